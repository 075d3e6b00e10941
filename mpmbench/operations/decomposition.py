"""Polar SVD and polar decomposition of 3x3 matrices: what they take, how wrong a result is, how wrong it may be.

Results are judged by what they promise: U, V and R are rotations, factors give the matrix back, singular values agree
with ``numpy.linalg.svd`` in float64, are in order, and only the smallest one is negative, where det F is. The vectors
of equal singular values are anyone's choice, so they are compared with nothing.

Arrays are as on the device, ``(entries, n)``: entry ``3 row + column``, of symmetric matrices xx, yy, zz, xy, yz, zx.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mpmbench.check import CheckResult
from mpmbench.primitives import Arrays, Axes, Operation

VALUES = "singular values"
STRETCH = "stretch"  # eigenvalues of S; its entries round on their own, hence the limit of the reconstruction
WRONG = "order and NaN"  # errors that are either 0 or infinite

# Largest error of any one matrix, relative to its largest singular value. A mean would hide the few that a fixed number
# of sweeps leaves unfinished. Float's are 17 units in the last place, half of that for singular values.
LIMITS: dict[str, dict[str, float]] = {
    "float32": {"reconstruction": 2e-6, VALUES: 1e-6, STRETCH: 2e-6, "orthogonality": 2e-6, "determinant": 2e-6},
    "float64": dict.fromkeys(("reconstruction", VALUES, STRETCH, "orthogonality", "determinant"), 1e-13),
}
ROUNDED = ("reconstruction", VALUES, STRETCH)  # errors that grow where results are rounded to denormals
_SYMMETRIC = ((0, 3, 5), (3, 1, 4), (5, 4, 2))

Errors = dict[str, np.ndarray]  # name -> (n,)


@dataclass(frozen=True)
class Reference:
    """Matrices and their singular values in float64, each matrix times the power of two that brings it near 1.

    matrix (3, 3, n); exponent (n,): matrix = F 2^-exponent; values (3, n), the last one with the sign of det F;
    finite (n,); spacing (n,): distance of neighbouring numbers where F's type is coarsest, relative to the largest
    singular value. All but ``finite`` are of a zero matrix where F is not finite.
    """

    matrix: np.ndarray
    exponent: np.ndarray
    values: np.ndarray
    finite: np.ndarray
    spacing: np.ndarray

    @property
    def largest(self) -> np.ndarray:
        """Largest singular values (n,), 1 for zero matrices: what errors are relative to."""
        return np.where(self.values[0] > 0, self.values[0], 1)

    def scaled(self, values: np.ndarray) -> np.ndarray:
        """Values of the matrices as given (..., n), in units of the scaled ones."""
        return np.ldexp(values.astype(float), -self.exponent)


def reference(f: np.ndarray) -> Reference:
    """Of matrices (9, n)."""
    finite = np.isfinite(f).all(axis=0)
    matrix = np.where(finite, f, 0).astype(float).reshape(3, 3, -1)
    exponent = np.frexp(np.abs(matrix).max(axis=(0, 1)))[1]
    matrix = np.ldexp(matrix, -exponent)
    stack = np.moveaxis(matrix, -1, 0)
    values = np.linalg.svd(stack, compute_uv=False).T.copy()
    values[2] = np.copysign(values[2], _determinant(matrix))
    coarsest = np.ldexp(float(np.finfo(f.dtype).smallest_subnormal), -exponent)
    return Reference(matrix, exponent, values, finite, coarsest / np.where(values[0] > 0, values[0], 1))


def svd_errors(exact: Reference, u: np.ndarray, s: np.ndarray, v: np.ndarray) -> Errors:
    """Of U (9, n), singular values (3, n) and V (9, n)."""
    left, right = (a.astype(float).reshape(3, 3, -1) for a in (u, v))
    values = exact.scaled(s)
    product = np.einsum("ikn,jkn->ijn", left * values, right)
    ordered = (values[0] >= values[1]) & (values[1] >= np.abs(values[2]))
    errors = {
        "reconstruction": _norm(product - exact.matrix) / exact.largest,
        VALUES: np.abs(values - exact.values).max(axis=0) / exact.largest,
        "orthogonality": np.maximum(_non_orthogonality(left), _non_orthogonality(right)),
        "determinant": np.maximum(np.abs(_determinant(left) - 1), np.abs(_determinant(right) - 1)),
        WRONG: np.where(ordered, 0, np.inf),
    }
    return _judge_nan(errors, exact.finite, u, s, v)


def polar_errors(exact: Reference, r: np.ndarray, s: np.ndarray) -> Errors:
    """Of R (9, n) and the symmetric S (6, n), whose eigenvalues are the singular values."""
    rotation = r.astype(float).reshape(3, 3, -1)
    stretch = exact.scaled(s)[np.array(_SYMMETRIC)]
    finite = np.where(np.isfinite(stretch), stretch, 0)
    eigenvalues = np.linalg.eigvalsh(np.moveaxis(finite, -1, 0)).T
    product = np.einsum("ikn,kjn->ijn", rotation, stretch)
    errors = {
        "reconstruction": _norm(product - exact.matrix) / exact.largest,
        STRETCH: np.abs(eigenvalues - np.sort(exact.values, axis=0)).max(axis=0) / exact.largest,
        "orthogonality": _non_orthogonality(rotation),
        "determinant": np.abs(_determinant(rotation) - 1),
        WRONG: np.zeros(len(exact.finite)),
    }
    return _judge_nan(errors, exact.finite, r, s)


def _judge_nan(errors: Errors, finite: np.ndarray, *results: np.ndarray) -> Errors:
    """A matrix that is not finite must have no number in its results, any other one nothing else."""
    all_nan = np.all([np.isnan(a).all(axis=0) for a in results], axis=0)
    right = {name: np.where(np.isnan(error), np.inf, error) for name, error in errors.items()}
    return {name: np.where(finite, error, np.where(all_nan, 0, np.inf)) for name, error in right.items()}


def judge(errors: Errors, exact: Reference, dtype: str) -> CheckResult:
    """The worst error next to its limit. Values have the spacing of denormals on top, which they are rounded to."""
    if len(exact.finite) == 0:
        return CheckResult(True, 0.0, 0.0)
    verdicts = []
    for name, error_of_each in errors.items():
        # Each of nine entries is off by half a spacing at most.
        room = 1.5 * exact.spacing if name in ROUNDED else np.zeros_like(exact.spacing)
        allowed = LIMITS[dtype].get(name, 1.0) + room
        worst = int(np.argmax(error_of_each / allowed))
        error = float(error_of_each[worst])
        passed = bool(error <= allowed[worst])
        verdicts.append(CheckResult(passed, error, float(allowed[worst]), name, (worst,)))
    return max(verdicts, key=lambda verdict: verdict.ratio)


def _norm(a: np.ndarray) -> np.ndarray:
    return np.sqrt(np.einsum("ijn,ijn->n", a, a))


def _determinant(a: np.ndarray) -> np.ndarray:
    return np.einsum("in,in->n", a[0], np.cross(a[1], a[2], axis=0))


def _non_orthogonality(a: np.ndarray) -> np.ndarray:
    """Largest entry of |A^T A - I|."""
    return np.abs(np.einsum("kin,kjn->ijn", a, a) - np.eye(3)[:, :, None]).max(axis=(0, 1))


# --- operations -------------------------------------------------------------------------------------------------------


def real_constants(dtype: str) -> dict[str, object]:
    """The constants of real.cuh."""
    return {"REAL": {"float32": "float", "float64": "double"}[dtype], "REAL_IS_DOUBLE": dtype == "float64"}


def uniform_matrices(axes: Axes, size: int, seed: int) -> dict[str, np.ndarray]:
    """Entries uniform in [-1, 1], as in thesis section 6.1."""
    return {"f": np.random.default_rng(seed).uniform(-1, 1, (9, size)).astype(axes["dtype"])}


def _check_svd(inputs: Arrays, outputs: Arrays, axes: Axes) -> CheckResult:
    exact = reference(inputs["f"])
    u, s, v = (outputs[name][:, : inputs["f"].shape[1]] for name in "usv")  # buffers are never empty
    return judge(svd_errors(exact, u, s, v), exact, axes["dtype"])


def _check_polar(inputs: Arrays, outputs: Arrays, axes: Axes) -> CheckResult:
    exact = reference(inputs["f"])
    r, s = (outputs[name][:, : inputs["f"].shape[1]] for name in "rs")
    return judge(polar_errors(exact, r, s), exact, axes["dtype"])


def _traffic(reals: int) -> Callable[[Axes, int], int]:
    """Bytes of so many reals per matrix."""
    return lambda axes, size: size * reals * np.dtype(axes["dtype"]).itemsize


SVD = Operation(
    name="svd",
    summary="F = U diag(s) V^T of 3x3 matrices, U and V rotations",
    unit="matrices",
    inputs=uniform_matrices,
    check=_check_svd,
    floor=_traffic(9 + 9 + 3 + 9),
)
POLAR = Operation(
    name="polar",
    summary="F = R S of 3x3 matrices, R a rotation and S symmetric",
    unit="matrices",
    inputs=uniform_matrices,
    check=_check_polar,
    floor=_traffic(9 + 9 + 6),
)
