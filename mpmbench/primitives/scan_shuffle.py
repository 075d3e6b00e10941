"""Scan by register exchange inside warps, by levels for long inputs.

Idea: a thread adds four neighbouring values, a warp scans its lanes' sums in five shuffles, one warp scans the sums of
all warps. Shared memory holds one integer per warp.

Wins when: the input fits one thread block, or two levels; two barriers instead of two per step of a tree.
Loses when: the input is long: levels read and write every value twice.

Source: Harris and Garland, Optimizing parallel prefix operations for the Fermi architecture, GPU Computing Gems, 2012.
"""

from mpmbench.operations.scan import SCAN, by_levels
from mpmbench.primitives import Primitive

PRIMITIVE = Primitive(
    name="scan_shuffle",
    operation=SCAN,
    summary="warp shuffles, four values per thread",
    kernel="scan_shuffle",
    axes={"threads": (256, 1024, 512, 128, 64, 32)},
    build=by_levels(lambda axes: 4 * axes["threads"], lambda axes: {}),
    reference="Harris and Garland 2012",
)
