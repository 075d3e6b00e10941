"""Records -> tables: what to show, beside what, and of which kind. Nothing here formats text.

A column has one kind, and a cell of another kind is refused, so a counted number can never stand under a measured
one. Ranks, shares and ratios are of the kind of the numbers they come from.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property
from typing import Any

from mpmbench.contest import BASELINES, PROBLEM_AXES
from mpmbench.record import PER_TRANSFER_STEPS, DatasetSummary, Record, StepCost
from mpmbench.report.contests import timed_apart
from mpmbench.simt.counters import SourceLine, Tally

SECTOR_BYTES = 32

HOTTEST_LINES = 5

DISTRIBUTION_TITLES = {"histogram": "Occupied cells by the number of particles in them"}


class Kind(StrEnum):
    """Where a number comes from."""

    NAME = "name"  # no number: what the row is
    CHECKED = "checked"  # comparison with the float64 reference
    PREDICTED = "predicted"  # follows from sizes alone, known before anything runs
    SIMULATED = "simulated"  # counted on the simulated device
    MEASURED = "measured"  # event time on a GPU
    WALL = "wall clock"  # time of a run on the CPU; beside no event time
    MODELLED = "modelled"  # performance model of a named GPU
    PUBLISHED = "published"  # printed by somebody else


class Quantity(StrEnum):
    """What a value means, for whoever formats it."""

    TEXT = "text"  # a word or two
    PROSE = "prose"  # long enough to need wrapping
    CODE = "code"
    PRINTED = "printed"  # shown with every digit it has
    COUNT = "count"
    RATE = "rate"  # per second
    NUMBER = "number"
    BYTES = "bytes"
    SECONDS = "seconds"
    SECONDS_RANGE = "seconds range"  # a pair (low, high)
    FACTOR = "factor"  # 2.0 is printed as a multiple
    FACTOR_INTERVAL = "factor interval"  # (median, low, high)
    SHARE = "share"  # 0.5 is printed as a percentage
    RANK = "rank"
    TRANSFERS = "transfers"  # a break-even: 1 is "at once", infinity is "never"
    TRANSFERS_RANGE = "transfers range"


@dataclass(frozen=True)
class Cell:
    value: Any  # None: not known, or without meaning here
    kind: Kind


@dataclass(frozen=True)
class Column:
    """better: "less" or "more" where one end of the column is the good one, so that the best can be marked; "leads"
    where the rows that carry a mark are the best.

    under: adds to the column before it, and may be shown beneath it where width is scarce.
    """

    title: str
    kind: Kind
    quantity: Quantity = Quantity.NUMBER
    better: str | None = None
    explain: str = ""  # one line, for a legend
    under: bool = False


@dataclass(frozen=True)
class Row:
    cells: tuple[Cell, ...]
    status: str = "ok"  # Record.status; only "ok" rows can be best
    baseline: bool = False
    mark: str = ""  # a word beside its name: "fastest", or "tied" where several share that


@dataclass(frozen=True)
class Table:
    title: str
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for row in self.rows:
            for cell, column in zip(row.cells, self.columns, strict=True):
                if cell.kind is not column.kind:
                    raise ValueError(f"a {cell.kind} value in the {column.kind} column {column.title!r}")

    @property
    def kinds(self) -> tuple[Kind, ...]:
        """Kinds of number in it, in column order."""
        return tuple(dict.fromkeys(c.kind for c in self.columns if c.kind is not Kind.NAME))

    def best(self, column: int) -> set[int]:
        """Rows that are best in a column: none where the column has no good end or nothing to choose from."""
        better = self.columns[column].better
        values = {
            i: row.cells[column].value
            for i, row in enumerate(self.rows)
            if row.status == "ok" and row.cells[column].value is not None
        }
        if better == "leads":
            return {i for i in values if self.rows[i].mark} if len(values) > 1 else set()
        if better is None or len(set(values.values())) < 2:
            return set()
        target = min(values.values()) if better == "less" else max(values.values())
        return {i for i, value in values.items() if value == target}


@dataclass(frozen=True)
class _Source:
    """A column together with how to fill it."""

    column: Column
    value: Callable[[Record], Any]


def _table(
    title: str,
    sources: Sequence[_Source],
    records: Sequence[Record],
    baseline: Record | None = None,
    notes: Iterable[str] = (),
    shared: Mapping[str, Any] | None = None,
    mark: Callable[[Record], str] = lambda record: "",
) -> Table:
    """One row per record. Columns that no record can fill are left out.

    shared: axes that are said elsewhere; by default those that all rows share, which a note then names.
    mark: see ``Row``.
    """
    notes = list(notes)
    if shared is None:
        shared = shared_axes(records)
        notes += [f"All rows: {axes_text(shared)}."] if shared else []
    filled: list[tuple[_Source, list[Any]]] = []
    for source in sources:
        if source is _AXES:
            values: list[Any] = [axes_text(changed_axes(record, shared)) for record in records]
        else:
            values = [source.value(record) for record in records]
        if any(v is not None and v != "" for v in values):
            filled.append((source, values))
    rows = tuple(
        Row(
            tuple(Cell(values[i], source.column.kind) for source, values in filled),
            record.status,
            record is baseline,
            mark(record),
        )
        for i, record in enumerate(records)
    )
    return Table(title, tuple(source.column for source, _ in filled), rows, tuple(notes))


# ---- groups ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Group:
    """Runs that may be compared: one dataset, transfer, problem, device and state of the caches, and where they were
    timed in paired rounds, the same rounds. Ranked ones come first, the leaders before all.

    note: tells it from another group of the same name.
    """

    records: tuple[Record, ...]
    note: str = ""

    @property
    def first(self) -> Record:
        return self.records[0]

    @property
    def simulated(self) -> bool:
        return self.first.simulated

    @property
    def kind(self) -> Kind:
        """Of its costs."""
        return cost_kind(self.first)

    @cached_property
    def ranked(self) -> tuple[Record, ...]:
        return tuple(r for r in self.records if r.status == "ok" and _has_cost(r))

    @property
    def paired(self) -> bool:
        """Whether its rows were compared round by round."""
        return any(r.comparison for r in self.ranked)

    @cached_property
    def leaders(self) -> tuple[Record, ...]:
        """Rows that no other was found to beat, the fastest first; none where nothing was paired."""
        return tuple(r for r in self.ranked if r.comparison and r.comparison.leads)

    @cached_property
    def baseline(self) -> Record | None:
        """What its rows were timed against; else the plainest run of unsorted global atomics (or gathers), with the
        fewest axes away from their defaults."""
        if self.paired:
            return next((r for r in self.ranked if r.comparison and r.comparison.is_baseline), None)
        found = [r for r in self.ranked if is_plain(r)]
        return min(found, key=lambda r: len(changed_axes(r)), default=None)

    @property
    def baseline_name(self) -> str | None:
        """Of the baseline that was meant, whether it has a time or not."""
        if self.baseline is not None:
            return self.label(self.baseline)
        return next((r.comparison.baseline for r in self.ranked if r.comparison), BASELINES.get(self.first.transfer))

    @cached_property
    def shared(self) -> dict[str, Any]:
        """Changed axes that all its runs share."""
        return shared_axes(self.records)

    def label(self, record: Record) -> str:
        return label(record, self.shared)

    @property
    def caches(self) -> str:
        """State of the caches before each sample, in words; "" where it is not known."""
        time = self.first.transfer_measurement
        mode = self.first.cache if time is None else time.mode
        return cache_text(mode) if mode else ""

    @property
    def title(self) -> str:
        record = self.first
        words = [f"{record.transfer.upper()} on {dataset_name(record.dataset)}", f"{record.dataset.n:,} particles"]
        words += [str(record.axes[axis]) for axis in PROBLEM_AXES if axis in record.axes]
        return ", ".join(filter(None, [*words, self.caches, self.note]))

    @property
    def device(self) -> str:
        record = self.first
        if record.simulated:
            tuned = f", axes searched for {record.tuning.gpu}" if record.tuning and record.tuning.gpu else ""
            return f"simulated device, kernels compiled for {record.arch}{tuned}"
        if self.kind is Kind.WALL:
            return f"{record.environment.cpu} (CPU, wall clock)"
        return f"{record.environment.gpu.get('name', record.device)}, {record.arch}"


def cost_kind(record: Record) -> Kind:
    """Of what a record's costs are: counts, event times, or wall clock."""
    if record.simulated:
        return Kind.SIMULATED
    return Kind.WALL if record.device.startswith("cpu") else Kind.MEASURED


def cache_text(mode: str) -> str:
    return {"step": "caches as a step leaves them"}.get(mode, f"caches {mode}")


def is_plain(record: Record) -> bool:
    """Whether it is the transfer of somebody who has read nothing of this, on particles in the order given."""
    return record.variant == BASELINES.get(record.transfer) and record.axes.get("particle_order") == "given"


def group(records: Iterable[Record]) -> list[Group]:
    """Put together what may be compared. Of runs that are the same in every respect the last one counts."""
    alike: dict[tuple[Any, ...], list[Record]] = {}
    for r in records:
        problem = tuple(r.axes.get(axis) for axis in PROBLEM_AXES)
        processor = r.environment.cpu if cost_kind(r) is Kind.WALL else r.environment.gpu.get("name")
        tuned_for = r.tuning.gpu if r.tuning and r.simulated else None  # each modelled GPU has its own best axes
        key = (r.dataset.name, r.dataset.fingerprint, r.transfer, problem, r.device, processor, r.arch, tuned_for)
        alike.setdefault((*key, r.environment.gpu.get("uuid")), []).append(r)
    found = _told_apart(
        [Group(tuple(sorted(part, key=_order))) for runs in alike.values() for part in timed_apart(runs)]
    )
    datasets = list(dict.fromkeys((g.first.dataset.name, g.first.dataset.fingerprint) for g in found))
    place = {dataset: i for i, dataset in enumerate(datasets)}
    # P2G and G2P of a dataset side by side, datasets in the order run.
    return sorted(
        found,
        key=lambda g: (
            place[g.first.dataset.name, g.first.dataset.fingerprint],
            list(BASELINES).index(g.first.transfer) if g.first.transfer in BASELINES else len(BASELINES),
        ),
    )


def _told_apart(groups: Sequence[Group]) -> list[Group]:
    """With notes on those whose titles and devices read the same."""
    alike: dict[tuple[str, str], list[Group]] = {}
    for g in groups:
        alike.setdefault((g.title, g.device), []).append(g)

    def note(g: Group) -> str:
        others = alike[g.title, g.device]
        if len(others) == 1:
            return ""
        devices = [other.first.device for other in others]
        return g.first.device if len(set(devices)) == len(others) else f"timing {others.index(g) + 1} of {len(others)}"

    return [replace(g, note=note(g)) for g in groups]


def _order(record: Record) -> tuple[Any, ...]:
    """Best first: by time where there is one, by sectors where counted; what cannot be ranked comes last."""
    if record.status != "ok" or not _has_cost(record):
        return (1, record.status, record.variant, str(record.axes))
    if record.transfer_measurement:
        leads = record.comparison is not None and record.comparison.leads
        return (0, not leads, record.transfer_measurement.median, record.variant)
    assert record.transfer_counters is not None
    return (0, record.transfer_counters.total.sectors, record.transfer_counters.total.warp_inst, record.variant)


def _has_cost(record: Record) -> bool:
    return record.transfer_counters is not None or record.transfer_measurement is not None


# ---- what a record says ------------------------------------------------------------------------------------


def changed_axes(record: Record, shared: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Axes that are not at this variant's defaults, less those that are said elsewhere, as the problem is."""
    said = shared or {}
    return {
        name: value
        for name, value in record.axes.items()
        if name not in PROBLEM_AXES and name not in said and record.default_axes.get(name) != value
    }


def shared_axes(records: Sequence[Record]) -> dict[str, Any]:
    """Changed axes that several records all have, with one value: one remark says them for all."""
    if len(records) < 2:
        return {}
    changed = [changed_axes(r) for r in records]
    return {name: v for name, v in changed[0].items() if all(c.get(name) == v for c in changed)}


def axis_text(value: Any) -> str:
    return "x".join(map(str, value)) if isinstance(value, tuple) else str(value)


def axes_text(axes: Mapping[str, Any]) -> str:
    return " ".join(f"{name}={axis_text(value)}" for name, value in axes.items())


def label(record: Record, shared: Mapping[str, Any] | None = None) -> str:
    """Variant with its changed axes: unique within a group."""
    return " ".join(filter(None, [record.variant, axes_text(changed_axes(record, shared))]))


def problem_text(record: Record) -> str:
    return " ".join(str(record.axes[axis]) for axis in PROBLEM_AXES if axis in record.axes)


def dataset_name(dataset: DatasetSummary) -> str:
    """Name with the density, where the recipe has one to choose."""
    density = dataset.recipe.get("particles_per_cell")
    return dataset.name if density is None else f"{dataset.name} ({density} per cell)"


def reason(record: Record) -> str:
    """Why a run has no rank; empty for one that has."""
    match record.status:
        case "skipped":
            return f"skipped: {record.skipped_because}"
        case "broken":
            return f"failed: {record.failed_because}"
        case "wrong":
            return f"WRONG RESULT: {error_text(record)}"
        case "findings":
            return f"refused: {finding_text(record)}"
        case "unchecked":
            return "not checked, hence not ranked"
    return ""


def error_text(record: Record) -> str:
    """How far off a wrong run is, and where."""
    check = record.check
    if check is None:
        return "no result"
    where = "" if check.worst_node is None else f" at {axis_text(check.worst_node)}"
    return f"error {check.ratio:.3g} times the allowance{where}"


def finding_text(record: Record) -> str:
    return f"the engine found {', '.join(sorted({finding.kind for finding in record.findings}))}"


def _tally(record: Record) -> Tally | None:
    return None if record.transfer_counters is None else record.transfer_counters.total


def _per(count: Callable[[Tally], float], unit: Callable[[Record], float]) -> Callable[[Record], float | None]:
    def value(record: Record) -> float | None:
        tally = _tally(record)
        return None if tally is None or not unit(record) else count(tally) / unit(record)

    return value


def _ratio(top: Callable[[Tally], int], bottom: Callable[[Tally], int]) -> Callable[[Record], float | None]:
    def value(record: Record) -> float | None:
        tally = _tally(record)
        return None if tally is None or not bottom(tally) else top(tally) / bottom(tally)

    return value


def particles(record: Record) -> int:
    return record.dataset.n


def warp_inst(tally: Tally) -> int:
    return tally.warp_inst


def sectors(tally: Tally) -> int:
    return tally.sectors


Measure = Callable[[StepCost], float | None]


def count_of(counter: Callable[[Tally], int]) -> Measure:
    """A counter as the measure of a step."""
    return lambda cost: None if cost.counters is None else counter(cost.counters.total)


def seconds(cost: StepCost) -> float | None:
    return None if cost.measurement is None else cost.measurement.median


@dataclass(frozen=True)
class Split:
    """What is paid once per sort, and what every transfer pays again."""

    per_sort: float
    per_transfer: float


def split(record: Record, measure: Measure) -> Split | None:
    """Preprocessing and transfer in one unit; None where a part of it is not known."""
    once = [cost for name, cost in record.preprocess.items() if name not in PER_TRANSFER_STEPS]
    again = [cost for name, cost in record.preprocess.items() if name in PER_TRANSFER_STEPS]
    again.append(StepCost(record.transfer_counters, record.transfer_measurement))
    parts = [[measure(cost) for cost in costs] for costs in (once, again)]
    if any(part is None for part in parts[0] + parts[1]):
        return None
    return Split(sum(p for p in parts[0] if p is not None), sum(p for p in parts[1] if p is not None))


def break_even(this: Split, baseline: Split) -> float:
    """Transfers per sort from which ``this`` costs less in total than ``baseline``; infinity if never."""
    gain = baseline.per_transfer - this.per_transfer  # per transfer
    debt = this.per_sort - baseline.per_sort  # per sort
    if gain <= 0:
        return 1 if gain == 0 and debt < 0 else math.inf
    return max(1, math.floor(debt / gain) + 1)


def break_even_of(measure: Measure, baseline: Record | None) -> Callable[[Record], float | None]:
    def value(record: Record) -> float | None:
        if baseline is None or record is baseline or record.status != "ok":
            return None
        this, other = split(record, measure), split(baseline, measure)
        return None if this is None or other is None else break_even(this, other)

    return value


# ---- columns -----------------------------------------------------------------------------------------------


_STRATEGY = _Source(Column("strategy", Kind.NAME, Quantity.CODE), lambda r: r.variant)
_AXES = _Source(
    Column(
        "axes changed", Kind.NAME, Quantity.CODE, explain="axes that are not at the strategy's defaults", under=True
    ),
    lambda r: axes_text(changed_axes(r)),
)
_REMARK = _Source(Column("remark", Kind.NAME, Quantity.PROSE), reason)
_AGREEMENT = _Source(
    Column(
        "error / allowance", Kind.CHECKED, Quantity.NUMBER,
        explain="worst error against the float64 reference over the allowed one; up to 1 agrees",
    ),
    lambda r: None if r.check is None else r.check.ratio,
)  # fmt: skip
_MEMORY = _Source(
    Column("device memory", Kind.PREDICTED, Quantity.BYTES, "less", "peak, predicted before the launch"),
    lambda r: r.device_bytes_predicted,
)


def _counted(
    title: str,
    value: Callable[[Record], Any],
    explain: str,
    quantity: Quantity = Quantity.NUMBER,
    better: str | None = "less",
) -> _Source:
    return _Source(Column(title, Kind.SIMULATED, quantity, better, explain), value)


_LANES_PER_VISIT = _counted(
    "lane inst / node visit",
    _per(lambda t: t.lane_inst, lambda r: r.node_visits),
    "lane instructions per pair of particle and node in its support",
)
_WARP_INST = _counted(
    "warp inst / particle", _per(warp_inst, particles), "instructions issued, each once per warp, over particles"
)
_REQUESTS = _counted(
    "requests / particle",
    _per(lambda t: t.gld_req + t.gst_req + t.gatom_req, particles),
    "global memory instructions per warp: loads, stores and atomics",
)
_SECTORS = _counted(
    "sectors / particle", _per(sectors, particles), "distinct 32-byte sectors per global memory request, summed"
)
_BYTES = _counted(
    "bytes / particle",
    _per(lambda t: t.sectors * SECTOR_BYTES, particles),
    "sectors times 32: traffic between SM and L2",
)
_FLOOR = _counted(
    "bytes / floor",
    lambda r: None if _tally(r) is None or not r.floor_bytes else _tally(r).sectors * SECTOR_BYTES / r.floor_bytes,  # type: ignore[union-attr]
    "bytes over the compulsory ones, each particle and each touched node once",
    Quantity.FACTOR,
)
_WAVEFRONTS = _counted(
    "shared wavefronts / particle",
    _per(lambda t: t.shm_wavefronts, particles),
    "passes over the 32 shared memory banks, conflicts included",
)
_GLOBAL_ATOMICS = _counted(
    "global atomics / particle", _per(lambda t: t.gatom_lane, particles), "lanes of global atomic instructions"
)
_GLOBAL_MULTIPLICITY = _counted(
    "global multiplicity",
    _ratio(lambda t: t.gatom_pass, lambda t: t.gatom_sectors),
    "mean over sectors of the most lanes of a warp that add to one word",
)
_SHARED_ATOMICS = _counted(
    "shared atomics / particle", _per(lambda t: t.satom_lane, particles), "lanes of shared atomic instructions"
)
_SHARED_MULTIPLICITY = _counted(
    "shared multiplicity",
    _ratio(lambda t: t.satom_iter, lambda t: t.satom_req),
    "mean over requests of the most lanes of a warp that add to one word",
)
_BARRIERS = _counted(
    "barriers / 1000 particles",
    _per(lambda t: 1000 * t.bar, particles),
    "arrivals of a warp at a barrier of its thread block",
)
_DIVERGENT = _counted(
    "divergent branches",
    _ratio(lambda t: t.div_branch, lambda t: t.branch),
    "share of conditional branches whose lanes part",
    Quantity.SHARE,
)
_LOCAL = _counted(
    "local requests / particle",
    lambda r: _per(lambda t: t.lld_req + t.lst_req, particles)(r) or None,
    "loads and stores of arrays that did not fit in registers",
)


def _rank(records: Sequence[Record], counter: Callable[[Tally], int]) -> Callable[[Record], int | None]:
    """1 is the least; equal counts share a rank."""
    counts = {id(r): counter(t) for r in records if (t := _tally(r)) is not None}
    ordered = sorted(counts.values())

    def value(record: Record) -> int | None:
        mine = counts.get(id(record))
        return None if mine is None else 1 + bisect_left(ordered, mine)

    return value


# ---- tables of a group -------------------------------------------------------------------------------------

WHY_RANKS_DISAGREE = (
    "Ranks are of the transfer alone. "
    "The two ranks disagree where a strategy saves memory traffic by spending instructions (staging nodes in shared "
    "memory, waiting at barriers) or the reverse: which of them binds depends on the GPU, so neither rank is a time."
)


def ranking(g: Group) -> Table:
    """Every run of a simulated group, the ranked ones first; runs without a rank say why."""
    base = g.baseline
    sources = [
        _counted("rank by sectors", _rank(g.ranked, sectors), "1 moves the fewest sectors", Quantity.RANK, None),
        _counted(
            "rank by warp inst", _rank(g.ranked, warp_inst), "1 issues the fewest instructions", Quantity.RANK, None
        ),
        _STRATEGY,
        _AXES,
        _REMARK,
        _AGREEMENT,
        _SECTORS,
        _WARP_INST,
        _counted(
            "break-even, sectors",
            break_even_of(count_of(sectors), base),
            "transfers per sort from which preprocessing has paid for itself",
            Quantity.TRANSFERS,
        ),
        _counted(
            "break-even, warp inst",
            break_even_of(count_of(warp_inst), base),
            "transfers per sort from which preprocessing has paid for itself",
            Quantity.TRANSFERS,
        ),
        _MEMORY,
    ]
    title = f"Ranking by sectors and by warp instructions: simulated, not time. {g.title}"
    return _table(title, sources, g.records, base, (WHY_RANKS_DISAGREE, *baseline_note(base, g)), g.shared)


def counters(g: Group) -> Table:
    """What the transfer itself costs."""
    sources = [
        _STRATEGY, _AXES, _LANES_PER_VISIT, _WARP_INST, _REQUESTS, _SECTORS, _BYTES, _FLOOR, _WAVEFRONTS,
        _GLOBAL_ATOMICS, _GLOBAL_MULTIPLICITY, _SHARED_ATOMICS, _SHARED_MULTIPLICITY, _BARRIERS, _DIVERGENT, _LOCAL,
    ]  # fmt: skip
    return _table(f"Transfer alone, counted: {g.title}", sources, g.ranked, g.baseline, (), g.shared)


def preprocessing(g: Group) -> Table:
    """Preprocessing beside transfer, with totals and the break-even, in the unit that the device gives."""
    base = g.baseline
    sources = [_STRATEGY, _AXES]
    measures: tuple[tuple[str, Measure, bool], ...]
    if g.simulated:
        kind, quantity = Kind.SIMULATED, Quantity.NUMBER
        measures = (("sectors", count_of(sectors), True), ("warp inst", count_of(warp_inst), True))
    else:
        kind, quantity = g.kind, Quantity.SECONDS
        measures = (("time", seconds, False),)
    for name, measure, per_particle in measures:
        unit = " / particle" if per_particle else ""
        parts = (
            ("per sort", lambda s: s.per_sort, "preprocessing done once per sort"),
            (
                "per transfer",
                lambda s: s.per_transfer,
                "the transfer, and clearing or dividing the grid before it",
            ),
            ("total", lambda s: s.per_sort + s.per_transfer, "a sort and one transfer"),
        )
        for part, pick, explain in parts:
            sources.append(
                _Source(
                    Column(f"{name} {part}{unit}", kind, quantity, "less", explain),
                    _of_split(measure, pick, per_particle),
                )
            )
        sources.append(
            _Source(
                Column(
                    f"break-even, {name}", kind, Quantity.TRANSFERS, "less",
                    "transfers per sort from which preprocessing has paid for itself",
                ),
                break_even_of(measure, base),
            )
        )  # fmt: skip
    return _table(
        f"Preprocessing beside transfer: {g.title}", sources, g.ranked, base, baseline_note(base, g), g.shared
    )


def _of_split(measure: Measure, pick: Callable[[Split], float], per_particle: bool) -> Callable[[Record], float | None]:
    def value(record: Record) -> float | None:
        parts = split(record, measure)
        if parts is None:
            return None
        return pick(parts) / (particles(record) or 1 if per_particle else 1)

    return value


def baseline_note(base: Record | None, g: Group) -> tuple[str, ...]:
    if base is not None:
        order = base.axes.get("particle_order")
        return (f"Baseline: {g.label(base)}{', particles in the order given' if order == 'given' else ''}.",)
    if g.paired:
        return (f"No break-even: the baseline {g.baseline_name} has no row here.",)
    name = BASELINES.get(g.first.transfer)
    return (f"No break-even: {name} with particle_order=given did not run on this dataset.",) if name else ()


def steps(g: Group) -> list[Table]:
    """Each preprocessing and finishing step on its own: a table per measure, a column per step."""
    records = [r for r in g.ranked if r.steps]
    names = list(dict.fromkeys(name for r in records for name in r.steps))
    if not names:
        return []
    measures: tuple[tuple[str, Measure, Kind, Quantity, bool], ...]
    if g.simulated:
        measures = (
            ("sectors / particle", count_of(sectors), Kind.SIMULATED, Quantity.NUMBER, True),
            ("warp inst / particle", count_of(warp_inst), Kind.SIMULATED, Quantity.NUMBER, True),
        )
    else:
        measures = (("time", seconds, g.kind, Quantity.SECONDS, False),)
    return [
        _table(
            f"Steps around the transfer, {title}: {g.title}",
            [
                _STRATEGY,
                _AXES,
                *(_Source(Column(n, kind, quantity), _of_step(n, measure, per_particle)) for n in names),
            ],
            records,
            g.baseline,
            (),
            g.shared,
        )
        for title, measure, kind, quantity, per_particle in measures
    ]


def _of_step(name: str, measure: Measure, per_particle: bool) -> Callable[[Record], float | None]:
    def value(record: Record) -> float | None:
        cost = record.steps.get(name)
        number = None if cost is None else measure(cost)
        return None if number is None else number / (particles(record) or 1 if per_particle else 1)

    return value


def transfer_cost(record: Record) -> StepCost:
    return StepCost(record.transfer_counters, record.transfer_measurement)


# ---- hottest lines -----------------------------------------------------------------------------------------


def hottest_lines(record: Record, name: str, count: int = HOTTEST_LINES) -> Table | None:
    """The source lines that cost most: the first few by warp instructions and the first few by sectors."""
    if record.transfer_counters is None or not record.transfer_counters.lines:
        return None
    lines, total = record.transfer_counters.lines, record.transfer_counters.total

    def top(counter: Callable[[Tally], int]) -> list[SourceLine]:
        costly = [line for line, tally in lines.items() if counter(tally)]
        return sorted(costly, key=lambda line: (-counter(lines[line]), line))[:count]

    chosen = dict.fromkeys(top(warp_inst) + top(sectors))
    shown = sorted(chosen, key=lambda line: (-lines[line].warp_inst, line))
    n = particles(record) or 1
    columns = (
        Column("line", Kind.NAME, Quantity.CODE),
        Column("warp inst / particle", Kind.SIMULATED, Quantity.NUMBER),
        Column("share of warp inst", Kind.SIMULATED, Quantity.SHARE, "more"),
        Column("sectors / particle", Kind.SIMULATED, Quantity.NUMBER),
        Column("share of sectors", Kind.SIMULATED, Quantity.SHARE, "more"),
        Column("source", Kind.NAME, Quantity.CODE),  # last: it is as long as its author liked
    )
    rows = []
    for line in shown:
        tally = lines[line]
        values = (
            f"{line.file.rsplit('/', 1)[-1]}:{line.line}",
            tally.warp_inst / n,
            tally.warp_inst / total.warp_inst if total.warp_inst else None,
            tally.sectors / n,
            tally.sectors / total.sectors if total.sectors else None,
            record.line_texts.get(line, ""),
        )
        rows.append(Row(tuple(Cell(v, c.kind) for v, c in zip(values, columns, strict=True))))
    return Table(f"Hottest lines: {name}", columns, tuple(rows))


# ---- across groups -----------------------------------------------------------------------------------------


# What names a group stands around the winners: on a narrow screen only the first columns are in sight.
BEFORE = (Column("transfer", Kind.NAME, Quantity.TEXT), Column("dataset", Kind.NAME, Quantity.CODE))
AFTER = (Column("particles", Kind.NAME, Quantity.COUNT), Column("problem", Kind.NAME, Quantity.TEXT))


def before(g: Group) -> list[Any]:
    return [g.first.transfer.upper(), dataset_name(g.first.dataset)]


def after(g: Group) -> list[Any]:
    return [g.first.dataset.n, problem_text(g.first)]


def _row(values: Sequence[Any], columns: Sequence[Column], **options: Any) -> Row:
    return Row(tuple(Cell(v, c.kind) for v, c in zip(values, columns, strict=True)), **options)


def summary(groups: Sequence[Group]) -> Table:
    """One row per simulated group: who wins, and by how much."""
    by: tuple[tuple[str, Callable[[Tally], int]], ...] = (("sectors", sectors), ("warp instructions", warp_inst))
    columns = list(BEFORE)
    for name, _ in by:
        columns += [
            Column(f"fewest {name}", Kind.SIMULATED, Quantity.CODE),
            Column(f"{name} / particle", Kind.SIMULATED, Quantity.NUMBER),
            Column(f"{name}, baseline / this", Kind.SIMULATED, Quantity.FACTOR),
        ]
    columns += AFTER
    several = len({g.first.arch for g in groups}) > 1
    columns += [Column("compiled for", Kind.NAME, Quantity.TEXT)] * several
    rows = []
    for g in groups:
        values = before(g)
        for _, counter in by:
            best = min(g.ranked, key=lambda r: counter(r.transfer_counters.total))  # type: ignore[union-attr]
            count = counter(best.transfer_counters.total)  # type: ignore[union-attr]
            base = g.baseline and counter(g.baseline.transfer_counters.total)  # type: ignore[union-attr]
            values += [g.label(best), count / (particles(best) or 1), base / count if base and count else None]
        rows.append(_row(values + after(g) + [g.first.arch] * several, columns))
    return Table("Fewest sectors and fewest warp instructions: simulated, not time", tuple(columns), tuple(rows))


def agreement(records: Sequence[Record]) -> Table:
    """Every variant against the float64 reference, over all its runs."""
    columns: tuple[Column, ...] = (
        Column("strategy", Kind.NAME, Quantity.CODE),
        Column("idea", Kind.NAME, Quantity.PROSE),
        Column("runs that agree", Kind.CHECKED, Quantity.COUNT),
        Column("runs checked", Kind.CHECKED, Quantity.COUNT),
        Column("worst error / allowance", Kind.CHECKED, Quantity.NUMBER),
        Column(
            "run to run", Kind.CHECKED, Quantity.PROSE,
            explain="two runs on the same input, bit by bit; differences relative to the largest number of all",
        ),
    )  # fmt: skip
    rows = []
    for name in dict.fromkeys(r.variant for r in records):
        runs = [r for r in records if r.variant == name]
        checks = [r.check for r in runs if r.check is not None]
        passed = sum(c.passed for c in checks)
        worst = max((c.ratio for c in checks), default=None)
        values = [name, runs[0].variant_summary, passed, len(checks), worst, repeat_text(runs)]
        rows.append(_row(values, columns, status="ok" if passed == len(checks) else "wrong"))
    if not any(row.cells[-1].value for row in rows):  # nothing was run twice
        columns, rows = columns[:-1], [replace(row, cells=row.cells[:-1]) for row in rows]
    return Table("Agreement with the float64 reference", columns, tuple(rows))


def repeat_text(runs: Sequence[Record]) -> str:
    """How two runs on the same input differ, of the run where they differ most."""
    repeats = [r.repeat for r in runs if r.repeat is not None]
    if not repeats:
        return ""
    worst = max(repeats, key=lambda repeat: (repeat.largest, repeat.differing))
    if not worst.differing:
        return f"the same bits in all {worst.of:,} numbers"
    return f"{worst.differing:,} of {worst.of:,} numbers differ in bits, at most {worst.largest:.1e}"


def skipped(records: Sequence[Record]) -> Table | None:
    """Every run without a rank, with its reason."""
    left = [r for r in records if r.status != "ok"]
    if not left:
        return None
    where = _Source(Column("dataset", Kind.NAME, Quantity.CODE), lambda r: dataset_name(r.dataset))
    problem = _Source(
        Column("problem", Kind.NAME, Quantity.TEXT),
        problem_text,
    )
    return _table("Runs without a rank", [_STRATEGY, _AXES, where, problem, _AGREEMENT, _REMARK], left)


def findings(records: Sequence[Record]) -> Table | None:
    """Defects that the engine saw."""
    columns = (
        Column("strategy", Kind.NAME, Quantity.CODE),
        Column("dataset", Kind.NAME, Quantity.CODE),
        Column("finding", Kind.NAME, Quantity.TEXT),
        Column("kernel", Kind.NAME, Quantity.CODE),
        Column("line", Kind.NAME, Quantity.CODE),
        Column("times", Kind.SIMULATED, Quantity.COUNT),
        Column("what", Kind.NAME, Quantity.PROSE),
    )
    rows = []
    for record in records:
        for f in record.findings:
            places = [f"{at.file.rsplit('/', 1)[-1]}:{at.line}" for at in (f.line, f.other_line) if at]
            line = " and ".join(dict.fromkeys(places))
            values = [label(record), dataset_name(record.dataset), f.kind, f.kernel, line, f.count, f.message]
            rows.append(_row(values, columns, status="findings"))
    return Table("Findings of the engine", columns, tuple(rows)) if rows else None


def kernels(records: Sequence[Record]) -> Table | None:
    """Registers, shared memory and spills as ``ptxas`` reports them."""
    columns = (
        Column("kernel", Kind.NAME, Quantity.CODE),
        Column("arch", Kind.NAME, Quantity.TEXT),
        Column("registers / thread", Kind.PREDICTED, Quantity.COUNT),
        Column("shared / thread block", Kind.PREDICTED, Quantity.BYTES),
        Column("stack / thread", Kind.PREDICTED, Quantity.BYTES),
        Column("spills / thread", Kind.PREDICTED, Quantity.BYTES),
        Column("source sha256", Kind.NAME, Quantity.CODE),
    )
    rows: dict[tuple[Any, ...], Row] = {}
    for record in records:
        for name, info in record.kernel_info.items():
            facts = [info.get(key) for key in ("registers", "shared_bytes", "local_bytes", "spill_bytes")]
            if any(fact is not None for fact in facts):
                values = (name, info.get("arch", record.arch), *facts, record.hashes.get(name, "")[:12])
                rows[values] = _row(values, columns)
    return Table("Kernels as compiled by ptxas", columns, tuple(rows.values())) if rows else None


def datasets(records: Sequence[Record]) -> Table | None:
    """Density and order of every dataset: one row each, a column per statistic that is one number."""
    seen = {r.dataset.fingerprint: r.dataset for r in records}
    if not seen:
        return None
    names = list(
        dict.fromkeys(
            name
            for d in seen.values()
            for name, value in d.statistics.items()
            if isinstance(value, int | float | str) or value is None
        )
    )
    columns = (
        Column("dataset", Kind.NAME, Quantity.CODE),
        Column("particles", Kind.NAME, Quantity.COUNT),
        Column("grid", Kind.NAME, Quantity.TEXT),
        Column("seed", Kind.NAME, Quantity.TEXT),
        *(Column(name.replace("_", " "), Kind.NAME, Quantity.NUMBER) for name in names),
        Column("fingerprint", Kind.NAME, Quantity.CODE),
    )
    rows = [
        _row(
            [
                dataset_name(d),
                d.n,
                axis_text(d.grid.shape),
                d.seed,
                *(d.statistics.get(n) for n in names),
                d.fingerprint[:12],
            ],
            columns,
        )
        for d in seen.values()
    ]
    return Table("Datasets: density and order", columns, tuple(rows))


def distributions(records: Sequence[Record]) -> list[Table]:
    """Statistics that are a count per class (particles per cell, say): a table each, a column per class."""
    seen = {r.dataset.fingerprint: r.dataset for r in records}
    names = dict.fromkeys(n for d in seen.values() for n, v in d.statistics.items() if isinstance(v, Mapping))
    found = []
    for name in names:
        held = [(d, d.statistics[name]) for d in seen.values() if isinstance(d.statistics.get(name), Mapping)]
        classes = list(dict.fromkeys(key for _, counts in held for key in counts))
        columns = (
            Column("dataset", Kind.NAME, Quantity.CODE),
            *(Column(key, Kind.NAME, Quantity.COUNT) for key in classes),
        )
        rows = [_row([dataset_name(d), *(counts.get(key) for key in classes)], columns) for d, counts in held]
        title = DISTRIBUTION_TITLES.get(name, name.replace("_", " "))
        found.append(Table(title, columns, tuple(rows)))
    return found


# ---- published tables --------------------------------------------------------------------------------------


def presets(records: Sequence[Record]) -> list[Table]:
    """One table per published table: its printed numbers beside ours, in columns of their own."""
    found: dict[tuple[str, Any, str, str], list[Record]] = {}
    for r in records:
        if r.preset_row:
            known = r.transfer_measurement.mode if r.transfer_measurement else r.cache
            modes = [known] if known else _modes(records, r.device)
            for mode in modes:
                found.setdefault((str(_preset(r, "source")), _preset(r, "table"), r.device, mode), []).append(r)
    # Records come in the order run; tables and rows are wanted in the order printed.
    return [
        _published(sorted(rows, key=lambda r: _preset(r, "place") or 0))
        for _, rows in sorted(found.items(), key=lambda item: (item[0][0], f"{item[0][1]!s:>9}", *item[0][2:]))
    ]


def _modes(records: Sequence[Record], device: str) -> list[str]:
    """States of the caches in which published rows were timed on a device."""
    times = [r.transfer_measurement for r in records if r.preset_row and r.device == device]
    return list(dict.fromkeys(time.mode for time in times if time)) or [""]


def _preset(record: Record, key: str) -> Any:
    return (record.preset_row or {}).get(key)


def _other_printed(name: str) -> Callable[[Record], Any]:
    return lambda record: (_preset(record, "published") or {}).get(name)


def _per_unit(source: _Source, records: Sequence[Record]) -> _Source:
    """The same column, named by what the rows process: transfers particles, primitives elements."""
    if all(r.transfer in ("p2g", "g2p") for r in records):
        return source
    return replace(source, column=replace(source.column, title=source.column.title.replace("particle", "element")))


def _published(records: list[Record]) -> Table:
    """Rows in printed order. A row printed without a speedup is the baseline of those after it."""
    speedups_printed = any(_preset(r, "published_speedup") is not None for r in records)
    baselines: dict[int, Record] = {}
    base: Record | None = None
    for record in records:
        if _preset(record, "published_speedup") is None and speedups_printed:
            base = record
        elif base is not None:
            baselines[id(record)] = base

    def against(measure: Measure) -> Callable[[Record], float | None]:
        def value(record: Record) -> float | None:
            other = baselines.get(id(record))
            mine = measure(transfer_cost(record))
            theirs = other and measure(transfer_cost(other))
            return theirs / mine if theirs and mine else None

        return value

    def published(title: str, value: Callable[[Record], Any]) -> _Source:
        return _Source(Column(title, Kind.PUBLISHED, Quantity.PRINTED, explain="as printed"), value)

    others = dict.fromkeys(name for r in records for name in _preset(r, "published") or ())

    def ours(title: str, kind: Kind, value: Callable[[Record], Any], quantity: Quantity, explain: str) -> _Source:
        return _Source(Column(title, kind, quantity, explain=explain), value)

    # A simulated table has no times: these columns stay empty there and are left out.
    time_kind = Kind.WALL if cost_kind(records[0]) is Kind.WALL else Kind.MEASURED
    several = len({r.dataset.fingerprint for r in records}) > 1
    where = _Source(Column("dataset", Kind.NAME, Quantity.CODE), lambda r: dataset_name(r.dataset) if several else "")
    row = _Source(Column("row as printed", Kind.NAME, Quantity.PROSE), lambda r: str(_preset(r, "row")))
    sources = [
        row, where, _STRATEGY, _AXES, _REMARK,
        published("time [µs]", lambda r: _preset(r, "published_us")),
        published("speedup", lambda r: _preset(r, "published_speedup")),
        _AGREEMENT, *(_per_unit(source, records) for source in (_SECTORS, _WARP_INST)),
        ours("sectors, baseline / this", Kind.SIMULATED, against(count_of(sectors)), Quantity.FACTOR,
             "sectors of the printed table's baseline over this row's; not a speedup"),
        ours("warp inst, baseline / this", Kind.SIMULATED, against(count_of(warp_inst)), Quantity.FACTOR,
             "warp instructions of the printed table's baseline over this row's; not a speedup"),
        ours("transfer", time_kind, lambda r: seconds(transfer_cost(r)), Quantity.SECONDS, "median time here"),
        ours("speedup here", time_kind, against(seconds), Quantity.FACTOR,
             "time of the printed table's baseline over this row's, both measured here"),
        *(published(name.replace("_", " ").replace(" percent", " [%]"), _other_printed(name)) for name in others),
    ]  # fmt: skip
    errata = [f"{_preset(r, 'row')}: {erratum}" for r in records if (erratum := _preset(r, "erratum"))]
    source = str(_preset(records[0], "source") or "published").capitalize()
    modes = dict.fromkeys(cache_text(r.transfer_measurement.mode) for r in records if r.transfer_measurement)
    name = f"{records[0].transfer.upper()} on {records[0].dataset.name}"
    return _table(
        f"{source}, table {_preset(records[0], 'table')}: {', '.join([name, *modes])}",
        sources, records, None, [f"Erratum. {text}" for text in dict.fromkeys(errata)],
    )  # fmt: skip
