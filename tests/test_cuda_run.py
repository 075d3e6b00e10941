"""`mpmbench run -d cuda` end to end over the fake driver: checked, timed step by step, recorded, reported."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from fake_cupy import FakeGpu, fake_cupy, on_the_engine

from mpmbench import measure
from mpmbench.cli import main
from mpmbench.nvbench_rows import read_nvbench
from mpmbench.protocol import rounds
from mpmbench.record import Record, read_records

QUICK_RUN = ["run", "-d", "cuda", "--quick", "--dataset", "one_cell", "--particles", "60"]


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch) -> FakeGpu:
    machine = FakeGpu(capability="90", execute=on_the_engine())
    monkeypatch.setitem(sys.modules, "cupy", fake_cupy(machine))
    monkeypatch.setattr(measure, "QUICK", measure.Sampling(min_samples=2, max_samples=2, warmup_limit=0))
    monkeypatch.setattr(rounds, "QUICK", rounds.Rules(min_rounds=2, max_rounds=2, warmup_limit=0))
    return machine


def run(tmp_path: Path, *words: str) -> tuple[Any, list[Record]]:
    path = tmp_path / "records.jsonl"
    result = CliRunner().invoke(main, [*QUICK_RUN, *words, "--json", str(path), "--md", str(tmp_path / "report.md")])
    return result, read_records(path)


def test_records_hold_event_times_of_every_step(gpu: FakeGpu, tmp_path: Path) -> None:
    gpu.seconds = {"p2g_block_sync": 0.004, "sort_deep": 0.001, "p2g_global_atomic": 0.008}
    result, records = run(tmp_path, "-b", "p2g_block_sync", "-b", "p2g_global_atomic")
    assert result.exit_code == 0, result.output
    record = {record.variant: record for record in records}["p2g_block_sync"]
    assert (record.device, record.arch, record.status) == ("cuda:0", "sm_90", "ok")
    assert record.transfer_measurement is not None
    assert record.transfer_measurement.median == pytest.approx(0.004)
    assert record.transfer_measurement.mode == "cold"
    assert record.transfer_counters is None, "a GPU measures, it does not count"
    steps = {name: cost.measurement for name, cost in record.preprocess.items()}
    assert {"binning", "scan", "sort_deep", "active_list", "grid_clear"} <= steps.keys()
    assert steps["sort_deep"] is not None
    assert steps["sort_deep"].median == pytest.approx(0.001)
    assert record.environment.gpu["name"] == "Fake GPU"
    assert record.environment.gpu["nvrtc"] == "12.9"
    assert record.kernel_info["p2g_block_sync"]["registers"] == 32
    assert json.loads((tmp_path / "records.jsonl").read_text().splitlines()[0])
    report = (tmp_path / "report.md").read_text()
    assert "p2g_block_sync" in report
    assert "measured" in report.lower()


def test_event_times_reach_nvbench(gpu: FakeGpu, tmp_path: Path) -> None:
    result, records = run(tmp_path, "-b", "p2g_global_atomic", "--nvbench", str(tmp_path / "n.json"))
    assert result.exit_code == 0, result.output
    [row] = read_nvbench(tmp_path / "n.json")
    assert records[0].transfer_measurement is not None
    assert row.seconds("max") == max(records[0].transfer_measurement.samples)
    assert (row.kind, row.environment["gpu.name"]) == ("measured (events)", "Fake GPU")
    compared = CliRunner().invoke(main, ["compare", str(tmp_path / "records.jsonl"), str(tmp_path / "n.json")])
    assert compared.exit_code == 0, compared.output


def test_a_wrong_result_has_no_time(gpu: FakeGpu, tmp_path: Path) -> None:
    def drop(name: str, arguments: tuple[Any, ...]) -> None:
        if name == "p2g_global_atomic":
            arguments[-1][...] = 0

    gpu.execute = on_the_engine(drop)
    result, (record,) = run(tmp_path, "-b", "p2g_global_atomic")
    assert result.exit_code == 4, result.output
    assert record.status == "wrong"
    assert record.transfer_measurement is None
    assert "event" not in gpu.names(), "no event may be recorded for a wrong kernel"


def test_too_large_is_a_row(gpu: FakeGpu, tmp_path: Path) -> None:
    gpu.memory_bytes = 1 << 20
    result, (record,) = run(tmp_path, "-b", "p2g_global_atomic")
    assert result.exit_code == 0, result.output
    assert record.status == "skipped"
    assert "GiB" in (record.skipped_because or "")
    assert not gpu.details("kernel")
