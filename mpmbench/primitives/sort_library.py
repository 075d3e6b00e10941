"""The library's sort: CuPy's stable argsort of the bin numbers, a radix sort of CUB underneath.

Idea: none of ours; what a user would call who does not write a sort. It is given the bins, so its time lacks what it
costs to find them, and it leaves an index.

Wins when: keys are wide or few; a radix sort does not care how many cells the grid has.
Loses when: cells are about as many as particles: counting takes one pass where digits take several.

Source: cupy.argsort; Merrill and Garland, Single-pass parallel prefix scan with decoupled look-back, 2016 (CUB).
"""

from __future__ import annotations

import numpy as np

from mpmbench.device import Launch
from mpmbench.operations.sorting import ORDERS, SORT
from mpmbench.primitives import Bench, Built, Primitive


def build(bench: Bench) -> Built:
    keys, order = bench.upload(bench.inputs["keys"]), bench.empty(bench.size, np.int64)
    if not bench.size:
        return Built((), {"order": order})
    sort = bench.device.library_sort()  # type: ignore[attr-defined]  # the cuda device alone has one
    return Built((Launch("argsort", sort, (1, 1, 1), (1, 1, 1), (keys, order)),), {"order": order})


PRIMITIVE = Primitive(
    name="sort_library",
    operation=SORT,
    summary="CuPy's argsort of the bins (CUB)",
    kernel="",
    axes={"order": ORDERS},
    build=build,
    reference="cupy.argsort",
    devices=("cuda",),
)
