"""Reduction by a tree with interleaved addressing: how not to do it, in two ways.

Idea: partners stand 1, 2, 4, ... places apart. With ``index=strided`` the active threads are packed into the first
warps and share banks; with ``index=remainder`` a thread stays at its place and works where a remainder is zero.

Wins when: never; it shows what bank conflicts, or idle lanes and divisions, cost.
Loses when: always: from the second step on, lanes that are active together share banks; or every warp takes every step
with ever fewer of its lanes, and divides in each.

Source: thesis section 5.2, figure 5 without padding, table 7 first row; Harris, Optimizing parallel reduction in CUDA,
2007, kernels 2 (strided) and 1 (remainder).
"""

from mpmbench.operations.reduce import ELEMENTS, OPERATORS, REDUCE, pyramid, requires
from mpmbench.primitives import Primitive

PRIMITIVE = Primitive(
    name="reduce_interleaved",
    operation=REDUCE,
    summary="shared-memory tree, interleaved: bank conflicts or idle lanes",
    kernel="reduce_interleaved",
    axes={
        "element": ELEMENTS,
        "operator": OPERATORS,
        "index": ("strided", "remainder"),
        "threads": (1024, 512, 256, 128, 64, 32),
    },
    build=pyramid,
    reference="thesis section 5.2, table 7: interleaved",
    requires=requires,
)
