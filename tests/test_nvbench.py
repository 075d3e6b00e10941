"""What we write as NVBench's, its own tools read; and what they read is what was measured."""

from __future__ import annotations

import dataclasses
import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import mpmbench.nvbench as nvbench_module
from mpmbench.cli import main
from mpmbench.errors import InputError
from mpmbench.nvbench import EVENTS, WALL, statistics_of, write_nvbench
from mpmbench.nvbench_rows import read_nvbench, read_rows, rows_of_records
from mpmbench.record import Check, RecordWriter
from tests.timed_rows import GPU, samples, simulated, timed, untimed, wall

results = pytest.importorskip("cuda.bench.results")


def tool(name, *words, code=0):
    """Output of one of cuda-bench's programs."""
    program = Path(sys.executable).with_name(f"nvbench-{name}")
    run = subprocess.run([program, *map(str, words)], capture_output=True, text=True, timeout=60)
    assert run.returncode == code, run.stdout + run.stderr
    assert "WARNING" not in run.stdout  # of a version it does not know
    return run.stdout + run.stderr


def robust(*words, code=0):
    """Its table and summary, with the code of each reason."""
    return tool("compare-robust", "--no-color", "--display", "explain", *words, code=code)


def written(tmp_path, name, *records):
    write_nvbench(records, tmp_path / name)
    return tmp_path / name


# ---- what the tools see --------------------------------------------------------------------------------------------


def test_the_summary_shows_rates_and_times(tmp_path):
    text = tool("json-summary", written(tmp_path, "a.json", timed(times=(1e-3,) * 10)))
    assert "### [0] Test GPU" in text
    heads, _, row = (line for line in text.splitlines() if line.startswith("|"))
    cells = dict(zip((c.strip() for c in heads.split("|")), (c.strip() for c in row.split("|")), strict=True))
    assert cells["strategy"] == "p2g_global_atomic"
    assert (cells["block_shape"], cells["batching"], cells["cache"]) == ("8x4x4", "4", "cold")
    assert (cells["Samples"], cells["GPU Time"], cells["Noise"]) == ("10x", "1.000 ms", "0.00%")
    assert cells["Elem/s"] == "4.096M"
    assert cells["Floor BW"] == "64.000 MB/s"
    assert cells["Other Steps"] == "200.000 us"
    assert "GlobalMem BW" not in cells  # nobody counted the bytes that moved


def test_five_percent_is_slow_and_the_same_distribution_is_same(tmp_path):
    ref = written(tmp_path, "ref.json", timed(times=samples(1)))
    same = written(tmp_path, "same.json", timed(times=samples(2)))
    slow = written(tmp_path, "slow.json", timed(times=samples(2, 1.05e-3)))
    fast = written(tmp_path, "fast.json", timed(times=samples(2, 0.95e-3)))
    assert "bulk-same" in robust(ref, same)
    assert "Regression  (clear timing gap, %Diff > 0): 1" in robust(ref, slow)
    assert "bc-gap" in robust(ref, slow)  # cycles come from both kinds of sidecar
    assert "Improvement (clear timing gap, %Diff < 0): 1" in robust(ref, fast)
    for file in (ref, same, slow, fast):
        tool("compare-legacy", "--no-color", ref, file, code=int(file in (slow, fast)))
        tool("json-summary", file)


@pytest.mark.parametrize("folder", ["cmp.json-bin", "cmp.json-freqs-bin"])
def test_a_broken_sidecar_is_noticed(tmp_path, folder):
    """So the tools do read the sidecars."""
    ref = written(tmp_path, "ref.json", timed(times=samples(1)))
    cmp = written(tmp_path, "cmp.json", timed(times=samples(2)))
    assert "classified as SAME): 1" in robust(ref, cmp)
    [sidecar] = (tmp_path / folder).iterdir()
    sidecar.write_bytes(sidecar.read_bytes()[:-4])
    text = robust(ref, cmp)
    assert "classified as SAME): 0" in text
    assert "expected 60 values" in text
    with pytest.raises(ValueError, match="expected 60 values"):
        results.BenchmarkResult.from_json(cmp)


def test_their_reader_gets_every_sample_and_every_reason(tmp_path):
    wrong = untimed(timed("p2g_block_sync"), check=Check(False, 2.0, 1.0))
    skipped = untimed(timed("p2g_block_pull"), check=None, skipped_because="does not fit")
    broken = untimed(timed("p2g_block_atomic"), check=None, failed_because="no launch")
    checked = untimed(timed("p2g_global_node"))
    good = timed(times=samples(3))
    file = written(tmp_path, "a.json", good, wrong, skipped, broken, checked, simulated())
    states = results.BenchmarkResult.from_json(file)["p2g"].states
    assert np.array_equal(states[0].samples, np.float32(good.transfer_measurement.samples))
    assert np.array_equal(states[0].frequencies, np.float32(good.transfer_measurement.hertz))
    assert [state.skip_reason for state in states] == [
        None, "wrong result: error 2 x allowed", "does not fit", "no launch", "checked, not timed",
        "counted on the simulated device: it has no time",
    ]  # fmt: skip
    assert all(state.is_skipped and not state.summaries for state in states[1:])
    text = robust(file, file)
    assert "Total Matches: 5" in text  # the simulated row is on no GPU
    assert "state-skip" in text
    assert tool("json-summary", file).count("p2g_") == 1


def test_a_row_that_fails_later_is_still_the_same_row(tmp_path):
    """Its cache state is that of the other rows: the tool would refuse both files otherwise."""
    other = timed("p2g_block_sync", times=samples(4))
    ref = written(tmp_path, "ref.json", timed(), other)
    cmp = written(tmp_path, "cmp.json", timed(), untimed(other, check=None, failed_because="no launch"))
    assert "Unknown     (input data unavailable or unusable): 1" in robust(ref, cmp)


def test_two_gpus(tmp_path):
    second = {**GPU, "name": "Other GPU", "uuid": "bb"}
    rows = [
        timed(times=samples(1)),
        dataclasses.replace(timed(times=samples(2), gpu=second), device="cuda:1"),
        timed(times=samples(3), gpu={**GPU, "uuid": "cc", "name": "Third GPU"}),  # cuda:0 of another machine
    ]
    file = written(tmp_path, "a.json", *rows)
    devices = results.BenchmarkResult.from_json(file).devices
    assert {number: device.name for number, device in devices.items()} == {
        0: "Test GPU", 1: "Other GPU", 2: "Third GPU",
    }  # fmt: skip
    assert devices[0].data["sm_version"] == 900
    assert devices[0].data["global_memory_bus_bandwidth"] == 2 * 2_000_000_000 * 5120 // 8
    text = tool("json-summary", file)
    assert all(f"### [{number}]" in text for number in (0, 1, 2))
    assert "Total Matches: 3" in robust(file, file)


def test_wall_times_never_stand_as_gpu_times(tmp_path):
    file = written(tmp_path, "a.json", timed(), wall(times=samples(5)), wall("g2p_global_gather", times=samples(6)))
    content = json.loads(file.read_text())
    assert [b["name"] for b in content["benchmarks"]] == ["p2g", "p2g (CPU)", "g2p (CPU)"]
    assert "nv/cold" not in json.dumps(content["benchmarks"][1:])
    text = tool("json-summary", file)
    assert "CPU Time" in text.split("## p2g (CPU)")[1]
    assert "GPU Time" not in text.split("## p2g (CPU)")[1]
    assert "Total Matches: 1" in robust(file, file)
    tool("compare-legacy", "--no-color", file, file)


@pytest.mark.parametrize("name", ["", "röhre 粒子", 'a|b "c"\n', "x=1 [y]"])
def test_names_of_any_kind(tmp_path, name):
    file = written(tmp_path, "größe 1.json", timed(dataset=name), timed("p2g_block_sync", dataset=name, axes={}))
    assert results.BenchmarkResult.from_json(file)["p2g"].states[0].point["dataset"] == name
    tool("json-summary", file)
    assert "Total Matches: 2" in robust(file, file)
    assert {row.dataset for row in read_nvbench(file)} == {name}
    file.read_bytes().decode("ascii")  # readable under any locale


@pytest.mark.parametrize("records", [(), (simulated(),), (wall(),), (timed(hertz=None),), (timed(times=(0.0,)),)])
def test_whatever_is_in_it_the_tools_read_it(tmp_path, records):
    file = written(tmp_path, "a.json", *records)
    tool("json-summary", file)
    robust(file, file)
    assert len(read_nvbench(file)) == len(records)


def test_few_samples_have_no_noise(tmp_path):
    file = written(tmp_path, "a.json", timed(times=samples(1, count=4)))
    assert "noise_unavailable" in robust(file, file)


def test_quartiles_are_the_tools_own():
    from cuda.bench.scripts import nvbench_compare_robust as theirs

    theirs.load_nvbench_compare_tooling(load_color=False)
    for count in (1, 2, 5, 10, 61, 100):
        times = samples(count, count=count)
        ours = statistics_of(times)
        estimate, interval = theirs.compute_robust_timing_input_from_samples(times)
        assert (ours["min"], ours["median"], ours["q3"]) == (interval.lower, interval.center, interval.upper)
        if count >= 5:
            assert ours["iqr/relative"] == pytest.approx(estimate.relative_dispersion, rel=1e-12)
            assert ours["stdev/absolute"] == pytest.approx(np.std(times, ddof=1))


# ---- the file on disk ----------------------------------------------------------------------------------------------


def test_the_json_comes_last_and_stale_sidecars_go(tmp_path, monkeypatch):
    order = []
    replace = os.replace

    def recorded(source, target):
        order.append(Path(target).name)
        replace(source, target)

    monkeypatch.setattr(nvbench_module.os, "replace", recorded)
    file = written(tmp_path, "a.json", timed(), timed("p2g_block_sync", times=samples(2)))
    assert order[-1] == "a.json"
    assert len(order) == len(set(order)) == 4  # two of times, one of equal clocks, the JSON
    write_nvbench([timed(times=samples(9), hertz=None)], file)
    assert len(list((tmp_path / "a.json-bin").iterdir())) == 1
    assert list((tmp_path / "a.json-freqs-bin").iterdir()) == []


@pytest.mark.parametrize("room", range(4))
def test_a_full_disk_leaves_the_old_file(tmp_path, monkeypatch, room):
    """After so many files, whichever of them does not fit."""
    file = written(tmp_path, "a.json", timed(times=samples(1)))
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    write_bytes, left = Path.write_bytes, [room]

    def filling(self, data):
        left[0] -= 1
        if left[0] < 0:
            write_bytes(self, data[: len(data) // 2])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write_bytes(self, data)

    monkeypatch.setattr(Path, "write_bytes", filling)
    new = [timed(times=samples(2), hertz=1.4e9), timed("p2g_block_sync", times=samples(3), hertz=1.4e9)]
    with pytest.raises(InputError, match=r"cannot write .*a\.json: no space left on device"):
        write_nvbench(new, file)
    monkeypatch.undo()
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
    assert "classified as SAME): 1" in robust(file, file)


# ---- back to rows --------------------------------------------------------------------------------------------------


def test_a_file_and_its_journal_give_the_same_rows(tmp_path):
    records = [timed(), wall(), simulated(), untimed(timed("p2g_block_sync"), check=None, failed_because="no launch")]
    file = written(tmp_path, "a.json", *records)
    with RecordWriter(tmp_path / "a.jsonl") as writer:
        for record in records:
            writer.write(record)
    back, journal = read_rows(file), read_rows(tmp_path / "a.jsonl")
    for one, other in zip(back, journal, strict=True):
        plain = [dataclasses.replace(row, path=Path(), state={}, sidecars=None) for row in (one, other)]
        assert plain[0] == plain[1]
    assert [row.kind for row in back] == [EVENTS, "simulated", EVENTS, WALL]
    assert back[0].seconds("median") == sorted(records[0].transfer_measurement.samples)[30]
    assert back[0].environment["gpu.cupy"] == "14.2.0"
    assert back[0].environment["mpmbench"] == records[0].environment.mpmbench


def test_axes_that_a_strategy_lacks_are_not_its_axes():
    rows = rows_of_records([timed(), timed("p2g_global_node", axes={"spline": "linear"})], "a.jsonl")
    assert rows[1].axes == (("spline", "linear"),)
    assert {value["name"]: value["value"] for value in rows[1].state["axis_values"]}["batching"] == "-"


def test_a_row_that_was_not_timed_keeps_the_cache_state_it_was_meant_for():
    failed = untimed(timed("p2g_block_sync", cache="hot"), check=None, failed_because="no launch")
    row = rows_of_records([timed(), failed], "a.jsonl")[1]
    assert row.cache == "hot"
    assert row.state["axis_values"][-1]["value"] == "hot"


def test_a_file_of_nvbench_itself(tmp_path):
    """Made by hand after its format: no key of ours, a mean only in one state, numbers as text."""
    value = {"name": "value", "type": "float64", "value": "2.5e-06"}
    state = {
        "name": "Device=0 N=2^8", "device": 0, "is_skipped": False,
        "axis_values": [{"name": "N", "type": "int64", "value": "256"}],
        "summaries": [{"tag": "nv/cold/time/gpu/mean", "name": "GPU Time", "hint": "duration", "data": [value]}],
    }  # fmt: skip
    skipped = {**state, "summaries": None, "is_skipped": True, "skip_reason": "too small"}
    content = {
        "meta": {"version": {"json": {"string": "1.0.0"}, "nvbench": {"string": "0.3.0"}}},
        "devices": [{"id": 0, "name": "GPU X", "sm_version": 900}],
        "benchmarks": [{"name": "copy", "devices": [0], "axes": [], "states": [state, skipped]}],
    }
    (tmp_path / "n.json").write_text(json.dumps(content))
    first, second = read_rows(tmp_path / "n.json")
    assert (first.strategy, first.axes, first.kind, first.cache) == ("copy", (("N", "256"),), EVENTS, "cold")
    assert (first.seconds("mean"), first.seconds("median"), first.without_time) == (2.5e-6, None, "")
    assert first.environment == {"nvbench": "0.3.0", "gpu.name": "GPU X", "gpu.sm_version": 900}
    assert second.without_time == "too small"


@pytest.mark.parametrize("text", ["", "{", "[1]", '{"benchmarks": 3}', '{"benchmarks": [{"name": "a"}]}', "\x00\xff"])
def test_other_files_are_refused(tmp_path, text):
    (tmp_path / "x.json").write_text(text)
    with pytest.raises(InputError, match=r"x\.json is (empty|neither|not what)"):
        read_rows(tmp_path / "x.json")
    with pytest.raises(InputError, match="no such file"):
        read_rows(tmp_path / "none.json")


# ---- the command line ----------------------------------------------------------------------------------------------


def test_run_and_report_leave_files_that_both_tools_read(tmp_path):
    rows, first, second = (tmp_path / name for name in ("rows.jsonl", "run.json", "report.json"))
    words = ["run", "--quick", "--particles", "300", "--dataset", "random", "-d", "simulated", "-b", "p2g_global_*"]
    run = CliRunner().invoke(main, [*words, "--json", str(rows), "--nvbench", str(first)])
    assert run.exit_code == 0, run.output
    assert f"wrote {first}" in run.output.replace("\n", "")
    again = CliRunner().invoke(main, ["report", str(rows), "--nvbench", str(second)])
    assert again.exit_code == 0, again.output
    for file in (first, second):
        assert "No data" in tool("json-summary", file)
        assert "Total Matches: 0" in robust(first, file)
        states = results.BenchmarkResult.from_json(file)["p2g"].states
        assert {state.skip_reason for state in states} == {"counted on the simulated device: it has no time"}
    assert json.loads(first.read_text())["mpmbench"]["environments"][0]["cores"] >= 1
    refused = CliRunner().invoke(main, ["report", str(rows), "--nvbench", str(rows)])
    assert refused.exit_code == 2
