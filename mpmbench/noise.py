"""How often does this machine call equals unequal? Copies of one transfer, judged as strategies are.

A trial is a contest that ends at its first look: the fewest rounds after which a run may speak. Every copy that comes
out FAST or SLOW is a false verdict.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, replace
from typing import Any

from mpmbench.contest import Contender
from mpmbench.environment import Environment
from mpmbench.errors import MpmbenchError
from mpmbench.protocol.clocks import clock_of
from mpmbench.protocol.rounds import Arm, Clock, Rules, run_rounds
from mpmbench.protocol.verdict import Verdict
from mpmbench.record import Record

SECONDS = 30.0
ALLOWED = 0.01  # share of false verdicts that the protocol promises to stay below
COPIES = 4  # beside the baseline and its own copy
VARIANT = "g2p_global_gather"  # nothing but reads: every run does the same
# device -> particles and cache state. A GPU needs times well above the resolution of its events; on a processor,
# overwriting the caches takes longer than all the rest.
TRANSFERS = {"cuda": (500_000, "cold"), "cpu": (1_000, "hot")}
REMEDIES = {
    "cuda": "use the GPU alone, lock its clocks (`mpmbench doctor` says how), or time with --rigorous",
    "cpu": "stop other programs, keep a core free for this one, or time with --rigorous",
}


@dataclass(frozen=True)
class Noise:
    """What came of the trials.

    rounds: of each trial.  seconds: that all took.  copies: verdicts on identical arms that were reached.  false: of
    them FAST or SLOW.  unusable: copies without a verdict, because their samples had to be thrown away.  spreads: per
    trial, how far the interval of the ratio of two copies reaches from 1.  discarded: passes thrown away, by reason.
    """

    rounds: int
    seconds: float
    copies: int
    false: int
    unusable: int
    spreads: tuple[float, ...]
    discarded: dict[str, int]

    @property
    def rate(self) -> float:
        """Share of false verdicts; 0 where there is no verdict."""
        return self.false / self.copies if self.copies else 0.0

    @property
    def bound(self) -> float:
        """Highest rate that this many verdicts leave possible, at 95 % confidence (Clopper and Pearson, one-sided)."""
        return _bound(self.false, self.copies)

    @property
    def floor(self) -> tuple[float, float]:
        """Median and worst of the spreads."""
        return statistics.median(self.spreads), max(self.spreads)


def kind_of(device: Any) -> str:
    """``cuda:1`` -> ``cuda``."""
    return str(device.name).partition(":")[0]


def measure_noise(
    device: Any, seconds: float = SECONDS, tick: Callable[[str, int, int], None] = lambda what, done, total: None
) -> Noise:
    """Trials on a device that keeps time, for so many seconds, at least one. tick: (what, seconds done, of)."""
    particles, cache = TRANSFERS[kind_of(device)]
    with getattr(device, "undisturbed", nullcontext)():
        arm = _transfer(device, particles).arm(device)
        return trials(arm, clock_of(device, cache), seconds, Rules(), tick)


def trials(
    arm: Arm,
    clock: Clock,
    seconds: float,
    rules: Rules,
    tick: Callable[[str, int, int], None] = lambda what, done, total: None,
) -> Noise:
    """Contests between copies of one arm, until the clock has moved on by so many seconds; at least one."""
    arms = [arm, *(replace(arm, name=f"{arm.name} copy {n}") for n in range(1, COPIES + 1))]
    short = replace(rules, max_rounds=rules.min_rounds)
    copies = false = unusable = 0
    spreads: list[float] = []
    discarded: dict[str, int] = {}
    begin, seed = clock.now(), 0
    while not seed or clock.now() - begin < seconds:
        contest = run_rounds(arms, clock, short, seed)
        verdicts = [paired.verdict for paired in contest.paired.values()]
        reached = [verdict for verdict in verdicts if verdict is not Verdict.UNUSABLE]
        copies += len(reached)
        unusable += COPIES - len(reached)
        false += sum(verdict in (Verdict.FAST, Verdict.SLOW) for verdict in reached)
        if reached:
            spreads.append(contest.noise.spread)
        for reason, count in contest.discarded.items():
            discarded[reason] = discarded.get(reason, 0) + count
        short = replace(short, warmup_seconds=0.0, warmup_limit=0.0)  # the trial before was warm-up enough
        seed += 1
        tick("A/A", min(int(clock.now() - begin), int(seconds)), int(seconds))
    return Noise(rules.min_rounds, clock.now() - begin, copies, false, unusable, tuple(spreads), discarded)


def describe(noise: Noise, device: Any) -> list[str]:
    """Lines for a person: what was run, the rate, the floor, what to do."""
    kind = kind_of(device)
    particles, cache = TRANSFERS[kind]
    lines = [
        f"A/A on {device.name}: {COPIES + 1} copies of {VARIANT}, {particles:,} particles, caches {cache}, "
        f"{len(noise.spreads)} trials of {noise.rounds} rounds"
    ]
    if not noise.copies:
        return [*lines, f"no verdict: {_reasons(noise)}", f"-> {REMEDIES[kind]}"]
    median, worst = noise.floor
    lines += [
        f"false verdicts (FAST or SLOW among equals): {noise.false} of {noise.copies}, {noise.rate:.1%}; "
        f"at most {noise.bound:.1%} at 95 % confidence",
        f"noise floor (how far two copies are apart): {median:.2%} in the median trial, {worst:.2%} in the worst",
    ]
    if noise.discarded or noise.unusable:
        lines.append(f"{noise.unusable} copies without a verdict; {_reasons(noise)}")
    if noise.rate > ALLOWED:
        lines.append(f"-> more than {ALLOWED:.0%}: differences are not to be trusted here; {REMEDIES[kind]}")
    elif noise.bound > ALLOWED:
        longer = _longer(noise)
        advice = f"give it longer, --noise-seconds {longer}" if longer else REMEDIES[kind]
        lines.append(f"-> too few trials to promise {ALLOWED:.0%}: {advice}")
    else:
        lines.append(f"-> good: below {ALLOWED:.0%}")
    return lines


def _reasons(noise: Noise) -> str:
    found = ", ".join(f"{count} passes thrown away: {reason}" for reason, count in noise.discarded.items())
    return found or "no passes thrown away"


def _longer(noise: Noise) -> int | None:
    """Seconds after which the same rate would be shown to be low enough; None where that is far away."""
    for times in (2, 4, 8, 16):
        if _bound(times * noise.false, times * noise.copies) <= ALLOWED:
            return math.ceil(times * noise.seconds)
    return None


def _bound(false: int, copies: int) -> float:
    from scipy.stats import beta

    return float(beta.ppf(0.95, false + 1, copies - false)) if false < copies else 1.0


def _transfer(device: Any, particles: int) -> Contender:
    from mpmbench.runner import DatasetChoice, Inputs, cases_of
    from mpmbench.variants import get

    (case,) = cases_of([get(VARIANT)], [DatasetChoice("uniform_cube", particles)], {})
    made = case.prepare(device, Inputs(), Environment.capture())
    if isinstance(made, Record):
        raise MpmbenchError(
            f"{VARIANT} cannot be timed on {device.name}: {made.skipped_because or made.failed_because or made.status}"
        )
    return made
