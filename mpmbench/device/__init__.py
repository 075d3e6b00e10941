"""The device protocol: one kernel text, and the places to run it.

``cuda`` (``cuda:1`` is the second GPU) gives results and event times; ``simulated`` runs the same PTX on the CPU
and gives results, counters and findings, but never a time of its own. ``cpu`` runs it there by wall clock, for tables
of their own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from mpmbench.errors import InputError
from mpmbench.kernel import KernelSource
from mpmbench.simt.counters import Counters, Finding
from mpmbench.simt.machine import MemoryCounters


@dataclass(frozen=True)
class KernelInfo:
    """Static facts of a compiled kernel, from ``ptxas`` (None where it was not asked)."""

    arch: str
    registers: int | None = None  # per thread
    shared_bytes: int | None = None  # static, per thread block
    local_bytes: int | None = None  # stack per thread
    spill_bytes: int | None = None  # spill stores + spill loads per thread
    sass_instructions: int | None = None  # machine instructions in the code, each counted once


@dataclass(frozen=True)
class CompiledKernel:
    """A kernel that a device can launch. ``handle`` is the device's own business."""

    source: KernelSource
    entry: str
    handle: Any = field(repr=False, compare=False)


@dataclass(frozen=True)
class Launch:
    """One kernel launch, ready to go and repeatable.

    args: device arrays, NumPy scalars (np.int32, np.float64, ...) or structured NumPy scalars passed by value.
    shared_bytes: dynamic shared memory per thread block.
    names: of the arguments, for messages; empty: those that the kernel's text gives them.
    """

    name: str
    kernel: CompiledKernel
    grid: tuple[int, int, int]
    block: tuple[int, int, int]
    args: tuple[Any, ...] = field(repr=False, compare=False)
    shared_bytes: int = 0
    names: tuple[str, ...] = ()


@dataclass(frozen=True)
class LaunchProfile:
    """One launch on a modelled machine: all that a performance model needs.

    blocks, threads: thread blocks of the launch, threads of each.  shared_bytes: static and dynamic, per thread block.
    opcodes: executions by a warp of each PTX opcode with each integer literal (None: without).
    """

    entry: str
    blocks: int
    threads: int
    shared_bytes: int
    info: KernelInfo
    counters: Counters
    memory: MemoryCounters
    opcodes: Mapping[tuple[str, int | None], int] = field(repr=False)


@dataclass(frozen=True)
class LaunchReport:
    """What a launch tells besides its outputs; on ``cuda`` all are empty.

    notes: findings that are no defects.  profiles: one per launch in mode profile.
    """

    counters: Counters | None = None
    findings: tuple[Finding, ...] = ()
    notes: tuple[Finding, ...] = ()
    profiles: tuple[LaunchProfile, ...] = ()


class Device(Protocol):
    name: str  # "simulated", "cuda:0"
    arch: str  # "sm_52", what kernels are compiled for

    def upload(self, host: np.ndarray) -> Any:
        """Copy to the device: a device array aligned to at least 256 bytes."""

    def empty(self, shape: int | tuple[int, ...], dtype: Any) -> Any:
        """Uninitialised device array. The simulated device fills it with a poison pattern in debug mode."""

    def download(self, array: Any) -> np.ndarray:
        """Copy to the host, after every launch so far has finished."""

    def compile(self, source: KernelSource, entry: str) -> CompiledKernel:
        """Compile (or fetch from the cache) the kernel function ``entry`` of ``source``."""

    def info(self, kernel: CompiledKernel) -> KernelInfo:
        """Registers, shared memory and spills of a compiled kernel."""

    def launch(self, launch: Launch) -> LaunchReport:
        """Run one kernel. Returns at once on ``cuda``, when done on ``simulated``."""

    def synchronize(self) -> None:
        """Wait for every launch so far."""


def run_all(device: Device, launches: Sequence[Launch]) -> LaunchReport:
    """Run launches in order and add up what they report."""
    counters: Counters | None = None
    findings: list[Finding] = []
    profiles: list[LaunchProfile] = []
    notes: list[Finding] = []
    for launch in launches:
        report = device.launch(launch)
        profiles.extend(report.profiles)
        if report.counters is not None:
            counters = report.counters if counters is None else counters + report.counters
        findings.extend(report.findings)
    return LaunchReport(counters, tuple(findings), tuple(notes), tuple(profiles))


def open_device(name: str, **options: Any) -> Device:
    """Open ``simulated``, ``cpu``, ``cuda`` or ``cuda:N``.

    Options of ``simulated``: arch ("sm_52", ...), mode ("run", "count", "debug", "profile"), seed (warp order in
    debug mode), machine (what mode profile models).
    Raises InputError for an unknown name, and where there is no GPU or no CuPy.
    """
    if name == "simulated":
        from mpmbench.device.simulated import SimulatedDevice

        return SimulatedDevice(**options)
    if name == "cpu":
        from mpmbench.device.cpu import CpuDevice

        return CpuDevice(**options)
    if isinstance(name, str) and (name == "cuda" or name.startswith("cuda:")):
        from mpmbench.device.cuda import CudaDevice

        return CudaDevice(name, **options)
    raise InputError(f"unknown device {name!r}: valid are 'simulated', 'cpu', 'cuda' and 'cuda:N'")
