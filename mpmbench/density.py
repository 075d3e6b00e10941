"""Density and order of a dataset's particles: what decides which strategy wins on it."""

from __future__ import annotations

from typing import Any

import numpy as np

from mpmbench.grid import Grid, Triple

BLOCK_SHAPE: Triple = (8, 4, 4)  # of the blocks that are counted as occupied


def statistics(xi: np.ndarray, grid: Grid) -> dict[str, Any]:
    """Numbers for the report, from xi (n, 3) in node units and in memory order.

    A cell is counted by its lowest node, floor(xi). Neighbours in memory are particles p and p + 1; "near" is the same
    cell or one that touches it; a jump is the distance between them in cells. histogram: cells by particles in them, in
    bins of powers of two ("3-4": cells with 3 or 4 particles).
    """
    cell = np.floor(xi).astype(np.int64)
    # Sorted, not counted into an array of all cells: a grid may be far larger than what its particles fill.
    counts = np.unique(np.ravel_multi_index(tuple(cell.T), grid.shape), return_counts=True)[1]
    blocks = np.unique(np.ravel_multi_index(tuple((cell // BLOCK_SHAPE).T), grid.blocks(BLOCK_SHAPE)))
    step = np.abs(np.diff(cell, axis=0)).max(axis=1, initial=0)
    jump = np.linalg.norm(np.diff(xi, axis=0), axis=1)
    return {
        "occupied_cells": len(counts),
        "occupied_blocks_8x4x4": len(blocks),
        "mean_per_occupied_cell": float(counts.mean()) if len(counts) else 0.0,
        "max_per_cell": int(counts.max(initial=0)),
        "same_cell_fraction": float((step == 0).mean()) if len(step) else 0.0,
        "near_cell_fraction": float((step <= 1).mean()) if len(step) else 0.0,
        "mean_jump_cells": float(jump.mean()) if len(jump) else 0.0,
        "histogram": _histogram(counts),
    }


def _histogram(counts: np.ndarray) -> dict[str, int]:
    """Number of cells by powers of two of their particles."""
    histogram = {}
    high = 1
    while len(counts) and high < 2 * counts.max():
        low = high // 2 + 1
        histogram[str(high) if low == high else f"{low}-{high}"] = int(((counts >= low) & (counts <= high)).sum())
        high *= 2
    return histogram
