"""Times of single steps that nothing competes with (sorting, clearing): warm-up, samples, and when to stop.

One sample is: reset the outputs, flush the second-level cache, wait, hold the stream, event, the step's kernels, event,
let the stream go, wait. Outputs are reset and the cache is flushed outside the timed span. The protocol follows NVBench
(cold measurements: NVIDIA/nvbench, docs/benchmarks.md) except for the stop rule, which bounds the median instead of the
mean: samples of a GPU have outliers on one side only.

The module needs of a device only what ``TimedDevice`` lists, so a test can drive it with a scripted clock.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

from mpmbench.device import Launch
from mpmbench.errors import InputError
from mpmbench.protocol.verdict import median_interval
from mpmbench.record import Measurement

# Below this, the resolution of events (about 0.5 us, CUDA Runtime API, cudaEventElapsedTime) exceeds 2 %.
SHORTEST_RANKED = 20e-6  # [s]


class TimedDevice(Protocol):
    """What sampling needs of a device; ``CudaDevice`` has it, the simulated device has no time and does not."""

    name: str

    def launch(self, launch: Launch) -> Any: ...

    def synchronize(self) -> None: ...

    def flush_cache(self) -> None: ...

    def hold(self) -> None: ...

    def release(self) -> None: ...

    @property
    def hold_expired(self) -> bool: ...

    def record(self) -> Any: ...

    def elapsed(self, start: Any, end: Any) -> float: ...


class TimedStep(Protocol):
    """A named list of launches that is timed as one; ``after`` is host work that follows it, untimed."""

    @property
    def name(self) -> str: ...

    @property
    def launches(self) -> Sequence[Launch]: ...

    @property
    def after(self) -> Callable[[], Any] | None: ...


@dataclass(frozen=True)
class Sampling:
    """How to sample.

    mode: "cold" flushes the caches before each sample, "step" and "hot" leave what the steps before left there.
    precision: stop once the 99 % confidence interval of the median is this narrow (half width over median).
    time_limit [s]: wall clock per group of steps, warm-up apart.
    warmup_seconds: least GPU time of the warm-up; it goes on, up to warmup_limit [s] of wall clock, until the medians
    of two successive chunks of samples agree within warmup_drift.
    """

    mode: Literal["cold", "hot", "step"] = "cold"
    min_samples: int = 10
    max_samples: int = 300
    precision: float = 0.005
    time_limit: float = 15.0
    warmup_seconds: float = 0.025
    warmup_limit: float = 1.0
    warmup_drift: float = 0.01
    warmup_chunk: int = 5

    def __post_init__(self) -> None:
        if self.mode not in ("cold", "hot", "step"):
            raise InputError(f"unknown sampling mode {self.mode!r}: valid are 'cold', 'hot' and 'step'")
        if not 1 <= self.min_samples <= self.max_samples:
            raise InputError(
                f"sampling needs 1 <= min_samples <= max_samples, not {self.min_samples}, {self.max_samples}"
            )


QUICK = Sampling(max_samples=30, time_limit=2.0, warmup_limit=0.2)


def measure_steps(
    device: TimedDevice,
    steps: Sequence[TimedStep],
    before: Sequence[TimedStep] = (),
    sampling: Sampling | None = None,
    clock: Callable[[], float] = time.monotonic,
) -> dict[str, Measurement]:
    """Time each step on its own. A round runs ``before`` untimed and then every step once, in order, so that each
    finds the input it has in a real run even where it is not idempotent."""
    sampling = sampling or Sampling()
    if not steps:
        return {}

    def one_round() -> list[float]:
        for step in before:
            _run_untimed(device, step)
        return [sample_step(device, step, sampling.mode) for step in steps]

    warmups = _warm_up(one_round, sampling, clock)
    rounds: list[list[float]] = []
    begin = clock()
    while not (stopped_by := _stop_reason(rounds, clock() - begin, sampling)):
        rounds.append(one_round())
    return {
        step.name: Measurement(tuple(samples), sampling.mode, warmups, stopped_by)
        for step, samples in zip(steps, zip(*rounds, strict=True), strict=True)
    }


def sample_step(device: TimedDevice, step: TimedStep, mode: str) -> float:
    """Time of one step [s], the cache flushed before it in mode "cold". Its kernels must have run before.

    Raises InputError where a launch waited for the stream that is held until all are made.
    """
    if mode == "cold":
        device.flush_cache()
    device.synchronize()
    device.hold()
    try:
        start = device.record()
        for launch in step.launches:
            device.launch(launch)
        end = device.record()
    finally:
        device.release()
    device.synchronize()
    if device.hold_expired:
        raise InputError(f"{device.name}: {step.name} cannot be timed: a launch of it waits for the ones before it")
    seconds = device.elapsed(start, end)
    if step.after is not None:
        step.after()
    return seconds


def too_fast_to_rank(measurement: Measurement) -> bool:
    """True where the resolution of events blurs the time: print it, but rank nothing by it."""
    return measurement.median < SHORTEST_RANKED


class DeviceClock:
    """A clock that moves only by event times, for harnesses that bring their own loop and take a timer
    (pytest-benchmark: ``timer=clock``, and ``pedantic`` with one iteration per round)."""

    def __init__(self, device: TimedDevice, mode: Literal["cold", "hot", "step"] = "cold") -> None:
        self.device = device
        self.mode = mode
        self.seconds = 0.0

    def __call__(self) -> float:
        return self.seconds

    def run(self, step: TimedStep) -> None:
        """Run a step once; the clock advances by its time on the device."""
        self.seconds += sample_step(self.device, step, self.mode)


def _run_untimed(device: TimedDevice, step: TimedStep) -> None:
    for launch in step.launches:
        device.launch(launch)
    if step.after is not None:
        step.after()


def _warm_up(one_round: Callable[[], list[float]], sampling: Sampling, clock: Callable[[], float]) -> int:
    """Run rounds until the GPU has its working clock; returns how many."""
    totals: list[float] = []
    begin = clock()
    size = sampling.warmup_chunk
    while True:
        totals.append(sum(one_round()))
        if clock() - begin >= sampling.warmup_limit:
            return len(totals)
        if sum(totals) >= sampling.warmup_seconds and len(totals) >= 2 * size:
            previous = statistics.median(totals[-2 * size : -size])
            latest = statistics.median(totals[-size:])
            if abs(latest - previous) <= sampling.warmup_drift * previous:
                return len(totals)


def _stop_reason(rounds: list[list[float]], seconds: float, sampling: Sampling) -> str:
    """Why to stop now, or "" to go on."""
    if len(rounds) >= sampling.min_samples and all(
        _precise(samples, sampling.precision) for samples in zip(*rounds, strict=True)
    ):
        return "precision"
    if len(rounds) >= sampling.max_samples:
        return "sample limit"
    if rounds and seconds >= sampling.time_limit:
        return "timeout"
    return ""


def _precise(samples: Sequence[float], precision: float) -> bool:
    return median_interval(samples).half_width <= precision
