"""The ``cpu`` device: our engine as a CPU backend, timed by wall clock. Never a statement about a GPU.

The kernels are the same; what runs is machine code for this processor, made from their PTX. Times go to tables of their
own, beside peers that run the same transfers on the same core.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path

import numpy as np

from mpmbench.device import CompiledKernel, KernelInfo
from mpmbench.device.simulated import SimulatedDevice

FLUSH_BYTES = 64 << 20  # where the size of the last cache is not known


class CpuDevice(SimulatedDevice):
    """Runs kernels on one core, without counting. Offers what timing needs: ``flush_cache``, ``hold``, ``release``,
    ``record``, ``elapsed``."""

    name = "cpu"

    def __init__(self, arch: str = "sm_90") -> None:
        super().__init__(arch, mode="run")

    def info(self, kernel: CompiledKernel) -> KernelInfo:
        """Registers and shared memory mean nothing here."""
        return KernelInfo(arch=self.arch)

    @contextmanager
    def undisturbed(self) -> Iterator[None]:
        """Tie this process, and every thread it starts meanwhile, to the last core it may use."""
        cores = os.sched_getaffinity(0)
        os.sched_setaffinity(0, {max(cores)})
        try:
            yield
        finally:
            os.sched_setaffinity(0, cores)

    @cached_property
    def _last_cache_bytes(self) -> int | None:
        sizes = [_bytes(_read(path)) for path in Path(CACHES).glob("index*/size")]
        return max(filter(None, sizes), default=None)

    @cached_property
    def _flush_buffer(self) -> np.ndarray:
        return np.zeros(2 * (self._last_cache_bytes or FLUSH_BYTES), np.uint8)

    def flush_cache(self) -> None:
        """Evict the caches: overwrite a buffer of twice the last one's size."""
        self._flush_buffer[:] = 0

    hold_expired = False

    def hold(self) -> None:
        """Nothing to hold: a launch runs when it is made."""

    def release(self) -> None:
        """Nothing is held."""

    def record(self) -> float:
        """This moment [s]."""
        return time.perf_counter()

    def elapsed(self, start: float, end: float) -> float:
        """Time between two moments [s]."""
        return end - start


CACHES = "/sys/devices/system/cpu/cpu0/cache"


def _read(path: str | Path) -> str:
    try:
        return Path(path).read_text().strip()
    except OSError:
        return ""


def _bytes(text: str) -> int | None:
    """``32768K`` -> 33554432."""
    units = {"K": 1 << 10, "M": 1 << 20}
    number, unit = text[:-1], text[-1:]
    return int(number) * units[unit] if unit in units and number.isdigit() else None
