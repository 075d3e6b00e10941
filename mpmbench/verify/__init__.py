"""Is the arithmetic right, and whose error is it? The thesis's verification (section 6.1), with exact sums.

Each part is a module with ``run(device, quick, tick)``; ``verify`` runs them in order, ``text``, ``markdown`` and
``to_json`` say what came out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from tabulate import tabulate

from mpmbench.device import Device
from mpmbench.environment import Environment
from mpmbench.errors import InputError
from mpmbench.report import markdown as markdown_report
from mpmbench.report.document import Document, Section
from mpmbench.report.table import Kind, Table
from mpmbench.report.text import LEFT, format_value
from mpmbench.verify import drift, table_3, table_4
from mpmbench.verify.outcome import Outcome, Tick

__all__ = ["PARTS", "Outcome", "markdown", "text", "to_json", "verify"]

PARTS: dict[str, Callable[[Device, bool, Tick], Outcome]] = {
    "table3": table_3.run,
    "table4": table_4.run,
    "drift": drift.run,
}


def verify(device: Device, parts: Sequence[str] = (), quick: bool = False, tick: Tick | None = None) -> list[Outcome]:
    """Run the parts named, or all.

    quick: fewer elements, particles and steps; the published figures then stand beside a smaller problem.
    tick: called with what runs, steps done and steps in all.
    """
    if unknown := [part for part in parts if part not in PARTS]:
        raise InputError(f"unknown part {unknown[0]!r}: valid are {', '.join(PARTS)}")
    return [run(device, quick, tick or _silent) for name, run in PARTS.items() if not parts or name in parts]


def problems(outcomes: Sequence[Outcome]) -> list[str]:
    return [problem for outcome in outcomes for problem in outcome.problems]


def text(outcomes: Sequence[Outcome]) -> str:
    """For a terminal."""
    lines = []
    for outcome in outcomes:
        lines += [outcome.title, "=" * len(outcome.title), outcome.intro, ""]
        for table in outcome.tables:
            lines += [table.title, _plain(table), *(f"  {note}" for note in table.notes), ""]
        lines += [f"NOT HELD: {problem}" for problem in outcome.problems]
        lines += [f"{outcome.title}: {_verdict(outcome)}, {outcome.seconds:.0f} s", ""]
    return "\n".join(lines)


def markdown(outcomes: Sequence[Outcome], device: Device, environment: Environment) -> str:
    """As GitHub renders it, in the form of the other reports."""
    found = problems(outcomes)
    document = Document(
        title="mpmbench verify",
        verdict=f"{len(found)} bounds do not hold." if found else "Every bound holds.",
        agreed=not found,
        answer=tuple(f"{outcome.title}: {_verdict(outcome)}, {outcome.seconds:.0f} s" for outcome in outcomes),
        attention=(),
        sections=tuple(Section(outcome.title, outcome.tables, intro=outcome.intro) for outcome in outcomes),
        legend=(),
        environment=(("device", f"{device.name} {device.arch}"), *_facts(environment)),
    )
    return markdown_report.render(document)


def to_json(outcomes: Sequence[Outcome], device: Device, environment: Environment) -> dict[str, Any]:
    """Every figure under its column's title and kind."""
    return {
        "device": device.name,
        "arch": device.arch,
        "environment": dict(_facts(environment)),
        "parts": [
            {
                "name": outcome.name,
                "title": outcome.title,
                "intro": outcome.intro,
                "problems": list(outcome.problems),
                "seconds": outcome.seconds,
                "tables": [_table_content(table) for table in outcome.tables],
            }
            for outcome in outcomes
        ],
    }


def _silent(what: str, done: int, total: int) -> None:
    pass


def _verdict(outcome: Outcome) -> str:
    return f"{len(outcome.problems)} bounds do not hold" if outcome.problems else "every bound holds"


def _facts(environment: Environment) -> tuple[tuple[str, str], ...]:
    names = ("mpmbench", "git_commit", "python", "numpy", "nvrtc", "cpu", "cores", "date")
    return tuple((name, str(value)) for name in names if (value := getattr(environment, name)) is not None)


def _plain(table: Table) -> str:
    header = [c.title if c.kind is Kind.NAME else f"{c.title}\n({c.kind})" for c in table.columns]
    rows = [
        [format_value(cell.value, column.quantity) for cell, column in zip(row.cells, table.columns, strict=True)]
        for row in table.rows
    ]
    align = ["left" if column.quantity in LEFT else "right" for column in table.columns]
    return tabulate(rows, header, tablefmt="simple", colalign=align, disable_numparse=True)


def _table_content(table: Table) -> dict[str, Any]:
    return {
        "title": table.title,
        "columns": [{"title": column.title, "kind": str(column.kind)} for column in table.columns],
        "rows": [[cell.value for cell in row.cells] for row in table.rows],
        "notes": list(table.notes),
    }
