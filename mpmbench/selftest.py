"""Does this device run every strategy right? Small datasets, each result held to the float64 reference.

On a GPU each result is also compared with the simulated device's, and the transfer is timed. Continuous integration
runs the same function on the simulated device, in its debug mode, where a finding fails as much as a wrong result.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mpmbench.check import CheckResult, allowance
from mpmbench.dataset import Dataset, load_dataset
from mpmbench.device import Device, LaunchReport, open_device
from mpmbench.errors import MpmbenchError
from mpmbench.measure import QUICK, measure_steps
from mpmbench.plan import build_plan
from mpmbench.reference import Nodes, ParticleValues, Reference
from mpmbench.runner import Inputs, check_outputs, format_axis
from mpmbench.variants import Variant, discover, resolve_axes, why_impossible

# Recipe -> what it is made with: one of each kind of trouble, small enough for any device; the quick ones first.
DATASETS: dict[str, dict[str, Any]] = {
    "random": {"particles": 1500, "grid_shape": (17, 16, 15)},
    "one_cell": {"particles": 150, "grid_shape": (12, 12, 12)},
    "lattice": {"particles": 1000, "grid_shape": (16, 16, 16)},
    "uniform_cube": {"particles": 3001, "grid_shape": (24, 24, 24)},
    "clustered": {"particles": 4000, "grid_shape": (32, 32, 32)},
    "splash": {},
}
QUICK_DATASETS = 3

# Where the kernels have been executed on hardware: (GPU, arch, version, date) of a `mpmbench selftest` that passed.
HARDWARE_RUNS: tuple[tuple[str, str, str, str], ...] = ()
COMPILED_FOR_ALL_PAIRS = ("sm_52", "sm_90")
COMPILED_FOR_DEFAULT_AXES = ("sm_70", "sm_75", "sm_80", "sm_86", "sm_89", "sm_100", "sm_120")


@dataclass(frozen=True)
class SelftestRow:
    """One strategy on one dataset.

    axes: those that differ from the defaults.  problem: why it failed, "" where it passed.  error: worst error in
    units of the allowance.  difference: largest difference from the simulated device in the same units, None on the
    simulated device itself.  seconds: median time of the transfer, None where it was not timed.
    """

    variant: str
    dataset: str
    device: str
    axes: Mapping[str, Any] = field(default_factory=dict)
    problem: str = ""
    error: float | None = None
    difference: float | None = None
    seconds: float | None = None

    @property
    def passed(self) -> bool:
        return not self.problem

    def __str__(self) -> str:
        what = " ".join([self.variant, self.dataset, *(f"{name}={format_axis(v)}" for name, v in self.axes.items())])
        if self.problem:
            return f"FAILED {what}: {self.problem}"
        facts = [f"error {self.error:.2f} of the allowance"]
        if self.difference is not None:
            facts.append(f"{self.difference:.2f} of it from the simulated device")
        if self.seconds is not None:
            facts.append(f"{self.seconds * 1e6:.1f} us")
        return f"ok     {what}: {', '.join(facts)}"


def run_selftest(device_name: str, quick: bool = False, arch: str | None = None) -> list[SelftestRow]:
    """Run every strategy on a device and judge each result.

    quick: default axes and the smallest datasets; otherwise every value of every axis as well, one at a time.
    arch: what the simulated device compiles for. Raises InputError where the device cannot be opened.
    """
    options = {"arch": arch} if arch else {}
    if device_name == "simulated":
        options["mode"] = "debug"
    device = open_device(device_name, **options)
    twin = None if device.name == "simulated" else open_device("simulated", arch=device.arch, mode="run")
    rows = []
    for name in list(DATASETS)[: QUICK_DATASETS if quick else None]:
        dataset = load_dataset(name, **DATASETS[name])
        inputs = Inputs(dataset=dataset)
        for variant in discover():
            for changed in [{}] if quick else axis_changes(variant):
                rows.append(_run(variant, changed, dataset, inputs, device, twin))
    return rows


def axis_changes(variant: Variant) -> Iterator[dict[str, Any]]:
    """The default axes, then each other value of each axis by itself, as far as it can exist."""
    yield {}
    for name, values in variant.axes.items():
        for value in values[1:]:
            if why_impossible(variant, resolve_axes(variant, {name: value})) is None:
                yield {name: value}


def hardware_table() -> str:
    """Markdown: what each strategy has been compiled for, and where it has been executed on hardware."""
    lines = [
        "| strategy | compiled for, every pair of axis values | compiled for, default axes | executed on hardware |",
        "|---|---|---|---|",
    ]
    runs = "; ".join(f"{gpu} ({arch}), mpmbench {version}, {date}" for gpu, arch, version, date in HARDWARE_RUNS)
    for variant in discover():
        lines.append(
            f"| `{variant.name}` | {', '.join(COMPILED_FOR_ALL_PAIRS)} | {', '.join(COMPILED_FOR_DEFAULT_AXES)} "
            f"| {runs or 'never'} |"
        )
    return "\n".join(lines)


def _run(
    variant: Variant, changed: dict[str, Any], dataset: Dataset, inputs: Inputs, device: Device, twin: Device | None
) -> SelftestRow:
    """One row; whatever goes wrong becomes its problem."""
    about = {"variant": variant.name, "dataset": dataset.name, "device": device.name, "axes": changed}
    axes = resolve_axes(variant, changed)
    try:
        check, outputs, plan, problems = _judged(variant, axes, dataset, inputs, device)
        difference = seconds = None
        if twin is not None:
            _, twin_outputs, _, twin_problems = _judged(variant, axes, dataset, inputs, twin)
            problems += [f"simulated: {problem}" for problem in twin_problems]
            reference = inputs.nodes(axes) if variant.transfer == "p2g" else inputs.particles(axes)
            difference = largest_difference(outputs, twin_outputs, reference)
            if difference > 1:
                problems.append(f"differs from the simulated device by {difference:.3g} times the allowance")
            if not problems:
                steps = [plan.transfer, *plan.finish]
                times = measure_steps(device, steps, before=plan.reset(), sampling=QUICK)  # type: ignore[arg-type]
                seconds = times["transfer"].median
                again = check_outputs(plan.outputs(), variant.transfer, inputs, axes)
                if not again.passed:
                    problems.append(f"wrong once it has run many times: {again}")
    except MpmbenchError as error:
        return SelftestRow(**about, problem=str(error))  # type: ignore[arg-type]
    if problems:
        seconds = None
    return SelftestRow(**about, problem="; ".join(problems), error=check.ratio, difference=difference, seconds=seconds)  # type: ignore[arg-type]


def _judged(
    variant: Variant, axes: Mapping[str, Any], dataset: Dataset, inputs: Inputs, device: Device
) -> tuple[CheckResult, Nodes | ParticleValues, Any, list[str]]:
    """Check, outputs, plan and problems of one run."""
    nodes = inputs.rounded_nodes(axes) if variant.transfer == "g2p" else None
    plan = build_plan(variant, dataset, device, axes, nodes=nodes)
    before, transfer, after = plan.run_once(device)
    outputs = plan.outputs()
    check = check_outputs(outputs, variant.transfer, inputs, axes)
    problems = [] if check.passed else [str(check)]
    reports: list[LaunchReport] = [*before.values(), transfer, *after.values()]
    problems += [f"{f.kind}: {f.message}" for report in reports for f in report.findings]
    return check, outputs, plan, problems


def largest_difference(a: Nodes | ParticleValues, b: Nodes | ParticleValues, reference: Reference) -> float:
    """Largest difference of two results, in units of what a correct kernel may be away from the reference."""
    allowed = allowance(reference)
    if allowed.size == 0:
        return 0.0
    first, second = _components_first(a), _components_first(b)
    off = np.abs(first - second)
    off[~(np.isfinite(first) & np.isfinite(second))] = np.inf
    ratio = np.divide(off, allowed, out=np.where(off > 0, np.inf, 0.0), where=allowed > 0)
    return float(ratio.max())


def _components_first(values: Nodes | ParticleValues) -> np.ndarray:
    """In the shape of ``Reference.value``."""
    if isinstance(values, Nodes):
        parts = [np.asarray(values.mass)[None], np.moveaxis(np.asarray(values.momentum), -1, 0)]
    else:
        parts = [np.asarray(values.velocity).T]
        if values.affine is not None:
            parts.append(np.asarray(values.affine).reshape(len(values.affine), 9).T)
    return np.concatenate(parts).astype(np.float64)
