"""How the score moves when each constant of the model moves, one at a time; calibrated ones are not set anew."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from mpmbench.reproduce.comparable import judge
from mpmbench.reproduce.rows import Constants, Row
from mpmbench.reproduce.score import POOLED, Score, score

STEP = 0.20
Retime = Callable[[Sequence[Row], Constants], Sequence[Row]]


@dataclass(frozen=True)
class Moved:
    """Scores with one constant less and more by STEP."""

    constant: str
    value: float
    less: Score
    more: Score

    @property
    def reach(self) -> float:
        """The median's largest distance between the two ends, for sorting."""
        return abs(self.more.median_abs_log2 - self.less.median_abs_log2)


def sensitivity(rows: Sequence[Row], constants: Constants, retime: Retime) -> list[Moved]:
    """One entry per constant, in the order given."""
    found = []
    for name, constant in constants.items():
        less, more = (
            score(judge(retime(rows, {**constants, name: replace(constant, value=constant.value * factor)})))
            for factor in (1 - STEP, 1 + STEP)
        )
        found.append(Moved(name, constant.value, less, more))
    return found


def tau(found: Score) -> float | None:
    """The pooled one."""
    return found.kendall_tau[POOLED]
