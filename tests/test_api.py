"""The Python API: shapes, order, defaults and refusals."""

from __future__ import annotations

import numpy as np
import pytest

import mpmbench as mb


@pytest.fixture(scope="module")
def particles():
    return mb.load_dataset("uniform_cube", particles=700, particles_per_cell=4, seed=5, grid_shape=(20, 18, 17))


def test_p2g_conserves_and_has_the_grids_shape(particles):
    nodes = mb.p2g("p2g_block_sync", particles, batching=4, block_shape=(4, 4, 4))
    assert nodes.mass.shape == (20, 18, 17)
    assert nodes.momentum.shape == (20, 18, 17, 3)
    np.testing.assert_allclose(nodes.mass.sum(dtype=float), particles.mass.sum(), rtol=1e-6)
    expected = (particles.mass[:, None] * particles.velocity).sum(axis=0)
    np.testing.assert_allclose(nodes.momentum.sum(axis=(0, 1, 2), dtype=float), expected, atol=1e-6)


def test_g2p_answers_in_the_datasets_order(particles):
    """A velocity field that is linear in x comes back as each particle's own position, whatever the sort did."""
    node = np.stack(np.meshgrid(*map(np.arange, particles.grid.shape), indexing="ij"), axis=-1) * particles.grid.dx
    nodes = mb.p2g("p2g_global_atomic", particles, dtype="float64")
    field = type(nodes)(mass=np.ones(particles.grid.shape), momentum=node)
    for order in ("index", "deep"):
        back = mb.g2p("g2p_block_gather", particles, field, dtype="float64", particle_order=order)
        np.testing.assert_allclose(back.velocity, particles.position, rtol=1e-12)
        assert back.affine is None
    apic = mb.g2p("g2p_global_gather", particles, field, dtype="float64", payload="apic")
    np.testing.assert_allclose(apic.affine, np.broadcast_to(np.eye(3), (700, 3, 3)), atol=1e-9)


def test_refusals(particles):
    nodes = mb.p2g("p2g_global_atomic", particles)
    with pytest.raises(mb.InputError, match="p2g_block_sync"):
        mb.p2g("p2g_nothing", particles)
    with pytest.raises(mb.InputError, match="batching"):
        mb.p2g("p2g_block_sync", particles, batchings=4)
    with pytest.raises(mb.InputError, match="deep, index"):
        mb.p2g("p2g_block_sync", particles, particle_order="given")
    with pytest.raises(mb.InputError, match=r"mpmbench\.g2p"):
        mb.p2g("g2p_global_gather", particles)
    with pytest.raises(mb.InputError, match="shared"):
        mb.p2g("p2g_block_sync", particles, block_shape=(16, 16, 4), dtype="float64")
    with pytest.raises(mb.InputError, match="want"):
        mb.g2p("g2p_global_gather", particles, type(nodes)(mass=np.ones((2, 2, 2)), momentum=np.ones((2, 2, 2, 3))))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mass": np.nan}, r"mass of node \(2, 3, 4\) is not finite"),
        ({"momentum": np.inf}, r"momentum of node \(2, 3, 4\) is not finite"),
        ({"momentum": 1e39}, "not finite in float32"),
        ({"mass": -1}, r"mass of node \(2, 3, 4\) is -1 kg"),
    ],
)
def test_bad_nodes_are_named(particles, change, message):
    nodes = mb.p2g("p2g_global_atomic", particles)
    arrays = {"mass": nodes.mass.astype(float), "momentum": nodes.momentum.astype(float)}
    for label, value in change.items():
        arrays[label][2, 3, 4] = value
    with pytest.raises(mb.InputError, match=message):
        mb.g2p("g2p_global_gather", particles, type(nodes)(**arrays))


def test_things_of_another_type_are_refused(particles):
    nodes = mb.p2g("p2g_global_atomic", particles)
    with pytest.raises(mb.InputError, match="want a Dataset"):
        mb.p2g("p2g_global_atomic", "uniform_cube")
    with pytest.raises(mb.InputError, match="not tuple"):
        mb.g2p("g2p_global_gather", particles, (nodes.mass, nodes.momentum))
    for dtype in (str, complex):
        with pytest.raises(mb.InputError, match="want real numbers"):
            mb.g2p("g2p_global_gather", particles, type(nodes)(nodes.mass, nodes.momentum.astype(dtype)))


def test_more_than_memory_holds_is_said_before_it_is_taken():
    for particles in (10**12, 10**30):
        with pytest.raises(mb.InputError, match="GiB of memory"):
            mb.load_dataset("random", particles=particles)


def test_no_device_and_one_folder_alone(particles, tmp_path):
    with pytest.raises(mb.InputError, match="unknown device None"):
        mb.p2g("p2g_global_atomic", particles, device=None)
    with pytest.raises(mb.InputError, match=str(tmp_path / "nowhere")):
        mb.p2g("p2g_global_atomic", particles, variants=str(tmp_path / "nowhere"))


def test_lists_have_names_and_summaries():
    for items in (mb.list_variants(), mb.list_datasets(), mb.list_devices()):
        assert items
        assert all(item.name and item.summary and "\n" not in item.summary for item in items)
