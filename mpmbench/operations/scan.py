"""Exclusive scan of integers: element i becomes the sum of all elements before it (thesis section 5.2, eq. 140)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from mpmbench.check import CheckResult
from mpmbench.device import Launch
from mpmbench.discovery import Axes
from mpmbench.primitives import Arrays, Bench, Built, Operation

INT32 = 4  # bytes
NEUTRAL: dict[str, object] = {"REAL": "float", "REAL_IS_DOUBLE": False}  # of headers that a scan of integers shares


def inputs(axes: Axes, size: int, seed: int) -> dict[str, np.ndarray]:
    """Particle counts of bins: small, many of them zero, so that no sum leaves 32 bits."""
    return {"values": np.random.default_rng(seed).poisson(0.5, size).astype(np.int32)}


def check(inputs: Arrays, outputs: Arrays, axes: Axes) -> CheckResult:
    """Against 64-bit sums, exactly."""
    values, result = inputs["values"], outputs["scanned"][: len(inputs["values"])]
    if not len(values):
        return CheckResult(True, 0.0, 0.0)
    expected = np.cumsum(values, dtype=np.int64) - values
    error = np.abs(result.astype(np.int64) - expected)
    worst = int(np.argmax(error))
    return CheckResult(not error[worst], float(error[worst]), 0.0, "scan", (worst,))


def floor(axes: Axes, size: int) -> int:
    """Every value read once and every result written once."""
    return 2 * INT32 * size


def by_levels(segment_of: Callable[[Axes], int], constants_of: Callable[[Axes], dict[str, object]]) -> Callable:
    """The ``build`` of a strategy that scans segments: any length, by scanning the segments' sums one level up.

    segment_of: axes -> values of a thread block.  constants_of: axes -> constants of the kernel beside GROUP, FLAGS.
    """

    def build(bench: Bench) -> Built:
        axes, segment = bench.axes, segment_of(bench.axes)
        kernel = bench.kernel(GROUP=axes["threads"], FLAGS=False, **NEUTRAL, **constants_of(axes))
        count, values = bench.size, bench.upload(bench.inputs["values"])
        launches: list[Launch] = []
        levels: list[tuple[int, Any]] = []
        while True:
            segments = max(1, -(-count // segment))
            scanned, sums = bench.empty(count, np.int32), bench.empty(segments, np.int32)
            launches += bench.launch(kernel, segments, axes["threads"], np.int32(count), values, scanned, sums)
            levels.append((count, scanned))
            if segments == 1:
                break
            count, values = segments, sums
        if len(levels) > 1:
            add = bench.helper("scan_add", SEGMENT=segment)
            for (length, scanned), (_, before) in zip(reversed(levels[:-1]), reversed(levels[1:]), strict=True):
                launches += bench.cover(add, length, np.int32(length), scanned, before)
        return Built(tuple(launches), {"scanned": levels[0][1]})

    return build


SCAN = Operation(
    name="scan",
    summary="each element to the sum of all before it",
    unit="integers",
    inputs=inputs,
    check=check,
    floor=floor,
    default_size=4 * 1024 * 1024,
)
