"""Sampling: the order of calls around a sample, verified before timed, warm-up, and the stop rule."""

from __future__ import annotations

import hashlib
import itertools
import random
import statistics
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from fake_cupy import FakeGpu, fake_cupy

from mpmbench import measure
from mpmbench.device import CompiledKernel, Launch
from mpmbench.device.cuda import CudaDevice
from mpmbench.errors import InputError
from mpmbench.kernel import KernelSource
from mpmbench.measure import DeviceClock, Sampling, measure_steps, too_fast_to_rank
from mpmbench.protocol.verdict import median_interval

TWO_KERNELS = """
extern "C" __global__ void first(int* x) { x[0] = 1; }
extern "C" __global__ void second(int* x) { x[0] = 2; }
"""


@dataclass(frozen=True)
class Step:
    name: str
    launches: tuple[Any, ...]
    after: Callable[[], Any] | None = None


@dataclass
class ScriptedDevice:
    """Kernels take the next of their scripted times [s]; everything that happens is logged."""

    times: dict[str, Iterator[float]]
    name: str = "cuda:0"
    now: float = 0.0
    calls: list[str] = field(default_factory=list)
    hold_expired: bool = False

    def launch(self, launch: Any) -> None:
        self.now += next(self.times[launch]) if launch in self.times else 0.0
        self.calls.append(launch)

    def synchronize(self) -> None:
        self.calls.append("sync")

    def flush_cache(self) -> None:
        self.now += 1.0
        self.calls.append("flush")

    def hold(self) -> None:
        self.now += 1.0
        self.calls.append("hold")

    def release(self) -> None:
        self.calls.append("release")

    def record(self) -> float:
        self.calls.append("event")
        return self.now

    def elapsed(self, start: float, end: float) -> float:
        assert self.calls[-1] == "sync"
        return end - start


def constant(seconds: float) -> Iterator[float]:
    return itertools.repeat(seconds)


def noisy(seconds: float, relative: float, seed: int) -> Iterator[float]:
    generator = random.Random(seed)
    while True:
        yield seconds * (1 + relative * abs(generator.gauss(0, 1)))


FEW = Sampling(min_samples=3, max_samples=3, warmup_seconds=0, warmup_limit=0)
SAMPLE = ["flush", "sync", "hold", "event", "K", "event", "release", "sync"]


RESET = [Step("r", ("R",))]
TRANSFER = Step("transfer", ("K",))


def test_order_of_calls_of_a_cold_sample() -> None:
    device = ScriptedDevice({"K": constant(0.001)})
    measure_steps(device, [TRANSFER], before=RESET, sampling=FEW)
    assert device.calls == ["R", *SAMPLE] * 4  # one warm-up and three samples, outputs reset before each


def test_warm_sample_is_not_flushed() -> None:
    device = ScriptedDevice({"K": constant(0.001)})
    measure.sample_step(device, Step("transfer", ("K", "K")), "step")
    assert device.calls == ["sync", "hold", "event", "K", "K", "event", "release", "sync"]


def test_a_launch_that_waits_for_the_held_stream_is_an_error_and_not_a_time() -> None:
    device = ScriptedDevice({"K": constant(0.001)}, hold_expired=True)
    with pytest.raises(InputError, match="transfer cannot be timed"):
        measure.sample_step(device, TRANSFER, "cold")


def test_the_stream_is_let_go_when_a_launch_fails() -> None:
    device = ScriptedDevice({"K": iter([])})
    with pytest.raises(StopIteration):
        measure.sample_step(device, TRANSFER, "cold")
    assert device.calls[-1] == "release"


def test_neither_flush_nor_hold_nor_reset_is_in_the_time() -> None:
    device = ScriptedDevice({"K": constant(0.001), "R": constant(5.0)})
    times = measure_steps(device, [TRANSFER], before=RESET, sampling=FEW)
    assert times["transfer"].samples == pytest.approx([0.001] * 3)


def test_each_preprocessing_step_is_measured_on_its_own() -> None:
    done: list[str] = []
    steps = [Step("bin", ("B",)), Step("scan", ("S", "S")), Step("compact", ("C",), lambda: done.append("read back"))]
    device = ScriptedDevice({"B": constant(1e-3), "S": constant(2e-3), "C": constant(3e-3), "K": constant(4e-3),
                             "F": constant(5e-3)})  # fmt: skip
    before = measure_steps(device, steps, sampling=FEW)
    after = measure_steps(device, [Step("K", ("K",)), Step("restore", ("F",))], before=RESET, sampling=FEW)
    medians = {name: m.median for name, m in {**before, **after}.items()}
    assert medians == pytest.approx({"bin": 1e-3, "scan": 4e-3, "compact": 3e-3, "K": 4e-3, "restore": 5e-3})
    kernels = [call for call in device.calls if call in "BSCKF"]
    assert kernels == list("BSSC") * 4 + list("KF") * 4, "steps must find the input of a real run"
    assert len(done) == 4


def test_stops_when_precise() -> None:
    device = ScriptedDevice({"K": noisy(0.001, 0.001, seed=1)})
    found = measure_steps(device, [Step("K", ("K",))])["K"]
    assert found.stopped_by == "precision"
    assert len(found.samples) >= 10
    assert median_interval(found.samples).half_width <= 0.005


def test_stops_at_the_sample_limit_when_it_cannot_become_precise() -> None:
    device = ScriptedDevice({"K": noisy(0.001, 0.5, seed=1)})
    found = measure_steps(device, [Step("K", ("K",))], sampling=Sampling(max_samples=40))["K"]
    assert (found.stopped_by, len(found.samples)) == ("sample limit", 40)


def test_stops_at_the_time_limit() -> None:
    ticks = itertools.count(step=1.0)
    device = ScriptedDevice({"K": noisy(0.001, 0.5, seed=1)})
    found = measure_steps(device, [Step("K", ("K",))], clock=lambda: next(ticks))["K"]
    assert found.stopped_by == "timeout"
    assert 1 <= len(found.samples) <= 16


def test_warm_up_lasts_until_times_are_steady() -> None:
    """A GPU that speeds up for 60 launches: none of the slow ones may be among the samples."""
    speeding_up = itertools.chain((0.004 - 0.00005 * i for i in range(60)), itertools.repeat(0.001))
    found = measure_steps(ScriptedDevice({"K": speeding_up}), [Step("K", ("K",))])["K"]
    assert found.warmups >= 60
    assert set(np.round(found.samples, 9)) == {0.001}


def test_bad_sampling_is_refused() -> None:
    with pytest.raises(InputError, match="'cold', 'hot' and 'step'"):
        Sampling(mode="warm")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="min_samples"):
        Sampling(min_samples=20, max_samples=10)


def test_too_fast_to_rank() -> None:
    device = ScriptedDevice({"K": constant(5e-6), "L": constant(5e-4)})
    found = measure_steps(device, [Step("K", ("K",)), Step("L", ("L",))], sampling=FEW)
    assert too_fast_to_rank(found["K"])
    assert not too_fast_to_rank(found["L"])


def test_device_clock_moves_by_event_time_only() -> None:
    clock = DeviceClock(ScriptedDevice({"K": iter([0.002, 0.003])}))
    rounds = []
    for _ in range(2):
        begin = clock()
        clock.run(Step("K", ("K",)))
        rounds.append(clock() - begin)
    assert rounds == pytest.approx([0.002, 0.003])
    assert statistics.fmean(rounds) == pytest.approx(0.0025)


def test_order_of_calls_down_to_cupy(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same order, seen from the driver: flush, sync, hold, event, kernels, event, sync."""
    gpu = FakeGpu(seconds={"first": 0.001, "second": 0.002}, compile_for_real=False)
    monkeypatch.setitem(sys.modules, "cupy", fake_cupy(gpu))
    device = CudaDevice("cuda")
    source = KernelSource("two", TWO_KERNELS, (), hashlib.sha256(TWO_KERNELS.encode()).hexdigest())
    buffer = device.empty(1, np.int32)
    kernels: list[CompiledKernel] = [device.compile(source, name) for name in ("first", "second")]
    launches = tuple(Launch(k.entry, k, (1, 1, 1), (32, 1, 1), (buffer,)) for k in kernels)
    gpu.calls.clear()
    times = measure_steps(device, [Step("transfer", launches)], [Step("clear", launches[:1])], FEW)
    assert times["transfer"].samples == pytest.approx([0.003] * 3)
    said = [detail.name if what == "kernel" else what for what, detail in gpu.calls]
    one = ["first", "flush", "sync", "mpmbench_hold", "event", "first", "second", "event", "sync"]
    loading = ["mpmbench_hold", "mpmbench_stamp", "sync"]
    assert said == [*one[:3], *loading, *one[3:], *one * 3]
