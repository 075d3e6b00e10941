"""Measured rows as tables: how long, how sure, how much faster than the baseline, and what a whole step takes."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from mpmbench.protocol.verdict import MARGIN
from mpmbench.record import PER_TRANSFER_STEPS, Record, StepCost, total_cost
from mpmbench.report import table as tables
from mpmbench.report.table import Column, Group, Kind, Quantity, Table

FASTEST, TIED = "fastest", "tied"

CLOCK_WORDS = {
    Kind.MEASURED: "median event time of the transfer on the GPU",
    Kind.WALL: "median wall-clock time of the transfer on the CPU",
}

# Beneath the name: a column of its own would push the times out of a narrow screen.
_REMARK_BELOW = replace(tables._REMARK, column=replace(tables._REMARK.column, under=True))

HOW_COMPARED = (
    "Speedup: the baseline's time over this row's, sample by sample from the same rounds; its median and its "
    "{confidence:g} % interval. Verdicts: FAST and SLOW lie clear of ±{margin:.2g} %, SAME lies within ±{same:.2g} %, "
    "AMBG is not decided, ???? cannot be compared. Rows that no other was found to beat share the mark."
)


def ranking(g: Group) -> Table:
    """Every run of a group with times, the leaders first; runs without a rank say why."""
    base = g.baseline
    base_seconds = None if base is None or g.paired else tables.seconds(tables.transfer_cost(base))

    def timed(
        title: str,
        value: Callable[[Record], Any],
        quantity: Quantity,
        better: str | None = None,
        explain: str = "",
        under: bool = False,
    ) -> tables._Source:
        if g.paired and better is not None and title != "break-even":
            better = "leads"  # rows that cannot be told apart share the mark, whatever their medians
        return tables._Source(Column(title, g.kind, quantity, better, explain, under), value)

    def of_time(pick: Callable[[Record, float], float | None]) -> Callable[[Record], float | None]:
        def value(record: Record) -> float | None:
            time = tables.seconds(tables.transfer_cost(record))
            return None if time is None or not time or not tables.particles(record) else pick(record, time)

        return value

    sources = [
        tables._STRATEGY,
        tables._AXES,
        _REMARK_BELOW,
        timed("transfer", of_time(lambda r, t: t), Quantity.SECONDS, "less", CLOCK_WORDS[g.kind]),
        timed("q1 to q3", _quartiles, Quantity.SECONDS_RANGE, None, "first and third quartile of the samples", True),
        timed("speedup", _speedup, Quantity.FACTOR_INTERVAL, "more",
              "baseline's time over this one's, pair by pair: median and interval; transfer alone"),
        timed("speedup", of_time(lambda r, t: base_seconds / t if base_seconds else None), Quantity.FACTOR, "more",
              "baseline's time over this one's, transfer alone; not paired, hence without an interval"),
        timed("verdict", lambda r: r.comparison.verdict if r.comparison and not r.comparison.is_baseline else "",
              Quantity.TEXT, None, "against the baseline"),
        timed("particles / s", of_time(lambda r, t: r.dataset.n / t), Quantity.RATE, "more", "throughput"),
        timed("ns / node visit", of_time(lambda r, t: 1e9 * t / r.node_visits), Quantity.NUMBER, "less",
              "time per pair of particle and node in its support"),
        timed("of peak", of_time(_of_peak), Quantity.SHARE, None,
              "compulsory bytes (each particle and touched node once) over time, as a share of the DRAM's peak rate"),
        timed("noise", lambda r: r.transfer_measurement and r.transfer_measurement.noise, Quantity.SHARE, None,
              "interquartile range over median"),
        timed("least", lambda r: r.transfer_measurement and min(r.transfer_measurement.samples), Quantity.SECONDS,
              None, "shortest sample"),
        timed("samples", lambda r: r.transfer_measurement and len(r.transfer_measurement.samples), Quantity.COUNT,
              None, "that were kept"),
        timed("SM MHz" if g.kind is Kind.MEASURED else "MHz", _megahertz, Quantity.COUNT, None,
              "clock of the processor during the samples, median"),
        timed("preprocessing", _before, Quantity.SECONDS, None, "median times of its steps, added up"),
        timed("break-even", tables.break_even_of(tables.seconds, base), Quantity.TRANSFERS, "less",
              "transfers per sort from which preprocessing has paid for itself"),
        tables._AGREEMENT,
        tables._MEMORY,
    ]  # fmt: skip
    caches = f" ({g.caches})" if g.caches else ""
    clock = "wall clock" if g.kind is Kind.WALL else "measured time"
    title = f"Ranking by {clock}{caches}. {g.title}"
    notes = [*_how_compared(g), *_other_caches(g), *tables.baseline_note(base, g)]
    return tables._table(title, sources, g.records, base, notes, g.shared, lambda r: mark(g, r))


def _of_peak(record: Record, seconds: float) -> float | None:
    """Share of DRAM's peak rate that the compulsory traffic alone takes: no transfer from cold caches passes 1."""
    gpu = record.environment.gpu
    clock, bits = gpu.get("memory_clock_khz"), gpu.get("memory_bus_bits")
    if not (clock and bits and record.floor_bytes):
        return None
    peak = 2 * clock * 1e3 * bits / 8  # two transfers per clock, as the driver counts it
    return record.floor_bytes / seconds / peak


def mark(g: Group, record: Record) -> str:
    """What to write beside a row that leads."""
    if len(g.ranked) < 2 or not any(record is leader for leader in g.leaders):
        return ""
    return FASTEST if len(g.leaders) == 1 else TIED


def whole_step(g: Group) -> Table | None:
    """Mode "step": the transfer among the other parts of a simulation step, and all of it."""
    records = [r for r in g.ranked if step_parts(r)]
    if not records:
        return None
    names = list(dict.fromkeys(name for r in records for name in step_parts(r)))
    parts = [tables._Source(Column(name.replace("_", " "), g.kind, Quantity.SECONDS), _part(name)) for name in names]
    sources = [
        tables._STRATEGY,
        tables._AXES,
        tables._Source(
            Column("whole step", g.kind, Quantity.SECONDS, "less", "sum of the medians of its parts"), step_seconds
        ),
        *parts,
    ]
    return tables._table(f"Whole step: {g.title}", sources, records, g.baseline, (), g.shared)


def _part(name: str) -> Callable[[Record], float | None]:
    return lambda record: tables.seconds(step_parts(record).get(name, StepCost()))


def step_parts(record: Record) -> dict[str, StepCost]:
    """Parts of a simulation step by name, the transfer among them; none where they were not timed."""
    if not record.rest_of_step:
        return {}
    before = {name: cost for name, cost in record.preprocess.items() if name in PER_TRANSFER_STEPS}
    around = {**record.rest_of_step, **{name: cost for name, cost in before.items() if name not in record.rest_of_step}}
    mine = {record.transfer: tables.transfer_cost(record)}
    if record.transfer == "g2p":  # the last part of a step, where P2G is the second
        return around | mine
    return {"grid_clear": around["grid_clear"], **mine, **around} if "grid_clear" in around else mine | around


def step_seconds(record: Record) -> float | None:
    """A whole step [s]; None where a part of it was not timed."""
    parts = step_parts(record)
    return tables.seconds(total_cost(parts.values())) if parts else None


def quartile(which: int) -> tables.Measure:
    """First (0) or third (1) quartile of the samples as the measure of a step."""
    return lambda cost: None if cost.measurement is None else cost.measurement.quartiles[which]


def _quartiles(record: Record) -> tuple[float, float] | None:
    return record.transfer_measurement.quartiles if record.transfer_measurement else None


def _speedup(record: Record) -> tuple[float, float, float] | None:
    return record.comparison.speedup if record.comparison else None


def _megahertz(record: Record) -> float | None:
    time = record.transfer_measurement
    return statistics.median(time.hertz) / 1e6 if time is not None and time.hertz else None


def _before(record: Record) -> float | None:
    return tables.seconds(total_cost(record.preprocess.values())) if record.preprocess else None


def _how_compared(g: Group) -> list[str]:
    compared = [r.comparison for r in g.ranked if r.comparison]
    if not compared:
        return []
    widest = max((c.margin for c in compared if math.isfinite(c.margin)), default=0.0)
    notes = [HOW_COMPARED.format(confidence=100 * compared[0].confidence, margin=100 * widest, same=100 * MARGIN)]
    if all(map(math.isfinite, compared[0].noise)):
        low, high = (f"{100 * (end - 1):+.2f} %" for end in compared[0].noise[1:])
        notes.append(
            f"Noise floor: two copies of the baseline differ by {low} to {high} over {compared[0].rounds:,} rounds."
        )
    return notes


def _other_caches(g: Group) -> list[str]:
    """Steps around the transfer whose caches were in another state than its own."""
    modes = {cost.measurement.mode for r in g.ranked for cost in r.steps.values() if cost.measurement is not None} - {
        r.transfer_measurement.mode for r in g.ranked if r.transfer_measurement
    }
    return [f"Steps around the transfer: {', '.join(map(tables.cache_text, sorted(modes)))}."] if modes else []
