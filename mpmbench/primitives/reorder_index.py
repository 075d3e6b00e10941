"""Reordering by index: the sorted order is a list of particles, which themselves stay where they are.

Idea: four bytes per particle are moved, whatever a particle carries.

Wins when: little is read through the index, or particles lie nearly in order already.
Loses when: kernels downstream read many attributes through it: every one of their reads is then scattered.

Source: thesis section 5.3 (indexing), table 10.
"""

from __future__ import annotations

import numpy as np

from mpmbench.operations.sorting import ORDERS, REORDER, reorder_by_index
from mpmbench.primitives import Bench, Built, Primitive


def build(bench: Bench) -> Built:
    tickets, starts = (bench.upload(bench.inputs[name]) for name in ("tickets", "bin_start"))
    order = bench.empty(bench.size, np.int32)
    return Built(reorder_by_index(bench, tickets, starts, order), {"order": order})


PRIMITIVE = Primitive(
    name="reorder_index",
    operation=REORDER,
    summary="a list of particles in sorted order",
    kernel="sort_index",
    axes={"order": ORDERS},
    build=build,
    reference="thesis section 5.3, table 10: index",
)
