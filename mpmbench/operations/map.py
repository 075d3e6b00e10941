"""Map: the same function of every record, with nothing between records (thesis sections 5.1 and 6.2, tables 5, 6)."""

from __future__ import annotations

import numpy as np

from mpmbench.check import CheckResult
from mpmbench.discovery import Axes
from mpmbench.layout import Declaration
from mpmbench.primitives import Arrays, Operation

PAIR = ("position", "velocity")
# Mass and volume stand in the fourth components; affine matrix and deformation gradient by rows.
PARTICLE = (*PAIR, "affine_x", "affine_y", "affine_z", "gradient_x", "gradient_y", "gradient_z")

DECLARATIONS = {
    "float4": Declaration(PAIR, np.dtype(np.float32), 4),
    "float": Declaration(PAIR, np.dtype(np.float32), 1),
    "double4": Declaration(PAIR, np.dtype(np.float64), 4),
    "particle": Declaration(PARTICLE, np.dtype(np.float32), 4),
}

_RESULTS = ("speeds", "distances")
_ROUNDINGS = 6  # four squares, their sum, the root: all of one sign, half an eps each


def used_attributes(axes: Axes) -> tuple[str, ...]:
    """Attributes that the map reads: velocity alone, or position too."""
    return ("velocity", "position")[: axes["used"]]


def inputs(axes: Axes, size: int, seed: int) -> dict[str, np.ndarray]:
    """Every attribute, uniform between 0 and 1."""
    generator, declaration = np.random.default_rng(seed), DECLARATIONS[axes["record"]]
    return {
        name: generator.uniform(0, 1, (size, declaration.components)).astype(declaration.number)
        for name in declaration.names
    }


def check(inputs: Arrays, outputs: Arrays, axes: Axes) -> CheckResult:
    """Against lengths in float64."""
    worst = CheckResult(True, 0.0, 0.0)
    eps = float(np.finfo(DECLARATIONS[axes["record"]].number).eps)
    for name, result in zip(used_attributes(axes), _RESULTS, strict=False):
        values = inputs[name].astype(np.float64)
        if not len(values):
            continue
        expected = np.sqrt((values**2).sum(axis=1))
        allowed = _ROUNDINGS * eps / 2 * expected
        error = np.abs(outputs[result][: len(values)].astype(np.float64) - expected)
        error[~np.isfinite(error)] = np.inf
        ratio = np.divide(error, allowed, out=np.where(error > 0, np.inf, 0.0), where=allowed > 0)
        place = int(np.argmax(ratio))
        found = CheckResult(
            bool(ratio[place] <= 1), float(error[place]), float(allowed[place]), f"length of {name}", (place,)
        )
        worst = max(worst, found, key=lambda result: (not result.passed, result.ratio))
    return worst


def floor(axes: Axes, size: int) -> int:
    """Every attribute that is used read once, one number per attribute and record written once."""
    declaration = DECLARATIONS[axes["record"]]
    return size * axes["used"] * (declaration.attribute_bytes + declaration.number.itemsize)


MAP = Operation(
    name="map",
    summary="the same function of every record",
    unit="records",
    inputs=inputs,
    check=check,
    floor=floor,
)
