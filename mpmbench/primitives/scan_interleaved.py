"""Scan by a balanced tree in shared memory, with none, some or all of the padding that keeps it free of bank conflicts.

Idea: sums go up a tree in place, zero enters at the root, and the way down turns sums into prefixes: work in proportion
to the length. Addresses are 2, 4, 8, ... places apart, so places are padded: one per 32 (partial), and one more per
1024 (full), which only thread blocks of 1024 threads need.

Wins when: padded partly, it is the best form without sequential work and without shuffles.
Loses when: unpadded: up to 32 lanes then take the same bank.

Source: thesis section 5.2, figures 4 and 5, eqs. 141 and 142, table 8; Harris, Sengupta and Owens, Parallel prefix sum
(scan) with CUDA, GPU Gems 3, 2007.
"""

from mpmbench.operations.scan import SCAN, by_levels
from mpmbench.primitives import Primitive

PADDING = {"partial": 1, "full": 2, "none": 0}

PRIMITIVE = Primitive(
    name="scan_interleaved",
    operation=SCAN,
    summary="shared-memory tree, two values per thread, padded or not",
    kernel="scan_interleaved",
    axes={"padding": tuple(PADDING), "threads": (1024, 512, 256, 128, 64, 32)},
    build=by_levels(lambda axes: 2 * axes["threads"], lambda axes: {"PADDING": PADDING[axes["padding"]]}),
    reference="thesis section 5.2, eqs. 141, 142, table 8: conflicts, no conflicts, part. conflicts",
)
