"""Thesis table 3: errors of map and map-reduce on 1024 x 1024 random elements, in float and double.

References are formed in float64 from the elements as the kernels get them and added exactly; for doubles the reference
of a length has one rounding itself. Beside the kernels stands what one accumulator makes of the same values.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mpmbench.device import Device, run_all
from mpmbench.presets import published_rows
from mpmbench.primitive_runs import build_primitive
from mpmbench.primitives import get, resolve_axes
from mpmbench.report.table import Column
from mpmbench.verify.outcome import Outcome, Tick, label, make_table, own_kind, published
from mpmbench.verify.totals import exact_sum, sequential_sum

ELEMENTS, QUICK_ELEMENTS = 1024 * 1024, 16 * 1024
SEED = 20193

# Of the printed rows: the element type and the operator. One printed row stands for two of ours. The length of a number
# between 0 and 1 is the number.
MAPS = (("Map (float)", "float", "identity"), ("Map (vec4,dvec4)", "float4", "length"),
        ("Map (vec4,dvec4)", "double4", "length"))  # fmt: skip
REDUCTIONS = (("MapReduce (float)", "float", "identity"), ("MapReduce (double)", "double", "identity"),
              ("MapReduce (vec4)", "float4", "length"), ("MapReduce (dvec4)", "double4", "length"))  # fmt: skip


def random_elements(element: str, count: int) -> np.ndarray:
    """(count, 1) numbers from 0 to 1, or (count, 4) vectors evenly spread over the unit ball, last component zero.

    The printed errors put the mean length at 787,000 / 1024**2 = 3/4, which is the ball's in three dimensions.
    """
    generator = np.random.default_rng(SEED)
    real = np.float64 if element.startswith("double") else np.float32
    if not element.endswith("4"):
        return generator.random((count, 1)).astype(real)
    direction = generator.standard_normal((count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    vectors = np.zeros((count, 4))
    vectors[:, :3] = direction * np.cbrt(generator.random((count, 1)))
    return vectors.astype(real)


def mapped(values: np.ndarray) -> np.ndarray:
    """The operator in float64: the number, or the length."""
    wide = values.astype(np.float64)
    return wide[:, 0] if values.shape[1] == 1 else np.sqrt((wide**2).sum(axis=1))


@dataclass(frozen=True)
class Error:
    """Of one printed row: the total of the kernel's result against the exact total.

    largest: relative error of the worst element, None for a reduction.  sequential: relative error of one float32 (or
    float64) accumulator over the same values.
    """

    row: str
    element: str
    operator: str
    absolute: float
    relative: float
    largest: float | None
    sequential: float


def map_error(device: Device, row: str, element: str, operator: str, count: int) -> Error:
    """One length per element; the results are added exactly."""
    values = random_elements(element, count)
    primitive = get("map_length")
    axes = resolve_axes(primitive, {"record": element, "layout": "soa", "used": 1})
    built = build_primitive(primitive, device, axes, {"position": values, "velocity": values}, count)
    run_all(device, (*built.before, *built.launches))
    result = np.asarray(device.download(built.outputs["speeds"])).reshape(-1)[:count]
    exact = mapped(values)
    worst = float((np.abs(result - exact) / np.where(exact > 0, exact, 1)).max())
    return _error(row, element, operator, exact_sum(result), exact, worst, values.dtype)


def reduction_error(device: Device, row: str, element: str, operator: str, count: int) -> Error:
    """The tree of the thesis: one thread block per 1024 elements, then again over the partial sums."""
    values = random_elements(element, count)
    primitive = get("reduce_sequential")
    axes = resolve_axes(primitive, {"element": element, "operator": f"{operator}_add", "loads": 1, "threads": 1024})
    built = build_primitive(primitive, device, axes, {"values": values}, count)
    run_all(device, (*built.before, *built.launches))
    result = float(np.asarray(device.download(built.outputs["result"])).reshape(-1)[0])
    return _error(row, element, operator, result, mapped(values), None, values.dtype)


def _error(
    row: str, element: str, operator: str, result: float, exact: np.ndarray, worst: float | None, real: np.dtype
) -> Error:
    total = exact_sum(exact)
    naive = sequential_sum(exact.astype(real))
    off = abs(result - total)
    return Error(row, element, operator, off, off / total, worst, abs(naive - total) / total)


def run(device: Device, quick: bool, tick: Tick) -> Outcome:
    begin = time.perf_counter()
    count = QUICK_ELEMENTS if quick else ELEMENTS
    errors = []
    cases = [*((map_error, case) for case in MAPS), *((reduction_error, case) for case in REDUCTIONS)]
    for done, (measure, case) in enumerate(cases):
        errors.append(measure(device, *case, count))
        tick(f"{case[0]} {case[1]}", done + 1, len(cases))
    printed = {row["row"]: row for row in published_rows(3)}
    kind = own_kind(device)
    columns = (
        label("kernel"),
        label("element"),
        label("of each"),
        published("printed abs. error"),
        published("printed rel. error"),
        Column("total abs. error", kind),
        Column("total rel. error", kind),
        Column("worst element, rel.", kind),
        Column("one accumulator on the CPU, rel.", kind),
    )
    rows = [
        (e.row, e.element, e.operator, float(printed[e.row]["abs_error"]), float(printed[e.row]["rel_error"]),
         e.absolute, e.relative, e.largest, e.sequential)
        for e in errors
    ]  # fmt: skip
    notes = [f"Printed {name}: {row['erratum']}." for name, row in printed.items() if row["erratum"]]
    return Outcome(
        "table3",
        "Map and map-reduce (thesis table 3)",
        f"{count:,} random elements: numbers from 0 to 1, vectors of the unit ball.",
        (make_table("Errors of the totals", columns, rows, notes),),
        tuple(problems_of(errors, count)),
        time.perf_counter() - begin,
    )


def problems_of(errors: Sequence[Error], count: int) -> list[str]:
    """Bounds that do not hold: a few roundings of each element, and one of a partial sum per level of the trees."""
    found = []
    for error in errors:
        eps = float(np.finfo(np.float64 if error.element.startswith("double") else np.float32).eps)
        levels = 2 * math.ceil(math.log2(count)) if error.largest is None else 0
        length = 3 if error.operator == "length" else 0
        allowed = eps / 2 * (2 * length + levels)
        for what, value in (("total", error.relative), ("worst element", error.largest)):
            if value is not None and not value <= allowed:
                found.append(f"{error.row} {error.element}: {what} off by {value:.2e}, allowed {allowed:.2e}")
    return found
