"""G2P with a thread per particle that reads nodes from global memory.

Idea: nodes are only read, so particles are independent; the caches turn the overlap of supports into hits. With
batching a thread gathers several particles at once.

Wins when: particles are sorted: neighbours read the same nodes, and no thread waits for a fuller cell.
Loses when: particles come in random order, since every node is then fetched anew. Batching costs registers and saves no
loads.

Source: thesis section 5.4.1, rows "G2P-global" and "sorted" of tables 11 and 12.
"""

from __future__ import annotations

from mpmbench.device import Launch
from mpmbench.variants import AXES, GLOBAL_AXES, Variant, g2p_floor
from mpmbench.workspace import THREADS, Workspace


def launch(work: Workspace) -> tuple[Launch, ...]:
    threads_per_batch = -(-work.particle_count // (THREADS * work.axes["batching"])) * THREADS
    return work.cover(
        threads_per_batch, work.domain, work.count, work.particles, work.order, work.velocities, work.results
    )


VARIANT = Variant(
    name="g2p_global_gather",
    summary="thread per particle, nodes through the caches",
    transfer="g2p",
    kernel="g2p_global_gather",
    needs=(),
    axes={**GLOBAL_AXES, "batching": AXES["batching"]},
    launch=launch,
    floor=g2p_floor,
    reference="thesis section 5.4.1, tables 11 and 12: G2P-global",
)
