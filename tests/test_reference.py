"""The float64 reference against a brute-force sum over all nodes, and what the transfers promise."""

from __future__ import annotations

import numpy as np
import pytest
from test_spline import textbook

from mpmbench.awkward import awkward_datasets
from mpmbench.dataset import Dataset, load_dataset
from mpmbench.errors import InputError
from mpmbench.reference import CHUNK, Nodes, g2p, grid_divide, p2g
from mpmbench.spline import SPLINES

ALL_SPLINES = pytest.mark.parametrize("spline", SPLINES)


def cloud(particles=60, **fields) -> Dataset:
    """A few random particles on a grid with nothing round about it; ``fields`` replace velocity, affine or mass."""
    drawn = load_dataset("random", particles=particles, grid_shape=(9, 7, 8), dx=0.3, origin=(-1, 0.5, 2))
    arrays = {"velocity": drawn.velocity, "mass": drawn.mass, "affine": drawn.affine} | fields
    return Dataset.from_arrays(drawn.position, **arrays, grid_shape=(9, 7, 8), dx=0.3, origin=(-1, 0.5, 2))


def node_positions(dataset):
    return np.array(dataset.grid.origin) + dataset.grid.dx * np.stack(np.indices(dataset.grid.shape), axis=-1)


@ALL_SPLINES
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_transfers_are_the_textbook_sums(spline, dtype):
    dataset = cloud()

    def rounded(array):
        return np.asarray(array).astype(dtype).astype(np.float64)

    inv_dx, dx = rounded(1 / dataset.grid.dx), rounded(dataset.grid.dx)
    xi = (rounded(dataset.position) - rounded(dataset.grid.origin)) * inv_dx
    velocity, affine, mass = (rounded(a) for a in (dataset.velocity, dataset.affine, dataset.mass))
    field = rounded(np.random.default_rng(1).normal(size=(*dataset.grid.shape, 3)))
    index = np.stack(np.indices(dataset.grid.shape), axis=-1)
    node_mass, pic, apic = np.zeros(dataset.grid.shape), np.zeros_like(field), np.zeros_like(field)
    gathered, outer = np.zeros((len(xi), 3)), np.zeros((len(xi), 3, 3))
    for p in range(len(xi)):
        distance = index - xi[p]
        w = textbook(spline, distance).prod(axis=-1)
        node_mass += w * mass[p]
        pic += (w * mass[p])[..., None] * velocity[p]
        apic += (w * mass[p])[..., None] * (velocity[p] + distance @ affine[p].T * dx)
        gathered[p] = (w[..., None] * field).sum(axis=(0, 1, 2))
        outer[p] = np.einsum("ijk,ijkc,ijka->ca", w, field, distance)

    for payload, momentum in (("pic", pic), ("apic", apic)):
        nodes = p2g(dataset, spline, payload, dtype).nodes
        np.testing.assert_allclose(nodes.mass, node_mass, atol=1e-16)
        np.testing.assert_allclose(nodes.momentum, momentum, atol=1e-16)
        back = g2p(dataset, field, spline, payload, dtype).particles
        np.testing.assert_allclose(back.velocity, gathered, atol=1e-14)
        if payload == "pic":
            assert back.affine is None
        elif spline != "linear":
            np.testing.assert_allclose(back.affine, outer * SPLINES[spline].affine_factor / dx, atol=1e-13)


@ALL_SPLINES
def test_linear_fields_come_back_exactly(spline):
    dataset = cloud()
    matrix, shift = np.array([[1.0, -2, 3], [0.5, 0, 1], [-1, 4, 2]]), np.array([3.0, -1, 0.25])
    back = g2p(dataset, node_positions(dataset) @ matrix.T + shift, spline, "apic", "float64").particles
    np.testing.assert_allclose(back.velocity, dataset.position @ matrix.T + shift, atol=1e-13)
    np.testing.assert_allclose(back.affine, np.broadcast_to(matrix, (60, 3, 3)), atol=1e-12)


@ALL_SPLINES
def test_constant_velocity_survives_a_round_trip_of_pic(spline):
    dataset = cloud(velocity=np.tile([1.5, -0.25, 3.0], (60, 1)), affine=np.zeros((60, 3, 3)))
    reference = p2g(dataset, spline, "pic", "float64")
    back = g2p(dataset, grid_divide(reference.nodes), spline, "pic", "float64").particles
    np.testing.assert_allclose(back.velocity, dataset.velocity, atol=1e-14)


@ALL_SPLINES
def test_affine_velocity_survives_a_round_trip_of_apic(spline):
    matrix = np.array([[1.0, -2, 3], [0.5, 0, 1], [-1, 4, 2]])
    dataset = cloud()
    moving = cloud(velocity=dataset.position @ matrix.T, affine=np.tile(matrix, (60, 1, 1)))
    reference = p2g(moving, spline, "apic", "float64")
    back = g2p(moving, grid_divide(reference.nodes), spline, "apic", "float64").particles
    np.testing.assert_allclose(back.velocity, moving.velocity, atol=1e-12)
    np.testing.assert_allclose(back.affine, moving.affine, atol=1e-11)


@ALL_SPLINES
@pytest.mark.parametrize("payload", ["pic", "apic"])
def test_mass_and_momentum_are_conserved_there_and_back(spline, payload):
    dataset = cloud()
    nodes = p2g(dataset, spline, payload, "float64").nodes
    momentum = dataset.mass @ dataset.velocity
    np.testing.assert_allclose(nodes.mass.sum(), dataset.mass.sum(), rtol=1e-14)
    np.testing.assert_allclose(nodes.momentum.sum(axis=(0, 1, 2)), momentum, atol=1e-15)
    back = g2p(dataset, grid_divide(nodes), spline, payload, "float64").particles
    np.testing.assert_allclose(dataset.mass @ back.velocity, momentum, atol=1e-15)


def angular_momentum(dataset, velocity, affine, factor):
    """sum m (x cross v) + m (dx**2 / k) eps:C, written with an explicit Levi-Civita symbol."""
    levi_civita = np.zeros((3, 3, 3))
    for a, b, c in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        levi_civita[a, b, c], levi_civita[a, c, b] = 1, -1
    spin = np.einsum("abc,pcb->pa", levi_civita, affine) * dataset.grid.dx**2 / factor
    return dataset.mass @ (np.cross(dataset.position, velocity) + spin)


@pytest.mark.parametrize("spline", ["quadratic", "cubic"])
def test_apic_conserves_angular_momentum_there_and_back(spline):
    dataset, factor = cloud(), SPLINES[spline].affine_factor
    before = angular_momentum(dataset, dataset.velocity, dataset.affine, factor)
    nodes = p2g(dataset, spline, "apic", "float64").nodes
    on_grid = np.cross(node_positions(dataset), nodes.momentum).sum(axis=(0, 1, 2))
    np.testing.assert_allclose(on_grid, before, atol=1e-14)
    back = g2p(dataset, grid_divide(nodes), spline, "apic", "float64").particles
    np.testing.assert_allclose(angular_momentum(dataset, back.velocity, back.affine, factor), before, atol=1e-14)
    without_affine = angular_momentum(dataset, dataset.velocity, 0 * dataset.affine, factor)
    assert np.abs(without_affine - before).max() > 1e-3 * np.abs(before).max()


def test_order_and_chunks_do_not_matter():
    particles = CHUNK + 77
    dataset = load_dataset("random", particles=particles, grid_shape=(20, 20, 20))
    order = np.random.default_rng(0).permutation(particles)
    shuffled = Dataset.from_arrays(
        dataset.position[order],
        dataset.velocity[order],
        dataset.mass[order],
        dataset.affine[order],
        grid_shape=(20, 20, 20),
        dx=dataset.grid.dx,
    )
    first, second = (p2g(d, "cubic", "apic") for d in (dataset, shuffled))
    np.testing.assert_allclose(first.value, second.value, atol=1e-14 * np.abs(first.value).max())
    field = grid_divide(first.nodes)
    ours, theirs = (g2p(d, field, "cubic", "apic").particles for d in (dataset, shuffled))
    np.testing.assert_array_equal(ours.velocity[order], theirs.velocity)
    np.testing.assert_array_equal(ours.affine[order], theirs.affine)


def test_empty_nodes_are_at_rest():
    nodes = Nodes(np.array([[[0.0, 2.0]]]), np.array([[[[0.0, 0.0, 0.0], [1.0, -4.0, 0.5]]]]))
    np.testing.assert_array_equal(grid_divide(nodes), [[[[0, 0, 0], [0.5, -2, 0.25]]]])


@ALL_SPLINES
def test_no_particles_make_an_empty_grid_and_no_values(spline):
    dataset = awkward_datasets(spline)["none"]
    reference = p2g(dataset, spline, "apic")
    assert not reference.value.any()
    back = g2p(dataset, grid_divide(reference.nodes), spline, "apic").particles
    assert back.velocity.shape == (0, 3)
    assert back.affine.shape == (0, 3, 3)


def test_bad_requests_are_refused_in_one_line():
    dataset = cloud()
    with pytest.raises(InputError, match="unknown payload 'flip': valid are pic, apic"):
        p2g(dataset, "cubic", "flip")
    with pytest.raises(InputError, match="unknown dtype 'float16'"):
        p2g(dataset, "cubic", "pic", "float16")
    with pytest.raises(InputError, match=r"node velocity has shape \(7, 9, 8, 3\), want \(9, 7, 8, 3\)"):
        g2p(dataset, np.zeros((7, 9, 8, 3)), "cubic")
