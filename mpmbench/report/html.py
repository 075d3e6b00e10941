"""Document -> one HTML file that needs nothing else: no network, no fonts, no scripts to be readable."""

from __future__ import annotations

import re
from itertools import groupby
from typing import Any

import jinja2
from markupsafe import Markup, escape

from mpmbench.report import chart_data
from mpmbench.report.chart_data import Chart
from mpmbench.report.document import KINDS, Document
from mpmbench.report.plots import svg
from mpmbench.report.table import Column, Kind, Quantity, Table
from mpmbench.report.text import LEFT, format_value


def render(document: Document) -> str:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("mpmbench.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"chart": _chart, "data": chart_data.data, "tight": _tight, "anchor": anchor, "code": _code}
    environment.globals |= {
        "header": _header,
        "rows": _rows,
        "shown_columns": shown_columns,
        "kinds_by_name": {str(k): text for k, text in KINDS.items()},
    }
    return environment.get_template("report.html.j2").render(document=document, kinds=KINDS)


def anchor(title: str) -> str:
    """An id for a heading."""
    return re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")


def _chart(chart: Chart) -> Markup:
    return Markup(svg(chart))


def _code(text: str) -> Markup:
    """Text whose back-ticked words are code."""
    pieces = re.split(r"`([^`]*)`", text)
    return Markup("").join(Markup("<code>{}</code>").format(p) if i % 2 else escape(p) for i, p in enumerate(pieces))


def _tight(title: str) -> str:
    """A column title that breaks before "/ particle" and not after the stroke."""
    return title.replace(" / ", " /\N{NO-BREAK SPACE}")


def shown_columns(table: Table) -> list[Column]:
    """Columns with a place of their own."""
    return [column for column in table.columns if not column.under]


def _header(table: Table) -> list[dict[str, Any]]:
    """The upper header row: which kind of number stands below, over how many columns."""
    return [
        {"kind": "" if kind is Kind.NAME else str(kind), "span": len(list(columns))}
        for kind, columns in groupby(shown_columns(table), key=lambda column: column.kind)
    ]


def _rows(table: Table) -> list[dict[str, Any]]:
    best = [table.best(i) for i in range(len(table.columns))]
    rows = []
    for i, row in enumerate(table.rows):
        cells: list[dict[str, Any]] = []
        for c, (cell, column) in enumerate(zip(row.cells, table.columns, strict=True)):
            text = format_value(cell.value, column.quantity)
            if column.under:
                cells[-1]["under"] += (
                    [(text, column.quantity is Quantity.PROSE)] if text and cell.value is not None else []
                )
                continue
            cells.append(
                {
                    "text": text,
                    "under": [],
                    "prose": column.quantity is Quantity.PROSE,
                    "code": column.quantity is Quantity.CODE,
                    "left": column.quantity in LEFT,
                    "best": i in best[c],
                }
            )
        tags = [*(["baseline"] if row.baseline else []), *([row.mark] if row.mark else [])]
        rows.append({"cells": cells, "status": row.status, "baseline": row.baseline, "tags": tags})
    return rows
