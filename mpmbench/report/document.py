"""Records -> what a report says, in the order it says it; Markdown and HTML only spell it.

The answer first, then what needs attention, then the tables and charts it rests on, then where it was made.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import pairwise

from mpmbench.errors import InputError
from mpmbench.record import Record
from mpmbench.report import (
    answer,
    banks,
    density,
    distributions,
    measured,
    modelled,
    primitives,
    profile,
    searches,
    winners,
)
from mpmbench.report import table as tables
from mpmbench.report.chart_data import Chart
from mpmbench.report.doubts import NAMED, doubts, throttled, throttled_action
from mpmbench.report.modelled import GpuGroup
from mpmbench.report.plots import MOST_BARS, Bars, Line, Lines, first_of, thin
from mpmbench.report.profile import Card
from mpmbench.report.table import Group, Kind, Table
from mpmbench.report.text import number

MOST_VALUES = 12  # of one fact about the environment

KINDS = {
    Kind.CHECKED: "compared with the float64 reference, or one run with another of the same",
    Kind.PREDICTED: "follows from sizes or from the compiler, known before anything runs",
    Kind.SIMULATED: "counted exactly while the CUDA kernel ran on the simulated device; not time",
    Kind.MEASURED: "event time on a GPU",
    Kind.WALL: "time of runs on a CPU: comparable among themselves, and with no event time",
    Kind.MODELLED: "performance model of a named GPU, its caches and DRAM included; never measured",
    Kind.PUBLISHED: "printed in the source named, on its GPU",
}


@dataclass(frozen=True)
class Attention:
    """Something to know before believing the tables. level: "wrong", "warning" or "note"."""

    level: str
    text: str
    action: str


@dataclass(frozen=True)
class Details:
    """Tables that are folded away."""

    summary: str
    tables: tuple[Table, ...]


@dataclass(frozen=True)
class Section:
    title: str
    tables: tuple[Table, ...] = ()
    charts: tuple[Chart, ...] = ()
    details: tuple[Details, ...] = ()
    intro: str = ""
    cards: tuple[Card, ...] = ()


@dataclass(frozen=True)
class Document:
    title: str
    verdict: str  # one sentence
    agreed: bool
    answer: tuple[str, ...]  # more sentences
    attention: tuple[Attention, ...]
    sections: tuple[Section, ...]
    legend: tuple[tuple[str, str, str], ...]  # column, kind, explanation
    environment: tuple[tuple[str, str], ...]
    left_out: tuple[str, ...] = field(default=())


@dataclass(frozen=True)
class Extent:
    """How much a document holds.

    searches: every configuration that a search tried.
    charts: how many groups get them; drawing takes time.  rows: of a table, the best ones.  groups: how many get a
    section, in the order run; the summary still has all.  cards: how many strategies get a profile of their own, of
    all GPUs together; the tables still have all.
    """

    hottest: bool = True
    searches: bool = True
    steps: bool = True
    charts: int = 24
    rows: int | None = None
    groups: int | None = None
    cards: int = 24


# From everything to what always fits.
EXTENTS = (
    Extent(),
    Extent(hottest=False),
    Extent(hottest=False, searches=False),
    Extent(hottest=False, searches=False, steps=False, cards=12),
    Extent(hottest=False, searches=False, steps=False, charts=6, cards=6),
    Extent(hottest=False, searches=False, steps=False, charts=0, cards=6),
    Extent(hottest=False, searches=False, steps=False, charts=0, rows=200, groups=100, cards=0),
    Extent(hottest=False, searches=False, steps=False, charts=0, rows=40, groups=40, cards=0),
    Extent(hottest=False, searches=False, steps=False, charts=0, rows=10, groups=10, cards=0),
)


def build(records: Sequence[Record], extent: Extent = EXTENTS[0]) -> Document:
    """What a report of these records says."""
    if not records:
        raise InputError("no records to report: run something first")
    records = list(records)
    transfers = [record for record in records if record.is_transfer]
    groups = tables.group(transfers)
    on_gpus = modelled.gpu_groups(records)
    on_gpus_transfers = [g for g in on_gpus if g.group.first.is_transfer][: extent.groups]
    sections = [_on_my_gpu(on_gpus_transfers)] if on_gpus_transfers else []
    profiles = _profiles(on_gpus[: extent.groups], extent)
    sections += profiles
    if any(g.ranked for g in groups):
        counted = [g for g in groups if g.simulated and g.ranked]
        shown = [*winners.tables_of(groups), *([tables.summary(counted)] if counted else [])]
        sections.append(Section("Answer in one table", tuple(shown)))
    if densities := density.charts(groups):
        charts = tuple(chart for chart, _ in densities[: extent.charts])
        shown = [table for _, table in densities]
        sections.append(Section("Strategy against density", tuple(shown), charts, intro=density.EXPLANATION))
    if published := tables.presets(records):
        sections.append(Section("Published tables, and the same rows here", tuple(published)))
    several_devices = len({g.device for g in groups}) > 1
    sections += [
        _group_section(g, extent, charted=i < extent.charts, name_device=several_devices)
        for i, g in enumerate(groups[: extent.groups])
    ]
    if found_patterns := banks.patterns([r for r in transfers if r.device != "cpu"]):
        pictures = tuple(map(banks.picture, found_patterns[:4])) if extent.charts else ()
        title = "Shared-memory banks of the block kernels"
        sections.append(Section(title, (banks.table(found_patterns),), pictures, intro=banks.EXPLANATION))
    sections += [Section(name, (primitives.table(rows),)) for name, rows in primitives.groups(records).items()]
    sections.append(Section("Agreement with the float64 reference", (_untitled(tables.agreement(records)),)))
    for title, found in (
        ("Runs without a rank", tables.skipped(records)),
        ("Findings of the engine", tables.findings(records)),
        ("Datasets: density and order", tables.datasets(transfers)),
        ("Kernels as compiled", tables.kernels(records)),
    ):
        if found:
            more = tables.distributions(transfers) if title.startswith("Datasets") else []
            sections.append(Section(title, (_untitled(found), *more)))
    if extent.rows is not None:
        sections = [replace(s, tables=tuple(_shortened(t, extent.rows) for t in s.tables)) for s in sections]
    parts = {"hottest lines": extent.hottest, "searches": extent.searches, "single steps": extent.steps}
    left_out = [name for name, shown in parts.items() if not shown]
    if extent.charts < len(groups):
        left_out.append(f"charts of {_plural(len(groups) - extent.charts, 'section')}")
    if extent.groups is not None and len(groups) > extent.groups:
        left_out.append(_plural(len(groups) - extent.groups, "section"))
    plain = sum(len(g.runs) for g in on_gpus) - sum(card.detailed for s in profiles for card in s.cards)
    if plain:
        left_out.append(f"charts and lines of {_plural(plain, 'profile')}")
    verdict, agreed = _verdict(records)
    return Document(
        title="mpmbench report",
        verdict=verdict,
        agreed=agreed,
        answer=tuple(_answer(groups, on_gpus, {tables.cost_kind(record) for record in records})),
        attention=tuple(_attention(records, groups)),
        sections=tuple(sections),
        legend=_legend(sections),
        environment=_environment(records),
        left_out=tuple(left_out),
    )


def _shortened(table: Table, most_rows: int) -> Table:
    more = len(table.rows) - most_rows
    if more <= 0:
        return table
    note = f"{more} more rows are left out; the records hold them."
    return replace(table, rows=table.rows[:most_rows], notes=(*table.notes, note))


def _untitled(table: Table) -> Table:
    return replace(table, title="")


# ---- the answer --------------------------------------------------------------------------------------------


def _verdict(records: Sequence[Record]) -> tuple[str, bool]:
    slowed = [r for r in records if throttled(r)]
    ran = [r for r in records if r.status != "skipped" and not throttled(r)]
    wrong = [r for r in ran if r.status != "ok"]
    lost = f" {_plural(len(slowed), 'run')} lost the time to a processor that slowed down." if slowed else ""
    strategies = _names(ran)
    sets = _plural(len({r.dataset.fingerprint for r in ran}), "dataset")
    if not ran:
        if skipped := len(records) - len(slowed):
            return f"Nothing ran: {_plural(skipped, 'run')} skipped.{lost}", False
        return f"Nothing was timed.{lost}", False
    if not wrong:
        worst = max(r.check.ratio for r in ran if r.check)
        every = "All" if len(strategies) > 1 else "The"
        return (
            f"{every} {_plural(len(strategies), 'strategy', 'strategies')} "
            f"agree{'' if len(strategies) > 1 else 's'} with the float64 reference "
            f"({_plural(len(ran), 'run')} on {sets}, worst error {number(worst)} of the allowance).{lost}",
            True,
        )
    bad = _names(wrong)
    return (
        f"{_plural(len(wrong), 'run')} of {len(ran)} cannot be trusted: "
        f"{', '.join(bad[:6])}{' and more' if len(bad) > 6 else ''}. "
        f"{'The others agree with the float64 reference.' if len(wrong) < len(ran) else 'No other ran.'}{lost}",
        False,
    )


def _names(records: Sequence[Record]) -> list[str]:
    return list(dict.fromkeys(r.variant for r in records))


def _plural(count: int, one: str, many: str = "") -> str:
    return f"{count:,} {one if count == 1 else many or one + 's'}"


def _answer(groups: Sequence[Group], on_gpus: Sequence[GpuGroup], kinds: set[Kind]) -> list[str]:
    sentences = []
    timed = _in_turn([g for g in groups if not g.simulated])
    transfers = [g for g in on_gpus if g.group.first.is_transfer]
    if kinds == {Kind.SIMULATED} and on_gpus:
        sentences.append(
            "No GPU took part: costs are counted on a simulated device, and every time below is modelled for the GPU "
            "that it names, with a range."
        )
    elif kinds == {Kind.SIMULATED}:
        sentences.append(
            "No GPU took part: every cost below is counted on a simulated device, exactly, and is not time. "
            "Run the same command where there is a GPU for times and speedups, or with --gpu h100,a100,gtx970 for "
            "times modelled for GPUs that you name."
        )
    elif Kind.MEASURED not in kinds:
        sentences.append("No GPU took part: times are wall clock on a CPU, and say nothing about a GPU.")
    sentences += [answer.sentence(g) for g in timed[:NAMED]]
    if len(timed) > NAMED:
        sentences.append(f"The table below has {_plural(len(timed) - NAMED, 'more measured case')}.")
    sentences += [modelled.answer(g) for g in transfers[:NAMED]]
    if len(transfers) > NAMED:
        sentences.append(f"The table below has {_plural(len(transfers) - NAMED, 'more modelled case')}.")
    for transfer in ("p2g", "g2p"):
        counted = [g for g in groups if g.simulated and len(g.ranked) > 1 and g.first.transfer == transfer]
        for name, counter in (("sectors", tables.sectors), ("warp instructions", tables.warp_inst)):
            winners: dict[str, int] = {}
            for g in counted:
                best = min(g.ranked, key=lambda r: counter(r.transfer_counters.total))  # type: ignore[union-attr]
                winners[best.variant] = winners.get(best.variant, 0) + 1
            if winners:
                who = ", ".join(
                    f"{variant} ({count} of {len(counted)})" if len(counted) > 1 else variant
                    for variant, count in sorted(winners.items(), key=lambda item: -item[1])
                )
                sentences.append(f"{transfer.upper()}, simulated, not time: fewest {name}: {who}.")
    return sentences


def _in_turn(groups: Sequence[Group]) -> list[Group]:
    """GPUs before CPUs; the first of each device, transfer and state of the caches before the second of any: those that
    are spelt out shall not be one and the same."""
    turns: dict[tuple[str, str, str, str], int] = {}
    ordered = []
    for g in groups:
        alike = (g.device, g.first.device, g.first.transfer, g.caches)
        ordered.append((turns.setdefault(alike, 0), g.kind is Kind.WALL, g))
        turns[alike] += 1
    return [g for _, _, g in sorted(ordered, key=lambda entry: entry[:2])]


# ---- what needs attention ----------------------------------------------------------------------------------


def _attention(records: Sequence[Record], groups: Sequence[Group]) -> list[Attention]:
    """The same trouble in many runs is one entry that names the first few of them."""
    found: dict[tuple[str, str, str], list[str]] = {}

    def note(level: str, trouble: str, action: str, where: str = "") -> None:
        found.setdefault((level, trouble, action), []).append(where)

    for r in records:
        where = f"{tables.label(r)} on {tables.dataset_name(r.dataset)}"
        if r.status == "wrong":
            again = f"`mpmbench check -b {r.variant}` on the same data (with `--debug` for races)"
            action = f"Do not use it; {again} says where it differs most."
            note("wrong", f"Wrong result of {r.variant}", action, f"{where}, {tables.error_text(r)}")
        elif r.status == "findings":
            action = "Its result cannot be relied on; the findings below name the lines."
            note("wrong", f"Refused, {tables.finding_text(r)}", action, where)
        elif throttled(r):
            note("warning", tables.reason(r), throttled_action(r), where)
        elif r.status == "broken":
            note("wrong", tables.reason(r), "It has no result and no rank.", where)
        elif r.status == "unchecked":
            note("warning", "Not checked", "Run it with the check on: only checked runs are ranked.", where)
        elif r.status == "skipped":
            note("note", tables.reason(r), "No error: choose other axes or a smaller dataset to run it.", where)
        for kernel, info in r.kernel_info.items():
            if info.get("spill_bytes"):
                trouble = f"Kernel {kernel} spills {info['spill_bytes']} bytes of registers per thread to local memory"
                note("warning", trouble, "A smaller block or less batching needs fewer registers.", where)
    for doubt in doubts(groups):
        note(doubt.level, doubt.trouble, doubt.action, doubt.where)
    for g in groups:
        if g.ranked and g.baseline is None and len(g.ranked) > 1 and not g.paired:
            action = f"Add {tables.BASELINES.get(g.first.transfer)} with particle_order=given."
            note("note", "No break-even and no speedup, the baseline did not run", action, g.title)
    if any(r.environment.git_dirty for r in records):
        action = "Commit them and run again before publishing numbers."
        note("note", "The code had changes that are in no commit", action)
    entries = [
        Attention(level, trouble[0].upper() + trouble[1:] + _where(places), action)
        for (level, trouble, action), places in found.items()
    ]
    order = {"wrong": 0, "warning": 1, "note": 2}
    return sorted(entries, key=lambda a: order[a.level])


def _where(places: list[str]) -> str:
    named = [place for place in dict.fromkeys(places) if place]
    if not named:
        return "."
    more = f"; and {len(named) - NAMED} more" if len(named) > NAMED else ""
    return f": {'; '.join(named[:NAMED])}{more}."


# ---- modelled ----------------------------------------------------------------------------------------------

RANKINGS_IN_SIGHT = 2  # more of them are folded away


def _on_my_gpu(groups: Sequence[GpuGroup]) -> Section:
    """Who wins on which GPU, and every ranking."""
    rankings = [modelled.ranking(g) for g in groups]
    in_sight = len(rankings) <= RANKINGS_IN_SIGHT
    problems = list(dict.fromkeys(g.problem for g in groups))
    return Section(
        title="What would it do on my GPU?",
        tables=(modelled.winners_table(groups), *(rankings if in_sight else ())),
        details=() if in_sight else tuple(Details(t.title, (_untitled(t),)) for t in rankings),
        intro=(f"{problems[0]}. " if len(problems) == 1 else "") + modelled.EXPLANATION,
    )


def _profiles(groups: Sequence[GpuGroup], extent: Extent) -> list[Section]:
    """What binds each strategy on each GPU. Charts go to the fastest of every group alike."""
    each, more = divmod(extent.cards, len(groups)) if groups else (0, 0)
    sections = []
    for i, g in enumerate(groups):
        charted = each + (i < more)
        cards = tuple(profile.card(g, r, detailed=place < charted) for place, r in enumerate(g.runs[: extent.rows]))
        shown = tuple(table for table in (profile.overview(g), profile.metrics(g), profile.traffic(g)) if table)
        intro = f"{g.problem}. {profile.EXPLANATION.format(gpu=g.gpu_title)}"
        sections.append(Section(f"Profile: {g.title}", shown, intro=intro, cards=cards))
    return sections


# ---- groups ------------------------------------------------------------------------------------------------


def _group_section(g: Group, extent: Extent, charted: bool, name_device: bool) -> Section:
    details = []
    shown = [tables.ranking(g) if g.simulated else measured.ranking(g)]
    charts: list[Chart] = []
    if len(g.ranked) > 1 and charted:
        charts += _bars(g) + _break_even_lines(g)
    if not g.simulated and charted and (strips := distributions.chart(g)):
        charts.insert(1, strips)
    if g.ranked:
        if g.simulated:
            shown.append(tables.counters(g))
        if step := measured.whole_step(g):
            shown.append(step)
        shown.append(tables.preprocessing(g))
    shown = [replace(t, title=t.title.replace(f". {g.title}", "").replace(f": {g.title}", "")) for t in shown]
    if extent.steps and (found := tables.steps(g)):
        found = [replace(t, title=t.title.replace(f": {g.title}", "")) for t in found]
        details.append(Details("Each step around the transfer on its own", tuple(found)))
    if extent.searches and (tried := searches.found(g)):
        searched = _plural(len(tried), "strategy was", "strategies were")
        details.append(Details(f"How axes were chosen: {searched} searched, losers included", tuple(tried)))
    if extent.hottest and g.simulated:
        hottest = [t for r in g.ranked if (t := tables.hottest_lines(r, g.label(r)))]
        if hottest:
            summary = "Hottest source lines of each strategy: simulated, not time"
            details.append(Details(summary, tuple(hottest)))
    intro = f"{g.device[0].upper()}{g.device[1:]}."
    if g.shared:
        intro += f" All runs: {tables.axes_text(g.shared)}."
    where = (f"simulated {g.first.arch}" if g.simulated else g.device) if name_device else ""
    title = ", ".join(filter(None, [g.title, where]))
    return Section(title, tuple(shown), tuple(charts), tuple(details), intro)


_BAR_MEASURES = (
    ("Sectors", "32-byte sectors per particle, transfer alone: simulated, not time", tables.count_of(tables.sectors)),
    (
        "Warp instructions",
        "warp instructions per particle, transfer alone: simulated, not time",
        tables.count_of(tables.warp_inst),
    ),
)


def _bars(g: Group) -> list[Chart]:
    if not g.simulated:
        measures = (("Transfer time", f"median transfer time [µs], {_clock(g)}", tables.seconds, 1e6),)
    else:
        measures = tuple((*m, 1 / (tables.particles(g.first) or 1)) for m in _BAR_MEASURES)  # type: ignore[assignment]
    charts: list[Chart] = []
    for title, axis, measure, scale in measures:
        costs = [(r, measure(tables.transfer_cost(r))) for r in g.ranked]
        known = sorted(((r, c * scale) for r, c in costs if c is not None), key=lambda pair: pair[1])
        if known:
            baseline = next((i for i, (r, _) in enumerate(known) if r is g.baseline), None)
            labels = tuple(g.label(r) + (" (baseline)" if r is g.baseline else "") for r, _ in known)
            axis += first_of(len(known), MOST_BARS)
            charts.append(Bars(title, axis, labels, tuple(c for _, c in known), baseline, g.kind))
    return charts


def _clock(g: Group) -> str:
    return "wall clock" if g.kind is Kind.WALL else "measured"


# 1 to 1000, every fourth a round number: those are told in the table of the curve.
_ROUND = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
PER_SORT = (*(low * (high / low) ** (i / 4) for low, high in pairwise(_ROUND) for i in range(4)), 1000)


def _break_even_lines(g: Group) -> list[Chart]:
    """Cost of a transfer with its share of the sort, over the number of transfers that share one sort."""
    if not g.simulated:
        measures = ((f"time per transfer [µs], {_clock(g)}; band: q1 to q3", tables.seconds, 1e6),)
    else:
        scale = 1 / (tables.particles(g.first) or 1)
        measures = (
            ("sectors per particle and transfer: simulated", tables.count_of(tables.sectors), scale),
            ("warp instructions per particle and transfer: simulated", tables.count_of(tables.warp_inst), scale),
        )  # type: ignore[assignment]
    charts: list[Chart] = []
    for axis, measure, scale in measures:
        lines = []
        for r in g.ranked:
            y = _over_transfers(r, measure, scale)
            if y is None:
                continue
            band = None
            if not g.simulated:
                ends = [_over_transfers(r, measured.quartile(i), scale) for i in (0, 1)]
                band = (ends[0], ends[1]) if ends[0] and ends[1] else None
            lines.append(Line(g.label(r), PER_SORT, y, r is g.baseline, band))
        if len(lines) > 1:
            title = "Transfer with its share of the sort"
            charts.append(Lines(title, axis, "transfers per sort", thin(lines), g.kind))
    return charts


def _over_transfers(record: Record, measure: tables.Measure, scale: float) -> tuple[float, ...] | None:
    parts = tables.split(record, measure)
    if parts is None or parts.per_transfer <= 0:
        return None
    return tuple(scale * (parts.per_sort / k + parts.per_transfer) for k in PER_SORT)


# ---- legend and environment --------------------------------------------------------------------------------


def _legend(sections: Sequence[Section]) -> tuple[tuple[str, str, str], ...]:
    shown = [t for s in sections for t in s.tables]
    shown += [t for s in sections for d in s.details for t in d.tables]
    shown += [t for s in sections for c in s.cards for t in c.tables]
    columns = {
        (c.title, "" if c.kind is Kind.NAME else str(c.kind), c.explain): None
        for t in shown
        for c in t.columns
        if c.explain
    }
    return tuple(columns)


def _environment(records: Sequence[Record]) -> tuple[tuple[str, str], ...]:
    """One line per fact; where records differ, every value that occurs."""
    facts: dict[str, dict[str, None]] = {}

    def note(name: str, value: object) -> None:
        if value is not None and value != "":
            facts.setdefault(name, {})[str(value)] = None

    for r in records:
        e = asdict(r.environment)
        note("device", r.device)
        note("compiled for", r.arch)
        for name, value in e.pop("gpu").items():
            note(f"GPU {name.replace('_', ' ')}", value)
        note("command", " ".join(e.pop("argv")))
        dirty = e.pop("git_dirty")
        commit = e.pop("git_commit")
        note("commit", f"{commit} with changes" if commit and dirty else commit)
        for name, value in e.items():
            note(name.replace("_", " "), value)
    dates = sorted(facts.get("date", {}))
    if len(dates) > 2:
        facts["date"] = {f"{dates[0]} to {dates[-1]}": None}
    seconds = [r.host_seconds for r in records if r.host_seconds is not None]
    if seconds:
        text = f"{sum(seconds):,.1f} s of wall clock for {_plural(len(seconds), 'run')}; says nothing about a GPU"
        facts["computing time here"] = {text: None}
    return tuple((name, _values(list(values))) for name, values in facts.items())


def _values(values: list[str]) -> str:
    """A fact that is another in every row (a temperature, say) is told by its first values."""
    more = len(values) - MOST_VALUES
    return f"{', '.join(values[:MOST_VALUES])}, and {more} more" if more > 0 else ", ".join(values)
