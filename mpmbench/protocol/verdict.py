"""From paired times to a word: FAST, SLOW, SAME, AMBG or ????.

Pair i holds the times of two arms from one pass, moments apart, so that a drifting clock cancels in their ratio. The
median of the ratios gets an interval from order statistics: the number of ratios below the true median is binomial,
whatever the distribution, so the interval needs neither normality nor resampling, and costs one sort. The sign test of
the same ratios gives the p-value that a table corrects for its number of rows.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache

MARGIN = 0.005  # smaller differences are not called differences
CONFIDENCE = 0.99


class Verdict(StrEnum):
    """NVBench's words for a row against the baseline."""

    FAST = "FAST"
    SLOW = "SLOW"
    SAME = "SAME"
    AMBIGUOUS = "AMBG"
    UNUSABLE = "????"


@dataclass(frozen=True)
class Interval:
    """A median and its confidence interval; infinite where there are too few values for the confidence."""

    median: float
    low: float
    high: float

    @property
    def half_width(self) -> float:
        """Relative to the median."""
        return (self.high - self.low) / (2 * self.median) if self.median else math.inf

    @property
    def spread(self) -> float:
        """How far the interval reaches from 1: the noise floor, where both arms are the same."""
        return max(abs(self.low - 1), abs(self.high - 1))


@dataclass(frozen=True)
class Paired:
    """One arm against the baseline.

    speedup: baseline's time over this arm's, pair by pair.  margin: a difference has to be clear of it.
    p_value: of the sign test that the speedup lies beyond the margin by chance; 1 where it does not lie beyond.
    """

    speedup: Interval
    margin: float
    verdict: Verdict
    p_value: float
    pairs: int


def median_interval(values: Sequence[float], confidence: float = CONFIDENCE) -> Interval:
    """Median of independent values and its interval [x_(r), x_(n-r+1)] of at least the confidence."""
    ordered = sorted(values)
    rank = lowest_rank(len(ordered), confidence)
    median = statistics.median(ordered)
    if rank == 0:
        return Interval(median, -math.inf, math.inf)
    return Interval(median, ordered[rank - 1], ordered[-rank])


def compare(
    baseline: Sequence[float],
    other: Sequence[float],
    noise: Interval | None = None,
    confidence: float = CONFIDENCE,
    margin: float = MARGIN,
) -> Paired:
    """Judge ``other`` against ``baseline``: times [s] of the same passes, in the same order.

    noise: ratio of two copies of the baseline from the same rounds. A spread wider than ``margin`` takes its place
    where a difference is called, not where equality is: noise hides differences, it does not make equal.
    """
    speedups = [b / o for b, o in zip(baseline, other, strict=True)]
    if not speedups:
        return Paired(Interval(math.nan, -math.inf, math.inf), margin, Verdict.UNUSABLE, 1.0, 0)
    interval = median_interval(speedups, confidence)
    equal, margin = margin, max(margin, noise.spread if noise and math.isfinite(noise.spread) else 0.0)
    return Paired(interval, margin, judge(interval, margin, equal), _sign_test(speedups, margin), len(speedups))


def judge(speedup: Interval, margin: float = MARGIN, equal: float = MARGIN) -> Verdict:
    """The word for an interval: clear of 1 +- margin, inside 1 +- equal, or neither."""
    if math.isnan(speedup.median):
        return Verdict.UNUSABLE
    if speedup.low > 1 + margin:
        return Verdict.FAST
    if speedup.high < 1 - margin:
        return Verdict.SLOW
    if speedup.low >= 1 - equal and speedup.high <= 1 + equal:
        return Verdict.SAME
    return Verdict.AMBIGUOUS


def correct(rows: Sequence[Paired], confidence: float = CONFIDENCE) -> list[Paired]:
    """The rows of one table after Benjamini and Hochberg: differences that the number of rows explains are AMBG.

    Benjamini, Hochberg: Controlling the false discovery rate, J. R. Stat. Soc. B 57 (1995) 289-300.
    """
    from dataclasses import replace

    from scipy.stats import false_discovery_control

    if not rows:
        return []
    adjusted = false_discovery_control([row.p_value for row in rows])
    called = (Verdict.FAST, Verdict.SLOW)
    return [
        replace(row, p_value=float(p), verdict=Verdict.AMBIGUOUS)
        if row.verdict in called and p > 1 - confidence
        else replace(row, p_value=float(p))
        for row, p in zip(rows, adjusted, strict=True)
    ]


def geometric_mean(ratios: Sequence[float]) -> float:
    """The only mean of ratios that does not depend on which side is called the baseline."""
    return math.exp(statistics.fmean(map(math.log, ratios)))


def _sign_test(speedups: Sequence[float], margin: float) -> float:
    """Two-sided p-value that the median speedup lies within the margin, by the side it lies on."""
    n = len(speedups)
    beyond = max(sum(s > 1 + margin for s in speedups), sum(s < 1 - margin for s in speedups))
    return min(1.0, 2 * _tail(n, n - beyond))


@lru_cache(maxsize=4096)
def lowest_rank(n: int, confidence: float) -> int:
    """Largest r such that [x_(r), x_(n-r+1)] covers the median with the confidence; 0 if none does."""
    low, high = 0, n // 2 + 1  # _tail(n, r - 1) grows with r
    while high - low > 1:
        middle = (low + high) // 2
        if _tail(n, middle - 1) <= (1 - confidence) / 2 * (1 + 1e-12):
            low = middle
        else:
            high = middle
    return low


@lru_cache(maxsize=4096)
def _tail(n: int, k: int) -> float:
    """P(at most k of n fair coins show heads)."""
    from scipy.special import bdtr

    return float(bdtr(k, n, 0.5)) if k >= 0 else 0.0
