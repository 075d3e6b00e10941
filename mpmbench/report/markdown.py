"""Document -> Markdown, as GitHub renders it."""

from __future__ import annotations

import re

from tabulate import tabulate

from mpmbench.report.document import KINDS, Document, Section
from mpmbench.report.table import Kind, Quantity, Table
from mpmbench.report.text import LEFT, format_value

_LEVELS = {"wrong": "**Wrong:**", "warning": "**Warning:**", "note": "Note:"}


def render(document: Document) -> str:
    parts = [f"# {escape(document.title)}", f"**{escape(document.verdict)}**"]
    parts += ["\n".join(f"- {escape(sentence)}" for sentence in document.answer)]
    if document.attention:
        parts.append("## Attention")
        parts.append(
            "\n".join(f"- {_LEVELS[a.level]} {escape(a.text)} {_with_code(a.action)}" for a in document.attention)
        )
    parts += [part for section in document.sections for part in _section(section)]
    parts.append("## How to read the tables")
    parts.append("\n".join(f"- *{kind}*: {text}" for kind, text in KINDS.items()))
    parts.append("\n".join(_meaning(*entry) for entry in document.legend))
    parts.append("## Environment")
    parts.append("\n".join(f"- {escape(name)}: {escape(value)}" for name, value in document.environment))
    if document.left_out:
        parts.append(f"Left out to keep the report small: {', '.join(document.left_out)}.")
    return "\n\n".join(part for part in parts if part) + "\n"


def _section(section: Section) -> list[str]:
    parts = [f"## {escape(section.title)}", escape(section.intro)]
    for table in section.tables:
        parts += _table(table)
    for details in section.details:
        parts.append(f"<details><summary>{escape(details.summary)}</summary>")
        for table in details.tables:
            parts += _table(table)
        parts.append("</details>")
    for card in section.cards:
        parts.append(f"#### {code(card.title)}")
        badge = f"**Uncalibrated:** {escape(card.badge)}." if card.badge else ""
        parts.append(" ".join(filter(None, [f"{escape(card.headline)}.", badge, escape(card.sentence)])))
        for table in card.tables:
            parts += _table(table)
    return parts


def _table(table: Table) -> list[str]:
    parts = [f"### {escape(table.title)}"] if table.title else []
    kinds = table.kinds
    if len(kinds) == 1:
        parts.append(f"*Numbers: {kinds[0]}, {KINDS[kinds[0]]}.*")
    header = [
        escape(column.title) + (f" ({column.kind})" if len(kinds) > 1 and column.kind is not Kind.NAME else "")
        for column in table.columns
    ]
    best = [table.best(i) for i in range(len(table.columns))]
    rows = []
    for i, row in enumerate(table.rows):
        cells: list[str] = []
        tags = [*(["(baseline)"] if row.baseline else []), *([f"**{row.mark}**"] if row.mark else [])]
        for c, (cell, column) in enumerate(zip(row.cells, table.columns, strict=True)):
            text = format_value(cell.value, column.quantity)
            if column.quantity is Quantity.CODE:
                text = " ".join([code(text), *tags])
                tags = []  # beside the name, which is the first of these
            else:
                text = escape(text)
            cells.append(f"**{text}**" if i in best[c] and text else text)
        rows.append(cells)
    align = ["left" if column.quantity in LEFT else "right" for column in table.columns]
    parts.append(tabulate(rows, header, tablefmt="pipe", colalign=align, disable_numparse=True) if rows else "(none)")
    parts += [escape(note) for note in table.notes]
    return parts


def code(text: str) -> str:
    """A code span that survives back-ticks, bars and line breaks in the text."""
    if not text:
        return ""
    text = re.sub(r"\s+", " ", text).replace("|", "\\|")
    fence = "`" * (1 + max((len(run) for run in re.findall("`+", text)), default=0))
    pad = " " if "`" in text else ""
    return f"{fence}{pad}{text}{pad}{fence}"


def _with_code(text: str) -> str:
    """Text whose back-ticked words are code."""
    pieces = text.split("`")
    return "".join(code(piece) if i % 2 else _kept_spaces(piece) for i, piece in enumerate(pieces))


def _kept_spaces(text: str) -> str:
    return re.sub(r"\S.*\S|\S", lambda match: escape(match[0]), text)


def _meaning(title: str, kind: str, text: str) -> str:
    return f"- {escape(title)}{f' ({kind})' if kind else ''}: {escape(text)}"


def escape(text: str) -> str:
    """Plain text as Markdown that shows exactly it."""
    return re.sub(r"([\\`*_{}\[\]<>|#~])", r"\\\1", re.sub(r"\s+", " ", str(text)).strip())
