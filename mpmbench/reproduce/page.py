"""The page: score, misses, then all tables 3-18 of the thesis in order, nothing left out. Rows -> Document -> HTML."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from markupsafe import Markup, escape

from mpmbench.banks import GROUPS, BankPattern
from mpmbench.environment import Environment
from mpmbench.gpu import Gpu
from mpmbench.gpu.modelled import TERM_WORDS, TERMS, ModelledTime
from mpmbench.presets import published_rows
from mpmbench.report import banks
from mpmbench.report.document import Attention, Details, Document, Section
from mpmbench.report.html import render
from mpmbench.report.scatter import Point, Scatter
from mpmbench.report.table import Cell, Column, Kind, Quantity, Row, Table
from mpmbench.report.text import number
from mpmbench.reproduce.causes import likely_cause
from mpmbench.reproduce.comparable import Judged
from mpmbench.reproduce.frozen import NOT_FROZEN, Frozen
from mpmbench.reproduce.rows import Constants
from mpmbench.reproduce.score import FEWEST_PAIRS, POOLED, Score, error_log2, pairs
from mpmbench.reproduce.sensitivity import STEP, Moved, tau
from mpmbench.reproduce.targets import MEDIAN, Target, implied_bytes, published_occupancy

L2_RULE = (
    "L2 hit rate, one rule for all rows: 32-byte sectors found in L2 over all sectors that reach it (loads that miss "
    "L1, stores, atomics), over all launches of the row; a store that fills its sector is a hit."
)

# Titles of tables 3-18, in words of our own.
TITLES = {
    3: "errors of map and map-reduce",
    4: "errors after a thousand round trips",
    5: "map over one attribute of two, AoS and SoA",
    6: "map over both attributes, AoS and SoA",
    7: "one dispatch of a reduction",
    8: "one dispatch of a scan",
    9: "binning, by order of the particles",
    10: "reordering by index and in full",
    11: "G2P on random particles",
    12: "G2P on the uniform cube",
    13: "P2G on random particles",
    14: "P2G on the uniform cube",
    15: "P2G-Atomic and P2G-Sync: active blocks and batching",
    16: "P2G-Sync by covered area and batching",
    17: "banks of a block 4 cells wide",
    18: "banks of a block 8 cells wide",
}
TABLES = range(5, 17)  # that hold times
FAMILIES = (("primitives", range(5, 11)), ("G2P", range(11, 13)), ("P2G", range(13, 17)))


@dataclass(frozen=True)
class Reproduction:
    """Everything that the page says.

    differs: what is not as frozen.  history: versions, oldest first.  verified: parts of ``mpmbench verify --json`` by
    name (table3, table4).
    """

    gpu: Gpu
    constants: Constants
    judged: Sequence[Judged]
    score: Score
    targets: Sequence[Target]
    moved: Sequence[Moved]
    differs: Sequence[str]
    history: Sequence[Frozen]
    verified: Mapping[str, Mapping[str, Any]]


def html(found: Reproduction) -> str:
    """One file that needs nothing else."""
    return render(document(found))


def document(found: Reproduction) -> Document:
    sections = [
        Section("Targets", (_target_table(found.targets),)),
        _misses(found),
        _scatter_section(found.judged),
        *(_verified(table, found.verified) for table in (3, 4)),
        *(_table_section(table, found) for table in TABLES),
        *(_bank_section(table) for table in (17, 18)),
        Section("Rows that are shown and not scored", (_excluded(found.judged),)),
        Section(
            "How the score moves with each constant",
            (_sensitivity(found),),
            intro=f"One constant at a time, {100 * STEP:.0f} % less and more, with the same counters; "
            "calibrated constants are not set anew.",
        ),
        Section("Constants of the model", (_constants(found.constants),)),
        Section("Frozen versions and their scores", (_history(found.history),), intro=_history_intro(found)),
    ]
    return Document(
        title=f"The 2019 thesis reproduced: times modelled for the {found.gpu.title} against the published ones",
        verdict=verdict(found),
        agreed=all(target.met is not False for target in found.targets) and not found.differs,
        answer=tuple(_answer(found)),
        attention=tuple(_attention(found)),
        sections=tuple(sections),
        legend=_legend(sections),
        environment=_environment(found),
    )


def verdict(found: Reproduction) -> str:
    """The score in one sentence."""
    score, stamp = found.score, "Post-hoc. " if found.differs else ""
    if found.differs and found.differs[0] == NOT_FROZEN:
        stamp = "Nothing is frozen yet. "
    right = score.pooled.concordant / score.pooled.count if score.pooled.count else math.nan
    return (
        f"{stamp}Half of {score.rows} comparable rows are modelled within a factor of {2**score.median_abs_log2:.2f}, "
        f"the worst within {2**score.worst_abs_log2:.2f}; {100 * right:.0f} % of {score.pooled.count} pairs of rows "
        "are in the printed order."
    )


def _answer(found: Reproduction) -> list[str]:
    missed = [target for target in found.targets if target.met is False]
    met = sum(target.met is True for target in found.targets)
    sentences = [f"{met} of {len(found.targets)} targets are met."]
    sentences += [f"Missed: {target.name} is {target.found}, wanted {target.wanted}." for target in missed]
    ratio = found.score.geomean
    sentences.append(
        f"On average (geometric mean) a modelled time is {ratio:.2f} of the published one. All times are modelled: no "
        "GPU took part. Published times are means of at least 1,000 timer queries on a GTX 970."
    )
    return sentences


def _attention(found: Reproduction) -> list[Attention]:
    items = []
    if found.differs:
        if found.differs[0] == NOT_FROZEN:
            text, action = (
                "No version is frozen: this score is a rehearsal.",
                "Freeze with `--freeze v1 --reason TEXT`.",
            )
        else:
            version = found.history[-1].version
            text = f"Post-hoc: {len(found.differs)} things differ from frozen version {version}: " + "; ".join(
                found.differs[:8]
            )
            text += f"; and {len(found.differs) - 8} more." if len(found.differs) > 8 else "."
            action = f"The score that counts for {version} is its first, below."
        items.append(Attention("wrong", text, action))
    if failed := [one.row for one in found.judged if one.row.modelled is None]:
        names = "; ".join(f"table {row.table}, {row.row}: {row.failed or 'no reason given'}" for row in failed)
        items.append(Attention("wrong", f"{len(failed)} rows have no modelled time: {names}.", "The score lacks them."))
    if uncalibrated := [one for one in found.judged if one.row.modelled and not one.row.modelled.calibrated]:
        reasons = "; ".join(dict.fromkeys(one.row.modelled.reason for one in uncalibrated if one.row.modelled))
        items.append(Attention("warning", f"{len(uncalibrated)} rows are uncalibrated: {reasons}.", ""))
    return items


# --- targets and misses -----------------------------------------------------------------------------------------------


def _target_table(targets: Sequence[Target]) -> Table:
    words = {True: "met", False: "missed", None: "not compared"}
    columns = (
        _name("target", Quantity.PROSE),
        Column("wanted", Kind.NAME, Quantity.TEXT),
        Column("found", Kind.NAME, Quantity.TEXT),
        Column("", Kind.NAME, Quantity.TEXT),
        Column("where it is missed", Kind.NAME, Quantity.PROSE),
    )
    rows = [
        Row(_cells(columns, (t.name, t.wanted, t.found, words[t.met], t.detail)), "wrong" if t.met is False else "ok")
        for t in targets
    ]
    return Table("", columns, tuple(rows))


def _misses(found: Reproduction) -> Section:
    """Every comparable row by its error; rows without a modelled time come first."""
    comparable = [one for one in found.judged if one.comparable]

    def error(one: Judged) -> float:
        known = error_log2(one)
        return math.inf if known is None else abs(known)

    ordered = sorted(comparable, key=error, reverse=True)
    bad = [one for one in ordered if error(one) > MEDIAN]
    good = [one for one in ordered if error(one) <= MEDIAN]
    within = f"{100 * (2**MEDIAN - 1):.0f} %"
    note = (
        f"Bars, left to right: {', '.join(TERM_WORDS[term].split(' (')[0] for term in TERMS)}; the coloured one is the "
        "longest and binds. Causes are likely, not proven."
    )
    title = f"{len(bad)} of {len(comparable)} comparable rows are off by more than {within}, worst first"
    rest = Details(f"The other {len(good)} rows", (_miss_table("", good, found.gpu),)) if good else None
    return Section(
        "Misses, worst first", (_miss_table(title, bad, found.gpu, (note,)),), details=(rest,) if rest else ()
    )


def _miss_table(title: str, judged: Sequence[Judged], gpu: Gpu, notes: Sequence[str] = ()) -> Table:
    columns = (
        _name("row as printed", Quantity.PROSE),
        Column("time [µs]", Kind.PUBLISHED, Quantity.PRINTED, explain="as printed"),
        *_TIME_COLUMNS,
        Column(
            "modelled / published",
            Kind.MODELLED,
            Quantity.FACTOR,
            explain="above 1: modelled too slow; below 1: too fast",
        ),
        *_BOUND_COLUMNS,
        Column("likely cause", Kind.NAME, Quantity.PROSE),
    )
    rows = []
    for one in judged:
        cause = likely_cause(one, gpu)
        name = f"{one.row.table}: {one.row.row}"
        values = (name, one.row.published_us, *_time(one), one.ratio, *_bound(one), cause)
        rows.append(Row(_cells(columns, values), "broken" if one.row.modelled is None else "ok"))
    return Table(title, columns, tuple(rows), tuple(notes))


def _excluded(judged: Sequence[Judged]) -> Table:
    columns = (
        _name("row as printed", Quantity.PROSE),
        Column("why", Kind.NAME, Quantity.TEXT),
        Column("reason", Kind.NAME, Quantity.PROSE),
        Column("time [µs]", Kind.PUBLISHED, Quantity.PRINTED, explain="as printed"),
        *_TIME_COLUMNS,
        Column("modelled / published", Kind.MODELLED, Quantity.FACTOR),
    )
    rows = [
        Row(_cells(columns, (f"{one.row.table}: {one.row.row}", one.status, one.reason, one.row.published_us,
                             *_time(one), one.ratio)))
        for one in judged
        if not one.comparable
    ]  # fmt: skip
    return Table("", columns, tuple(rows))


# --- the plot ---------------------------------------------------------------------------------------------------------


def _scatter_section(judged: Sequence[Judged]) -> Section:
    timed = [one for one in judged if one.ratio is not None]
    worst = sorted((one for one in timed if one.comparable), key=lambda one: -abs(error_log2(one) or 0))[:5]
    labelled = {id(one) for one in worst if abs(error_log2(one) or 0) > MEDIAN}
    series = []
    for name, tables in FAMILIES:
        points = [
            Point(
                one.row.published_us or 0,
                one.row.modelled_us or 0,
                f"{one.row.table} {one.row.row}" if id(one) in labelled else "",
                one.comparable,
            )
            for one in timed
            if one.row.table in tables
        ]
        series.append((name, tuple(points)))
    chart = Scatter("Every row once", "modelled time [µs]", "published time [µs]", tuple(series))
    columns = (
        _name("row as printed", Quantity.PROSE),
        Column("scored", Kind.NAME, Quantity.TEXT),
        Column("time [µs]", Kind.PUBLISHED, Quantity.PRINTED, explain="as printed"),
        *_TIME_COLUMNS,
    )
    rows = [
        Row(_cells(columns, (f"{one.row.table}: {one.row.row}", "yes" if one.comparable else one.status,
                             one.row.published_us, *_time(one))))
        for one in timed
    ]  # fmt: skip
    data = Details("The same points as a table", (Table("", columns, tuple(rows)),))
    return Section(
        "Modelled against published", charts=(chart,) if timed else (), details=(data,),
        intro="On the line both are equal; the band is a factor of 2. Hollow marks are shown and not scored.",
    )  # fmt: skip


# --- one table of the thesis ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Metric:
    """A figure that the thesis prints and we count or model, by its name in ``Row.metrics``."""

    name: str
    title: str
    kind: Kind
    explain: str


METRICS = (
    Metric("vram_percent", "VRAM [%]", Kind.MODELLED, "DRAM bytes over modelled time and nominal bandwidth"),
    Metric("sm_percent", "SM [%]", Kind.MODELLED, "busiest pipe of the SM over its peak in the modelled time"),
    Metric("l2_percent", "L2 [%]", Kind.MODELLED, "bytes through L2 over modelled time and L2 bandwidth"),
    Metric("sm_issue_percent", "issue [%]", Kind.MODELLED, "cycles in which a scheduler issued"),
    Metric("read_percent", "read [%]", Kind.MODELLED, "of the modelled time, spent on DRAM reads"),
    Metric("write_percent", "write [%]", Kind.MODELLED, "of the modelled time, spent on DRAM writes"),
    Metric("l2_hit_percent", "L2 hit [%]", Kind.SIMULATED, L2_RULE),
    Metric("dram_bytes", "DRAM [MB]", Kind.SIMULATED, "sectors read from and written to DRAM"),
    Metric(
        "occupancy_warps", "occupancy [warps]", Kind.PREDICTED, "warps that one SM holds, from the compiler's figures"
    ),
)
_NOT_METRICS = ("area_percent",)  # printed, and part of the row's name


def _table_section(table: int, found: Reproduction) -> Section:
    judged = [one for one in found.judged if one.row.table == table]
    title = f"Table {table}: {TITLES[table]}"
    if not judged:
        return Section(title, (), intro="No row of it was run.")
    judged = sorted(judged, key=lambda one: one.row.place)
    order = pairs([one for one in judged if one.comparable])
    notes = [f"{one.row.row}: {one.row.erratum}." for one in judged if one.row.erratum]
    if order.count:
        alone = "" if order.count >= FEWEST_PAIRS else f"; fewer than {FEWEST_PAIRS} pairs enter the pool alone"
        notes.insert(
            0, f"Order: {order.concordant} of {order.count} scored pairs as printed, tau {order.tau:.2f}{alone}."
        )
    return Section(title, (_times(judged, notes), _counters(judged, found.gpu)))


_TIME_COLUMNS = (
    Column("time [µs]", Kind.MODELLED, Quantity.NUMBER, explain="launches and the largest term"),
    Column("from", Kind.MODELLED, Quantity.NUMBER, explain="lower end of the modelled range [µs]"),
    Column("to", Kind.MODELLED, Quantity.NUMBER, explain="upper end of the modelled range [µs]"),
)
_BOUND_COLUMNS = (
    Column("bound by", Kind.MODELLED, Quantity.TEXT, explain="the largest term"),
    Column(
        "terms", Kind.MODELLED, Quantity.TEXT,
        explain="time of each unit if it were the only limit: " + ", ".join(TERM_WORDS[term] for term in TERMS),
    ),
)  # fmt: skip


def _times(judged: Sequence[Judged], notes: Sequence[str]) -> Table:
    columns = (
        _name("row as printed", Quantity.PROSE),
        Column("scored", Kind.NAME, Quantity.TEXT),
        Column("time [µs]", Kind.PUBLISHED, Quantity.PRINTED, explain="as printed"),
        Column("speedup as printed", Kind.PUBLISHED, Quantity.PRINTED, explain="as printed"),
        Column(
            "speedup by the times", Kind.PUBLISHED, Quantity.FACTOR, explain="published time of the baseline over this"
        ),
        Column("rank", Kind.PUBLISHED, Quantity.RANK, explain="by published time"),
        *_TIME_COLUMNS,
        Column("speedup", Kind.MODELLED, Quantity.FACTOR, explain="modelled time of the baseline over this row's"),
        Column("rank", Kind.MODELLED, Quantity.RANK, explain="by modelled time"),
        Column(
            "modelled / published",
            Kind.MODELLED,
            Quantity.FACTOR,
            explain="above 1: modelled too slow; below 1: too fast",
        ),
        *_BOUND_COLUMNS,
    )
    baselines = baselines_of(judged)
    published_ranks = ranks([one.row.published_us for one in judged])
    modelled_ranks = ranks([one.row.modelled_us for one in judged])
    rows = []
    for i, one in enumerate(judged):
        base = baselines[i]
        values = (
            one.row.row, "yes" if one.comparable else one.status,
            one.row.published_us, _printed(one).get("speedup") or None,
            _over(base.row.published_us if base else None, one.row.published_us), published_ranks[i],
            *_time(one), _over(base.row.modelled_us if base else None, one.row.modelled_us), modelled_ranks[i], one.ratio,
            *_bound(one),
        )  # fmt: skip
        status = "broken" if one.row.modelled is None else "ok" if one.comparable else "out"
        rows.append(Row(_cells(columns, values), status))
    return _without_empty(Table("Times", columns, tuple(rows), tuple(notes)))


def _counters(judged: Sequence[Judged], gpu: Gpu) -> Table:
    """Printed metrics, then ours, kind by kind; a metric of one side alone is shown as well."""
    titles = {metric.name: metric.title for metric in METRICS}
    keys = dict.fromkeys(key for one in judged for key, value in one.row.published.items() if value)
    printed = [key for key in keys if key not in _NOT_METRICS]
    columns = [_name("row as printed", Quantity.PROSE)]
    sources: list[Callable[[Judged], Any]] = [lambda one: one.row.row]
    for key in printed:
        title = titles.get(key, key.replace("_percent", " [%]").replace("_", " "))
        text = any(not _is_number(one.row.published.get(key, "")) for one in judged)
        columns.append(Column(title, Kind.PUBLISHED, Quantity.TEXT if text else Quantity.PRINTED, explain="as printed"))
        sources.append(lambda one, key=key: one.row.published.get(key) or None)  # type: ignore[misc]
    if "occupancy_warps" not in printed:
        columns.append(Column("occupancy [warps]", Kind.PUBLISHED, explain="stated in the text"))
        sources.append(lambda one: published_occupancy(one.row))
    columns.append(Column("DRAM [MB]", Kind.PUBLISHED, explain="printed VRAM share x nominal bandwidth x printed time"))
    sources.append(lambda one: _scaled(implied_bytes(one.row, gpu), 1e-6))
    for kind in (Kind.SIMULATED, Kind.PREDICTED, Kind.MODELLED):
        for metric in METRICS:
            if metric.kind is kind:
                scale = 1e-6 if metric.name == "dram_bytes" else 1.0
                columns.append(Column(metric.title, kind, explain=metric.explain))
                sources.append(
                    lambda one, m=metric, s=scale: _scaled(one.row.metrics.get(m.name), s)  # type: ignore[misc]
                )
    rows = [
        Row(_cells(columns, [source(one) for source in sources]), "ok" if one.comparable else "out") for one in judged
    ]
    shows_hits = any("l2_hit_percent" in one.row.metrics for one in judged)
    return _without_empty(Table("Counters", tuple(columns), tuple(rows), (L2_RULE,) if shows_hits else ()))


def baselines_of(judged: Sequence[Judged]) -> list[Judged | None]:
    """What each row's speedup is against: the last row above that prints none; the first where none prints any."""
    prints = any(_printed(one).get("speedup") for one in judged)
    found: list[Judged | None] = []
    base: Judged | None = None
    for one in judged:
        own = bool(_printed(one).get("speedup"))
        if base is None or (prints and not own):
            base = one
            found.append(None)
        else:
            found.append(base)
    return found


def ranks(values: Sequence[float | None]) -> list[int | None]:
    """1 for the least; equal values share a rank."""
    known = sorted(value for value in values if value is not None)
    return [None if value is None else 1 + known.index(value) for value in values]


def _printed(one: Judged) -> dict[str, str]:
    return published_rows(one.row.table)[one.row.place]


# --- tables of errors and of banks ------------------------------------------------------------------------------------


def _verified(table: int, verified: Mapping[str, Mapping[str, Any]]) -> Section:
    """Errors: printed ones, and ours from a run of ``mpmbench verify``."""
    printed = published_rows(table)
    skipped = ("table", "erratum")
    columns = [
        _name("row as printed", Quantity.PROSE),
        *(
            Column(key.replace("_", " "), Kind.PUBLISHED, Quantity.PRINTED)
            for key in printed[0]
            if key not in ("row", *skipped)
        ),
    ]
    rows = [
        Row(_cells(columns, [row["row"], *(row[key] for key in row if key not in ("row", *skipped))]))
        for row in printed
    ]
    notes = [f"{row['row']}: {row['erratum']}." for row in printed if row["erratum"]]
    tables = [Table("As printed", tuple(columns), tuple(rows), tuple(notes))]
    part = verified.get(f"table{table}")
    intro = "Errors, not times: no part of the score. "
    if part is None:
        intro += (
            f"Our own errors: mpmbench verify --part table{table} --json FILE, then reproduce thesis --verify FILE."
        )
    else:
        tables += [_from_json(content) for content in part["tables"]]
        when = part.get("environment", {})
        intro += f"Ours are from mpmbench verify, {when.get('date', 'undated')}. {part['intro']}"
    return Section(f"Table {table}: {TITLES[table]}", tuple(tables), intro=intro)


def _from_json(content: Mapping[str, Any]) -> Table:
    """A table of ``mpmbench verify --json``."""
    columns = []
    for i, column in enumerate(content["columns"]):
        kind = Kind(column["kind"])
        words = any(isinstance(row[i], str) for row in content["rows"])
        quantity = Quantity.TEXT if words else Quantity.PRINTED if kind is Kind.PUBLISHED else Quantity.NUMBER
        columns.append(Column(column["title"], kind, quantity))
    rows = [Row(_cells(columns, row)) for row in content["rows"]]
    return Table(content["title"], tuple(columns), tuple(rows), tuple(content["notes"]))


def _bank_section(table: int) -> Section:
    """Banks that the printed rows name, and those that follow from the block's shape."""
    printed = published_rows(table)
    width = int(printed[0]["block_x"])
    # The printed rows follow each other without the halo between layers: a block of one layer.
    flat = BankPattern((width, 32 // width, 1))
    full = BankPattern((width, 4, 4))
    across = flat.arena[0]
    columns = (
        _name("row as printed", Quantity.TEXT),
        Column("bank groups", Kind.PUBLISHED, Quantity.CODE, explain="as printed, place by place"),
        Column("bank groups", Kind.PREDICTED, Quantity.CODE, explain="place modulo 8"),
        Column("same", Kind.PREDICTED, Quantity.TEXT),
    )
    rows = []
    for row in printed:
        ours = " ".join(str((int(row["y"]) * across + x) % GROUPS) for x in range(across))
        same = "yes" if ours == row["banks"] else "no"
        rows.append(Row(_cells(columns, (row["row"], row["banks"], ours, same)), "ok" if same == "yes" else "wrong"))
    notes = [f"{row['row']}: {row['erratum']}." for row in printed if row["erratum"]]
    notes.append(
        f"Printed: every bank is taken four times. Predicted for rows that follow each other: "
        f"{_counts(flat)}; for a block of {width}x4x4 cells with the halo between its layers: {_counts(full)}."
    )
    chart = banks.picture(full)
    return Section(
        f"Table {table}: {TITLES[table]}", (Table("", columns, tuple(rows), tuple(notes)),), (chart,),
        intro="No times: the pattern follows from the block's shape, and is no part of the score.",
    )  # fmt: skip


def _counts(pattern: BankPattern) -> str:
    return " ".join(map(str, pattern.accesses(0)))


# --- constants, sensitivity, history ----------------------------------------------------------------------------------


def _sensitivity(found: Reproduction) -> Table:
    def percent(sign: str) -> str:
        return f"{sign}{100 * STEP:.0f} %"

    measures: tuple[tuple[str, Callable[[Score], float | None]], ...] = (
        ("median", lambda s: s.median_abs_log2),
        ("worst", lambda s: s.worst_abs_log2),
        ("tau", tau),
    )
    columns = [_name("constant", Quantity.CODE), Column("value", Kind.NAME, Quantity.NUMBER)]
    columns += [Column(f"{name} {percent(sign)}", Kind.MODELLED) for name, _ in measures for sign in "−+"]
    rows = [
        Row(
            _cells(columns, ["as it is", None, *(value(found.score) for _, value in measures for _ in "−+")]),
            "ok",
            True,
        )
    ]
    for moved in sorted(found.moved, key=lambda m: -m.reach):
        values = [value(score) for _, value in measures for score in (moved.less, moved.more)]
        rows.append(Row(_cells(columns, [moved.constant, moved.value, *values])))
    note = "median, worst: of |log2(modelled / published)|; tau: pooled."
    return Table("", tuple(columns), tuple(rows), (note,))


def _constants(constants: Constants) -> Table:
    columns = (
        _name("constant", Quantity.CODE),
        Column("value", Kind.NAME, Quantity.NUMBER),
        Column("confidence", Kind.NAME, Quantity.TEXT),
        Column("source", Kind.NAME, Quantity.PROSE),
    )
    rows = [Row(_cells(columns, (name, c.value, c.confidence, c.source))) for name, c in constants.items()]
    return Table("", columns, tuple(rows))


def _history(history: Sequence[Frozen]) -> Table:
    columns = (
        _name("version", Quantity.TEXT),
        Column("frozen", Kind.NAME, Quantity.TEXT),
        Column("reason", Kind.NAME, Quantity.PROSE),
        Column("decision", Kind.NAME, Quantity.CODE),
        Column("first scored", Kind.NAME, Quantity.TEXT),
        Column("median", Kind.MODELLED),
        Column("worst", Kind.MODELLED),
        Column("geomean", Kind.MODELLED, Quantity.FACTOR),
        Column("tau", Kind.MODELLED),
    )
    rows = []
    for one in history:
        score = one.score or {}
        rows.append(
            Row(
                _cells(
                    columns,
                    (one.version, one.date[:10], one.reason, one.note, str(score.get("date", "not yet"))[:10],
                     score.get("median_abs_log2"), score.get("worst_abs_log2"), score.get("geomean"),
                     score.get("kendall_tau", {}).get(POOLED)),
                )
            )
        )  # fmt: skip
    return Table("", columns, tuple(rows))


def _history_intro(found: Reproduction) -> str:
    text = "A version fixes constants, kernels, datasets and the list of scored rows; its first score stays."
    if found.differs:
        return text + f" This run is {'a rehearsal' if found.differs[0] == NOT_FROZEN else 'post-hoc'}."
    return text + f" This run is {found.history[-1].version}, as frozen."


# --- cells ------------------------------------------------------------------------------------------------------------


def terms_bars(modelled: ModelledTime) -> Markup:
    """The terms side by side, as tall as they are long; the largest coloured. Small enough for a table's cell."""
    top = max((modelled.terms.get(term, 0.0) for term in TERMS), default=0.0)
    if not top > 0:
        return Markup("")
    bars, said = [], []
    for i, term in enumerate(TERMS):
        value = modelled.terms.get(term, 0.0)
        height = 20 * value / top
        said.append(f"{TERM_WORDS[term]} {1e6 * value:,.0f} µs")
        colour = "var(--series-1)" if value == top else "var(--muted)"
        bars.append(
            f'<rect x="{8 * i + 1}" y="{21 - max(height, 0.6):.1f}" width="6" height="{max(height, 0.6):.1f}" '
            f'fill="{colour}"><title>{escape(said[-1])}</title></rect>'
        )
    label = escape("; ".join(said))
    head = f'<svg viewBox="0 0 {8 * len(TERMS)} 22" style="width:4.5rem" role="img" aria-label="{label}">'
    return Markup(f"{head}{''.join(bars)}</svg>")  # numbers and escaped words


def _time(one: Judged) -> tuple[float | None, float | None, float | None]:
    modelled = one.row.modelled
    if modelled is None:
        return None, None, None
    return 1e6 * modelled.seconds, 1e6 * modelled.low, 1e6 * modelled.high


def _bound(one: Judged) -> tuple[str | None, Markup | None]:
    modelled = one.row.modelled
    if modelled is None:
        return None, None
    return TERM_WORDS.get(modelled.bound, modelled.bound).split(" (")[0], terms_bars(modelled)


def _over(mine: float | None, other: float | None) -> float | None:
    return mine / other if mine and other else None


def _scaled(value: float | None, scale: float) -> float | None:
    return None if value is None else scale * value


def _is_number(text: str) -> bool:
    try:
        float(text or 0)
    except ValueError:
        return False
    return True


def _name(title: str, quantity: Quantity) -> Column:
    return Column(title, Kind.NAME, quantity)


def _cells(columns: Sequence[Column], values: Iterable[Any]) -> tuple[Cell, ...]:
    return tuple(Cell(value, column.kind) for value, column in zip(values, columns, strict=True))


def _without_empty(table: Table) -> Table:
    """Without the columns that no row fills."""
    kept = [
        i
        for i in range(len(table.columns))
        if any(row.cells[i].value is not None and row.cells[i].value != "" for row in table.rows)
    ]
    rows = (Row(tuple(row.cells[i] for i in kept), row.status, row.baseline) for row in table.rows)
    return Table(table.title, tuple(table.columns[i] for i in kept), tuple(rows), table.notes)


def _legend(sections: Sequence[Section]) -> tuple[tuple[str, str, str], ...]:
    """Every column that says what it is, once."""
    found: dict[tuple[str, str], str] = {}
    for section in sections:
        for table in (*section.tables, *(t for fold in section.details for t in fold.tables)):
            for column in table.columns:
                if column.explain and column.explain != "as printed":
                    kind = "" if column.kind is Kind.NAME else str(column.kind)
                    found.setdefault((column.title, kind), column.explain)
    return tuple((title, kind, text) for (title, kind), text in found.items())


def _environment(found: Reproduction) -> tuple[tuple[str, str], ...]:
    environment = Environment.capture()
    names = ("mpmbench", "git_commit", "git_dirty", "nvrtc", "python", "cpu", "date")
    facts = [(name, str(value)) for name in names if (value := getattr(environment, name)) is not None]
    return (("model of", found.gpu.summary), *facts, ("command", " ".join(environment.argv)))


def summary(found: Reproduction) -> list[str]:
    """The score and the worst misses, for a terminal."""
    lines = [verdict(found)]
    lines += [
        f"  {'met   ' if t.met else 'missed' if t.met is False else '-     '} {t.name}: {t.found} ({t.wanted})"
        for t in found.targets
    ]
    scored = [(error, one) for one in found.judged if one.comparable and (error := error_log2(one)) is not None]
    lines.append("worst misses:")
    for error, one in sorted(scored, key=lambda pair: -abs(pair[0]))[:5]:
        bound = one.row.modelled.bound if one.row.modelled else ""
        lines.append(
            f"  {error:+.2f}  table {one.row.table}, {one.row.row}: published {one.row.published_us:,.0f} µs, modelled "
            f"{number(one.row.modelled_us or 0)} µs ({bound})"
        )
    return lines
