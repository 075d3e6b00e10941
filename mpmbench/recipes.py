"""Where particles sit: one generator per kind of recipe, positions in node units.

A generator gets the grid, the recipe's parameters and a source of uniform numbers, and returns xi (n, 3): position in
units of dx counted from node (0, 0, 0), in memory order. Every xi lies in the box of nodes [1, n-2) per axis, in which
the support of every B-spline of this project stays on the grid, and keeps ``MARGIN`` cells away from the box's faces,
so that rounding to float32 cannot push a particle out.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from mpmbench.errors import InputError
from mpmbench.grid import Grid, Triple

# Free strip inside a face [cells]: float32 resolves xi < 2**13 finer than this, whatever dx and a near origin are.
MARGIN = 2.0**-10


class Uniform:
    """Uniform numbers in [0, 1) from named streams of a seed.

    Built on the raw output of PCG64, which NumPy promises to keep for ever (NEP 19), so a fingerprint stays valid.
    """

    def __init__(self, seed: int) -> None:
        self.seed = seed

    def __call__(self, stream: str, *shape: int) -> np.ndarray:
        """float64 array of ``shape``; the same seed, stream and shape give the same numbers."""
        entropy = [self.seed, *stream.encode()]
        raw = np.random.PCG64(np.random.SeedSequence(entropy)).random_raw(math.prod(shape))
        return ((np.asarray(raw, dtype=np.uint64) >> np.uint64(11)) * 2.0**-53).reshape(shape)


Generator = Callable[[Grid, dict[str, Any], Uniform], np.ndarray]


def free_cells(grid: Grid) -> Triple:
    """Cells per axis of the box of nodes [1, n-2)."""
    cells = tuple(n - 3 for n in grid.shape)
    if min(cells) < 1:
        raise InputError(f"grid {grid.shape} is too small for a recipe: give at least 4 nodes per axis")
    return cells  # type: ignore[return-value]


def random(grid: Grid, recipe: dict[str, Any], uniform: Uniform) -> np.ndarray:
    """Uniform in the box of nodes [1, n-2)."""
    extent = np.array(free_cells(grid), dtype=np.float64)
    return 1 + MARGIN + (extent - 2 * MARGIN) * uniform("position", recipe["particles"], 3)


def uniform_cube(grid: Grid, recipe: dict[str, Any], uniform: Uniform) -> np.ndarray:
    """Cells of a centred cube with exactly k jittered particles each, the last layer partial so that n is exact.

    On a grid too flat for the cube, the region is cut to the grid and grows along the other axes.
    """
    count, per_cell = recipe["particles"], recipe["particles_per_cell"]
    free = free_cells(grid)
    wanted = -(-count // per_cell)
    if wanted > math.prod(free):
        raise InputError(
            f"{count} particles at {per_cell} per cell need {wanted} cells, but grid {grid.shape} has room for "
            f"{math.prod(free)}: take fewer particles, more per cell or a larger grid"
        )
    edge = 1
    while math.prod(min(edge, cells) for cells in free) < wanted:
        edge += 1
    region = [min(edge, cells) for cells in free]
    low = [1 + (cells - taken) // 2 for cells, taken in zip(free, region, strict=True)]
    cell = np.arange(count) // per_cell  # z is the slowest axis, so the partial layer is the top one
    index = np.stack([cell % region[0], cell // region[0] % region[1], cell // (region[0] * region[1])], axis=1)
    xi = low + index + jitter(uniform("position", count, 3))
    if recipe["order"] == "random":
        return xi[np.argsort(uniform("order", count), kind="stable")]
    spacing = per_cell ** (-1 / 3)  # of a lattice with k points per cell
    turned = xi @ rotation(recipe["rotation_axis"], recipe["rotation_degrees"])
    site = np.floor(turned / spacing).astype(np.int64)
    return xi[np.lexsort((site[:, 0], site[:, 1], site[:, 2]))]  # x fastest, as a lattice would be stored


def jitter(uniform: np.ndarray) -> np.ndarray:
    """Uniform numbers to offsets inside a cell, ``MARGIN`` away from its faces so that float32 keeps the cell."""
    return MARGIN + (1 - 2 * MARGIN) * uniform


def rotation(axis: list[float], degrees: float) -> np.ndarray:
    """(3, 3) rotation matrix about ``axis`` (Rodrigues)."""
    x, y, z = (component / math.sqrt(sum(c * c for c in axis)) for component in axis)
    cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return cos * np.eye(3) + sin * cross + (1 - cos) * np.outer((x, y, z), (x, y, z))


GENERATORS: dict[str, Generator] = {"random": random, "uniform_cube": uniform_cube}
