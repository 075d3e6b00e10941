"""Totals of mass, momentum and angular momentum, added exactly: what a transfer must keep.

``math.fsum`` rounds once, whatever the number of terms: what a total has lost was lost by the kernels and not by adding
up. Terms are formed in float64, where the product of two float32 numbers is exact.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mpmbench.grid import Grid


@dataclass(frozen=True)
class Totals:
    """mass [kg], momentum (3,) [kg m/s], angular momentum (3,) about node (0, 0, 0) [kg m^2/s]."""

    mass: float
    momentum: np.ndarray
    angular: np.ndarray


def exact_sum(values: np.ndarray) -> float:
    """The sum of all values, rounded once."""
    return math.fsum(np.asarray(values, dtype=np.float64).ravel().tolist())


def sequential_sum(values: np.ndarray) -> float:
    """The sum in the values' own number type, one after another: one accumulator."""
    flat = np.ascontiguousarray(values).ravel()
    return float(np.add.accumulate(flat)[-1]) if flat.size else 0.0


def pairwise_sum(values: np.ndarray) -> float:
    """The sum in the values' own number type, as a tree: NumPy's own order."""
    return float(np.ascontiguousarray(values).ravel().sum())


def node_totals(nodes: np.ndarray, grid: Grid) -> Totals:
    """Of (nodes, 4) momentum and mass in device order."""
    filled = np.flatnonzero(nodes[:, 3])
    values = nodes[filled].astype(np.float64)
    nx, ny, _ = grid.shape
    arm = grid.dx * np.stack([filled % nx, filled // nx % ny, filled // (nx * ny)], axis=1)
    momentum = values[:, :3]
    return Totals(exact_sum(values[:, 3]), _per_axis(momentum), _moment(arm, momentum))


def particle_totals(attributes: np.ndarray, grid: Grid, affine_factor: float | None) -> Totals:
    """Of (attributes, n, 4) as kernels hold them: position and mass, velocity, and for APIC the rows of C.

    affine_factor: k of D = dx**2 / k. The angular momentum of a particle is m x cross v, and for APIC
    m (dx**2 / k) eps:C on top, what its affine part gives to the nodes.
    """
    values = attributes.astype(np.float64)
    mass = values[0, :, 3:]
    arm = values[0, :, :3] - np.array(grid.origin)
    momentum = mass * values[1, :, :3]
    angular = _moment(arm, momentum)
    if len(values) > 2 and affine_factor is not None:
        inertia = mass[:, 0] * grid.dx**2 / affine_factor
        rows = values[2:, :, :3]  # rows[a, p, b] = C_ab of particle p
        angular = angular + np.array(
            [exact_sum(np.concatenate([inertia * rows[c, :, b], -inertia * rows[b, :, c]])) for b, c in _PLANES]
        )
    return Totals(exact_sum(mass), _per_axis(momentum), angular)


_PLANES = ((1, 2), (2, 0), (0, 1))  # of the rotations about x, y and z


def _per_axis(vectors: np.ndarray) -> np.ndarray:
    return np.array([exact_sum(vectors[:, axis]) for axis in range(3)])


def _moment(arm: np.ndarray, momentum: np.ndarray) -> np.ndarray:
    """Sum of arm cross momentum."""
    return np.array(
        [exact_sum(np.concatenate([arm[:, b] * momentum[:, c], -arm[:, c] * momentum[:, b]])) for b, c in _PLANES]
    )
