"""Debug mode: one kernel per kind of defect, beside one that differs by the mending of it."""

from __future__ import annotations

import numpy as np
import pytest
from engine_programs import run

I32 = np.int32


def findings(body: str, threads: int, *args, grid: int = 2, **options):
    return run(body, grid, threads, *args, mode="debug", **options).findings


def kinds(*args, **options) -> list[str]:
    return [finding.kind for finding in findings(*args, **options)]


@pytest.mark.parametrize("seed", range(3))
def test_a_sound_kernel_has_no_findings_in_any_order(seed):
    body = """(float* o) { __shared__ float s[128]; int t = threadIdx.x; s[t] = t; __syncthreads();
        float v = s[127 - t]; __syncthreads(); s[t] = v; __syncthreads(); atomicAdd(&s[t ^ 1], 0.f); __syncthreads();
        o[blockIdx.x * 128 + t] = s[t]; }"""
    out = np.zeros(256, np.float32)
    assert findings(body, 128, out, seed=seed) == ()
    np.testing.assert_array_equal(out, np.tile(127.0 - np.arange(128), 2))


EXCHANGE = """(float* o) {
    __shared__ float s[128]; int t = threadIdx.x;
    s[t] = t;
    BARRIER
    o[blockIdx.x * blockDim.x + t] = s[blockDim.x - 1 - t]; }"""


def test_a_missing_block_barrier_is_a_race():
    found = findings(EXCHANGE.replace("BARRIER", "__syncwarp();"), 128, np.zeros(256, np.float32))
    races = [f for f in found if f.kind == "race"]
    assert races
    assert {races[0].line.line, races[0].other_line.line} == {3, 5}
    assert "different warps" in races[0].message
    assert findings(EXCHANGE.replace("BARRIER", "__syncthreads();"), 128, np.zeros(256, np.float32)) == ()


def test_lanes_of_a_warp_need_a_barrier_too():
    (finding,) = findings(EXCHANGE.replace("BARRIER", ""), 32, np.zeros(64, np.float32))
    assert finding.kind == "race"
    assert "lanes of a warp" in finding.message
    assert findings(EXCHANGE.replace("BARRIER", "__syncwarp();"), 32, np.zeros(64, np.float32)) == ()


def test_two_lanes_must_not_store_to_one_address():
    body = "(float* o) { __shared__ float s; s = threadIdx.x; __syncthreads(); o[threadIdx.x] = s; }"
    found = findings(body, 32, np.zeros(32, np.float32))
    assert [f.kind for f in found] == ["race"]
    assert "several lanes" in found[0].message


def test_stores_of_one_value_are_no_race():
    body = """(float2* o, float v) { __shared__ float2 s[2]; float* f = (float*)s;
        s[0] = make_float2(v, v + 1.f); VALUE __syncthreads(); o[threadIdx.x] = s[0]; }"""
    out = np.zeros((128, 2), np.float32)
    assert kinds(body.replace("VALUE", ""), 128, out, np.float32(3)) == []
    assert (out == [3, 4]).all()
    assert "race" in kinds(body.replace("VALUE", "if (threadIdx.x == 77) f[1] = v;"), 128, out, np.float32(3))
    overlapping = body.replace("VALUE", "if (threadIdx.x == 64) { f[1] = v; f[2] = v + 1.f; }")
    assert "race" in kinds(overlapping, 128, out, np.float32(3))
    signs = (
        "(double* o) { __shared__ double s; s = threadIdx.x & 1 ? -1.0 : 1.0; __syncthreads(); o[threadIdx.x] = s; }"
    )
    assert "race" in kinds(signs, 32, np.zeros(32))


def test_atomics_race_with_plain_accesses_only():
    body = """(int* o) { __shared__ int s; if (threadIdx.x == 0) s = 0; __syncthreads();
        atomicAdd(&s, 1); BARRIER o[threadIdx.x] = s; }"""
    out = np.zeros(128, I32)
    assert kinds(body.replace("BARRIER", "__syncthreads();"), 128, out) == []
    assert (out == 128).all()
    found = findings(body.replace("BARRIER", ""), 128, out, grid=1)
    assert [(f.kind, f.severity) for f in found] == [("atomic-mix", "WARNING")]


def test_uninitialised_shared_memory_is_reported_and_poisoned():
    body = """(float* o, int n) {
        __shared__ float s[64]; if ((int)threadIdx.x < n) s[threadIdx.x] = 1.f; __syncthreads();
        o[threadIdx.x] = s[threadIdx.x]; }"""
    out = np.zeros(64, np.float32)
    (finding,) = findings(body, 64, out, I32(60))
    assert (finding.kind, finding.count) == ("uninitialised", 8)
    assert np.isnan(out[60:]).all()
    assert findings(body, 64, out, I32(64)) == ()


@pytest.mark.parametrize(
    ("body", "kind", "threads"),
    [
        ("(float* o, int n) { o[threadIdx.x + n] = 1.f; }", "out-of-bounds", 64),
        ("(float* o, int n) { o[threadIdx.x] = o[(int)threadIdx.x - n]; }", "out-of-bounds", 64),
        ("(float* o, int n) { atomicAdd(o + threadIdx.x + n, 1.f); }", "out-of-bounds", 64),
        ("(float* o, int n) { extern __shared__ float s[]; s[threadIdx.x + n] = 1.f; }", "out-of-bounds", 32),
        ("(float* o, int n) { *(float4*)(o + n + 4 * (threadIdx.x & 3)) = make_float4(1, 2, 3, 4); }", "misaligned", 4),
    ],
)
def test_accesses_that_leave_their_array_are_found_and_not_carried_out(body, kind, threads):
    around = np.zeros(192, np.float32)
    start = -(around.ctypes.data + 256) % 16 // 4 + 64
    inside = around[start : start + 64]
    assert kinds(body, threads, inside, I32(0), grid=1, shared_bytes=128) == []
    around[:] = 0
    (finding,) = findings(body, threads, inside, I32(3), grid=1, shared_bytes=128)
    assert finding.kind == kind
    assert finding.count == (3 if kind == "out-of-bounds" else 4)
    assert not around[:start].any()
    assert not around[start + 64 :].any()


def test_arrays_behind_pointers_can_be_named():
    out = np.zeros(8)
    holder = np.array([out.ctypes.data], np.int64)
    body = "(double* const* p) { p[0][threadIdx.x] = 1.0; }"
    assert kinds(body, 8, holder, grid=1) == ["out-of-bounds"]
    assert kinds(body, 8, holder, grid=1, allocations=(out,)) == []


def test_warps_that_leave_others_at_a_barrier_are_reported():
    body = "(int* o) { if (threadIdx.x >= 64) return; __syncthreads(); o[threadIdx.x] = 1; }"
    (finding,) = findings(body, 128, np.zeros(128, I32))
    assert (finding.kind, finding.count) == ("divergent-barrier", 2)


def test_a_racing_kernel_gives_different_results_in_different_orders():
    body = """(int* o) { __shared__ int s; if (threadIdx.x % 32 == 0) s = threadIdx.x; __syncthreads();
        if (threadIdx.x == 0) o[blockIdx.x] = s; }"""
    seen = set()
    for seed in range(6):
        out = np.zeros(2, I32)
        findings(body, 256, out, seed=seed)
        seen.update(out.tolist())
    assert len(seen) > 1
