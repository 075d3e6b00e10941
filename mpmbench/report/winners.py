"""Who wins: one row per measured group, and geometric means of speedups where there are several cases.

Tables are of one kind of time and one state of the caches.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from mpmbench.protocol.verdict import geometric_mean
from mpmbench.record import Record
from mpmbench.report import table as tables
from mpmbench.report.doubts import too_short
from mpmbench.report.measured import TIED, mark
from mpmbench.report.table import Column, Group, Kind, Quantity, Table
from mpmbench.report.text import format_value

NAMED_TIES = 3

WHY_GEOMETRIC = (
    "Geometric mean of the speedups, the only mean of ratios that does not depend on which side is the baseline. "
    "Only strategies with all cases compete for the mark: a mean over fewer cases is of another thing."
)


def tables_of(groups: Sequence[Group]) -> list[Table]:
    """Winners, then means, for event times and for wall clock, per state of the caches."""
    found = []
    for kind in (Kind.MEASURED, Kind.WALL):
        timed = [g for g in groups if g.kind is kind and g.ranked]
        for caches in dict.fromkeys(g.caches for g in timed):
            same = [g for g in timed if g.caches == caches]
            found.append(_winners(same))
            found += _means(same)
    return found


def _winners(groups: Sequence[Group]) -> Table:
    kind = groups[0].kind
    processors = {(g.device, g.first.device) for g in groups}
    several = len(processors) > 1
    where = [Column("device", Kind.NAME, Quantity.CODE)]
    columns = (
        # Several devices: what names the case stands beneath the device, so that the winner is in sight on a telephone.
        *(where if several else []),
        *(replace(column, under=several) for column in tables.BEFORE),
        Column("fastest", kind, Quantity.CODE),
        Column("cannot be told from it", kind, Quantity.CODE, under=True),
        Column("transfer time", kind, Quantity.SECONDS),
        Column("speedup", kind, Quantity.TEXT, explain="baseline's time over this one's, transfer alone"),
        Column("verdict", kind, Quantity.TEXT, explain="of the fastest against the baseline"),
        Column("break-even", kind, Quantity.TRANSFERS),
        *tables.AFTER,
        *(where if not several else []),
    )
    rows = []
    for g in groups:
        best, base = g.ranked[0], g.baseline
        if too_short(best):
            continue
        device = [f"{g.device}{f', {g.note}' if g.note else ''}"]
        values = [
            g.label(best),
            _others(g, best),
            tables.seconds(tables.transfer_cost(best)),
            speedup_text(g, best),
            best.comparison.verdict if best.comparison and best is not base else "",
            tables.break_even_of(tables.seconds, base)(best),
        ]
        around = [*tables.before(g), *values, *tables.after(g)]
        rows.append(tables._row([*device, *around] if several else [*around, *device], columns))
    unit = "wall clock on a CPU" if kind is Kind.WALL else "measured"
    caches = f", {groups[0].caches}" if groups[0].caches else ""
    processor = "CPU" if kind is Kind.WALL else "GPU"
    title = f"Winner per {processor} and dataset" if several else "Fastest transfer"
    return Table(f"{title}, {unit}{caches}", columns, tuple(rows))


def speedup_text(g: Group, record: Record) -> str:
    """Over the baseline, with its interval where the two were paired."""
    base = g.baseline
    if record.comparison is not None:
        return format_value(record.comparison.speedup, Quantity.FACTOR_INTERVAL) if record.comparison.speedup else ""
    time, base_time = (r and tables.seconds(tables.transfer_cost(r)) for r in (record, base))
    return format_value(base_time / time, Quantity.FACTOR) if time and base_time else ""


def _others(g: Group, best: Record) -> str:
    """Rows that share the mark with the best."""
    if mark(g, best) != TIED:
        return ""
    names = [g.label(r) for r in g.leaders if r is not best]
    more = f" and {len(names) - NAMED_TIES} more" if len(names) > NAMED_TIES else ""
    return f"= {', '.join(names[:NAMED_TIES])}{more}"


def _means(groups: Sequence[Group]) -> list[Table]:
    """Of groups that differ in their dataset alone."""
    alike: dict[Any, list[Group]] = {}
    for g in groups:
        if g.paired:
            alike.setdefault((g.first.transfer, g.device, tables.problem_text(g.first), _baseline(g)), []).append(g)
    return [_mean(same) for same in alike.values() if len({g.first.dataset.fingerprint for g in same}) > 1]


def _baseline(g: Group) -> str:
    return g.baseline.variant if g.baseline else next(r.comparison.baseline for r in g.ranked if r.comparison)


def _mean(groups: Sequence[Group]) -> Table:
    kind = groups[0].kind
    columns = (
        Column("strategy", Kind.NAME, Quantity.CODE),
        Column("cases", kind, Quantity.COUNT, explain="datasets in the mean"),
        Column("geometric mean", kind, Quantity.FACTOR, "leads", "of the speedups, one per case"),
        Column("worst case", kind, Quantity.FACTOR, explain="least speedup of them"),
        Column("its dataset", kind, Quantity.CODE, under=True),
        Column("slower than the baseline", kind, Quantity.COUNT, explain="cases with the verdict SLOW"),
    )
    speedups: dict[str, dict[str, tuple[float, str, str]]] = {}
    for g in groups:
        name = tables.dataset_name(g.first.dataset)
        for r in g.ranked:
            c = r.comparison
            if c is not None and c.speedup is not None and c.speedup[0] > 0 and math.isfinite(c.speedup[0]):
                case = f"{g.first.dataset.fingerprint} {g.note}"
                # Of rows with one name, differing in what was searched, the faster one is the strategy's.
                here = speedups.setdefault(_strategy(r), {})
                here[case] = max(here.get(case, (0.0, "", "")), (c.speedup[0], name, str(c.verdict)))
    means = {
        strategy: geometric_mean([s for s, _, _ in cases.values()])
        for strategy, cases in speedups.items()
        if len(cases) > 1
    }
    ordered = sorted(means, key=lambda strategy: (-len(speedups[strategy]), -means[strategy]))
    rows = []
    for strategy in ordered:
        cases = speedups[strategy].values()
        worst, dataset, _ = min(cases)
        values = [strategy, len(cases), means[strategy], worst, dataset, sum(v == "SLOW" for _, _, v in cases)]
        best = strategy == ordered[0] and len(cases) == len(groups) and means[strategy] > 1
        rows.append(tables._row(values, columns, mark="best mean" if best else ""))
    first = groups[0].first
    title = f"{first.transfer.upper()} over {len(groups)} cases against {_baseline(groups[0])}, {groups[0].device}"
    caches = f"All with {groups[0].caches}, {tables.problem_text(first)}."
    return Table(title, columns, tuple(rows), (WHY_GEOMETRIC, caches))


def _strategy(record: Record) -> str:
    """Variant with its changed axes, less those that were searched for in every case anew."""
    searched = dict.fromkeys(record.tuning.searched) if record.tuning else {}
    name = tables.label(record, searched)
    return f"{name} (tuned)" if searched else name
