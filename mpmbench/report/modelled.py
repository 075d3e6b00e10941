"""What would it do on my GPU? Modelled times of every strategy, ranked per GPU and dataset, as far as the ranges allow.

Rank 1 means: no other strategy is surely faster. Two whose ranges overlap cannot be told apart; both carry an "=".
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from mpmbench.gpu.modelled import ModelledTime
from mpmbench.profile_record import Profile
from mpmbench.record import PER_TRANSFER_STEPS, Record
from mpmbench.report import table as tables
from mpmbench.report.speed_of_light import unit_label
from mpmbench.report.table import Cell, Column, Group, Kind, Quantity, Row, Split, Table
from mpmbench.report.text import number, range_text, seconds_text

NAMED_TIES = 2

EXPLANATION = (
    "Times are modelled, not measured, each with the range that the model claims; where ranges overlap, the order is "
    "within its error. A transfer alone, and with the sort that it needs."
)
UNCALIBRATED = "uncalibrated"

HOW_RANKED = (
    "Rank 1: nothing is surely faster. Ranks with = share a range with another strategy: which of the two is faster is "
    "within the model's error. Ranks without overlap are outside it."
)


@dataclass(frozen=True)
class Span:
    """A modelled time and its range [s]."""

    seconds: float
    low: float
    high: float

    @classmethod
    def of(cls, time: ModelledTime) -> Span:
        return cls(time.seconds, time.low, time.high)

    def __add__(self, other: Span) -> Span:
        return Span(self.seconds + other.seconds, self.low + other.low, self.high + other.high)

    def overlaps(self, other: Span) -> bool:
        return self.low <= other.high and other.low <= self.high

    @property
    def text(self) -> str:
        return f"{seconds_text(self.seconds)} ({range_text(self.low, self.high, seconds_text)})"


@dataclass(frozen=True)
class Costs:
    """What is paid once per sort and what every transfer pays again."""

    per_sort: Span
    per_transfer: Span

    @property
    def total(self) -> Span:
        """A sort and one transfer."""
        return self.per_sort + self.per_transfer


@dataclass(frozen=True)
class GpuGroup:
    """Runs of one group whose time is modelled on one GPU, the fastest first.

    alone: whether no other group has the same transfer, dataset and GPU, so that these name it.
    """

    group: Group
    gpu: str
    alone: bool = True

    @cached_property
    def runs(self) -> tuple[Record, ...]:
        found = [r for r in self.group.ranked if self.gpu in (r.modelled or {})]
        return tuple(sorted(found, key=lambda r: (self.profile(r).time.seconds, r.variant)))

    def profile(self, record: Record) -> Profile:
        assert record.modelled is not None
        return record.modelled[self.gpu]

    @property
    def gpu_title(self) -> str:
        return self.profile(self.runs[0]).title

    @property
    def title(self) -> str:
        """Problem and GPU, as short as tells it from the others."""
        record = self.group.first
        what = record.transfer.upper() if record.is_transfer else record.transfer.replace("_", " ").capitalize()
        words = [f"{what} on {tables.dataset_name(record.dataset)}", "" if self.alone else self.problem, self.gpu_title]
        return ", ".join(filter(None, words))

    @property
    def problem(self) -> str:
        """Size, and the axes that make a problem."""
        record = self.group.first
        size = f"{record.dataset.n:,} {'particles' if record.is_transfer else 'elements'}"
        words = [str(record.axes[axis]) for axis in tables.PROBLEM_AXES if axis in record.axes]
        return ", ".join([size, *words, f"compiled for {record.arch}"])

    @property
    def baseline(self) -> Record | None:
        base = self.group.baseline
        return base if base is not None and base in self.runs else None

    def transfer(self, record: Record) -> Span:
        """The transfer alone."""
        return Span.of(self.profile(record).time)

    def costs(self, record: Record) -> Costs | None:
        """None where a step before the transfer has no modelled time."""
        steps = self.profile(record).steps
        if any(name not in steps for name in record.preprocess):
            return None
        nothing = Span(0.0, 0.0, 0.0)
        once = (Span.of(steps[name]) for name in record.preprocess if name not in PER_TRANSFER_STEPS)
        again = (Span.of(steps[name]) for name in record.preprocess if name in PER_TRANSFER_STEPS)
        return Costs(sum(once, nothing), sum(again, self.transfer(record)))

    def total(self, record: Record) -> Span | None:
        costs = self.costs(record)
        return None if costs is None else costs.total


def gpu_groups(records: Iterable[Record]) -> list[GpuGroup]:
    """Every group on every GPU that its records name: by GPU, then dataset, then transfer."""
    pairs = [
        (g, gpu)
        for g in tables.group(records)
        for gpu in dict.fromkeys(gpu for r in g.ranked for gpu in r.modelled or {})
    ]
    gpus = list(dict.fromkeys(gpu for _, gpu in pairs))
    names = Counter((g.first.transfer, tables.dataset_name(g.first.dataset), gpu) for g, gpu in pairs)
    found = [
        GpuGroup(g, gpu, names[g.first.transfer, tables.dataset_name(g.first.dataset), gpu] == 1) for g, gpu in pairs
    ]
    return sorted(found, key=lambda g: gpus.index(g.gpu))


# ---- ranks -------------------------------------------------------------------------------------------------


def ranks(spans: Sequence[Span | None]) -> list[str | None]:
    """Of each: one more than there are surely faster ones, and "=" where its range overlaps another's."""
    known = [span for span in spans if span is not None]

    def rank(span: Span) -> str:
        faster = sum(other.high < span.low for other in known)
        tied = sum(span.overlaps(other) for other in known) > 1  # it overlaps itself
        return f"{faster + 1}{'=' if tied else ''}"

    return [None if span is None else rank(span) for span in spans]


def winners(g: GpuGroup, cost: Callable[[Record], Span | None]) -> tuple[Record, ...]:
    """The fastest, then those that cannot be told from it."""
    spans = {id(r): span for r in g.runs if (span := cost(r)) is not None}
    ordered = sorted((r for r in g.runs if id(r) in spans), key=lambda r: spans[id(r)].seconds)
    if not ordered:
        return ()
    best, *others = ordered
    return (best, *(r for r in others if spans[id(r)].overlaps(spans[id(best)])))


def break_even(g: GpuGroup, record: Record) -> tuple[float, float, float] | None:
    """Transfers per sort from which it beats unsorted global atomics (or gathers): as modelled, at best, at worst."""
    base = g.baseline
    if base is None or record is base:
        return None
    this, other = g.costs(record), g.costs(base)
    if this is None or other is None:
        return None

    def between(mine: str, theirs: str) -> float:
        return tables.break_even(
            Split(getattr(this.per_sort, mine), getattr(this.per_transfer, mine)),
            Split(getattr(other.per_sort, theirs), getattr(other.per_transfer, theirs)),
        )

    return between("seconds", "seconds"), between("low", "high"), between("high", "low")


# ---- tables ------------------------------------------------------------------------------------------------

_RANGE = Column("range", Kind.MODELLED, Quantity.SECONDS_RANGE, explain="of the modelled time", under=True)


def _modelled(
    title: str, quantity: Quantity, better: str | None = None, explain: str = "", under: bool = False
) -> Column:
    return Column(title, Kind.MODELLED, quantity, better, explain, under)


def winners_table(groups: Sequence[GpuGroup]) -> Table:
    """The fastest strategy per GPU, dataset and problem; whoever cannot be told from it stands beneath it."""
    columns = (
        Column("GPU", Kind.NAME, Quantity.CODE),
        Column("transfer", Kind.NAME, Quantity.TEXT),
        Column("dataset", Kind.NAME, Quantity.CODE),
        _modelled("fastest transfer", Quantity.CODE, explain="least modelled time, the transfer alone"),
        _modelled("or", Quantity.TEXT, explain="cannot be told from the fastest: ranges overlap", under=True),
        _modelled("time", Quantity.SECONDS, explain="modelled time of the transfer"),
        _RANGE,
        _modelled("baseline / this", Quantity.FACTOR, explain="modelled time of unsorted global atomics over this one"),
        _modelled("fastest with its sort", Quantity.CODE, explain="least modelled time of a sort and one transfer"),
        _modelled("or, with its sort", Quantity.TEXT, explain="cannot be told from the fastest", under=True),
        _modelled("total", Quantity.SECONDS, explain="modelled time of a sort and one transfer"),
        _RANGE,
        Column("particles", Kind.NAME, Quantity.COUNT),
        Column("problem", Kind.NAME, Quantity.TEXT),
    )
    rows = []
    for g in groups:
        alone, sorted_too = winners(g, g.transfer), winners(g, g.total)
        time = g.transfer(alone[0])
        base = g.baseline and g.transfer(g.baseline).seconds
        total = g.total(sorted_too[0]) if sorted_too else None
        first = g.group.first
        values = (
            g.gpu,
            first.transfer.upper(),
            tables.dataset_name(first.dataset),
            g.group.label(alone[0]),
            _ties(g, alone),
            time.seconds,
            (time.low, time.high),
            base / time.seconds if base and time.seconds else None,
            g.group.label(sorted_too[0]) if sorted_too else None,
            _ties(g, sorted_too),
            total and total.seconds,
            total and (total.low, total.high),
            first.dataset.n,
            tables.problem_text(first),
        )
        rows.append(_row(values, columns))
    return Table("Fastest per GPU: modelled", columns, tuple(rows))


def _ties(g: GpuGroup, found: Sequence[Record]) -> str:
    others = [g.group.label(r) for r in found[1:]]
    more = len(others) - NAMED_TIES
    named = ", ".join(others[:NAMED_TIES])
    return "" if not others else f"or {named}{f' or {more} more' if more > 0 else ''}"


def ranking(g: GpuGroup) -> Table:
    """Every strategy on one GPU, with ranges, preprocessing and break-even."""
    columns = (
        _modelled("rank", Quantity.RANK, explain="by the transfer alone; = where ranges overlap"),
        _modelled("rank with sort", Quantity.RANK, explain="by a sort and one transfer; = where ranges overlap"),
        Column("strategy", Kind.NAME, Quantity.CODE),
        Column("axes changed", Kind.NAME, Quantity.CODE, under=True),
        _modelled("transfer", Quantity.SECONDS, "less", "modelled time of the transfer alone"),
        _RANGE,
        _modelled("bound", Quantity.TEXT, explain="the unit that takes most of the time"),
        _modelled("calibration", Quantity.TEXT, explain="empty where the rates that bind are known", under=True),
        _modelled("per sort", Quantity.SECONDS, None, "preprocessing done once per sort"),
        _RANGE,
        _modelled("sort and transfer", Quantity.SECONDS, "less", "a sort and one transfer, clearing included"),
        _RANGE,
        _modelled(
            "break-even", Quantity.TRANSFERS, "less",
            "transfers per sort from which it takes less time than unsorted global atomics (or gathers)",
        ),
        _modelled("at best to at worst", Quantity.TRANSFERS_RANGE, explain="ends of both ranges", under=True),
    )  # fmt: skip
    alone = ranks([g.transfer(r) for r in g.runs])
    with_sort = ranks([g.total(r) for r in g.runs])
    rows = []
    for record, rank, rank_total in zip(g.runs, alone, with_sort, strict=True):
        time, costs, even = g.profile(record).time, g.costs(record), break_even(g, record)
        sort = costs.per_sort if costs is not None and costs.per_sort.seconds else None
        values = (
            rank,
            rank_total,
            record.variant,
            tables.axes_text(tables.changed_axes(record, g.group.shared)),
            time.seconds,
            (time.low, time.high),
            unit_label(time.bound),
            "" if time.calibrated else UNCALIBRATED,
            sort and sort.seconds,
            sort and (sort.low, sort.high),
            costs and costs.total.seconds,
            costs and (costs.total.low, costs.total.high),
            even and even[0],
            even[1:] if even and even[1] != even[2] else None,
        )
        rows.append(_row(values, columns, baseline=record is g.baseline))
    notes = [HOW_RANKED] if len(g.runs) > 1 else []
    if g.group.first.is_transfer:
        base = g.baseline
        name = tables.BASELINES.get(g.group.first.transfer)
        notes.append(
            f"Break-even against {g.group.label(base)}, particles in the order given."
            if base is not None
            else f"No break-even: {name} with particle_order=given did not run on this dataset."
        )
    notes += uncalibrated_notes(g)
    return Table(f"Modelled: {g.title}", columns, tuple(rows), tuple(notes))


def uncalibrated_notes(g: GpuGroup) -> list[str]:
    """Each reason why a time of this GPU is uncalibrated, once."""
    times = [g.profile(r).time for r in g.runs]
    return [f"Uncalibrated: {reason}." for reason in dict.fromkeys(t.reason for t in times if not t.calibrated)]


def _row(values: Iterable[Any], columns: Sequence[Column], baseline: bool = False) -> Row:
    return Row(tuple(Cell(v, c.kind) for v, c in zip(values, columns, strict=True)), baseline=baseline)


# ---- sentences ---------------------------------------------------------------------------------------------


def answer(g: GpuGroup) -> str:
    """One sentence for the head of a report."""
    best, *ties = winners(g, g.transfer)
    words = f"Modelled, {g.title}: {g.group.label(best)}, {g.transfer(best).text}"
    if not g.profile(best).time.calibrated:
        words += ", uncalibrated"
    base = g.baseline
    if base is not None and base is not best:
        if base in ties:
            words += f"; it cannot be told from unsorted {base.variant}"
        else:
            gain = g.transfer(base).seconds / g.transfer(best).seconds
            words += f", {number(gain)} times as fast as unsorted {base.variant} (transfer alone)"
    others = [g.group.label(r) for r in ties if r is not base]
    if others:
        more = len(others) - NAMED_TIES
        named = ", ".join(others[:NAMED_TIES]) + (f" and {more} more" if more > 0 else "")
        words += f"; within the model's error of {named}"
    return f"{words}."
