"""Strategies that answer one question, timed against each other: prepare and check all, then rounds, then records.

The rows of a contest come from the same rounds, hence its strategies are on the device together. Where they do not fit
they are timed in batches, each with the baseline in it.
"""

from __future__ import annotations

import time
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any
from uuid import uuid4

import numpy as np

from mpmbench.errors import InputError
from mpmbench.measure import Sampling, TimedDevice, measure_steps
from mpmbench.protocol.clocks import clock_of
from mpmbench.protocol.rounds import Arm, Contest, Rules, run_rounds
from mpmbench.protocol.verdict import Interval, Verdict
from mpmbench.record import Comparison, Measurement, Record, Repeat, StepCost

# Unsorted global atomics (or gathers): what a user has before reading any of this, and what break-even is against.
BASELINES = {"p2g": "p2g_global_atomic", "g2p": "g2p_global_gather"}

# Axes that change the problem and not the way it is solved: rows that differ in them are never in one contest.
PROBLEM_AXES = ("spline", "payload", "dtype")

FILLED = 0.9  # share of the free device memory that the strategies of a batch may take together

CACHES = ("cold", "hot", "step")


@dataclass(frozen=True)
class Timing:
    """How measured rows are made.

    cache: its state before each sample.  rules: of the rounds.  sampling: of the steps before and after a transfer.
    baseline: beginning of the label of the row that others are compared with; "" for the plainest one.
    """

    cache: str = "cold"
    rules: Rules = field(default_factory=Rules)
    sampling: Sampling = field(default_factory=Sampling)
    baseline: str = ""

    def __post_init__(self) -> None:
        if self.cache not in CACHES:
            raise InputError(f"unknown cache state {self.cache!r}: valid are {', '.join(CACHES)}")


@dataclass(frozen=True)
class Contender:
    """A strategy whose result has been checked on this device, ready to be timed.

    about: what its record says so far.  steps, transfer, finish: as in a Plan.  reset: before each transfer.
    outputs: fetches its result.  rest: the rest of a simulation's step, for cache state "step".  begin: when its
    preparation began (time.perf_counter).
    """

    label: str
    about: dict[str, Any]
    steps: Sequence[Any]
    transfer: Any
    finish: Sequence[Any]
    reset: Sequence[Any]
    outputs: Callable[[], Any]
    rest: Any
    begin: float

    def arm(self, device: TimedDevice) -> Arm:
        """Its transfer as an arm of the rounds."""
        before = [launch for step in (self.rest.before if self.rest else self.reset) for launch in step.launches]
        launches = self.transfer.launches

        def prepare() -> None:
            for launch in before:
                device.launch(launch)

        def run() -> None:
            for launch in launches:
                device.launch(launch)

        return Arm(self.label, run, prepare, len(launches))


def contests(cases: Iterable[Any], inputs: Any) -> list[list[Any]]:
    """Cases that answer the same question, together; questions in the order of their first cases."""
    groups: dict[tuple[Any, ...], list[Any]] = {}
    for case in cases:
        groups.setdefault(case.contest_key(inputs), []).append(case)
    return list(groups.values())


def baseline_of(cases: Sequence[Any], wanted: str = "") -> Any:
    """The case that the others are compared with: the one asked for, else the plainest, else the first."""
    if wanted:
        for fits in (str.__eq__, str.startswith):
            if found := [case for case in cases if fits(case.label, wanted)]:
                return found[0]
    plain = [case for case in cases if case.is_plain]
    return min(plain, key=lambda case: len(case.label), default=cases[0])


def run_contest(
    cases: Sequence[Any],
    device: Any,
    inputs: Any,
    environment: Any,
    timing: Timing | None = None,
    known: Iterable[Any] = (),
    tick: Callable[[str], None] = lambda state: None,
    baseline: Any = None,
) -> Iterator[Record]:
    """Records of cases that answer the same question, one by one as they are finished.

    known: those of the cases whose rows are there already; the baseline is timed again beside the missing ones, without
    a row. tick: told what is going on. baseline: one of the cases, where it is known; else ``baseline_of`` finds it.
    """
    timing = timing or Timing()
    baseline = baseline or baseline_of(cases, timing.baseline)
    silent = {id(case) for case in known}
    missing = [case for case in cases if id(case) not in silent]
    for number, batch in enumerate(_batches(missing, baseline, device, inputs)):
        if number:
            silent.add(id(baseline))
        yield from _run_batch(batch, baseline, silent, device, inputs, environment, timing, tick)


def _batches(cases: Sequence[Any], baseline: Any, device: Any, inputs: Any) -> Iterator[list[Any]]:
    """The cases in pieces that fit on the device together with the baseline, which leads each piece."""
    others = [case for case in cases if case is not baseline]
    if not others:
        if cases:
            yield [baseline]
        return
    room = FILLED * getattr(device, "free_bytes", float("inf")) - baseline.device_bytes(inputs)
    piece: list[Any] = [baseline]
    taken = 0.0
    for case in others:
        need = case.device_bytes(inputs)
        if len(piece) > 1 and taken + need > room:
            yield piece
            piece, taken = [baseline], 0.0
        piece.append(case)
        taken += need
    yield piece


def _run_batch(
    cases: Sequence[Any],
    baseline: Any,
    silent: set[int],
    device: Any,
    inputs: Any,
    environment: Any,
    timing: Timing,
    tick: Callable[[str], None],
) -> Iterator[Record]:
    contenders: list[Contender] = []
    unseen: set[str] = set()
    for case in cases:
        tick(f"{case.title}: check")
        made = case.prepare(device, inputs, environment, timing.cache)
        if isinstance(made, Contender):
            contenders.append(made)
            if id(case) in silent:
                unseen.add(made.label)
        elif id(case) not in silent:
            yield replace(made, cache=timing.cache)
    if all(contender.label in unseen for contender in contenders):
        return
    seed = zlib.crc32(repr([(c.label, c.about["dataset"].fingerprint) for c in contenders]).encode())
    clock = clock_of(device, timing.cache)
    question = f"{cases[0].title.partition(' on ')[2]}: {len(contenders)} in rounds"

    def told(rounds: int) -> None:
        tick(f"{question}, round {rounds}")

    contest = run_rounds([c.arm(device) for c in contenders], clock, timing.rules, seed, told)
    name = uuid4().hex[:12]
    for contender in contenders:
        if contender.label not in unseen:
            tick(f"{contender.label}: steps")
            yield _record(contender, contest, name, device, timing)


def _record(contender: Contender, contest: Contest, name: str, device: Any, timing: Timing) -> Record:
    label, about = contender.label, {**contender.about, "cache": timing.cache}
    try:
        if label in contest.spoiled:
            raise InputError(contest.spoiled[label])
        if not contest.seconds[label]:
            raise InputError(f"no sample: {contest.stopped_by}")
        about["transfer_measurement"] = Measurement(
            tuple(contest.seconds[label]),
            timing.cache,
            contest.warmups,
            contest.stopped_by,
            tuple(contest.hertz[label]),
            contest.discarded,
            contest.held_down,
        )
        about["comparison"] = _comparison(label, contest, name, timing.rules)
        about["repeat"] = _repeat(contender, device)
        # A step finds in the caches what the step before it left there, or nothing.
        sampling = replace(timing.sampling, mode="cold" if timing.cache == "cold" else "step")
        about["preprocess"] = _measured(device, contender.steps, sampling)
        about["finish"] = _measured(device, contender.finish, sampling)
        if contender.rest:
            around = _measured(device, contender.rest.step, sampling)
            about["rest_of_step"] = {step: cost for step, cost in around.items() if step != contender.rest.transfer}
    except InputError as error:
        for key in ("transfer_measurement", "comparison", "repeat", "preprocess", "finish", "rest_of_step"):
            about.pop(key, None)
        about["failed_because"] = str(error)
    return Record(**about, host_seconds=time.perf_counter() - contender.begin)


def _measured(device: Any, steps: Sequence[Any], sampling: Sampling) -> dict[str, StepCost]:
    return {name: StepCost(measurement=m) for name, m in measure_steps(device, steps, sampling=sampling).items()}


def _comparison(label: str, contest: Contest, name: str, rules: Rules) -> Comparison:
    paired = contest.paired.get(label)
    return Comparison(
        contest=name,
        baseline=contest.baseline,
        is_baseline=label == contest.baseline,
        verdict=str(paired.verdict if paired else Verdict.SAME if label == contest.baseline else Verdict.UNUSABLE),
        speedup=_three(paired.speedup) if paired else None,
        leads=label in contest.leaders,
        noise=_three(contest.noise),
        margin=paired.margin if paired else rules.margin,
        p_value=paired.p_value if paired else 1.0,
        confidence=rules.confidence,
        rounds=contest.rounds,
        seed=contest.seed,
    )


def _three(interval: Interval) -> tuple[float, float, float]:
    return interval.median, interval.low, interval.high


def _repeat(contender: Contender, device: Any) -> Repeat:
    """The transfer twice from the same state: which bits of the result depend on the order of atomics?"""
    results = []
    for _ in range(2):
        for step in (*contender.reset, contender.transfer, *contender.finish):
            for launch in step.launches:
                device.launch(launch)
        results.append(list(_arrays(contender.outputs())))
    differing = count = 0
    largest = 0.0
    for first, second in zip(*results, strict=True):
        bits = [np.ascontiguousarray(array).view(f"u{array.dtype.itemsize}") for array in (first, second)]
        differing += int(np.count_nonzero(bits[0] != bits[1]))
        count += first.size
        if first.size and first.dtype.kind == "f":
            scale = float(np.abs(first).max()) or 1.0
            largest = max(largest, float(np.abs(first.astype(float) - second).max()) / scale)
    return Repeat(differing, count, largest)


def _arrays(outputs: Any) -> Iterator[np.ndarray]:
    """The arrays of a result, whatever holds them."""
    held = outputs if isinstance(outputs, dict) else {f.name: getattr(outputs, f.name) for f in fields(outputs)}
    for value in held.values():
        if isinstance(value, np.ndarray):
            yield value
