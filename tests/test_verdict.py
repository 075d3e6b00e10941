"""Verdicts: intervals that cover, words that follow from them, and the correction for many rows."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest
from scipy import stats

from mpmbench.protocol.verdict import (
    Interval,
    Paired,
    Verdict,
    compare,
    correct,
    geometric_mean,
    judge,
    lowest_rank,
    median_interval,
)


def test_interval_covers_the_median() -> None:
    """99 % by construction: of 2000 skewed samples of known median, at most 2 % may miss it."""
    generator = np.random.default_rng(7)
    misses = 0
    for _ in range(2000):
        found = median_interval(list(generator.exponential(size=25)))
        misses += not found.low <= math.log(2) <= found.high
    assert misses <= 40


def test_interval_is_unbounded_below_eight_values() -> None:
    assert median_interval([1.0] * 7) == Interval(1.0, -math.inf, math.inf)
    assert median_interval(list(map(float, range(1, 9)))) == Interval(4.5, 1.0, 8.0)
    assert math.isfinite(median_interval([float(i) for i in range(3000)]).low)


@pytest.mark.parametrize("confidence", [0.95, 0.99, 0.9999])
@pytest.mark.parametrize("n", [1, 7, 8, 9, 30, 120, 1001])
def test_rank_is_the_largest_that_covers(n: int, confidence: float) -> None:
    rank = lowest_rank(n, confidence)
    uncovered = [2 * stats.binom.cdf(r - 1, n, 0.5) for r in (rank, rank + 1)]
    assert rank == 0 or uncovered[0] <= 1 - confidence
    assert rank == n // 2 or uncovered[1] > 1 - confidence


@pytest.mark.parametrize(
    ("low", "high", "word"),
    [
        (1.006, 1.02, "FAST"),
        (0.98, 0.994, "SLOW"),
        (0.996, 1.004, "SAME"),
        (0.995, 1.005, "SAME"),
        (0.996, 1.006, "AMBG"),
        (1.004, 1.02, "AMBG"),
        (1.0051, 9.0, "FAST"),
        (-math.inf, math.inf, "AMBG"),
    ],
)
def test_words(low: float, high: float, word: str) -> None:
    assert judge(Interval((low + high) / 2 if math.isfinite(low) else 1.0, low, high), 0.005) == word


def test_speedup_is_baseline_over_other() -> None:
    found = compare([2.0] * 30, [1.0] * 30)
    assert (found.speedup.median, found.verdict, found.pairs) == (2.0, Verdict.FAST, 30)
    assert compare([1.0] * 30, [2.0] * 30).verdict is Verdict.SLOW


def test_pairs_cancel_what_both_arms_see() -> None:
    """A machine that becomes five times as slow changes no ratio."""
    level = [1.0 + 0.2 * i for i in range(21)]
    found = compare([1.02 * x for x in level], level)
    assert found.speedup.low == pytest.approx(1.02)
    assert found.verdict is Verdict.FAST


def test_nothing_to_compare_is_unusable() -> None:
    assert compare([], []).verdict is Verdict.UNUSABLE


def test_a_wide_noise_floor_takes_the_place_of_the_margin() -> None:
    times = [1.02] * 30, [1.0] * 30
    noise = Interval(1.0, 0.97, 1.01)
    found = compare(*times, noise)
    assert (found.margin, found.verdict) == (pytest.approx(0.03), Verdict.AMBIGUOUS), "noise does not make equal"
    assert compare([1.04] * 30, [1.0] * 30, noise).verdict is Verdict.FAST
    assert compare(*times, Interval(1.0, 0.999, 1.001)).margin == 0.005
    assert compare(*times, Interval(1.0, -math.inf, math.inf)).margin == 0.005, "an unknown floor is no floor"


def test_p_value_is_the_sign_tests() -> None:
    baseline = [1.02] * 9 + [1.0] * 3
    found = compare(baseline, [1.0] * 12)
    assert found.p_value == pytest.approx(stats.binomtest(9, 12).pvalue)


def rows(p_values: list[float], word: Verdict = Verdict.FAST) -> list[Paired]:
    return [Paired(Interval(1.1, 1.05, 1.15), 0.005, word, p, 40) for p in p_values]


def test_correction_takes_back_what_the_number_of_rows_explains() -> None:
    found = correct(rows([1e-9, 0.009] + [0.5] * 8))
    assert [row.verdict for row in found[:2]] == [Verdict.FAST, Verdict.AMBIGUOUS]
    assert found[1].p_value == pytest.approx(0.045)
    assert correct(rows([1e-9, 0.009]))[1].verdict is Verdict.FAST, "two rows explain less than ten"
    assert correct([]) == []


def test_correction_leaves_other_words_alone() -> None:
    assert [row.verdict for row in correct(rows([1.0, 1.0], Verdict.SAME))] == [Verdict.SAME] * 2


def test_correction_bounds_false_verdicts_in_a_table() -> None:
    """Twenty identical rows, 200 tables: with the correction at most 2 % of the tables may hold a false verdict."""
    generator = random.Random(3)
    false = 0
    for _ in range(200):
        table = [compare([1.0] * 25, [math.exp(generator.gauss(0, 0.05)) for _ in range(25)], margin=0.0)
                 for _ in range(20)]  # fmt: skip
        false += any(row.verdict in (Verdict.FAST, Verdict.SLOW) for row in correct(table))
    assert false <= 4


def test_geometric_mean_does_not_care_which_is_the_baseline() -> None:
    ratios = [2.0, 0.5, 3.0]
    assert geometric_mean(ratios) == pytest.approx(1 / geometric_mean([1 / r for r in ratios]))
    assert geometric_mean(ratios) == pytest.approx(3 ** (1 / 3))
