"""Preprocessing: named steps that bring particles and grid into the state a strategy needs, each counted on its own.

Counting sort of thesis section 5.3 (binning, scan, reordering by index or in full), the per-block maximum and the
active list of section 5.4.3, and the steps on the grid. Every step can run again on the same buffers.
"""

from __future__ import annotations

import numpy as np

from mpmbench.primitives.scan_lookback import lookback
from mpmbench.workspace import Step, Workspace, bin_count, maximum_needed

_REAL = ("REAL", "REAL_IS_DOUBLE")
_PARTICLES = (*_REAL, "APIC", "SOA")
_BLOCK = ("BLOCK_X", "BLOCK_Y", "BLOCK_Z")


def steps(work: Workspace) -> tuple[Step, ...]:
    """Everything before the transfer, in order."""
    axes = work.axes
    result: list[Step] = []
    if axes["particle_order"] != "given":
        result += [binning(work), bin_scan(work), sort(work)]
    if work.variant.uses_blocks and maximum_needed(work.variant, axes):
        result.append(block_maximum(work))
        if axes["blocks"] == "active":
            result.append(active_list(work))
    result.append(grid_clear(work) if work.variant.transfer == "p2g" else grid_divide(work))
    return tuple(result)


def finish(work: Workspace) -> tuple[Step, ...]:
    """Everything after the transfer that brings results into the dataset's order."""
    if work.variant.transfer == "g2p" and work.axes["particle_order"] == "deep":
        return (restore_order(work),)
    return ()


def _bin_constants(work: Workspace) -> tuple[str, ...]:
    """What the numbering of bins depends on; the block's shape only where bins are numbered by it."""
    return ("BLOCK_INDEX", *(_BLOCK if work.axes["cell_index"] == "block" else ()))


def binning(work: Workspace) -> Step:
    """Each particle draws a ticket: its bin and its place in it."""
    counters = work.buffers["bin_count"]
    bins = bin_count(work.grid, work.axes) + 1
    kernel = work.helper("bin_particles", (*_PARTICLES, "SPLINE", *_bin_constants(work)))
    return Step(
        "binning",
        (
            *work.cover(bins, np.int32(bins), counters, kernel=work.helper("clear_counts")),
            *work.cover(
                work.particle_count,
                work.domain, work.count, work.buffers["particles"], counters, work.buffers["tickets"],
                kernel=kernel,
            ),
        ),
    )  # fmt: skip


def bin_scan(work: Workspace) -> Step:
    """Counts of bins to the first sorted particle of each."""
    bins = bin_count(work.grid, work.axes) + 1
    return Step("scan", lookback(work, bins, work.buffers["bin_count"], work.bin_start, work.buffers["bin_scan"]))


def sort(work: Workspace) -> Step:
    """Reorder by index, or move every attribute of every particle."""
    buffers = work.buffers
    tickets = (work.count, buffers["tickets"], work.bin_start)
    if work.axes["particle_order"] == "index":
        launches = work.cover(work.particle_count, *tickets, work.order, kernel=work.helper("sort_index"))
        return Step("sort_index", launches)
    kernel = work.helper("sort_deep", _PARTICLES, KEEP_ORDER=work.variant.transfer == "g2p")
    both = (buffers["particles"], buffers["sorted_particles"])
    return Step("sort_deep", work.cover(work.particle_count, *tickets, *both, work.order, kernel=kernel))


def block_maximum(work: Workspace) -> Step:
    """The largest bin of each block, or of each block and the halo that a pull reads."""
    name = maximum_needed(work.variant, work.axes)
    assert name is not None
    halo = name == "halo_maximum"
    kernel = work.helper("block_maximum", (*_REAL, *_BLOCK, "SPLINE", "BLOCK_INDEX"), HALO=halo)
    blocks = _block_count(work)
    launches = work.cover(32 * blocks, work.domain, np.int32(blocks), work.bin_start, work.block_maximum, kernel=kernel)
    return Step(name, launches)


def active_list(work: Workspace) -> Step:
    """Stream compaction of the blocks whose maximum is not zero; the list's length is read back once."""
    blocks, slots = _block_count(work), work.buffers["block_slots"]
    scan = lookback(work, blocks, work.block_maximum, slots, work.buffers["block_scan"], flags=True)
    length = work.buffers["active_count"]
    compact = work.cover(
        blocks, np.int32(blocks), work.block_maximum, slots, work.active_blocks, length,
        kernel=work.helper("compact_blocks"),
    )  # fmt: skip

    def read_length() -> None:
        work.active_count = int(work.device.download(length)[0])

    return Step("active_list", (*scan, *compact), read_length)


def grid_clear(work: Workspace) -> Step:
    """Momentum and mass of every node to zero."""
    nodes = work.grid.node_count
    return Step("grid_clear", work.cover(nodes, np.int32(nodes), work.nodes, kernel=work.helper("grid_clear", _REAL)))


def grid_divide(work: Workspace) -> Step:
    """Momentum over mass: velocity of every node, zero where there is no mass."""
    nodes = work.grid.node_count
    kernel = work.helper("grid_divide", _REAL)
    return Step("grid_divide", work.cover(nodes, np.int32(nodes), work.nodes, work.velocities, kernel=kernel))


def restore_order(work: Workspace) -> Step:
    """Results of deeply sorted particles back to the dataset's order."""
    kernel = work.helper("restore_order", _PARTICLES)
    both = (work.buffers["sorted_results"], work.buffers["results"])
    return Step("restore_order", work.cover(work.particle_count, work.count, work.order, *both, kernel=kernel))


def _block_count(work: Workspace) -> int:
    return int(np.prod(work.grid.blocks(work.axes["block_shape"])))
