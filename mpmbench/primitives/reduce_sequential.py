"""Reduction by a tree with sequential addressing, after each thread has combined several elements in a register.

Idea: the tree folds the upper half of the places onto the lower half, so that active lanes take neighbouring places and
no two share a bank. Sequential loads feed many elements into one tree.

Wins when: there is no shuffle; with 2 or more loads it is bound by memory.
Loses when: so many loads are taken that fewer thread blocks are left than the GPU has multiprocessors.

Source: thesis section 5.2, figure 3, table 7; Harris, Optimizing parallel reduction in CUDA, 2007.
"""

from mpmbench.operations.reduce import ELEMENTS, LOADS, OPERATORS, REDUCE, pyramid, requires
from mpmbench.primitives import Primitive

PRIMITIVE = Primitive(
    name="reduce_sequential",
    operation=REDUCE,
    summary="shared-memory tree, sequential addresses, several loads",
    kernel="reduce_sequential",
    axes={"element": ELEMENTS, "operator": OPERATORS, "loads": LOADS, "threads": (1024, 512, 256, 128, 64, 32)},
    build=pyramid,
    reference="thesis section 5.2, table 7: sequential",
    requires=requires,
)
