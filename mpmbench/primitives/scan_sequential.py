"""Scan with sequential work: each thread scans a few neighbouring values in registers, the tree only their sums.

Idea: raking, or register blocking. The tree in shared memory, that of the plain scan, sees one sum of several values at
each leaf, so that its steps and barriers are shared by more values.

Wins when: against the plain tree, always: fewer barriers per value.
Loses when: the loops stay rolled, because values indexed by a loop variable lie in local memory; and with more loads a
request of a warp touches more sectors, which only caches make up for.

Source: thesis section 5.2, table 8 (sequential, rolled and unrolled); Baxter, Modern GPU, 2013.
"""

from mpmbench.operations.scan import SCAN, by_levels
from mpmbench.primitives import Primitive
from mpmbench.primitives.scan_interleaved import PADDING

PRIMITIVE = Primitive(
    name="scan_sequential",
    operation=SCAN,
    summary="raking: sequential loads per leaf, then the tree",
    kernel="scan_sequential",
    axes={
        "loads": (2, 4),
        "loop": ("unrolled", "rolled"),
        "padding": tuple(PADDING),
        "threads": (1024, 512, 256, 128, 64, 32),
    },
    build=by_levels(
        lambda axes: 2 * axes["loads"] * axes["threads"],
        lambda axes: {
            "LOADS": axes["loads"],
            "UNROLL": axes["loads"] if axes["loop"] == "unrolled" else 1,
            "PADDING": PADDING[axes["padding"]],
        },
    ),
    reference="thesis section 5.2, table 8: sequential, unrolled",
)
