"""P2G with a thread per cell that adds to a shared arena by shared atomics.

Idea: a thread block collects the sums of its block and halo in shared memory. Each thread spreads the particles of its
cell there by shared atomics, because threads of different warps may meet at a node. The arena goes to the grid once, by
global atomics where a neighbour may add too. With batching a thread sums several particles in registers before it adds.

Wins when: cells hold several particles, so that batching divides the shared atomics, and bins are unevenly filled: no
thread waits for another.
Loses when: cells hold one particle or less: shared float atomics are compare-and-swap loops, and batching finds nothing
to sum.

Source: thesis section 5.4.2 (P2G-Atomic); rows "P2G-Atomic" of tables 13 to 15.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mpmbench.device import Launch
from mpmbench.variants import BLOCK_AXES, Variant, arena_fits, p2g_floor

if TYPE_CHECKING:
    from mpmbench.workspace import Workspace


def launch(work: Workspace) -> tuple[Launch, ...]:
    return work.per_block(
        work.domain, work.count, work.particles, work.order, work.bin_start, work.active_blocks, work.nodes
    )


VARIANT = Variant(
    name="p2g_block_atomic",
    summary="thread per cell, shared atomics into a block arena",
    transfer="p2g",
    kernel="p2g_block_atomic",
    needs=("bins",),
    axes=BLOCK_AXES,
    launch=launch,
    floor=p2g_floor,
    reference="thesis section 5.4.2, tables 13 to 15: P2G-Atomic",
    requires=arena_fits,
)
