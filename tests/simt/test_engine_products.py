"""Adds of one quad times many factors, w (x, y, z, 1): staged once, multiplied lane by lane, with the same bits."""

from __future__ import annotations

import re

import numpy as np
import pytest
from engine_programs import OPTIONS, run

from mpmbench.simt import engine, nvrtc, ptx
from mpmbench.simt.codegen import generate

BODY = """(const REAL* x, const REAL* w, REAL* out) {
    int t = threadIdx.x; if (t >= 61) return;
    REAL a = x[3 * t], b = x[3 * t + 1], c = x[3 * t + 2];
    REAL* o = out + 4 * NODES * t;
    REAL factor[NODES];
    #pragma unroll
    for (int k = 0; k < NODES; ++k) factor[k] = w[NODES * t + k] * w[0];
    #pragma unroll
    for (int k = 0; k < NODES; ++k) {
        REAL f = factor[k];
        atomicAdd(o + 4 * k, f * a); atomicAdd(o + 4 * k + 1, ORDER);
        atomicAdd(o + 4 * k + 2, f * c); atomicAdd(o + 4 * k + 3, LAST); } }"""


def text(nodes: int, order: str = "b * f", last: str = "f", real: str = "float") -> str:
    body = BODY.replace("NODES", str(nodes)).replace("ORDER", order).replace("LAST", last).replace("REAL", real)
    return f'extern "C" __global__ void kernel{body}'


def is_factored(cuda: str, element: str = "float") -> bool:
    return is_factored_ptx(nvrtc.compile_cuda(cuda, "sm_70", OPTIONS), element)


def is_factored_ptx(text: str, element: str = "float") -> bool:
    parsed = ptx.parse(text)
    return f"fmul <4 x {element}>" in generate(parsed.kernels["kernel"], {}, "run", 16).text


@pytest.mark.parametrize("real", ["float", "double"])
@pytest.mark.parametrize("width", [8, 16, 32])
@pytest.mark.parametrize(("order", "last"), [("b * f", "f"), ("f * b", "f * a"), ("f", "f * c")])
def test_same_bits_as_a_product_and_a_sum(real, width, order, last):
    random, dtype = np.random.default_rng(5), np.dtype(real if real == "double" else "f4")
    x, w = random.normal(size=(64, 3)).astype(dtype), random.normal(size=(64, 5)).astype(dtype)
    x[3], x[4, 1], w[7, 2], w[8] = 0, np.inf, -0.0, 0
    out = random.normal(size=(64, 5, 4)).astype(dtype)
    a, b, c, f = x[:61, None, 0], x[:61, None, 1], x[:61, None, 2], w[:61] * w[0, 0]
    values = {"f": f + 0 * a, "b * f": b * f, "f * b": f * b, "f * a": f * a, "f * c": f * c}
    with np.errstate(invalid="ignore"):
        terms = np.stack([f * a, values[order] if order != "f" else f, f * c, values[last] if last != "f" else f], -1)
        want = out.copy()
        want[:61] += terms
    cuda = text(5, order, last, real)
    assert is_factored(cuda, real)
    run(cuda, 1, 64, x, w, out, lane_width=width)
    np.testing.assert_array_equal(out, want)


def test_either_side_of_a_product_may_be_the_factor():
    compiled = nvrtc.compile_cuda(text(4), "sm_70", OPTIONS)
    swapped = re.sub(r"(mul\.ftz\.f32\s+%f\d+), (%f\d+), (%f\d+);", r"\1, \3, \2;", compiled)
    assert swapped != compiled
    assert is_factored_ptx(swapped)
    x, w = np.random.default_rng(6).normal(size=(2, 64, 4)).astype(np.float32)
    results = []
    for source in (compiled, swapped):
        out = np.zeros((64, 16), np.float32)
        engine.compile_ptx(source).kernel("kernel").launch((1,), (64,), (x, w, out))
        results.append(out)
    assert np.abs(results[0]).sum() > 0
    np.testing.assert_array_equal(*results)


def test_other_quads_and_too_few_nodes_are_added_as_they_are():
    assert not is_factored(text(2))
    assert not is_factored(text(5, order="b + f"))
    assert not is_factored(text(5, last="a * b"))
