"""Every strategy against the float64 reference, and every strategy what it says it is, by count."""

from __future__ import annotations

import itertools
import math
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from pairwise import covering_rows, pairs_of
from transfers import crowded, filled, make_plan, transfer

from mpmbench import device as devices
from mpmbench.awkward import awkward_datasets
from mpmbench.device import Launch
from mpmbench.errors import InputError
from mpmbench.kernel import RAW_KERNELS, KernelSource, load_source
from mpmbench.plan import build_plan, floor_bytes, predict_bytes, touched_nodes
from mpmbench.variants import AXES, discover, get, resolve_axes, why_impossible
from mpmbench.workspace import buffer_table, kernel_constants

VARIANTS = discover()
NAMES = [variant.name for variant in VARIANTS]
BLOCK_VARIANTS = [variant.name for variant in VARIANTS if variant.uses_blocks]
SPLINES = AXES["spline"]
COVERING_SEED = 1
QUICK = {"writing": "literal"}  # where counts do not depend on the writing: rolled loops compile several times faster


@pytest.fixture(scope="module")
def device():
    return devices.open_device("simulated", arch="sm_52", mode="run")


@pytest.fixture(scope="module")
def counting():
    return devices.open_device("simulated", arch="sm_52", mode="count")


def tally(device, name: str, dataset, **axes):
    """Counters of the transfer itself, after its result has passed the check."""
    check, report, findings = transfer(get(name), dataset, device, **axes)
    assert check.passed, f"{name}: {check}"
    assert not findings
    return report.counters.total


# --- results ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("spline", SPLINES)
@pytest.mark.parametrize("name", NAMES)
def test_awkward_datasets(device, name: str, spline: str) -> None:
    for dataset in awkward_datasets(spline).values():
        check, _, findings = transfer(get(name), dataset, device, spline=spline)
        assert check.passed, f"{dataset.name}: {check}"
        assert not findings


def covering_array() -> list[dict]:
    choices = [{"variant": (v.name,), **v.axes} for v in VARIANTS]
    return covering_rows(choices, possible, COVERING_SEED)


def possible(row: dict) -> bool:
    axes = dict(row)
    return why_impossible(get(axes.pop("variant")), axes) is None


def row_name(row: dict) -> str:
    return "-".join("x".join(map(str, v)) if isinstance(v, tuple) else str(v) for v in row.values())


@pytest.mark.parametrize("row", covering_array(), ids=row_name)
def test_pairwise_axes(device, row: dict) -> None:
    axes = dict(row)
    variant = get(axes.pop("variant"))
    check, _, _ = transfer(variant, crowded(), device, **axes)
    assert check.passed, str(check)


@pytest.mark.parametrize("block_shape", [(1, 1, 1), (2, 3, 7), (33, 1, 1)], ids=str)
@pytest.mark.parametrize("name", BLOCK_VARIANTS)
def test_any_block_shape(device, name: str, block_shape: tuple[int, int, int]) -> None:
    """One cell, no multiple of a warp, one thread more than a warp."""
    axes = {"spline": "linear", "writing": "literal", "cell_index": "block", "batching": 2}
    check, _, _ = transfer(get(name), crowded(), device, block_shape=block_shape, **axes)
    assert check.passed, str(check)


def test_covering_array_covers_every_possible_pair() -> None:
    covered = set().union(*map(pairs_of, covering_array()))
    for variant in VARIANTS:
        names = sorted({"variant": (variant.name,), **variant.axes})
        for a, b in itertools.combinations(names, 2):
            a_values, b_values = ((variant.name,) if n == "variant" else variant.axes[n] for n in (a, b))
            for x, y in itertools.product(a_values, b_values):
                axes = {k: v for k, v in ((a, x), (b, y)) if k != "variant"}
                if why_impossible(variant, resolve_axes(variant, axes)) is None:
                    assert ((a, x), (b, y)) in covered


@pytest.mark.parametrize("name", NAMES)
def test_repeats_on_the_same_buffers_agree(device, name: str) -> None:
    plan = make_plan(get(name), crowded(), device)
    plan.run_once(device)
    first = plan.outputs()
    plan.run_once(device)
    for before, after in zip(vars(first).values(), vars(plan.outputs()).values(), strict=True):
        np.testing.assert_array_equal(before, after)


# --- each is what it says, by count -----------------------------------------------------------------------------------


def test_global_atomic_adds_every_node_of_every_particle(counting) -> None:
    dataset = crowded()
    total = tally(counting, "p2g_global_atomic", dataset)
    assert total.gatom_lane == 64 * 4 * dataset.particle_count
    assert total.satom_lane == total.bar == 0


def test_global_node_has_a_thread_per_particle_and_node(counting) -> None:
    dataset = crowded()
    total = tally(counting, "p2g_global_node", dataset)
    pairs = 64 * dataset.particle_count
    assert total.gatom_lane == 4 * pairs
    assert total.gatom_req == 4 * math.ceil(pairs / 32), "all lanes of a warp add at the same time"
    (launch,) = make_plan(get("p2g_global_node"), dataset, counting).transfer.launches
    threads = launch.grid[0] * launch.block[0]
    assert 0 <= threads - pairs < launch.block[0]


@pytest.mark.parametrize("blocks", ["active", "all"])
def test_pull_has_no_atomics_and_stores_each_node_once(counting, blocks: str) -> None:
    dataset = crowded()
    total = tally(counting, "p2g_block_pull", dataset, blocks=blocks, **QUICK)
    assert total.gatom_req == total.satom_req == 0
    if blocks == "all":
        # A warp covers 8 x 4 nodes of one layer of a block; only layers past the last node of the grid store nothing.
        bx, by, _ = dataset.grid.blocks((8, 4, 4))
        assert total.gst_req == bx * by * dataset.grid.shape[2]


def _thread_blocks(device, name: str, dataset, **axes) -> int:
    plan = make_plan(get(name), dataset, device, **axes)
    plan.run_once(device)
    return sum(launch.grid[0] for launch in plan.transfer.launches)


@pytest.mark.parametrize("batching", AXES["batching"])
def test_sync_has_one_barrier_per_node_step_and_no_shared_atomics(counting, batching: int) -> None:
    dataset = crowded()
    plan = make_plan(get("p2g_block_sync"), dataset, counting, batching=batching, **QUICK)
    plan.run_once(counting)
    maxima = np.asarray(counting.download(plan.work.block_maximum))
    rounds = sum(math.ceil(m / batching) for m in maxima)
    warps = 8 * 4 * 4 // 32
    total = tally(counting, "p2g_block_sync", dataset, batching=batching, **QUICK)
    assert total.satom_req == 0
    assert total.bar == warps * (plan.work.active_count + 64 * rounds)


@pytest.mark.parametrize("batching", AXES["batching"])
def test_block_atomic_adds_in_shared_memory(counting, batching: int) -> None:
    dataset = crowded()
    total = tally(counting, "p2g_block_atomic", dataset, batching=batching, **QUICK)
    cells = np.floor(dataset.node_units(np.float32)).astype(int)
    counts = np.unique(cells, axis=0, return_counts=True)[1]
    assert total.satom_lane == 64 * 4 * sum(math.ceil(c / batching) for c in counts)
    blocks = _thread_blocks(counting, "p2g_block_atomic", dataset, batching=batching, **QUICK)
    assert total.bar == 4 * 2 * blocks, "before and after the particles, never in between"


@pytest.mark.parametrize(("name", "counter"), [("p2g_block_sync", "bar"), ("p2g_block_atomic", "satom_lane"),
                                               ("p2g_block_pull", "bar")])  # fmt: skip
@pytest.mark.parametrize("batching", [2, 4, 8])
def test_batching_divides_where_cells_are_full(counting, name: str, counter: str, batching: int) -> None:
    # For the pull, 8 staged particles per bin must fit.
    axes: dict = QUICK | ({"block_shape": (2, 2, 2)} if name == "p2g_block_pull" else {})
    dataset = filled(8)
    single, batched = (
        getattr(tally(counting, name, dataset, batching=b, **axes), counter)
        - (_setup_barriers(counting, name, dataset, **axes) if counter == "bar" else 0)
        for b in (1, batching)
    )
    assert single == batching * batched > 0


def _setup_barriers(device, name: str, dataset, **axes) -> int:
    """The barrier of each warp before the particles."""
    threads = math.prod(axes.get("block_shape", (8, 4, 4)))
    return math.ceil(threads / 32) * _thread_blocks(device, name, dataset, **axes)


@pytest.mark.parametrize(
    ("name", "weights"),
    [(v.name, "unity") for v in VARIANTS if len(v.axes["writing"]) > 1]
    + [("p2g_block_sync", "plain"), ("g2p_block_gather", "plain")],
)
def test_literal_writing_is_not_optimised_into_the_hoisted_one(counting, name: str, weights: str) -> None:
    literal, hoisted = (
        tally(counting, name, filled(2), writing=w, weights=weights).lane_inst for w in ("literal", "hoisted")
    )
    assert literal >= 1.5 * hoisted


@pytest.mark.parametrize("name", BLOCK_VARIANTS)
def test_active_list_skips_empty_blocks(counting, name: str) -> None:
    dataset = filled(1)
    launched = {b: _thread_blocks(counting, name, dataset, blocks=b, **QUICK) for b in ("active", "all")}
    assert launched["all"] == math.prod(dataset.grid.blocks((8, 4, 4)))
    assert 0 < launched["active"] < launched["all"]


# --- axes, sizes and a user's own -------------------------------------------------------------------------------------


def test_axes_are_checked() -> None:
    variant = get("p2g_block_sync")
    assert resolve_axes(variant, {"block_shape": "4x4x4", "batching": "4"}) == resolve_axes(
        variant, {"block_shape": [4, 4, 4], "batching": 4}
    )
    assert resolve_axes(variant, {"dtype": np.float64})["dtype"] == "float64"
    for bad, hint in (
        ({"batches": 2}, "valid are dtype"),
        ({"batching": 3}, "valid are 1, 2, 4, 8"),
        ({"spline": "quartic"}, "valid are cubic"),
        ({"block_shape": "4x4"}, "three positive"),
        ({"block_shape": (0, 4, 4)}, "three positive"),
    ):
        with pytest.raises(InputError, match=hint):
            resolve_axes(variant, bad)
    with pytest.raises(InputError, match="valid are g2p_block_gather"):
        get("p2g_magic")


@pytest.mark.parametrize(
    ("name", "axes", "reason"),
    [
        ("p2g_block_sync", {"particle_order": "given"}, "valid are deep, index"),
        ("p2g_block_sync", {"block_shape": (16, 16, 8)}, "2048 threads"),
        ("p2g_block_sync", {"block_shape": (32, 8, 4), "dtype": "float64"}, "shared memory"),
        ("p2g_block_pull", {"payload": "apic", "dtype": "float64"}, "shared memory"),
        ("p2g_block_pull", {"batching": 4}, "shared memory"),
        ("p2g_global_node", {"writing": "hoisted"}, "valid are literal"),
    ],
)
def test_what_cannot_exist_says_why(device, name: str, axes: dict, reason: str) -> None:
    variant = get(name)
    resolved = resolve_axes(variant, axes)
    assert reason in why_impossible(variant, resolved)
    with pytest.raises(InputError, match=re.escape(reason)):
        build_plan(variant, crowded(), device, resolved)


@pytest.mark.parametrize("name", BLOCK_VARIANTS)
@pytest.mark.parametrize(
    "axes",
    [
        {},
        {"dtype": "float64", "spline": "linear"},
        {"payload": "apic", "block_shape": (4, 4, 2)},
        {"batching": 2, "block_shape": (3, 5, 2)},
    ],
    ids=str,
)
def test_shared_memory_is_what_the_limit_assumes(monkeypatch, name: str, axes: dict) -> None:
    """Ask for one byte less than the kernel declares: the reason must name exactly that size."""
    from mpmbench import variants
    from mpmbench.kernel import COMPILE_OPTIONS
    from mpmbench.simt.nvrtc import compile_cuda

    variant = get(name)
    resolved = resolve_axes(variant, axes)
    ptx = compile_cuda(load_source(name, kernel_constants(resolved)).text, "sm_52", COMPILE_OPTIONS)
    declared = sum(map(int, re.findall(r"\.shared .*\[(\d+)\];", ptx)))
    assert declared > 0
    monkeypatch.setattr(variants, "SHARED_LIMIT", declared - 1)
    assert f"needs {declared} bytes" in why_impossible(variant, resolved)
    monkeypatch.setattr(variants, "SHARED_LIMIT", declared)
    assert why_impossible(variant, resolved) is None


def test_without_contraction_results_are_right_and_rounded_otherwise(counting) -> None:
    dataset, mass, count = crowded(), {}, {}
    for contraction in AXES["contraction"]:
        plan = make_plan(get("p2g_block_sync"), dataset, counting, contraction=contraction, **QUICK)
        plan.run_once(counting)
        mass[contraction] = plan.outputs().mass
        count[contraction] = tally(counting, "p2g_block_sync", dataset, contraction=contraction, **QUICK).lane_inst
    assert count["none"] > count["fma"], "a product and a sum are two instructions"
    assert (mass["none"] != mass["fma"]).any()


def test_fast_math_of_a_kernel_that_divides(device) -> None:
    """Division, root and functions become approximate ones, which agree to a few units of the last place."""
    text = """extern "C" __global__ void divides(const float* x, float* y) {
        const int i = threadIdx.x;
        y[i] = x[i] / (x[i] + 2) + sqrtf(x[i]) * expf(x[i]) - rsqrtf(x[i]); }"""
    source = KernelSource("divides", text, (), "fast", ("--use_fast_math",))
    ptx = device.ptx(source)
    assert {"div.approx", "sqrt.approx", "ex2.approx", "rsqrt.approx"} <= set(re.findall(r"[a-z0-9]+\.approx", ptx))
    x = np.linspace(0.1, 3, 64, dtype=np.float32)
    y = device.empty(64, np.float32)
    device.launch(Launch("divides", device.compile(source, "divides"), (1, 1, 1), (64, 1, 1), (device.upload(x), y)))
    exact = x.astype(float)
    want = exact / (exact + 2) + np.sqrt(exact) * np.exp(exact) - 1 / np.sqrt(exact)
    np.testing.assert_allclose(device.download(y), want, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_memory_is_predicted_before_it_is_taken(device, monkeypatch, name: str) -> None:
    taken = {}
    for method in ("empty", "upload"):
        real = getattr(device, method)

        def spy(*args, real=real, **kwargs):
            array = real(*args, **kwargs)
            taken[id(array)] = (array.nbytes, array)
            return array

        monkeypatch.setattr(device, method, spy)
    dataset = crowded()
    plan = make_plan(get(name), dataset, device, particle_order="deep")
    axes = plan.work.axes
    assert plan.device_bytes == predict_bytes(get(name), dataset, axes) == sum(size for size, _ in taken.values())
    assert set(plan.work.buffers) == set(buffer_table(get(name), dataset.grid, dataset.particle_count, axes))


def test_floor_counts_particles_and_touched_nodes_once() -> None:
    dataset = filled(1, cells=(1, 1, 1))
    assert [touched_nodes(dataset, spline, np.float32) for spline in ("linear", "quadratic", "cubic")] == [8, 27, 64]
    axes = resolve_axes(get("p2g_global_atomic"), {"payload": "apic", "dtype": "float64"})
    assert floor_bytes(get("p2g_global_atomic"), dataset, axes) == 32 * (5 + 64)
    axes = resolve_axes(get("g2p_global_gather"), {})
    assert floor_bytes(get("g2p_global_gather"), dataset, axes) == 16 * (2 + 64)


OWN_MODULE = '''"""P2G as shipped, under a name of its own.

Idea: show that a folder is enough.
"""

from mpmbench.variants import GLOBAL_AXES, Variant, p2g_floor


def launch(work):
    return work.cover(work.particle_count, work.domain, work.count, work.particles, work.order, work.nodes)


VARIANT = Variant(
    name="p2g_global_own", summary="a user's own", transfer="p2g", kernel="p2g_global_own", needs=(),
    axes=GLOBAL_AXES, launch=launch, floor=p2g_floor, reference="none",
)
'''


def own_folder(tmp_path: Path) -> Path:
    (tmp_path / "p2g_global_own.py").write_text(OWN_MODULE)
    kernel = (RAW_KERNELS / "p2g_global_atomic.cu").read_text()
    (tmp_path / "p2g_global_own.cu").write_text(kernel.replace("p2g_global_atomic", "p2g_global_own"))
    return tmp_path


def test_a_bad_folder_gets_one_clear_line(tmp_path: Path) -> None:
    def refuse(match: str) -> None:
        with pytest.raises(InputError, match=match) as caught:
            discover([tmp_path])
        assert "\n" not in str(caught.value)

    with pytest.raises(InputError, match="does not exist"):
        discover([tmp_path / "nowhere"])
    refuse("no Python module")
    own_folder(tmp_path)
    (tmp_path / "p2g_global_own.cu").unlink()
    refuse(r"p2g_global_own\.cu does not exist")
    shutil.copy(RAW_KERNELS / "p2g_global_atomic.cu", tmp_path)
    module = tmp_path / "p2g_global_own.py"
    module.write_text(OWN_MODULE.replace("p2g_global_own", "p2g_global_atomic"))
    refuse("is taken by")
    module.write_text(OWN_MODULE.replace('"p2g", ker', '"g2g", ker'))
    refuse("it must be 'p2g' or 'g2p'")
    module.write_text("VARIANT = 3")
    refuse("has no VARIANT")
    module.write_text("1 / 0")
    refuse("ZeroDivisionError")
