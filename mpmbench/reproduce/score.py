"""The score: how far modelled times are from the published ones, and whether they rank rows as printed.

Errors are log2(modelled / published), so that twice too slow and twice too fast weigh the same. Kendall's tau is
(C - D) / (C + D) over pairs of comparable rows of one table whose published times differ by more than 5 %: C pairs are
modelled in the printed order, D pairs are not, and a modelled tie within 1 % counts as D. ``pooled`` takes those pairs
of all tables together; rows of different tables are never paired, since they do not answer one question. A table with
fewer than six such pairs has no tau of its own.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from statistics import fmean, median
from typing import Any

from mpmbench.errors import MpmbenchError
from mpmbench.reproduce.comparable import Judged

PRINTED_APART = 1.05  # published times nearer than this are no pair
MODELLED_TIE = 1.01
FEWEST_PAIRS = 6  # of a table that is scored alone
POOLED = "pooled"


@dataclass(frozen=True)
class Pairs:
    """Pairs of rows whose order is scored."""

    concordant: int = 0
    discordant: int = 0

    def __add__(self, other: Pairs) -> Pairs:
        return Pairs(self.concordant + other.concordant, self.discordant + other.discordant)

    @property
    def count(self) -> int:
        return self.concordant + self.discordant

    @property
    def tau(self) -> float | None:
        return (self.concordant - self.discordant) / self.count if self.count else None


@dataclass(frozen=True)
class Score:
    """median_abs_log2, worst_abs_log2: of the errors.  geomean: of modelled / published.  pairs: by table.

    rows: comparable rows scored.  unmodelled: comparable rows that have no modelled time and are missing from the rest.
    """

    median_abs_log2: float
    worst_abs_log2: float
    geomean: float
    pairs: Mapping[int, Pairs]
    rows: int
    unmodelled: int

    @property
    def pooled(self) -> Pairs:
        return sum(self.pairs.values(), Pairs())

    @property
    def kendall_tau(self) -> dict[str, float | None]:
        """Pooled, and of each table that is scored alone."""
        alone = {str(table): found.tau for table, found in self.pairs.items() if found.count >= FEWEST_PAIRS}
        return {POOLED: self.pooled.tau, **alone}


def error_log2(judged: Judged) -> float | None:
    """log2(modelled / published): 1 is twice too slow, -1 twice too fast."""
    return None if judged.ratio is None else math.log2(judged.ratio)


def score(judged: Sequence[Judged]) -> Score:
    """Score the comparable rows. Raises MpmbenchError if none has a modelled time."""
    scored = [one for one in judged if one.comparable]
    errors = [error for one in scored if (error := error_log2(one)) is not None]
    if not errors:
        raise MpmbenchError("no comparable row has a modelled time: there is nothing to score")
    tables = sorted({one.row.table for one in scored})
    return Score(
        median(map(abs, errors)),
        max(map(abs, errors)),
        2 ** fmean(errors),
        {table: pairs([one for one in scored if one.row.table == table]) for table in tables},
        len(errors),
        len(scored) - len(errors),
    )


def pairs(judged: Sequence[Judged]) -> Pairs:
    """Of rows of one table."""
    concordant = discordant = 0
    timed = [(one.row.published_us or 0.0, one.ratio) for one in judged if one.ratio is not None]
    for (published_a, ratio_a), (published_b, ratio_b) in combinations(timed, 2):
        printed = published_a / published_b
        if max(printed, 1 / printed) <= PRINTED_APART:
            continue
        ours = printed * ratio_a / ratio_b
        if (printed > 1) == (ours > 1) and max(ours, 1 / ours) > MODELLED_TIE:
            concordant += 1
        else:
            discordant += 1
    return Pairs(concordant, discordant)


def to_json(judged: Sequence[Judged]) -> dict[str, Any]:
    """The score and every row that it was made from, and every row that it was not."""
    return {
        "score": score_json(score(judged)),
        "rows": [
            {
                "table": one.row.table,
                "row": one.row.row,
                "published_us": one.row.published_us,
                "modelled_us": one.row.modelled_us,
                "bound": None if one.row.modelled is None else one.row.modelled.bound,
                "comparable": one.comparable,
                "reason": one.row.failed or (f"{one.status}: {one.reason}" if one.reason else ""),
            }
            for one in judged
        ],
    }


def score_json(found: Score) -> dict[str, Any]:
    return {
        "median_abs_log2": found.median_abs_log2,
        "worst_abs_log2": found.worst_abs_log2,
        "geomean": found.geomean,
        "kendall_tau": found.kendall_tau,
    }
