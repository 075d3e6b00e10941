"""The closed form of appendix C against addresses written here, and against counts of the transfer kernels."""

from __future__ import annotations

import re

import numpy as np
import pytest
from bank_model import wavefronts
from transfers import filled, transfer

from mpmbench import device as devices
from mpmbench.banks import BankPattern
from mpmbench.report.banks import picture, table
from mpmbench.report.plots import svg
from mpmbench.spline import get_spline
from mpmbench.variants import get

REACH = {"linear": 1, "quadratic": 2, "cubic": 3}
SHAPES = [(8, 4, 4), (4, 4, 4), (8, 8, 4), (4, 4, 2), (4, 8, 2), (2, 4, 4), (8, 2, 2), (2, 2, 8), (1, 2, 16), (3, 5, 2)]


@pytest.fixture(scope="module")
def counting():
    return devices.open_device("simulated", arch="sm_52", mode="count")


def cells_of(shape) -> list[tuple[int, int, int]]:
    """Cells in thread order, x fastest."""
    bx, by, bz = shape
    return [(x, y, z) for z in range(bz) for y in range(by) for x in range(bx)]


def step_by_addresses(shape, spline: str, double: bool, offset=(0, 0, 0)) -> int:
    """Wavefronts of one access by every warp, from byte addresses: cell by cell, piece by piece."""
    ax, ay, _ = (edge + REACH[spline] for edge in shape)
    size = 32 if double else 16
    places = [((z + offset[2]) * ay + (y + offset[1])) * ax + (x + offset[0]) for x, y, z in cells_of(shape)]
    total = 0
    for first in range(0, len(places), 32):
        for piece in range(0, size, 16):
            total += wavefronts([size * place + piece for place in places[first : first + 32]], 16)
    return total


@pytest.mark.parametrize("double", [False, True], ids=["float32", "float64"])
@pytest.mark.parametrize("spline", REACH)
@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_closed_form_is_what_addresses_give(shape, spline: str, double: bool) -> None:
    pattern = BankPattern(shape, spline, double)
    assert pattern.arena == tuple(edge + REACH[spline] for edge in shape)
    assert pattern.step_wavefronts == step_by_addresses(shape, spline, double)
    assert pattern.step_wavefronts >= pattern.least_wavefronts
    ax, ay = (edge + REACH[spline] for edge in shape[:2])
    first = [(z * ay + y) * ax + x for x, y, z in cells_of(shape)[:32]]
    pieces = [2 * place + piece for place in first for piece in (0, 1)] if double else first
    assert pattern.accesses(0).tolist() == [sum(piece % 8 == group for piece in pieces) for group in range(8)]
    last = (REACH[spline],) * 3
    assert pattern.step_wavefronts == step_by_addresses(shape, spline, double, last), "a shift changes nothing"


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize(("shape", "spline"), [((8, 4, 4), "cubic"), ((4, 4, 4), "cubic"), ((2, 4, 4), "quadratic")])
@pytest.mark.parametrize(("name", "accesses"), [("g2p_block_gather", 1), ("p2g_block_sync", 2)])
def test_counted_wavefronts_of_the_node_steps_agree(counting, name, accesses, shape, spline, dtype) -> None:
    """One particle in every cell of one block: each node step reads the arena (and P2G writes it) once per warp."""
    dataset = filled(1, cells=shape)
    axes = {"block_shape": shape, "spline": spline, "dtype": dtype, "writing": "literal"}
    check, report, _ = transfer(get(name), dataset, counting, **axes)
    assert check.passed
    # Filling, clearing and writing back the arena are lines of their own.
    lines = report.counters.lines.items()
    streaming = {"g2p_block_gather": "sst_req", "p2g_block_sync": ""}[name]
    steps = [
        tally for line, tally in lines if line.file != "arena_sum.cuh" and not (streaming and getattr(tally, streaming))
    ]
    nodes = get_spline(spline).nodes ** 3
    counted = sum(tally.shm_wavefronts for tally in steps)
    assert counted == accesses * nodes * BankPattern(shape, spline, dtype == "float64").step_wavefronts


def test_wide_blocks_are_balanced_and_free_of_conflicts() -> None:
    """Table 18: eight cells along x are one row of eight groups, whatever the halo."""
    for spline in REACH:
        pattern = BankPattern((8, 4, 4), spline)
        assert pattern.accesses(0).tolist() == [4] * 8
        assert pattern.step_wavefronts == pattern.least_wavefronts


def test_narrow_blocks_are_balanced_only_over_eight_rows() -> None:
    """Table 17 shades 4 cells along x in eight rows that follow each other: there each group is taken four times. The
    four rows per layer of a 4x4x4 block leave three rows of halo between, and the balance is lost."""
    assert BankPattern((4, 8, 4)).accesses(0).tolist() == [4] * 8
    assert BankPattern((4, 4, 4)).accesses(0).tolist() == [7, 7, 5, 3, 1, 1, 3, 5]
    assert BankPattern((4, 4, 4)).step_wavefronts == 2 * BankPattern((4, 4, 4)).least_wavefronts


def test_groups_are_those_printed() -> None:
    """First entries of the rows of tables 17 and 18 for lanes that stand there."""
    narrow, wide = BankPattern((4, 8, 4)), BankPattern((8, 4, 4))
    assert narrow.groups(0)[0, ::4].tolist() == [0, 7, 6, 5, 4, 3, 2, 1]
    assert wide.groups(0)[0, ::8].tolist() == [0, 3, 6, 1]


def test_picture_shows_every_place_of_the_first_warp() -> None:
    text = svg(picture(BankPattern((8, 4, 4))))
    assert text.startswith("<svg")
    labels = re.findall(r">([0-7])</text>", text)
    assert len(labels) == 4 * 11
    assert [int(label) for label in labels[11:22]] == [3, 4, 5, 6, 7, 0, 1, 2, 3, 4, 5]
    assert text.count("opacity: 0.3") == 32


def test_table_names_what_a_step_costs() -> None:
    (row,) = table([BankPattern((4, 4, 4))]).rows
    assert [cell.value for cell in row.cells][-2:] == [16, 8]
    assert np.sum([int(n) for n in row.cells[4].value.split()]) == 32
