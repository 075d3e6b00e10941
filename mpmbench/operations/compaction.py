"""Stream compaction: the places of all positive values, in order, and how many there are (thesis section 5.3).

The transfers make their list of active blocks with it (section 5.4.3).
"""

from __future__ import annotations

import numpy as np

from mpmbench.check import CheckResult
from mpmbench.discovery import Axes
from mpmbench.primitives import Arrays, Operation

PERCENT = (12, 50, 100, 0)  # of values that are positive; 11.9 % of the blocks of table 16's densest set are active
INT32 = 4  # bytes


def positive_count(axes: Axes, size: int) -> int:
    return size * axes["percent"] // 100


def inputs(axes: Axes, size: int, seed: int) -> dict[str, np.ndarray]:
    """Particle counts of blocks: exactly the share asked for is positive."""
    generator = np.random.default_rng(seed)
    values = np.zeros(size, np.int32)
    chosen = generator.choice(size, positive_count(axes, size), replace=False)
    values[chosen] = generator.integers(1, 100, len(chosen))
    return {"values": values}


def check(inputs: Arrays, outputs: Arrays, axes: Axes) -> CheckResult:
    """The list, entry by entry, and its length."""
    expected = np.flatnonzero(inputs["values"])
    count = int(outputs["count"][0]) if len(inputs["values"]) else 0
    if count != len(expected):
        return CheckResult(False, float(abs(count - len(expected))), 0.0, "length of the list", (0,))
    wrong = outputs["list"][:count] != expected
    if wrong.any():
        return CheckResult(False, float(wrong.sum()), 0.0, "list", (int(np.argmax(wrong)),))
    return CheckResult(True, 0.0, 0.0, "list", (0,))


def floor(axes: Axes, size: int) -> int:
    """Every value read, every entry of the list and its length written."""
    return INT32 * (size + positive_count(axes, size) + 1) if size else 0


COMPACT = Operation("compact", "places of all positive values, in order", "values", inputs, check, floor)
