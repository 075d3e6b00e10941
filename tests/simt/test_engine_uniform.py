"""Registers that hold the same for all lanes are computed where they are read: no slots, no dependence on who ran."""

from __future__ import annotations

import numpy as np
import pytest
from engine_programs import OPTIONS, run

from mpmbench.simt import nvrtc, ptx
from mpmbench.simt.codegen import generate

I32 = np.int32


def context_bytes(body: str) -> int:
    text = nvrtc.compile_cuda(f'extern "C" __global__ void kernel{body}', "sm_70", OPTIONS)
    return generate(ptx.parse(text).kernels["kernel"], {}, "run", 16).context_bytes


def test_parameters_and_their_products_take_no_room_in_a_warps_context():
    body = """(int* o, int a, int b, int c, float d) {
        int t = threadIdx.x, k = t; __syncthreads();
        if (t < VALUE) k += VALUE; __syncthreads();
        if (t > VALUE) k -= (int)d * VALUE; __syncthreads();
        o[t] = k; }"""
    assert context_bytes(body.replace("VALUE", "(a * b + 4 - c * (int)gridDim.x)")) <= context_bytes(
        body.replace("VALUE", "9")
    )


@pytest.mark.parametrize("width", [8, 16, 32])
@pytest.mark.parametrize("mode", ["run", "count", "debug"])
def test_a_uniform_value_is_right_for_lanes_that_did_not_run_its_definition(width, mode):
    out = np.zeros((3, 70), I32)
    run(
        """(int* out, int a, int b) {
            int t = threadIdx.x, last = gridDim.x * a - 1, k = 0;
            if (t % 3 == 0) k = a * b + blockIdx.x;
            __syncthreads();
            #pragma unroll 1
            for (int i = 0; i < t % 4; ++i) { k += a * b + i; if (i == b) k -= last; }
            __syncthreads();
            if (t & 1) k += a * b + last;
            out[blockIdx.x * 70 + t] = k; }""",
        3,
        70,
        out,
        I32(7),
        I32(2),
        mode=mode,
        lane_width=width,
    )
    a, b, last = 7, 2, 3 * 7 - 1
    want = np.zeros_like(out)
    for block in range(3):
        for t in range(70):
            k = a * b + block if t % 3 == 0 else 0
            for i in range(t % 4):
                k += a * b + i - (last if i == b else 0)
            want[block, t] = k + (a * b + last if t & 1 else 0)
    np.testing.assert_array_equal(out, want)
