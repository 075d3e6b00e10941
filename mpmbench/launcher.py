"""Ways to compile and launch kernels that every kind of strategy shares."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mpmbench.device import CompiledKernel, Device, Launch
from mpmbench.errors import InputError
from mpmbench.kernel import load_source

THREADS = 128  # per thread block, where a kernel leaves the choice open
INT32_LIMIT = 2**31  # kernels index with 32-bit integers


class Launcher:
    """One device, and the kernels that were compiled for it so far."""

    device: Device
    kernels: dict[Any, CompiledKernel]

    def compile(
        self, path: Path, entry: str, constants: Mapping[str, object], options: tuple[str, ...] = ()
    ) -> CompiledKernel:
        """The kernel ``entry`` of a source under these constants and options of NVRTC, compiled once."""
        key = (path, tuple(constants.items()), options)
        if key not in self.kernels:
            self.kernels[key] = self.device.compile(load_source(path, constants, options=options), entry)
        return self.kernels[key]

    def launch(self, kernel: CompiledKernel, count: int, threads: int, *args: Any) -> tuple[Launch, ...]:
        """One launch of ``count`` thread blocks of ``threads`` threads; none where count is zero."""
        if count >= INT32_LIMIT:
            raise InputError(f"{kernel.entry} needs {count} thread blocks, a launch has at most 2^31 - 1")
        return (Launch(kernel.entry, kernel, (count, 1, 1), (threads, 1, 1), args),) if count else ()
