"""Particles some steps after a sort: neither in order nor in disorder, what a simulation sorts most of the time.

The CFL condition keeps a particle from moving further than a cell in a step, so that k steps after a sort it is at most
k cells from where the order puts it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mpmbench.dataset import Dataset
from mpmbench.errors import InputError
from mpmbench.recipes import MARGIN, Uniform
from mpmbench.spline import get_spline

COURANT = 0.5  # cells per step and axis that the fastest particle moves


def in_bin_order(dataset: Dataset, spline: str = "cubic") -> Dataset:
    """The particles sorted by bin, bins numbered x fastest; inside a bin they keep their order."""
    i, j, k = get_spline(spline).bin_node(dataset.node_units(np.float32)).T
    nx, ny, _ = dataset.grid.shape
    order = np.argsort((k * ny + j) * nx + i, kind="stable")
    return replace(
        dataset,
        position=dataset.position[order],
        velocity=dataset.velocity[order],
        affine=dataset.affine[order],
        mass=dataset.mass[order],
        order="by bin",
    )


def after_steps(dataset: Dataset, steps: int, seed: int, courant: float = COURANT) -> Dataset:
    """The particles sorted by bin, then moved ``steps`` steps; in memory they keep the order of that sort.

    Each has a constant velocity, uniform up to ``courant`` cells per step on each axis, and is reflected where the
    support of any spline would leave the grid. Other attributes stay as they are.
    """
    if steps < 0 or not 0 <= courant <= 1:
        raise InputError(f"motion: {steps} steps of up to {courant:g} cells; want steps >= 0 and 0 to 1 cells (CFL)")
    ordered = in_bin_order(dataset)
    xi = ordered.node_units(np.float64)
    xi = xi + steps * courant * (2 * Uniform(seed)("motion", len(xi), 3) - 1)
    extent = np.array(dataset.grid.shape) - 3.0
    folded = np.abs((xi - 1 + extent) % (2 * extent) - extent)
    inside = 1 + np.clip(folded, MARGIN, extent - MARGIN)
    position = np.array(dataset.grid.origin) + dataset.grid.dx * inside
    return replace(ordered, position=position, order=f"{steps} steps after a sort")
