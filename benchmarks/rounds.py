"""Interleaved rounds: every arm once per round in random order, so that drift of the machine hits all arms alike.

What is compared is the ratio of two arms inside a round; a table states the median of these ratios and its bootstrap
interval, beside the times themselves.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

# Share of a sample that the process may spend off its core before the round counts as disturbed.
DISTURBED_SHARE = 0.03
DISTURBED_SECONDS = 1e-3


@dataclass(frozen=True)
class Arm:
    """One contender. ``reset`` (clear the outputs) runs before every sample, outside of the timed span."""

    name: str
    run: Callable[[], object]
    reset: Callable[[], object]


@dataclass(frozen=True, eq=False)
class Rounds:
    """seconds, processor_seconds: wall clock and time on the core, by arm, (rounds,). disturbed: rounds run again
    because another process took the core; kept_disturbed: such rounds kept because too many had been run again."""

    seconds: dict[str, np.ndarray] = field(repr=False)
    processor_seconds: dict[str, np.ndarray] = field(repr=False)
    disturbed: int = 0
    kept_disturbed: int = 0


@dataclass(frozen=True)
class Interval:
    """A median with its 95 % bootstrap interval."""

    median: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.median:.2f} [{self.low:.2f}, {self.high:.2f}]"


def pin_to_one_core() -> int:
    """Tie this process, and every thread it starts from now on, to the last core it may use."""
    core = max(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {core})
    return core


def run_rounds(arms: Sequence[Arm], rounds: int, seed: int) -> Rounds:
    """Time every arm ``rounds`` times after one untimed run of each.

    A round in which some arm lost the core for more than 3 % of its sample is run again, as long as such rounds stay
    the exception: at most a third of ``rounds``. The choice looks at processor time, never at which arm was faster.
    """
    allowed = max(1, rounds // 3)
    random = np.random.default_rng(seed)
    for arm in arms:
        arm.reset()
        arm.run()
    kept: list[list[tuple[float, float]]] = []
    disturbed = kept_disturbed = 0
    while len(kept) < rounds:
        sample = [(0.0, 0.0)] * len(arms)
        calm = True
        for a in random.permutation(len(arms)):
            arms[a].reset()
            wall, processor = time.perf_counter(), time.process_time()
            arms[a].run()
            wall, processor = time.perf_counter() - wall, time.process_time() - processor
            sample[a] = wall, processor
            calm &= wall - processor <= DISTURBED_SHARE * wall + DISTURBED_SECONDS
        if not calm:
            if disturbed < allowed:
                disturbed += 1
                continue
            kept_disturbed += 1
        kept.append(sample)
    by_arm = np.array(kept).transpose(1, 2, 0)
    names = [arm.name for arm in arms]
    return Rounds(
        {name: times[0] for name, times in zip(names, by_arm, strict=True)},
        {name: times[1] for name, times in zip(names, by_arm, strict=True)},
        disturbed,
        kept_disturbed,
    )


def paired_ratio(over: np.ndarray, under: np.ndarray, seed: int = 0, resamples: int = 4000) -> Interval:
    """Median of over / under round by round, with the 95 % percentile bootstrap interval of that median."""
    ratio = np.asarray(over) / np.asarray(under)
    return median_interval(ratio, seed, resamples)


def median_interval(values: np.ndarray, seed: int = 0, resamples: int = 4000) -> Interval:
    """Median and its 95 % percentile bootstrap interval."""
    values = np.asarray(values)
    picks = np.random.default_rng(seed).integers(len(values), size=(resamples, len(values)))
    low, high = np.percentile(np.median(values[picks], axis=1), [2.5, 97.5])
    return Interval(float(np.median(values)), float(low), float(high))
