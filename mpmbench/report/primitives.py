"""Tables of primitives: one section per operation and device, its strategies side by side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from mpmbench.record import Record
from mpmbench.report import table as tables
from mpmbench.report.contests import timed_apart
from mpmbench.report.table import Column, Group, Kind, Quantity, Table
from mpmbench.simt.counters import Tally


def groups(records: Sequence[Record]) -> dict[str, list[Record]]:
    """Records of primitives by the title of their section: operation, size, device and caches, in the order run."""
    alike: dict[str, list[Record]] = {}
    for record in records:
        if not record.is_transfer:
            where = Group((record,)).device
            alike.setdefault(f"{record.transfer.capitalize()} of {record.dataset.name}: {where}", []).append(record)
    found: dict[str, list[Record]] = {}
    for title, runs in alike.items():
        for part in timed_apart(runs):
            caches = next((tables.cache_text(r.transfer_measurement.mode) for r in part if r.transfer_measurement), "")
            found.setdefault(", ".join(filter(None, [title, caches])), []).extend(part)
    return found


def table(records: Sequence[Record]) -> Table:
    """One row per strategy and choice of axes, in the order run; of equal rows the last counts."""
    latest = {(r.variant, tuple(sorted(r.axes.items(), key=str))): r for r in records}
    sources = [_of_kind(source, records[0]) for source in _SOURCES]
    return tables._table("", sources, list(latest.values()))


def _of_kind(source: tables._Source, record: Record) -> tables._Source:
    """A column of times with the kind of the device that took them."""
    if source.column.kind is not Kind.MEASURED or tables.cost_kind(record) is not Kind.WALL:
        return source
    return replace(source, column=replace(source.column, kind=Kind.WALL))


def _counted(
    title: str, count: Callable[[Tally, Record], float | None], explain: str, quantity: Quantity = Quantity.NUMBER
) -> tables._Source:
    def value(record: Record) -> float | None:
        counters = record.transfer_counters
        return None if counters is None or not record.dataset.n else count(counters.total, record)

    return tables._Source(Column(title, Kind.SIMULATED, quantity, "less", explain), value)


def _conflicts(tally: Tally, record: Record) -> float | None:
    requests = tally.sld_req + tally.sst_req
    return tally.shm_wavefronts / requests if requests else None


def _seconds(record: Record) -> float | None:
    return record.transfer_measurement.median if record.transfer_measurement else None


def _bandwidth(record: Record) -> float | None:
    seconds = _seconds(record)
    return record.floor_bytes / seconds / 1e9 if seconds and record.floor_bytes else None


_SOURCES = (
    tables._STRATEGY,
    tables._AXES,
    tables._REMARK,
    tables._AGREEMENT,
    tables._Source(
        Column("time", Kind.MEASURED, Quantity.SECONDS, "less", "median time of all its launches"), _seconds
    ),
    tables._Source(
        Column("GB/s of the floor", Kind.MEASURED, Quantity.NUMBER, "more", "compulsory bytes over the time"),
        _bandwidth,
    ),
    _counted(
        "bytes / floor",
        lambda t, r: t.sectors * tables.SECTOR_BYTES / r.floor_bytes if r.floor_bytes else None,
        "bytes over the compulsory ones: each input that is used read once, each result written once",
        Quantity.FACTOR,
    ),
    _counted("sectors / element", lambda t, r: t.sectors / r.dataset.n, "distinct 32-byte sectors per request, summed"),
    _counted("warp inst / element", lambda t, r: t.warp_inst / r.dataset.n, "instructions issued, each once per warp"),
    _counted(
        "wavefronts / shared request",
        _conflicts,
        "passes over the 32 banks per request: 1 is free of conflicts for 4-byte places, 4 for 16-byte ones",
    ),
    _counted("barriers / 1000 elements", lambda t, r: 1000 * t.bar / r.dataset.n, "arrivals of a warp at a barrier"),
    _counted(
        "local requests / element",
        lambda t, r: (t.lld_req + t.lst_req) / r.dataset.n or None,
        "loads and stores of arrays that did not fit in registers",
    ),
    _counted("global atomics / element", lambda t, r: t.gatom_lane / r.dataset.n or None, "lanes of global atomics"),
)
