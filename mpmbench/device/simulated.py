"""The simulated device: the kernels' own PTX, executed on the CPU. The only file that imports the engine."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from mpmbench.device import CompiledKernel, KernelInfo, Launch, LaunchProfile, LaunchReport
from mpmbench.errors import InputError
from mpmbench.kernel import KernelSource, parameter_names
from mpmbench.simt.machine import Machine
from mpmbench.simt.nvrtc import compile_cuda, supported_archs

MODES = ("run", "count", "debug", "profile", "oracle")
ALIGNMENT = 256  # bytes, as cudaMalloc guarantees: sector counts depend on it
POISON = 0xFF  # every byte of fresh memory in debug mode: a NaN for both float types


class SimulatedDevice:
    """Runs kernels warp by warp; arrays are NumPy arrays.

    arch: what NVRTC compiles for.  mode: "run" gives results only, "count" counters too, "debug" findings (slow),
    "profile" counters of a modelled GPU's memory system too, "oracle" the plain NumPy executor that the engine is held
    to (very slow).  In debug mode, seed: of the warp order; fuzz: lanes that part run in a random order too; budget:
    warp instructions that loops may repeat (None: much).  machine: (facts of a kernel, threads and shared bytes per
    thread block) -> the machine that mode profile models.
    """

    name = "simulated"

    def __init__(
        self,
        arch: str = "sm_90",
        mode: str = "count",
        seed: int = 0,
        fuzz: bool = False,
        budget: int | None = None,
        machine: Callable[[KernelInfo, int, int], Machine] | None = None,
    ) -> None:
        if mode not in MODES:
            raise InputError(f"unknown mode {mode!r} of the simulated device: valid are {', '.join(MODES)}")
        if arch not in (known := supported_archs()):
            raise InputError(f"NVRTC cannot compile for {arch!r}: valid are {', '.join(known)}")
        if mode == "profile" and machine is None:
            raise InputError("mode 'profile' needs a machine to model")
        self.arch, self.mode, self.seed, self.fuzz, self.budget = arch, mode, seed, fuzz, budget
        self.machine = machine
        self._modules: dict[str, Any] = {}
        self._written: Any = None  # debug: which bytes of fresh memory have been written
        if mode == "debug":
            from mpmbench.simt.checks import Written

            self._written = Written()

    def upload(self, host: np.ndarray) -> np.ndarray:
        array = _aligned(host.shape, host.dtype)
        array[...] = host
        return array

    def empty(self, shape: int | tuple[int, ...], dtype: Any) -> np.ndarray:
        array = _aligned(shape, np.dtype(dtype))
        if self.mode == "debug":
            array.reshape(-1).view(np.uint8)[...] = POISON
            self._written.allocate(array)
        return array

    def download(self, array: np.ndarray) -> np.ndarray:
        return array.copy()

    def ptx(self, source: KernelSource) -> str:
        """The PTX of a source for this device's architecture."""
        return compile_cuda(source.text, self.arch, source.all_options, name=f"{source.name}.cu")

    def compile(self, source: KernelSource, entry: str) -> CompiledKernel:
        if source.sha256 not in self._modules:
            self._modules[source.sha256] = self._compile(self.ptx(source))
        kernels = self._modules[source.sha256]
        return CompiledKernel(source, entry, kernels.kernel(entry))

    def _compile(self, ptx: str) -> Any:
        if self.mode == "oracle":
            return _OracleModule(ptx)
        from mpmbench.simt.engine import compile_ptx

        return compile_ptx(ptx, mode=self.mode)

    def info(self, kernel: CompiledKernel) -> KernelInfo:
        from mpmbench.device.ptxas import kernel_infos

        return kernel_infos(self.ptx(kernel.source), self.arch)[kernel.entry]

    def launch(self, launch: Launch) -> LaunchReport:
        if self.mode == "profile":
            return self._profile(launch)
        options: dict[str, Any] = {}
        if self.mode == "debug":
            names = launch.names or parameter_names(launch.kernel.source.text, launch.kernel.entry)
            options = {
                "seed": self.seed,
                "fuzz": self.fuzz,
                "budget": self.budget,
                "names": names,
                "written": self._written,
            }
        result = launch.kernel.handle.launch(
            launch.grid, launch.block, launch.args, shared_bytes=launch.shared_bytes, **options
        )
        return LaunchReport(result.counters, result.findings, result.notes)

    def _profile(self, launch: Launch) -> LaunchReport:
        assert self.machine is not None
        info, threads = self.info(launch.kernel), math.prod(launch.block)
        shared_bytes = (info.shared_bytes or 0) + launch.shared_bytes
        result = launch.kernel.handle.launch(
            launch.grid,
            launch.block,
            launch.args,
            shared_bytes=launch.shared_bytes,
            machine=self.machine(info, threads, shared_bytes),
        )
        profile = LaunchProfile(
            launch.kernel.entry,
            math.prod(launch.grid),
            threads,
            shared_bytes,
            info,
            result.counters,
            result.memory,
            result.opcodes,
        )
        return LaunchReport(result.counters, result.findings, profiles=(profile,))

    def synchronize(self) -> None:
        """Launches return when they are done."""


class _OracleModule:
    """The NumPy executor behind the engine's interface."""

    def __init__(self, ptx: str) -> None:
        from mpmbench.simt.ptx import parse

        self.module = parse(ptx)

    def kernel(self, name: str) -> _OracleKernel:
        return _OracleKernel(self.module, name)


class _OracleKernel:
    def __init__(self, module: Any, name: str) -> None:
        self.module, self.name = module, name

    def launch(self, grid: Any, block: Any, args: Any, shared_bytes: int = 0) -> Any:
        from mpmbench.simt import numpy_exec

        return numpy_exec.run(self.module.kernels[self.name], self.module, grid, block, args, shared_bytes)


def _aligned(shape: int | tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    size = int(np.prod(shape)) * dtype.itemsize
    raw = np.empty(size + ALIGNMENT, np.uint8)
    start = -raw.ctypes.data % ALIGNMENT
    return raw[start : start + size].view(dtype).reshape(shape)
