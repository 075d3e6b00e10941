"""The answer: P2G, grid division and G2P in plain float64 NumPy, with the sums that bound a kernel's rounding.

Inputs are first rounded to the kernel's dtype, so that a kernel is never blamed for what its inputs lost. From there on
everything is float64, the particle's place in its cell included; only the bin node is taken from the dtype, because the
linear spline's gradient jumps at cell faces and a particle must have one cell there.

Transfers are those of thesis section 4.5: mass (eq. 75), PIC momentum (eq. 77) and velocity (eq. 80), APIC momentum
(eq. 86) and affine (eqs. 85, 90 with fixed particle positions, 91).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from mpmbench.dataset import Dataset
from mpmbench.errors import InputError
from mpmbench.spline import Spline, get_spline

PAYLOADS = ("pic", "apic")
# Particles handled at once: few enough that all weights of their supports stay in the processor's cache.
CHUNK = 4096


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


@dataclass(frozen=True, eq=False)
class Sums:
    """Sums over the terms of each result, from which ``check`` makes its allowance; shapes follow the result.

    A result is a sum of terms f(xi) q: weight (or weight times distance) f and quantity q.
    weighted: sum |f q|.  gradient: sum |q| |grad f|, the 1-norm of the gradient by xi.  plain: sum |q| over the support
    and one node beyond it.  terms: how many particles add to a node, or nodes to a particle.
    """

    weighted: np.ndarray
    gradient: np.ndarray
    plain: np.ndarray
    terms: np.ndarray


@dataclass(frozen=True, eq=False)
class Reference:
    """A float64 result and how it was asked for.

    value: components first, (4, nx, ny, nz) mass and momentum for P2G; (3, n) velocity or (12, n) velocity and rows of
    C for G2P.  max_xi: the largest |xi| of a particle, at least 1.
    """

    dataset: Dataset
    spline: Spline
    payload: str
    dtype: np.dtype
    value: np.ndarray
    sums: Sums
    max_xi: float


@dataclass(frozen=True, eq=False)
class ReferenceNodes(Reference):
    """The answer of P2G."""

    @property
    def nodes(self) -> Nodes:
        return Nodes(self.value[0], np.moveaxis(self.value[1:], 0, -1))


@dataclass(frozen=True, eq=False)
class ReferenceParticles(Reference):
    """The answer of G2P."""

    @property
    def particles(self) -> ParticleValues:
        n = self.value.shape[1]
        affine = self.value[3:].T.reshape(n, 3, 3) if self.payload == "apic" else None
        return ParticleValues(self.value[:3].T, affine)


def p2g(dataset: Dataset, spline: str | Spline, payload: str = "pic", dtype: Any = "float32") -> ReferenceNodes:
    """Mass and momentum of every node (thesis eqs. 75, 77; 86 for payload "apic")."""
    inputs = _Inputs(dataset, get_spline(spline), payload, dtype)
    spline, apic, nodes = inputs.spline, payload == "apic", dataset.grid.node_count
    value, weighted, gradient = (np.zeros((4, nodes)) for _ in range(3))
    # A particle's largest term |m (v + C (x_i - x_p))| per component, wherever the node is in the support.
    magnitude = np.abs(inputs.velocity)
    if apic:
        magnitude = magnitude + spline.reach * inputs.dx * np.abs(inputs.affine).sum(axis=1)
    magnitude = inputs.mass * np.concatenate([np.ones((1, inputs.count)), magnitude])

    for support in inputs.supports():
        part = support.particles
        span = slice(support.node.min(), support.node.max() + 1)
        node = (support.node - span.start).ravel()

        def add(total: np.ndarray, terms: np.ndarray, node: np.ndarray = node, span: slice = span) -> None:
            total[span] += np.bincount(node, terms.ravel(), minlength=span.stop - span.start)

        mass_share = support.weight * inputs.mass[part]
        add(value[0], mass_share)
        for axis in range(3):
            velocity = inputs.velocity[axis, part]
            if apic:
                velocity = velocity + inputs.dx * support.affine_part(inputs.affine[axis][:, part])
            add(value[1 + axis], mass_share * velocity)
            add(weighted[1 + axis], support.weight * magnitude[1 + axis, part])
        for component in range(4):
            add(gradient[component], support.gradient * magnitude[component, part])
    weighted[0] = value[0]
    if apic:
        # The distance to the node is as uncertain as xi itself: |m w C dx| is at most |w| times the magnitude.
        gradient[1:] += weighted[1:]

    shape = dataset.grid.shape
    flat_bin = np.ravel_multi_index(tuple(inputs.bin_node), shape)
    plain = np.stack(
        [_spread(np.bincount(flat_bin, magnitude[c], minlength=nodes).reshape(shape), spline) for c in range(4)]
    )
    binned = np.bincount(flat_bin, minlength=nodes).reshape(shape).astype(np.float64)
    terms = _box_sum(binned, -spline.right, spline.left)
    sums = Sums(weighted.reshape(4, *shape), gradient.reshape(4, *shape), plain, terms)
    return ReferenceNodes(dataset, spline, payload, inputs.dtype, value.reshape(4, *shape), sums, inputs.max_xi)


def grid_divide(nodes: Nodes) -> np.ndarray:
    """(nx, ny, nz, 3) velocity [m/s] = momentum / mass (thesis eq. 78); zero where a node has no mass."""
    mass = np.asarray(nodes.mass, dtype=np.float64)[..., None]
    momentum = np.asarray(nodes.momentum, dtype=np.float64)
    return np.divide(momentum, mass, out=np.zeros_like(momentum), where=mass > 0)


def g2p(
    dataset: Dataset,
    node_velocity: np.ndarray,
    spline: str | Spline,
    payload: str = "pic",
    dtype: Any = "float32",
) -> ReferenceParticles:
    """Velocity of every particle (thesis eq. 80) and, for payload "apic", C.

    node_velocity: (nx, ny, nz, 3) [m/s].  C = (k / dx**2) sum w v_i (x_i - x_p)^T for the quadratic (k = 4) and cubic
    (k = 3) splines, sum v_i (grad w)^T for the linear one.
    """
    inputs = _Inputs(dataset, get_spline(spline), payload, dtype)
    spline, apic, n = inputs.spline, payload == "apic", inputs.count
    if np.shape(node_velocity) != (*dataset.grid.shape, 3):
        raise InputError(
            f"node velocity has shape {np.shape(node_velocity)}, want {(*dataset.grid.shape, 3)} as the grid has"
        )
    field = np.moveaxis(np.asarray(node_velocity).astype(inputs.dtype).astype(np.float64), -1, 0)
    flat = np.ascontiguousarray(field).reshape(3, -1)
    value = np.zeros((12 if apic else 3, n))
    weighted, gradient, mixed = (np.zeros((3, n)) for _ in range(3))
    for support in inputs.supports():
        part = support.particles
        for axis in range(3):
            velocity = flat[axis][support.node]
            value[axis, part] = _total(support.weight * velocity)
            speed = np.abs(velocity)
            weighted[axis, part] = _total(support.weight * speed)
            gradient[axis, part] = _total(support.gradient * speed)
            if apic:
                for column, factor in enumerate(support.affine_factors()):
                    value[3 + 3 * axis + column, part] = _total(factor * velocity) / inputs.dx
                if spline.affine_factor is None:
                    mixed[axis, part] = _total(support.mixed_gradient() * speed)
    plain = np.stack([_collect(np.abs(field[c]), spline)[tuple(inputs.bin_node)] for c in range(3)])
    if apic:
        if spline.affine_factor is None:
            rows = (gradient / inputs.dx, mixed / inputs.dx, plain / inputs.dx)
        else:
            scale = spline.affine_factor * spline.reach / inputs.dx
            # f = w d with |d| <= reach: |grad f| <= |grad w| reach + w.
            rows = (
                scale * weighted,
                scale * (gradient + weighted / spline.reach),
                scale * plain,
            )
        weighted, gradient, plain = (
            np.concatenate([velocity_row, np.repeat(row, 3, axis=0)])
            for velocity_row, row in zip((weighted, gradient, plain), rows, strict=True)
        )
    sums = Sums(weighted, gradient, plain, np.full(n, float(spline.nodes**3)))
    # Sums were made in bin order; a reference is in the dataset's order.
    back = np.empty_like(inputs.sorting)
    back[inputs.sorting] = np.arange(n)
    sums = Sums(weighted[:, back], gradient[:, back], plain[:, back], sums.terms)
    return ReferenceParticles(dataset, spline, payload, inputs.dtype, value[:, back], sums, inputs.max_xi)


class _Inputs:
    """A dataset's arrays rounded to a dtype, then float64 again; component first, sorted by bin node.

    xi (3, n) and bin_node (3, n); velocity (3, n) [m/s], affine (3, 3, n) [1/s], mass (n,) [kg], dx [m].
    """

    def __init__(self, dataset: Dataset, spline: Spline, payload: str, dtype: Any) -> None:
        if payload not in PAYLOADS:
            raise InputError(f"unknown payload {payload!r}: valid are {', '.join(PAYLOADS)}")
        self.dtype = np.dtype(dtype)
        if self.dtype not in (np.float32, np.float64):
            raise InputError(f"unknown dtype {dtype!r}: valid are float32, float64")
        self.spline = spline
        self.grid = dataset.grid
        dataset.check_support(spline, self.dtype)

        bin_node = spline.bin_node(dataset.node_units(self.dtype)).T
        self.sorting = np.argsort(np.ravel_multi_index(tuple(bin_node), self.grid.shape), kind="stable")
        self.bin_node = np.ascontiguousarray(bin_node[:, self.sorting])
        self.count = len(self.sorting)

        def rounded(array: Any) -> np.ndarray:
            return np.asarray(array).astype(self.dtype).astype(np.float64)

        inv_dx = rounded(1 / self.grid.dx)
        xi = (rounded(dataset.position) - rounded(self.grid.origin)) * inv_dx
        self.xi = np.ascontiguousarray(xi[self.sorting].T)
        self.velocity = np.ascontiguousarray(rounded(dataset.velocity)[self.sorting].T)
        self.affine = np.ascontiguousarray(np.moveaxis(rounded(dataset.affine)[self.sorting], 0, -1))
        self.mass = rounded(dataset.mass)[self.sorting]
        self.dx = float(rounded(self.grid.dx))
        self.max_xi = max(1.0, float(np.abs(xi).max(initial=0.0)))

    def supports(self) -> Iterator[_Support]:
        """The supports of all particles, a chunk of sorted neighbours at a time."""
        for start in range(0, self.count, CHUNK):
            yield _Support(self, slice(start, min(start + CHUNK, self.count)))


class _Support:
    """The support nodes of some particles. Arrays are (K, K, K, m): K nodes per axis, m particles.

    weight; gradient: sum over the axes of |d weight / d xi|; node: index into the flattened (nx, ny, nz) grid.
    """

    def __init__(self, inputs: _Inputs, particles: slice) -> None:
        spline, (_, ny, nz) = inputs.spline, inputs.grid.shape
        self.spline = spline
        self.particles = particles
        xi, bin_node = inputs.xi[:, particles], inputs.bin_node[:, particles]
        along_x, along_y, along_z = np.s_[:, None, None], np.s_[None, :, None], np.s_[None, None, :]
        self._along = (along_x, along_y, along_z)
        self._weight = [spline.weights(xi[a], bin_node[a])[self._along[a]] for a in range(3)]
        self._slope = [spline.gradients(xi[a], bin_node[a])[self._along[a]] for a in range(3)]
        offset = np.arange(spline.nodes)[:, None] - spline.left
        node = [(bin_node[a] + offset)[self._along[a]] for a in range(3)]
        # (3 x K, m) distance x_i - x_p in units of dx
        self._distance = [node[a] - xi[a] for a in range(3)]

        (wx, wy, wz), (gx, gy, gz) = self._weight, [np.abs(slope) for slope in self._slope]
        self.weight = wx * (wy * wz)
        self.gradient = gx * (wy * wz) + wx * (gy * wz + wy * gz)
        self.node = (node[0] * ny + node[1]) * nz + node[2]

    def affine_part(self, row: np.ndarray) -> np.ndarray:
        """Row (3, m) of C times x_i - x_p in units of dx."""
        x, y, z = self._distance
        return row[0] * x + (row[1] * y + row[2] * z)

    def affine_factors(self) -> list[np.ndarray]:
        """What multiplies v_i / dx in each column of C: k w d, or the derivative of w for the linear spline."""
        if self.spline.affine_factor is not None:
            scaled = self.spline.affine_factor * self.weight
            return [scaled * distance for distance in self._distance]
        (wx, wy, wz), (gx, gy, gz) = self._weight, self._slope
        return [gx * (wy * wz), wx * (gy * wz), wx * (wy * gz)]

    def mixed_gradient(self) -> np.ndarray:
        """Sum over pairs of axes of |d^2 weight / d xi_a d xi_b|."""
        (wx, wy, wz), (gx, gy, gz) = self._weight, [np.abs(slope) for slope in self._slope]
        return gx * (gy * wz + wy * gz) + wx * (gy * gz)


def _total(terms: np.ndarray) -> np.ndarray:
    """(m,) sum over the support of (K, K, K, m) terms."""
    return terms.sum(axis=(0, 1, 2))


def _spread(binned: np.ndarray, spline: Spline) -> np.ndarray:
    """Sum over the particles whose support, one node wider than it is, holds the node; ``binned`` is by bin node."""
    return _box_sum(binned, -spline.right - 1, spline.left + 1)


def _collect(nodal: np.ndarray, spline: Spline) -> np.ndarray:
    """Sum over the support, one node wider than it is, of a particle in each bin."""
    return _box_sum(nodal, -spline.left - 1, spline.right + 1)


def _box_sum(array: np.ndarray, first: int, last: int) -> np.ndarray:
    """out[i] = sum of array[i + o] for o = first ... last along every axis, zero beyond the grid."""
    for axis in range(3):
        source = np.moveaxis(array, axis, 0)
        total = np.zeros_like(source)
        n = len(source)
        for offset in range(max(first, -n), min(last, n) + 1):
            total[max(0, -offset) : n - max(0, offset)] += source[max(0, offset) : n + min(0, offset)]
        array = np.moveaxis(total, 0, axis)
    return array
