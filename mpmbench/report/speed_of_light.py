"""Two charts of a profile: how near each unit is to its limit, and the instruction roofline.

The roofline is that of N. Ding and S. Williams, An Instruction Roofline Model for GPUs (PMBS 2019): warp instructions
per 32-byte transaction of a memory level against warp instructions per second.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from mpmbench.gpu.modelled import TERMS
from mpmbench.profile_record import Profile
from mpmbench.record import Record
from mpmbench.report.advice import SECTOR_BYTES, binding
from mpmbench.report.plots import MUTED, RULE, SERIES, WIDTH, inline
from mpmbench.report.text import number

ROW_HEIGHT = 0.23  # [inch]
GIGA = 1e9
MARKERS = ("o", "s", "D")  # told apart without colour


@dataclass(frozen=True)
class SpeedOfLight:
    """One bar per unit. shares: its term over the modelled time.  binding: rows that bind, or may."""

    title: str
    axis: str
    labels: tuple[str, ...]
    shares: tuple[float, ...]
    binding: tuple[int, ...]


@dataclass(frozen=True)
class Level:
    """One memory level. intensity: warp instructions per transaction.  rate: transactions per second, at peak."""

    name: str
    intensity: float
    rate: float


@dataclass(frozen=True)
class Roofline:
    """achieved, low, high: warp instructions per second, at the modelled time and at the ends of its range."""

    title: str
    axis: str
    levels: tuple[Level, ...]
    peak: float  # warp instructions per second
    achieved: float
    low: float
    high: float


def unit_label(term: str) -> str:
    """Short name of a term."""
    return term.upper() if term in ("l1", "l2", "dram") else term


def speed_of_light(profile: Profile) -> SpeedOfLight:
    terms, seconds = profile.time.terms, profile.time.seconds
    shares = tuple(terms.get(term, 0.0) / seconds if seconds else 0.0 for term in TERMS)
    return SpeedOfLight(
        "Speed of light",
        f"time of each unit alone over the modelled time, {profile.title}: modelled",
        tuple(unit_label(term) for term in TERMS),
        shares,
        tuple(TERMS.index(term) for term in binding(profile)),
    )


def roofline(record: Record, profile: Profile) -> Roofline | None:
    """None where counts, peaks or time are not known."""
    counters, peak, time = record.transfer_counters, profile.peak, profile.time
    if counters is None or not peak.get("warp_inst") or not (time.seconds > 0 and time.low > 0 and time.high > 0):
        return None
    instructions = counters.total.warp_inst
    transactions = {"l1": counters.total.sectors, "l2": profile.memory.l2_sectors, "dram": profile.memory.dram_sectors}
    levels = tuple(
        Level(unit_label(name), instructions / count, peak[f"{name}_bytes"] / SECTOR_BYTES)
        for name, count in transactions.items()
        if count and peak.get(f"{name}_bytes")
    )
    if not levels or not instructions:
        return None
    return Roofline(
        "Instruction roofline",
        f"10⁹ warp instructions per second over warp instructions per 32-byte transaction, {profile.title}: modelled",
        levels,
        peak["warp_inst"],
        *(instructions / seconds for seconds in (time.seconds, time.high, time.low)),
    )


def draw(chart: SpeedOfLight | Roofline) -> str:
    return _bars(chart) if isinstance(chart, SpeedOfLight) else _roofline(chart)


def _bars(chart: SpeedOfLight) -> str:
    from matplotlib.figure import Figure

    figure = Figure((WIDTH, ROW_HEIGHT * len(chart.labels) + 0.1))
    axes = figure.add_axes((0.17, 0.0, 0.82, 1.0))
    for i, (label, share) in enumerate(zip(chart.labels, chart.shares, strict=True)):
        binds = i in chart.binding
        axes.barh(i, 1.0, height=0.62, facecolor="none", edgecolor=RULE, linewidth=0.6)
        axes.barh(i, min(share, 1.0), height=0.62, color=SERIES[1] if binds else SERIES[0])
        axes.text(-0.02, i, label, va="center", ha="right", fontsize=9, fontweight="bold" if binds else "normal")
        mark = "" if not binds else "  binds" if i == chart.binding[0] else "  may bind"
        axes.text(1.02, i, f"{100 * share:.0f} %{mark}", va="center", ha="left", fontsize=9)
    axes.set_xlim(0, 1.36)
    axes.set_ylim(len(chart.labels) - 0.4, -0.6)
    axes.axis("off")
    said = ", ".join(f"{label} {100 * share:.0f} %" for label, share in zip(chart.labels, chart.shares, strict=True))
    return inline(figure, f"{chart.title}: {chart.axis}: {said}")


def _roofline(chart: Roofline) -> str:
    from matplotlib.figure import Figure

    peak, achieved = chart.peak / GIGA, chart.achieved / GIGA
    knees = [chart.peak / level.rate for level in chart.levels]
    spots = [level.intensity for level in chart.levels]
    left, right = min(*knees, *spots) / 3, max(*knees, *spots) * 3
    legend_height = 0.18 * len(chart.levels)
    height = 2.5 + legend_height
    figure = Figure((WIDTH, height))
    axes = figure.add_axes((0.13, (legend_height + 0.5) / height, 0.84, 1.9 / height))
    axes.plot((left, right), (peak, peak), color=MUTED, linewidth=1.6)
    axes.text(left * 1.1, peak * 1.12, f"issue limit {number(peak)}", fontsize=8, va="bottom", ha="left")
    for i, (level, knee) in enumerate(zip(chart.levels, knees, strict=True)):
        axes.plot((left, knee), (left * level.rate / GIGA, peak), color=SERIES[i], linewidth=1.4)
        axes.plot(
            level.intensity, achieved, marker=MARKERS[i], color=SERIES[i], markersize=9 - i, linestyle="none",
            label=f"{level.name}: {number(level.intensity)} per transaction, limit {number(level.rate / GIGA)}·10⁹/s",
        )  # fmt: skip
        axes.plot((level.intensity,) * 2, (chart.low / GIGA, chart.high / GIGA), color=SERIES[i], linewidth=1.2)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlim(left, right)
    lowest = min(chart.low / GIGA, achieved, *(left * level.rate / GIGA for level in chart.levels))
    axes.set_ylim(max(lowest, peak / 1e5) / 1.5, peak * 2.6)
    _plain_numbers(axes, number)
    axes.grid(True, which="major")
    axes.set_xlabel("warp instructions per transaction")
    axes.legend(
        loc="upper left", bbox_to_anchor=(-0.1, -0.5 / 1.9), frameon=False, fontsize=9, labelspacing=0.35, borderpad=0,
        handlelength=1.2,
    )  # fmt: skip
    return inline(figure, f"{chart.title}: {chart.axis}")


def _plain_numbers(axes: Any, words: Callable[[float], str]) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1, 2, 5), numticks=8))
        axis.set_major_formatter(FuncFormatter(lambda value, _: words(value)))
        axis.set_minor_formatter(NullFormatter())
