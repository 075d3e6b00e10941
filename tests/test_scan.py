"""Scans: exact at every length, free of bank conflicts where the thesis says so, one pass in the best form."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from bank_model import of_threads, run_on

import mpmbench
from mpmbench import device as devices
from mpmbench.kernel import RAW_KERNELS
from mpmbench.operations import block_scan, scan
from mpmbench.primitives import Bench, discover, get, resolve_axes
from mpmbench.primitives.scan_lookback import SEGMENT, lookback, state_length

NAMES = [p.name for p in discover() if p.operation.name == "scan"]
SIZES = sorted({2**k + d for k in range(12, 23) for d in (-1, 0, 1)})
SEED = 6

# Small thread blocks make the pyramid tall; every value of every other axis takes its turn.
SHORT = [
    ("scan_interleaved", {"threads": 32, "padding": "none"}),
    ("scan_interleaved", {"threads": 1024, "padding": "full"}),
    ("scan_sequential", {"threads": 64, "loads": 2, "loop": "rolled"}),
    ("scan_sequential", {"threads": 128, "loads": 4, "loop": "unrolled"}),
    ("scan_shuffle", {"threads": 32}),
    ("scan_lookback", {}),
]


@pytest.fixture(scope="module")
def device():
    return devices.open_device("simulated", arch="sm_52", mode="run")


@pytest.fixture(scope="module")
def counting():
    return devices.open_device("simulated", arch="sm_52", mode="count")


@pytest.fixture(scope="module")
def values():
    return np.random.default_rng(SEED).integers(-1, 3, 2**22 + 1, dtype=np.int32)


@pytest.fixture(scope="module")
def sums(values):
    return np.concatenate([[0], np.cumsum(values, dtype=np.int64)]).astype(np.int32)


def bench_of(device, name: str, **axes) -> Bench:
    primitive = get(name)
    return Bench(primitive, resolve_axes(primitive, axes), 0, {}, device)


def scanned(bench: Bench, values: np.ndarray) -> np.ndarray:
    bench.size, bench.inputs = len(values), {"values": values}
    built = bench.primitive.build(bench)
    for launch in built.launches:
        bench.device.launch(launch)
    return built.outputs["scanned"][: len(values)]


def test_strategies_of_the_thesis_are_there() -> None:
    assert {"scan_interleaved", "scan_sequential", "scan_shuffle", "scan_lookback"} == set(NAMES)
    assert set(get("scan_interleaved").axes["padding"]) == {"none", "partial", "full"}
    assert set(get("scan_sequential").axes["loads"]) == {2, 4}


@pytest.mark.parametrize(("name", "axes"), SHORT, ids=str)
def test_every_short_length_is_exact(device, name: str, axes: dict, values, sums) -> None:
    bench = bench_of(device, name, **axes)
    for length in range(4101):
        assert np.array_equal(scanned(bench, values[:length]), sums[:length]), length


@pytest.mark.parametrize("name", NAMES)
def test_lengths_around_powers_of_two_are_exact(device, name: str, values, sums) -> None:
    bench = bench_of(device, name)
    for length in SIZES:
        assert np.array_equal(scanned(bench, values[:length]), sums[:length]), length


@pytest.mark.parametrize("loads", [2, 4])
@pytest.mark.parametrize("loop", ["rolled", "unrolled"])
def test_raking_is_exact_in_every_form(device, loop: str, loads: int, values, sums) -> None:
    bench = bench_of(device, "scan_sequential", loop=loop, loads=loads, padding="full")
    for length in (1, 1024 * loads - 1, 1024 * loads, 70_001):
        assert np.array_equal(scanned(bench, values[:length]), sums[:length]), length


@pytest.mark.parametrize(
    ("far", "known"), [(0, 49), (30, 19), (31, 18), (32, 17), (45, 4), (49, 0)], ids=lambda number: str(number)
)
def test_look_back_walks_over_segments_that_know_only_their_sum(device, far: int, known: int) -> None:
    """As on a GPU, where segments run at once: the nearest known prefix stands ``far`` segments before the last."""
    rng = np.random.default_rng(SEED)
    segment, own = 50, rng.integers(0, 9, 50)
    count = 51 * SEGMENT
    values = np.zeros(count, np.int32)
    values[segment * SEGMENT :] = rng.integers(0, 9, SEGMENT)
    words = np.zeros(51, np.uint64)
    for other in range(segment):
        status, number = (2, own[: other + 1].sum()) if other <= known else (1, own[other])
        words[other] = status << 32 | int(number)
    assert far == segment - 1 - known
    state = device.upload(np.concatenate([np.array([segment, 0], np.int32), words.view(np.int32)]))
    bench, out = bench_of(device, "scan_lookback"), device.empty((count,), np.int32)
    _, launch = lookback(bench, count, device.upload(values), out, state)
    device.launch(type(launch)(launch.name, launch.kernel, (1, 1, 1), launch.block, launch.args))
    last = values[segment * SEGMENT :]
    np.testing.assert_array_equal(out[segment * SEGMENT :], own.sum() + np.cumsum(last) - last)
    published = int(state[2:].view(np.uint64)[segment])
    assert (published >> 32, published & 0xFFFFFFFF) == (2, own.sum() + last.sum())


def test_negative_sums_survive_the_packed_word(device) -> None:
    values = np.full(3 * SEGMENT, -5, np.int32)
    out = scanned(bench_of(device, "scan_lookback"), values)
    np.testing.assert_array_equal(out, -5 * np.arange(3 * SEGMENT))


def test_check_sees_one_wrong_place() -> None:
    inputs = scan.inputs({}, 500, SEED)
    right = np.cumsum(inputs["values"]) - inputs["values"]
    assert scan.check(inputs, {"scanned": right}, {}).passed
    for place in (0, 250, 499):
        wrong = right + (np.arange(500) == place)
        assert not scan.check(inputs, {"scanned": wrong}, {}).passed


def test_state_holds_a_ticket_and_a_word_per_segment() -> None:
    assert [state_length(n) for n in (0, 1, SEGMENT, SEGMENT + 1)] == [4, 4, 4, 6]


def test_no_second_scan_is_written_anywhere() -> None:
    """Shuffle scans stand in one header, look-back in one kernel, and sorting takes them from there."""
    texts = {path.name: path.read_text() for path in sorted(RAW_KERNELS.iterdir())}
    assert [name for name, text in texts.items() if "__shfl_up_sync" in text] == ["operators.cuh"]
    assert [name for name, text in texts.items() if "look_back(" in text] == ["scan_lookback.cu"]
    preprocess = (Path(mpmbench.__file__).parent / "preprocess.py").read_text()
    assert re.findall(r"\blookback\(", preprocess) == ["lookback("] * 2


# --- banks and bytes --------------------------------------------------------------------------------------------------


def pad(place: int, padding: str) -> int:
    """Eq. 141 (partial) and eq. 142 (full)."""
    return place + {"none": 0, "partial": place // 32, "full": place // 32 + place // 1024}[padding]


def tree_accesses(leaves: int, threads: int, padding: str) -> list[tuple[list[int | None], int]]:
    """Byte addresses and widths of a work-efficient scan of ``leaves`` places, access by access."""

    def step(apart: int, of: int) -> list[int | None]:
        return [
            4 * pad(apart * (2 * t + of) - 1, padding) if t < leaves // 2 // apart else None for t in range(threads)
        ]

    steps = [2**k for k in range(leaves.bit_length() - 1)]
    accesses: list[tuple[list[int | None], int]] = []
    for apart in steps:  # tile[high] += tile[low]
        low, high = step(apart, 1), step(apart, 2)
        accesses += [(low, 4), (high, 4), (high, 4)]
    root: list[int | None] = [4 * pad(leaves - 1, padding), *[None] * (threads - 1)]
    accesses += [(root, 4)] * 2  # the total is read, the root cleared
    for apart in reversed(steps):  # tile[low], tile[high] = tile[high], tile[low] + tile[high]
        low, high = step(apart, 1), step(apart, 2)
        accesses += 2 * [(low, 4), (high, 4)]
    return accesses


@pytest.mark.parametrize("padding", ["none", "partial", "full"])
@pytest.mark.parametrize("threads", [1024, 512, 128])
def test_wavefronts_of_the_tree_follow_from_addresses(counting, threads: int, padding: str, values) -> None:
    leaves = 2 * threads
    ends = [([4 * pad(t + half * threads, padding) for t in range(threads)], 4) for half in (0, 1)]
    accesses = [*ends, *tree_accesses(leaves, threads, padding), *ends]
    expected = np.sum([of_threads(*access) for access in accesses], axis=0)
    axes = {"threads": threads, "padding": padding}
    _, counters = run_on(counting, get("scan_interleaved"), values[:leaves], **axes)
    total = counters.total
    requests, wavefronts = expected
    assert (total.sld_req + total.sst_req, total.shm_wavefronts) == (requests, wavefronts)
    # Partial padding leaves conflicts in thread blocks of 1024 only, full padding in none: the thesis's claim.
    free = padding == "full" or (padding == "partial" and threads < 1024)
    assert (wavefronts == requests) == free


@pytest.mark.parametrize("loads", [2, 4])
def test_raking_has_no_conflicts_and_fewer_barriers(counting, loads: int, values) -> None:
    length = 2**14
    _, tree = run_on(counting, get("scan_interleaved"), values[:length])
    _, raking = run_on(counting, get("scan_sequential"), values[:length], loads=loads, padding="full")
    total = raking.total
    assert total.shm_wavefronts == total.sld_req + total.sst_req
    assert total.lld_req == 0, "unrolled values stay in registers"
    assert total.bar < tree.total.bar


def test_rolled_loops_put_values_in_local_memory(counting, values) -> None:
    _, counters = run_on(counting, get("scan_sequential"), values[:4096], loop="rolled", loads=4)
    assert counters.total.lld_req > 0


@pytest.mark.parametrize("name", ["scan_shuffle", "scan_lookback"])
def test_shuffles_share_no_bank(counting, name: str, values) -> None:
    _, counters = run_on(counting, get(name), values[: 2**15])
    assert counters.total.shm_wavefronts == counters.total.sld_req + counters.total.sst_req


def test_best_form_moves_little_more_than_it_must(counting, values) -> None:
    length = 2**18
    _, counters = run_on(counting, get("scan_lookback"), values[:length])
    assert 1 <= 32 * counters.total.sectors / scan.floor({}, length) < 1.05


# --- inside blocks ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(8, 4, 4), (3, 5, 2), (1, 1, 1), (2, 8, 8), (1, 14, 7)], ids=str)
def test_block_scan_from_the_grids_scan(device, shape) -> None:
    """Against the definition, cell by cell, on a grid that blocks do not divide."""
    primitive = get("block_scan_rows")
    grid = block_scan.grid_of(13 * 13 * 17)
    assert grid.shape == (14, 14, 14)
    axes = resolve_axes(primitive, {"block_shape": shape})
    inputs = block_scan.inputs(axes, grid.node_count, SEED)
    built = primitive.build(Bench(primitive, axes, grid.node_count, inputs, device))
    for launch in built.launches:
        device.launch(launch)
    counts = inputs["counts"].reshape(grid.shape)  # z, y, x
    running: dict[tuple[int, ...], int] = {}
    expected = np.zeros_like(counts)
    for z, y, x in np.ndindex(grid.shape):  # inside a block this is its own order
        block = (z // shape[2], y // shape[1], x // shape[0])
        expected[z, y, x] = running.get(block, 0)
        running[block] = int(expected[z, y, x] + counts[z, y, x])
    result = built.outputs["block_scanned"]
    np.testing.assert_array_equal(result.reshape(grid.shape), expected)
    assert block_scan.check(inputs, {"block_scanned": result}, axes).passed
    assert not block_scan.check(inputs, {"block_scanned": result + (np.arange(len(result)) == 99)}, axes).passed


def test_a_block_of_too_many_threads_says_so() -> None:
    assert "2048 cells" in (block_scan.requires({"block_shape": (16, 16, 8)}) or "")
