"""Distributions of samples: a box and the samples themselves per strategy of a contest.

Each strategy is drawn around its own median, so that a noise of one per cent is seen beside times that differ tenfold.
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mpmbench.report.plots import INK, MUTED, RULE, SERIES, WIDTH, first_of, fit, inline
from mpmbench.report.table import Cell, Column, Group, Kind, Quantity, Row, Table
from mpmbench.report.text import number, seconds_text

MOST_STRIPS = 20
MOST_TICKS = 40  # per strip; more samples are drawn by as many of their quantiles
ROW_HEIGHT = 0.5  # [inch]
LONGEST_LABEL = 50
FENCE = 3  # interquartile ranges beyond the quartiles: Tukey's outer fence, beyond which are outliers
WIDEST = 4  # spreads of the typical strip; what lies further out is counted at the edge


@dataclass(frozen=True)
class Strip:
    """samples: over their median, less 1, ascending.  seconds: the same [s]."""

    label: str
    samples: tuple[float, ...]
    seconds: tuple[float, ...]
    baseline: bool = False


@dataclass(frozen=True)
class Strips:
    title: str
    axis: str
    strips: tuple[Strip, ...]
    kind: Kind


def chart(g: Group) -> Strips | None:
    """Of all rows with times, in the order of their ranking; None where there are too few samples to show."""
    strips = []
    for record in g.ranked:
        time = record.transfer_measurement
        if time is not None and len(time.samples) > 1 and time.median > 0:
            ordered = tuple(sorted(time.samples))
            around = tuple(sample / time.median - 1 for sample in ordered)
            strips.append(Strip(g.label(record), around, ordered, record is g.baseline))
    if not strips or all(strip.samples[0] == strip.samples[-1] for strip in strips):
        return None
    clock = "wall clock" if g.kind is Kind.WALL else "measured"
    axis = f"each sample over its strategy's median [%], {clock}; box: q1 to q3, line: 5 % to 95 %"
    axis += first_of(len(strips), MOST_STRIPS)
    return Strips("Distribution of samples", axis, tuple(strips), g.kind)


def data(drawn: Strips) -> Table:
    """Quantiles of every strip."""
    names = ("least", "5 %", "q1", "median", "q3", "95 %", "most")
    columns = (
        Column("strategy", Kind.NAME, Quantity.CODE),
        Column("samples", drawn.kind, Quantity.COUNT),
        *(Column(name, drawn.kind, Quantity.SECONDS) for name in names),
    )
    rows = []
    for strip in drawn.strips:
        quantiles = np.quantile(strip.seconds, (0, 0.05, 0.25, 0.5, 0.75, 0.95, 1)).tolist()
        values = (strip.label, len(strip.seconds), *quantiles)
        cells = tuple(Cell(v, c.kind) for v, c in zip(values, columns, strict=True))
        rows.append(Row(cells, baseline=strip.baseline))
    return Table("", columns, tuple(rows))


def draw(drawn: Strips) -> str:
    """The plot as SVG."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    strips = drawn.strips[:MOST_STRIPS]
    low, high = (100 * end for end in limits(strips))
    height = ROW_HEIGHT * len(strips) + 0.5
    figure = Figure((WIDTH, height))
    axes = figure.add_axes((0.01, 0.42 / height, 0.98, 1 - 0.42 / height))
    axes.set_xlim(low, high)
    axes.set_ylim(len(strips) - 0.45, -0.75)
    for i, strip in enumerate(strips):
        colour = MUTED if strip.baseline else SERIES[0]
        values = 100 * np.asarray(strip.samples)
        p5, q1, median, q3, p95 = np.clip(np.quantile(values, (0.05, 0.25, 0.5, 0.75, 0.95)), low, high)
        axes.plot((p5, p95), (i, i), color=colour, linewidth=1.2, solid_capstyle="butt")
        axes.barh(i, q3 - q1, left=q1, height=0.24, facecolor=colour, alpha=0.45, linewidth=0)
        axes.plot((median, median), (i - 0.16, i + 0.16), color=INK, linewidth=1.4)
        ticks = values if len(values) <= MOST_TICKS else np.quantile(values, np.linspace(0, 1, MOST_TICKS))
        ticks = ticks[(ticks >= low) & (ticks <= high)]
        x = np.repeat(ticks, 3)  # all ticks are one path, with gaps
        y = np.tile((i + 0.19, i + 0.31, np.nan), len(ticks))
        axes.plot(x, y, color=colour, linewidth=0.7)
        for outside, at, side in ((values < low, low, "left"), (values > high, high, "right")):
            if outside.any():
                axes.text(at, i + 0.02, f"{outside.sum()} beyond", va="center", ha=side, fontsize=7.5)
        # The name stands over its strip: beside it, there would be no room left on a narrow screen.
        name = fit(strip.label + (" (baseline)" if strip.baseline else ""), LONGEST_LABEL)
        axes.text(low, i - 0.24, name, va="bottom", ha="left", fontsize=9)
        text = seconds_text(statistics.median(strip.seconds))
        axes.text(high, i - 0.24, text, va="bottom", ha="right", fontsize=9)
    axes.axvline(0, color=RULE, linewidth=0.8, zorder=0)
    for side in ("left", "bottom"):
        axes.spines[side].set_visible(False)
    axes.set_yticks([])
    # A number at the very edge would be cut off.
    axes.set_xticks([x for x in MaxNLocator(6).tick_values(low, high) if 0.88 * low < x < 0.88 * high])
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:+g} %" if value else "median")
    axes.tick_params(length=0)
    axes.grid(True, axis="x")
    said = ", ".join(f"{strip.label} {_spread(strip)}" for strip in strips)
    return inline(figure, f"{drawn.title}: {drawn.axis}: {said}")


def limits(strips: Sequence[Strip]) -> tuple[float, float]:
    """What the axis shows, over the median: all but outliers, and not so much that the calm strips vanish."""
    quartiles = [np.quantile(strip.samples, (0.25, 0.75)).tolist() for strip in strips]
    lows = [-max(strip.samples[0], q1 - FENCE * (q3 - q1)) for strip, (q1, q3) in zip(strips, quartiles, strict=True)]
    highs = [min(strip.samples[-1], q3 + FENCE * (q3 - q1)) for strip, (q1, q3) in zip(strips, quartiles, strict=True)]
    low = min(max(lows), WIDEST * max(statistics.median(lows), 1e-4))
    high = min(max(highs), WIDEST * max(statistics.median(highs), 1e-4))
    least = max(low, high, 1e-4) / 4  # neither side so narrow that the median falls on the edge
    return -max(low, least) * 1.1, max(high, least) * 1.1


def _spread(strip: Strip) -> str:
    q1, q3 = np.quantile(strip.samples, (0.25, 0.75))
    return f"{number(100 * float(q1))} to {number(100 * float(q3))} %"
