"""Run kernels in the engine's debug mode, under several schedules, and gather what it finds.

Shipped strategies run with all their preprocessing; a user's own kernel runs as its launch file says. What is checked,
by which rules, is told in docs/sanitizer.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mpmbench.device import CompiledKernel, Launch, LaunchReport
from mpmbench.device.simulated import SimulatedDevice
from mpmbench.environment import Environment
from mpmbench.errors import InputError, MpmbenchError
from mpmbench.kernel import load_source
from mpmbench.launch_file import ArraySpec, LaunchFile, LaunchSpec
from mpmbench.runner import Inputs
from mpmbench.simt.counters import ERROR, INFO, WARNING, Finding

SEEDS = 3  # schedules that are tried
BUDGET = 10**8  # warp instructions that the loops of one launch may repeat: well under a minute where it spins
ROUNDINGS = 1024  # units in the last place, of an array's largest value, by which orders of float atomics may differ


@dataclass
class Sanitized:
    """What was run and found. findings: by kernel, kind and line, the first schedule's first; counts are its counts."""

    runs: list[str] = field(default_factory=list)  # what ran, one line each
    seeds: int = SEEDS
    arch: str = ""
    findings: list[Finding] = field(default_factory=list)

    def count(self, severity: str) -> int:
        return sum(finding.severity == severity for finding in self.findings)

    @property
    def clean(self) -> bool:
        return not self.count(ERROR) and not self.count(WARNING)

    def add(self, findings: Iterable[Finding]) -> None:
        known = {_key(finding) for finding in self.findings}
        for finding in findings:
            if _key(finding) not in known:
                self.findings.append(finding)
                known.add(_key(finding))

    def text(self) -> str:
        """One line per finding, the gravest first, and a line that sums up."""
        order = (ERROR, WARNING, INFO)
        lines = [
            f"{finding.severity:8}{finding.message}" + (f" [{finding.count} times]" if finding.count > 1 else "")
            for finding in sorted(self.findings, key=lambda f: order.index(f.severity))
        ]
        counts = ", ".join(
            f"{self.count(severity)} {word}"
            for severity, word in zip(order, ("errors", "warnings", "notes"), strict=True)
        )
        return "\n".join([*lines, f"{len(self.runs)} runs under {self.seeds} schedules for {self.arch}: {counts}"])

    def to_json(self) -> dict[str, Any]:
        return {
            "runs": self.runs,
            "arch": self.arch,
            "seeds": self.seeds,
            "errors": self.count(ERROR),
            "warnings": self.count(WARNING),
            "notes": self.count(INFO),
            "findings": [asdict(finding) | _places(finding) for finding in self.findings],
        }


def _places(finding: Finding) -> dict[str, Any]:
    """Lines as JSON shows them best."""
    return {
        name: None if line is None else {"file": line.file, "line": line.line}
        for name, line in (("line", finding.line), ("other_line", finding.other_line))
    }


def _key(finding: Finding) -> tuple[Any, ...]:
    return finding.kernel, finding.kind, finding.severity, frozenset((finding.line, finding.other_line))


class _Watched(SimulatedDevice):
    """A device in debug mode that keeps what its launches report."""

    def __init__(self, arch: str, seed: int, budget: int) -> None:
        super().__init__(arch, "debug", seed, fuzz=seed > 0, budget=budget)
        self.seen: list[Finding] = []

    def launch(self, launch: Launch) -> LaunchReport:
        report = super().launch(launch)
        self.seen += [*report.findings, *report.notes]
        return report


# --- shipped strategies -----------------------------------------------------------------------------------------------


def sanitize_cases(
    cases: Sequence[Any],
    arch: str,
    seeds: int = SEEDS,
    budget: int = 100 * BUDGET,
    tick: Callable[[str], None] = lambda title: None,
) -> Sanitized:
    """Run cases (``runner.Case`` or ``primitive_runs.PrimitiveCase``) in debug mode, each under several schedules.

    A result that misses the reference under some schedules only depends on the schedule: a finding, as is one that
    always misses. A case that cannot exist is passed over; one that breaks is an MpmbenchError.
    """
    result, environment, inputs = Sanitized(seeds=seeds, arch=arch), Environment.capture(), Inputs()
    for case in cases:
        tick(case.title)
        passed = []
        for seed in range(seeds):
            device = _Watched(arch, seed, budget)
            record = case.run(device, inputs, environment)
            result.add(device.seen)
            if record.failed_because:
                raise MpmbenchError(f"{case.title}: {record.failed_because}")
            if record.skipped_because:
                break
            passed.append(record.check.passed)
        else:
            result.runs.append(case.title)
            if not all(passed):
                kind = "schedule" if any(passed) else "wrong-result"
                message = f"{case.name}: {sum(passed)} of {seeds} schedules agree with the reference ({case.title})"
                severity = WARNING if any(passed) else ERROR
                result.add([Finding(kind, case.name, message, severity=severity)])
    return result


# --- a user's own kernel ----------------------------------------------------------------------------------------------


def sanitize_file(
    path: Path, launches: LaunchFile, arch: str, seeds: int = SEEDS, budget: int | None = None
) -> Sanitized:
    """Run a ``.cu`` file as a launch file says. Raises InputError for what does not compile, fit or exist."""
    arch = launches.arch or arch
    limit = budget or launches.budget or BUDGET
    result = Sanitized(seeds=seeds, arch=arch)
    source = load_source(_existing(path), launches.defines, launches.include)
    first: list[dict[str, np.ndarray]] = []
    for seed in range(seeds):
        device = _Watched(arch, seed, limit)
        arrays = {name: _allocate(device, spec) for name, spec in launches.arrays.items()}
        kernels = [device.compile(source, launch.kernel) for launch in launches.launches]
        snapshots: list[dict[str, np.ndarray]] = []
        for launch, kernel in zip(launches.launches, kernels, strict=True):
            _refuse_endless(launch, limit)
            report = device.launch(_ready(launch, kernel, arrays))
            if any(_stops(finding) for finding in report.findings):
                break
            if seeds > 1:
                snapshots.append({name: arrays[name].copy() for name in launch.args if isinstance(name, str)})
        result.add(device.seen)
        if len(snapshots) < len(kernels) and seeds > 1:
            break  # a launch that was stopped will be stopped again, and its results mean nothing
        if seed == 0:
            first = snapshots
            result.runs += [f"{path.name} {launch.kernel}" for launch in launches.launches]
        else:
            result.add(_differences(launches, kernels, first, snapshots, seed))
    return result


def _stops(finding: Finding) -> bool:
    return finding.message.endswith("launch stopped")


def _existing(path: Path) -> Path:
    if path.suffix != ".cu":
        raise InputError(f"{path} is no CUDA source: its name must end in .cu")
    if not path.is_file():
        raise InputError(f"cannot read kernel source {path}: no such file")
    return path


def _allocate(device: SimulatedDevice, spec: ArraySpec) -> np.ndarray:
    values = spec.values()
    return device.empty(spec.shape, spec.dtype) if values is None else device.upload(values)


def _refuse_endless(launch: LaunchSpec, budget: int) -> None:
    """Thread blocks cost something even where nothing loops."""
    warps = int(np.prod(launch.grid, dtype=object)) * -(-int(np.prod(launch.block)) // 32)
    if warps > budget // 50:
        raise InputError(f"{launch.kernel}: {warps} warps are more than the budget of {budget} instructions allows for")


def _ready(launch: LaunchSpec, kernel: CompiledKernel, arrays: dict[str, np.ndarray]) -> Launch:
    args = tuple(arrays[arg] if isinstance(arg, str) else arg for arg in launch.args)
    names = tuple(arg if isinstance(arg, str) else "" for arg in launch.args)
    return Launch(launch.kernel, kernel, launch.grid, launch.block, args, launch.shared, names)


def _differences(
    launches: LaunchFile,
    kernels: Sequence[CompiledKernel],
    first: Sequence[dict[str, np.ndarray]],
    now: Sequence[dict[str, np.ndarray]],
    seed: int,
) -> list[Finding]:
    """Arrays that hold something else than under the first schedule, each with the first launch after which it does."""
    rounds, found = False, {}
    for launch, kernel, before, after in zip(launches.launches, kernels, first, now, strict=True):
        rounds |= _adds_floats(kernel)
        for name, was in before.items():
            if name in found:
                continue
            differs = _differing(was, after[name], launches.arrays[name], rounds)
            if len(differs):
                at = tuple(int(index) for index in np.unravel_index(differs[0], was.shape))
                place = f"{name}[{', '.join(map(str, at))}]"
                message = (
                    f"{launch.kernel}: the result depends on the schedule: {len(differs)} of {was.size} elements of "
                    f"{name} differ between schedules 0 and {seed}, first {place}: {was[at]} and {after[name][at]}"
                )
                found[name] = Finding(
                    "schedule", launch.kernel, message, None, None, len(differs), WARNING, place=place
                )
    return list(found.values())


def _adds_floats(kernel: CompiledKernel) -> bool:
    """Whether a kernel adds floats atomically, in an order that the schedule decides."""
    opcodes = (opcode.split(".") for opcode in kernel.handle.facts.opcodes)
    return any(parts[0] in ("atom", "red") and "add" in parts and parts[-1] in ("f32", "f64") for parts in opcodes)


def _differing(was: np.ndarray, now: np.ndarray, spec: ArraySpec, rounds: bool) -> np.ndarray:
    """Flat indices at which two results differ, bitwise or by more than roundings explain."""
    if spec.compare == "none":
        return np.empty(0, int)
    width = f"u{was.dtype.itemsize}"
    different = (was.view(width) != now.view(width)).ravel()
    if rounds and spec.compare == "auto" and was.dtype.kind == "f" and different.any():
        a, b = was.ravel().astype(np.float64), now.ravel().astype(np.float64)
        both = np.isfinite(a) & np.isfinite(b)
        largest = max(np.abs(a[both]).max(initial=0), np.abs(b[both]).max(initial=0))
        allowed = ROUNDINGS * np.finfo(was.dtype).eps * largest
        different &= ~(both & (np.abs(a - b) <= allowed))
    return np.flatnonzero(different)
