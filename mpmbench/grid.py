"""The background grid: nodes, cells and blocks, and the one index convention that every array follows.

Node (i, j, k) sits at ``origin + dx * (i, j, k)``. In device memory x runs fastest: ``(k * ny + j) * nx + i``, because
neighbouring lanes are neighbouring in x. On the host, node arrays have shape (nx, ny, nz[, components]).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

Triple = tuple[int, int, int]


@dataclass(frozen=True)
class Grid:
    """A uniform grid.

    shape: nodes per axis (nx, ny, nz).  dx: spacing [m].  origin: position of node (0, 0, 0) [m].
    """

    shape: Triple
    dx: float
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def node_count(self) -> int:
        nx, ny, nz = self.shape
        return nx * ny * nz

    def blocks(self, block_shape: Triple) -> Triple:
        """Blocks per axis; the last one of an axis may reach past the grid."""
        return tuple(-(-n // b) for n, b in zip(self.shape, block_shape, strict=True))  # type: ignore[return-value]

    def to_device_order(self, nodes: np.ndarray) -> np.ndarray:
        """(nx, ny, nz, c) host array -> (nodes, c) in device order, x fastest."""
        return np.ascontiguousarray(nodes.transpose(2, 1, 0, 3)).reshape(self.node_count, -1)

    def to_host_order(self, nodes: np.ndarray) -> np.ndarray:
        """(nodes, c) in device order -> (nx, ny, nz, c) view."""
        nx, ny, nz = self.shape
        return nodes.reshape(nz, ny, nx, -1).transpose(2, 1, 0, 3)
