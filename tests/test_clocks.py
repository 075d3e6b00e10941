"""The clocks of real devices: order of calls in each state of the caches, samples that are thrown away, and why."""

from __future__ import annotations

import hashlib
import sys
from dataclasses import dataclass, field, replace
from itertools import cycle

import numpy as np
import pynvml
import pytest
from fake_cupy import FakeGpu, fake_cupy
from fake_pynvml import FakeNvml, NvmlGpu

from mpmbench.device import Launch
from mpmbench.device.cpu import CpuDevice
from mpmbench.device.cuda import CudaDevice
from mpmbench.errors import InputError
from mpmbench.kernel import KernelSource
from mpmbench.protocol import rounds
from mpmbench.protocol.clocks import EventClock, WallClock, clock_of
from mpmbench.protocol.rounds import Arm

TEXT = "".join(f'extern "C" __global__ void {name}(int* x) {{ x[0] = 1; }}' for name in ("clear", "work", "other"))
SOURCE = KernelSource("both", TEXT, (), hashlib.sha256(TEXT.encode()).hexdigest())
TIMED = ["mpmbench_hold", "mpmbench_stamp", "event", "work", "event", "mpmbench_stamp", "sync"]
UNTIMED = {"cold": ["clear", "flush", "sync"], "hot": ["clear", "work", "clear", "sync"], "step": ["clear", "sync"]}


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch) -> FakeGpu:
    machine = FakeGpu(compile_for_real=False, seconds={"work": 0.002, "other": 0.001})
    monkeypatch.setitem(sys.modules, "cupy", fake_cupy(machine))
    return machine


@pytest.fixture
def nvml(monkeypatch: pytest.MonkeyPatch) -> NvmlGpu:
    one = NvmlGpu()
    monkeypatch.setitem(sys.modules, "pynvml", FakeNvml(one))
    return one


def arm_on(device: CudaDevice, name: str = "work") -> Arm:
    """Its kernels have run once, as those of every checked strategy have."""
    buffer = device.empty(1, np.int32)
    launches = [
        Launch(entry, device.compile(SOURCE, entry), (1, 1, 1), (32, 1, 1), (buffer,)) for entry in ("clear", name)
    ]
    device.flush_cache()
    device.stamp()
    return Arm(name, lambda: device.launch(launches[1]), lambda: device.launch(launches[0]))


def said(gpu: FakeGpu) -> list[str]:
    return [detail.name if what == "kernel" else what for what, detail in gpu.calls]


@pytest.mark.parametrize("cache", UNTIMED)
def test_order_of_calls_of_a_sample(gpu: FakeGpu, cache: str) -> None:
    device = CudaDevice("cuda")
    arm, clock = arm_on(device), clock_of(device, cache)
    assert isinstance(clock, EventClock)
    gpu.calls.clear()
    sample = clock.sample(arm)
    assert said(gpu) == UNTIMED[cache] + TIMED
    assert sample.seconds == pytest.approx(0.002)
    assert sample.hertz == pytest.approx(1e9, rel=1e-4)
    assert sample.discard == ""


@pytest.mark.parametrize(("hertz", "discarded"), [(0.76e9, False), (0.74e9, True)])
def test_a_slow_clock_discards_the_sample(gpu: FakeGpu, hertz: float, discarded: bool) -> None:
    """The fake driver's default is 1 GHz."""
    device = CudaDevice("cuda")
    arm, gpu.hertz = arm_on(device), hertz
    sample = EventClock(device, "cold").sample(arm)
    assert sample.hertz == pytest.approx(hertz, rel=1e-4)
    assert sample.discard == ("SM clock below 75 % of its default" if discarded else "")


def test_a_clock_that_is_not_known_discards_nothing(gpu: FakeGpu) -> None:
    device = CudaDevice("cuda")
    arm, gpu.on_sm_0 = arm_on(device), False
    sample = EventClock(device, "cold").sample(arm)
    assert (sample.hertz, sample.discard) == (None, "")


def test_a_locked_clock_is_measured_by_what_came_of_the_lock(gpu: FakeGpu, nvml: NvmlGpu) -> None:
    """Base clocks are half of the highest on some GPUs: slow, and as asked for."""
    device = CudaDevice("cuda")
    arm = arm_on(device)
    with device.lock_clocks("510"):
        assert device.usual_hertz == 510e6
        gpu.hertz = 0.5e9
        assert EventClock(device, "cold").sample(arm).discard == ""
        gpu.hertz = 0.35e9
        assert EventClock(device, "cold").sample(arm).discard
    assert device.usual_hertz == 1e9


def test_a_hold_that_timed_out_discards_the_sample(gpu: FakeGpu) -> None:
    device = CudaDevice("cuda")
    arm = arm_on(device)
    waits = Arm("waits", device.synchronize, arm.prepare)
    assert EventClock(device, "cold").sample(waits).discard == "hold timed out"
    assert EventClock(device, "cold").sample(arm).discard == ""


def test_the_stream_is_let_go_when_a_launch_fails(gpu: FakeGpu) -> None:
    device = CudaDevice("cuda")
    arm = arm_on(device)

    def fail() -> None:
        raise InputError("no such kernel")

    with pytest.raises(InputError, match="no such kernel"):
        EventClock(device, "step").sample(Arm("fails", fail, arm.prepare))
    device.synchronize()
    assert "hold expired" not in gpu.names()
    assert EventClock(device, "step").sample(arm).discard == ""


def test_trouble_is_what_nvml_says(gpu: FakeGpu, nvml: NvmlGpu) -> None:
    clock = EventClock(CudaDevice("cuda"), "cold")
    assert clock.trouble() == ""
    nvml.reasons = pynvml.nvmlClocksEventReasonSwPowerCap | pynvml.nvmlClocksEventReasonGpuIdle
    assert clock.trouble() == "power cap"


def test_an_arm_that_always_throttles_is_given_up_with_the_reason(
    gpu: FakeGpu, nvml: NvmlGpu, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("time.sleep", lambda seconds: None)
    device = CudaDevice("cuda")
    good, bad = arm_on(device), arm_on(device, "other")

    def at(hertz: float, arm: Arm) -> Arm:
        """The arm with a GPU that takes this clock for it."""

        def prepare() -> None:
            gpu.hertz = hertz
            arm.prepare()

        return replace(arm, prepare=prepare)

    nvml.reasons = 0x40
    arms = [at(1e9, good), at(0.5e9, bad)]
    rules = rounds.Rules(min_rounds=2, max_rounds=2, warmup_limit=0)
    contest = rounds.run_rounds(arms, EventClock(device, "cold"), rules)
    assert contest.spoiled["other"].startswith(
        "THROTTLED: SM clock below 75 % of its default (hardware thermal slowdown)"
    )
    assert len(contest.seconds["work"]) == 8


# Wall clock


@dataclass
class Cpu:
    calls: list[str] = field(default_factory=list)

    def flush_cache(self) -> None:
        self.calls.append("flush")

    def synchronize(self) -> None:
        self.calls.append("sync")


@pytest.mark.parametrize("cache", UNTIMED)
def test_order_of_calls_of_a_wall_clock_sample(cache: str) -> None:
    device = Cpu()
    arm = Arm("arm", lambda: device.calls.append("work"), lambda: device.calls.append("clear"))
    clock = clock_of(device, cache)
    assert isinstance(clock, WallClock)
    sample = clock.sample(arm)
    assert device.calls == [*UNTIMED[cache], "work", "sync"]
    assert sample.seconds > 0
    assert sample.hertz is None


@pytest.mark.parametrize(
    ("wall", "processor", "lost"),
    [(1.0, 0.97, False), (1.0, 0.96, True), (0.01, 0.0088, False), (0.01, 0.0086, True), (1.0, 4.0, False)],
)
def test_a_sample_that_lost_its_core_is_discarded(
    monkeypatch: pytest.MonkeyPatch, wall: float, processor: float, lost: bool
) -> None:
    walls, processors = cycle([0.0, wall]), cycle([0.0, processor])
    monkeypatch.setattr("time.perf_counter", lambda: next(walls))
    monkeypatch.setattr("time.process_time", lambda: next(processors))
    sample = WallClock(Cpu(), "step").sample(Arm("arm", lambda: None, lambda: None))
    assert sample.seconds == wall
    assert bool(sample.discard) is lost
    assert sample.tolerable, "a machine that is always busy has times too"


def test_the_cpu_device_has_the_wall_clock() -> None:
    assert isinstance(clock_of(CpuDevice(), "cold"), WallClock)
