"""Preprocessing steps one by one against NumPy: sort, scan, maxima, active list, and the steps on the grid."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from mpmbench import device as devices
from mpmbench.dataset import Dataset
from mpmbench.plan import build_plan
from mpmbench.primitives.scan_lookback import lookback, state_length
from mpmbench.reference import Nodes
from mpmbench.spline import get_spline
from mpmbench.variants import get, resolve_axes
from mpmbench.workspace import Workspace, bin_count

SHAPE = (11, 9, 13)  # no multiple of any block edge used here
SEED = 20261


@pytest.fixture(scope="module")
def device():
    return devices.open_device("simulated", arch="sm_52")


def some_particles(n: int = 150, shape=SHAPE) -> Dataset:
    """Half of them anywhere, half in two cells, so that bins differ in size."""
    rng = np.random.default_rng(SEED)
    spread = 1 + rng.random((n - n // 2, 3)) * (np.array(shape) - 3.001)
    dense = np.array([[2, 3, 4], [8, 6, 10]])[rng.integers(0, 2, n // 2)] + 0.99 * rng.random((n // 2, 3))
    xi = np.concatenate([spread, dense])
    return Dataset.from_arrays(
        0.5 * xi - 1, rng.uniform(-1, 1, (n, 3)), rng.uniform(1, 2, n), rng.uniform(-1, 1, (n, 3, 3)),
        grid_shape=shape, dx=0.5, origin=(-1, -1, -1),
    )  # fmt: skip


def plan_of(device, name: str, dataset: Dataset | None = None, nodes: Nodes | None = None, **axes):
    variant = get(name)
    return build_plan(variant, dataset or some_particles(), device, resolve_axes(variant, axes), nodes)


def run_steps(device, plan) -> Workspace:
    for step in plan.steps:
        for launch in step.launches:
            device.launch(launch)
        if step.after:
            step.after()
    return plan.work


def fetch(work: Workspace, name: str) -> np.ndarray:
    return np.asarray(work.device.download(work.buffers[name]))


def bins_of(dataset: Dataset, axes) -> np.ndarray:
    """The bin number of each particle, by its definition."""
    i, j, k = get_spline(axes["spline"]).bin_node(dataset.node_units(np.dtype(axes["dtype"]))).T
    nx, ny, _ = dataset.grid.shape
    if axes["cell_index"] == "global":
        return (k * ny + j) * nx + i
    (x, y, z), (bx, by, _) = axes["block_shape"], dataset.grid.blocks(axes["block_shape"])
    block = ((k // z) * by + j // y) * bx + i // x
    return block * (x * y * z) + ((k % z) * y + j % y) * x + i % x


SORTED = [
    dict(particle_order="index", cell_index="global", spline="cubic", payload="pic", layout="soa"),
    dict(particle_order="index", cell_index="block", spline="quadratic", payload="pic", layout="aos"),
    dict(particle_order="deep", cell_index="global", spline="quadratic", payload="apic", layout="soa"),
    dict(particle_order="deep", cell_index="block", spline="linear", payload="apic", layout="aos", dtype="float64"),
]


@pytest.mark.parametrize("axes", SORTED, ids=lambda a: f"{a['particle_order']}-{a['cell_index']}")
def test_counting_sort(device, axes) -> None:
    dataset = some_particles()
    n = dataset.particle_count
    plan = plan_of(device, "g2p_global_gather", dataset, zero_nodes(dataset), block_shape=(4, 3, 2), **axes)
    work = run_steps(device, plan)
    bins = bins_of(dataset, plan.work.axes)
    counts = np.bincount(bins, minlength=bin_count(dataset.grid, work.axes) + 1)
    np.testing.assert_array_equal(fetch(work, "bin_start"), np.cumsum(counts) - counts)
    order = fetch(work, "order")
    assert sorted(order) == list(range(n)), "every particle once"
    assert (np.diff(bins[order]) >= 0).all(), "bins in order"
    if axes["particle_order"] == "deep":
        shape = (-1, n, 4) if axes["layout"] == "soa" else (n, -1, 4)
        axis = 1 if axes["layout"] == "soa" else 0
        before, after = (fetch(work, name).reshape(shape) for name in ("particles", "sorted_particles"))
        np.testing.assert_array_equal(after, before.take(order, axis=axis), "every attribute moved")


def test_sort_runs_again_on_the_same_buffers(device) -> None:
    plan = plan_of(device, "p2g_global_atomic", particle_order="index")
    first = fetch(run_steps(device, plan), "bin_start").copy()
    np.testing.assert_array_equal(fetch(run_steps(device, plan), "bin_start"), first)


@pytest.mark.parametrize("flags", [False, True], ids=["values", "flags"])
@pytest.mark.parametrize("count", [1, 2, 4095, 4096, 4097, 40 * 4096 + 1])
def test_scan_of_any_length(device, count: int, flags: bool) -> None:
    work = plan_of(device, "p2g_global_atomic").work
    values = np.random.default_rng(SEED).integers(0, 3, count).astype(np.int32)
    out, state = device.empty((count,), np.int32), device.empty((state_length(count),), np.int32)
    for launch in lookback(work, count, device.upload(values), out, state, flags=flags):
        device.launch(launch)
    expected = (values > 0) if flags else values
    np.testing.assert_array_equal(device.download(out), np.cumsum(expected) - expected)


@pytest.mark.parametrize("cell_index", ["global", "block"])
@pytest.mark.parametrize(
    ("name", "spline"),
    [
        ("p2g_block_sync", "cubic"),
        ("p2g_block_pull", "cubic"),
        ("p2g_block_pull", "quadratic"),
        ("p2g_block_pull", "linear"),
    ],
)
def test_block_maximum_and_active_list(device, name: str, spline: str, cell_index: str) -> None:
    dataset, edges = some_particles(40), (4, 3, 2)
    plan = plan_of(device, name, dataset, spline=spline, cell_index=cell_index, block_shape=edges)
    work = run_steps(device, plan)
    cells = get_spline(spline).bin_node(dataset.node_units(np.float32))
    per_cell = np.zeros(SHAPE, int)
    np.add.at(per_cell, tuple(cells.T), 1)
    halo = name == "p2g_block_pull"
    # A node i hears from bins i - right .. i + left: the nodes of a block from that much around it.
    below, above = (get_spline(spline).right, get_spline(spline).left) if halo else (0, 0)
    expected = []
    for index in itertools.product(*(range(b) for b in dataset.grid.blocks(edges)[::-1])):
        first = [b * e for b, e in zip(index[::-1], edges, strict=True)]
        tile = tuple(slice(max(0, f - below), f + e + above) for f, e in zip(first, edges, strict=True))
        expected.append(per_cell[tile].max(initial=0))
    np.testing.assert_array_equal(fetch(work, "block_maximum"), expected)
    active = np.flatnonzero(expected)
    assert work.active_count == len(active)
    np.testing.assert_array_equal(fetch(work, "active_blocks")[: len(active)], active)


def test_no_particles_means_no_active_block(device) -> None:
    plan = plan_of(device, "p2g_block_sync", some_particles(0))
    assert run_steps(device, plan).active_count == 0
    assert plan.transfer.launches == ()


def zero_nodes(dataset: Dataset) -> Nodes:
    return Nodes(np.zeros(dataset.grid.shape), np.zeros((*dataset.grid.shape, 3)))


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_grid_divide(device, dtype: str) -> None:
    rng = np.random.default_rng(SEED)
    mass = rng.uniform(1, 2, SHAPE) * (rng.random(SHAPE) < 0.5)
    momentum = rng.uniform(-1, 1, (*SHAPE, 3)) * (mass > 0)[..., None]
    plan = plan_of(device, "g2p_global_gather", nodes=Nodes(mass, momentum), dtype=dtype)
    work = run_steps(device, plan)
    velocity = work.grid.to_host_order(fetch(work, "velocities"))[..., :3]
    m = mass.astype(dtype)[..., None]
    expected = np.divide(momentum.astype(dtype), m, out=np.zeros_like(velocity), where=m > 0)
    np.testing.assert_array_equal(velocity, expected)


def test_grid_clear_and_reset(device) -> None:
    """Repeats of a transfer on the same buffers must not add up."""
    plan = plan_of(device, "p2g_global_atomic")
    plan.run_once(device)
    mass = plan.outputs().mass.copy()
    for step in (*plan.reset(), plan.transfer):
        for launch in step.launches:
            device.launch(launch)
    np.testing.assert_array_equal(plan.outputs().mass, mass)


@pytest.mark.parametrize("layout", ["soa", "aos"])
def test_results_come_back_in_the_order_of_the_dataset(device, layout: str) -> None:
    """A velocity field equal to position, gathered with weights that reproduce it."""
    dataset = some_particles()
    x, y, z = (np.arange(n) for n in SHAPE)
    field = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).astype(float)
    for order in ("given", "index", "deep"):
        plan = plan_of(
            device, "g2p_global_gather", dataset, Nodes(np.ones(SHAPE), field), layout=layout, particle_order=order
        )
        plan.run_once(device)
        np.testing.assert_allclose(plan.outputs().velocity, dataset.node_units(), atol=1e-4)
