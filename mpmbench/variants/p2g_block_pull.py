"""P2G with a thread per node that pulls from the bins around it; no atomics at all.

Idea: reverse the scatter. A round stages one particle (BATCH with batching) of every bin of a block and its halo in
shared memory; each thread then sums what the bins of its node's reversed support give to its one node. Every node is
written once, by a plain store.

Wins when: bins are evenly filled and dense: rounds are few and none of the staged places is empty.
Loses when: one bin is much fuller than the others, because all wait for it, and with large payloads: particles, not
nodes, fill the shared memory, APIC takes five values per bin, and occupancy falls.

Source: thesis section 5.4.2 (P2G-Pull) with the halo maximum of section 5.4.3; rows "P2G-Pull" of tables 13 and 14.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mpmbench.device import Launch
from mpmbench.variants import ATTRIBUTES, BLOCK_AXES, Axes, Variant, arena_places, fits, p2g_floor, real_bytes

if TYPE_CHECKING:
    from mpmbench.workspace import Workspace


def launch(work: Workspace) -> tuple[Launch, ...]:
    return work.per_block(
        work.domain, work.count, work.particles, work.order, work.bin_start, work.block_maximum, work.active_blocks,
        work.nodes,
    )  # fmt: skip


def _requires(axes: Axes) -> str | None:
    # Per bin of block and halo: each attribute of BATCH particles, and where the bin starts and how many it holds.
    return fits(axes, arena_places(axes) * (4 * real_bytes(axes) * ATTRIBUTES[axes["payload"]] * axes["batching"] + 8))


VARIANT = Variant(
    name="p2g_block_pull",
    summary="thread per node pulls staged particles, no atomics",
    transfer="p2g",
    kernel="p2g_block_pull",
    needs=("bins", "halo_maximum"),
    axes=BLOCK_AXES,
    launch=launch,
    floor=p2g_floor,
    reference="thesis section 5.4.2, tables 13 and 14: P2G-Pull",
    requires=_requires,
)
