"""The benchmarks against native CPU code: the rounds are fair, a wrong or missing contender gets no time."""

from __future__ import annotations

import gc
import json
import os
import sys
import weakref
from pathlib import Path

import numpy as np
import pytest

from mpmbench import reference
from mpmbench.check import check_g2p, check_p2g
from mpmbench.reference import Nodes, ParticleValues

FOLDER = Path(__file__).resolve().parent.parent / "benchmarks"
PEERS = ("peers_gcc", "peers_warp", "peers_taichi")


@pytest.fixture(scope="module", autouse=True)
def folder_on_path():
    """Benchmarks are scripts in a folder of their own, not a package."""
    sys.path.insert(0, str(FOLDER))
    yield
    sys.path.remove(str(FOLDER))


@pytest.fixture
def restored_affinity():
    """Scripts pin themselves to one core; the tests after this one want theirs back."""
    cores = os.sched_getaffinity(0)
    yield
    os.sched_setaffinity(0, cores)


@pytest.fixture(scope="module")
def scene():
    from scenes import load

    return load("uniform_cube", 500, deep=True)


# --- rounds ---------------------------------------------------------------------------------------------------------


def test_drift_that_hits_both_arms_leaves_the_paired_ratio_alone():
    from rounds import paired_ratio

    drift = np.linspace(1, 5, 9)
    ratio = paired_ratio(2 * drift, drift)
    assert (ratio.median, ratio.low, ratio.high) == (2, 2, 2)


def test_interval_of_the_median_holds_the_truth():
    from rounds import median_interval

    random = np.random.default_rng(3)
    held = 0
    for trial in range(100):
        interval = median_interval(random.normal(1, 0.1, 21), seed=trial, resamples=500)
        held += interval.low <= 1 <= interval.high
    assert held >= 85


class Clock:
    """Time that passes only where an arm says so: on the core, or while another process has it."""

    def __init__(self):
        self.wall = self.core = 0.0

    def work(self, seconds):
        self.wall += seconds
        self.core += seconds

    def perf_counter(self):
        return self.wall

    def process_time(self):
        return self.core


@pytest.fixture
def clock(monkeypatch):
    import rounds

    clock = Clock()
    monkeypatch.setattr(rounds, "time", clock)
    return clock


def test_every_round_runs_every_arm_once_after_its_reset_in_seeded_random_order(clock):
    from rounds import Arm, run_rounds

    def orders(seed):
        log = []

        def run(name):
            log.append(name)
            clock.work("abc".index(name) + 1)

        arms = [Arm(n, run=lambda n=n: run(n), reset=lambda n=n: log.append(f"reset {n}")) for n in "abc"]
        sampled = run_rounds(arms, rounds=8, seed=seed)
        assert {name: set(seconds) for name, seconds in sampled.seconds.items()} == {"a": {1}, "b": {2}, "c": {3}}
        assert log[0::2] == [f"reset {name}" for name in log[1::2]]
        names = log[1::2]
        assert names[:3] == ["a", "b", "c"]  # untimed
        chunks = ["".join(names[i : i + 3]) for i in range(3, len(names), 3)]
        assert len(chunks) == 8
        assert all(sorted(chunk) == ["a", "b", "c"] for chunk in chunks)
        return chunks

    assert len(set(orders(1))) > 1
    assert orders(1) == orders(1) != orders(2)


def test_a_round_that_lost_the_core_is_run_again(clock):
    from rounds import Arm, run_rounds

    runs = []

    def lose_the_core_once():
        runs.append(1)
        clock.work(1)
        clock.wall += 0.5 * (len(runs) == 3)  # the second timed run; the first of all is untimed

    sampled = run_rounds([Arm("a", lose_the_core_once, lambda: None)], rounds=3, seed=0)
    assert (sampled.disturbed, sampled.kept_disturbed, len(runs)) == (1, 0, 5)
    assert sampled.seconds["a"].tolist() == sampled.processor_seconds["a"].tolist() == [1, 1, 1]


def test_rounds_end_on_a_machine_that_is_never_calm(clock):
    from rounds import Arm, run_rounds

    def shared():
        clock.work(1)
        clock.wall += 1

    sampled = run_rounds([Arm("a", shared, lambda: None)], rounds=6, seed=0)
    assert (sampled.disturbed, sampled.kept_disturbed) == (2, 6)
    assert sampled.seconds["a"].tolist() == [2] * 6
    assert sampled.processor_seconds["a"].tolist() == [1] * 6


# --- peers ----------------------------------------------------------------------------------------------------------


@pytest.fixture(params=PEERS)
def peer(request):
    from scenes import PeerMissing

    module = pytest.importorskip(request.param)
    try:
        return module.Peer()
    except PeerMissing as reason:
        pytest.skip(str(reason))


def test_peers_agree_with_the_reference(peer, scene):
    from scenes import aligned

    grid, n = scene.grid, scene.count
    nodes = aligned((grid.node_count, 4))
    run = peer.p2g(scene, nodes)
    run()
    host = grid.to_host_order(nodes)
    verdict = check_p2g(Nodes(host[..., 3], host[..., :3]), reference.p2g(scene.dataset, "cubic"))
    assert verdict.passed, verdict
    run()  # adds once more: what `reset` is for
    assert grid.to_host_order(nodes)[..., 3].sum() == pytest.approx(2 * scene.dataset.mass.sum(), rel=1e-5)

    velocity = np.random.default_rng(0).uniform(-1, 1, (*grid.shape, 3)).astype(np.float32)
    nodes[:, :3], results = grid.to_device_order(velocity), aligned((n, 4))
    peer.g2p(scene, nodes, results)()
    place = np.argsort(scene.to_given)
    verdict = check_g2p(ParticleValues(results[place, :3]), reference.g2p(scene.dataset, velocity, "cubic"))
    assert verdict.passed, verdict


def test_a_launch_keeps_its_arrays_alive(peer, scene):
    from scenes import aligned

    nodes = aligned((scene.grid.node_count, 4))
    held = weakref.ref(nodes)
    run = peer.p2g(scene, nodes)
    del nodes
    gc.collect()
    run()
    assert held() is not None
    assert held()[:, 3].sum() > 0


def test_sorted_scenes_walk_the_cells_in_memory_order(scene):
    cell = np.floor(scene.dataset.node_units(np.float32)[scene.to_given]).astype(int)
    nx, ny, _ = scene.grid.shape
    assert np.all(np.diff((cell[:, 2] * ny + cell[:, 1]) * nx + cell[:, 0]) >= 0)
    assert np.array_equal(scene.attributes[: scene.count, 3], scene.dataset.mass[scene.to_given].astype(np.float32))


def test_no_compiler_is_a_reason_not_a_crash(monkeypatch):
    import peers_gcc
    from scenes import PeerMissing

    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(PeerMissing, match="no g\\+\\+ on PATH"):
        peers_gcc.Peer()


# --- the scripts ----------------------------------------------------------------------------------------------------


class FakePeer:
    """Adds each particle's mass to one node, which is wrong."""

    name = "Warp"
    version = "0"

    def p2g(self, scene, nodes):
        def run():
            nodes[0, 3] += 1

        return run


def missing_peer():
    from scenes import PeerMissing

    raise PeerMissing("not here")


missing_peer.name = "Taichi"


def test_table_has_a_time_for_the_engine_and_reasons_for_wrong_and_missing_peers(
    tmp_path, monkeypatch, restored_affinity, capsys
):
    import engine_vs_cpu

    monkeypatch.setattr(engine_vs_cpu, "PEERS", (FakePeer, missing_peer))
    monkeypatch.setattr(engine_vs_cpu, "_copy_rate", lambda: 1e10)
    arguments = ["--particles", "600", "--rounds", "2", "--only", "P2G sorted, uniform_cube"]
    assert engine_vs_cpu.main([*arguments, "--out", str(tmp_path)]) == 0
    record = json.loads((tmp_path / "engine_vs_cpu.json").read_text())
    rows = {row["variant"]: row for row in record["rows"]}
    assert set(rows) == {"p2g_global_atomic", "p2g_block_sync"}
    for row in rows.values():
        assert list(row["seconds"]) == ["engine"]
        assert len(row["seconds"]["engine"]) == 2
        assert row["verdict"] == "not measured"
        assert row["excluded"]["Taichi"] == "not here"
        assert row["excluded"]["Warp"].startswith("FAILED")
    text = (tmp_path / "engine_vs_cpu.md").read_text()
    assert text in capsys.readouterr().out
    assert "measured (wall, CPU)" in text
    assert "- Taichi: no time, not here" in text


def test_verdict_compares_the_median_with_the_aim():
    from engine_vs_cpu import ROWS, Result
    from rounds import Interval

    def verdict(median, low, high):
        return Result(ROWS[0], 1, ratios={"Warp": Interval(median, low, high)}).verdict

    assert ROWS[0].target == 1.5
    assert verdict(1.2, 1.1, 1.3) == "met"
    assert verdict(1.4, 1.1, 1.6) == "met (within noise)"
    assert verdict(1.6, 1.55, 1.7) == "missed"
    assert verdict(1.6, 1.4, 1.7) == "missed (within noise)"


def test_compile_and_count_reports_every_strategy(tmp_path, monkeypatch, restored_affinity, capsys):
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
