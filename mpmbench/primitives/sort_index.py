"""Counting sort by index: binning, scan, and a list of particles in sorted order.

Idea: keys are cells, so few that counting them is cheaper than comparing or taking them apart by digits.

Wins when: there are about as many cells as particles, and one kernel or two read through the index.
Loses when: cells far outnumber particles (the scan runs over all of them), or many kernels read through the index.

Source: thesis section 5.3, tables 9 and 10.
"""

from __future__ import annotations

import numpy as np

from mpmbench.operations.sorting import ORDERS, SORT, reorder_by_index, ticketed
from mpmbench.primitives import Bench, Built, Primitive


def build(bench: Bench) -> Built:
    launches, tickets, starts = ticketed(bench, bench.upload(bench.inputs["particles"]))
    order = bench.empty(bench.size, np.int32)
    return Built((*launches, *reorder_by_index(bench, tickets, starts, order)), {"order": order})


PRIMITIVE = Primitive(
    name="sort_index",
    operation=SORT,
    summary="counting sort, particles stay where they are",
    kernel="sort_index",
    axes={"order": ORDERS},
    build=build,
    reference="thesis section 5.3, tables 9 and 10",
)
