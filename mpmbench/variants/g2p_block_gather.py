"""G2P with a thread per cell that reads nodes from a shared arena.

Idea: a thread block loads the nodes of its block and halo into shared memory once; each thread then gathers the
particles of its cell from there (Algorithm 5). With batching one visit of a node serves several particles.

Wins when: all cells hold about equally many particles, several each: the arena is loaded once for all of them.
Loses when: cells are unevenly filled, because the lanes of a warp wait for the fullest one, or nearly empty, because
the arena is then loaded for nothing.

Source: thesis section 5.4.1, Algorithm 5 (G2P-shared); rows "G2P-shared" of tables 11 and 12.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mpmbench.device import Launch
from mpmbench.variants import BLOCK_AXES, Variant, arena_fits, g2p_floor

if TYPE_CHECKING:
    from mpmbench.workspace import Workspace


def launch(work: Workspace) -> tuple[Launch, ...]:
    return work.per_block(
        work.domain, work.count, work.particles, work.order, work.bin_start, work.active_blocks, work.velocities,
        work.results,
    )  # fmt: skip


VARIANT = Variant(
    name="g2p_block_gather",
    summary="thread per cell, nodes from a shared block arena",
    transfer="g2p",
    kernel="g2p_block_gather",
    needs=("bins",),
    axes=BLOCK_AXES,
    launch=launch,
    floor=g2p_floor,
    reference="thesis section 5.4.1, Algorithm 5, tables 11 and 12: G2P-shared",
    requires=arena_fits,
)
