"""Charts as small inline SVG that follows the page: its font, its colours, its dark mode.

matplotlib draws with placeholder colours, which are then replaced by CSS variables of the page. What would make an
SVG a document of its own (namespaces, metadata, ids nobody refers to) is taken out: it stands inside HTML.
"""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from mpmbench.report.text import number

if TYPE_CHECKING:
    from mpmbench.report.banks import BankPicture
    from mpmbench.report.scatter import Scatter
    from mpmbench.report.speed_of_light import Roofline, SpeedOfLight

INK = "#010101"
RULE = "#020202"
SERIES = tuple(f"#03030{i}" for i in range(8))  # --series-0 ... --series-7
MUTED = "#040404"
DASHES = ("solid", (0, (5, 1.5)), (0, (1.5, 1)), (0, (6, 1.5, 1.5, 1.5)))

WIDTH = 4.6  # [inch], drawn at 72 per inch: legible when scaled to a telephone's width
BAR_HEIGHT = 0.42
MOST_BARS = 20
LONGEST_LABEL = 56  # characters that fit in the width


@dataclass(frozen=True)
class Bars:
    """One horizontal bar per strategy. highlight: index of the baseline, drawn muted; None if it is not there."""

    title: str
    axis: str
    labels: tuple[str, ...]
    values: tuple[float, ...]
    highlight: int | None = None


@dataclass(frozen=True)
class Line:
    label: str
    x: tuple[float, ...]
    y: tuple[float, ...]
    baseline: bool = False


@dataclass(frozen=True)
class Lines:
    """Curves over logarithmic axes."""

    title: str
    axis: str  # what the vertical axis shows
    x_axis: str
    lines: tuple[Line, ...]


@lru_cache(maxsize=256)
def svg(chart: Bars | Lines | BankPicture | Scatter | SpeedOfLight | Roofline) -> str:
    """An ``<svg>`` element. Kept, as a page that comes out too large is laid out again with less on it."""
    import matplotlib

    style: dict[Any, Any] = {
        "svg.fonttype": "none",  # text stays text: small, selectable, in the page's font
        "svg.hashsalt": chart.title,  # ids that do not change from run to run
        "font.size": 10,
        "text.color": INK,
        "axes.labelcolor": INK,
        "axes.edgecolor": RULE,
        "xtick.color": INK,
        "ytick.color": INK,
        "grid.color": RULE,
        "grid.linewidth": 0.6,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "path.simplify": True,
    }
    with matplotlib.rc_context(style):
        if isinstance(chart, Bars):
            return _bars(chart)
        if isinstance(chart, Lines):
            return _lines(chart)
        from mpmbench.report import banks, scatter, speed_of_light

        if isinstance(chart, banks.BankPicture):
            return banks.draw(chart)
        if isinstance(chart, scatter.Scatter):
            return scatter.draw(chart)
        return speed_of_light.draw(chart)


def _bars(chart: Bars) -> str:
    from matplotlib.figure import Figure

    labels, values = chart.labels[:MOST_BARS], chart.values[:MOST_BARS]
    figure = Figure((WIDTH, BAR_HEIGHT * len(values) + 0.5))
    axes = figure.add_axes((0.01, 0.0, 0.98, 1.0))
    top = max(values) or 1.0
    for i, (label, value) in enumerate(zip(labels, values, strict=True)):
        colour = MUTED if i == chart.highlight else SERIES[0]
        axes.barh(i, value, height=0.38, color=colour)
        # The name stands over its bar: beside it, there would be no room left on a narrow screen.
        axes.text(0, i - 0.28, _fit(label), va="bottom", ha="left", fontsize=9)
        axes.text(value + 0.012 * top, i, number(value), va="center", ha="left", fontsize=9)
    axes.set_xlim(0, 1.14 * top)
    axes.set_ylim(len(values) - 0.6, -0.9)
    axes.axis("off")
    return inline(figure, f"{chart.title}: {chart.axis}")


def _lines(chart: Lines) -> str:
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    legend_height = 0.2 * len(chart.lines) + 0.1
    plot_height = 3.0
    height = plot_height + legend_height
    figure = Figure((WIDTH, height))
    axes = figure.add_axes((0.13, (legend_height + 0.5) / height, 0.83, (plot_height - 0.62) / height))
    series = 0
    for line in chart.lines:
        if line.baseline:
            axes.plot(line.x, line.y, color=MUTED, linewidth=2.2, label=f"{_fit(line.label)} (baseline)")
        else:
            axes.plot(
                line.x, line.y, color=SERIES[series % len(SERIES)], linewidth=1.6, label=_fit(line.label),
                linestyle=DASHES[series % len(DASHES)],
            )  # fmt: skip
            series += 1
    axes.set_xscale("log")
    axes.set_yscale("log")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(FuncFormatter(lambda value, _: number(value)))
        axis.set_minor_formatter(NullFormatter())
    low, high = axes.get_ylim()
    if high / low < 300:  # powers of ten alone would be too few to read a value off
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.grid(True, which="major")
    axes.margins(x=0)
    axes.set_xlabel(chart.x_axis)
    axes.legend(
        loc="upper left", bbox_to_anchor=(-0.02, -0.5 / (plot_height - 0.62)), frameon=False, fontsize=9,
        labelspacing=0.35, borderpad=0, handlelength=2.6,
    )  # fmt: skip
    return inline(figure, f"{chart.title}: {chart.axis}")


def _fit(label: str) -> str:
    return label if len(label) <= LONGEST_LABEL else f"{label[: LONGEST_LABEL - 1]}…"


def inline(figure: object, label: str) -> str:
    """SVG text fit to stand inside an HTML page, described for those who cannot see it."""
    from html import escape

    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})  # type: ignore[attr-defined]
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'\s(?:xmlns(?::\w+)?|version)="[^"]*"', "", text)
    text = text.replace("xlink:href", "href")
    used = set(re.findall(r'(?:href="#|url\(#)([^")]+)', text))
    text = re.sub(r' id="([^"]*)"', lambda m: m[0] if m[1] in used else "", text)
    text = re.sub(r"<!--.*?-->\s*", "", text, flags=re.DOTALL)
    text = re.sub(r"""font: ([\d.]+px) [^;"]*(?=[;"])""", r"font-size: \1", text)
    colours = {INK: "currentColor", RULE: "var(--rule)", MUTED: "var(--muted)"}
    colours |= {colour: f"var(--series-{i})" for i, colour in enumerate(SERIES)}
    for colour, variable in colours.items():
        text = text.replace(colour, variable)
    text = re.sub(r"(\d+\.\d{2})\d+", r"\1", text)
    # The figure's own width would keep the page from being narrower.
    head = text[: text.index(">")]
    slim = re.sub(r'\s(?:width|height)="[^"]*"', "", head)
    text = f'{slim} role="img" aria-label="{escape(label, quote=True)}"{text[len(head) :]}'
    return re.sub(r">\s+<", "><", text).strip()


def logspace(low: float, high: float, count: int) -> tuple[float, ...]:
    """``count`` numbers from ``low`` to ``high`` at equal ratios."""
    ratio = (high / low) ** (1 / (count - 1))
    return tuple(low * ratio**i for i in range(count))


def thin(lines: Sequence[Line], most: int = 8) -> tuple[Line, ...]:
    """The baseline and those lines that come nearest to the best somewhere; a chart of more cannot be read."""
    if not lines:
        return ()
    best = [min(column) for column in zip(*(line.y for line in lines), strict=True)]

    def distance(line: Line) -> float:
        return min((y / b if b else 1.0) for y, b in zip(line.y, best, strict=True))

    chosen = sorted((line for line in lines if not line.baseline), key=distance)[: most - 1]
    return tuple(line for line in lines if line.baseline or line in chosen)
