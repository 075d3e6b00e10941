"""Searches for the best axes: every configuration that was tried, the losers included."""

from __future__ import annotations

from mpmbench.record import Record, Tuning
from mpmbench.report import table as tables
from mpmbench.report.table import Cell, Column, Group, Kind, Quantity, Row, Table

KINDS = {"measured (events)": Kind.MEASURED, "measured (wall, CPU)": Kind.WALL, "modelled": Kind.MODELLED}


def found(g: Group) -> list[Table]:
    """One table per row of the group whose axes were searched for."""
    return [table(record, record.tuning, g.label(record)) for record in g.records if record.tuning is not None]


def table(record: Record, tuning: Tuning, name: str) -> Table:
    """The chosen configuration first, the others by their times."""
    kind = KINDS.get(tuning.kind, Kind.MEASURED)
    times = [tried.seconds for tried in tuning.tried if tried.seconds is not None]
    columns = (
        Column("configuration", Kind.NAME, Quantity.CODE),
        Column("time", kind, Quantity.SECONDS, "less", "in the search; the ranking has the time of its own rounds"),
        Column("over the fastest", kind, Quantity.FACTOR),
        Column("remark", Kind.NAME, Quantity.PROSE),
    )
    chosen, *losers = tuning.tried or (None,)
    losers.sort(key=lambda tried: (tried.seconds is None, tried.seconds or 0.0))
    rows = []
    for tried in filter(None, (chosen, *losers)):
        ratio = tried.seconds / min(times) if tried.seconds is not None and min(times) else None
        axes = {axis: tried.axes[axis] for axis in tuning.searched if axis in tried.axes} or tried.axes
        values = (tables.axes_text(axes), tried.seconds, ratio, tried.reason or ("chosen" if tried is chosen else ""))
        cells = tuple(Cell(v, c.kind) for v, c in zip(values, columns, strict=True))
        rows.append(Row(cells, "ok" if tried.seconds is not None else "skipped"))
    where = f" for {tuning.gpu}" if tuning.gpu else ""
    searched = " and ".join(axis.replace("_", " ") for axis in tuning.searched)
    note = (
        f"Searched: {searched}. {len(tuning.tried):,} of {tuning.possible:,} possible configurations tried, "
        f"{tuning.budget:,} allowed. Times: {tuning.kind}{where}."
    )
    return Table(f"Search of {name}", columns, tuple(rows), (note,))
