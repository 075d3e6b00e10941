"""Scan inside every block of a grid, from the scan of the whole grid (thesis appendix B, eqs. 147 to 155)."""

from __future__ import annotations

import numpy as np

from mpmbench.check import CheckResult
from mpmbench.discovery import THREAD_LIMIT, Axes
from mpmbench.grid import Grid, Triple
from mpmbench.operations.scan import INT32
from mpmbench.primitives import Arrays, Operation


def grid_of(size: int) -> Grid:
    """A grid of at most ``size`` cells, as cubic as can be."""
    edge = max(1, round(size ** (1 / 3) - 1e-9))
    while edge > 1 and edge**3 > size:
        edge -= 1
    return Grid((edge, edge, max(1, size // edge**2)), 1.0)


def inputs(axes: Axes, size: int, seed: int) -> dict[str, np.ndarray]:
    """Particle counts of the cells, x fastest, and their exclusive scan with the total behind it."""
    grid = grid_of(size)
    counts = np.random.default_rng(seed).poisson(0.5, grid.node_count).astype(np.int32)
    return {"counts": counts, "scanned": np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)}


def check(inputs: Arrays, outputs: Arrays, axes: Axes) -> CheckResult:
    """Against sums over the cells of each block, exactly."""
    grid = grid_of(len(inputs["counts"]))
    expected = scanned_by_blocks(inputs["counts"], grid, axes["block_shape"])
    error = np.abs(outputs["block_scanned"].astype(np.int64) - expected)
    worst = int(np.argmax(error))
    return CheckResult(not error[worst], float(error[worst]), 0.0, "block scan", (worst,))


def scanned_by_blocks(counts: np.ndarray, grid: Grid, block_shape: Triple) -> np.ndarray:
    """The definition (eq. 150): for each cell, the sum of the cells of its block that come before it, x fastest."""
    (nx, ny, nz), (bx, by, bz) = grid.shape, block_shape
    mx, my, mz = grid.blocks(block_shape)
    padded = np.zeros((mz * bz, my * by, mx * bx), np.int64)
    padded[:nz, :ny, :nx] = counts.reshape(nz, ny, nx)
    by_block = padded.reshape(mz, bz, my, by, mx, bx).transpose(0, 2, 4, 1, 3, 5).reshape(mz, my, mx, -1)
    scanned = np.cumsum(by_block, axis=-1) - by_block
    back = scanned.reshape(mz, my, mx, bz, by, bx).transpose(0, 3, 1, 4, 2, 5).reshape(padded.shape)
    return back[:nz, :ny, :nx].reshape(-1)


def floor(axes: Axes, size: int) -> int:
    """The scan of the grid read once, that of the blocks written once."""
    return 2 * INT32 * grid_of(size).node_count


def requires(axes: Axes) -> str | None:
    """One thread per cell of a block."""
    threads = int(np.prod(axes["block_shape"]))
    return f"a block of {threads} cells has more than {THREAD_LIMIT} threads" if threads > THREAD_LIMIT else None


BLOCK_SCAN = Operation(
    name="block_scan",
    summary="scan inside each block, from the scan of the grid",
    unit="cells",
    inputs=inputs,
    check=check,
    floor=floor,
    default_size=128**3,
)
