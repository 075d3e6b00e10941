"""Warnings before and after a run, from the facts in a record alone."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import pytest
from fake_cupy import FakeGpu, fake_cupy
from fake_pynvml import FakeNvml, NvmlGpu

from mpmbench import preflight
from mpmbench.device.cuda import CudaDevice


def facts(monkeypatch: pytest.MonkeyPatch, **changes: Any) -> dict[str, Any]:
    monkeypatch.setitem(sys.modules, "cupy", fake_cupy(FakeGpu()))
    monkeypatch.setitem(sys.modules, "pynvml", FakeNvml(NvmlGpu(**changes)))
    return CudaDevice("cuda").facts


@pytest.mark.parametrize(
    ("changes", "trouble", "action"),
    [
        ({"reasons": 0x4}, "(power cap)", "power limit"),
        ({"reasons": 0x40 | 0x4}, "(power cap, hardware thermal slowdown)", "cool down"),
        ({"processes": [1, 2]}, "Other programs", "GPU of your own"),
        ({"mig": 1}, "MIG is on", "--mig=0"),
        ({"persistence": 0}, "Persistence mode is off", "--persistence-mode=1"),
        ({"power_limit": 400_000}, "power limit is lower", "--power-limit=700"),
    ],
)
def test_each_trouble_has_an_action(monkeypatch: pytest.MonkeyPatch, changes, trouble: str, action: str) -> None:
    told = {**facts(monkeypatch, **changes), "clocks_locked": True}
    ((what, cure),) = preflight.warnings(told)
    assert trouble in what
    assert action in cure


def test_a_gpu_in_order_raises_none(monkeypatch: pytest.MonkeyPatch) -> None:
    assert preflight.warnings({**facts(monkeypatch), "clocks_locked": True}) == []
    assert preflight.warnings({}) == []
    assert preflight.warnings({"name": "GPU of a record from before there were such facts"}) == []


def test_clocks_that_are_not_locked(monkeypatch: pytest.MonkeyPatch) -> None:
    ((trouble, action),) = preflight.warnings(facts(monkeypatch))
    assert "did not lock" in trouble
    assert "--lock-gpu-clocks base" in action
    ((trouble, action),) = preflight.warnings(facts(monkeypatch, capability=(5, 2)))
    assert "cannot lock" in trouble


def test_without_nvml_nothing_is_taken_for_granted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cupy", fake_cupy(FakeGpu()))
    monkeypatch.setitem(sys.modules, "pynvml", None)
    ((trouble, action),) = preflight.warnings(CudaDevice("cuda").facts)
    assert "not watched (nvidia-ml-py is not installed)" in trouble
    assert "pip install nvidia-ml-py" in action


def test_words_do_not_vary_with_the_moment(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every row tells of its GPU anew; a report says it once."""
    first = facts(monkeypatch, reasons=0x4, processes=[1, 2])
    later = facts(monkeypatch, reasons=0x4, processes=[1, 2, 3], temperature=80, sm_clock=900)
    assert preflight.warnings(first) == preflight.warnings(later)
    differing = {key for key in first if first[key] != later[key]}
    assert differing
    assert all(key.endswith(preflight.MOMENTARY) for key in differing)


def test_a_report_needs_no_nvml() -> None:
    code = "import sys, mpmbench.preflight; assert not {'pynvml', 'cupy'} & sys.modules.keys()"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
