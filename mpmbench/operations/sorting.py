"""Counting sort of particles by bin, whole and in its parts (thesis section 5.3, tables 9 and 10).

``bin``: each particle draws a ticket, its bin and its place in it.  ``reorder``: tickets and the scanned counts to the
sorted order, as an index or by moving every attribute.  ``sort``: all of it, from positions (or keys) to the order.

The particles lie at random in a cubic grid of as many bins as table 9 has for its million: half a particle per bin.
How they lie in memory is an axis: ``random``; ``after_10`` and ``after_1``, so many steps of motion within the CFL
condition after a sort; and ``sorted``.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from mpmbench.check import CheckResult
from mpmbench.dataset import Dataset
from mpmbench.device import Launch
from mpmbench.discovery import Axes
from mpmbench.grid import Grid
from mpmbench.motion import after_steps, in_bin_order
from mpmbench.primitives import Arrays, Bench, Operation
from mpmbench.primitives.scan_lookback import lookback, state_length
from mpmbench.recipes import MARGIN, Uniform
from mpmbench.spline import get_spline
from mpmbench.workspace import NEUTRAL, domain_value

STEPS = {"after_10": 10, "after_1": 1, "sorted": 0}  # since the last sort
ORDERS = ("random", *STEPS)
ATTRIBUTES = (8, 1, 2, 3, 4, 5, 6, 7)
LAYOUTS = ("soa", "aos")
SPLINE = "cubic"

INT32, REAL4 = 4, 16  # bytes
TICKET = 2 * INT32


def grid_of(size: int) -> Grid:
    """The cubic grid with about two bins per particle: 128 nodes along each edge for 1024 * 1024 particles."""
    edge = max(8, round((2 * size) ** (1 / 3)))
    return Grid((edge, edge, edge), 1 / edge)


@lru_cache(maxsize=2)  # the same particles for every number of attributes
def particles_of(order: str, size: int, seed: int) -> Dataset:
    """Random positions, in the memory order asked for."""
    grid, uniform = grid_of(size), Uniform(seed)
    xi = 1 + MARGIN + (np.array(grid.shape) - 3 - 2 * MARGIN) * uniform("position", size, 3)
    # Positions that float32 holds: the kernels and their reference see the same.
    position = (grid.dx * xi).astype(np.float32).astype(np.float64)
    dataset = Dataset("random", grid, position, np.zeros((size, 3)), np.zeros((size, 3, 3)), np.ones(size))
    if order == "random":
        return dataset
    return after_steps(dataset, STEPS[order], seed) if STEPS[order] else in_bin_order(dataset, SPLINE)


def keys_of(dataset: Dataset) -> np.ndarray:
    """Bin of each particle, by its definition: the number of its bin node."""
    i, j, k = get_spline(SPLINE).bin_node(dataset.node_units(np.float32)).T
    nx, ny, _ = dataset.grid.shape
    return ((k * ny + j) * nx + i).astype(np.int32)


def attributes_of(dataset: Dataset, count: int, layout: str, seed: int) -> np.ndarray:
    """(count * n, 4) float32 as kernels hold them: position and mass, then random numbers that tell all apart."""
    n = dataset.particle_count
    values = np.empty((count, n, 4), np.float32)
    values[0, :, :3], values[0, :, 3] = dataset.position, dataset.mass
    values[1:] = np.random.default_rng(seed).random((count - 1, n, 4), np.float32)
    return np.ascontiguousarray(values if layout == "soa" else values.transpose(1, 0, 2)).reshape(-1, 4)


def tickets_of(keys: np.ndarray) -> np.ndarray:
    """(n, 2) bin and place of each particle, places in memory order."""
    order = np.argsort(keys, kind="stable")
    place = np.empty(len(keys), np.int64)
    place[order] = np.arange(len(keys)) - np.searchsorted(keys[order], keys[order])
    return np.stack([keys, place], axis=1).astype(np.int32)


def starts_of(keys: np.ndarray, grid: Grid) -> np.ndarray:
    """First sorted particle of each bin, and one entry more: the exclusive scan of the counts."""
    counts = np.bincount(keys, minlength=grid.node_count + 1)
    return (np.cumsum(counts) - counts).astype(np.int32)


# --- inputs -----------------------------------------------------------------------------------------------------------


def bin_inputs(axes: Axes, size: int, seed: int) -> dict[str, np.ndarray]:
    dataset = particles_of(axes["order"], size, seed)
    return {"particles": attributes_of(dataset, 2, axes["layout"], seed), "keys": keys_of(dataset)}


def reorder_inputs(axes: Axes, size: int, seed: int) -> dict[str, np.ndarray]:
    dataset = particles_of(axes["order"], size, seed)
    keys = keys_of(dataset)
    inputs = {"keys": keys, "tickets": tickets_of(keys), "bin_start": starts_of(keys, dataset.grid)}
    return inputs | _moved_attributes(dataset, axes, seed)


def sort_inputs(axes: Axes, size: int, seed: int) -> dict[str, np.ndarray]:
    dataset = particles_of(axes["order"], size, seed)
    given = _moved_attributes(dataset, axes, seed) or {"particles": attributes_of(dataset, 2, "soa", seed)}
    return {"keys": keys_of(dataset)} | given


def _moved_attributes(dataset: Dataset, axes: Axes, seed: int) -> dict[str, np.ndarray]:
    """For strategies that move attributes, all of them; nothing for those that write an index."""
    if "attributes" not in axes:
        return {}
    return {"particles": attributes_of(dataset, axes["attributes"], axes["layout"], seed)}


# --- checks: exact, so that an error is a number of wrong entries -----------------------------------------------------


def check_bin(inputs: Arrays, outputs: Arrays, axes: Axes) -> CheckResult:
    """Each particle has its bin, the places of a bin are 0, 1, 2, ... in any order, and the counts are theirs."""
    keys = inputs["keys"]
    tickets, counts = outputs["tickets"][: len(keys)], outputs["bin_count"]
    place_in_order = np.sort(tickets[:, 0].astype(np.int64) * (len(keys) + 1) + tickets[:, 1])
    expected = np.sort(keys.astype(np.int64) * (len(keys) + 1) + tickets_of(keys)[:, 1])
    return _exact(
        {
            "bins": tickets[:, 0] != keys,
            "places": place_in_order != expected,
            "counts": counts != np.bincount(keys, minlength=len(counts)),
        }
    )


def check_order(inputs: Arrays, outputs: Arrays, axes: Axes) -> CheckResult:
    """The order is a permutation that sorts the keys; moved attributes are the ones that it names, bit by bit."""
    keys = inputs["keys"]
    n = len(keys)
    order = outputs["order"][:n].astype(np.int64)
    wrong = {"permutation": np.sort(order) != np.arange(n)}
    if wrong["permutation"].any():
        return _exact(wrong)
    sorted_keys = keys[order]
    wrong["order of the keys"] = sorted_keys[1:] < sorted_keys[:-1]
    if "sorted_particles" in outputs:
        before, after = (_by_particle(a, n, axes) for a in (inputs["particles"], outputs["sorted_particles"]))
        wrong["moved attributes"] = (after != before[order]).any(axis=(1, 2))
    return _exact(wrong)


def check_reorder(inputs: Arrays, outputs: Arrays, axes: Axes) -> CheckResult:
    """As ``check_order``; where only attributes are written, the order is the one that the tickets fix."""
    tickets = inputs["tickets"]
    if "order" in outputs:
        return check_order(inputs, outputs, axes)
    order = np.empty(len(tickets), np.int32)
    order[inputs["bin_start"][tickets[:, 0]] + tickets[:, 1]] = np.arange(len(tickets))
    return check_order(inputs, {**outputs, "order": order}, axes)


def _by_particle(flat: np.ndarray, n: int, axes: Axes) -> np.ndarray:
    """(count * n, 4) -> (n, count, 4)."""
    if axes["layout"] == "soa":
        return flat[: axes["attributes"] * n].reshape(axes["attributes"], n, 4).transpose(1, 0, 2)
    return flat[: axes["attributes"] * n].reshape(n, axes["attributes"], 4)


def _exact(wrong: dict[str, np.ndarray]) -> CheckResult:
    """The first property that does not hold, how many entries break it, and the first of them."""
    for quantity, where in wrong.items():
        if where.any():
            return CheckResult(False, float(where.sum()), 0.0, quantity, (int(np.argmax(where)),))
    return CheckResult(True, 0.0, 0.0, ", ".join(wrong), (0,))


# --- floors -----------------------------------------------------------------------------------------------------------


def bin_floor(axes: Axes, size: int) -> int:
    """Every position read and every ticket written. What counters cost on top is up to the particles."""
    return (REAL4 + TICKET) * size


def reorder_floor(axes: Axes, size: int) -> int:
    """Every ticket read and every index written, or every attribute read and written."""
    return (TICKET + (2 * REAL4 * axes["attributes"] if "attributes" in axes else INT32)) * size


def sort_floor(axes: Axes, size: int) -> int:
    """Every position read, and every index written or every attribute read and written."""
    return (2 * REAL4 * axes["attributes"] if "attributes" in axes else REAL4 + INT32) * size


# --- what strategies launch -------------------------------------------------------------------------------------------


def constants(axes: Axes, **more: object) -> dict[str, object]:
    """Of the particle kernels: float, the attributes and the layout asked for."""
    return {**NEUTRAL, "SOA": axes.get("layout", "soa") == "soa", "ATTRIBUTES": axes.get("attributes", 2), **more}


def binning(bench: Bench, particles: Any, counts: Any, tickets: Any) -> tuple[Launch, ...]:
    """The launch that draws tickets; ``counts`` start at zero."""
    kernel = bench.helper("bin_particles", **constants(bench.axes, SPLINE=get_spline(SPLINE).nodes - 1))
    domain = domain_value(grid_of(bench.size), np.float32)
    return bench.cover(kernel, bench.size, domain, np.int32(bench.size), particles, counts, tickets)


def cleared(bench: Bench, counts: Any, length: int) -> tuple[Launch, ...]:
    """The launch that sets counters to zero."""
    return bench.cover(bench.helper("clear_counts"), length, np.int32(length), counts)


def bins_of(bench: Bench) -> int:
    """Bins, and one more for where the last one ends."""
    return grid_of(bench.size).node_count + 1


def ticketed(bench: Bench, particles: Any) -> tuple[tuple[Launch, ...], Any, Any]:
    """Binning and scan: the launches, the tickets and the first sorted particle of each bin."""
    bins = bins_of(bench)
    counts, starts = bench.empty(bins, np.int32), bench.empty(bins, np.int32)
    tickets = bench.empty((bench.size, 2), np.int32)
    scan = lookback(bench, bins, counts, starts, bench.empty(state_length(bins), np.int32))
    launches = (*cleared(bench, counts, bins), *binning(bench, particles, counts, tickets), *scan)
    return launches, tickets, starts


def reorder_by_index(bench: Bench, tickets: Any, starts: Any, order: Any) -> tuple[Launch, ...]:
    return bench.cover(bench.helper("sort_index"), bench.size, np.int32(bench.size), tickets, starts, order)


def reorder_in_full(
    bench: Bench, tickets: Any, starts: Any, particles: Any, moved: Any, order: Any = None
) -> tuple[Launch, ...]:
    """Every attribute to its sorted place; the order too, where there is a buffer for it."""
    kernel = bench.helper("sort_deep", **constants(bench.axes, KEEP_ORDER=order is not None))
    unused = tickets  # for the order, which the kernel then never touches
    target = unused if order is None else order
    return bench.cover(kernel, bench.size, np.int32(bench.size), tickets, starts, particles, moved, target)


BIN = Operation("bin", "each particle's bin and its place in it", "particles", bin_inputs, check_bin, bin_floor)
REORDER = Operation("reorder", "tickets to the sorted order", "particles", reorder_inputs, check_reorder, reorder_floor)
SORT = Operation("sort", "particles to their order by bin", "particles", sort_inputs, check_order, sort_floor)
