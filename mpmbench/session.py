"""Cases on devices -> records, one after the other: counted where a device counts, in contests where it keeps time."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import nullcontext
from typing import Any

from mpmbench.contest import Timing, baseline_of, contests, run_contest
from mpmbench.environment import Environment
from mpmbench.errors import InputError
from mpmbench.record import Record
from mpmbench.runner import Inputs, resume_key, tuned_key
from mpmbench.tuning import settled, tune

Tick = Callable[[str], None]


def keeps_time(device: Any) -> bool:
    """Whether a device has a clock: the simulated one has none."""
    return hasattr(device, "elapsed")


def run_session(
    cases: Sequence[Any],
    devices: Sequence[Any],
    timings: Sequence[Timing] = (),
    known: Collection[Record] = (),
    tick: Tick = lambda what: None,
) -> Iterator[tuple[Record, bool]]:
    """Each record with whether it is new, device by device.

    timings: one for each cache state that is asked for; none: results are checked and nothing is timed.
    known: rows of an earlier run, taken as they are; those of another GPU, cache state or case are passed over.
    """
    environment, inputs = Environment.capture(), Inputs()
    kept = {
        (key(record), record.cache, record.environment.gpu.get("name")): record
        for record in known
        for key in (resume_key, tuned_key)
    }
    for device in devices:
        if not (timings and keeps_time(device)):
            yield from _one_by_one(cases, device, inputs, environment, kept, tick)
            continue
        with getattr(device, "undisturbed", nullcontext)():
            for timing in timings:
                for group in contests(cases, inputs):
                    yield from _contest(group, device, inputs, environment, timing, kept, tick)


def shard(cases: Sequence[Any], text: str, together: bool) -> list[Any]:
    """Part i of n of the cases, for text ``i/n``; parts 1 to n hold every case once.

    together: cases that are timed against each other stay in one part.
    """
    part, slash, parts = text.partition("/")
    if not (slash and part.isdigit() and parts.isdigit() and 1 <= int(part) <= int(parts)):
        raise InputError(f"cannot read shard {text!r}: write it as i/n with i from 1 to n, such as 2/4")
    groups = contests(cases, Inputs()) if together else [[case] for case in cases]
    return [case for group in groups[int(part) - 1 :: int(parts)] for case in group]


def _gpu_name(device: Any) -> str | None:
    """Its model. Two cards of one model go on with each other's rows: on a cluster nobody chooses the card."""
    name: str | None = getattr(device, "facts", {}).get("name")
    return name


def _one_by_one(
    cases: Sequence[Any], device: Any, inputs: Inputs, environment: Environment, kept: dict[Any, Record], tick: Tick
) -> Iterator[tuple[Record, bool]]:
    for case in cases:
        tick(f"{device.name} {case.title}")
        record = kept.get((case.resume_key(device, inputs), None, _gpu_name(device))) if kept else None
        yield (case.run(device, inputs, environment), True) if record is None else (record, False)


def _contest(
    group: Sequence[Any],
    device: Any,
    inputs: Inputs,
    environment: Environment,
    timing: Timing,
    kept: dict[Any, Record],
    tick: Tick,
) -> Iterator[tuple[Record, bool]]:
    ready, known = [], []
    told = f"{device.name} {timing.cache}"
    for case in group:
        record = kept.get((case.resume_key(device, inputs), timing.cache, _gpu_name(device))) if kept else None
        if record is not None:
            known.append(settled(case, record) if case.search else case)
            yield record, False
        ready.append(known[-1] if record is not None else case)
    if len(known) == len(group):
        return

    def named(what: str) -> None:
        tick(f"{told} {what}")

    # The baseline is what was asked for, or the plainest, before its axes are searched for.
    baseline = ready.index(baseline_of(ready, timing.baseline))
    for place, case in enumerate(ready):
        if case.search:
            ready[place] = tune(case, device, inputs, environment, timing, named)
    for record in run_contest(ready, device, inputs, environment, timing, known, named, ready[baseline]):
        yield record, True
