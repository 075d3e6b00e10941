"""The answer to what was measured: one sentence per group, with what to use and how sure that is."""

from __future__ import annotations

import math

from mpmbench.protocol.verdict import MARGIN, Verdict
from mpmbench.record import PER_TRANSFER_STEPS, Record
from mpmbench.report import table as tables
from mpmbench.report.density import per_cell
from mpmbench.report.doubts import throttled, too_short
from mpmbench.report.measured import step_seconds
from mpmbench.report.table import Group, Kind, Quantity
from mpmbench.report.text import format_value, number, seconds_text

NAMED = 4  # strategies that cannot be told apart, by name

_AXIS_WORDS = {"block_shape": "block", "particle_order": "particle order"}


def sentence(g: Group) -> str:
    """What to use for these particles on this processor."""
    start = f"{_where(g)}, {_what(g)}"
    if not g.ranked:
        why = "every row was throttled" if all(map(throttled, g.records)) else "no row of it has a time"
        return f"{start}: no answer, {why}."
    best, base = g.ranked[0], g.baseline
    if too_short(best):
        return f"{start}: too short to say which is fastest; use more particles."
    if not g.paired:
        return f"{start}: use {in_words(best)}, {_time(best)}{_gain_of_medians(best, base)}{_sort(g, best)}."
    if base is not None and any(base is leader for leader in g.leaders):
        return f"{start}: {_nothing_gained(g, base)}."
    others = [r for r in g.leaders if r is not best]
    use = f"use {in_words(best)}: {_time(best)}{_gain(g, best)}{_sort(g, best)}"
    if others:
        use += f"; {_list(g, others)} cannot be told apart from it"
    return f"{start}: {use}."


def in_words(record: Record) -> str:
    """A strategy with all that is needed to run it again: block and batching, and the axes that were changed."""
    shape = {name: record.axes[name] for name in ("block_shape", "batching") if name in record.axes}
    searched = {name: record.axes[name] for name in (record.tuning.searched if record.tuning else ())}
    axes = {**shape, **searched, **tables.changed_axes(record)}
    words = [f"{_AXIS_WORDS.get(name, name.replace('_', ' '))} {tables.axis_text(v)}" for name, v in axes.items()]
    if not words:
        return record.variant
    return f"{record.variant} with {' and '.join(filter(None, [', '.join(words[:-1]), words[-1]]))}"


def _where(g: Group) -> str:
    if g.kind is Kind.WALL:
        return f"On this CPU ({g.first.environment.cpu}), wall clock"
    name = g.first.environment.gpu.get("name", g.first.device)
    return f"On this GPU ({', '.join(filter(None, [name, g.note]))})"


def _what(g: Group) -> str:
    dataset = g.first.dataset
    density = per_cell(dataset)
    words = [dataset.name, f"{dataset.n:,}", f"{number(density)} per cell" if density else ""]
    problem = [tables.problem_text(g.first), g.caches]
    return f"{g.first.transfer.upper()} of these particles ({', '.join(filter(None, [*words, *problem]))})"


def _time(record: Record) -> str:
    text = seconds_text(record.transfer_measurement.median) if record.transfer_measurement else ""
    step = step_seconds(record)
    return text if step is None else f"{text}, the whole step {seconds_text(step)}"


def _over(base: Record) -> str:
    plain = {"p2g": "unsorted global atomics", "g2p": "unsorted global gathers"}[base.transfer]
    name = plain if tables.is_plain(base) else "the baseline"
    time = seconds_text(base.transfer_measurement.median) if base.transfer_measurement else ""
    return f"{name} ({', '.join(filter(None, [base.variant if name is plain else in_words(base), time]))})"


def _gain(g: Group, best: Record) -> str:
    """Its speedup, and in words where that is none for sure."""
    base, compared = g.baseline, best.comparison
    if compared is None or (base is None and compared.speedup is None):
        return f", compared with nothing: the baseline {g.baseline_name} has no time"
    if compared.speedup is None:
        return ""
    # A baseline that has no row here was timed beside these: they are a later part of a contest.
    over = f"the baseline ({compared.baseline})" if base is None else _over(base)
    text = f", {format_value(compared.speedup, Quantity.FACTOR_INTERVAL)} over {over}"
    match compared.verdict:
        case Verdict.SAME:
            return f"{text}: the same within {_percent(MARGIN)}"
        case Verdict.AMBIGUOUS:
            return f"{text}: whether it is faster is not decided"
        case Verdict.UNUSABLE:
            return f"{text}: the two cannot be compared"
    return text


def _nothing_gained(g: Group, base: Record) -> str:
    """The baseline is not beaten."""
    others = [r for r in g.leaders if r is not base]
    if not others and len(g.ranked) == 1:
        return f"{_over(base)} ran alone: there is nothing to compare it with"
    if not others:
        return f"use {_over(base)}: nothing is faster"
    best = others[0]
    compared = best.comparison
    interval = ""
    if compared is not None and compared.speedup is not None:
        same = f"the same within {_percent(MARGIN)}" if compared.verdict == Verdict.SAME else "not decided"
        who = f"{g.label(best)}: " if len(others) > 1 else ""
        interval = f" ({who}{format_value(compared.speedup, Quantity.FACTOR_INTERVAL)}, {same})"
    return f"nothing is faster for sure than {_over(base)}; {_list(g, others)} cannot be told apart from it{interval}"


def _gain_of_medians(best: Record, base: Record | None) -> str:
    if base is None or base is best or not (base.transfer_measurement and best.transfer_measurement):
        return ""
    gain = base.transfer_measurement.median / best.transfer_measurement.median
    return f", {number(gain)} times as fast as unsorted {base.variant} (transfer alone)"


def _sort(g: Group, best: Record) -> str:
    """From how many transfers per sort on its sort has paid for itself; "" where it has none."""
    steps = [name for name in best.preprocess if name not in PER_TRANSFER_STEPS]
    transfers = tables.break_even_of(tables.seconds, g.baseline)(best)
    if not steps or transfers is None:
        return ""
    if math.isinf(transfers):
        return "; its sort never pays"
    return "; sorting pays at once" if transfers <= 1 else f"; sorting pays from {transfers:,.0f} transfers per sort"


def _list(g: Group, records: list[Record]) -> str:
    names = [g.label(r) for r in records]
    if len(names) > NAMED:
        return f"{', '.join(names[:NAMED])} and {len(names) - NAMED} more"
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %"
