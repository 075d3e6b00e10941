"""What makes measured times doubtful, and what to do about each: a cause and the next action.

Advice knows what was in use already: it does not send for an option that the command had.
"""

from __future__ import annotations

import math
import shlex
import statistics
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from mpmbench import preflight
from mpmbench.measure import SHORTEST_RANKED, too_fast_to_rank
from mpmbench.protocol.rounds import CLOCKS_AGREE
from mpmbench.protocol.verdict import MARGIN, Verdict
from mpmbench.record import Comparison, Measurement, Record
from mpmbench.report import table as tables
from mpmbench.report.table import Group, Kind
from mpmbench.report.text import interval_text, seconds_text

NOISY = 0.10  # interquartile range over median
TOO_NOISY = 0.25
OFTEN = 0.05  # share of rounds
CACHE_BOUND = 5  # below so many times the cache, cold and hot caches have been seen to rank differently
NAMED = 5  # runs (or sentences) of one sort that are spelt out; the tables hold all

# Options of a run that say where its results go: a second run must not write over them.
_TARGETS = ("--json", "--html", "--md", "--csv", "--nvbench")
_DROPPED = ("--quick", "--resume", "--dry-run", "--rigorous")


@dataclass(frozen=True)
class Doubt:
    """level: "warning" or "note".  where: row or group; doubts that differ in it alone are told together."""

    level: str
    trouble: str
    action: str
    where: str = ""


def too_short(record: Record) -> bool:
    """Whether events cannot tell its time from that of another row."""
    time = record.transfer_measurement
    return tables.cost_kind(record) is Kind.MEASURED and time is not None and too_fast_to_rank(time)


def throttled(record: Record) -> bool:
    """Whether it lost its samples to a processor that slowed down."""
    return (record.failed_because or "").startswith("THROTTLED")


def doubts(groups: Sequence[Group]) -> Iterator[Doubt]:
    """Of all groups with times, or with rows that should have had one."""
    timed = [g for g in groups if not g.simulated]
    # What is known of a GPU does not depend on the row, yet every row carries it.
    facts = {repr(sorted(r.environment.gpu.items(), key=str)): r for g in timed for r in g.ranked if r.environment.gpu}
    for record in facts.values():
        for trouble, action in preflight.warnings(record.environment.gpu):
            yield Doubt("warning", trouble, action, str(record.environment.gpu.get("name", record.device)))
    for g in timed:
        for record in g.ranked:
            yield from _of_row(record, f"{tables.label(record)} on {tables.dataset_name(record.dataset)}")
        if g.paired:
            yield from _of_contest(g)


def _of_row(record: Record, where: str) -> Iterator[Doubt]:
    time = record.transfer_measurement
    assert time is not None
    if too_short(record):
        trouble = f"Too short for the resolution of events (below {seconds_text(SHORTEST_RANKED)})"
        yield Doubt("warning", trouble, "Do not rank by it; use more particles (`--particles`).", where)
    if time.noise > TOO_NOISY:
        trouble = f"Samples scatter by more than {100 * TOO_NOISY:.0f} % (interquartile range over median)"
        yield Doubt("warning", trouble, f"Do not use these times: {_calm(record)}, and run again.", where)
    elif time.noise > NOISY:
        trouble = f"Samples scatter by more than {100 * NOISY:.0f} % (interquartile range over median)"
        yield Doubt("warning", trouble, f"{_sentence(_calm(record))}, and run again.", where)
    if record.comparison is None and time.discarded:
        yield _discarded(record, time, where)


def _of_contest(g: Group) -> Iterator[Doubt]:
    rows = [(r, r.comparison, r.transfer_measurement) for r in g.ranked if r.comparison and r.transfer_measurement]
    first, comparison, time = next((row for row in rows if row[1].is_baseline), rows[0])
    if any(t.discarded for _, _, t in rows):
        # A pass is thrown away as a whole, so that every row of the contest carries the same numbers.
        yield _discarded(first, max((t for _, _, t in rows), key=lambda t: sum(t.discarded.values())), g.title)
    for why, count in max((t.held_down for _, _, t in rows), key=len).items():
        trouble = f"The driver held the clocks down in {count:,} of {comparison.rounds:,} rounds ({why})"
        action = f"All rows of a round were held down alike, so speedups stand; for the times, {_cool(first)}."
        yield Doubt("warning" if count > comparison.rounds * OFTEN else "note", trouble, action, g.title)
    if (ratio := _cache_share(first)) is not None and ratio < CACHE_BOUND:
        trouble = f"Particles and nodes are {ratio:.2g} times the second-level cache: its state can decide the ranking"
        action = 'Rank by the state that the simulation has: `-a "cache=[cold,hot,step]"` shows all three.'
        yield Doubt("note", trouble, action, g.title)
    if not any(c.is_baseline or c.speedup for _, c, _ in rows):
        action = "Find out why it failed (its row says), then run again."
        yield Doubt("warning", f"The baseline {comparison.baseline} has no time: nothing is compared", action, g.title)
    floor = max(abs(comparison.noise[1] - 1), abs(comparison.noise[2] - 1))
    if math.isfinite(floor) and floor > MARGIN:
        trouble = (
            f"Two copies of the baseline differ by up to {100 * floor:.2g} % (noise floor, "
            f"{interval_text(*comparison.noise)}): smaller differences are not called"
        )
        yield Doubt("warning", trouble, f"{_sentence(_calm(first))}, and run again.", g.title)
    apart = [r for r, c, t in rows if c.verdict == Verdict.UNUSABLE and not c.is_baseline and _clocks_differ(t, time)]
    if apart:
        trouble = f"Clocks differ by more than {100 * CLOCKS_AGREE:.0f} % from the baseline's, not compared (????)"
        yield Doubt("warning", trouble, f"{_sentence(_calm(first))}, and run again.", _names(g, apart))
    left = [r for r, c, _ in rows if c.verdict == Verdict.UNUSABLE and not c.is_baseline and r not in apart]
    if left:
        trouble = f"Too few samples to compare with {comparison.baseline} (????)"
        yield Doubt("warning", trouble, next_command(first), _names(g, left))
    yield from _undecided(g, [(r, c) for r, c, _ in rows], time)


def _undecided(g: Group, rows: Sequence[tuple[Record, Comparison]], time: Measurement) -> Iterator[Doubt]:
    why, _, open_names = time.stopped_by.partition("; undecided: ")
    if open_names:
        names = open_names.split(", ")
        more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
        trouble = f"The {why} came before a verdict on {', '.join(names[:NAMED])}{more}"
        yield Doubt("warning", trouble, next_command(rows[0][0]), g.title)
    ambiguous = [r for r, c in rows if c.verdict == Verdict.AMBIGUOUS]
    left = [r for r in ambiguous if not open_names or g.label(r) not in open_names]
    if left:
        trouble = f"Neither faster nor slower than {rows[0][1].baseline} for sure (AMBG)"
        yield Doubt("warning", trouble, next_command(left[0]), _names(g, left))


def next_command(record: Record) -> str:
    """How to decide what this run did not decide."""
    argv = list(record.environment.argv)
    if "--rigorous" in argv:
        return (
            "`--rigorous` was in use: take them as equal, or make the difference larger than the noise "
            f"({_calm(record)}; more particles)."
        )
    if argv[:1] not in (["mpmbench"], ["__main__.py"]) or argv[1:2] != ["run"]:
        return "Run again with `--rigorous`: more rounds, narrower intervals."
    words, skip = ["mpmbench"], False
    for word in argv[1:]:
        if skip:
            skip = False
        elif word in _TARGETS:
            skip = True
        elif word not in _DROPPED and not word.startswith(tuple(f"{target}=" for target in _TARGETS)):
            words.append(word)
    return f"Run `{shlex.join([*words, '--rigorous'])}`: more rounds, narrower intervals."


def throttled_action(record: Record) -> str:
    """What to do where a processor slowed down."""
    return f"No error of the strategy: {_cool(record)}, and run again."


def _discarded(record: Record, time: Measurement, where: str) -> Doubt:
    reasons = ", ".join(f"{count:,} for {reason}" for reason, count in time.discarded.items())
    passes = "passes" if record.comparison else "samples"
    trouble = f"Of {passes} {sum(time.discarded.values()):,} were thrown away ({reasons}), {len(time.samples):,} kept"
    return Doubt("note", trouble, f"They are in no number here; to lose fewer, {_cool(record)}.", where)


def _calm(record: Record) -> str:
    """What quiets this machine, less what is in use already."""
    if tables.cost_kind(record) is Kind.WALL:
        return "close other programs, fix the CPU's frequency"
    if _clocks_locked(record):
        return "the clocks are locked already: keep other programs off the GPU"
    return "lock the clocks (`--lock-gpu-clocks base`), keep other programs off the GPU"


def _cool(record: Record) -> str:
    if tables.cost_kind(record) is Kind.WALL:
        return "let the CPU cool down, close other programs"
    if _clocks_locked(record):
        return "the clocks are locked already: cool the GPU, raise its power limit, or lock a lower clock"
    return "cool the GPU, raise its power limit, or lock a clock that it can hold (`--lock-gpu-clocks base`)"


def _clocks_locked(record: Record) -> bool:
    return any(word.startswith("--lock-gpu-clocks") for word in record.environment.argv)


def _cache_share(record: Record) -> float | None:
    """Working set of the plainest transfer over the second-level cache; None where either is not known."""
    size = record.environment.gpu.get("l2_bytes")
    return record.floor_bytes / size if size and record.floor_bytes else None


def _clocks_differ(one: Measurement, other: Measurement) -> bool:
    if not (one.hertz and other.hertz):
        return False
    clocks = statistics.median(one.hertz), statistics.median(other.hertz)
    return max(clocks) > min(clocks) * (1 + CLOCKS_AGREE)


def _names(g: Group, records: Sequence[Record]) -> str:
    """Rows of a group, the first few by name."""
    named = [g.label(r) for r in records[:NAMED]]
    more = f" and {len(records) - NAMED} more" if len(records) > NAMED else ""
    return f"{', '.join(named)}{more} ({g.title})"


def _sentence(text: str) -> str:
    return text[0].upper() + text[1:]
