"""Tables 3-18 of the thesis as sections of the page: printed figures, and ours beside them in columns of their own."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from mpmbench.banks import GROUPS, BankPattern
from mpmbench.gpu import Gpu
from mpmbench.presets import PRIMITIVE_TABLES, TRANSFER_TABLES, published_rows
from mpmbench.report import banks
from mpmbench.report.document import Section
from mpmbench.report.table import Column, Kind, Quantity, Row, Table
from mpmbench.reproduce.cells import BOUND_COLUMNS, NAME, PUBLISHED_TIME, RATIO, TIME_COLUMNS, bound_of, cells, time_of
from mpmbench.reproduce.comparable import Judged
from mpmbench.reproduce.score import FEWEST_PAIRS, pairs
from mpmbench.reproduce.targets import implied_bytes, published_occupancy

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
TABLES = (*PRIMITIVE_TABLES, *TRANSFER_TABLES)  # that hold times


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


def times_section(table: int, judged: Sequence[Judged], gpu: Gpu) -> Section:
    """One of tables 5-16: times, then counters."""
    judged = [one for one in judged if one.row.table == table]
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
    return Section(title, (_times(judged, notes), _counters(judged, gpu)))


def _times(judged: Sequence[Judged], notes: Sequence[str]) -> Table:
    columns = (
        NAME,
        Column("", Kind.NAME, Quantity.TEXT, under=True),  # why it is not scored
        PUBLISHED_TIME,
        Column("rank", Kind.PUBLISHED, Quantity.RANK, explain="by published time"),
        Column("speedup as printed", Kind.PUBLISHED, Quantity.PRINTED, explain="as printed"),
        Column("speedup by the times", Kind.PUBLISHED, Quantity.FACTOR, explain="baseline's published time over this"),
        *TIME_COLUMNS,
        RATIO,
        Column("rank", Kind.MODELLED, Quantity.RANK, explain="by modelled time"),
        Column("speedup", Kind.MODELLED, Quantity.FACTOR, explain="baseline's modelled time over this"),
        *BOUND_COLUMNS,
    )
    baselines = baselines_of(judged)
    published_ranks = ranks([one.row.published_us for one in judged])
    modelled_ranks = ranks([one.row.modelled_us for one in judged])
    rows = []
    for one, base, published_rank, modelled_rank in zip(
        judged, baselines, published_ranks, modelled_ranks, strict=True
    ):
        times = (base.row.published_us, base.row.modelled_us) if base else (None, None)
        values = (
            one.row.row, "" if one.comparable else f"not scored: {one.status}",
            one.row.published_us, published_rank, _printed(one).get("speedup") or None,
            _over(times[0], one.row.published_us), *time_of(one), one.ratio, modelled_rank,
            _over(times[1], one.row.modelled_us), *bound_of(one),
        )  # fmt: skip
        status = "broken" if one.row.modelled is None else "ok" if one.comparable else "out"
        rows.append(Row(cells(columns, values), status))
    return _without_empty(Table("Times", columns, tuple(rows), tuple(notes)))


def _counters(judged: Sequence[Judged], gpu: Gpu) -> Table:
    """Printed metrics, then ours, kind by kind; a metric of one side alone is shown as well."""
    titles = {metric.name: metric.title for metric in METRICS}
    keys = dict.fromkeys(key for one in judged for key, value in one.row.published.items() if value)
    printed = [key for key in keys if key not in _NOT_METRICS]
    columns = [NAME]
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
        Row(cells(columns, [source(one) for source in sources]), "ok" if one.comparable else "out") for one in judged
    ]
    return _without_empty(Table("Counters", tuple(columns), tuple(rows)))


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


def errors_section(table: int, verified: Mapping[str, Mapping[str, Any]]) -> Section:
    """Errors: printed ones, and ours from a run of ``mpmbench verify``."""
    printed = published_rows(table)
    skipped = ("table", "erratum")
    columns = [
        NAME,
        *(
            Column(key.replace("_", " "), Kind.PUBLISHED, Quantity.PRINTED)
            for key in printed[0]
            if key not in ("row", *skipped)
        ),
    ]
    rows = [
        Row(cells(columns, [row["row"], *(row[key] for key in row if key not in ("row", *skipped))])) for row in printed
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
        intro += f"Ours are from mpmbench verify, {when.get('date', 'undated')[:10]}. {part['intro']}"
    return Section(f"Table {table}: {TITLES[table]}", tuple(tables), intro=intro)


def _from_json(content: Mapping[str, Any]) -> Table:
    """A table of ``mpmbench verify --json``."""
    columns = []
    for i, column in enumerate(content["columns"]):
        kind = Kind(column["kind"])
        words = any(isinstance(row[i], str) for row in content["rows"])
        quantity = Quantity.TEXT if words else Quantity.PRINTED if kind is Kind.PUBLISHED else Quantity.NUMBER
        columns.append(Column(column["title"], kind, quantity))
    rows = [Row(cells(columns, row)) for row in content["rows"]]
    return Table(content["title"], tuple(columns), tuple(rows), tuple(content["notes"]))


def banks_section(table: int) -> Section:
    """Banks that the printed rows name, and those that follow from the block's shape."""
    printed = published_rows(table)
    width = int(printed[0]["block_x"])
    # The printed rows follow each other without the halo between layers: a block of one layer.
    flat = BankPattern((width, 32 // width, 1))
    full = BankPattern((width, 4, 4))
    across = flat.arena[0]
    columns = (
        Column("row as printed", Kind.NAME, Quantity.TEXT),
        Column("bank groups", Kind.PUBLISHED, Quantity.CODE, explain="as printed, place by place"),
        Column("bank groups", Kind.PREDICTED, Quantity.CODE, explain="place modulo 8"),
        Column("same", Kind.PREDICTED, Quantity.TEXT),
    )
    rows = []
    for row in printed:
        ours = " ".join(str((int(row["y"]) * across + x) % GROUPS) for x in range(across))
        same = "yes" if ours == row["banks"] else "no"
        rows.append(Row(cells(columns, (row["row"], row["banks"], ours, same)), "ok" if same == "yes" else "wrong"))
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


def _without_empty(table: Table) -> Table:
    """Without the columns that no row fills."""
    kept = [
        i
        for i in range(len(table.columns))
        if table.columns[i].under or any(row.cells[i].value not in (None, "") for row in table.rows)
    ]
    rows = (Row(tuple(row.cells[i] for i in kept), row.status, row.baseline) for row in table.rows)
    return Table(table.title, tuple(table.columns[i] for i in kept), tuple(rows), table.notes)
