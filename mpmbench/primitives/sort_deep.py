"""Counting sort in full: binning, scan, and every attribute of every particle moved to its sorted place.

Idea: what index sorting saves here is paid by every kernel that follows; a full sort pays once.

Wins when: the last sorted state is the input, a few steps old: reads and writes are then nearly in order.
Loses when: particles lie at random, or nothing that follows profits from order.

Source: thesis section 5.3, tables 9 and 10.
"""

from __future__ import annotations

import numpy as np

from mpmbench.operations.sorting import ATTRIBUTES, LAYOUTS, ORDERS, SORT, reorder_in_full, ticketed
from mpmbench.primitives import Bench, Built, Primitive


def build(bench: Bench) -> Built:
    particles = bench.upload(bench.inputs["particles"])
    launches, tickets, starts = ticketed(bench, particles)
    order = bench.empty(bench.size, np.int32)
    moved = bench.empty((bench.axes["attributes"] * bench.size, 4), np.float32)
    reorder = reorder_in_full(bench, tickets, starts, particles, moved, order)
    return Built((*launches, *reorder), {"order": order, "sorted_particles": moved})


PRIMITIVE = Primitive(
    name="sort_deep",
    operation=SORT,
    summary="counting sort, every attribute moves",
    kernel="sort_deep",
    axes={"order": ORDERS, "attributes": ATTRIBUTES, "layout": LAYOUTS},
    build=build,
    reference="thesis section 5.3, tables 9 and 10",
)
