"""Polar SVD with a thread per matrix: Jacobi rotations, then QR.

Idea: a fixed number of exact Jacobi rotations on F^T F and one sweep on the columns of F V give V and the order, a QR
factorisation gives U. There is nothing to wait for and nothing to branch on, so all lanes stay busy; the matrix lives
in registers.

Wins when: singular values are needed (plasticity, inverted elements), for any matrix at all, denormal to infinite.
Loses when: only the rotation is needed; and in double precision on a GPU with few double units, as it computes far
more than it loads.

Source: thesis section 4.2, after McAdams et al. 2011; its accuracy on a million random matrices is in section 6.1.
"""

from __future__ import annotations

import numpy as np

from mpmbench.operations.decomposition import SVD, real_constants
from mpmbench.primitives import Bench, Built, Primitive


def build(bench: Bench) -> Built:
    dtype = bench.axes["dtype"]
    kernel = bench.kernel(**real_constants(dtype))
    u, s, v = (bench.empty((entries, bench.size), dtype) for entries in (9, 3, 9))
    launches = bench.cover(kernel, bench.size, np.int32(bench.size), bench.upload(bench.inputs["f"]), u, s, v)
    return Built(launches, {"u": u, "s": s, "v": v})


PRIMITIVE = Primitive(
    name="svd_polar",
    operation=SVD,
    summary="thread per matrix, Jacobi rotations and QR",
    kernel="svd_polar",
    axes={"dtype": ("float32", "float64")},
    build=build,
    reference="thesis sections 4.2 and 6.1; McAdams et al. 2011",
)
