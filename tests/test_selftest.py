"""The self-test passes on the simulated device, and on a GPU it would see what is wrong."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import cupy
import numpy as np
import pytest
from fake_cupy import FakeGpu, fake_cupy, on_the_engine

from mpmbench import selftest
from mpmbench.dataset import Dataset
from mpmbench.errors import InputError
from mpmbench.reference import Nodes, ParticleValues, p2g
from mpmbench.selftest import axis_changes, hardware_table, largest_difference, run_selftest
from mpmbench.variants import discover, get

DOCS = Path(__file__).parent.parent / "docs"


def test_quick_on_the_simulated_device() -> None:
    rows = run_selftest("simulated", quick=True)
    assert len(rows) == selftest.QUICK_DATASETS * len(discover())
    for row in rows:
        assert row.passed, str(row)
        assert row.error is not None
        assert row.error < 1
        assert (row.seconds, row.difference) == (None, None), "the simulated device has no time"
        assert str(row).startswith("ok ")


@pytest.mark.slow
def test_full_on_the_simulated_device() -> None:
    failed = [str(row) for row in run_selftest("simulated") if not row.passed]
    assert not failed


@pytest.mark.gpu
def test_on_a_gpu(cuda_device: Any) -> None:
    failed = [str(row) for row in run_selftest(cuda_device.name) if not row.passed]
    assert not failed


# A GPU that is a CPU: the fake driver hands each kernel, compiled as CuPy would, to the engine.


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch) -> FakeGpu:
    machine = FakeGpu(capability="52", execute=on_the_engine())
    monkeypatch.setitem(sys.modules, "cupy", fake_cupy(machine))
    monkeypatch.setattr(selftest, "DATASETS", {"one_cell": {"particles": 70, "grid_shape": (12, 12, 12)}})
    monkeypatch.setattr(selftest, "QUICK", selftest.QUICK.__class__(min_samples=2, max_samples=2, warmup_limit=0))
    return machine


def test_on_a_gpu_results_are_compared_and_timed(gpu: FakeGpu) -> None:
    gpu.seconds = {variant.kernel: 123e-6 for variant in discover()}
    rows = run_selftest("cuda", quick=True)
    assert len(rows) == len(discover())
    for row in rows:
        assert row.passed, str(row)
        assert row.difference is not None
        assert row.difference <= 1
        assert row.seconds == pytest.approx(123e-6)
        assert "123.0 us" in str(row)


def test_a_gpu_that_adds_wrongly_is_found_out_and_not_timed(gpu: FakeGpu) -> None:
    def lose_some(name: str, arguments: tuple[Any, ...]) -> None:
        if name == "p2g_global_atomic":
            arguments[-1][...] *= 0.999

    gpu.execute = on_the_engine(lose_some)
    rows = {row.variant: row for row in run_selftest("cuda", quick=True)}
    wrong = rows.pop("p2g_global_atomic")
    assert not wrong.passed
    assert wrong.seconds is None
    assert "worst error" in wrong.problem
    assert "differs from the simulated device" in wrong.problem
    assert str(wrong).startswith("FAILED p2g_global_atomic one_cell: ")
    assert all(row.passed for row in rows.values())


def test_a_gpu_that_goes_wrong_in_the_long_run_is_found_out(gpu: FakeGpu) -> None:
    """Such as a strategy that does not reset something of its own between repeats."""
    launches = []

    def lose_some_later(name: str, arguments: tuple[Any, ...]) -> None:
        if name == "p2g_global_atomic":
            launches.append(name)
            if len(launches) > 2:
                arguments[-1][...] *= 0.999

    gpu.execute = on_the_engine(lose_some_later)
    rows = {row.variant: row for row in run_selftest("cuda", quick=True)}
    wrong = rows.pop("p2g_global_atomic")
    assert "wrong once it has run many times" in wrong.problem
    assert wrong.seconds is None
    assert all(row.passed for row in rows.values()), "every strategy can be repeated"


def test_a_failing_launch_fails_its_rows_only(gpu: FakeGpu) -> None:
    run = on_the_engine()

    def execute(ptx: str, name: str, *rest: Any) -> None:
        if name == "g2p_block_gather":
            raise cupy.cuda.runtime.CUDARuntimeError(701)
        run(ptx, name, *rest)

    gpu.execute = execute
    rows = run_selftest("cuda", quick=True)
    assert [row.variant for row in rows if not row.passed] == ["g2p_block_gather"]


def test_findings_fail_a_row(monkeypatch: pytest.MonkeyPatch) -> None:
    from mpmbench.device import LaunchReport
    from mpmbench.plan import Plan
    from mpmbench.simt.counters import Finding

    real = Plan.run_once

    def with_a_race(plan: Plan, device: Any) -> Any:
        before, _, after = real(plan, device)
        return before, LaunchReport(findings=(Finding("race", "p2g", "two warps write one word"),)), after

    monkeypatch.setattr(Plan, "run_once", with_a_race)
    monkeypatch.setattr(selftest, "DATASETS", {"one_cell": {"particles": 5, "grid_shape": (12, 12, 12)}})
    monkeypatch.setattr(selftest, "discover", lambda: (get("p2g_global_atomic"),))
    (row,) = run_selftest("simulated", quick=True)
    assert row.problem == "race: two warps write one word"


def test_full_run_changes_every_axis_by_itself() -> None:
    variant = get("p2g_block_sync")
    changes = list(axis_changes(variant))
    assert changes[0] == {}
    assert {name for change in changes for name in change} == set(variant.axes)
    assert all(len(change) <= 1 for change in changes)


def test_largest_difference() -> None:
    dataset = Dataset.from_arrays(np.full((1, 3), 3.5), np.ones((1, 3)), mass=1.0, affine=None, grid_shape=(8, 8, 8),
                                  dx=1.0, origin=(0, 0, 0))  # fmt: skip
    reference = p2g(dataset, "cubic")
    nodes = reference.nodes
    assert largest_difference(nodes, nodes, reference) == 0
    moved = Nodes(nodes.mass + 1e-12, nodes.momentum)
    assert largest_difference(nodes, moved, reference) == np.inf, "nodes that no particle reaches have no allowance"
    broken = Nodes(nodes.mass.copy(), nodes.momentum)
    broken.mass[3, 3, 3] = np.nan
    assert largest_difference(nodes, broken, reference) == np.inf
    near = Nodes(nodes.mass * (1 + 1e-8), nodes.momentum)
    assert 0 < largest_difference(nodes, near, reference) < 1


def test_no_such_device() -> None:
    with pytest.raises(InputError, match="unknown device 'metal'"):
        run_selftest("metal")
    with pytest.raises(InputError, match="sm_1"):
        run_selftest("simulated", arch="sm_1")


def test_what_has_run_on_hardware_is_written_down() -> None:
    table = hardware_table()
    assert [line.split("`")[1] for line in table.splitlines()[2:]] == [variant.name for variant in discover()]
    for page in (DOCS / "hardware.md", DOCS.parent / "README.md"):
        assert table.strip() in page.read_text(), f"{page.name} is stale: paste hardware_table() into it"


def test_values_of_both_transfers_are_compared() -> None:
    values = ParticleValues(np.ones((2, 3)), np.ones((2, 3, 3)))
    assert selftest._components_first(values).shape == (12, 2)
