"""B-splines against the textbook piecewise formulas and against what every spline must satisfy."""

from __future__ import annotations

import numpy as np
import pytest

from mpmbench.errors import InputError
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
