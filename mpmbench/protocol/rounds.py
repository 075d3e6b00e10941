"""Paired rounds: every arm a few times per round, in random order, so that whatever the machine does hits all alike.

A round is made of passes; a pass takes one sample of every arm. Passes come in twos: a random order and the same order
backwards, which cancels a drift that is linear over the two. Two arms are compared pass by pass (``verdict``). The last
arm repeats the first, the baseline: how far apart do two copies of one thing come out here?

How far to go on is decided at looks that lie ever further apart. Each look spends a part of the confidence that is
left, so that looking often does not make differences out of noise.
"""

from __future__ import annotations

import math
import random
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Protocol

from mpmbench.errors import InputError
from mpmbench.protocol.verdict import CONFIDENCE, MARGIN, Interval, Paired, Verdict, compare, correct, median_interval

CLOCKS_AGREE = 0.01  # arms whose median SM clocks differ by more are not compared
PAUSE = 0.05  # [s] after a discarded pass, growing by as much each time
MOST_TOLERABLE = 3  # times that a pass is repeated for something tolerable
MOST_DISCARDED = 20  # passes in a row, then the arm that spoils them is given up


@dataclass(frozen=True)
class Arm:
    """One contender.

    run: enqueues what is timed.  prepare: brings its inputs back to where they were, untimed.  launches: how many
    ``run`` makes, for clocks that hold the stream while they are enqueued.
    """

    name: str
    run: Callable[[], object] = field(repr=False)
    prepare: Callable[[], object] = field(repr=False)
    launches: int = 1


class Sample(NamedTuple):
    """seconds: of one run.  hertz: clock of the processor meanwhile, where known.  discard: why not to use it.
    tolerable: use it all the same where repeating the pass does not help."""

    seconds: float
    hertz: float | None = None
    discard: str = ""
    tolerable: bool = False


class Clock(Protocol):
    """Times arms: CUDA events, wall clock, or a script."""

    def sample(self, arm: Arm) -> Sample:
        """Prepare the arm, bring the caches into their state, and time one run of it."""

    def now(self) -> float:
        """Seconds that have passed, for limits."""

    def pause(self, seconds: float) -> None:
        """Let the processor cool down."""

    def trouble(self) -> str:
        """What slows the processor right now (power cap, heat, ...); "" where nothing does or nobody knows."""


@dataclass(frozen=True)
class Rules:
    """When to start, stop and believe.

    passes: per round, an even number.  min_rounds: before the first look.  max_rounds: a limit that does not depend on
    the machine.  time_limit [s]: per arm, warm-up apart.  precision: half width of every speedup's interval that is
    narrow enough even without a verdict.  margin, confidence: see ``verdict``.
    warmup_seconds: least time of an arm's own runs before the first round; warm-up goes on, up to warmup_limit [s] per
    arm, until the medians of two successive chunks of samples agree within warmup_drift.
    """

    passes: int = 4
    min_rounds: int = 30
    max_rounds: int = 1000
    time_limit: float = 15.0
    precision: float = 0.001
    margin: float = MARGIN
    confidence: float = CONFIDENCE
    warmup_seconds: float = 0.025
    warmup_limit: float = 1.0
    warmup_drift: float = 0.01
    warmup_chunk: int = 5

    def __post_init__(self) -> None:
        if self.passes < 2 or self.passes % 2:
            raise InputError(f"a round needs an even number of passes, not {self.passes}: half of them run backwards")
        if not 1 <= self.min_rounds <= self.max_rounds:
            raise InputError(f"rounds need 1 <= min <= max, not {self.min_rounds} and {self.max_rounds}")


QUICK = Rules(min_rounds=8, max_rounds=16, time_limit=2.0, warmup_limit=0.2)
RIGOROUS = Rules(min_rounds=60, max_rounds=4000, time_limit=60.0, precision=0.0005)


@dataclass(frozen=True)
class Contest:
    """What came of the rounds.

    seconds: name -> times [s] of the passes that count, aligned between arms.  hertz: name -> clocks of the same
    samples, empty where the clock of the processor is not known.  paired: name -> against the baseline, corrected for
    the number of arms; not for the baseline itself.  leaders: arms that no other was found to beat.
    noise: ratio of the two copies of the baseline.  discarded: passes thrown away, by reason.  held_down: rounds at
    whose end something slowed the processor, by what it was.
    spoiled: arm -> why it has no time.
    """

    baseline: str
    seconds: dict[str, list[float]] = field(repr=False)
    hertz: dict[str, list[float]] = field(repr=False)
    again: list[float] = field(repr=False)
    paired: dict[str, Paired]
    leaders: tuple[str, ...]
    noise: Interval
    rounds: int
    warmups: int
    seed: int
    stopped_by: str
    discarded: dict[str, int]
    held_down: dict[str, int]
    spoiled: dict[str, str]


def run_rounds(
    arms: Sequence[Arm],
    clock: Clock,
    rules: Rules | None = None,
    seed: int = 0,
    tick: Callable[[int], None] | None = None,
) -> Contest:
    """Time the arms against each other; the first is the baseline.

    tick: told after each round how many there have been.
    """
    if not arms:
        raise InputError("nothing to time")
    if len({arm.name for arm in arms}) < len(arms):
        raise InputError("two arms have one name")
    return _Rounds(arms, clock, rules or Rules(), seed, tick or (lambda rounds: None)).run()


def looks(rules: Rules) -> list[int]:
    """Rounds after which to look: each a third more than the one before."""
    found = [rules.min_rounds]
    while found[-1] < rules.max_rounds:
        found.append(min(rules.max_rounds, math.ceil(found[-1] * 4 / 3)))
    return found


def confidence_at(look: int, confidence: float) -> float:
    """Confidence of the intervals at a look (0, 1, ...): the shares 1/((k+1)(k+2)) of the error add up to all of it."""
    return 1 - (1 - confidence) / ((look + 1) * (look + 2))


class _Rounds:
    """One contest under way."""

    def __init__(self, arms: Sequence[Arm], clock: Clock, rules: Rules, seed: int, tick: Callable[[int], None]) -> None:
        self.clock, self.rules, self.seed, self.tick = clock, rules, seed, tick
        self.baseline = arms[0]
        # The copy of the baseline runs the same code on the same buffers; only its name differs.
        self.arms = [*arms, replace(arms[0], name=f"{arms[0].name} again")]
        self.seconds: list[list[float]] = [[] for _ in self.arms]
        self.hertz: list[list[float]] = [[] for _ in self.arms]
        self.discarded: dict[str, int] = {}
        self.held_down: dict[str, int] = {}
        self.spoiled: dict[int, str] = {}
        self.random = random.Random(seed)

    def run(self) -> Contest:
        rules = self.rules
        warmups = max(self._warm_up(arm) for arm in self.arms[:-1])
        begin, limit = self.clock.now(), rules.time_limit * len(self.arms)
        schedule, look, rounds = looks(rules), 0, 0
        order = list(range(len(self.arms)))
        while True:
            for _ in range(rules.passes // 2):
                self.random.shuffle(order)
                self._pass(order)
                self._pass(order[::-1])
            rounds += 1
            if why := self.clock.trouble():
                self.held_down[why] = self.held_down.get(why, 0) + 1
            late = "time limit" if self.clock.now() - begin >= limit else ""
            last = late or ("round limit" if rounds >= rules.max_rounds else "") or self._unusable()
            if last or rounds == schedule[look]:
                standing = self._judge(confidence_at(look, rules.confidence))
                look += 1
                if stopped_by := self._stop_reason(standing, last):
                    return self._contest(standing, rounds, warmups, stopped_by)
            self.tick(rounds)

    def _warm_up(self, arm: Arm) -> int:
        """Run an arm until the processor has its working clock; returns how often."""
        rules = self.rules
        times: list[float] = []
        begin, size = self.clock.now(), rules.warmup_chunk
        while True:
            times.append(self.clock.sample(arm).seconds)
            if self.clock.now() - begin >= rules.warmup_limit:
                return len(times)
            if sum(times) >= rules.warmup_seconds and len(times) >= 2 * size:
                before, after = statistics.median(times[-2 * size : -size]), statistics.median(times[-size:])
                if abs(after - before) <= rules.warmup_drift * before:
                    return len(times)

    def _pass(self, order: Sequence[int]) -> None:
        """One sample of every arm. A pass with a sample to be discarded is repeated as a whole: half a pass pairs with
        nothing."""
        sample, arms, spoiled = self.clock.sample, self.arms, self.spoiled
        blamed: dict[int, int] = {}
        tries = 0
        while True:
            taken: list[tuple[int, Sample]] = []
            for place in order:
                if place in spoiled:
                    continue
                one = sample(arms[place])
                if one.discard and not (one.tolerable and tries >= MOST_TOLERABLE):
                    break
                taken.append((place, one))
            else:
                break
            blamed[place] = blamed.get(place, 0) + 1
            self.discarded[one.discard] = self.discarded.get(one.discard, 0) + 1
            tries += 1
            self.clock.pause(PAUSE * tries)
            if tries % MOST_DISCARDED == 0:
                self._give_up(max(blamed, key=lambda place: blamed[place]), one.discard, tries)
                blamed.clear()
        for place, one in taken:
            self.seconds[place].append(one.seconds)
            if one.hertz is not None:
                self.hertz[place].append(one.hertz)

    def _give_up(self, place: int, discard: str, tries: int) -> None:
        why = self.clock.trouble()
        self.spoiled[place] = f"THROTTLED: {discard}{f' ({why})' if why else ''}, {tries} passes in a row"

    def _unusable(self) -> str:
        """Why going on is of no use: without both copies of the baseline nothing can be compared."""
        if {0, len(self.arms) - 1} & self.spoiled.keys():
            return "throttled baseline"
        return ""

    def _judge(self, confidence: float) -> _Standing:
        """Where all arms stand, at one confidence."""
        seconds, margin = self.seconds, self.rules.margin
        noise = _ratio(seconds[0], seconds[-1], confidence)
        if self._unusable():
            return _Standing({}, {}, None, noise)
        others = [place for place in range(1, len(self.arms) - 1) if place not in self.spoiled]
        paired = {place: self._compare(0, place, noise, confidence, margin) for place in others}
        timed = [place for place in (0, *others) if place not in self.spoiled and seconds[place]]
        if not timed:
            return _Standing(paired, {}, None, noise)
        leader = min(timed, key=lambda place: statistics.median(seconds[place]))
        behind = {p: self._compare(leader, p, noise, confidence, margin) for p in timed if p != leader}
        return _Standing(paired, behind, leader, noise)

    def _compare(self, base: int, place: int, noise: Interval, confidence: float, margin: float) -> Paired:
        paired = compare(self.seconds[base], self.seconds[place], noise, confidence, margin)
        if self.hertz[base] and self.hertz[place]:
            clocks = statistics.median(self.hertz[base]), statistics.median(self.hertz[place])
            if max(clocks) > min(clocks) * (1 + CLOCKS_AGREE):
                return replace(paired, verdict=Verdict.UNUSABLE)
        return paired

    def _stop_reason(self, standing: _Standing, last: str) -> str:
        """Why to stop now, or "" to go on. A limit names what it left open."""
        pairs = [(place, one) for group in (standing.paired, standing.behind) for place, one in group.items()]
        decided = (Verdict.FAST, Verdict.SLOW, Verdict.SAME)
        if self._unusable():
            return last
        if not pairs:  # one strategy alone: there is nothing to decide but how well its time is known
            return "precision" if standing.noise.half_width <= self.rules.margin else last
        if all(one.verdict in decided for _, one in pairs):
            return "verdict"
        if all(one.speedup.half_width <= self.rules.precision for _, one in pairs):
            return "precision"
        if not last:
            return ""
        names = dict.fromkeys(self.arms[place].name for place, one in pairs if one.verdict not in decided)
        return f"{last}; undecided: {', '.join(names)}" if names else last

    def _contest(self, standing: _Standing, rounds: int, warmups: int, stopped_by: str) -> Contest:
        names = [arm.name for arm in self.arms]
        behind = dict(zip(standing.behind, correct(list(standing.behind.values()), self.rules.confidence), strict=True))
        paired = dict(zip(standing.paired, correct(list(standing.paired.values()), self.rules.confidence), strict=True))
        leaders = [place for place, one in behind.items() if one.verdict is not Verdict.SLOW]
        if standing.leader is not None:
            leaders.append(standing.leader)
        timed = [place for place in range(len(names) - 1) if place not in self.spoiled]
        return Contest(
            baseline=self.baseline.name,
            seconds={names[place]: self.seconds[place] for place in timed},
            hertz={names[place]: self.hertz[place] for place in timed},
            again=self.seconds[-1],
            paired={names[place]: one for place, one in paired.items()},
            leaders=tuple(names[place] for place in sorted(leaders)),
            noise=standing.noise,
            rounds=rounds,
            warmups=warmups,
            seed=self.seed,
            stopped_by=stopped_by,
            discarded=dict(self.discarded),
            held_down=dict(self.held_down),
            spoiled={names[place]: why for place, why in self.spoiled.items()},
        )


@dataclass(frozen=True)
class _Standing:
    """A look: every arm against the baseline and against the fastest."""

    paired: dict[int, Paired]
    behind: dict[int, Paired]
    leader: int | None
    noise: Interval


def _ratio(over: Sequence[float], under: Sequence[float], confidence: float) -> Interval:
    ratios = [a / b for a, b in zip(over, under, strict=False)]
    return median_interval(ratios, confidence) if ratios else Interval(math.nan, -math.inf, math.inf)
