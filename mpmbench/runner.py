"""One case through the whole flow: dataset -> preprocessing -> transfer -> check -> count or measure -> Record.

Cases come from a preset or from the command line's choice of variants, datasets and axes; each becomes one Record,
whatever happens to it: run, skipped with a reason, or broken with a reason.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from traceback import extract_tb
from typing import TYPE_CHECKING, Any

import numpy as np

from mpmbench import plan as planning
from mpmbench.check import CheckResult, check_g2p, check_p2g
from mpmbench.contest import BASELINES, PROBLEM_AXES, Contender
from mpmbench.dataset import Dataset, load_dataset
from mpmbench.device import Device, Launch, LaunchReport
from mpmbench.environment import Environment, machine_bytes
from mpmbench.errors import InputError
from mpmbench.profile_record import Profile
from mpmbench.record import Check, DatasetSummary, Record, StepCost, Tuning, line_texts
from mpmbench.reference import Nodes, ReferenceNodes, ReferenceParticles, g2p, grid_divide, p2g
from mpmbench.simt.counters import Counters
from mpmbench.variants import Variant, resolve_axes, why_impossible

if TYPE_CHECKING:
    from mpmbench.tuning import Search

# The reference, the sums and the allowance of a check, float64, at their peak: measured on 192^3 nodes.
CHECK_BYTES_PER_NODE = 320


@dataclass(frozen=True)
class DatasetChoice:
    """A dataset by name or path, with what overrides its recipe; loaded only when its first case runs."""

    name: str
    particles: int | None = None
    particles_per_cell: int | None = None
    seed: int | None = None
    grid_shape: tuple[int, int, int] | None = None
    dx: float | None = None
    origin: tuple[float, float, float] | None = None

    def load(self) -> Dataset:
        return load_dataset(
            self.name,
            self.particles,
            self.particles_per_cell,
            self.seed,
            grid_shape=self.grid_shape,
            dx=self.dx,
            origin=self.origin,
        )


@dataclass(frozen=True)
class Case:
    """One strategy on one dataset with one choice of axes.

    preset_row: the published row it repeats, if any.  search: for better axes than these, before it is run.
    tuning: the search that its axes come from.
    """

    variant: Variant
    dataset: DatasetChoice
    axes: Mapping[str, Any]
    preset_row: Mapping[str, Any] | None = None
    search: Search | None = None
    tuning: Tuning | None = None

    @property
    def name(self) -> str:
        return self.variant.name

    def shrunk(self, particles: int | None = None, size: int | None = None) -> Case:
        """This case with so many particles, where its dataset has a choice: no repetition of a published row."""
        if particles is None or self.dataset.particles is None:
            return self
        return replace(self, dataset=replace(self.dataset, particles=particles), preset_row=None)

    @property
    def label(self) -> str:
        """The variant and what differs from its defaults: unique among the cases of a contest."""
        return label_of(self.name, self.axes, resolve_axes(self.variant, {}))

    @property
    def title(self) -> str:
        """For progress lines."""
        return f"{self.label} on {self.dataset.name}"

    def contest_key(self, inputs: Inputs) -> tuple[Any, ...]:
        """Cases of equal key answer the same question."""
        return (self.variant.transfer, self.dataset, *(self.axes[axis] for axis in PROBLEM_AXES))

    @property
    def is_plain(self) -> bool:
        """Whether this is what a user has before reading any of this: global atomics (or a gather), never sorted."""
        return self.name == BASELINES[self.variant.transfer] and self.axes["particle_order"] == "given"

    def device_bytes(self, inputs: Inputs) -> int:
        """Device memory that it takes while it is timed."""
        if why_impossible(self.variant, self.axes):
            return 0
        return planning.predict_bytes(self.variant, inputs.select(self.dataset), self.axes)

    def run(self, device: Device, inputs: Inputs, environment: Environment, model: Model | None = None) -> Record:
        """``run_case`` for this case."""
        return run_case(self, device, inputs, environment, model)

    def prepare(
        self, device: Device, inputs: Inputs, environment: Environment, cache: str = "cold"
    ) -> Record | Contender:
        """``prepare_case`` for this case."""
        return prepare_case(self, device, inputs, environment, cache)

    def resume_key(self, device: Device, inputs: Inputs) -> tuple[Any, ...]:
        """Equal to ``resume_key`` of the Record that this case would repeat; with a search, to its ``tuned_key``."""
        fingerprint, row = inputs.select(self.dataset).fingerprint, self.preset_row or {}
        where, search = (device.name, device.arch), self.search
        axes = _axis_key(self.axes, search.free if search else ())
        key = (self.name, axes, fingerprint, where, row.get("table"), row.get("row"))
        return (*key, *search.key) if search else key


def label_of(name: str, axes: Mapping[str, Any], defaults: Mapping[str, Any]) -> str:
    """A strategy and its axes that are not at their defaults, the problem's own left out."""
    differing = [f"{k}={format_axis(v)}" for k, v in axes.items() if defaults.get(k) != v and k not in PROBLEM_AXES]
    return " ".join([name, *differing])


def format_axis(value: Any) -> str:
    """(8, 4, 4) -> ``8x4x4``, anything else as it is."""
    return "x".join(map(str, value)) if isinstance(value, tuple) else str(value)


def cases_of(
    variants: Iterable[Variant], datasets: Sequence[DatasetChoice], axes: Mapping[str, Sequence[Any]]
) -> list[Case]:
    """The product of variants, datasets and the axis values asked for, dataset by dataset.

    A variant ignores an axis that it does not have; an axis that none of them has is an InputError.
    """
    variants = list(variants)
    unknown = [name for name in axes if not any(name in resolve_axes(v, {}) for v in variants)]
    if unknown:
        known = sorted({name for v in variants for name in resolve_axes(v, {})})
        raise InputError(f"unknown axis {unknown[0]!r}: valid are {', '.join(known)}")
    cases = []
    for dataset, variant in itertools.product(datasets, variants):
        names = [name for name in axes if name in resolve_axes(variant, {})]
        for values in itertools.product(*(axes[name] for name in names)):
            cases.append(Case(variant, dataset, resolve_axes(variant, dict(zip(names, values, strict=True)))))
    return cases


def refuse_bad_input(cases: Iterable[Any]) -> None:
    """Load every dataset and hold its particles to the splines and number types of its cases; the first problem is an
    InputError. To be called before any file is touched and before an hour of work."""
    uses: dict[DatasetChoice, dict[tuple[str, str], None]] = {}
    for case in cases:
        if hasattr(case, "dataset"):  # primitives have none
            uses.setdefault(case.dataset, {})[case.axes["spline"], case.axes["dtype"]] = None
    for choice, kinds in uses.items():
        dataset = choice.load()
        for spline, dtype in kinds:
            dataset.check_support(spline, dtype)


@dataclass
class Inputs:
    """A dataset and its references. Only those of one dataset are kept: at full size a reference takes some 100 MB."""

    choice: DatasetChoice | None = None
    dataset: Dataset | None = None
    references: dict[tuple[Any, ...], Any] = field(default_factory=dict)

    def select(self, choice: DatasetChoice) -> Dataset:
        if choice != self.choice or self.dataset is None:
            self.references.clear()
            self.choice, self.dataset = choice, choice.load()
        return self.dataset

    def nodes(self, axes: Mapping[str, Any]) -> ReferenceNodes:
        """The reference P2G for these axes."""
        return self._cached("p2g", axes, lambda dataset, *how: p2g(dataset, *how))

    def rounded_nodes(self, axes: Mapping[str, Any]) -> Nodes:
        """What every G2P starts from: the reference P2G as the kernels' number type holds it."""
        nodes, real = self.nodes(axes).nodes, np.dtype(axes["dtype"])
        return Nodes(nodes.mass.astype(real), nodes.momentum.astype(real))

    def particles(self, axes: Mapping[str, Any]) -> ReferenceParticles:
        """The reference G2P for these axes, from ``rounded_nodes``."""
        return self._cached(
            "g2p", axes, lambda dataset, *how: g2p(dataset, grid_divide(self.rounded_nodes(axes)), *how)
        )

    def _cached(self, transfer: str, axes: Mapping[str, Any], make: Callable[..., Any]) -> Any:
        assert self.dataset is not None
        how = (axes["spline"], axes["payload"], axes["dtype"])
        if (transfer, *how) not in self.references:
            self.references[transfer, *how] = make(self.dataset, *how)
        return self.references[transfer, *how]


# (reports of the steps before, of the transfer, of the steps after) -> what a record says of named GPUs.
Model = Callable[[Mapping[str, LaunchReport], LaunchReport, Mapping[str, LaunchReport]], Mapping[str, Profile]]


def run_case(
    case: Case, device: Device, inputs: Inputs, environment: Environment, model: Model | None = None
) -> Record:
    """Run, check and count one case. Errors of the case become its record's reason, not an exception.

    model: asked for modelled times once the result is known to be right; for a device in mode profile.
    """
    about = about_case(case, device, inputs, environment)
    if reason := why_not_here(case, device, inputs, about):
        return Record(**about, skipped_because=reason)
    begin = time.perf_counter()
    try:
        plan, reports, check = _checked(case, device, inputs, about)
    except InputError as error:
        return Record(**about, failed_because=str(error), host_seconds=time.perf_counter() - begin)
    preprocess, transfer, finish = reports
    # A wrong row keeps no figures: its counts are those of another computation.
    counters = transfer.counters if check.passed else None
    about |= kernel_facts(device, plan.transfer.launches, counters)
    if counters is not None:
        about["preprocess"] = {name: StepCost(counters=report.counters) for name, report in preprocess.items()}
        about["finish"] = {name: StepCost(counters=report.counters) for name, report in finish.items()}
        if model is not None:
            about["modelled"] = model(preprocess, transfer, finish)
    return Record(**about, host_seconds=time.perf_counter() - begin)


def prepare_case(
    case: Case, device: Device, inputs: Inputs, environment: Environment, cache: str = "cold"
) -> Record | Contender:
    """Build, run and check one case so that it can be timed; a Record where it has come to an end before.

    cache: state of the caches before each sample, see ``Measurement.mode``; "step" brings the rest of the step along.
    """
    about = about_case(case, device, inputs, environment)
    if reason := why_not_here(case, device, inputs, about):
        return Record(**about, skipped_because=reason)
    begin = time.perf_counter()
    try:
        plan, _, check = _checked(case, device, inputs, about)
        about |= kernel_facts(device, plan.transfer.launches, None)
        if not check.passed:
            return Record(**about, host_seconds=time.perf_counter() - begin)
        rest = planning.rest_of_step(plan, device) if cache == "step" else None
        if rest:
            planning.run_steps(device, rest.before)  # compiles and loads
    except InputError as error:
        return Record(**about, failed_because=str(error), host_seconds=time.perf_counter() - begin)
    return Contender(
        label=case.label,
        about=about,
        steps=plan.steps,
        transfer=plan.transfer,
        finish=plan.finish,
        reset=plan.reset(),
        outputs=plan.outputs,
        rest=rest,
        begin=begin,
    )


def about_case(case: Case, device: Device, inputs: Inputs, environment: Environment) -> dict[str, Any]:
    """What a record says before anything has run."""
    variant, axes = case.variant, case.axes
    dataset = inputs.select(case.dataset)
    about: dict[str, Any] = {
        "variant": variant.name,
        "variant_summary": variant.summary,
        "transfer": variant.transfer,
        "dataset": DatasetSummary.of(dataset),
        "axes": dict(axes),
        "default_axes": resolve_axes(variant, {}),
        "device": device.name,
        "arch": device.arch,
        "environment": replace(environment, gpu=getattr(device, "facts", {})),
        "preset_row": case.preset_row,
        "tuning": case.tuning,
        "floor_bytes": planning.floor_bytes(variant, dataset, axes),
    }
    if why_impossible(variant, axes) is None:
        about["device_bytes_predicted"] = planning.predict_bytes(variant, dataset, axes)
    return about


def why_not_here(case: Case, device: Device, inputs: Inputs, about: dict[str, Any]) -> str | None:
    """Why a case cannot exist, or does not fit."""
    if reason := why_impossible(case.variant, case.axes):
        return reason
    need, free = about["device_bytes_predicted"], free_bytes(device)
    if need > free:
        return f"needs {need / 2**30:.2f} GiB, {device.name} has {free / 2**30:.2f} free"
    here, check_needs = machine_bytes(), CHECK_BYTES_PER_NODE * inputs.select(case.dataset).grid.node_count
    if not hasattr(device, "free_bytes"):
        check_needs += need
    if check_needs > here:
        return f"run and check need {check_needs / 2**30:.2f} GiB of memory, {here / 2**30:.2f} are free"
    return None


def _checked(case: Case, device: Device, inputs: Inputs, about: dict[str, Any]) -> tuple[planning.Plan, Any, Any]:
    """Plan, reports of one run of it, and the verdict on its result; what was found goes into ``about``."""
    variant, axes, dataset = case.variant, case.axes, inputs.select(case.dataset)
    dataset.check_support(axes["spline"], np.dtype(axes["dtype"]))
    nodes = inputs.rounded_nodes(axes) if variant.transfer == "g2p" else None
    try:
        plan = planning.build_plan(variant, dataset, device, axes, nodes=nodes)
        preprocess, transfer, finish = reports = plan.run_once(device)
    except InputError:
        raise
    except Exception as error:  # a bug in a module that may be a user's costs its row, not the run
        line = next((f for f in reversed(extract_tb(error.__traceback__)) if f.filename == str(variant.path)), None)
        if line is None:
            raise
        raise InputError(f"{line.filename}:{line.lineno}: {type(error).__name__}: {error}") from error
    check = check_outputs(plan.outputs(), variant.transfer, inputs, axes)
    findings = [f for report in (*preprocess.values(), transfer, *finish.values()) for f in report.findings]
    about |= {"check": Check.of(check), "findings": tuple(findings)}
    return plan, reports, check


def kernel_facts(device: Device, launches: Sequence[Launch], counters: Counters | None) -> dict[str, Any]:
    """What a record says of the kernels that ran, and what was counted in them with the text of those lines."""
    kernels = {launch.kernel.entry: launch.kernel for launch in launches}
    facts: dict[str, Any] = {
        "hashes": {entry: kernel.source.sha256 for entry, kernel in kernels.items()},
        "kernel_info": {entry: asdict(device.info(kernel)) for entry, kernel in kernels.items()},
    }
    if counters is not None:
        text = "\n".join(kernel.source.text for kernel in kernels.values())
        facts |= {"transfer_counters": counters, "line_texts": line_texts(text, counters.lines)}
    return facts


def check_outputs(outputs: Any, transfer: str, inputs: Inputs, axes: Mapping[str, Any]) -> CheckResult:
    """Hold a plan's outputs to the float64 reference."""
    if transfer == "p2g":
        return check_p2g(outputs, inputs.nodes(axes))
    return check_g2p(outputs, inputs.particles(axes))


def free_bytes(device: Device) -> int:
    """Memory that a case may take [bytes]: the GPU's free memory, or the machine's for the simulated device."""
    if hasattr(device, "free_bytes"):
        return int(device.free_bytes)
    return machine_bytes()


def resume_key(record: Record) -> tuple[Any, ...]:
    """What makes two rows the same row: a finished Record and the case that would repeat it have equal keys."""
    return _key(record)


def tuned_key(record: Record) -> tuple[Any, ...]:
    """What makes two rows the same where axes were searched for: which ones and how, and not what came of it. Without a
    search, ``resume_key``."""
    tuning = record.tuning
    if tuning is None:
        return resume_key(record)
    return (*_key(record, tuning.searched), tuning.searched, tuning.budget, tuning.possible)


def _key(record: Record, searched: Collection[str] = ()) -> tuple[Any, ...]:
    row, where = record.preset_row or {}, (record.device, record.arch)
    axes = _axis_key(record.axes, searched)
    return (record.variant, axes, record.dataset.fingerprint, where, row.get("table"), row.get("row"))


def _axis_key(axes: Mapping[str, Any], searched: Collection[str] = ()) -> tuple[tuple[str, str], ...]:
    return tuple(sorted((key, format_axis(value)) for key, value in axes.items() if key not in searched))
