"""Reduction by register exchange inside warps, with one place of shared memory per warp.

Idea: five shuffles replace five steps of the tree in shared memory; one barrier is left.

Wins when: on every GPU that has shuffles; with several loads it is bound by memory.
Loses when: so many loads are taken that fewer thread blocks are left than the GPU has multiprocessors.

Source: named, not measured, in thesis section 5.2; Westphal, Voting and shuffling to optimize atomic operations, 2015.
"""

from mpmbench.operations.reduce import ELEMENTS, LOADS, OPERATORS, REDUCE, pyramid, requires
from mpmbench.primitives import Primitive

PRIMITIVE = Primitive(
    name="reduce_shuffle",
    operation=REDUCE,
    summary="warp shuffles, one shared place per warp, several loads",
    kernel="reduce_shuffle",
    axes={
        "element": ELEMENTS,
        "operator": OPERATORS,
        "loads": (8, *(loads for loads in LOADS if loads != 8)),
        "threads": (256, 1024, 512, 128, 64, 32),
    },
    build=pyramid,
    reference="thesis section 5.2 names it; Westphal 2015",
    requires=requires,
)
