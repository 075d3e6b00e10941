"""Which combinations of axes tests take: a small, seeded covering array, in which every pair of possible values of two
factors meets at least once, or every combination that has a text of its own."""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from mpmbench.variants import COMPILER_OPTIONS, Variant, why_impossible

Row = dict[str, Any]


def pairs_of(row: Row) -> set[tuple[tuple[str, Any], tuple[str, Any]]]:
    return set(itertools.combinations(sorted(row.items(), key=lambda item: item[0]), 2))


def covering_rows(
    choices: Sequence[Mapping[str, Sequence[Any]]], possible: Callable[[Row], bool], seed: int, tries: int = 12
) -> list[Row]:
    """Rows that cover every pair of values that some possible row contains.

    choices: alternatives of factor -> values; a row is one value of each factor of one alternative (factors that an
    alternative lacks do not meet anything in its rows). Greedy: each row is built around a pair not covered yet, the
    best of a few random completions.
    """
    rng = random.Random(seed)

    def complete(fixed: Row) -> Row | None:
        able = [c for c in choices if all(value in c.get(name, ()) for name, value in fixed.items())]
        for _ in range(200):
            if not able:
                return None
            choice = rng.choice(able)
            row = {name: fixed.get(name, rng.choice(values)) for name, values in choice.items()}
            if possible(row):
                return row
        return None

    todo: dict[Any, None] = {}  # an ordered set: sets of strings would change order from run to run
    for choice in choices:
        for (a, a_values), (b, b_values) in itertools.combinations(sorted(choice.items()), 2):
            todo |= {((a, x), (b, y)): None for x in a_values for y in b_values}
    rows: list[Row] = []
    while todo:
        pair = next(iter(todo))
        candidates = [row for row in (complete(dict(pair)) for _ in range(tries)) if row is not None]
        if candidates:
            best = max(candidates, key=lambda row: sum(p in todo for p in pairs_of(row)))
            rows.append(best)
            for covered in pairs_of(best):
                todo.pop(covered, None)
        todo.pop(pair, None)  # where no row could be completed the pair cannot exist
    return rows


def texts_of(variant: Variant) -> list[Row]:
    """Every possible combination of a strategy's axes under the compiler's usual options: those would make four times
    as many and change no text. In covering arrays each of them meets every other value."""
    told = {axis for axis, _ in COMPILER_OPTIONS}
    values = [values[:1] if axis in told else values for axis, values in variant.axes.items()]
    rows = [dict(zip(variant.axes, row, strict=True)) for row in itertools.product(*values)]
    return [axes for axes in rows if why_impossible(variant, axes) is None]
