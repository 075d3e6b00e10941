"""Linear, quadratic and cubic B-splines in float64: support, weights, derivatives (thesis eq. 74 for the cubic one).

A particle at xi (in units of dx) is binned by its bin node b = floor(xi - shift), one per axis; its support on an axis
is the nodes b - left ... b + right. The weight of node i is N(xi - i), in three dimensions the product over the axes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mpmbench.errors import InputError


@dataclass(frozen=True)
class Spline:
    """One B-spline.

    nodes: support per axis.  shift: of the bin node, b = floor(xi - shift).
    left, right: the support is b - left ... b + right.
    affine_factor: k with C = (k / dx**2) B, the inverse of D_p = dx**2 / k (thesis appendix A for the cubic one); None
    for the linear spline, whose D_p is singular at nodes.
    reach: largest distance |xi - i| of a node in the support, in units of dx.
    """

    name: str
    nodes: int
    shift: float
    left: int
    right: int
    affine_factor: float | None

    @property
    def reach(self) -> float:
        return self.nodes / 2

    def bin_node(self, xi: np.ndarray) -> np.ndarray:
        """int64 bin node of each coordinate of xi (any shape, float32 or float64)."""
        return np.floor(xi - xi.dtype.type(self.shift)).astype(np.int64)

    def weights(self, xi: np.ndarray, bin_node: np.ndarray) -> np.ndarray:
        """(nodes, n) weights of the nodes bin_node - left ... bin_node + right for xi (n,)."""
        f = xi - bin_node
        if self.name == "linear":
            return np.stack([1 - f, f])
        if self.name == "quadratic":
            return np.stack([0.5 * (1.5 - f) ** 2, 0.75 - (f - 1) ** 2, 0.5 * (f - 0.5) ** 2])
        return np.stack(
            [
                (1 - f) ** 3 / 6,
                f**3 / 2 - f**2 + 2 / 3,
                (1 - f) ** 3 / 2 - (1 - f) ** 2 + 2 / 3,
                f**3 / 6,
            ]
        )

    def gradients(self, xi: np.ndarray, bin_node: np.ndarray) -> np.ndarray:
        """(nodes, n) derivatives of ``weights`` by xi [1]; divide by dx for a gradient in space."""
        f = xi - bin_node
        if self.name == "linear":
            return np.stack([-np.ones_like(f), np.ones_like(f)])
        if self.name == "quadratic":
            return np.stack([f - 1.5, -2 * (f - 1), f - 0.5])
        return np.stack(
            [
                -((1 - f) ** 2) / 2,
                1.5 * f**2 - 2 * f,
                -1.5 * (1 - f) ** 2 + 2 * (1 - f),
                f**2 / 2,
            ]
        )


SPLINES: dict[str, Spline] = {
    "linear": Spline("linear", nodes=2, shift=0.0, left=0, right=1, affine_factor=None),
    "quadratic": Spline("quadratic", nodes=3, shift=0.5, left=0, right=2, affine_factor=4.0),
    "cubic": Spline("cubic", nodes=4, shift=0.0, left=1, right=2, affine_factor=3.0),
}


def get_spline(name: str | Spline) -> Spline:
    """The spline of that name, or InputError naming the valid ones."""
    if isinstance(name, Spline):
        return name
    if name not in SPLINES:
        raise InputError(f"unknown spline {name!r}: valid are {', '.join(SPLINES)}")
    return SPLINES[name]
