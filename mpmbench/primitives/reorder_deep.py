"""Reordering in full: every attribute of every particle moves to its sorted place in a second buffer.

Idea: pay for the scattered accesses once, so that all kernels downstream read in order.

Wins when: many kernels follow, or particles lie nearly in order already: reads and writes then stream.
Loses when: particles lie at random and carry much: each attribute is a scattered write, in AoS a little less so.

Source: thesis section 5.3 (full deep copy), table 10.
"""

from __future__ import annotations

import numpy as np

from mpmbench.operations.sorting import ATTRIBUTES, LAYOUTS, ORDERS, REORDER, reorder_in_full
from mpmbench.primitives import Bench, Built, Primitive


def build(bench: Bench) -> Built:
    tickets, starts, particles = (bench.upload(bench.inputs[name]) for name in ("tickets", "bin_start", "particles"))
    moved = bench.empty((bench.axes["attributes"] * bench.size, 4), np.float32)
    return Built(reorder_in_full(bench, tickets, starts, particles, moved), {"sorted_particles": moved})


PRIMITIVE = Primitive(
    name="reorder_deep",
    operation=REORDER,
    summary="every attribute moves",
    kernel="sort_deep",
    axes={"order": ORDERS, "attributes": ATTRIBUTES, "layout": LAYOUTS},
    build=build,
    reference="thesis section 5.3, table 10: full",
)
