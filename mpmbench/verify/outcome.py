"""What a verification says: tables whose columns keep published and own figures apart, and what did not hold."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from mpmbench.device import Device
from mpmbench.report.table import Cell, Column, Kind, Quantity, Row, Table

Tick = Callable[[str, int, int], None]  # (what runs, steps done, steps in all)


@dataclass(frozen=True)
class Outcome:
    """One part. name: as the command line knows it.  problems: one line for each bound that did not hold."""

    name: str
    title: str
    intro: str
    tables: tuple[Table, ...]
    problems: tuple[str, ...]
    seconds: float


def own_kind(device: Device) -> Kind:
    """The kind of figures that a device computes."""
    return Kind.SIMULATED if device.name == "simulated" else Kind.MEASURED


def label(title: str) -> Column:
    """A column that names its row."""
    return Column(title, Kind.NAME, Quantity.TEXT)


def published(title: str) -> Column:
    """A column of printed figures."""
    return Column(title, Kind.PUBLISHED, Quantity.PRINTED)


def make_table(
    title: str, columns: Sequence[Column], rows: Sequence[Sequence[Any]], notes: Sequence[str] = ()
) -> Table:
    """Rows of values, each of its column's kind."""
    cells = [Row(tuple(Cell(value, column.kind) for value, column in zip(row, columns, strict=True))) for row in rows]
    return Table(title, tuple(columns), tuple(cells), tuple(notes))
