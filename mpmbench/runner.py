"""One case through the whole flow: dataset -> preprocessing -> transfer -> check -> count or measure -> Record.

Cases come from a preset or from the command line's choice of variants, datasets and axes; each becomes one Record,
whatever happens to it: run, skipped with a reason, or broken with a reason.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from mpmbench import plan as planning
from mpmbench.check import CheckResult, check_g2p, check_p2g
from mpmbench.dataset import Dataset, load_dataset
from mpmbench.device import Device, Launch, LaunchReport
from mpmbench.environment import Environment, machine_bytes
from mpmbench.errors import InputError
from mpmbench.measure import Sampling, measure_plan
from mpmbench.profile_record import Profile
from mpmbench.record import Check, DatasetSummary, Record, StepCost, line_texts
from mpmbench.reference import Nodes, ReferenceNodes, ReferenceParticles, g2p, grid_divide, p2g
from mpmbench.simt.counters import Counters
from mpmbench.variants import Variant, resolve_axes, why_impossible

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
    """One strategy on one dataset with one choice of axes. ``preset_row``: the published row it repeats, if any."""

    variant: Variant
    dataset: DatasetChoice
    axes: Mapping[str, Any]
    preset_row: Mapping[str, Any] | None = None

    @property
    def name(self) -> str:
        return self.variant.name

    def shrunk(self, particles: int | None = None, size: int | None = None) -> Case:
        """This case with so many particles, where its dataset has a choice: no repetition of a published row."""
        if particles is None or self.dataset.particles is None:
            return self
        return replace(self, dataset=replace(self.dataset, particles=particles), preset_row=None)

    @property
    def title(self) -> str:
        """For progress lines: the variant and what differs from its defaults."""
        defaults = resolve_axes(self.variant, {})
        differing = [f"{k}={format_axis(v)}" for k, v in self.axes.items() if defaults.get(k) != v]
        return " ".join([self.variant.name, self.dataset.name, *differing])


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


def refuse_bad_input(cases: Iterable[Case]) -> None:
    """Load every dataset and hold its particles to the splines and number types of its cases; the first problem is an
    InputError. To be called before any file is touched and before an hour of work."""
    uses: dict[DatasetChoice, dict[tuple[str, str], None]] = {}
    for case in cases:
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
    case: Case,
    device: Device,
    inputs: Inputs,
    environment: Environment,
    sampling: Sampling | None = None,
    model: Model | None = None,
) -> Record:
    """Run, check, and count or measure one case. Errors of the case become its record's reason, not an exception.

    model: asked for modelled times once the result is known to be right; for a device in mode profile.
    """
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
        "floor_bytes": planning.floor_bytes(variant, dataset, axes),
    }
    if reason := why_impossible(variant, axes):
        return Record(**about, skipped_because=reason)
    about["device_bytes_predicted"] = planning.predict_bytes(variant, dataset, axes)
    free = free_bytes(device)
    if about["device_bytes_predicted"] > free:
        need = about["device_bytes_predicted"]
        return Record(
            **about, skipped_because=f"needs {need / 2**30:.2f} GiB, {device.name} has {free / 2**30:.2f} free"
        )
    here, check_needs = machine_bytes(), CHECK_BYTES_PER_NODE * dataset.grid.node_count
    if device.name == "simulated":
        check_needs += about["device_bytes_predicted"]
    if check_needs > here:
        return Record(
            **about,
            skipped_because=f"run and check need {check_needs / 2**30:.2f} GiB of memory, {here / 2**30:.2f} are free",
        )
    begin = time.perf_counter()
    try:
        return _run(case, device, inputs, about, sampling, begin, model)
    except InputError as error:
        return Record(**about, failed_because=str(error), host_seconds=time.perf_counter() - begin)


def _run(
    case: Case,
    device: Device,
    inputs: Inputs,
    about: dict[str, Any],
    sampling: Sampling | None,
    begin: float,
    model: Model | None,
) -> Record:
    variant, axes, dataset = case.variant, case.axes, inputs.dataset
    assert dataset is not None
    dataset.check_support(axes["spline"], np.dtype(axes["dtype"]))
    nodes = inputs.rounded_nodes(axes) if variant.transfer == "g2p" else None
    plan = planning.build_plan(variant, dataset, device, axes, nodes=nodes)
    preprocess, transfer, finish = plan.run_once(device)
    check = check_outputs(plan.outputs(), variant.transfer, inputs, axes)
    # A wrong row keeps no figures: its counts are those of another computation.
    counters = transfer.counters if check.passed else None
    about |= kernel_facts(device, plan.transfer.launches, counters)
    findings = [f for report in (*preprocess.values(), transfer, *finish.values()) for f in report.findings]
    about |= {"check": Check.of(check), "findings": tuple(findings)}
    if device.name == "simulated":
        if counters is not None:
            about["preprocess"] = {name: StepCost(counters=report.counters) for name, report in preprocess.items()}
            about["finish"] = {name: StepCost(counters=report.counters) for name, report in finish.items()}
            if model is not None:
                about["modelled"] = model(preprocess, transfer, finish)
    elif check.passed:
        times = measure_plan(device, plan, check, sampling)  # type: ignore[arg-type]
        about["transfer_measurement"] = times.transfer
        about["preprocess"] = {name: StepCost(measurement=m) for name, m in times.preprocess.items()}
        about["finish"] = {name: StepCost(measurement=m) for name, m in times.finish.items()}
    return Record(**about, host_seconds=time.perf_counter() - begin)


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


def resume_key(run: Record | Case, device: Device | None = None, inputs: Inputs | None = None) -> tuple[Any, ...]:
    """What makes two rows the same row: a finished Record and the Case that would repeat it have equal keys."""
    if isinstance(run, Record):
        name, fingerprint, where = run.variant, run.dataset.fingerprint, (run.device, run.arch)
    else:
        assert device is not None
        assert inputs is not None
        name, fingerprint = run.variant.name, inputs.select(run.dataset).fingerprint
        where = (device.name, device.arch)
    axes = tuple(sorted((key, format_axis(value)) for key, value in run.axes.items()))
    row = run.preset_row or {}
    return (name, axes, fingerprint, where, row.get("table"), row.get("row"))
