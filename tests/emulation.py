"""P2G and G2P in NumPy float32 or float64, each operation rounded, terms added one after the other: stands in for a
kernel where the check itself is tested. Weights are evaluated in the two textbook ways that kernels use."""

from __future__ import annotations

import numpy as np

from mpmbench.dataset import Dataset
from mpmbench.reference import Nodes, ParticleValues
from mpmbench.spline import Spline, get_spline


def weights_1d(spline: Spline, xi: np.ndarray, node: np.ndarray, unity: bool) -> np.ndarray:
    """(K, n) weights of support nodes from |xi - i| (plain), or with one inner weight as one minus the others."""
    real = xi.dtype.type
    d = np.abs(xi - (node + np.arange(spline.nodes)[:, None] - spline.left).astype(real))
    if spline.name == "linear":
        w = real(1) - d
        inner = 1
    elif spline.name == "quadratic":
        t = real(1.5) - d
        w = np.where(d < 0.5, real(0.75) - d * d, real(0.5) * t * t)
        inner = 1
    else:
        t = real(2) - d
        w = np.where(d < 1, real(0.5) * d * d * d - d * d + real(2 / 3), real(1 / 6) * t * t * t)
        inner = 2
    if unity:
        others = [k for k in range(spline.nodes) if k != inner]
        total = w[others[0]]
        for k in others[1:]:
            total = total + w[k]
        w[inner] = real(1) - total
    return w


class Emulation:
    """One dataset and set of axes; ``order`` is a permutation of the particles."""

    def __init__(
        self,
        dataset: Dataset,
        spline: str,
        payload: str,
        dtype: str,
        unity: bool = True,
        order: np.ndarray | None = None,
    ) -> None:
        self.dataset, self.spline, self.apic = dataset, get_spline(spline), payload == "apic"
        self.real = np.dtype(dtype).type
        order = np.arange(dataset.particle_count) if order is None else order
        self.order = order
        xi = dataset.node_units(dtype)[order]
        node = self.spline.bin_node(xi)
        self.velocity = dataset.velocity.astype(dtype)[order]
        self.affine = dataset.affine.astype(dtype)[order]
        self.mass = dataset.mass.astype(dtype)[order]
        self.dx, self.inv_dx = self.real(dataset.grid.dx), self.real(1 / dataset.grid.dx)
        self.w = [weights_1d(self.spline, xi[:, a], node[:, a], unity) for a in range(3)]
        self.node, self.xi = node, xi

    def support(self):
        """For every support node: index arrays (i, j, k), weight (n,), distance x_i - x_p (n, 3) [m]."""
        for offset in np.ndindex(3 * (self.spline.nodes,)):
            index = self.node + np.array(offset) - self.spline.left
            weight = self.w[0][offset[0]] * self.w[1][offset[1]] * self.w[2][offset[2]]
            distance = (index.astype(self.real) - self.xi) * self.dx
            yield tuple(index.T), weight, distance, offset

    def p2g(self) -> Nodes:
        mass = np.zeros(self.dataset.grid.shape, self.real)
        momentum = np.zeros((*self.dataset.grid.shape, 3), self.real)
        for index, weight, distance, _ in self.support():
            share = weight * self.mass
            velocity = self.velocity
            if self.apic:
                row = self.affine[:, :, 0] * distance[:, None, 0]
                for a in (1, 2):
                    row = row + self.affine[:, :, a] * distance[:, None, a]
                velocity = velocity + row
            np.add.at(mass, index, share)
            for c in range(3):
                np.add.at(momentum[..., c], index, share * velocity[:, c])
        return Nodes(mass, momentum)

    def g2p(self, node_velocity: np.ndarray) -> ParticleValues:
        field = node_velocity.astype(self.real)
        n = len(self.order)
        velocity, affine = np.zeros((n, 3), self.real), np.zeros((n, 3, 3), self.real)
        factor = self.spline.affine_factor
        for index, weight, distance, offset in self.support():
            v = field[index]
            velocity += weight[:, None] * v
            if not self.apic:
                continue
            if factor is not None:
                affine += (weight[:, None] * v)[:, :, None] * distance[:, None, :]
            else:
                for a in range(3):
                    b, c = (x for x in range(3) if x != a)
                    slope = self.real(2 * offset[a] - 1) * self.w[b][offset[b]] * self.w[c][offset[c]]
                    affine[:, :, a] += (slope * self.inv_dx)[:, None] * v
        if factor is not None:
            affine *= self.real(factor) * self.inv_dx * self.inv_dx
        back = np.empty(n, int)
        back[self.order] = np.arange(n)
        return ParticleValues(velocity[back], affine[back] if self.apic else None)
