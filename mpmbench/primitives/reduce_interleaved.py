"""Reduction by a tree with interleaved addressing, which commits shared-memory bank conflicts on purpose.

Idea: partners stand 1, 2, 4, ... places apart, and the active threads are packed into the first warps.

Wins when: never; it shows what bank conflicts cost.
Loses when: always: from the second step on, lanes that are active together share banks.

Source: thesis section 5.2, figure 5 without padding, table 7 first row; Harris, Optimizing parallel reduction in CUDA,
2007, kernel 2.
"""

from mpmbench.operations.reduce import ELEMENTS, OPERATORS, REDUCE, pyramid, requires
from mpmbench.primitives import Primitive

PRIMITIVE = Primitive(
    name="reduce_interleaved",
    operation=REDUCE,
    summary="shared-memory tree, interleaved addresses: bank conflicts",
    kernel="reduce_interleaved",
    axes={"element": ELEMENTS, "operator": OPERATORS, "threads": (1024, 512, 256, 128, 64, 32)},
    build=pyramid,
    reference="thesis section 5.2, table 7: interleaved",
    requires=requires,
)
