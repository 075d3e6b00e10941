"""Binning by atomic counters: each particle adds one to its bin and keeps what the counter was before.

Idea: the old count is the particle's place among those of its bin, so that one pass yields the counts and the places.

Wins when: neighbours in memory are neighbours in space: their counters share sectors, and the positions stream.
Loses when: particles lie in memory at random: nearly every counter is a sector of its own.

Source: thesis section 5.3 (binning), figure 6, table 9; Hoetzlein, Fast fixed-radius nearest neighbors, GTC 2014.
"""

from __future__ import annotations

import numpy as np

from mpmbench.operations.sorting import BIN, LAYOUTS, ORDERS, binning, bins_of, cleared
from mpmbench.primitives import Bench, Built, Primitive


def build(bench: Bench) -> Built:
    bins = bins_of(bench)
    counts, tickets = bench.empty(bins, np.int32), bench.empty((bench.size, 2), np.int32)
    launches = binning(bench, bench.upload(bench.inputs["particles"]), counts, tickets)
    return Built(launches, {"tickets": tickets, "bin_count": counts}, before=cleared(bench, counts, bins))


PRIMITIVE = Primitive(
    name="bin_particles",
    operation=BIN,
    summary="one atomic counter per bin",
    kernel="bin_particles",
    axes={"order": ORDERS, "layout": LAYOUTS},
    build=build,
    reference="thesis section 5.3, table 9",
)
