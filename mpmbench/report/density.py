"""Strategy against density: time per particle over particles per cell, a line per strategy and order of particles."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mpmbench.record import DatasetSummary, Record
from mpmbench.report import table as tables
from mpmbench.report.plots import Line, Lines
from mpmbench.report.table import Cell, Column, Group, Kind, Quantity, Row, Table
from mpmbench.report.text import number

MOST_LINES = 8
EXPLANATION = (
    "Time of the transfer alone, per particle, without the sort. Of several choices of axes the fastest at each "
    "density is shown."
)


def per_cell(dataset: DatasetSummary) -> float | None:
    """Particles per cell: as asked for, else the mean over cells that hold any."""
    found = dataset.recipe.get("particles_per_cell") or dataset.statistics.get("mean_per_occupied_cell")
    return float(found) if isinstance(found, int | float) and found > 0 else None


def charts(groups: Sequence[Group]) -> list[tuple[Lines, Table]]:
    """One chart, and all its numbers, per kind of dataset that was timed at two densities or more."""
    alike: dict[Any, list[Group]] = {}
    for g in groups:
        first = g.first
        if not g.simulated and g.ranked and per_cell(first.dataset) is not None:
            key = (first.transfer, first.dataset.name, g.device, first.device, tables.problem_text(first), g.caches)
            alike.setdefault(key, []).append(g)
    found = []
    for same in alike.values():
        times = _times(same)
        densities = sorted({density for line in times.values() for density in line})
        if len(densities) > 1:
            found.append((_chart(same[0], times), _table(same[0], times, densities)))
    return found


# (strategy, order of particles) -> particles per cell -> [s per particle]
_Times = dict[tuple[str, str], dict[float, float]]


def _times(groups: Sequence[Group]) -> _Times:
    times: _Times = {}
    for g in groups:
        for record in g.ranked:
            assert record.transfer_measurement is not None
            density, n = per_cell(record.dataset), record.dataset.n
            if density is None or not n:
                continue
            line = times.setdefault((record.variant, _order(record)), {})
            line[density] = min(line.get(density, float("inf")), record.transfer_measurement.median / n)
    return times


def _order(record: Record) -> str:
    order = record.axes.get("particle_order")
    if order in (None, "given"):  # then it is the dataset that has one
        return str(record.dataset.recipe.get("order", order or ""))
    return str(order)


def _title(g: Group) -> str:
    parts = [f"{g.first.transfer.upper()} on {g.first.dataset.name}", tables.problem_text(g.first), g.caches, g.device]
    return ", ".join(filter(None, parts))


def _chart(g: Group, times: _Times) -> Lines:
    best = {d: min(line[d] for line in times.values() if d in line) for line in times.values() for d in line}
    near = sorted(times, key=lambda key: min(time / best[d] for d, time in times[key].items()))[:MOST_LINES]
    lines = tuple(
        Line(
            _name(key),
            tuple(sorted(times[key])),
            tuple(1e9 * times[key][d] for d in sorted(times[key])),
            key[0] == tables.BASELINES.get(g.first.transfer) and sum(k[0] == key[0] for k in times) == 1,
        )
        for key in times
        if key in near
    )
    clock = "wall clock" if g.kind is Kind.WALL else "measured"
    return Lines(_title(g), f"time per particle [ns], {clock}", "particles per cell", lines, g.kind, marks=True)


def _table(g: Group, times: _Times, densities: Sequence[float]) -> Table:
    columns = (
        Column("strategy", Kind.NAME, Quantity.CODE),
        Column("order", Kind.NAME, Quantity.TEXT),
        *(Column(f"{number(d)} per cell", g.kind, Quantity.SECONDS, "less") for d in densities),
    )
    rows = tuple(
        Row(tuple(Cell(v, c.kind) for v, c in zip((*key, *map(line.get, densities)), columns, strict=True)))
        for key, line in times.items()
    )
    return Table(f"Time per particle: {_title(g)}", columns, rows)


def _name(key: tuple[str, str]) -> str:
    return f"{key[0]}, {key[1]}" if key[1] else key[0]
