"""P2G with a thread per particle and support node that adds to the grid by global atomics.

Idea: the loop over the support runs in parallel too. The threads of one particle are neighbours, so one warp request
adds to adjacent nodes, and there are 8, 27 or 64 times as many threads to hide latency with.

Wins when: particles are unsorted and the device is far from full, since adjacent lanes at least hit adjacent nodes.
Loses when: particles are sorted: every thread of a particle loads and weighs it again, for a single node each.

There is no node loop to hoist weights out of: the axis ``writing`` has one value.

Source: thesis section 5.4.2, its reference [Mey15], rows "[Mey15]" of tables 13 and 14.
"""

from __future__ import annotations

from mpmbench.device import Launch
from mpmbench.errors import InputError
from mpmbench.variants import GLOBAL_AXES, Variant, p2g_floor
from mpmbench.workspace import THREADS, Workspace


def launch(work: Workspace) -> tuple[Launch, ...]:
    nodes = {"linear": 8, "quadratic": 27, "cubic": 64}[work.axes["spline"]]
    pairs = nodes * work.particle_count
    if pairs >= 2**32 - THREADS:
        raise InputError(f"p2g_global_node numbers {pairs} particle-node pairs with 32 bits: take fewer particles")
    return work.cover(pairs, work.domain, work.count, work.particles, work.order, work.nodes)


VARIANT = Variant(
    name="p2g_global_node",
    summary="thread per particle and support node, global atomics",
    transfer="p2g",
    kernel="p2g_global_node",
    needs=(),
    axes={**GLOBAL_AXES, "writing": ("literal",)},
    launch=launch,
    floor=p2g_floor,
    reference="thesis section 5.4.2, tables 13 and 14: [Mey15]",
)
