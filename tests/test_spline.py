"""B-splines against the textbook piecewise formulas and against what every spline must satisfy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import sympy

from mpmbench.device import Launch, open_device
from mpmbench.errors import InputError
from mpmbench.kernel import load_source
from mpmbench.spline import SPLINES, get_spline

XI = np.concatenate([3 + np.linspace(0, 5, 1001), [4.0, 4.5, 5.0, np.nextafter(5.0, 0), 1e-300 + 6]])


def textbook(name: str, x: np.ndarray) -> np.ndarray:
    """N(x) as a function of the distance; the cubic one is thesis eq. 74."""
    x = np.abs(x)
    if name == "linear":
        return np.maximum(0, 1 - x)
    if name == "quadratic":
        return np.where(x < 0.5, 0.75 - x**2, np.where(x < 1.5, 0.5 * (1.5 - x) ** 2, 0))
    return np.where(x < 1, x**3 / 2 - x**2 + 2 / 3, np.where(x < 2, (2 - x) ** 3 / 6, 0))


@pytest.fixture(params=SPLINES)
def spline(request):
    return SPLINES[request.param]


def nodes_of(spline, xi):
    return spline.bin_node(xi) + np.arange(spline.nodes)[:, None] - spline.left


def test_weights_follow_the_textbook_and_the_support_holds_all(spline):
    node = nodes_of(spline, XI)
    np.testing.assert_allclose(spline.weights(XI, spline.bin_node(XI)), textbook(spline.name, XI - node), atol=1e-15)
    everywhere = textbook(spline.name, XI - np.arange(0, 12)[:, None])
    np.testing.assert_allclose(everywhere.sum(axis=0), 1, atol=1e-15)
    assert spline.nodes == spline.left + spline.right + 1
    assert np.abs(XI - node).max() <= spline.reach


def test_partition_of_unity_first_moment_and_gradient_sums(spline):
    b, node = spline.bin_node(XI), nodes_of(spline, XI)
    w, g = spline.weights(XI, b), spline.gradients(XI, b)
    assert w.min() >= 0
    np.testing.assert_allclose(w.sum(axis=0), 1, atol=1e-15)
    np.testing.assert_allclose((w * node).sum(axis=0), XI, atol=1e-14)
    np.testing.assert_allclose(g.sum(axis=0), 0, atol=1e-15)
    np.testing.assert_allclose((g * node).sum(axis=0), 1, atol=1e-14)  # the gradient of a linear field


def test_second_moment_is_one_over_the_affine_factor(spline):
    d = nodes_of(spline, XI) - XI
    moment = (spline.weights(XI, spline.bin_node(XI)) * d**2).sum(axis=0)
    if spline.affine_factor is None:
        assert moment.min() == 0  # singular at nodes
    else:
        np.testing.assert_allclose(moment, 1 / spline.affine_factor, atol=1e-14)


def test_gradients_are_the_derivatives_of_the_weights(spline):
    xi = 3 + (np.arange(20) + 0.37) / 7
    b, h = spline.bin_node(xi), 1e-5
    slope = (spline.weights(xi + h, b) - spline.weights(xi - h, b)) / (2 * h)
    np.testing.assert_allclose(spline.gradients(xi, b), slope, atol=1e-9)


def test_bin_node_at_faces(spline):
    half = np.array([2.0, 2.5, 3.0])
    expected = {"linear": [2, 2, 3], "cubic": [2, 2, 3], "quadratic": [1, 2, 2]}[spline.name]
    for dtype in (np.float32, np.float64):
        assert spline.bin_node(half.astype(dtype)).tolist() == expected


def test_unknown_spline_names_the_valid_ones():
    with pytest.raises(InputError, match=r"unknown spline 'quartic': valid are linear, quadratic, cubic"):
        get_spline("quartic")


# --- exact algebra ----------------------------------------------------------------------------------------------------

FRACTION = sympy.Symbol("f", real=True)


def exact(values: np.ndarray) -> list[sympy.Expr]:
    """Polynomials in f of the shipped formulas, their constants taken as the fractions that they stand for."""
    return [sympy.expand(sympy.nsimplify(value, rational=True, tolerance=1e-15)) for value in values[:, 0]]


def polynomials(spline):
    """Weights, gradients and distances node - particle of one axis, for the symbol f = xi - b."""
    xi, b = np.array([FRACTION], dtype=object), np.array([sympy.Integer(0)], dtype=object)
    distance = [sympy.Integer(o - spline.left) - FRACTION for o in range(spline.nodes)]
    return exact(spline.weights(xi, b)), exact(spline.gradients(xi, b)), distance


def test_sums_hold_exactly_for_every_fraction(spline):
    w, g, d = polynomials(spline)
    nodes = range(spline.nodes)
    assert sympy.expand(sum(w)) == 1
    assert sympy.expand(sum(w[o] * d[o] for o in nodes)) == 0
    assert sympy.expand(sum(g)) == 0
    assert sympy.expand(sum(g[o] * d[o] for o in nodes)) == 1
    assert [sympy.expand(sympy.diff(w[o], FRACTION) - g[o]) for o in nodes] == [0] * spline.nodes


@pytest.mark.parametrize(("name", "third"), [("quadratic", sympy.Rational(1, 4)), ("cubic", sympy.Rational(1, 3))])
def test_d_is_a_multiple_of_the_identity(name: str, third: sympy.Rational):
    """Thesis appendix A: D_p / dx^2, the sum of w (x_i - x_p)(x_i - x_p)^T, as polynomials in three fractions."""
    spline = SPLINES[name]
    w, _, d = polynomials(spline)
    f = sympy.symbols("fx fy fz", real=True)
    weights = [[one.subs(FRACTION, f[axis]) for one in w] for axis in range(3)]
    distance = [[one.subs(FRACTION, f[axis]) for one in d] for axis in range(3)]
    total = sympy.zeros(3, 3)
    for index in np.ndindex(3 * (spline.nodes,)):
        product = sympy.Mul(*(weights[axis][o] for axis, o in enumerate(index)))
        arm = sympy.Matrix([distance[axis][o] for axis, o in enumerate(index)])
        total += product * arm * arm.T
    assert total.applyfunc(sympy.expand) == third * sympy.eye(3)
    assert spline.affine_factor == float(1 / third)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_sums_hold_to_rounding_in_both_number_types(spline, dtype):
    xi = (3 + np.linspace(0, 4, 4001)).astype(dtype)
    b = spline.bin_node(xi).astype(dtype)
    w, g = spline.weights(xi, b), spline.gradients(xi, b)
    assert w.dtype == g.dtype == dtype
    assert_sums(spline, w.astype(float), (xi - b).astype(float), 2 * np.finfo(dtype).eps)
    assert np.abs(g.astype(float).sum(axis=0)).max() <= 2 * np.finfo(dtype).eps


def assert_sums(spline, w: np.ndarray, f: np.ndarray, allowed: float) -> None:
    """Partition of unity, first moment and, where D is regular, second moment of (nodes, n) weights."""
    d = np.arange(spline.nodes)[:, None] - spline.left - f
    assert np.abs(w.sum(axis=0) - 1).max() <= allowed
    assert np.abs((w * d).sum(axis=0)).max() <= allowed
    if spline.affine_factor is not None:
        assert np.abs((w * d**2).sum(axis=0) - 1 / spline.affine_factor).max() <= allowed


# --- the weights of the kernels ---------------------------------------------------------------------------------------

COUNT = 3000
CONSTANTS = {"SOA": 1, "APIC": 1, "INDEXED": 0, "BLOCK_INDEX": 0, "BLOCK_X": 1, "BLOCK_Y": 1, "BLOCK_Z": 1}
WRITTEN = [(degree, real, unity, 1) for degree in (1, 2, 3) for real in ("float", "double") for unity in (0, 1)]


@pytest.fixture(scope="module")
def device():
    return open_device("simulated", arch="sm_52", mode="run")


def values_of_kernels(device, spline, real: str, unity: int, literal: int):
    """Fractions (3, n), axis weights (nodes, n), weights (support, n), affine factors (support, 3, n); float64."""
    dtype = np.float32 if real == "float" else np.float64
    more = {"SPLINE": spline.nodes - 1, "REAL": real, "REAL_IS_DOUBLE": real == "double", "UNITY": unity}
    source = load_source(Path(__file__).parent / "spline_values.cu", CONSTANTS | more | {"LITERAL": literal})
    f = spline.shift + np.random.default_rng(74).random((3, COUNT))
    f[:, :2] = spline.shift, spline.shift + 0.5
    f = np.minimum(f.astype(dtype), np.nextafter(dtype(spline.shift + 1), dtype(0)))
    support = spline.nodes**3
    shapes = ((spline.nodes, COUNT), (support, COUNT), (support, 3, COUNT))
    results = [device.empty(shape, dtype) for shape in shapes]
    kernel = device.compile(source, "spline_values")
    device.launch(Launch("spline_values", kernel, (-(-COUNT // 128), 1, 1), (128, 1, 1),
                         (np.int32(COUNT), device.upload(f), *results)))  # fmt: skip
    return f.astype(float), *(device.download(result).astype(float) for result in results)


@pytest.mark.parametrize(("degree", "real", "unity", "literal"), [*WRITTEN, *((d, "float", 1, 0) for d in (1, 2, 3))])
def test_weights_of_kernels_sum_as_they_must(device, degree: int, real: str, unity: int, literal: int):
    spline = list(SPLINES.values())[degree - 1]
    eps = np.finfo(np.float32 if real == "float" else np.float64).eps
    f, axis, weights, factors = values_of_kernels(device, spline, real, unity, literal)
    np.testing.assert_allclose(axis, spline.weights(f[0], np.zeros(COUNT)), rtol=0, atol=2 * eps)
    assert_sums(spline, axis, f[0], 1.5 * eps)
    assert np.abs(axis.sum(axis=0) - 1).max() <= (eps if unity else 1.5 * eps)
    nodes = np.array([(n % spline.nodes, n // spline.nodes % spline.nodes, n // spline.nodes**2)
                      for n in range(spline.nodes**3)])  # fmt: skip
    d = (nodes[:, :, None] - spline.left) - f
    assert np.abs(weights.sum(axis=0) - 1).max() <= 6 * eps
    assert np.abs((weights[:, None] * d).sum(axis=0)).max() <= 2 * eps
    # What G2P makes of a constant field has no affine part, and of a linear one its gradient: the gradient sums.
    assert np.abs(factors.sum(axis=0)).max() <= 2 * eps
    gradient = np.einsum("nap,nbp->pab", factors, d) * (spline.affine_factor or 1)
    assert np.abs(gradient - np.eye(3)).max() <= 8 * eps


def test_unity_takes_the_bias_out_of_the_cubic_sum(device):
    """In float32: 2/3 rounds up by 2e-8 and stands in two weights. One of them then pays for both, on one side."""
    spline = SPLINES["cubic"]
    sums, moments = {}, {}
    for unity in (0, 1):
        f, axis, *_ = values_of_kernels(device, spline, "float", unity, 1)
        sums[unity] = axis.sum(axis=0) - 1
        moments[unity] = (axis * (np.arange(4)[:, None] - 1 - f[0])).sum(axis=0)
    assert 3e-8 < sums[0].mean() < 6e-8
    assert abs(sums[1].mean()) < sums[0].mean() / 20
    assert abs(moments[0].mean()) < 5e-10
    assert 1e-8 < -moments[1].mean() < 3e-8
