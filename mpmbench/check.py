"""The one comparison of a result with its float64 reference, and what is conserved.

The allowance. A result is a sum of terms f(xi) q, where f is a weight (times a distance, for affine parts), q a
quantity of the particle or node, and xi = (x - origin) / dx. With u = eps / 2, the largest relative rounding of one
operation:

1. xi itself is off by at most eps max|xi| (subtract and multiply: u each). A term then moves by
   eps max|xi| |q| |grad f|: the second sum below with constant 1. ``C2`` = 2 also covers a kernel that divides by its
   own rounded dx.
2. Where f vanishes together with its gradient, at the support's edge, what remains is the second order,
   (eps max|xi|)**2 |q| |f''| / 2 with |f''| <= 7: the third sum, ``C3`` = 4. It counts one node beyond the support, so
   that a particle within rounding of a cell face may be put on either side of it; only the linear spline, with its
   jumping gradient, wants the cell that ``Dataset.node_units`` gives.
3. A term has a handful of roundings besides: 3 to 5 in each of three 1-D weights, 3 products, an APIC velocity of 6
   operations; each u of |f q| or little more, of either sign: ``C1`` = 8, or 16 roundings all of one sign. NumPy
   emulations of the textbook formulas need up to 6 without any help of 1 and 2, adding up included.
4. Adding up N terms in any order: rounding k is at most u |S_k|, and all may have one sign (identical terms: each
   rounds the same way; very unequal terms: the small ones vanish). For a sum that grows steadily the total is at most
   u N / 2 sum|f q| = eps N / 4 sum|f q|, if every rounding is the largest possible. Measured: N / 8 for identical
   particles, N / 60 for random ones in one cell. ``C_ADD`` = 1 / 8. Random signs would give sqrt(N); they are not to
   be had.

Allowed at a node or particle: eps * ((C1 + C_ADD N) sum|f q| + C2 max|xi| sum|q| |grad f|
+ C3 max|xi|**2 eps sum|q|), plus N times the smallest normal number, below which devices may flush to zero.
A bound of the form c * eps * sum|f q| alone cannot work: weights vanish at the edge of the support, roundings of xi
do not.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mpmbench.errors import InputError
from mpmbench.reference import Nodes, ParticleValues, Reference, ReferenceNodes, ReferenceParticles

C1 = 8.0
C2 = 2.0
C3 = 4.0
C_ADD = 1 / 8

AXES = "xyz"
P2G_QUANTITIES = ("mass", *(f"momentum {a}" for a in AXES))
G2P_QUANTITIES = (*(f"velocity {a}" for a in AXES), *(f"affine {a}{b}" for a in AXES for b in AXES))


@dataclass(frozen=True)
class Conserved:
    """Drift of one conserved total, and how much of it rounding explains.

    Both are relative to the total of magnitudes, sum m |v| for momentum, or absolute where that is zero.
    """

    drift: float
    allowed: float

    @property
    def passed(self) -> bool:
        return self.drift <= self.allowed  # False for NaN


@dataclass(frozen=True)
class CheckResult:
    """Verdict on one result.

    worst_error, allowed: |result - reference| and its allowance where their ratio is largest, in units of ``quantity``;
    the error is infinite where the result is not finite.
    worst_node: node (i, j, k), or particle (p,); None where there is no value at all.
    conserved: by name, "mass", "momentum" and "angular momentum" as far as the transfer promises them.
    """

    passed: bool
    worst_error: float
    allowed: float
    quantity: str = ""
    worst_node: tuple[int, ...] | None = None
    conserved: dict[str, Conserved] = field(default_factory=dict)

    @property
    def ratio(self) -> float:
        """Worst error in units of its allowance: up to 1 passes."""
        if self.worst_error == 0:
            return 0.0
        return self.worst_error / self.allowed if self.allowed > 0 else np.inf

    def __str__(self) -> str:
        """One line for a table or an error message."""
        verdict = "passed" if self.passed else "FAILED"
        if self.worst_node is None:
            return f"{verdict}: nothing to compare"
        failed = [name for name, total in self.conserved.items() if not total.passed]
        drift = f"; not conserved: {', '.join(failed)}" if failed else ""
        return (
            f"{verdict}: worst error {self.worst_error:.3g} of allowed {self.allowed:.3g} "
            f"in {self.quantity} at {self.worst_node}{drift}"
        )


def check_p2g(result: Nodes, reference: ReferenceNodes) -> CheckResult:
    """Compare node masses and momenta with the reference, and their totals with the particles'."""
    shape = reference.dataset.grid.shape
    mass = _shaped(result.mass, shape, "mass")
    momentum = _shaped(result.momentum, (*shape, 3), "momentum")
    values = np.concatenate([mass[None], np.moveaxis(momentum, -1, 0)])
    return _compare(values, reference, P2G_QUANTITIES, _conserved_p2g(values, reference))


def check_g2p(result: ParticleValues, reference: ReferenceParticles) -> CheckResult:
    """Compare particle velocities (and affine C for payload APIC) with the reference, and their totals."""
    n = reference.dataset.particle_count
    values = _shaped(result.velocity, (n, 3), "velocity").T
    if reference.payload == "apic":
        if result.affine is None:
            raise InputError("check: payload apic, but the result has no affine")
        affine = _shaped(result.affine, (n, 3, 3), "affine")
        values = np.concatenate([values, affine.reshape(n, 9).T])
    return _compare(values, reference, G2P_QUANTITIES, _conserved_g2p(values, reference))


def allowance(reference: Reference) -> np.ndarray:
    """How far a correct kernel may be from ``reference.value``, in its shape; the module's docstring derives it."""
    limits, sums = np.finfo(reference.dtype), reference.sums
    eps, max_xi = float(limits.eps), reference.max_xi
    return (
        eps
        * ((C1 + C_ADD * sums.terms) * sums.weighted + C2 * max_xi * sums.gradient + C3 * max_xi**2 * eps * sums.plain)
        + float(limits.tiny) * sums.terms
    )


def _shaped(array: np.ndarray, shape: tuple[int, ...], label: str) -> np.ndarray:
    if np.shape(array) != shape:
        raise InputError(f"check: {label} has shape {np.shape(array)}, want {shape}")
    return np.asarray(array, dtype=np.float64)


def _compare(
    values: np.ndarray, reference: Reference, quantities: tuple[str, ...], conserved: dict[str, Conserved]
) -> CheckResult:
    """The comparison: ``values`` against ``reference.value``, components first."""
    if values.size == 0:
        return CheckResult(True, 0.0, 0.0)
    allowed = allowance(reference)
    error = np.abs(values - reference.value)
    error[~np.isfinite(values)] = np.inf
    ratio = np.divide(error, allowed, out=np.where(error > 0, np.inf, 0.0), where=allowed > 0)
    worst = np.unravel_index(int(np.argmax(ratio)), ratio.shape)
    return CheckResult(
        passed=bool(ratio[worst] <= 1) and all(total.passed for total in conserved.values()),
        worst_error=float(error[worst]),
        allowed=float(allowed[worst]),
        quantity=quantities[worst[0]],
        worst_node=tuple(int(i) for i in worst[1:]),
        conserved=conserved,
    )


def _conserved_p2g(values: np.ndarray, reference: ReferenceNodes) -> dict[str, Conserved]:
    """Totals over the nodes against totals over the particles.

    A total's allowance has the terms of ``allowance``, but without what cancels: the weights of a particle sum to one
    whatever xi is, so mass and PIC momentum lack the second sum. APIC momentum also sums w C (x_i - x_p), and angular
    momentum takes node positions, both as uncertain as xi.
    """
    eps, max_xi, sums = float(np.finfo(reference.dtype).eps), reference.max_xi, reference.sums
    apic = reference.payload == "apic"
    particles = _ParticleTotals(reference)
    totals = np.array([component.sum() for component in values])
    magnitude = np.array([component.sum() for component in sums.weighted])
    rounding = np.array([((C1 + C_ADD * sums.terms) * component).sum() for component in sums.weighted])
    allowed = eps * rounding
    if apic:
        allowed[1:] += eps * C2 * max_xi * magnitude[1:]
    conserved = {
        "mass": _worst(totals[:1] - particles.mass, allowed[:1], magnitude[:1]),
        "momentum": _worst(totals[1:] - particles.momentum, allowed[1:], magnitude[1:]),
    }
    if apic and reference.spline.affine_factor is not None:
        # About node (0, 0, 0). Node coordinates are separable: plane sums do instead of a cross product per node.
        dx = reference.dataset.grid.dx
        moment = np.empty((3, 3))  # [a, c] = sum over the nodes of x_a p_c
        for a in range(3):
            others = tuple(b for b in range(3) if b != a)
            for c in range(3):
                moment[a, c] = dx * np.dot(np.arange(values.shape[1 + a]), values[1 + c].sum(axis=others))
        angular = _cross(moment)
        arm = (max_xi + reference.spline.reach) * dx
        bound = arm * allowed[1:] + eps * C2 * max_xi * dx * magnitude[1:]
        conserved["angular momentum"] = _worst(
            angular - particles.angular, bound.sum() - bound, arm * (magnitude[1:].sum() - magnitude[1:])
        )
    return conserved


def _conserved_g2p(values: np.ndarray, reference: ReferenceParticles) -> dict[str, Conserved]:
    """Totals over the particles of the result against those of the reference: what the nodes hand over."""
    max_xi, sums = reference.max_xi, reference.sums
    particles = _ParticleTotals(reference)
    mass, dx = particles.particle_mass, reference.dataset.grid.dx
    off = mass * (values - reference.value)
    allowed = mass * allowance(reference)
    magnitude = (mass * sums.weighted[:3]).sum(axis=1)
    conserved = {"momentum": _worst(off[:3].sum(axis=1), allowed[:3].sum(axis=1), magnitude)}
    if reference.payload == "apic" and reference.spline.affine_factor is not None:
        inertia = dx**2 / reference.spline.affine_factor
        moment = particles.arm.T @ off[:3].T + inertia * off[3:].sum(axis=1).reshape(3, 3).T
        bound = np.abs(particles.arm).T @ allowed[:3].T + inertia * allowed[3:].sum(axis=1).reshape(3, 3).T
        size = max_xi * dx * magnitude
        conserved["angular momentum"] = _worst(_cross(moment), _cross(bound, sign=1), size.sum() - size)
    return conserved


class _ParticleTotals:
    """Totals over the particles, from inputs rounded to the dtype.

    mass (1,), momentum (3,), angular (3,) about node (0, 0, 0): sum m (x cross v) plus the affine part
    m (dx**2 / k) eps:C that the nodes of a support carry.  arm (n, 3): x - origin.
    """

    def __init__(self, reference: Reference) -> None:
        dataset, dtype = reference.dataset, reference.dtype

        def rounded(array: np.ndarray) -> np.ndarray:
            return np.asarray(array).astype(dtype).astype(np.float64)

        self.particle_mass = rounded(dataset.mass)
        self.arm = rounded(dataset.position) - rounded(np.array(dataset.grid.origin))
        velocity = rounded(dataset.velocity)
        self.mass = self.particle_mass.sum(keepdims=True)
        self.momentum = self.particle_mass @ velocity
        moment = self.arm.T @ (self.particle_mass[:, None] * velocity)
        if reference.spline.affine_factor is not None:
            # sum_i w d_b (C d)_c = (dx**2 / k) C_cb
            affine = np.tensordot(self.particle_mass, rounded(dataset.affine), axes=1)
            moment = moment + dataset.grid.dx**2 / reference.spline.affine_factor * affine.T
        self.angular = _cross(moment)


def _cross(moment: np.ndarray, sign: int = -1) -> np.ndarray:
    """(3,) x cross p from moment[a, c] = sum x_a p_c; with sign = 1 the sum of magnitudes."""
    return np.array([moment[(a + 1) % 3, (a + 2) % 3] + sign * moment[(a + 2) % 3, (a + 1) % 3] for a in range(3)])


def _worst(off: np.ndarray, allowed: np.ndarray, magnitude: np.ndarray) -> Conserved:
    """The component whose drift is worst, relative to ``magnitude``; absolute where that is zero."""
    off = np.where(np.isfinite(off), np.abs(off), np.inf)
    ratio = np.divide(off, allowed, out=np.where(off > 0, np.inf, 0.0), where=allowed > 0)
    worst = int(np.argmax(ratio))
    scale = float(magnitude[worst]) or 1.0
    return Conserved(float(off[worst]) / scale, float(allowed[worst]) / scale)
