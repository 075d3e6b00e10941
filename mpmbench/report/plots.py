"""Charts as small inline SVG that follows the page: its font, its colours, its dark mode.

matplotlib draws with placeholder colours, which are then replaced by CSS variables of the page. What would make an
SVG a document of its own (namespaces, metadata, ids nobody refers to) is taken out: it stands inside HTML.
"""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from mpmbench.report.table import Kind
from mpmbench.report.text import number

if TYPE_CHECKING:
    from mpmbench.report.banks import BankPicture
    from mpmbench.report.distributions import Strips
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
    kind: Kind = Kind.SIMULATED


@dataclass(frozen=True)
class Line:
    """band: lower and upper ends around y, where they are known."""

    label: str
    x: tuple[float, ...]
    y: tuple[float, ...]
    baseline: bool = False
    band: tuple[tuple[float, ...], tuple[float, ...]] | None = None


@dataclass(frozen=True)
class Lines:
    """Curves over logarithmic axes. marks: whether only the points are known, not what lies between."""

    title: str
    axis: str  # what the vertical axis shows
    x_axis: str
    lines: tuple[Line, ...]
    kind: Kind = Kind.SIMULATED
    marks: bool = False


@lru_cache(maxsize=256)
def svg(chart: Bars | Lines | BankPicture | Scatter | SpeedOfLight | Roofline | Strips) -> str:
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
        from mpmbench.report import banks, distributions, scatter, speed_of_light

        if isinstance(chart, distributions.Strips):
            return distributions.draw(chart)
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
        axes.text(0, i - 0.28, fit(label), va="bottom", ha="left", fontsize=9)
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
        colour = MUTED if line.baseline else SERIES[series % len(SERIES)]
        if line.band:
            axes.fill_between(line.x, *line.band, color=colour, alpha=0.2, linewidth=0)
        mark: dict[str, Any] = {"marker": "o", "markersize": 3.5} if chart.marks else {}
        if line.baseline:
            axes.plot(line.x, line.y, color=colour, linewidth=2.2, label=f"{fit(line.label)} (baseline)", **mark)
        else:
            axes.plot(
                line.x, line.y, color=colour, linewidth=1.6, label=fit(line.label),
                linestyle=DASHES[series % len(DASHES)], **mark,
            )  # fmt: skip
            series += 1
    axes.set_xscale("log")
    axes.set_yscale("log")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(FuncFormatter(lambda value, _: number(value)))
        axis.set_minor_formatter(NullFormatter())
    for axis, (low, high) in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
        if high / low < 300:  # powers of ten alone would be too few to read a value off
            axis.set_major_locator(LogLocator(subs=(1, 2, 5) if high / low > 5 else (1, 1.5, 2, 3, 4, 5, 6, 8)))
    axes.grid(True, which="major")
    axes.margins(x=0.02 if chart.marks else 0)
    axes.set_xlabel(chart.x_axis)
    axes.legend(
        loc="upper left", bbox_to_anchor=(-0.02, -0.5 / (plot_height - 0.62)), frameon=False, fontsize=9,
        labelspacing=0.35, borderpad=0, handlelength=2.6,
    )  # fmt: skip
    return inline(figure, f"{chart.title}: {chart.axis}")


def first_of(count: int, most: int) -> str:
    """For a chart that shows some of what it was given; its data has all."""
    return f"; the first {most} of {count}" if count > most else ""


def fit(label: str, longest: int = LONGEST_LABEL) -> str:
    """A label that fits in the width of a chart."""
    return label if len(label) <= longest else f"{label[: longest - 1]}…"


def inline(figure: object, label: str) -> str:
    """SVG text fit to stand inside an HTML page, described for those who cannot see it."""
    from html import escape

    buffer = io.StringIO()
    with warnings.catch_warnings():
        # Text stays text and is set in the reader's font: that ours lacks a letter is of no matter.
        warnings.filterwarnings("ignore", "Glyph .* missing from font")
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
    text = re.sub(r"""\s*font-family: [^;"]*;?""", "", text)  # the page's
    text = re.sub(r' transform="rotate\(-?0 [^"]*"', "", text)
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
