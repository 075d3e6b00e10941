"""Polar decomposition with a thread per matrix, from the polar SVD.

Idea: R = U V^T and S = V diag(s) V^T. U and V are quaternions, so R takes one quaternion product, and U as a matrix is
never formed.

Wins when: a material asks for rotation and stretch only (fixed corotated elasticity): a fifth less traffic than the
full SVD.
Loses when: rotations change little from step to step, where a few Newton steps from the last rotation are cheaper.

Source: thesis section 4.2, equation 30.
"""

from __future__ import annotations

import numpy as np

from mpmbench.operations.decomposition import POLAR, real_constants
from mpmbench.primitives import Bench, Built, Primitive


def build(bench: Bench) -> Built:
    dtype = bench.axes["dtype"]
    kernel = bench.kernel(**real_constants(dtype))
    r, s = (bench.empty((entries, bench.size), dtype) for entries in (9, 6))
    launches = bench.cover(kernel, bench.size, np.int32(bench.size), bench.upload(bench.inputs["f"]), r, s)
    return Built(launches, {"r": r, "s": s})


PRIMITIVE = Primitive(
    name="polar_decompose",
    operation=POLAR,
    summary="thread per matrix, by the polar SVD",
    kernel="polar_decompose",
    axes={"dtype": ("float32", "float64")},
    build=build,
    reference="thesis section 4.2, equation 30",
)
