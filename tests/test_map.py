"""One declaration, three layouts: values arrive, and a warp touches exactly the sectors that the layout implies."""

from __future__ import annotations

import numpy as np
import pytest

from mpmbench import device as devices
from mpmbench.device import run_all
from mpmbench.kernel import RAW_KERNELS
from mpmbench.layout import LAYOUTS, Declaration, capacity
from mpmbench.operations.map import DECLARATIONS, MAP
from mpmbench.primitive_runs import build_primitive
from mpmbench.primitives import get, resolve_axes

SEED = 7


@pytest.fixture(scope="module")
def device():
    return devices.open_device("simulated", arch="sm_52", mode="count")


def run(device, size: int, **axes):
    primitive = get("map_length")
    resolved = resolve_axes(primitive, axes)
    inputs = MAP.inputs(resolved, size, SEED)
    built = build_primitive(primitive, device, resolved, inputs, size)
    report = run_all(device, built.launches)
    outputs = {name: device.download(array) for name, array in built.outputs.items()}
    return MAP.check(inputs, outputs, resolved), report.counters


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("record", DECLARATIONS)
def test_values_arrive_whatever_the_layout(device, record: str, layout: str) -> None:
    for size in (1, 31, 33, 1000):
        check, _ = run(device, size, record=record, layout=layout, used=2)
        assert check.passed, f"{size}: {check}"


def test_check_sees_one_wrong_length() -> None:
    axes = resolve_axes(get("map_length"), {"used": 2})
    inputs = MAP.inputs(axes, 50, SEED)
    right = {
        result: np.linalg.norm(inputs[name].astype(np.float64), axis=1)
        for result, name in (("speeds", "velocity"), ("distances", "position"))
    }
    assert MAP.check(inputs, right, axes).passed
    for result in right:
        for factor in (1 + 1e-6, np.nan):
            wrong = right | {result: right[result] * np.where(np.arange(50) == 17, factor, 1)}
            assert not MAP.check(inputs, wrong, axes).passed


def test_no_record_is_no_launch(device) -> None:
    check, counters = run(device, 0)
    assert check.passed
    assert counters is None


def sectors_of_a_warp(declaration: Declaration, layout: str, attribute: int) -> int:
    """Distinct 32-byte sectors per request of 32 lanes and at most 16 bytes per lane, over its requests."""
    size, count = declaration.attribute_bytes, len(declaration.names)
    lane = np.arange(32)
    start = {
        "soa": 32 * 100 * size * attribute + lane * size,  # any whole number of tiles lies before
        "aos": (lane * count + attribute) * size,
        "aosoa": (32 * attribute + lane) * size,
    }[layout]
    width = min(size, 16)
    pieces = [start + piece for piece in range(0, size, width)]
    return sum(len({byte // 32 for first in piece for byte in (first, first + width - 1)}) for piece in pieces)


@pytest.mark.parametrize("used", [1, 2])
@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("record", DECLARATIONS)
def test_sectors_follow_from_the_layout(device, record: str, layout: str, used: int) -> None:
    _, counters = run(device, 3200, record=record, layout=layout, used=used)
    declaration = DECLARATIONS[record]
    names = ("velocity", "position")[:used]
    expected = sum(sectors_of_a_warp(declaration, layout, declaration.names.index(name)) for name in names)
    assert counters.total.gld_sectors == 100 * expected


def test_structure_of_arrays_reads_nothing_twice(device) -> None:
    """The ratios behind tables 5 and 6: loads only, where one attribute of two is used."""

    def ratio(record: str) -> float:
        loads = {layout: run(device, 3200, record=record, layout=layout)[1].total.gld_sectors for layout in LAYOUTS}
        assert loads["soa"] == loads["aosoa"]
        return loads["aos"] / loads["soa"]

    assert [ratio(record) for record in ("float", "float4", "particle", "double4")] == [2, 2, 2, 1]


def test_packing_puts_every_attribute_where_the_layout_says() -> None:
    declaration = Declaration(("a", "b", "c"), np.dtype(np.float32), 1)
    count = 40
    values = {name: (100 * k + np.arange(count, dtype=np.float32))[:, None] for k, name in enumerate("abc")}
    assert capacity(count) == 64
    for layout, place in (
        ("aos", lambda k, i: 3 * i + k),
        ("soa", lambda k, i: 64 * k + i),
        ("aosoa", lambda k, i: 96 * (i // 32) + 32 * k + i % 32),
    ):
        buffer = declaration.pack(values, layout).view(np.float32)
        assert len(buffer) == 3 * 64
        for k in range(3):
            for i in range(count):
                assert buffer[place(k, i)] == 100 * k + i, (layout, k, i)


def test_kernels_know_no_layout() -> None:
    text = (RAW_KERNELS / "map_length.cu").read_text()
    code = "\n".join(line for line in text.splitlines() if not line.startswith("//"))
    assert "TILE" not in code
    assert "Tile" not in code
