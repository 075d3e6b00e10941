"""Matrices that 3x3 decompositions get wrong, as sets: random, near the identity, rotations, singular, graded, extreme.

``matrices(name, dtype, count)`` gives (count, 3, 3), the same ones in every run. Sets are written in float64 and
rounded to ``dtype``, so what counts is the rounded matrix: a rank 2 matrix has a third singular value of rounding size.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

Maker = Callable[[np.random.Generator, int], np.ndarray]

COUNT = 100_000
LARGE = 1_000_000

# Printed in reports of wrong results: negative singular values (taichi 6903), results of two libraries differ (taichi
# 8429), determinants that cancel (taichi 8424, twice), U and V far from orthogonal (ericjang/svd3 issue 3).
REPORTED = np.array([
    [[-45.003811, 0.929553, -0.704581], [0.934495, -44.535431, 0.370609], [-0.722628, 0.385308, -44.987701]],
    [[0.999688, 0.0249922, 0.0], [-0.0249922, 0.999688, 0.0], [0.0, 0.0, 1.0]],
    [[2.52825e4, 2.385e4, 4.77e2], [2.385e4, 2.25015e4, 4.5e2], [4.77e2, 4.5e2, 9.0]],
    [[8.1015e3, 1.35e4, 2.7e2], [1.35e4, 2.25015e4, 4.5e2], [2.7e2, 4.5e2, 9.0]],
    [[0.8147, 0.9134, 0.2785], [0.9058, 0.6324, 0.5469], [0.1270, 0.0975, 0.9575]],
])  # fmt: skip


def rotations(rng: np.random.Generator, count: int) -> np.ndarray:
    """Uniform random rotations, (count, 3, 3), from normalised quaternions."""
    q = rng.standard_normal((4, count))
    w, x, y, z = q / np.linalg.norm(q, axis=0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def with_values(rng: np.random.Generator, values: np.ndarray) -> np.ndarray:
    """Random rotations around given singular values (count, 3)."""
    count = len(values)
    return np.einsum("nik,nk,njk->nij", rotations(rng, count), values, rotations(rng, count))


def among(count: int, *choices: object) -> np.ndarray:
    """The choices in turn, (count, ...)."""
    return np.resize(np.asarray(choices, float), (count, *np.shape(choices)[1:]))


def powers(rng: np.random.Generator, count: int, lowest: float, highest: float) -> np.ndarray:
    """10^x with x uniform."""
    return 10 ** rng.uniform(lowest, highest, count)


def third(values: np.ndarray) -> np.ndarray:
    """Singular values (1, 1/2, v)."""
    return np.stack([np.ones_like(values), np.full_like(values, 0.5), values], axis=-1)


def reflections(rng: np.random.Generator, count: int) -> np.ndarray:
    """I - 2 n n^T, and a rotation of it for every second one; first the mirrors of the axes."""
    n = rng.standard_normal((count, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    mirrors = np.eye(3) - 2 * n[:, :, None] * n[:, None, :]
    mirrors[1::2] = rotations(rng, count)[1::2] @ mirrors[1::2]
    mirrors[:4] = [np.diag([-1, 1, 1]), np.diag([1, -1, 1]), np.diag([1, 1, -1]), -np.eye(3)]
    return mirrors


def multiples_of_identity(rng: np.random.Generator, count: int) -> np.ndarray:
    scale = powers(rng, count, -6, 6)
    scale[:6] = [1, -1, 2, 0.5, 3, 0]
    return scale[:, None, None] * np.eye(3)


def rank_deficient(rng: np.random.Generator, count: int) -> np.ndarray:
    """Rank 2 and 1 up to rounding and exactly, diagonal with zeros, and zero itself."""
    a = with_values(rng, among(count, [1, 0.5, 0], [1, 1, 0], [1, 0, 0]))
    small = rng.integers(-8, 9, (2, 2, count, 3)).astype(float)  # products and sums of small integers are exact
    exact = np.einsum("kni,knj->nij", small[0], small[1])
    exact[1::2] = np.einsum("ni,nj->nij", small[0, 0], small[1, 0])[1::2]
    a[: count // 2] = exact[: count // 2]
    axes = np.array([np.diag(np.array(d, float)) for d in np.ndindex(2, 2, 2)])
    a[:8], a[8:16], a[16:24] = axes, -axes, np.roll(axes, 1, axis=1)
    return a


def extremes(*scales: float) -> Maker:
    def make(rng: np.random.Generator, count: int) -> np.ndarray:
        a = rng.uniform(-1, 1, (count, 3, 3))
        a[::8] = rotations(rng, len(a[::8]))
        a[0] = np.eye(3)
        return a * among(count, *np.repeat(scales, 16))[:, None, None]

    return make


def not_finite(rng: np.random.Generator, count: int) -> np.ndarray:
    """One to nine entries of a matrix are NaN, infinity or minus infinity."""
    a = rng.uniform(-1, 1, (count, 3, 3)) * powers(rng, count, -30, 30)[:, None, None]
    bad = rng.random((count, 9)) < rng.random((count, 1))
    bad[np.arange(count), rng.integers(0, 9, count)] = True
    return np.where(bad.reshape(-1, 3, 3), rng.choice([np.nan, np.inf, -np.inf], (count, 3, 3)), a)


def reported(rng: np.random.Generator, count: int) -> np.ndarray:
    """As printed, then with their last digits changed."""
    a = among(count, *REPORTED)
    a[len(REPORTED) :] *= 1 + 1e-5 * rng.uniform(-1, 1, (count - len(REPORTED), 3, 3))
    return a


SETS: dict[str, Maker] = {
    "U1 uniform": lambda rng, n: rng.uniform(-1, 1, (n, 3, 3)),
    "U2 Gaussian": lambda rng, n: rng.standard_normal((n, 3, 3)),
    "U3 identity + 1e-4": lambda rng, n: np.eye(3) + 1e-4 * rng.standard_normal((n, 3, 3)),
    "U4 identity + 1e-2": lambda rng, n: np.eye(3) + 1e-2 * rng.standard_normal((n, 3, 3)),
    "U5 rotations": rotations,
    "U6 scaled rotations": lambda rng, n: rotations(rng, n) * powers(rng, n, -6, 6)[:, None, None],
    "U7 reflections": reflections,
    "U8 double values": lambda rng, n: with_values(rng, among(n, [2, 2, 1], [2, 1, 1])),
    "U9 multiples of identity": multiples_of_identity,
    "U10 rank 2, 1, 0": rank_deficient,
    "U11 small third value": lambda rng, n: with_values(rng, third(powers(rng, n, -12, -1))),
    "U12 graded": lambda rng, n: with_values(rng, among(n, [1, 1e-4, 1e-8])),
    "U13 inverted": lambda rng, n: with_values(rng, third(-powers(rng, n, -6, -1))),
    "U14 extreme scales": extremes(1e-20, 1e-39, 1e18, 1e20),
    "U15 not finite": not_finite,
    "U16 reported": reported,
}


def matrices(name: str, dtype: type, count: int = COUNT) -> np.ndarray:
    """The first ``count`` matrices of a set, (count, 3, 3)."""
    seed = list(SETS).index(name) + 1
    return SETS[name](np.random.default_rng(seed), count).astype(dtype)
