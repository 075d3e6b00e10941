"""What the reproduction is to reach, and whether it does."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from mpmbench.gpu import Gpu
from mpmbench.presets import published_rows
from mpmbench.reproduce.comparable import NOT_COMPARABLE, Judged
from mpmbench.reproduce.rows import Row
from mpmbench.reproduce.score import POOLED, Score

MEDIAN, WORST = 0.20, 1.0  # |log2|
TAU_POOLED, TAU_TABLE = 0.9, 0.8
BYTES, BYTES_TABLES = 0.10, (6, 9, 13, 14)
WARPS = 2.0

# Occupancies that section 6.2 states in its text and no table prints.
OCCUPANCY_IN_TEXT = {(14, "P2G-Pull"): 16.0}


@dataclass(frozen=True)
class Target:
    """met: None where nothing could be compared. found, wanted: in words.  detail: where it is missed."""

    name: str
    found: str
    wanted: str
    met: bool | None
    detail: str = ""


def targets(judged: Sequence[Judged], score: Score, gpu: Gpu) -> list[Target]:
    """Every target, in the order of weight."""
    whole = not score.unmodelled
    missing = f"{score.unmodelled} comparable rows have no modelled time" if score.unmodelled else ""
    tau = score.kendall_tau
    found = [
        Target("median |log2(modelled / published)|", f"{score.median_abs_log2:.3f}", f"at most {MEDIAN:.2f}",
               score.median_abs_log2 <= MEDIAN and whole, missing),
        Target("worst |log2(modelled / published)|", f"{score.worst_abs_log2:.3f}", f"at most {WORST:.1f}",
               score.worst_abs_log2 <= WORST and whole, missing),
        _tau("Kendall's tau, pooled", tau[POOLED], TAU_POOLED, score.pooled.count, whole),
    ]  # fmt: skip
    found += [
        _tau(f"Kendall's tau, table {table}", value, TAU_TABLE, score.pairs[int(table)].count, whole)
        for table, value in tau.items()
        if table != POOLED
    ]
    return [*found, _bytes(judged, gpu), _occupancy(judged)]


def implied_bytes(row: Row, gpu: Gpu) -> float | None:
    """DRAM traffic that the printed figures imply: share of the nominal bandwidth times the time."""
    share = row.published.get("vram_percent")
    if not share or not row.published_us:
        return None
    return float(share) / 100 * gpu["dram_bandwidth"] * row.published_us * 1e-6


def prints_less_than_moves(row: Row, gpu: Gpu) -> bool:
    """Whether the printed figures imply fewer bytes than particles and touched nodes are: no model can agree."""
    implied = implied_bytes(row, gpu)
    return implied is not None and row.floor_bytes is not None and implied < row.floor_bytes


def published_occupancy(row: Row) -> float | None:
    """Resident warps per SM, from the table or the text."""
    printed = row.published.get("occupancy_warps")
    return float(printed) if printed else OCCUPANCY_IN_TEXT.get((row.table, row.row))


def is_batched(row: Row) -> bool:
    """Whether the thesis's kernel handles several particles per turn: ours may need other registers for it."""
    pinned = published_rows(row.table)[row.place]
    return pinned.get("batching", "") not in ("", "1")


def _tau(name: str, value: float | None, wanted: float, pairs: int, whole: bool) -> Target:
    text = "–" if value is None else f"{value:.3f}"
    met = None if value is None else value >= wanted and whole
    return Target(name, f"{text} over {pairs} pairs", f"at least {wanted:.1f}", met)


def _bytes(judged: Sequence[Judged], gpu: Gpu) -> Target:
    ratios = []
    for one in judged:
        implied, ours = implied_bytes(one.row, gpu), one.row.metrics.get("dram_bytes")
        # Calibrated rows are in: what was set from them are rates, and bytes are counted.
        if one.row.table in BYTES_TABLES and one.status != NOT_COMPARABLE and implied and ours is not None:
            ratios.append((one.row, ours / implied))
    name = f"DRAM bytes of tables {', '.join(map(str, BYTES_TABLES))} over printed VRAM share x time"
    target = _within(name, ratios, f"within {100 * BYTES:.0f} %", lambda r: abs(r - 1) <= BYTES, lambda r: f"{r:.2f}x")
    below = [f"table {row.table}, {row.row}" for row, _ in ratios if prints_less_than_moves(row, gpu)]
    if not below:
        return target
    return replace(target, detail=f"{target.detail} (printed is less than must move in {', '.join(below)})".strip())


def _occupancy(judged: Sequence[Judged]) -> Target:
    gaps = []
    for one in judged:
        printed, ours = published_occupancy(one.row), one.row.metrics.get("occupancy_warps")
        if printed is not None and ours is not None and not is_batched(one.row):
            gaps.append((one.row, ours - printed))
    return _within(
        "occupancy of unbatched kernels", gaps, f"within {WARPS:.0f} warps", lambda g: abs(g) <= WARPS,
        lambda g: f"{g:+.1f}",
    )  # fmt: skip


def _within(
    name: str,
    found: Sequence[tuple[Row, float]],
    wanted: str,
    holds: Callable[[float], bool],
    text: Callable[[float], str],
) -> Target:
    bad = [(row, value) for row, value in found if not holds(value)]
    detail = "; ".join(f"table {row.table}, {row.row}: {text(value)}" for row, value in bad)
    met = not bad if found else None
    return Target(name, f"{len(found) - len(bad)} of {len(found)} rows", wanted, met, detail)
