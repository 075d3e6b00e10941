"""Counters against patterns that can be counted by hand, and against brute force over random addresses."""

from __future__ import annotations

import ctypes

import numpy as np
import pytest
from engine_programs import run

from mpmbench.simt import engine
from mpmbench.simt.counters import SourceLine, Tally

I32 = np.int32
WIDTHS = (8, 16, 32)


def aligned(count: int, dtype: type, start: int = 0) -> np.ndarray:
    """An array whose first byte stands ``start`` bytes after a multiple of 4096."""
    size = np.dtype(dtype).itemsize * count
    raw = np.zeros(size + 8192, np.uint8)
    first = -raw.ctypes.data % 4096 + start
    return raw[first : first + size].view(dtype)


def count(body: str, grid: int, block: int, *args, **options) -> Tally:
    result = run(body, grid, block, *args, mode="count", **options)
    assert result.findings == ()
    assert result.counters is not None
    total = sum(result.counters.lines.values(), Tally())
    assert total == result.counters.total
    return total


@pytest.mark.parametrize("width", WIDTHS)
def test_instructions_and_lanes(width):
    """A partial warp issues as a whole."""
    body = "(const float* x, float* y) { y[threadIdx.x] = x[threadIdx.x] + 1.f; }"
    x, y = aligned(64, np.float32), aligned(64, np.float32)
    one, two = (count(body, 1, threads, x, y, lane_width=width) for threads in (32, 40))
    assert one.lane_inst == 32 * one.warp_inst
    assert two.warp_inst == 2 * one.warp_inst
    assert two.lane_inst == 40 * one.warp_inst
    assert (one.gld_req, one.gst_req, two.gld_req) == (1, 1, 2)


def test_lines_are_those_of_the_source():
    text = """extern "C" __global__ void kernel(float* x, int* y) {
        x[threadIdx.x] = 1.f;
        atomicAdd(&y[0], 1);
        __syncthreads();
    }"""
    result = run(text, 1, 64, aligned(64, np.float32), aligned(1, I32), mode="count")
    assert result.counters is not None
    lines = {line.line: tally for line, tally in result.counters.lines.items() if line.file == "test.cu"}
    assert SourceLine("test.cu", 2) in result.counters.lines
    assert lines[2].gst_req == 2
    assert (lines[3].gatom_req, lines[3].gatom_lane) == (2, 64)
    assert lines[4].bar == 2


@pytest.mark.parametrize(
    ("index", "start", "sectors"),
    [
        ("t", 0, 4),  # 128 contiguous bytes
        ("t", 4, 5),  # the same, off by a word
        ("8 * t", 0, 32),
        ("2 * t", 0, 8),
        ("0", 0, 1),
        ("t / 2", 0, 2),
        ("31 - t", 0, 4),
    ],
)
def test_sectors_of_loads_and_stores(index, start, sectors):
    x = aligned(300, np.float32, start)
    body = f"(const float* x, float* y) {{ int t = threadIdx.x; float v = x[{index}]; y[{index}] = v + 1.f; }}"
    tally = count(body, 1, 32, x, aligned(300, np.float32, start))
    assert (tally.gld_req, tally.gld_sectors) == (1, sectors)
    assert (tally.gst_req, tally.gst_sectors) == (1, sectors)


def test_a_vector_load_is_one_request():
    body = "(const float4* x, float4* y) { y[threadIdx.x] = x[threadIdx.x]; }"
    tally = count(body, 1, 32, aligned(128, np.float32), aligned(128, np.float32))
    assert (tally.gld_req, tally.gld_sectors, tally.gst_req, tally.gst_sectors) == (1, 16, 1, 16)


def test_branches():
    """Three trips in every lane: the loop's branch three times per warp. One lane more: one divergent branch."""
    body = """(int* o, const int* n) { int t = threadIdx.x, s = 0;
        #pragma unroll 1
        for (int i = 0; i < n[t]; ++i) { s += i; o[t] = s; } }"""
    trips = np.full(64, 3, I32)
    same = count(body, 1, 64, aligned(64, I32), trips)
    trips[40] = 4
    other = count(body, 1, 64, aligned(64, I32), trips)
    assert (same.div_branch, other.div_branch) == (0, 1)
    assert other.branch == same.branch + 1
    assert same.branch >= 6


@pytest.mark.parametrize("width", WIDTHS)
def test_atomics_by_brute_force(width):
    rng = np.random.default_rng(3)
    place = rng.integers(0, 64, 128).astype(I32)
    active = rng.random(128) < 0.8
    out = aligned(64, np.float32)
    body = """(const int* place, const bool* active, float* out) {
        int t = threadIdx.x; if (active[t]) atomicAdd(out + place[t], 1.f); }"""
    tally = count(body, 1, 128, place, active, out, lane_width=width)
    np.testing.assert_array_equal(out, np.bincount(place[active], minlength=64))
    sectors = passes = 0
    for warp in range(4):
        here = place[32 * warp :][:32][active[32 * warp :][:32]]
        for sector in np.unique(here // 8):
            sectors += 1
            passes += np.bincount(here[here // 8 == sector]).max()
    assert (tally.gatom_req, tally.gatom_lane) == (4, active.sum())
    assert (tally.gatom_sectors, tally.gatom_pass) == (sectors, passes)


@pytest.mark.parametrize("start", [0, 8])
def test_adds_to_four_neighbours_are_four_requests(start):
    """Aligned or not: what a fused add of 16 bytes stands for."""
    rng = np.random.default_rng(4)
    node = rng.integers(0, 20, 32).astype(I32)
    out = aligned(100, np.float32, start)
    body = """(const int* node, float* out) { float* g = out + 4 * node[threadIdx.x];
        atomicAdd(g, 1.f); atomicAdd(g + 1, 2.f); atomicAdd(g + 2, 3.f); atomicAdd(g + 3, 4.f); }"""
    tally = count(body, 1, 32, node, out)
    sectors = passes = 0
    for word in range(4):
        at = 4 * node + word + start // 4
        for sector in np.unique(at // 8):
            sectors += 1
            passes += np.bincount(at[at // 8 == sector]).max()
    assert (tally.gatom_req, tally.gatom_lane) == (4, 128)
    assert (tally.gatom_sectors, tally.gatom_pass) == (sectors, passes)


def wavefronts(words: np.ndarray, width: int) -> int:
    """words: first 4-byte word of every lane; width: bytes per lane."""
    group = 128 // width
    total = 0
    for first in range(0, 32, group):
        used = {int(w) + k for w in words[first : first + group] for k in range(width // 4)}
        total += np.bincount([word % 32 for word in used]).max()
    return total


@pytest.mark.parametrize("width", [4, 8, 16])
def test_shared_wavefronts_by_brute_force(width):
    rng = np.random.default_rng(5)
    kind = {4: "float", 8: "float2", 16: "float4"}[width]
    dtype = np.dtype((np.float32, width // 4)) if width > 4 else np.dtype(np.float32)
    body = f"""(const int* from, const int* to, {kind}* out) {{ __shared__ {kind} s[256]; int t = threadIdx.x;
        s[to[t]] = out[t]; __syncthreads(); out[t] = s[from[t]]; }}"""
    for stride in (1, 2, 5, 8, 0):
        t = np.arange(32)
        to = (t * stride % 256 if stride else rng.permutation(256)[:32]).astype(I32)
        source = (t * 3 % 256 if stride else rng.integers(0, 256, 32)).astype(I32)
        tally = count(body, 1, 32, source, to, np.zeros(32, dtype))
        words = width // 4
        want = wavefronts(to * words, width) + wavefronts(source * words, width)
        assert (tally.sst_req, tally.sld_req, tally.shm_wavefronts) == (1, 1, want)


def test_shared_atomics():
    body = """(int* out) { __shared__ int s[8]; int t = threadIdx.x; if (t < 8) s[t] = 0; __syncthreads();
        atomicAdd(&s[t % 5], t); __syncthreads(); if (t < 8) out[t] = s[t]; }"""
    out = np.zeros(8, I32)
    tally = count(body, 1, 64, out)
    assert (tally.satom_req, tally.satom_lane, tally.satom_iter) == (2, 64, 7 + 7)
    assert tally.satom_wavefronts == 7 + 7
    assert tally.bar == 4
    assert tally.gatom_req == 0


@pytest.mark.parametrize(("kind", "width"), [("float", 4), ("double", 8)])
def test_shared_atomics_wavefronts_by_brute_force(kind, width):
    """In each round the lanes that are not served yet pass by the banks of their words, 8-byte ones in two halves."""
    rng = np.random.default_rng(6)
    body = f"""(const int* to, {kind}* out) {{ __shared__ {kind} s[512]; int t = threadIdx.x;
        for (int i = t; i < 512; i += 32) s[i] = 0;
        __syncthreads(); if (to[t] >= 0) atomicAdd(&s[to[t]], ({kind})1);
        __syncthreads(); out[t] = s[t]; }}"""
    cases = [np.arange(32), 4 * np.arange(32), np.arange(32) // 5 * 32, np.full(32, 7), rng.integers(0, 12, 32)]
    cases += [rng.integers(0, 512, 32), np.where(rng.random(32) < 0.4, rng.integers(0, 40, 32), -1)]
    for to in cases:
        tally = count(body, 1, 32, to.astype(I32), np.zeros(32, np.dtype(kind if kind == "double" else "float32")))
        turn = np.array([np.count_nonzero(to[:lane] == to[lane]) for lane in range(32)])
        want = 0
        for served in range(1 + turn[to >= 0].max()):
            waiting = (turn >= served) & (to >= 0)
            for half in np.split(np.arange(32), width // 4):
                words = np.unique(to[half][waiting[half]]) * (width // 4)
                want += np.bincount(words % 32).max(initial=0)
        assert tally.satom_iter == 1 + turn[to >= 0].max()
        assert tally.satom_wavefronts == want


def test_local_and_generic_accesses():
    body = """__device__ __noinline__ float get(const float* p, int i) { return p[i]; }
        extern "C" __global__ void kernel(const float* x, float* out, int n) {
            __shared__ float s[32]; int t = threadIdx.x; s[t] = t; __syncthreads(); __syncwarp();
            out[t] = get(n ? x : s, t); }"""
    x = aligned(32, np.float32)
    in_global, in_shared = (count(body, 1, 32, x, aligned(32, np.float32), I32(n)) for n in (1, 0))
    assert (in_global.gld_req, in_global.gld_sectors, in_global.sld_req) == (1, 4, 0)
    assert (in_shared.gld_req, in_shared.sld_req, in_shared.shm_wavefronts) == (0, 1, 2)
    assert in_shared.bar_warp == 1
    body = """(float* out, int n) { float l[8]; int t = threadIdx.x;
        for (int k = 0; k < 8; ++k) l[(k + n) & 7] = k; out[t] = l[(t + n) & 7]; }"""
    tally = count(body, 1, 32, aligned(32, np.float32), I32(3))
    assert (tally.lld_req, tally.lst_req > 0, tally.gst_req) == (1, True, 1)


def test_far_addresses_in_one_request_are_told_apart():
    """Sector numbers that agree in their low 31 or 32 bits, as those of arrays far apart may."""
    rng = np.random.default_rng(8)
    lanes = rng.integers(0, 2, 32)
    for name, shift in (("count_global", 36), ("count_global", 37), ("count_atomics", 36), ("count_atomics", 32)):
        addresses = aligned(32, np.int64)
        addresses[:] = 0x7F0000000000 + (lanes << shift) + 32 * (np.arange(32) % 3)
        words = np.zeros(12, np.int64)
        function = ctypes.CFUNCTYPE(
            None, ctypes.c_void_p, ctypes.c_int64, ctypes.c_int32, ctypes.c_void_p, ctypes.c_int64, ctypes.c_int64
        )(engine._load_support().address(name))
        mask = int(rng.integers(1 << 31))
        function(addresses.ctypes.data, 0, mask, words.ctypes.data, 1, 4)
        active = addresses[[bool(mask >> lane & 1) for lane in range(32)]]
        passes = [np.unique(active[active >> 5 == s], return_counts=True)[1].max() for s in np.unique(active >> 5)]
        want = [1, len(active), len(passes), sum(passes) if name == "count_atomics" else 0]
        assert words[:4].tolist() == want
