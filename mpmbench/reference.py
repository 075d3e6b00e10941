"""The answer: P2G and G2P in plain float64 NumPy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Nodes:
    """What P2G makes: mass (nx, ny, nz) [kg] and momentum (nx, ny, nz, 3) [kg m/s] of every node."""

    mass: np.ndarray
    momentum: np.ndarray


@dataclass(frozen=True, eq=False)
class ParticleValues:
    """What G2P makes: velocity (n, 3) [m/s] and, for payload APIC, affine C (n, 3, 3) [1/s]."""

    velocity: np.ndarray
    affine: np.ndarray | None = None
