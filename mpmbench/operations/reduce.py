"""Reduction: all elements of an array to one value, by any unary and binary operator (thesis section 5.2, eq. 139).

The unary operator turns what is loaded into a value, the binary one combines two values; both are constants of the
kernels. What the method needs of it: the CFL bound (``length_max`` over velocities, eq. 92; ``speed_max`` over
particles with their affine part, eq. 93), what transfers conserve (``momentum_add``: mass and momentum in one pass,
eqs. 144 and 145), and the fullest bin (``identity_max``).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from mpmbench.check import CheckResult
from mpmbench.device import Launch
from mpmbench.discovery import Axes
from mpmbench.primitives import Arrays, Bench, Built, Operation

ELEMENTS = ("float4", "float", "double", "int", "double4")
OPERATORS = ("length_add", "length_max", "identity_add", "identity_max", "momentum_add", "speed_max")
LOADS = (1, 2, 4, 8, 16, 32, 64, 128, 256)

# Farthest node of a cubic support from its particle, in cells: kappa of eq. 93; with the spacing of a 128^3 unit cube.
REACH = 2 * math.sqrt(3) / 128

_UNARY = {"identity": "Identity", "length": "Length", "momentum": "Momentum", "speed": "SpeedBound"}
_PARTICLE_ATTRIBUTES = {"momentum": 2, "speed": 5}
_UNARY_ROUNDINGS = 16  # of a length or a particle's momentum, generously


def components(element: str) -> int:
    """4 for a vector, 1 for a number."""
    return 4 if element.endswith("4") else 1


def number_type(element: str) -> np.dtype:
    """The NumPy type of one component."""
    return np.dtype({"float": np.float32, "double": np.float64, "int": np.int32}[element.removesuffix("4")])


def element_constants(element: str) -> dict[str, object]:
    """The type of an input array for kernels that take any."""
    double = element.startswith("double")
    name = {"int": "int"}.get(element, "real4" if components(element) == 4 else "real")
    return {"REAL": "double" if double else "float", "REAL_IS_DOUBLE": double, "ELEMENT": name}


def value_element(axes: Axes) -> str:
    """What the unary operator makes of an element."""
    unary = axes["operator"].split("_")[0]
    return axes["element"] if unary in ("identity", "momentum") else axes["element"].removesuffix("4")


def requires(axes: Axes) -> str | None:
    """Operators on particles read four-component attributes."""
    unary = axes["operator"].split("_")[0]
    if unary in _PARTICLE_ATTRIBUTES and components(axes["element"]) == 1:
        return f"operator {axes['operator']} reads particles: element must be float4 or double4"
    return None


def inputs(axes: Axes, size: int, seed: int) -> dict[str, np.ndarray]:
    """Numbers between -1 and 1, integers between -1000 and 1000, vectors no longer than 1; masses are positive."""
    generator = np.random.default_rng(seed)
    unary, width = axes["operator"].split("_")[0], components(axes["element"])
    if axes["element"] == "int":
        return {"values": generator.integers(-1000, 1001, size, dtype=np.int32)}
    attributes = _PARTICLE_ATTRIBUTES.get(unary, 1)
    values = generator.uniform(-1, 1, (attributes, size, width))
    if width == 4:
        values /= 2
    if attributes > 1:
        values[0, :, 3] = generator.uniform(0.5, 1.5, size)
        values[1:, :, 3] = 0
    return {"values": values.reshape(-1, width).astype(number_type(axes["element"])).reshape(attributes * size, width)}


def check(inputs: Arrays, outputs: Arrays, axes: Axes) -> CheckResult:
    """Against exact integers, or float64 with exact summation.

    A pyramid of sums rounds every partial sum once: at most ``depth`` roundings lie between an element and the total.
    """
    result = np.asarray(outputs["result"]).reshape(-1).astype(np.float64)
    values = _values(inputs["values"], axes)
    binary = axes["operator"].split("_")[1]
    columns = values.reshape(len(values), -1).T
    if axes["element"] == "int":
        neutral = 0 if binary == "add" else np.iinfo(np.int32).min
        reference = [float(c.sum() if binary == "add" else c.max(initial=neutral)) for c in columns]
        allowed = [0.0]
    else:
        u = float(np.finfo(number_type(axes["element"])).eps) / 2
        size = [math.fsum(np.abs(c)) for c in columns]
        if binary == "add":
            reference = [math.fsum(c) for c in columns]
            allowed = [u * (_UNARY_ROUNDINGS + _depth(axes, len(values))) * s for s in size]
        else:
            reference = [float(c.max(initial=-np.inf)) for c in columns]
            allowed = [u * _UNARY_ROUNDINGS * abs(r) if np.isfinite(r) else 0.0 for r in reference]
    error = [0.0 if a == b else abs(a - b) for a, b in zip(result, reference, strict=True)]
    error = [e if np.isfinite(e) else np.inf for e in error]
    ratio = [0.0 if e == 0 else e / a if a > 0 else np.inf for e, a in zip(error, allowed, strict=True)]
    worst = int(np.argmax(ratio))
    return CheckResult(max(ratio) <= 1, error[worst], allowed[worst], axes["operator"], (worst,))


def floor(axes: Axes, size: int) -> int:
    """Every element read once and the result written once."""
    attributes = _PARTICLE_ATTRIBUTES.get(axes["operator"].split("_")[0], 1)
    if axes["operator"] == "speed_max":
        attributes -= 1  # the position is not read
    item = number_type(axes["element"]).itemsize
    return item * (attributes * size * components(axes["element"]) + components(value_element(axes)))


def pyramid(bench: Bench) -> Built:
    """Any length: each level leaves one partial result per thread block, until one is left."""
    axes, group, loads = bench.axes, bench.axes["threads"], bench.axes.get("loads", 1)
    unary, binary = axes["operator"].split("_")
    shape: dict[str, Any] = {"BINARY": binary.capitalize(), "GROUP": group, "LOADS": loads, "REACH": REACH}
    if "index" in axes:
        shape["STRIDED"] = axes["index"] == "strided"
    level: dict[str, Any] = element_constants(axes["element"]) | {"UNARY": _UNARY[unary]}
    above = element_constants(value_element(axes)) | {"UNARY": "Identity"}
    count, source = bench.size, bench.upload(bench.inputs["values"])
    width, dtype = components(value_element(axes)), number_type(axes["element"])
    launches: list[Launch] = []
    while True:
        partials = max(1, -(-count // (group * loads)))
        result = bench.empty((partials, width), dtype)
        launches += bench.launch(bench.kernel(**level, **shape), partials, group, np.int32(count), source, result)
        if partials == 1:
            return Built(tuple(launches), {"result": result})
        count, source, level = partials, result, above


def _values(loaded: np.ndarray, axes: Axes) -> np.ndarray:
    """The unary operator in float64 (int64 for integers), one row per element."""
    unary = axes["operator"].split("_")[0]
    if axes["element"] == "int":
        return np.abs(loaded.astype(np.int64)) if unary == "length" else loaded.astype(np.int64)
    wide = loaded.astype(np.float64)
    if unary == "identity":
        return wide
    if unary == "length":
        return np.sqrt((wide**2).sum(axis=1))
    attributes = wide.reshape(_PARTICLE_ATTRIBUTES[unary], -1, 4)
    if unary == "momentum":
        mass = attributes[0, :, 3:]
        return np.concatenate([mass * attributes[1, :, :3], mass], axis=1)
    affine = (attributes[2:, :, :3] ** 2).sum(axis=(0, 2))
    return np.sqrt((attributes[1, :, :3] ** 2).sum(axis=1)) + REACH * np.sqrt(affine)


def _depth(axes: Axes, count: int) -> int:
    """Additions between an element and the total; for a strategy without these axes, of the widest pyramid."""
    group, loads = axes.get("threads", 1024), axes.get("loads", 256)
    depth = 0
    while True:
        depth += loads + group.bit_length()
        count = -(-count // (group * loads))
        if count <= 1:
            return depth


REDUCE = Operation(
    name="reduce",
    summary="all elements of an array to one value",
    unit="elements",
    inputs=inputs,
    check=check,
    floor=floor,
)
