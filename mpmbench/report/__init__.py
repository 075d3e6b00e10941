"""Reports from records, on any machine: a Markdown file and a page in one HTML file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from mpmbench.errors import InputError
from mpmbench.record import Record
from mpmbench.report import document, html, markdown

HTML_LIMIT = 1_000_000  # [bytes]


def write_report(records: Sequence[Record], html: Path | None = None, markdown: Path | None = None) -> None:
    """Write the report in the forms asked for. A page above ``HTML_LIMIT`` leaves out details, and says which."""
    page, text = html, markdown
    if page is not None:
        _write(page, html_text(records))
    if text is not None:
        _write(text, markdown_text(records))


def html_text(records: Sequence[Record]) -> str:
    """The page: as much detail as fits."""
    for extent in document.EXTENTS:
        page = html.render(document.build(records, extent))
        if len(page.encode()) <= HTML_LIMIT:
            break
    return page


def markdown_text(records: Sequence[Record]) -> str:
    return markdown.render(document.build(records))


def _write(path: Path, text: str) -> None:
    path = Path(path)
    new = path.with_name(f".{path.name}.new")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        new.write_text(text, encoding="utf-8")
        new.replace(path)  # a full disk leaves the old report as it was
    except OSError as error:
        new.unlink(missing_ok=True)
        raise InputError(f"cannot write the report to {path}: {(error.strerror or str(error)).lower()}") from None
