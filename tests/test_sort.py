"""Counting sort and compaction as benchmarks: exact whatever the order of the input, and the traffic they promise."""

from __future__ import annotations

import csv
import sys

import numpy as np
import pytest
from fake_cupy import FakeGpu, fake_cupy, on_the_engine

from mpmbench import device as devices
from mpmbench.contest import Timing, run_contest
from mpmbench.dataset import DATASETS_FOLDER, load_dataset
from mpmbench.device import run_all
from mpmbench.environment import Environment
from mpmbench.errors import InputError
from mpmbench.measure import Sampling
from mpmbench.motion import after_steps, in_bin_order
from mpmbench.operations import compaction, sorting
from mpmbench.primitive_runs import PrimitiveCase, build_primitive
from mpmbench.primitives import discover, get, resolve_axes
from mpmbench.protocol.rounds import Rules
from mpmbench.runner import Inputs

SEED = 9
ORDERS = ("random", "after_10", "after_1", "sorted")
OPERATIONS = ("bin", "reorder", "sort", "compact")
NAMES = [p.name for p in discover() if p.operation.name in OPERATIONS and "simulated" in p.devices]


@pytest.fixture(scope="module")
def device():
    return devices.open_device("simulated", arch="sm_52")


@pytest.fixture(scope="module")
def debugger():
    return devices.open_device("simulated", arch="sm_52", mode="debug", seed=3)


def record_of(device, name: str, size: int, **axes):
    primitive = get(name)
    return PrimitiveCase(primitive, size, resolve_axes(primitive, axes), SEED).run(
        device, Inputs(), Environment.capture(argv=[])
    )


def outputs_of(device, name: str, size: int, **axes):
    """Inputs, outputs and counters of one run."""
    primitive = get(name)
    resolved = resolve_axes(primitive, axes)
    inputs = primitive.operation.inputs(resolved, size, SEED)
    built = build_primitive(primitive, device, resolved, inputs, size)
    run_all(device, built.before)
    counters = run_all(device, built.launches).counters
    return inputs, {key: device.download(array) for key, array in built.outputs.items()}, counters


def test_every_part_of_the_sort_is_there() -> None:
    expected = {"bin_particles", "reorder_index", "reorder_deep", "sort_index", "sort_deep", "compact_blocks"}
    assert expected <= set(NAMES)
    assert set(get("sort_deep").axes["attributes"]) == set(range(1, 9))


@pytest.mark.parametrize("size", [0, 1, 33, 700])
@pytest.mark.parametrize("name", NAMES)
def test_any_size_is_exact_and_without_findings(debugger, name: str, size: int) -> None:
    record = record_of(debugger, name, size)
    assert record.status == "ok", (record.failed_because, record.findings, record.check)


@pytest.mark.parametrize("order", ORDERS)
def test_index_and_deep_sort_by_cell(device, order: str) -> None:
    """Judged by what the test computes from the positions alone."""
    n, attributes = 3000, 3
    for name, layout in (("sort_index", None), ("sort_deep", "soa"), ("sort_deep", "aos")):
        axes = {"attributes": attributes, "layout": layout} if layout else {}
        inputs, outputs, _ = outputs_of(device, name, n, order=order, **axes)
        flat = inputs["particles"]
        by_particle = flat.reshape(-1, n, 4).swapaxes(0, 1) if layout != "aos" else flat.reshape(n, -1, 4)
        edge = sorting.grid_of(n).shape[0]
        cells = np.floor(by_particle[:, 0, :3] * np.float32(edge)).astype(int)
        keys = (cells[:, 2] * edge + cells[:, 1]) * edge + cells[:, 0]
        found = outputs["order"]
        assert (np.bincount(found, minlength=n) == 1).all(), "a permutation"
        assert (np.diff(keys[found]) >= 0).all(), "sorted by key"
        assert len(np.unique(keys)) < n, "some bins hold several particles"
        if layout:
            moved = outputs["sorted_particles"]
            after = moved.reshape(attributes, n, 4).swapaxes(0, 1) if layout == "soa" else moved.reshape(n, -1, 4)
            np.testing.assert_array_equal(after, by_particle[found], "every attribute moved")


@pytest.mark.parametrize("attributes", range(1, 9))
def test_every_number_of_attributes_moves(device, attributes: int) -> None:
    record = record_of(device, "reorder_deep", 500, attributes=attributes, layout="aos" if attributes % 2 else "soa")
    assert record.status == "ok"
    assert record.floor_bytes == 500 * (8 + 2 * 16 * attributes)


def corrupted(outputs, name: str, place: int, value) -> dict[str, np.ndarray]:
    copy = {key: array.copy() for key, array in outputs.items()}
    copy[name].reshape(-1)[place] = value
    return copy


def test_one_wrong_entry_is_refused(device) -> None:
    primitive = get("sort_deep")
    axes = resolve_axes(primitive, {"attributes": 2})
    inputs, outputs, _ = outputs_of(device, "sort_deep", 400, attributes=2)
    check = primitive.operation.check
    assert check(inputs, outputs, axes).passed
    first, last = outputs["order"][0], outputs["order"][-1]
    twice = check(inputs, corrupted(outputs, "order", 0, last), axes)
    assert (twice.passed, twice.quantity) == (False, "permutation")
    swapped = corrupted(corrupted(outputs, "order", 0, last), "order", -1, first)
    assert check(inputs, swapped, axes).quantity == "order of the keys"
    left_behind = check(inputs, corrupted(outputs, "sorted_particles", -1, 7.0), axes)
    assert (left_behind.passed, left_behind.quantity) == (False, "moved attributes")
    primitive = get("bin_particles")
    axes = resolve_axes(primitive, {})
    inputs, outputs, _ = outputs_of(device, "bin_particles", 400)
    for name, quantity in (("tickets", "bins"), ("bin_count", "counts")):
        assert primitive.operation.check(inputs, corrupted(outputs, name, 0, 10**6), axes).quantity == quantity
    assert primitive.operation.check(inputs, corrupted(outputs, "tickets", 1, 5), axes).quantity == "places"


def test_sorted_input_streams_and_random_input_scatters(device) -> None:
    """Counted sectors against a model over the tickets, 32 bytes each, warp by warp."""
    n = 4096
    for order in ORDERS:
        inputs, _, counters = outputs_of(device, "reorder_deep", n, order=order, attributes=2)
        tickets = inputs["tickets"]
        place = (inputs["bin_start"][tickets[:, 0]] + tickets[:, 1]).reshape(-1, 32)
        distinct = sum(len(np.unique(lanes * 16 // 32)) for lanes in place)
        starts = sum(len(np.unique(lanes * 4 // 32)) for lanes in tickets[:, 0].reshape(-1, 32))
        assert counters.total.gst_sectors == 2 * distinct
        # A ticket is read as its two halves, of the same sectors, or as a whole.
        tickets_read = counters.total.gld_sectors - starts - 2 * n // 2
        assert tickets_read in (n // 4, 2 * (n // 4))
    scattered = [outputs_of(device, "bin_particles", n, order=order)[2].total.gatom_sectors for order in ORDERS]
    assert scattered == sorted(scattered, reverse=True)
    assert len(set(scattered)) == len(ORDERS)


def test_traffic_of_a_sorted_reorder_is_at_its_floor(device) -> None:
    record = record_of(device, "reorder_deep", 2**16, order="sorted", attributes=8)
    assert record.transfer_counters is not None
    # The floor leaves out the first particle of each bin, since how many bins are read is up to the particles.
    starts = 4 * sorting.grid_of(2**16).node_count
    assert record.transfer_counters.total.sectors * 32 <= 1.05 * (record.floor_bytes + starts)
    index = record_of(device, "reorder_index", 2**16, order="sorted")
    assert index.floor_bytes < record.floor_bytes / 20


# --- motion -----------------------------------------------------------------------------------------------------------


def test_motion_stays_within_the_cfl_condition_and_on_the_grid() -> None:
    dataset = load_dataset("random", 4000, grid_shape=(20, 24, 28))
    ordered = in_bin_order(dataset)
    for steps, courant in ((0, 0.5), (1, 1.0), (7, 0.5), (500, 1.0)):
        moved = after_steps(dataset, steps, seed=4, courant=courant)
        distance = np.abs(moved.node_units() - ordered.node_units()).max()
        assert distance <= steps * courant + 0.002
        moved.check_support("quadratic")
        moved.check_support("cubic")
    assert distance > 10
    np.testing.assert_array_equal(moved.velocity, ordered.velocity)


def test_motion_follows_its_seed_and_lies_between_order_and_disorder() -> None:
    dataset = load_dataset("random", 4000, grid_shape=(20, 20, 20))
    first, again, other = (after_steps(dataset, 10, seed) for seed in (1, 1, 2))
    assert first.fingerprint == again.fingerprint != other.fingerprint
    jumps = [d.statistics["mean_jump_cells"] for d in (in_bin_order(dataset), first, dataset)]
    assert jumps == sorted(jumps)
    recipe = load_dataset("random_moved", 4000, grid_shape=(20, 20, 20))
    assert recipe.fingerprint == after_steps(dataset, 10, dataset.seed or 0).fingerprint
    with pytest.raises(InputError, match="want steps >= 0 and 0 to 1 cells"):
        after_steps(dataset, 3, 1, courant=1.5)


# --- compaction -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("percent", compaction.PERCENT)
@pytest.mark.parametrize("size", [1, 4095, 4097, 12_345])
def test_compaction_keeps_what_is_positive(device, percent: int, size: int) -> None:
    inputs, outputs, _ = outputs_of(device, "compact_blocks", size, percent=percent)
    expected = np.flatnonzero(inputs["values"] > 0)
    assert len(expected) == size * percent // 100
    assert outputs["count"][0] == len(expected)
    np.testing.assert_array_equal(outputs["list"][: len(expected)], expected)


def test_a_wrong_list_is_refused(device) -> None:
    inputs, outputs, _ = outputs_of(device, "compact_blocks", 500, percent=50)
    assert compaction.check(inputs, outputs, {}).passed
    shifted = compaction.check(inputs, corrupted(outputs, "list", 3, 0), {})
    assert (shifted.passed, shifted.quantity) == (False, "list")
    cut = compaction.check(inputs, corrupted(outputs, "count", 0, 249), {})
    assert (cut.passed, cut.quantity) == (False, "length of the list")


# --- library baseline -------------------------------------------------------------------------------------------------


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch) -> FakeGpu:
    machine = FakeGpu(capability="90", execute=on_the_engine(), seconds={"argsort": 0.003, "sort_index": 0.001})
    monkeypatch.setitem(sys.modules, "cupy", fake_cupy(machine))
    return machine


def test_the_librarys_sort_is_a_row_on_a_gpu_only(gpu: FakeGpu, device) -> None:
    cuda = devices.open_device("cuda")
    rules = Rules(min_rounds=1, max_rounds=1, warmup_limit=0)
    timing = Timing(rules=rules, sampling=Sampling(min_samples=2, max_samples=2, warmup_limit=0))
    for name, seconds in (("sort_library", 0.003), ("sort_index", 0.001)):
        primitive = get(name)
        axes = resolve_axes(primitive, {"order": "after_1"})
        case = PrimitiveCase(primitive, 1000, axes, SEED)
        (record,) = run_contest([case], cuda, Inputs(), Environment.capture(argv=[]), timing)
        assert record.status == "ok", record.failed_because
        assert record.transfer_measurement is not None
        assert record.transfer_measurement.median == pytest.approx(seconds, rel=0.1)
    assert gpu.details("argsort")[0] == 1000
    skipped = record_of(device, "sort_library", 1000)
    assert skipped.skipped_because == "runs on cuda only"


# --- published tables -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("table", [9, 10])
def test_published_rows_name_what_exists(table: int) -> None:
    with (DATASETS_FOLDER / "published" / f"thesis_table_{table}.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        primitive = get(row["variant"])
        axes = {name: row[name] for name in primitive.axes if row.get(name)}
        resolved = resolve_axes(primitive, axes)
        assert resolved["order"] == row["order"]
        assert int(row["size"]) == 1024 * 1024
    first = float(rows[0]["time_us"])
    for row in rows:
        if row["speedup"]:
            assert float(row["speedup"]) == pytest.approx(first / float(row["time_us"]), abs=0.006)
