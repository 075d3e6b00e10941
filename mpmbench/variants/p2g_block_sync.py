"""P2G with a thread per cell and a barrier per node step, so that no shared atomics are needed.

Idea: all threads of a block visit the same offset of their supports at the same time. Their nodes then differ, plain
additions to the shared arena are enough, and a barrier after each node step keeps the warps together (Algorithm 6).
Every thread runs to the largest bin of the block. With batching a thread sums several particles in registers before it
adds, which divides the barriers.

Wins when: cells hold about equally many particles, dense or not: a barrier costs less than shared atomics.
Loses when: one cell of a block is much fuller than the others, because all its threads wait at the barriers.

Source: thesis section 5.4.2, Algorithm 6 (P2G-Sync), with the block maximum of section 5.4.3; tables 13 to 16.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mpmbench.device import Launch
from mpmbench.variants import BLOCK_AXES, Variant, arena_fits, p2g_floor

if TYPE_CHECKING:
    from mpmbench.workspace import Workspace


def launch(work: Workspace) -> tuple[Launch, ...]:
    return work.per_block(
        work.domain, work.count, work.particles, work.order, work.bin_start, work.block_maximum, work.active_blocks,
        work.nodes,
    )  # fmt: skip


VARIANT = Variant(
    name="p2g_block_sync",
    summary="thread per cell, barrier per node step instead of atomics",
    transfer="p2g",
    kernel="p2g_block_sync",
    needs=("bins", "block_maximum"),
    axes=BLOCK_AXES,
    launch=launch,
    floor=p2g_floor,
    reference="thesis section 5.4.2, Algorithm 6, tables 13 to 16: P2G-Sync",
    requires=arena_fits,
)
