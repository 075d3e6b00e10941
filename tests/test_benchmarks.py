"""The benchmarks against native CPU code: a wrong or missing contender gets no time, targets are held to ratios."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import pytest

from mpmbench.device import open_device
from mpmbench.environment import Environment
from mpmbench.peer_runs import PeerCase
from mpmbench.peers import Library, Peer, PeerMissing, open_library, resolve_axes
from mpmbench.protocol.rounds import Contest
from mpmbench.protocol.verdict import Interval
from mpmbench.runner import DatasetChoice, Inputs

FOLDER = Path(__file__).resolve().parent.parent / "benchmarks"


@pytest.fixture(scope="module", autouse=True)
def folder_on_path():
    """Benchmarks are scripts in a folder of their own, not a package."""
    sys.path.insert(0, str(FOLDER))
    yield
    sys.path.remove(str(FOLDER))


@pytest.fixture
def same_cores():
    """Scripts pin themselves to one core; what comes after them has all of its own again."""
    cores = os.sched_getaffinity(0)
    yield
    assert os.sched_getaffinity(0) == cores


# --- g++ ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("transfer", ["p2g", "g2p"])
@pytest.mark.parametrize("order", ["given", "deep"])
def test_gcc_agrees_with_the_reference(transfer, order):
    import peers_gcc

    try:
        open_library(peers_gcc.LIBRARY)
    except PeerMissing as reason:
        pytest.skip(str(reason))
    peer = Peer(peers_gcc.LIBRARY, transfer)
    box = DatasetChoice("random", particles=200, grid_shape=(12, 11, 13), dx=0.3, origin=(0.5, -1.0, 2.0))
    case = PeerCase(peer, box, resolve_axes(peer, {"particle_order": order}))
    record = case.run(open_device("cpu"), Inputs(), Environment.capture(argv=[]))
    assert record.status == "ok", record


def test_no_compiler_is_a_reason_not_a_crash(monkeypatch):
    import peers_gcc

    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(PeerMissing, match="no g\\+\\+ on PATH"):
        peers_gcc.Transfers()


# --- the scripts ----------------------------------------------------------------------------------------------------


class Wrong:
    """Adds to one node alone."""

    version, facts = "0", {}

    def p2g(self, grid, count, particles, nodes):
        def run():
            nodes[0, 3] += 1

        return run


def missing():
    raise PeerMissing("not here")


def test_table_has_a_time_for_the_engine_and_reasons_for_wrong_and_missing_peers(
    tmp_path, monkeypatch, same_cores, capsys
):
    import engine_vs_cpu

    fakes = (Library("wrong", "NVIDIA Warp", "", Wrong, FOLDER / "machine.py"),
             Library("missing", "Taichi", "", missing, FOLDER / "machine.py"))  # fmt: skip
    monkeypatch.setattr(engine_vs_cpu, "PEERS", fakes)
    monkeypatch.setattr(engine_vs_cpu, "_copy_rate", lambda: 1e10)
    arguments = ["--particles", "600", "--rounds", "2", "--only", "P2G sorted, uniform_cube"]
    assert engine_vs_cpu.main([*arguments, "--out", str(tmp_path)]) == 0
    record = json.loads((tmp_path / "engine_vs_cpu.json").read_text())
    rows = {row["variant"]: row for row in record["rows"]}
    assert set(rows) == {"p2g_global_atomic", "p2g_block_sync"}
    for row in rows.values():
        assert list(row["seconds"]) == ["engine"]
        assert len(row["seconds"]["engine"]) == 2 * 4
        assert row["verdict"] == "not measured"
        assert row["excluded"]["Taichi"] == "not here"
        assert row["excluded"]["NVIDIA Warp"].startswith("FAILED")
        assert row["floor_seconds"] > 0
    text = (tmp_path / "engine_vs_cpu.md").read_text()
    assert text in capsys.readouterr().out
    assert "measured (wall, CPU)" in text
    assert "- Taichi: no time, not here" in text


def contest(**seconds):
    """What rounds of these samples come to, the first being the baseline."""
    first = next(iter(seconds))
    return Contest(first, seconds, {}, [2 * s for s in seconds[first]], {}, (), Interval(1, 1, 1), 2, 0, 0, "verdict",
                   {"core taken": 3}, {}, {"peer_taichi_p2g": "THROTTLED"})  # fmt: skip


def test_ratios_are_the_engine_over_each_peer_pass_by_pass(monkeypatch):
    import engine_vs_cpu

    monkeypatch.setattr(engine_vs_cpu, "_copy_rate", lambda: 1e10)
    monkeypatch.setattr(engine_vs_cpu, "PEERS", ())
    bench = engine_vs_cpu.Bench(600, engine_vs_cpu.Rules(), 1)
    bench.versions = {"NVIDIA Warp": "1", "Taichi": "2"}
    drift = [1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0]
    sampled = contest(peer_warp_p2g=drift, p2g_global_atomic=[1.25 * s for s in drift])
    labels = {"NVIDIA Warp": "peer_warp_p2g", "Taichi": "peer_taichi_p2g", "p2g_global_atomic": "p2g_global_atomic"}
    variant = engine_vs_cpu.get("p2g_global_atomic")
    case = engine_vs_cpu.Case(
        variant, DatasetChoice("random", 600), engine_vs_cpu.resolve_axes(variant, engine_vs_cpu.AXES)
    )
    result = bench._result(engine_vs_cpu.ROWS[0], case, sampled, labels, {})
    assert result.ratios == {"NVIDIA Warp": Interval(1.25, 1.25, 1.25)}
    assert result.verdict == "met"
    assert result.noise == Interval(0.5, 0.5, 0.5)
    assert result.excluded == {"Taichi": "THROTTLED"}
    assert engine_vs_cpu.notes([result], {"machine": {"load_average_before": 0.0}}) == [
        "P2G sorted, uniform_cube: 3 passes run again: core taken",
        "Taichi: no time, THROTTLED",
    ]


def test_verdict_compares_the_median_with_the_aim():
    from engine_vs_cpu import AIMED_AT, ROWS, Result

    def verdict(median, low, high):
        return Result(ROWS[0], 1, ratios={AIMED_AT: Interval(median, low, high)}).verdict

    assert ROWS[0].target == 1.5
    assert verdict(1.2, 1.1, 1.3) == "met"
    assert verdict(1.4, 1.1, 1.6) == "met (within noise)"
    assert verdict(1.6, 1.55, 1.7) == "missed"
    assert verdict(1.6, 1.4, 1.7) == "missed (within noise)"


def test_compile_and_count_reports_every_strategy(tmp_path, monkeypatch, same_cores, capsys):
    import compile_and_count

    from mpmbench.variants import get

    monkeypatch.setattr(compile_and_count, "discover", lambda: (get("g2p_global_gather"),))
    monkeypatch.setattr(compile_and_count, "COUNTED", ("g2p_global_gather",))
    cache = os.environ.get("MPMBENCH_CACHE_DIR")
    assert compile_and_count.main(["--quick", "--particles", "600", "--out", str(tmp_path)]) == 0
    assert os.environ.get("MPMBENCH_CACHE_DIR") == cache
    record = json.loads((tmp_path / "compile_and_count.json").read_text())
    assert [(t["variant"], t["mode"]) for t in record["compile"]] == [
        ("g2p_global_gather", "run"),
        ("g2p_global_gather", "count"),
    ]
    for times in record["compile"]:
        assert times["load"] < times["total"] == times["nvrtc"] + times["engine"]
    assert record["count"][0]["warp_inst"] > 0
    assert "g2p_global_gather" in capsys.readouterr().out
