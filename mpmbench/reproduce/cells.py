"""Columns and cells that the page's tables share."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from markupsafe import Markup, escape

from mpmbench.gpu.modelled import TERM_WORDS, TERMS, ModelledTime
from mpmbench.report.table import Cell, Column, Kind, Quantity
from mpmbench.report.text import number
from mpmbench.reproduce.comparable import Judged

NAME = Column("row as printed", Kind.NAME, Quantity.TEXT)
NAME_AND_MORE = Column("row as printed", Kind.NAME, Quantity.PROSE)  # with a text beneath
PUBLISHED_TIME = Column("time [µs]", Kind.PUBLISHED, Quantity.PRINTED, explain="as printed")
TIME_COLUMNS = (
    Column("time [µs]", Kind.MODELLED, Quantity.NUMBER, explain="launches and the largest term"),
    Column("range [µs]", Kind.MODELLED, Quantity.TEXT, explain="in which the model expects the time"),
)
RATIO = Column(
    "modelled / published", Kind.MODELLED, Quantity.FACTOR, explain="above 1: modelled too slow; below 1: too fast"
)
BOUND_COLUMNS = (
    Column(
        "bound, terms", Kind.MODELLED, Quantity.TEXT,
        explain="what binds, and the time of each unit if it were the only limit, as bars: "
        + ", ".join(TERM_WORDS[term] for term in TERMS),
    ),
    Column("", Kind.MODELLED, Quantity.TEXT, under=True),
)  # fmt: skip


def cells(columns: Sequence[Column], values: Iterable[Any]) -> tuple[Cell, ...]:
    """Values, each of its column's kind."""
    return tuple(Cell(value, column.kind) for value, column in zip(values, columns, strict=True))


def time_of(one: Judged) -> tuple[float | None, str | None]:
    """For TIME_COLUMNS."""
    modelled = one.row.modelled
    if modelled is None:
        return None, None
    return 1e6 * modelled.seconds, f"{number(1e6 * modelled.low)}–{number(1e6 * modelled.high)}"


def bound_of(one: Judged) -> tuple[Markup | None, str | None]:
    """For BOUND_COLUMNS."""
    modelled = one.row.modelled
    if modelled is None:
        return None, None
    return terms_bars(modelled), TERM_WORDS.get(modelled.bound, modelled.bound).split(" (")[0]


def terms_bars(modelled: ModelledTime) -> Markup:
    """The terms side by side, as tall as they are long, the one that binds coloured; small enough for a cell."""
    top = max((modelled.terms.get(term, 0.0) for term in TERMS), default=0.0)
    if not top > 0:
        return Markup("")
    bars, said = [], []
    for i, term in enumerate(TERMS):
        value = modelled.terms.get(term, 0.0)
        height = max(20 * value / top, 0.6)
        said.append(f"{TERM_WORDS[term]} {number(1e6 * value)} µs")
        colour = "var(--series-1)" if term == modelled.bound else "var(--muted)"
        bars.append(
            f'<rect x="{8 * i + 1}" y="{21 - height:.1f}" width="6" height="{height:.1f}" fill="{colour}">'
            f"<title>{escape(said[-1])}</title></rect>"
        )
    label = escape("; ".join(said))
    head = f'<svg viewBox="0 0 {8 * len(TERMS)} 22" style="width:4.5rem" role="img" aria-label="{label}">'
    return Markup(f"{head}{''.join(bars)}</svg>")  # numbers and escaped words
