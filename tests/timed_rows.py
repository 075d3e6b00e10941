"""Made-up records with times: nothing is run. Samples come from a seed, so that a test's verdicts never change."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from mpmbench.environment import Environment
from mpmbench.grid import Grid
from mpmbench.record import Check, DatasetSummary, Measurement, Record, StepCost

GPU = {
    "name": "Test GPU", "uuid": "aa", "arch": "sm_90", "multiprocessors": 132, "memory_bytes": 1 << 36,
    "l2_bytes": 50 << 20, "clock_khz": 1_500_000, "memory_clock_khz": 2_000_000, "memory_bus_bits": 5120,
    "ecc": True, "cuda_driver": 12090, "nvrtc": "12.9", "cupy": "14.2.0", "clocks_locked": True,
}  # fmt: skip
ENVIRONMENT = Environment.capture(argv=["mpmbench", "run"], seed=7, gpu=GPU)
AXES = {"spline": "cubic", "block_shape": (8, 4, 4), "batching": 4}


def samples(seed: int, median: float = 1e-3, count: int = 60, noise: float = 0.001) -> tuple[float, ...]:
    """[s], skewed to one side as a GPU's are."""
    return tuple(median * (1 + np.random.default_rng(seed).exponential(noise, count)))


def timed(
    variant: str = "p2g_global_atomic",
    times: tuple[float, ...] | None = None,
    mode: str = "cold",
    hertz: float | None = 1.5e9,
    dataset: str = "random",
    fingerprint: str = "f" * 64,
    gpu: dict[str, Any] | None = None,
    axes: dict[str, Any] | None = None,
    **changes: Any,
) -> Record:
    """A row timed with events on cuda:0, at a fixed clock."""
    times = samples(1) if times is None else times
    clocks = tuple(hertz * (1 + 1e-4 * np.sin(np.arange(len(times))))) if hertz else ()
    environment = dataclasses.replace(ENVIRONMENT, gpu=GPU if gpu is None else gpu)
    step = StepCost(None, Measurement((2e-4,), mode, 3, "precision"))
    made = Record(
        variant=variant,
        transfer=variant[:3],
        dataset=DatasetSummary(dataset, {}, 3, 4096, Grid((8, 9, 10), 0.1), fingerprint),
        axes=AXES if axes is None else axes,
        device="cuda:0",
        arch="sm_90",
        environment=environment,
        check=Check(True, 1e-7, 1e-6),
        preprocess={"scan": step},
        transfer_measurement=Measurement(times, mode, 3, "precision", clocks, {"clock low": 2}),
        hashes={variant: "ab" * 32},
        floor_bytes=64_000,
    )
    return dataclasses.replace(made, **changes)


def wall(variant: str = "p2g_global_atomic", **changes: Any) -> Record:
    """The same on the CPU: wall time, no clock, no GPU."""
    return timed(variant, hertz=None, gpu={}, **{"device": "cpu", "arch": "cpu", **changes})


def untimed(record: Record, **changes: Any) -> Record:
    """The row without its times, with what explains that."""
    return dataclasses.replace(record, transfer_measurement=None, preprocess={}, **changes)


def simulated(variant: str = "p2g_global_atomic") -> Record:
    return untimed(timed(variant, gpu={}), device="simulated")


def other_axes(record: Record, **axes: Any) -> Record:
    return dataclasses.replace(record, axes={**record.axes, **axes})
