"""Two files of times, row by row: which rows changed, by NVBench's rule, and whether the environments allow saying so.

The files come from other days, drivers or GPUs, so nothing can be paired in time. What differs between the environments
of matched rows is listed, and refused unless it is allowed by name.
"""

from __future__ import annotations

import fnmatch
import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from mpmbench.errors import InputError
from mpmbench.nvbench import ABSENT, EVENTS, WALL
from mpmbench.nvbench_rows import Row
from mpmbench.preflight import MOMENTARY
from mpmbench.robust_rule import Judgement, RobustRule

# Keys of an environment that say nothing about a time. Kernels are compared by their hashes, not by commits.
NEVER_MATTER = ("date", "argv", "seed", "git_commit", "git_dirty")
# The machine around the GPU: it moves wall times, not event times.
HOST = ("cpu", "cores", "os", "python", "numpy", "numba", "llvmlite")
NOT_RECORDED = "not recorded"
FIGURES = ("median", "min", "mean")  # that --fail-on takes


@dataclass(frozen=True)
class Difference:
    """One key whose values differ between matched rows; ``rows``: how many pairs have these two values."""

    key: str
    ref: Any
    cmp: Any
    rows: int
    allowed: bool


@dataclass(frozen=True)
class Pair:
    """The same row in both files. ratio: time of CMP over that of REF; None where one has no time."""

    ref: Row
    cmp: Row
    judgement: Judgement

    @property
    def ratio(self) -> float | None:
        return self.change(self.center)

    @property
    def center(self) -> str:
        """What is printed: the median, or the mean where a file of an older NVBench has no median."""
        timed = [row for row in (self.ref, self.cmp) if not row.without_time]
        return "mean" if any(row.seconds("median") is None for row in timed) else "median"

    def change(self, figure: str) -> float | None:
        """CMP over REF in one figure of the times."""
        before, after = self.ref.seconds(figure), self.cmp.seconds(figure)
        return after / before if before and after is not None else None


@dataclass(frozen=True)
class Summary:
    """Of the pairs of one kind of number. ratio: geometric mean of ``count`` ratios.  worst: largest ratio."""

    kind: str
    count: int
    ratio: float
    worst: Pair
    verdicts: dict[str, int]


@dataclass(frozen=True)
class Outcome:
    """Everything that a comparison has to say.

    only_ref, only_cmp: rows without a partner.  untimed: per file, rows of a kind that has no time, by kind.
    """

    preset: str
    pairs: tuple[Pair, ...]
    only_ref: tuple[Row, ...]
    only_cmp: tuple[Row, ...]
    differences: tuple[Difference, ...]
    untimed: tuple[dict[str, int], dict[str, int]]

    @property
    def refused(self) -> tuple[Difference, ...]:
        return tuple(one for one in self.differences if not one.allowed)

    @property
    def summaries(self) -> list[Summary]:
        found = []
        for kind in (EVENTS, WALL):
            pairs = [pair for pair in self.pairs if pair.ref.kind == kind]
            timed = [pair for pair in pairs if pair.ratio]
            if not timed:
                continue
            mean = math.exp(math.fsum(math.log(pair.ratio or 1) for pair in timed) / len(timed))
            worst = max(timed, key=lambda pair: pair.ratio or 0)
            verdicts = dict(Counter(pair.judgement.verdict for pair in pairs))
            found.append(Summary(kind, len(timed), mean, worst, verdicts))
        return found


@dataclass(frozen=True)
class Limit:
    """``median:5%``: a row fails that is slower by more in this figure, and that the rule calls SLOW."""

    figure: str
    percent: float

    @classmethod
    def parse(cls, text: str) -> Limit:
        figure, colon, amount = text.strip().partition(":")
        try:
            percent = float(amount.removesuffix("%"))
        except ValueError:
            percent = math.nan
        if figure not in FIGURES or not colon or not amount.endswith("%") or not 0 <= percent < math.inf:
            raise InputError(f"cannot read --fail-on {text!r}: write it as median:5%, min:5% or mean:5%")
        return cls(figure, percent)

    def __str__(self) -> str:
        return f"{self.figure}:{self.percent:g}%"

    def exceeded(self, pair: Pair) -> bool:
        """Whether the times alone are slower by more, whatever the verdict. Raises InputError without the figure."""
        if pair.ratio is None:
            return False
        change = pair.change(self.figure)
        if change is None:
            raise InputError(f"--fail-on {self}: {pair.ref.title} has no {self.figure} in one of the files")
        return 100 * (change - 1) > self.percent

    def failed(self, pairs: Iterable[Pair]) -> list[Pair]:
        return [pair for pair in pairs if self.exceeded(pair) and pair.judgement.verdict == "SLOW"]


def compare(
    ref: Sequence[Row],
    cmp: Sequence[Row],
    preset: str = "default",
    allow: Sequence[str] = (),
    benchmarks: Sequence[str] = (),
    axes: Sequence[str] = (),
) -> Outcome:
    """Match the rows of two files and judge each pair.

    preset: of NVBench's thresholds.  allow: keys that may differ, "all", or a group as "gpu".  benchmarks: globs of
    transfers or strategies.  axes: NVBench's axis filters.  Raises InputError for files without times, filters that
    select nothing, files without a common row that has times, and a key in ``allow`` that is none. What differs and is
    not allowed is in the outcome's ``refused``: no verdict of it is to be trusted.
    """
    rule = RobustRule(preset)
    for rows in (ref, cmp):
        _refuse_without_times(rows)
    chosen = _filters([*ref, *cmp], benchmarks, axes, rule)
    ref, cmp = [r for r in ref if chosen(r)], [r for r in cmp if chosen(r)]
    if not ref or not cmp:
        raise InputError("the filters leave no rows on one side: loosen -b or -a")
    untimed = tuple(dict(Counter(r.kind for r in rows if not _comparable(r))) for rows in (ref, cmp))
    matched, only_ref, only_cmp = match([r for r in ref if _comparable(r)], [r for r in cmp if _comparable(r)])
    if not matched:
        raise InputError(_nothing_in_common(only_ref, only_cmp))
    if all(a.without_time or b.without_time for a, b in matched):
        a, b = matched[0]
        reason = f"REF: {a.without_time}" if a.without_time else f"CMP: {b.without_time}"
        raise InputError(f"no row has a time in both files: {a.title}: {reason}")
    differences = environment_differences(matched, allow)
    pairs = tuple(Pair(a, b, rule.judge(a, b)) for a, b in matched)
    return Outcome(preset, pairs, tuple(only_ref), tuple(only_cmp), tuple(differences), untimed)  # type: ignore[arg-type]


def _comparable(row: Row) -> bool:
    return row.kind in (EVENTS, WALL)


def _refuse_without_times(rows: Sequence[Row]) -> None:
    if not rows:
        raise InputError("no rows on one side: nothing to compare")
    if any(not row.without_time for row in rows):
        return
    reason, _ = Counter(row.without_time for row in rows).most_common(1)[0]
    raise InputError(
        f"{rows[0].path} holds no measured time ({len(rows)} rows; {reason}): compare timed runs (-d cuda, -d cpu)"
    )


def _filters(
    rows: Sequence[Row], benchmarks: Sequence[str], axes: Sequence[str], rule: RobustRule
) -> Callable[[Row], bool]:
    for pattern in benchmarks:
        names = dict.fromkeys(name for row in rows for name in (row.transfer, row.strategy))
        if not any(fnmatch.fnmatchcase(name, pattern) for name in names):
            raise InputError(f"nothing matches {pattern!r}: valid are {', '.join(names)}")
    named_axes, selected = rule.axis_filter(axes)
    known = dict.fromkeys(value["name"] for row in rows for value in row.state["axis_values"])
    if unknown := [name for name in named_axes if name not in known]:
        raise InputError(f"unknown axis {unknown[0]!r}: valid are {', '.join(known)}")

    def chosen(row: Row) -> bool:
        named = any(fnmatch.fnmatchcase(name, p) for p in benchmarks for name in (row.transfer, row.strategy))
        return (named or not benchmarks) and selected(row)

    return chosen


# ---- matching ------------------------------------------------------------------------------------------------------


def match(ref: Sequence[Row], cmp: Sequence[Row]) -> tuple[list[tuple[Row, Row]], list[Row], list[Row]]:
    """Pairs in the order of ``cmp``, and what is left of each.

    Rows are the same by kind of number, transfer, strategy, dataset, axes, cache state and GPU. Repeated rows pair in
    their order. A row that was not timed may not know its cache state: it then takes any row that is otherwise equal.
    """
    gpus = _pair_devices(ref, cmp)

    def key(row: Row) -> tuple[Any, ...]:
        """Of a row of ``ref``: those of ``cmp`` come as if they ran on its GPU."""
        dataset = row.fingerprint or row.dataset
        return row.kind, row.transfer, row.strategy, dataset, row.axes, row.device, row.cache

    moved = [replace(row, device=gpus.get(row.device, row.device)) for row in cmp]
    waiting: dict[Any, list[Row]] = {}
    for row in ref:
        waiting.setdefault(key(row), []).append(row)
    partners: dict[int, Row] = {}
    for i, row in enumerate(moved):
        if same := waiting.get(key(row)):
            partners[i] = same.pop(0)
    left = [row for rows in waiting.values() for row in rows]
    for i, row in enumerate(moved):
        if i in partners:
            continue
        for other in left:
            if key(other)[:-1] == key(row)[:-1] and ABSENT in (other.cache, row.cache):
                partners[i] = other
                left = [one for one in left if one is not other]
                break
    pairs = [(partners[i], row) for i, row in enumerate(cmp) if i in partners]
    return pairs, left, [row for i, row in enumerate(cmp) if i not in partners]


def _pair_devices(ref: Sequence[Row], cmp: Sequence[Row]) -> dict[tuple[str, str], tuple[str, str]]:
    """Device of ``cmp`` -> device of ``ref``, in their order, without those that both have: each pairs with itself."""
    found: dict[tuple[str, str], tuple[str, str]] = {}
    for kind in (EVENTS, WALL):
        before, after = (list(dict.fromkeys(row.device for row in rows if row.kind == kind)) for rows in (ref, cmp))
        common = set(before) & set(after)
        rest = [device for device in before if device not in common]
        found |= dict(zip([device for device in after if device not in common], rest, strict=False))
    return found


def _nothing_in_common(ref: Sequence[Row], cmp: Sequence[Row]) -> str:
    text = "the files have no row in common (strategy, dataset, axes, cache state and kind of number must agree)"
    if ref and cmp:
        text += f": {ref[0].title}, {ref[0].kind}, against {cmp[0].title}, {cmp[0].kind}"
    return text


# ---- environments --------------------------------------------------------------------------------------------------


def environment_differences(pairs: Sequence[tuple[Row, Row]], allow: Sequence[str] = ()) -> list[Difference]:
    """Every key that differs within a pair of rows with times, each combination of values once.

    ``allow`` names keys, groups ("gpu" for every gpu.*, "kernel" for every kernel's text) or "all". Raises InputError
    for a name that is no key of these files.
    """
    timed = [(a, b) for a, b in pairs if not a.without_time and not b.without_time]
    found: Counter[tuple[str, str, str]] = Counter()
    values: dict[tuple[str, str, str], tuple[Any, Any]] = {}
    keys: dict[str, None] = {}
    for ref, cmp in timed:
        before, after = _environment(ref), _environment(cmp)
        for key in dict.fromkeys([*before, *after]):
            keys[key] = None
            a, b = before.get(key, NOT_RECORDED), after.get(key, NOT_RECORDED)
            if a != b:
                found[key, str(a), str(b)] += 1
                values[key, str(a), str(b)] = a, b
    known = {"all", *keys, *(key.partition(".")[0] for key in keys)}
    if unknown := [name for name in allow if name not in known]:
        raise InputError(f"--allow-different {unknown[0]}: no such key; these files have {', '.join(sorted(known))}")
    return [
        Difference(key, *values[key, a, b], count, not {"all", key, key.partition(".")[0]}.isdisjoint(allow))
        for (key, a, b), count in found.items()
    ]


def _environment(row: Row) -> dict[str, Any]:
    """What can change the row's time, kernels by the start of their hash."""
    ignored = NEVER_MATTER if row.kind == WALL else (*NEVER_MATTER, *HOST)
    lasting = {key: value for key, value in row.environment.items() if not key.endswith(MOMENTARY)}
    facts = {key: value for key, value in lasting.items() if key not in ignored}
    return facts | {f"kernel.{name}": sha[:12] for name, sha in row.hashes.items()}
