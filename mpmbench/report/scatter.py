"""Modelled against published times, one mark per row, over logarithmic axes of equal length."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from mpmbench.report.plots import INK, MUTED, RULE, SERIES, WIDTH, inline
from mpmbench.report.text import number

MARKS = ("o", "s", "^", "D", "v")  # shape tells series apart where colour does not


@dataclass(frozen=True)
class Point:
    """label: shown beside the mark; "" for none.  filled: whether the row is scored."""

    x: float
    y: float
    label: str = ""
    filled: bool = True


@dataclass(frozen=True)
class Scatter:
    """Points of a few series against the line y = x, in a band of a factor 2 to either side."""

    title: str
    axis: str
    x_axis: str
    series: tuple[tuple[str, tuple[Point, ...]], ...]


def draw(chart: Scatter) -> str:
    """The plot as SVG."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, NullFormatter

    values = [value for _, points in chart.series for point in points for value in (point.x, point.y)]
    if not values:
        return ""
    low, high = min(values) / 1.6, max(values) * 1.6
    figure = Figure((WIDTH, WIDTH + 0.35))
    axes = figure.add_axes((0.15, 0.16, 0.82, 0.78))
    axes.fill_between((low, high), (low / 2, high / 2), (low * 2, high * 2), color=RULE, alpha=0.35, linewidth=0)
    axes.plot((low, high), (low, high), color=MUTED, linewidth=1)
    for i, (name, points) in enumerate(chart.series):
        colour = SERIES[i % len(SERIES)]
        for filled in (True, False):
            chosen = [point for point in points if point.filled is filled]
            axes.scatter(
                [p.x for p in chosen], [p.y for p in chosen], s=26, marker=MARKS[i % len(MARKS)], edgecolors=colour,
                facecolors=colour if filled else "none", linewidths=1.1, label=name if filled else None,
            )  # fmt: skip
    for point, offset in _label_offsets([p for _, points in chart.series for p in points if p.label]):
        above = point.y > point.x
        axes.annotate(
            point.label, (point.x, point.y), (0, offset if above else -offset), textcoords="offset points", fontsize=8,
            ha="right" if above else "left", va="bottom" if above else "top", color=INK,
        )  # fmt: skip
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlim(low, high)
    axes.set_ylim(low, high)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(FuncFormatter(lambda value, _: number(value)))
        axis.set_minor_formatter(NullFormatter())
    axes.grid(True, which="major")
    axes.set_xlabel(chart.x_axis)
    axes.set_ylabel(chart.axis)
    figure.legend(loc="lower center", ncols=len(chart.series), frameon=False, fontsize=9, handletextpad=0.2)
    return inline(figure, f"{chart.title}: {chart.axis} over {chart.x_axis}")


def _label_offsets(points: Sequence[Point]) -> list[tuple[Point, int]]:
    """Distance of each label from its mark [points]: further out where a neighbour's label stands already."""
    placed: list[tuple[Point, int]] = []
    for point in sorted(points, key=lambda p: abs(math.log(p.y / p.x))):
        near = [
            offset
            for other, offset in placed
            if abs(math.log10(other.x / point.x)) < 0.8
            and abs(math.log10(other.y / point.y)) < 0.2
            and (other.y > other.x) == (point.y > point.x)
        ]
        placed.append((point, max(near, default=-5) + 11))
    return placed
