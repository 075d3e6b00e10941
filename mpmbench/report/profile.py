"""Profile: per strategy on one GPU, how near each unit is to its limit, which lines cost most, and what would help."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from mpmbench.gpu.modelled import TERM_WORDS, TERMS
from mpmbench.profile_record import METRICS, Profile
from mpmbench.record import Record
from mpmbench.report import table as tables
from mpmbench.report.advice import SECTOR_BYTES, sentence
from mpmbench.report.modelled import UNCALIBRATED, GpuGroup, Span, uncalibrated_notes
from mpmbench.report.speed_of_light import Roofline, SpeedOfLight, roofline, speed_of_light, unit_label
from mpmbench.report.table import Cell, Column, Kind, Quantity, Row, Table

HOTTEST = 6

EXPLANATION = (
    "Every time, share and cache or DRAM count here is modelled for {gpu}; instructions are simulated, counted exactly "
    "for the PTX. Open a strategy for its charts and its hottest lines."
)


@dataclass(frozen=True)
class Card:
    """One strategy on one GPU. badge: why its time is uncalibrated; empty if it is not.  detailed: whether charts and
    lines were asked for."""

    title: str
    headline: str
    sentence: str
    badge: str = ""
    charts: tuple[SpeedOfLight | Roofline, ...] = ()
    tables: tuple[Table, ...] = ()
    detailed: bool = True


def card(g: GpuGroup, record: Record, detailed: bool = True) -> Card:
    """detailed: with charts and hottest lines."""
    profile = g.profile(record)
    time, held = profile.time, profile.occupancy
    limiter = "" if held.warps >= held.max_warps else f", limited by {held.limiter}"
    drawn = [speed_of_light(profile), roofline(record, profile)] if detailed else []
    hottest = hottest_lines(record, profile) if detailed else None
    return Card(
        title=g.group.label(record),
        headline=f"{Span.of(time).text} modelled on {profile.title}; bound: {unit_label(time.bound)}; "
        f"{held.warps} of {held.max_warps} warps per SM{limiter}",
        sentence=sentence(record, profile),
        badge="" if time.calibrated else (time.reason or UNCALIBRATED),
        charts=tuple(chart for chart in drawn if chart is not None),
        tables=() if hottest is None else (hottest,),
        detailed=detailed,
    )


def overview(g: GpuGroup) -> Table:
    """Every unit's term over the modelled time: the bars of all strategies as numbers."""
    sources: list[tuple[Column, Callable[[Record, Profile], Any]]] = [
        *_who(g),
        (_modelled("time", Quantity.SECONDS, "less", "transfer alone"), lambda r, p: p.time.seconds),
        (
            Column("range", Kind.MODELLED, Quantity.SECONDS_RANGE, explain="of the modelled time", under=True),
            lambda r, p: (p.time.low, p.time.high),
        ),
        (_modelled("bound", Quantity.TEXT, explain="largest term"), lambda r, p: unit_label(p.time.bound)),
        (
            Column("calibration", Kind.MODELLED, Quantity.TEXT, under=True),
            lambda r, p: "" if p.time.calibrated else UNCALIBRATED,
        ),
        *((_modelled(unit_label(t), Quantity.SHARE, None, f"{TERM_WORDS[t]}: term / time"), _term(t)) for t in TERMS),
    ]
    return _table("Speed of light: each unit's time over the modelled time", g, sources, uncalibrated_notes(g))


def metrics(g: GpuGroup) -> Table | None:
    """The metrics of thesis table 2, in its words."""
    known = [name for name in METRICS if any(name in g.profile(r).metrics for r in g.runs)]
    if not known:
        return None
    sources = _who(g)
    for name in known:
        title, explain = METRICS[name]
        sources.append((_modelled(title, Quantity.NUMBER, None, explain), _metric(name)))
    held: tuple[tuple[str, Quantity, str, Callable[[Record, Profile], Any]], ...] = (
        ("warps that fit", Quantity.COUNT, "per SM, by registers, shared memory, warps and blocks",
         lambda r, p: p.occupancy.warps),
        ("limiter", Quantity.TEXT, "what keeps more warps from fitting", lambda r, p: p.occupancy.limiter),
    )  # fmt: skip
    sources += [(Column(t, Kind.PREDICTED, quantity, explain=explain), value) for t, quantity, explain, value in held]
    return _table("Metrics of the thesis (table 2)", g, sources)


def traffic(g: GpuGroup) -> Table:
    """Bytes over the compulsory ones: each particle and each touched node once."""

    def moved(sectors: Callable[[Profile], int]) -> Callable[[Record, Profile], Any]:
        return lambda r, p: SECTOR_BYTES * sectors(p)

    def over(sectors: Callable[[Profile], int]) -> Callable[[Record, Profile], Any]:
        return lambda r, p: SECTOR_BYTES * sectors(p) / r.floor_bytes if r.floor_bytes else None

    levels: tuple[tuple[str, Callable[[Profile], int]], ...] = (
        ("L2", lambda p: p.memory.l2_sectors),
        ("DRAM", lambda p: p.memory.dram_sectors),
    )
    sources = _who(g)
    sources.append(
        (Column("compulsory", Kind.PREDICTED, Quantity.BYTES, explain="each particle and touched node once"),
         lambda r, p: r.floor_bytes)
    )  # fmt: skip
    for name, sectors in levels:
        sources.append((_modelled(f"{name} bytes", Quantity.BYTES, "less", f"asked of {name}"), moved(sectors)))
        sources.append((_modelled(f"{name} / compulsory", Quantity.FACTOR, "less", "bytes over them"), over(sectors)))
    return _table("Traffic over the compulsory", g, sources)


def hottest_lines(record: Record, profile: Profile, count: int = HOTTEST) -> Table | None:
    """Source lines with the largest share of the term that binds."""
    costly = sorted(profile.lines.items(), key=lambda item: (-item[1].share, -item[1].warp_inst, item[0]))[:count]
    if not costly:
        return None
    columns = (
        Column("line", Kind.NAME, Quantity.CODE),
        _modelled(f"share of {unit_label(profile.time.bound)}", Quantity.SHARE, "more", "of the term that binds"),
        Column("warp inst", Kind.SIMULATED, Quantity.COUNT, explain="instructions issued, each once per warp"),
        _modelled("L2 sectors", Quantity.COUNT, None, "asked of L2"),
        _modelled("DRAM sectors", Quantity.COUNT, None, "read and written back"),
        Column("source", Kind.NAME, Quantity.CODE),
    )
    rows = []
    for line, counts in costly:
        where = f"{line.file.rsplit('/', 1)[-1]}:{line.line}"
        text = record.line_texts.get(line, "")
        values = (where, counts.share, counts.warp_inst, counts.l2_sectors, counts.dram_sectors, text)
        rows.append(Row(tuple(Cell(v, c.kind) for v, c in zip(values, columns, strict=True))))
    return Table(f"Hottest lines on {profile.title}", columns, tuple(rows))


def _modelled(title: str, quantity: Quantity, better: str | None = None, explain: str = "") -> Column:
    return Column(title, Kind.MODELLED, quantity, better, explain)


def _term(name: str) -> Callable[[Record, Profile], Any]:
    return lambda r, p: p.time.terms.get(name, 0.0) / p.time.seconds if p.time.seconds else None


def _metric(name: str) -> Callable[[Record, Profile], Any]:
    return lambda r, p: p.metrics.get(name)


def _who(g: GpuGroup) -> list[tuple[Column, Callable[[Record, Profile], Any]]]:
    return [
        (Column("strategy", Kind.NAME, Quantity.CODE), lambda r, p: r.variant),
        (
            Column("axes changed", Kind.NAME, Quantity.CODE, under=True),
            lambda r, p: tables.axes_text(tables.changed_axes(r, g.group.shared)),
        ),
    ]


def _table(
    title: str,
    g: GpuGroup,
    sources: Sequence[tuple[Column, Callable[[Record, Profile], Any]]],
    notes: Sequence[str] = (),
) -> Table:
    rows = tuple(
        Row(
            tuple(Cell(value(record, g.profile(record)), column.kind) for column, value in sources),
            baseline=record is g.baseline,
        )
        for record in g.runs
    )
    return Table(f"{title}: {g.gpu_title}", tuple(column for column, _ in sources), rows, tuple(notes))
