"""Each strategy at its own best: block shape and batching searched within a budget of configurations.

The search goes along one axis at a time, from the best found so far (coordinate descent), and begins with the defaults.
Configurations that are tried together are a *heat*: on a device that keeps time they are strategies of one contest, so
that drift hits all alike; for a GPU that is modelled they are runs on the simulated device. What is compared is the
time of the transfer alone. A configuration whose result is wrong has no time and cannot be chosen.
"""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from mpmbench.contest import Timing, run_contest
from mpmbench.environment import Environment
from mpmbench.errors import InputError
from mpmbench.gpu import Gpu
from mpmbench.measure import Sampling
from mpmbench.protocol import rounds
from mpmbench.protocol.verdict import MARGIN, Verdict
from mpmbench.record import Record, Tried, Tuning
from mpmbench.runner import Case, Inputs, format_axis, label_of, refuse_bad_input, tuned_key
from mpmbench.variants import Variant, why_impossible

BUDGET = 12  # one of each value of both axes beside the defaults

# Axes that change how a strategy works and neither what it computes nor which steps it needs, in the order searched.
AXES = ("batching", "block_shape")

# Beside the shapes that a variant names: powers of two from 32 to 256 cells, long along x, in which cells are numbered.
LONG_SHAPES = ((8, 2, 2), (8, 4, 2), (16, 4, 2), (16, 4, 4))

WRONG = "wrong"  # how the reason of a configuration begins that failed the check

# The steps around the transfer are not searched for: one sample each.
ONE_SAMPLE = Sampling(min_samples=1, max_samples=1, warmup_limit=0)


@dataclass(frozen=True)
class Search:
    """What of a case is free.

    free: axes, in the order searched.  budget: configurations that may be tried.  configurations: all axes of each that
    can exist, the one to begin with first.
    """

    free: tuple[str, ...]
    budget: int
    configurations: tuple[Mapping[str, Any], ...]

    @property
    def key(self) -> tuple[Any, ...]:
        """Searches of equal key find the same for the same case."""
        return self.free, self.budget, len(self.configurations)

    @property
    def tries(self) -> int:
        """Most configurations that are tried."""
        return min(self.budget, len(self.configurations))

    def __str__(self) -> str:
        free = f" of {', '.join(self.free)}" if self.free else ""
        return f"{self.tries} of {len(self.configurations)} configurations{free}"


def free_axes(variant: Variant, axes: Mapping[str, Any], fixed: Collection[str]) -> tuple[str, ...]:
    """Axes to search: those of AXES that the variant has, that matter to it, and that nobody has fixed."""
    # Without blocks, their shape is only an order of particles: that of a sort by blocks.
    shape_matters = variant.uses_blocks or (axes["particle_order"] != "given" and axes["cell_index"] == "block")
    return tuple(
        name for name in AXES if name in variant.axes and name not in fixed and (name != "block_shape" or shape_matters)
    )


def values(variant: Variant, axis: str) -> tuple[Any, ...]:
    """Candidates for an axis, the variant's default first."""
    return tuple(dict.fromkeys([*variant.axes[axis], *(LONG_SHAPES if axis == "block_shape" else ())]))


def to_search(cases: Sequence[Any], budget: int, fixed: Collection[str]) -> list[Any]:
    """The cases with a search for their free axes; primitives stay as they are.

    fixed: axes that the user has chosen. Raises InputError where there is nothing to search.
    """
    found = [_to_search(case, budget, fixed) if isinstance(case, Case) else case for case in cases]
    if not any(case.search and case.search.free for case in found):
        raise InputError(
            f"--tune has nothing to search: it tries {' and '.join(AXES)} of transfers, those that -a does not fix"
        )
    return found


def _to_search(case: Case, budget: int, fixed: Collection[str]) -> Case:
    free = free_axes(case.variant, case.axes, fixed)
    # The values of the case come first: with them the search begins.
    choices = [dict.fromkeys([case.axes[name], *values(case.variant, name)]) for name in free]
    every = [{**case.axes, **dict(zip(free, chosen, strict=True))} for chosen in itertools.product(*choices)]
    possible = [axes for axes in every if not why_impossible(case.variant, axes)]
    return replace(case, search=Search(free, budget, tuple(possible or every[:1])))


# (cases, the best so far first) -> their records, in the same order.
Heat = Callable[[Sequence[Case]], Sequence[Record]]


def find(case: Case, heat: Heat, kind: str, gpu: str | None = None) -> tuple[Case, Record]:
    """The case with the best axes found and with how they were found; the record of its last heat.

    kind, gpu: of the times, as in ``Tuning``.
    """
    assert case.search is not None
    hunt = _Hunt(case, case.search, heat)
    hunt.run()
    tuning = Tuning(
        case.search.free, case.search.budget, len(case.search.configurations), kind, gpu, tuple(hunt.tried())
    )
    return replace(hunt.best, tuning=tuning), replace(hunt.records[hunt.best.label], tuning=tuning)


class _Hunt:
    """One search under way. records: of each configuration, its last one."""

    def __init__(self, case: Case, search: Search, heat: Heat) -> None:
        self.search, self.heat = search, heat
        self.open = [replace(case, axes=axes, search=None) for axes in search.configurations]
        self.best = self.open[0]
        self.records: dict[str, Record] = {}

    def run(self) -> None:
        if len(self.open) <= self.search.budget:
            self.try_all(self.open)
            return
        idle = 0
        for axis in itertools.cycle(self.search.free):
            idle = 0 if self.try_all(self.along(axis)) else idle + 1
            if idle == len(self.search.free):
                break
        # All axes have been gone through from the best: what is left of the budget goes to others, anywhere.
        random.Random(0).shuffle(self.open)
        self.try_all(self.open)

    def along(self, axis: str) -> list[Case]:
        """Configurations that differ from the best in one axis."""
        others = [name for name in self.search.free if name != axis]
        return [case for case in self.open if all(case.axes[name] == self.best.axes[name] for name in others)]

    def try_all(self, cases: Sequence[Case]) -> bool:
        """A heat of those that have not been tried and that the budget has room for; False where there are none."""
        new = [case for case in (self.best, *cases) if case.label not in self.records]
        new = list({case.label: case for case in new}.values())[: self.search.budget - len(self.records)]
        if not new:
            return False
        together = [self.best, *(case for case in new if case.label != self.best.label)]
        found = dict(zip((case.label for case in together), self.heat(together), strict=True))
        self.records |= found
        self.best = _best(together, found)
        return True

    def tried(self) -> Iterator[Tried]:
        """The best, then the others by time, then what has none."""

        def place(item: tuple[str, Record]) -> tuple[bool, float]:
            time = seconds(item[1])
            return item[0] != self.best.label, float("inf") if time is None else time

        for _, record in sorted(self.records.items(), key=place):
            axes = {name: record.axes[name] for name in self.search.free}
            yield Tried(axes, seconds(record), "" if seconds(record) is not None else _reason(record))


def _best(cases: Sequence[Case], records: Mapping[str, Record]) -> Case:
    """The fastest of those that are faster than the first that has a time: ties go to it."""
    timed = [case for case in cases if seconds(records[case.label]) is not None]
    if not timed:
        return cases[0]
    base = records[timed[0].label]
    faster = [case for case in timed[1:] if _faster(records[case.label], base)]
    return min(faster, key=lambda case: seconds(records[case.label]) or 0.0, default=timed[0])


def seconds(record: Record) -> float | None:
    """Time of the transfer [s], measured or for the one GPU that is modelled; None where there is none."""
    if record.status != "ok":
        return None
    if record.transfer_measurement:
        return record.transfer_measurement.median
    return next((profile.time.seconds for profile in (record.modelled or {}).values()), None)


def _faster(record: Record, base: Record) -> bool:
    compared = record.comparison
    if compared and compared.baseline == label_of(base.variant, base.axes, base.default_axes):
        return compared.verdict == Verdict.FAST
    mine, its = seconds(record), seconds(base)
    return mine is not None and its is not None and mine * (1 + MARGIN) < its


def _reason(record: Record) -> str:
    if record.status == "wrong":
        assert record.check is not None
        return f"{WRONG}: error {record.check.ratio:.3g} x allowed"
    findings = record.findings[0].message if record.findings else ""
    return f"{record.status}: {record.skipped_because or record.failed_because or findings or 'no time'}"


def wrong(record: Record) -> list[Tried]:
    """Configurations of a record's search that failed the check."""
    return [one for one in (record.tuning.tried if record.tuning else ()) if one.reason.startswith(WRONG)]


def axes_text(axes: Mapping[str, Any]) -> str:
    return " ".join(f"{name}={format_axis(value)}" for name, value in axes.items())


# --- on devices that keep time ----------------------------------------------------------------------------------------


def tune(
    case: Case, device: Any, inputs: Inputs, environment: Environment, timing: Timing, tick: Callable[[str], None]
) -> Case:
    """The case with the axes that are fastest on this device, in this state of the caches. A heat is a short contest.

    tick: told what is going on.
    """
    count, tries = 0, _tries(case)

    def heat(cases: Sequence[Case]) -> list[Record]:
        nonlocal count
        count += len(cases) - bool(count)  # the best so far is there again
        where = f"tuning {case.label} {count}/{tries}"
        short = replace(timing, rules=rounds.QUICK, sampling=ONE_SAMPLE, baseline=cases[0].label)
        records = run_contest(cases, device, inputs, environment, short, tick=lambda what: tick(f"{where}: {what}"))
        found = {label_of(record.variant, record.axes, record.default_axes): record for record in records}
        return [found[one.label] for one in cases]

    return find(case, heat, "measured (wall, CPU)" if device.name == "cpu" else "measured (events)")[0]


def settled(case: Case, record: Record) -> Case:
    """The case as an earlier search left it, from its row."""
    return replace(case, axes=record.axes, search=None, tuning=record.tuning)


# --- on named GPUs ----------------------------------------------------------------------------------------------------


def model_tuned(
    cases: Sequence[Any],
    gpus: Sequence[Gpu],
    progress: Callable[[str, int, int], None],
    keep: Callable[[Record], None] = lambda record: None,
    known: Sequence[Record] = (),
) -> list[Record]:
    """``profile_cases`` with a search: each GPU has its own best axes, and so a record of its own per case.

    progress: told of every configuration that runs.
    """
    from mpmbench.profile import Modeller, run_modelled

    refuse_bad_input(cases)
    environment, inputs = Environment.capture(), Inputs()
    earlier = {(tuned_key(record), record.tuning.gpu): record for record in known if record.tuning}
    groups = list(itertools.product(cases, gpus))
    total = sum(_tries(case) for case, _ in groups)
    records: list[Record] = []
    done = 0
    for case, gpu in groups:
        model = Modeller(gpu)
        heat = _Once(
            run=partial(run_modelled, model=model, inputs=inputs, environment=environment),
            tell=partial(_tell, progress, gpu.name, _tries(case), done, total),
        )
        found = earlier.get((case.resume_key(model.device(), inputs), gpu.name)) if earlier and case.search else None
        if found is None:
            found = find(case, heat, "modelled", gpu.name)[1] if case.search else heat([case])[0]
            keep(found)
        records.append(found)
        done += _tries(case)
    progress("done", total, total)
    return records


def _tries(case: Any) -> int:
    return case.search.tries if case.search else 1


def _tell(
    progress: Callable[[str, int, int], None], gpu: str, tries: int, done: int, total: int, case: Any, place: int
) -> None:
    tuning = f"tuning {case.name} {place + 1}/{tries}: " if tries > 1 else ""
    progress(f"{gpu}: {tuning}{case.title}", done + place, total)


@dataclass(frozen=True)
class _Once:
    """A heat on the simulated device: a case that has run before is not run again.

    run: case -> its record.  tell: (case, how many have run) before each run.
    """

    run: Callable[[Any], Record]
    tell: Callable[[Any, int], None]
    records: dict[str, Record] = field(default_factory=dict)

    def __call__(self, cases: Sequence[Any]) -> list[Record]:
        for case in cases:
            if case.label not in self.records:
                self.tell(case, len(self.records))
                self.records[case.label] = self.run(case)
        return [self.records[case.label] for case in cases]
