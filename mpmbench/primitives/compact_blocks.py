"""Stream compaction by scan: the scan of a 0/1 flag is the place of each entry that stays.

Idea: the order is kept and nothing is drawn by atomics; the flags are scanned in the pass that reads the values.

Wins when: the list must be in order, or most entries stay.
Loses when: hardly any entry stays and order does not matter: one atomic per warp would do.

Source: thesis sections 5.3 and 5.4.3.
"""

from __future__ import annotations

import numpy as np

from mpmbench.operations.compaction import COMPACT, PERCENT
from mpmbench.primitives import Bench, Built, Primitive
from mpmbench.primitives.scan_lookback import lookback, state_length


def build(bench: Bench) -> Built:
    count, values = bench.size, bench.upload(bench.inputs["values"])
    slots, chosen, length = (bench.empty(entries, np.int32) for entries in (count, count, 1))
    scan = lookback(bench, count, values, slots, bench.empty(state_length(count), np.int32), flags=True)
    compact = bench.cover(bench.kernel(), count, np.int32(count), values, slots, chosen, length)
    return Built((*scan, *compact), {"list": chosen, "count": length})


PRIMITIVE = Primitive(
    name="compact_blocks",
    operation=COMPACT,
    summary="scan of flags, then every entry to its place",
    kernel="compact_blocks",
    axes={"percent": PERCENT},
    build=build,
    reference="thesis sections 5.3, 5.4.3",
)
