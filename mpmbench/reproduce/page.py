"""The page: score, misses, then all tables 3-18 of the thesis in order, nothing left out. Rows -> Document -> HTML."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from mpmbench.environment import Environment
from mpmbench.gpu import Gpu
from mpmbench.gpu.modelled import TERM_WORDS, TERMS
from mpmbench.report.document import Attention, Details, Document, Section
from mpmbench.report.html import render
from mpmbench.report.scatter import Point, Scatter
from mpmbench.report.table import Column, Kind, Quantity, Row, Table
from mpmbench.report.text import number
from mpmbench.reproduce.causes import likely_cause
from mpmbench.reproduce.cells import (
    BOUND_COLUMNS,
    NAME,
    NAME_AND_MORE,
    PUBLISHED_TIME,
    RATIO,
    TIME_COLUMNS,
    bound_of,
    cells,
    time_of,
)
from mpmbench.reproduce.comparable import Judged
from mpmbench.reproduce.frozen import NOT_FROZEN, Frozen
from mpmbench.reproduce.rows import Constants
from mpmbench.reproduce.score import POOLED, Score, error_log2, score
from mpmbench.reproduce.sensitivity import STEP, Moved, tau
from mpmbench.reproduce.targets import MEDIAN, Target
from mpmbench.reproduce.thesis_tables import L2_RULE, TABLES, banks_section, errors_section, times_section

NAMED = 5  # differences that are spelt out on top; the section on frozen versions has all
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
        *(errors_section(table, found.verified) for table in (3, 4)),
        *(times_section(table, found.judged, found.gpu) for table in TABLES),
        *(banks_section(table) for table in (17, 18)),
        Section("Rows that are shown and not scored", (_excluded(found.judged),)),
        Section(
            "How the score moves with each constant",
            (_sensitivity(found),),
            intro=f"One constant at a time, {100 * STEP:.0f} % less and more, with the same counters; "
            "calibrated constants are not set anew.",
        ),
        Section("Constants of the model", (_constants(found.constants),)),
        _history_section(found),
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
    total, stamp = found.score, "Post-hoc. " if found.differs else ""
    if found.differs and found.differs[0] == NOT_FROZEN:
        stamp = "Nothing is frozen yet. "
    right = total.pooled.concordant / total.pooled.count if total.pooled.count else math.nan
    return (
        f"{stamp}Half of {total.rows} comparable rows are modelled within a factor of {2**total.median_abs_log2:.2f}, "
        f"the worst within {2**total.worst_abs_log2:.2f}; {100 * right:.0f} % of {total.pooled.count} pairs of rows "
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
    if found.differs and found.differs[0] == NOT_FROZEN:
        action = "Freeze with `--freeze v1 --reason TEXT`."
        items.append(Attention("wrong", "No version is frozen: this score is a rehearsal.", action))
    elif found.differs:
        version = found.history[-1].version
        named = "; ".join(found.differs[:NAMED])
        more = f"; and {len(found.differs) - NAMED} more" if len(found.differs) > NAMED else ""
        text = f"Post-hoc, this run is not the frozen version {version}: {named}{more}."
        items.append(Attention("wrong", text, f"The score that counts for {version} is its first, below."))
    if failed := [one.row for one in found.judged if one.row.modelled is None]:
        names = "; ".join(f"table {row.table}, {row.row}: {row.failed or 'no reason given'}" for row in failed)
        items.append(Attention("wrong", f"Without a modelled time: {names}.", "The score lacks them."))
    if uncalibrated := [one.row for one in found.judged if one.row.modelled and not one.row.modelled.calibrated]:
        names = "; ".join(
            f"table {row.table}, {row.row}: {row.modelled.reason}" for row in uncalibrated if row.modelled
        )
        items.append(Attention("warning", f"Uncalibrated: {names}.", ""))
    return items


# --- targets and misses -----------------------------------------------------------------------------------------------


def _target_table(targets: Sequence[Target]) -> Table:
    words = {True: "met", False: "missed", None: "not compared"}
    columns = (
        Column("target", Kind.NAME, Quantity.PROSE),
        Column("result", Kind.NAME, Quantity.TEXT),
        Column("found", Kind.NAME, Quantity.TEXT),
        Column("wanted", Kind.NAME, Quantity.TEXT),
        Column("where it is missed", Kind.NAME, Quantity.PROSE),
    )
    rows = [
        Row(cells(columns, (t.name, words[t.met], t.found, t.wanted, t.detail)), "wrong" if t.met is False else "ok")
        for t in targets
    ]
    return Table("", columns, tuple(rows), (L2_RULE,))


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
        NAME_AND_MORE,
        Column("likely cause", Kind.NAME, Quantity.PROSE, explain="under the row's name", under=True),
        PUBLISHED_TIME,
        TIME_COLUMNS[0],
        RATIO,
        TIME_COLUMNS[1],
        *BOUND_COLUMNS,
    )
    rows = []
    for one in judged:
        time, extent = time_of(one)
        name = f"Table {one.row.table}: {one.row.row}"
        values = (name, likely_cause(one, gpu), one.row.published_us, time, one.ratio, extent, *bound_of(one))
        rows.append(Row(cells(columns, values), "broken" if one.row.modelled is None else "ok"))
    return Table(title, columns, tuple(rows), tuple(notes))


def _excluded(judged: Sequence[Judged]) -> Table:
    columns = (
        NAME_AND_MORE,
        Column("reason", Kind.NAME, Quantity.PROSE, under=True),
        Column("why", Kind.NAME, Quantity.TEXT),
        PUBLISHED_TIME,
        *TIME_COLUMNS,
        RATIO,
    )
    rows = [
        Row(cells(columns, (f"Table {one.row.table}: {one.row.row}", one.reason, one.status, one.row.published_us,
                             *time_of(one), one.ratio)))
        for one in judged
        if not one.comparable
    ]  # fmt: skip
    return Table("", columns, tuple(rows), (_with_all(judged),))


def _with_all(judged: Sequence[Judged]) -> str:
    """What the score would be if nothing were left out."""
    every = score([Judged(one.row, "comparable", "") for one in judged if one.row.published_us is not None])
    return (
        f"With these rows counted as well, {every.rows} in all: median {every.median_abs_log2:.3f}, worst "
        f"{every.worst_abs_log2:.3f}, pooled tau {every.pooled.tau or 0:.3f}."
    )


# --- the plot ---------------------------------------------------------------------------------------------------------


def _scatter_section(judged: Sequence[Judged]) -> Section:
    timed = [one for one in judged if one.ratio is not None]
    worst = sorted((one for one in timed if one.comparable), key=lambda one: -abs(error_log2(one) or 0))[:5]
    labelled = {id(one) for one in worst if abs(error_log2(one) or 0) > 0.5}
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
        NAME,
        Column("scored", Kind.NAME, Quantity.TEXT),
        PUBLISHED_TIME,
        *TIME_COLUMNS,
        *(Column(f"{term} [µs]", Kind.MODELLED, explain=TERM_WORDS[term]) for term in TERMS),
        Column("launch [µs]", Kind.MODELLED, explain="overhead of the launches"),
    )
    rows = []
    for one in timed:
        terms = one.row.modelled.terms if one.row.modelled else {}
        lengths = [1e6 * terms[term] if term in terms else None for term in (*TERMS, "launch")]
        name, scored = f"{one.row.table}: {one.row.row}", "yes" if one.comparable else one.status
        rows.append(Row(cells(columns, (name, scored, one.row.published_us, *time_of(one), *lengths))))
    data = Details("The same points as a table, with every term", (Table("", columns, tuple(rows)),))
    return Section(
        "Modelled against published", charts=(chart,) if timed else (), details=(data,),
        intro="On the line both are equal; the band is a factor of 2. Hollow marks are shown and not scored.",
    )  # fmt: skip


# --- constants, sensitivity, history ----------------------------------------------------------------------------------


def _sensitivity(found: Reproduction) -> Table:
    def percent(sign: str) -> str:
        return f"{sign}{100 * STEP:.0f} %"

    measures: tuple[tuple[str, Callable[[Score], float | None]], ...] = (
        ("median", lambda s: s.median_abs_log2),
        ("worst", lambda s: s.worst_abs_log2),
        ("tau", tau),
    )
    columns = [Column("constant", Kind.NAME, Quantity.CODE), Column("value", Kind.NAME, Quantity.NUMBER)]
    columns += [Column(f"{name} {percent(sign)}", Kind.MODELLED) for name, _ in measures for sign in "−+"]
    rows = [
        Row(
            cells(columns, ["as it is", None, *(value(found.score) for _, value in measures for _ in "−+")]),
            "ok",
            True,
        )
    ]
    for moved in sorted(found.moved, key=lambda m: -m.reach):
        values = [value(end) for _, value in measures for end in (moved.less, moved.more)]
        rows.append(Row(cells(columns, [moved.constant, moved.value, *values])))
    note = "median, worst: of |log2(modelled / published)|; tau: pooled."
    return Table("", tuple(columns), tuple(rows), (note,))


def _constants(constants: Constants) -> Table:
    columns = (
        Column("constant", Kind.NAME, Quantity.CODE),
        Column("value", Kind.NAME, Quantity.NUMBER),
        Column("confidence", Kind.NAME, Quantity.TEXT),
        Column("source", Kind.NAME, Quantity.PROSE),
    )
    rows = [Row(cells(columns, (name, c.value, c.confidence, c.source))) for name, c in constants.items()]
    return Table("", columns, tuple(rows))


def _history(history: Sequence[Frozen]) -> Table:
    columns = (
        Column("version", Kind.NAME, Quantity.TEXT),
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
        first = one.score or {}
        rows.append(
            Row(
                cells(
                    columns,
                    (one.version, one.date[:10], one.reason, one.note, str(first.get("date", "not yet"))[:10],
                     first.get("median_abs_log2"), first.get("worst_abs_log2"), first.get("geomean"),
                     first.get("kendall_tau", {}).get(POOLED)),
                )
            )
        )  # fmt: skip
    return Table("", columns, tuple(rows))


def _history_section(found: Reproduction) -> Section:
    intro = "A version fixes constants, kernels, datasets and the list of scored rows; its first score stays."
    tables = [_history(found.history)]
    if found.differs:
        columns = (Column("what differs in this run", Kind.NAME, Quantity.TEXT),)
        rows = tuple(Row(cells(columns, (line,))) for line in found.differs)
        tables.append(Table("Post-hoc" if found.history else "A rehearsal", columns, rows))
    elif found.history:
        intro += f" This run is {found.history[-1].version}, as frozen."
    return Section("Frozen versions and their scores", tuple(tables), intro=intro)


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
    if found.moved:
        lines.append(f"median, worst, pooled tau with one constant {100 * STEP:.0f} % less | more:")
    for moved in sorted(found.moved, key=lambda m: -m.reach):
        ends = (
            f"{s.median_abs_log2:.3f} {s.worst_abs_log2:.2f} {'–' if (t := tau(s)) is None else f'{t:.3f}'}"
            for s in (moved.less, moved.more)
        )
        lines.append(f"  {moved.constant}: {' | '.join(ends)}")
    lines += [f"post-hoc: {line}" for line in found.differs]
    return lines
