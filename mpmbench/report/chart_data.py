"""What a chart shows, as a table: to be folded beneath it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mpmbench.report import distributions
from mpmbench.report.banks import BankPicture
from mpmbench.report.distributions import Strips
from mpmbench.report.plots import Bars, Lines
from mpmbench.report.scatter import Scatter
from mpmbench.report.speed_of_light import Roofline, SpeedOfLight
from mpmbench.report.table import Column, Kind, Quantity, Table, _row

Chart = Bars | Lines | BankPicture | Scatter | SpeedOfLight | Roofline | Strips

MOST_POINTS = 12  # of a curve; a smooth one is told by fewer points than it is drawn by


def data(chart: Chart) -> Table | None:
    """The numbers of a chart, each of its kind; None for charts whose section has them as a table of its own."""
    match chart:
        case Bars():
            return _bars(chart)
        case Lines():
            return _lines(chart)
        case Strips():
            return distributions.data(chart)
        case SpeedOfLight():
            columns = (Column("unit", Kind.NAME, Quantity.TEXT), Column("share", Kind.MODELLED, Quantity.SHARE))
            return _table(columns, list(zip(chart.labels, chart.shares, strict=True)))
        case Roofline():
            return _roofline(chart)
    return None


def _table(columns: Sequence[Column], values: Sequence[Sequence[Any]], baseline: int | None = None) -> Table:
    rows = tuple(_row(row, columns, baseline=i == baseline) for i, row in enumerate(values))
    return Table("", tuple(columns), rows)


def _bars(chart: Bars) -> Table:
    columns = (Column("strategy", Kind.NAME, Quantity.CODE), Column(chart.axis, chart.kind))
    return _table(columns, list(zip(chart.labels, chart.values, strict=True)))


def _lines(chart: Lines) -> Table:
    """A row per curve, a column per place: the curves have names, which would be wide as headings."""
    places = sorted({x for line in chart.lines for x in line.x})
    step = -(-(len(places) - 1) // (MOST_POINTS - 1)) or 1
    places = places[::step]
    columns = (
        Column("strategy", Kind.NAME, Quantity.CODE),
        *(Column(f"{x:,.10g}", chart.kind, explain=f"{chart.axis} at {x:,.10g} {chart.x_axis}") for x in places),
    )
    values = []
    baseline = None
    for i, line in enumerate(chart.lines):
        at = dict(zip(line.x, line.y, strict=True))
        values.append((line.label, *(at.get(x) for x in places)))
        baseline = i if line.baseline else baseline
    table = _table(columns, values, baseline)
    return Table("", table.columns, table.rows, (f"Columns: {chart.x_axis}. Numbers: {chart.axis}.",))


def _roofline(chart: Roofline) -> Table:
    columns = (
        Column("level", Kind.NAME, Quantity.TEXT),
        Column("warp inst / transaction", Kind.MODELLED),
        Column("transactions / s", Kind.MODELLED, Quantity.RATE),
        Column("warp inst / s", Kind.MODELLED, Quantity.RATE),
        Column("at most", Kind.MODELLED, Quantity.RATE),
    )
    values = [
        (level.name, level.intensity, level.rate, chart.achieved, min(chart.peak, level.intensity * level.rate))
        for level in chart.levels
    ]
    return _table(columns, values)
