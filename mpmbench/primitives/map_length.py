"""Map over records: the length of one attribute or of two, in three memory layouts.

Idea: one declaration of the attributes generates the access of every layout, so that the kernel is written once. As a
structure of arrays (soa) neighbouring lanes read neighbouring values; as an array of structures (aos) they step over
whole records; in tiles of 32 (aosoa) a warp reads neighbouring values and a record stays in one neighbourhood.

Wins when: soa and aosoa: a kernel uses part of a record, which is the common case.
Loses when: aos: every sector that a warp touches also carries attributes that nobody asked for. Random access turns
this round, and a double4 fills its sector in every layout.

Source: thesis section 5.1, listings 2 to 4, figures 1 and 2; section 6.2, tables 5 and 6.
"""

import numpy as np

from mpmbench.layout import LAYOUTS, capacity
from mpmbench.operations.map import DECLARATIONS, MAP
from mpmbench.primitives import Bench, Built, Primitive


def build(bench: Bench) -> Built:
    axes, declaration = bench.axes, DECLARATIONS[bench.axes["record"]]
    buffer = bench.upload(declaration.pack(bench.inputs, axes["layout"]))
    speeds, distances = (bench.empty(bench.size, declaration.number) for _ in range(2))
    kernel = bench.kernel(USED=axes["used"], **declaration.constants(axes["layout"]))
    launches = bench.cover(
        kernel, bench.size, np.int32(bench.size), np.int32(capacity(bench.size)), buffer, speeds, distances
    )
    outputs = {"speeds": speeds} | ({"distances": distances} if axes["used"] > 1 else {})
    return Built(launches, outputs)


PRIMITIVE = Primitive(
    name="map_length",
    operation=MAP,
    summary="length of one attribute or two, in any memory layout",
    kernel="map_length",
    axes={"record": tuple(DECLARATIONS), "layout": LAYOUTS, "used": (1, 2)},
    build=build,
    reference="thesis section 5.1, tables 5 and 6",
)
