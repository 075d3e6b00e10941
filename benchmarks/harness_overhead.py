"""What the harness itself takes per sample: rounds under a scripted clock, in which no time passes in earnest.

    python benchmarks/harness_overhead.py

Kind of number: measured (wall, CPU). The target is 50 us; an event of CUDA resolves 0.5 us, a flush of the cache takes
some 20 us, so what is below that is lost in the sample's own preparation, which is not timed.
"""

from __future__ import annotations

import time

import numpy as np

from mpmbench.protocol.rounds import Arm, Rules, run_rounds
from mpmbench.protocol.scripted import Script, ScriptedClock

TARGET = 50e-6  # [s] per sample


def nothing() -> None:
    """What an arm runs."""


def overhead(arms: int, rounds: int) -> float:
    """Seconds per sample of a contest that goes on to its last round: a noise that no number of rounds resolves."""
    names = [f"arm {i}" for i in range(arms)]
    clock = ScriptedClock(Script(noise=0.5, samples=10_000), dict.fromkeys(names, 1e-3), np.random.default_rng(0))
    rules = Rules(max_rounds=rounds, time_limit=float("inf"), precision=0, warmup_limit=0)
    begin = time.perf_counter()
    run_rounds([Arm(name, nothing, nothing) for name in names], clock, rules)
    return (time.perf_counter() - begin) / ((arms + 1) * rules.passes * rounds)


def main() -> None:
    print("| arms | rounds | us per sample | of the target |")
    print("|---|---|---|---|")
    for arms, rounds in ((2, 30), (2, 1000), (10, 30), (10, 1000), (40, 300)):
        seconds = min(overhead(arms, rounds) for _ in range(3))
        print(f"| {arms} | {rounds} | {seconds * 1e6:.1f} | {seconds / TARGET:.0%} |")


if __name__ == "__main__":
    main()
