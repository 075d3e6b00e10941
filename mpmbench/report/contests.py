"""Runs of one problem on one device -> those whose times may stand in one table.

Times from different states of the caches answer different questions, and times from different rounds were not paired.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mpmbench.record import Record


def timed_apart(records: Sequence[Record]) -> list[list[Record]]:
    """One list per state of the caches and contest, in the order run; of equal runs the last counts.

    A run without a time stands in every contest of the state that it was meant for. Where that is not known and there
    are several, it stands in each that has no time for it.
    """
    order = {id(record): place for place, record in enumerate(records)}
    latest = {(_mode(r), _identity(r)): r for r in records}
    parts: dict[tuple[str, str], dict[Any, Record]] = {}
    for record in sorted(latest.values(), key=lambda r: order[id(r)]):
        if record.transfer_measurement:
            contest = record.comparison.contest if record.comparison else ""
            parts.setdefault((_mode(record), contest), {})[_identity(record)] = record
    untimed = [record for record in latest.values() if not record.transfer_measurement]
    modes = {mode for mode, _ in parts}
    strays: dict[str, list[Record]] = {}
    for record in untimed:
        if (meant := _mode(record)) and meant not in modes:
            strays.setdefault(meant, []).append(record)
            continue
        for (mode, _), part in parts.items():
            if meant and meant != mode:
                continue
            other = part.get(_identity(record))
            if other is None or ((len(parts) == 1 or meant) and order[id(other)] < order[id(record)]):
                part[_identity(record)] = record
    if not parts and "" in {_mode(record) for record in untimed}:
        return [untimed]
    return [*(list(part.values()) for part in parts.values()), *strays.values()]


def _mode(record: Record) -> str:
    return record.transfer_measurement.mode if record.transfer_measurement else record.cache or ""


def _identity(record: Record) -> tuple[Any, ...]:
    return record.variant, tuple(sorted(record.axes.items(), key=str))
