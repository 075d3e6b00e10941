"""Reductions: exact on integers at every length, within rounding elsewhere, and the banks and bytes they promise."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from bank_model import of_threads, run_on

from mpmbench import device as devices
from mpmbench.check import CheckResult
from mpmbench.operations import reduce
from mpmbench.primitive_runs import build_primitive
from mpmbench.primitives import Bench, discover, get, resolve_axes, why_impossible

NAMES = [p.name for p in discover() if p.operation.name == "reduce"]
INTEGERS = {"element": "int", "operator": "identity_add"}
SIZES = sorted({2**k + d for k in range(12, 23) for d in (-1, 0, 1)})
SEED = 5


@pytest.fixture(scope="module")
def device():
    return devices.open_device("simulated", arch="sm_52", mode="run")


@pytest.fixture(scope="module")
def counting():
    return devices.open_device("simulated", arch="sm_52", mode="count")


@pytest.fixture(scope="module")
def integers():
    return np.random.default_rng(SEED).integers(-1000, 1001, 2**22 + 1, dtype=np.int32)


def total_of(bench: Bench, values: np.ndarray) -> int:
    bench.size, bench.inputs = len(values), {"values": values}
    built = bench.primitive.build(bench)
    for launch in built.launches:
        bench.device.launch(launch)
    return int(built.outputs["result"][0, 0])


def bench_of(device, name: str, **axes) -> Bench:
    primitive = get(name)
    return Bench(primitive, resolve_axes(primitive, INTEGERS | axes), 0, {}, device)


def test_strategies_of_the_thesis_are_there() -> None:
    assert {"reduce_interleaved", "reduce_sequential", "reduce_shuffle"} <= set(NAMES)
    assert set(get("reduce_sequential").axes["loads"]) == {2**k for k in range(9)}


@pytest.mark.parametrize("name", NAMES)
def test_every_short_length_is_exact(device, name: str, integers) -> None:
    # Two levels or three from length 65 on: small thread blocks make the pyramid tall.
    bench = bench_of(device, name, threads=64)
    sums = np.concatenate([[0], np.cumsum(integers[:4100], dtype=np.int64)])
    for length in range(4101):
        assert total_of(bench, integers[:length]) == sums[length], length


@pytest.mark.parametrize("name", NAMES)
def test_lengths_around_powers_of_two_are_exact(device, name: str, integers) -> None:
    bench = bench_of(device, name)
    for length in SIZES:
        assert total_of(bench, integers[:length]) == integers[:length].sum(dtype=np.int64), length


@pytest.mark.parametrize("threads", [1024, 64, 32])
def test_threads_that_stay_at_their_places_are_exact(device, threads: int, integers) -> None:
    bench = bench_of(device, "reduce_interleaved", index="remainder", threads=threads)
    for length in (0, 1, 31, 33, 1023, 1025, 4099):
        assert total_of(bench, integers[:length]) == integers[:length].sum(dtype=np.int64), length


@pytest.mark.parametrize("loads", [2, 16, 256])
def test_sequential_loads_are_exact(device, loads: int, integers) -> None:
    bench = bench_of(device, "reduce_sequential", loads=loads)
    for length in (0, 1, 1023 * loads, 1024 * loads, 1024 * loads + 1, 300_001):
        assert total_of(bench, integers[:length]) == integers[:length].sum(dtype=np.int64), length


@pytest.mark.parametrize("name", NAMES)
def test_maximum_sees_every_place(device, name: str) -> None:
    """One large value among small ones, wherever it stands; where all are negative, none may be invented."""
    bench = bench_of(device, name, operator="identity_max", threads=64)
    values = np.full(700, -7, np.int32)
    for place in range(700):
        values[place] = -3
        assert total_of(bench, values) == -3, place
        values[place] = -7
    assert total_of(bench, values) == -7
    assert total_of(bench, values[:0]) == np.iinfo(np.int32).min


CHOICES = list(itertools.product(reduce.ELEMENTS, reduce.OPERATORS))


@pytest.mark.parametrize(("element", "operator"), CHOICES)
def test_operators_agree_with_float64(device, element: str, operator: str) -> None:
    """Each with one strategy in turn: the operators are one text for all of them."""
    primitive = get(NAMES[CHOICES.index((element, operator)) % len(NAMES)])
    axes = resolve_axes(primitive, {"element": element, "operator": operator, "threads": 128})
    if reason := why_impossible(primitive, axes):
        assert "float4" in reason
    else:
        check = verdict(device, primitive, axes, 777)
        assert check.passed, f"{primitive.name}: {check}"


def verdict(device, primitive, axes, size: int) -> CheckResult:
    inputs = reduce.inputs(axes, size, SEED)
    built = build_primitive(primitive, device, axes, inputs, size)
    for launch in built.launches:
        device.launch(launch)
    return reduce.check(inputs, {name: device.download(array) for name, array in built.outputs.items()}, axes)


def test_references_are_what_the_method_asks_for() -> None:
    """One particle by hand: its momentum, and the bound |v| + kappa dx |C| on the speed of nodes."""
    inputs = np.zeros((5, 1, 4))
    inputs[0, 0], inputs[1, 0, :3] = (9, 9, 9, 2), (3, 0, 4)
    inputs[2:, 0, :3] = np.eye(3)
    for operator, expected in (
        ("momentum_add", [6, 0, 8, 2]),
        ("speed_max", [5 + 2 * math.sqrt(3) / 128 * math.sqrt(3)]),
        ("length_add", [math.sqrt(247) + 5 + 3]),
    ):
        axes = {"element": "double4", "operator": operator, "threads": 128}
        attributes = {"momentum_add": 2}.get(operator, 5)
        values = {"values": inputs[:attributes].reshape(-1, 4)}
        assert reduce.check(values, {"result": np.array([expected])}, axes).passed
        worse = np.array([expected]) + 1e-9
        assert not reduce.check(values, {"result": worse}, axes).passed


# --- banks and bytes --------------------------------------------------------------------------------------------------


Access = tuple[list[int | None], int]  # byte address of each thread, bytes


def interleaved_accesses(threads: int) -> list[Access]:
    """The store before the tree, then two loads and a store per step, and the load of the result."""
    accesses: list[Access] = [([4 * t for t in range(threads)], 4)]
    apart = 1
    while apart < threads:
        low = [8 * apart * t if 2 * apart * t < threads else None for t in range(threads)]
        high = [None if address is None else address + 4 * apart for address in low]
        # Partners side by side are one access of eight bytes.
        accesses += [(low, 8), (low, 4)] if apart == 1 else [(low, 4), (high, 4), (low, 4)]
        apart *= 2
    return [*accesses, ([0, *[None] * (threads - 1)], 4)]


def sequential_accesses(threads: int) -> list[Access]:
    accesses: list[Access] = [([4 * t for t in range(threads)], 4)]
    half = threads // 2
    while half:
        low = [4 * t if t < half else None for t in range(threads)]
        high = [None if address is None else address + 4 * half for address in low]
        accesses += [(low, 4), (high, 4), (low, 4)]
        half //= 2
    return [*accesses, ([0, *[None] * (threads - 1)], 4)]


@pytest.mark.parametrize("threads", [1024, 128])
@pytest.mark.parametrize(
    ("name", "accesses"), [("reduce_interleaved", interleaved_accesses), ("reduce_sequential", sequential_accesses)]
)
def test_wavefronts_follow_from_addresses(counting, name: str, accesses, threads: int, integers) -> None:
    values = integers[:threads].astype(np.float32)[:, None]
    axes = {"element": "float", "operator": "identity_add", "threads": threads}
    _, counters = run_on(counting, get(name), values, **axes)
    requests, expected = np.sum([of_threads(*access) for access in accesses(threads)], axis=0)
    total = counters.total
    assert (total.sld_req + total.sst_req, total.shm_wavefronts) == (requests, expected)
    assert (expected == requests) == (name == "reduce_sequential")


def test_a_remainder_shares_no_bank_and_keeps_every_warp_in_every_step(counting, integers) -> None:
    """Harris's first kernel: each warp takes all ten steps, from the sixth on ever fewer have work in them."""
    values = integers[:1024].astype(np.float32)[:, None]
    axes = {"element": "float", "operator": "identity_add"}
    strided, remainder = (
        run_on(counting, get("reduce_interleaved"), values, index=index, **axes)[1].total
        for index in ("strided", "remainder")
    )
    assert remainder.shm_wavefronts == remainder.sld_req + remainder.sst_req
    # The store before the tree, three accesses a step by the warps with a worker, and the load of the result.
    assert remainder.sld_req + remainder.sst_req == 32 + 3 * (5 * 32 + 16 + 8 + 4 + 2 + 1) + 1
    assert remainder.warp_inst > 2 * strided.warp_inst


@pytest.mark.parametrize("element", reduce.ELEMENTS)
@pytest.mark.parametrize("name", ["reduce_sequential", "reduce_shuffle"])
def test_no_conflicts_whatever_the_element(counting, name: str, element: str) -> None:
    axes = {"element": element, "operator": "identity_add", "threads": 256}
    size = 4096
    values = reduce.inputs(axes, size, SEED)["values"]
    _, counters = run_on(counting, get(name), values, **axes)
    small, total = min(reduce.number_type(element).itemsize * reduce.components(element), 16) // 4, counters.total
    # A full warp of 4, 8 or 16 bytes per lane takes 1, 2 or 4 wavefronts at best; fewer lanes may take fewer.
    assert total.shm_wavefronts <= small * (total.sld_req + total.sst_req)


@pytest.mark.parametrize("element", ["float", "float4", "double"])
def test_best_form_moves_little_more_than_it_must(counting, element: str) -> None:
    """A lane moves at most 16 bytes per request: a double4 takes two, and each touches every sector."""
    axes = resolve_axes(get("reduce_shuffle"), {"element": element, "operator": "length_add"})
    values = reduce.inputs(axes, 2**18, SEED)["values"]
    _, counters = run_on(counting, get("reduce_shuffle"), values, **axes)
    assert 1 <= 32 * counters.total.sectors / reduce.floor(axes, 2**18) < 1.05
