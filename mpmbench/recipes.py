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
    """Cells of a cube with exactly k jittered particles each, the last layer partial so that n is exact."""
    count, per_cell = recipe["particles"], recipe["particles_per_cell"]
    xi = cube_cells(grid, count, per_cell) + jitter(uniform("position", count, 3))
    if recipe["order"] == "random":
        return shuffled(xi, uniform)
    spacing = per_cell ** (-1 / 3)  # of a lattice with k points per cell
    turned = xi @ rotation(recipe["rotation_axis"], recipe["rotation_degrees"])
    site = np.floor(turned / spacing).astype(np.int64)
    return xi[np.lexsort((site[:, 0], site[:, 1], site[:, 2]))]  # x fastest, as a lattice would be stored


def lattice(grid: Grid, recipe: dict[str, Any], uniform: Uniform) -> np.ndarray:
    """s x s x s particles at the same places in every cell of a cube, one cell after the other."""
    count, per_cell = recipe["particles"], recipe["particles_per_cell"]
    side = round(per_cell ** (1 / 3))
    if side**3 != per_cell:
        raise InputError(f"a lattice has a cube number of particles per cell (1, 8, 27, ...), not {per_cell}")
    site = np.arange(count) % per_cell
    place = np.stack([site % side, site // side % side, site // side**2], axis=1)
    return cube_cells(grid, count, per_cell) + (place + 0.5) / side


def one_cell(grid: Grid, recipe: dict[str, Any], uniform: Uniform) -> np.ndarray:
    """All particles in the cell at the middle of the grid."""
    middle = [1 + cells // 2 for cells in free_cells(grid)]
    return middle + jitter(uniform("position", recipe["particles"], 3))


def sheet(grid: Grid, recipe: dict[str, Any], uniform: Uniform) -> np.ndarray:
    """As few sheets as hold n, each one cell thick with k jittered particles per cell, rising one cell in four."""
    count, per_cell = recipe["particles"], recipe["particles_per_cell"]
    wide, deep, high = free_cells(grid)
    check_room(grid, count, per_cell)
    cell = np.arange(count) // per_cell
    sheets = max(1, -(-int(cell.max(initial=-1) + 1) // (wide * deep)))
    x, y, level = cell % wide, cell // wide % deep, cell // (wide * deep)
    z = (level * high // sheets + (x + y) // 4) % high  # sheets keep their distance, also over the wrap
    xi = 1 + np.stack([x, y, z], axis=1) + jitter(uniform("position", count, 3))
    return shuffled(xi, uniform)


def clustered(grid: Grid, recipe: dict[str, Any], uniform: Uniform) -> np.ndarray:
    """Spherical clusters whose number density falls as r**-exponent, folded back into the box at its faces."""
    count, clusters, exponent = recipe["particles"], recipe["clusters"], recipe["density_exponent"]
    extent = np.array(free_cells(grid), dtype=np.float64)
    centre = extent * uniform("centre", clusters, 3)
    member = (clusters * uniform("member", count)).astype(np.int64)
    radius = extent.max() / 4 * uniform("radius", count) ** (1 / (3 - exponent))
    cos_polar, azimuth = (numbers := uniform("direction", count, 2))[:, 0] * 2 - 1, 2 * np.pi * numbers[:, 1]
    sin_polar = np.sqrt(1 - cos_polar**2)
    direction = np.stack([sin_polar * np.cos(azimuth), sin_polar * np.sin(azimuth), cos_polar], axis=1)
    folded = np.abs((centre[member] + radius[:, None] * direction) % (2 * extent) - extent)
    return 1 + np.clip(folded, MARGIN, extent - MARGIN)


def cube_cells(grid: Grid, count: int, per_cell: int) -> np.ndarray:
    """(n, 3) cell of each particle: k per cell of a centred cube, x fastest, so that the top z layer may be partial.

    On a grid too flat for the cube, the region is cut to the grid and grows along the other axes.
    """
    free = free_cells(grid)
    wanted = check_room(grid, count, per_cell)
    edge = 1
    while math.prod(min(edge, cells) for cells in free) < wanted:
        edge += 1
    region = [min(edge, cells) for cells in free]
    low = [1 + (cells - taken) // 2 for cells, taken in zip(free, region, strict=True)]
    cell = np.arange(count) // per_cell
    index = np.stack([cell % region[0], cell // region[0] % region[1], cell // (region[0] * region[1])], axis=1)
    return low + index


def check_room(grid: Grid, count: int, per_cell: int) -> int:
    """Cells that n particles fill, or InputError where the grid has not as many."""
    wanted, room = -(-count // per_cell), math.prod(free_cells(grid))
    if wanted > room:
        raise InputError(
            f"{count} particles at {per_cell} per cell need {wanted} cells, but grid {grid.shape} has room for {room}: "
            "take fewer particles, more per cell or a larger grid"
        )
    return wanted


def shuffled(xi: np.ndarray, uniform: Uniform) -> np.ndarray:
    """Rows of xi in random order."""
    return xi[np.argsort(uniform("order", len(xi)), kind="stable")]


def jitter(uniform: np.ndarray) -> np.ndarray:
    """Uniform numbers to offsets inside a cell, ``MARGIN`` away from its faces so that float32 keeps the cell."""
    return MARGIN + (1 - 2 * MARGIN) * uniform


def rotation(axis: list[float], degrees: float) -> np.ndarray:
    """(3, 3) rotation matrix about ``axis`` (Rodrigues)."""
    x, y, z = (component / math.sqrt(sum(c * c for c in axis)) for component in axis)
    cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return cos * np.eye(3) + sin * cross + (1 - cos) * np.outer((x, y, z), (x, y, z))


GENERATORS: dict[str, Generator] = {
    "random": random,
    "uniform_cube": uniform_cube,
    "clustered": clustered,
    "one_cell": one_cell,
    "lattice": lattice,
    "sheet": sheet,
}
