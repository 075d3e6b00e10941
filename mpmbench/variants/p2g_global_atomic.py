"""P2G with a thread per particle that adds to the grid by global atomics.

Idea: particles do not know of each other; each loops over the nodes of its support and adds mass and momentum by atomic
sums in global memory. Nothing needs to be sorted.

Wins when: particles come unsorted and a sort cannot pay for itself, or so few share a node that atomics rarely collide.
Loses when: many particles share nodes, because colliding atomics take turns in the second-level cache; in random order
every sum misses the caches as well.

Source: thesis section 5.4.2, rows "global" and "global sorted" of tables 13 and 14.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mpmbench.device import Launch
from mpmbench.variants import GLOBAL_AXES, Variant, p2g_floor

if TYPE_CHECKING:
    from mpmbench.workspace import Workspace


def launch(work: Workspace) -> tuple[Launch, ...]:
    return work.cover(work.particle_count, work.domain, work.count, work.particles, work.order, work.nodes)


VARIANT = Variant(
    name="p2g_global_atomic",
    summary="thread per particle, global atomics",
    transfer="p2g",
    kernel="p2g_global_atomic",
    needs=(),
    axes=GLOBAL_AXES,
    launch=launch,
    floor=p2g_floor,
    reference='thesis section 5.4.2, tables 13 and 14: "global"',
)
