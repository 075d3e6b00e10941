"""Runs of one problem on one device -> those whose times may stand in one table.

Times from different states of the caches answer different questions, and times from different rounds were not paired.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mpmbench.record import Record


def timed_apart(records: Sequence[Record]) -> list[list[Record]]:
    """One list per state of the caches and contest, in the order run; of equal runs the last counts.

    A run without a time belongs to no state: where there are several, it stands in each that has no time for it.
    """
    order = {id(record): place for place, record in enumerate(records)}
    latest = {(_mode(r), _identity(r)): r for r in records}
    parts: dict[tuple[str, str], dict[Any, Record]] = {}
    for record in sorted(latest.values(), key=lambda r: order[id(r)]):
        if record.transfer_measurement:
            contest = record.comparison.contest if record.comparison else ""
            parts.setdefault((_mode(record), contest), {})[_identity(record)] = record
    untimed = [record for record in latest.values() if not record.transfer_measurement]
    if not parts:
        return [untimed]
    for record in untimed:
        for part in parts.values():
            other = part.get(_identity(record))
            if other is None or (len(parts) == 1 and order[id(other)] < order[id(record)]):
                part[_identity(record)] = record
    return [list(part.values()) for part in parts.values()]


def _mode(record: Record) -> str:
    return record.transfer_measurement.mode if record.transfer_measurement else ""


def _identity(record: Record) -> tuple[Any, ...]:
    return record.variant, tuple(sorted(record.axes.items(), key=str))
