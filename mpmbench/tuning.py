"""Each strategy at its own best: block shape and batching searched within a budget of configurations.

The budget goes to a spread over all that can exist, in which every value of every axis comes up about equally often,
defaults first. Going along one axis after the other can get stuck, depending on which goes first: which batching is
best depends on the block shape. On a device that keeps time the configurations of a strategy are timed in the same
rounds, so that drift hits all alike; for a GPU that is modelled each runs on the simulated device. What is compared is
the time of the transfer alone. A configuration whose result is wrong has no time and cannot be chosen.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from mpmbench.contest import Timing, run_contest
from mpmbench.environment import Environment
from mpmbench.errors import InputError
from mpmbench.gpu import Gpu
from mpmbench.measure import Sampling
from mpmbench.protocol import rounds
from mpmbench.protocol.verdict import MARGIN
from mpmbench.record import Record, Tried, Tuning
from mpmbench.runner import Case, Inputs, format_axis, label_of, refuse_bad_input, tuned_key
from mpmbench.variants import Variant, why_impossible

# Axes that change how a strategy works and neither what it computes nor which steps it needs.
AXES = ("block_shape", "batching")

# Beside the shapes that a variant names: powers of two from 32 to 256 cells, long along x, in which cells are numbered.
LONG_SHAPES = ((8, 2, 2), (8, 4, 2), (16, 4, 2), (16, 4, 4))

WRONG = "wrong"  # how the reason of a configuration begins that failed the check

# The steps around the transfer are not searched for: one sample each.
ONE_SAMPLE = Sampling(min_samples=1, max_samples=1, warmup_limit=0)


@dataclass(frozen=True)
class Search:
    """What of a case is free.

    free: axes.  budget: configurations that may be tried.  possible: how many can exist.
    configurations: all axes of each that is tried; ties go to the first.
    """

    free: tuple[str, ...]
    budget: int
    possible: int
    configurations: tuple[Mapping[str, Any], ...]

    @property
    def key(self) -> tuple[Any, ...]:
        """Searches of equal key find the same for the same case."""
        return self.free, self.budget, self.possible

    def __str__(self) -> str:
        free = f" of {', '.join(self.free)}" if self.free else ""
        return f"{len(self.configurations)} of {self.possible} configurations{free}"


def free_axes(variant: Variant, axes: Mapping[str, Any], fixed: Collection[str]) -> tuple[str, ...]:
    """Axes to search: those of AXES that the variant has, that matter to it, and that nobody has fixed."""
    # Without blocks, their shape is only an order of particles: that of a sort by blocks.
    shape_matters = variant.uses_blocks or (axes["particle_order"] != "given" and axes["cell_index"] == "block")
    return tuple(
        name for name in AXES if name in variant.axes and name not in fixed and (name != "block_shape" or shape_matters)
    )


def spread(possible: Sequence[Mapping[str, Any]], free: Sequence[str], count: int) -> list[Mapping[str, Any]]:
    """So many configurations, the first one first; each next one has the values that came up least until then."""
    left = list(possible)
    chosen = [left.pop(0)]
    used = {name: Counter([chosen[0][name]]) for name in free}
    while left and len(chosen) < count:
        rarest = min(left, key=lambda axes: sum(used[name][axes[name]] for name in free))
        left.remove(rarest)
        chosen.append(rarest)
        for name in free:
            used[name][rarest[name]] += 1
    return chosen


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
    variant, free = case.variant, free_axes(case.variant, case.axes, fixed)
    # Each axis begins with the case's own value, so that its own configuration comes first.
    values = [
        dict.fromkeys([case.axes[name], *variant.axes[name], *(LONG_SHAPES if name == "block_shape" else ())])
        for name in free
    ]
    every = [{**case.axes, **dict(zip(free, chosen, strict=True))} for chosen in itertools.product(*values)]
    possible = [axes for axes in every if not why_impossible(variant, axes)]
    tried = spread(possible or every[:1], free, budget)  # where nothing can exist, the row says why
    return replace(case, search=Search(free, budget, len(possible), tuple(tried)))


def configurations(case: Case) -> list[Case]:
    """A case for each configuration that its search tries."""
    assert case.search is not None
    return [replace(case, axes=axes, search=None) for axes in case.search.configurations]


def choose(search: Search, records: Sequence[Record], kind: str, gpu: str | None = None) -> tuple[int, Tuning]:
    """Place of the best record, one for each configuration in order, and the search as its row keeps it.

    kind, gpu: of the times, as in ``Tuning``. The best is the fastest of those that are faster than the first that has
    a time; if there is none, that first one.
    """
    timed = {place: time for place, record in enumerate(records) if (time := seconds(record)) is not None}
    first = min(timed, default=0)
    faster = [place for place in timed if place != first and _faster(records[place], records[first])]
    best = min(faster, key=lambda place: timed[place], default=first)
    order = sorted(range(len(records)), key=lambda place: (place != best, timed.get(place, float("inf")), place))
    tried = tuple(
        Tried(
            {name: records[place].axes[name] for name in search.free},
            timed.get(place),
            "" if place in timed else _reason(records[place]),
        )
        for place in order
    )
    return best, Tuning(search.free, search.budget, search.possible, kind, gpu, tried)


def seconds(record: Record) -> float | None:
    """Time of the transfer [s], measured or for the one GPU that is modelled; None where there is none."""
    if record.status != "ok":
        return None
    if record.transfer_measurement:
        return record.transfer_measurement.median
    return next((profile.time.seconds for profile in (record.modelled or {}).values()), None)


def _faster(record: Record, base: Record) -> bool:
    """By more than the margin: in rounds, pass by pass, that is at least what two copies of the baseline differ by."""
    compared = record.comparison
    if compared and compared.speedup and compared.baseline == _label(base):
        return compared.speedup[0] > 1 + compared.margin
    mine, its = seconds(record), seconds(base)
    return mine is not None and its is not None and mine * (1 + MARGIN) < its


def _label(record: Record) -> str:
    return label_of(record.variant, record.axes, record.default_axes)


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
    """The case with the axes that are fastest on this device in this state of the caches, found in a short contest.

    tick: told what is going on.
    """
    assert case.search is not None
    cases = configurations(case)
    short = replace(timing, rules=rounds.QUICK, sampling=ONE_SAMPLE)
    places = {one.title: place for place, one in enumerate(cases, start=1)}

    def told(what: str) -> None:
        place = places.get(what.removesuffix(": check"))
        tick(f"tuning {case.name} {place}/{len(cases)}: check" if place else f"tuning {case.name}: {what}")

    rows = run_contest(cases, device, inputs, environment, short, tick=told, baseline=cases[0])
    records = {_label(record): record for record in rows}
    kind = "measured (wall, CPU)" if device.name == "cpu" else "measured (events)"
    best, tuning = choose(case.search, [records[one.label] for one in cases], kind)
    return replace(cases[best], tuning=tuning)


def settled(case: Case, record: Record) -> Case:
    """The case with the axes that an earlier search found, from its row."""
    return replace(case, axes=record.axes, search=None)


# --- on named GPUs ----------------------------------------------------------------------------------------------------


def model_tuned(
    cases: Sequence[Any],
    gpus: Sequence[Gpu],
    progress: Callable[[str, int, int], None],
    keep: Callable[[Record], None] = lambda record: None,
    known: Sequence[Record] = (),
) -> list[Record]:
    """``profile_cases`` with a search: each GPU has its own best axes, and so a record of its own per case.

    progress: told of every configuration that runs. The record is that of the configuration that won: nothing is
    counted twice.
    """
    from mpmbench.profile import Modeller, run_modelled

    refuse_bad_input(cases)
    environment, inputs = Environment.capture(), Inputs()
    earlier = {(tuned_key(record), gpu): record for record in known for gpu in record.modelled or ()}
    groups = [(case, gpu, configurations(case) if case.search else [case]) for case in cases for gpu in gpus]
    total, done = sum(len(tries) for *_, tries in groups), 0
    records: list[Record] = []
    for case, gpu, tries in groups:
        model = Modeller(gpu)
        found = earlier.get((case.resume_key(model.device(), inputs), gpu.name)) if earlier else None
        if found is None:
            tried = []
            for place, one in enumerate(tries, start=1):
                tuning = f"tuning {case.name} {place}/{len(tries)}: " if len(tries) > 1 else ""
                progress(f"{gpu.name}: {tuning}{one.title}", done + place - 1, total)
                tried.append(run_modelled(one, model, inputs, environment))
            found = tried[0]
            if case.search:
                best, searched = choose(case.search, tried, "modelled", gpu.name)
                found = replace(tried[best], tuning=searched)
            keep(found)
        records.append(found)
        done += len(tries)
    progress("done", total, total)
    return records
