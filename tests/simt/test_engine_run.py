"""The engine's results against plain NumPy: what a launch is, memory of every kind, control flow, atomics."""

from __future__ import annotations

import numpy as np
import pytest
from engine_programs import OPTIONS, kernel, run

from mpmbench.errors import InputError
from mpmbench.simt import engine, nvrtc

I32 = np.int32
WIDTHS = (8, 16, 32)


@pytest.fixture
def rng():
    return np.random.default_rng(11)


# --- launches ---------------------------------------------------------------------------------------------------------


def test_every_thread_knows_its_place():
    grid, block = (3, 2, 2), (5, 3, 2)
    out = np.zeros((12, 30, 6), I32)
    run(
        """(int* out) {
            int thread = (threadIdx.z * blockDim.y + threadIdx.y) * blockDim.x + threadIdx.x;
            int block = (blockIdx.z * gridDim.y + blockIdx.y) * gridDim.x + blockIdx.x;
            int* o = out + 6 * (block * 30 + thread);
            o[0] = threadIdx.x; o[1] = threadIdx.y; o[2] = threadIdx.z;
            o[3] = blockIdx.x; o[4] = blockIdx.y; o[5] = blockIdx.z; }""",
        grid,
        block,
        out,
    )
    z, y, x = np.unravel_index(np.arange(30), block[::-1])
    bz, by, bx = np.unravel_index(np.arange(12), grid[::-1])
    np.testing.assert_array_equal(out[..., :3], np.broadcast_to(np.stack([x, y, z], -1), (12, 30, 3)))
    np.testing.assert_array_equal(out[..., 3:], np.broadcast_to(np.stack([bx, by, bz], -1)[:, None], (12, 30, 3)))


@pytest.mark.parametrize("width", WIDTHS)
def test_threads_past_the_end_of_a_partial_warp_do_nothing(width, rng):
    x, y = rng.normal(size=(2, 77)).astype(np.float32)
    want = np.float32(3) * x + y
    room = np.concatenate([y, np.full(200, -1, np.float32)])
    body = """(float a, const float* x, float* y) {
        int i = blockIdx.x * 11 + threadIdx.x; y[i] = __fmaf_rn(a, x[i], y[i]); }"""
    run(body, 7, 11, np.float32(3), x, room, lane_width=width)
    np.testing.assert_allclose(room[:77], want, rtol=1e-6)
    assert (room[77:] == -1).all()


def test_structures_pass_by_value():
    domain = np.zeros((), np.dtype([("shape", I32, 3), ("scale", np.float64), ("out", np.int64)], align=True))
    out = np.zeros(2)
    domain["shape"], domain["scale"], domain["out"] = (7, 8, 9), 0.5, out.ctypes.data
    run(
        """struct Domain { int shape[3]; double scale; double* out; };
        extern "C" __global__ void kernel(char pad, Domain d) {
            d.out[threadIdx.x] = d.shape[threadIdx.x] * d.scale + pad; }""",
        1,
        2,
        np.int8(2),
        domain[()],
    )
    np.testing.assert_array_equal(out, [5.5, 6.0])


def test_an_empty_launch_is_a_launch():
    out = np.ones(4, np.float32)
    assert run("(float* o) { o[threadIdx.x] = 2.f; }", (0, 1, 1), 32, out).findings == ()
    assert (out == 1).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "takes 2 arguments, 0 given"),
        ((np.zeros((4, 4))[:, ::2], np.int32(1)), "not C-contiguous"),
        ((np.zeros(4), np.int64(1)), "has 8 bytes, the kernel expects 4"),
        ((np.zeros(4), 1), "pass a NumPy array or scalar"),
    ],
)
def test_wrong_arguments_are_named(arguments, message):
    with pytest.raises(InputError, match=message):
        run("(double* o, int n) { o[0] = n; }", 1, 1, *arguments)


def test_impossible_launches_are_refused():
    with pytest.raises(InputError, match="2048 threads"):
        run("(int* o) { o[0] = 1; }", 1, 2048, np.zeros(1, I32))
    with pytest.raises(InputError, match="shared memory"):
        run("(int* o) { o[0] = 1; }", 1, 32, np.zeros(1, I32), shared_bytes=1 << 20)
    module = engine.compile_ptx(nvrtc.compile_cuda('extern "C" __global__ void here() {}', "sm_52"))
    with pytest.raises(InputError, match=r"no kernel 'there'; the module has: here"):
        module.kernel("there")
    with pytest.raises(InputError, match="unknown mode"):
        engine.compile_ptx("", "fast")


def test_unsupported_instructions_name_opcode_and_line():
    text = '\n\nextern "C" __global__ void kernel(long long* o) { o[0] = clock64(); }'
    with pytest.raises(InputError, match=r"does not support 'mov.u64' \(test.cu:3\)"):
        kernel(text)


def test_a_runaway_loop_ends_with_a_finding():
    flag = np.zeros(1, I32)
    result = run("(volatile int* flag) { while (flag[0] == 0) ; }", 1, 32, flag, budget=10_000)
    (finding,) = result.findings
    assert finding.kind == "runaway"
    assert "test.cu:1" in finding.message


def test_a_trap_ends_the_launch():
    out = np.zeros(3, I32)
    (finding,) = run("(int* o) { o[blockIdx.x] = 1; if (blockIdx.x == 1) __trap(); }", 3, 32, out).findings
    assert finding.kind == "trap"
    assert out.tolist() == [1, 1, 0]


# --- memory -----------------------------------------------------------------------------------------------------------


def test_local_arrays_and_switches(rng):
    a = rng.integers(0, 1000, 96).astype(I32)
    out = np.zeros_like(a)
    run(
        """(const int* a, int* out) {
            int t = threadIdx.x, x = a[t], local[16], sum = 0;
            for (int k = 0; k < 16; ++k) local[k] = x * k + t;
            for (int k = 0; k < x % 16; ++k) sum += local[(x + 3 * k) & 15];
            switch (x % 6) { case 0: sum += 3; break; case 1: sum *= 5; break; case 2: sum -= 8; break;
                             case 3: sum ^= 77; break; case 4: sum |= 5; break; default: sum = sum / 3; }
            out[t] = sum; }""",
        1,
        96,
        a,
        out,
    )

    def expected(t: int, x: int) -> int:
        total = sum(x * ((x + 3 * k) & 15) + t for k in range(x % 16))
        return [total + 3, total * 5, total - 8, total ^ 77, total | 5, total // 3][x % 6]

    np.testing.assert_array_equal(out, [expected(t, int(x)) for t, x in enumerate(a)])


def test_module_variables_keep_their_values_between_launches():
    text = """__constant__ float table[4] = {1, 2, 3, 4}; __device__ int launches = 5;
    extern "C" __global__ void kernel(float* o, int* n) { o[threadIdx.x] = table[threadIdx.x & 3];
        if (threadIdx.x == 0) n[0] = atomicAdd(&launches, 1); }"""
    out, count = np.zeros(8, np.float32), np.zeros(1, I32)
    compiled = kernel(text)
    for want in (5, 6):
        compiled.launch((1,), (8,), (out, count))
        assert count[0] == want
    assert out.tolist() == [1, 2, 3, 4] * 2


def test_dynamic_shared_memory_follows_static():
    out = np.zeros(64, I32)
    run(
        """(int* o) { __shared__ int fixed[64]; extern __shared__ int rest[]; int t = threadIdx.x;
            fixed[t] = t; rest[t] = 100 * t; __syncthreads(); o[t] = fixed[63 - t] + rest[63 - t]; }""",
        1,
        64,
        out,
        shared_bytes=256,
    )
    np.testing.assert_array_equal(out, 101 * np.arange(63, -1, -1))


def test_generic_pointers_reach_every_space():
    out = np.zeros(64, I32)
    run(
        """__device__ __noinline__ int get(const int* p, int i) { return p[i]; }
        extern "C" __global__ void kernel(int* o) { __shared__ int s[64]; int l[4]; int t = threadIdx.x;
            for (int k = 0; k < 4; ++k) l[k] = 1000 * k + t;
            s[t] = 2 * t; __syncthreads(); o[64 + t] = t & 1 ? get(s, 63 - t) : get(l, t & 3);
            o[t] = get(o, 64 + t); }""",
        1,
        64,
        out := np.zeros(128, I32),
    )
    t = np.arange(64)
    np.testing.assert_array_equal(out[:64], np.where(t & 1, 2 * (63 - t), 1000 * (t & 3) + t))


@pytest.mark.parametrize("width", WIDTHS)
def test_widths_of_access(width, rng):
    small = rng.integers(-128, 127, 64).astype(np.int8)
    quad = rng.normal(size=(64, 4)).astype(np.float32)
    pair = rng.normal(size=(64, 2))
    out_small, out_quad, out_pair = np.zeros(64, np.int16), np.zeros_like(quad), np.zeros_like(pair)
    run(
        """(const signed char* a, short* b, const float4* c, float4* d, const double2* e, double2* f) {
            int t = threadIdx.x; if (t % 3 == 1) return;
            b[t] = a[t] * 2; float4 v = c[63 - t]; d[t] = make_float4(v.w, v.z, v.y, v.x);
            double2 p = e[t]; f[63 - t] = make_double2(p.y, -p.x); }""",
        1, 64, small, out_small, quad, out_quad, pair, out_pair, lane_width=width,
    )  # fmt: skip
    alive = np.arange(64) % 3 != 1
    np.testing.assert_array_equal(out_small, np.where(alive, small.astype(np.int16) * 2, 0))
    np.testing.assert_array_equal(out_quad, np.where(alive[:, None], quad[::-1, ::-1], 0))
    want = np.stack([pair[:, 1], -pair[:, 0]], -1)[::-1]
    np.testing.assert_array_equal(out_pair, np.where(alive[::-1, None], want, 0))


def test_where_lanes_store_to_one_address_the_last_one_wins():
    out = np.zeros(2, I32)
    run("(int* o) { o[0] = threadIdx.x; if (threadIdx.x < 21) o[1] = threadIdx.x; }", 1, 64, out)
    assert out.tolist() == [63, 20]


# --- control flow -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("width", WIDTHS)
def test_divergent_loops_meet_again(width, rng):
    n = rng.integers(0, 40, 128).astype(I32)
    out, together = np.zeros(128, I32), np.zeros(128, np.uint32)
    run(
        """(const int* n, int* o, unsigned* together) {
            int t = threadIdx.x, sum = 0;
            for (int i = 0; i < n[t]; ++i) { if (i % 3 == t % 3) continue; sum += i; if (sum > 200) break; }
            together[t] = __activemask(); o[t] = sum; }""",
        1, 128, n, out, together, lane_width=width,
    )  # fmt: skip
    want = []
    for t, limit in enumerate(n):
        total = 0
        for i in range(limit):
            if i % 3 != t % 3:
                total += i
                if total > 200:
                    break
        want.append(total)
    np.testing.assert_array_equal(out, want)
    assert (together == 0xFFFFFFFF).all()


@pytest.mark.parametrize("width", WIDTHS)
def test_block_reduction_with_barriers_and_shuffles(width, rng):
    x = rng.integers(-1000, 1000, 4 * 256).astype(I32)
    out = np.zeros(4, I32)
    run(
        """(const int* x, int* o) { __shared__ int part[8]; int t = threadIdx.x, v = x[blockIdx.x * 256 + t];
            for (int d = 16; d; d >>= 1) v += __shfl_down_sync(~0u, v, d);
            if (t % 32 == 0) part[t / 32] = v;
            __syncthreads();
            if (t < 8) { v = part[t]; for (int d = 4; d; d >>= 1) v += __shfl_xor_sync(0xff, v, d); }
            if (t == 0) o[blockIdx.x] = v; }""",
        4, 256, x, out, lane_width=width,
    )  # fmt: skip
    np.testing.assert_array_equal(out, x.reshape(4, 256).sum(1))


@pytest.mark.parametrize("mode", ["run", "debug"])
def test_barriers_that_reduce(mode):
    """Many in a row, so that fast warps meet the next one before slow ones have read the last."""
    out = np.zeros((20, 160, 3), I32)
    body = """(int* o) { int t = threadIdx.x;
        #pragma unroll 1
        for (int k = 0; k < 20; ++k) {
            int n = __syncthreads_count(t % (k + 1) == 0), a = __syncthreads_and(t + 1 > k);
            int s = __syncthreads_or(t == 8 * k);
            int* p = o + 3 * (160 * k + t); p[0] = n; p[1] = a; p[2] = s; } }"""
    assert run(body, 2, 160, out, mode=mode).findings == ()
    t = np.arange(160)
    for k in range(20):
        want = [np.sum(t % (k + 1) == 0), k == 0, 8 * k < 160]
        assert (out[k] == want).all()


def test_warps_that_have_ended_do_not_hold_up_a_barrier():
    out = np.zeros(128, I32)
    run("(int* o) { if (threadIdx.x >= 64) return; __syncthreads(); o[threadIdx.x] = 1; }", 1, 128, out)
    assert out.tolist() == [1] * 64 + [0] * 64


def test_a_barrier_inside_a_divergent_branch_is_a_finding():
    (finding,) = run(
        "(int* o) { if (threadIdx.x & 1) __syncthreads(); o[threadIdx.x] = 1; }", 1, 64, np.zeros(64, I32)
    ).findings
    assert finding.kind == "divergent-barrier"
    assert finding.line is not None
    assert finding.line.line == 1


def test_lanes_that_do_not_come_to_a_shuffle_are_a_finding():
    body = "(int* o) { int t = threadIdx.x; if (t < 16) o[t] = __shfl_sync(~0u, t, 3); }"
    (finding,) = run(body, 1, 32, np.zeros(32, I32)).findings
    assert finding.kind == "bad-mask"


# --- atomics ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("space", ["global", "shared"])
@pytest.mark.parametrize("real", ["float", "double"])
def test_adds_to_neighbouring_words(width, space, real, rng):
    """Runs of 1, 2, 3, 4 and 7 neighbouring words, to the same and to different places, under a mask."""
    dtype = {"float": np.float32, "double": np.float64}[real]
    node = rng.integers(0, 9, 256).astype(I32)
    x = rng.integers(-8, 8, 256).astype(dtype)
    grid = np.zeros((9, 16), dtype)
    adds = "".join(
        f"atomicAdd(g + {word}, x[t] * {word + 1});" for word in (0, 2, 3, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14)
    )
    to_shared = space == "shared"
    run(
        f"""(const int* node, const {real}* x, {real}* grid) {{ int t = threadIdx.x; __shared__ {real} s[144];
            {real}* g = ({"s" if to_shared else "grid"}) + 16 * node[t];
            if ({int(to_shared)} && t < 144) s[t] = 0;
            __syncthreads();
            if (t % 7 != 3) {{ {adds} }}
            __syncthreads();
            if ({int(to_shared)} && t < 144) grid[t] = s[t]; }}""",
        1, 256, node, x, grid, lane_width=width,
    )  # fmt: skip
    want = np.zeros_like(grid)
    for t in range(256):
        if t % 7 != 3:
            for word in (0, 2, 3, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14):
                want[node[t], word] += x[t] * (word + 1)
    np.testing.assert_array_equal(grid, want)


def test_an_add_is_seen_by_the_loads_that_follow_it():
    out = np.zeros(33, I32)
    body = """(int* o) { int t = threadIdx.x;
        atomicAdd(o + t, 5); int x = o[t]; atomicAdd(o + t + 1, 100); o[t] = x + o[t]; }"""
    run(body, 1, 1, out)
    assert out[:2].tolist() == [10, 100]


@pytest.mark.parametrize("width", WIDTHS)
def test_every_atomic_operation(width):
    n = 200
    ints = np.array([0, 5, -5, -1, 0, 0, 3, -1, 0], I32)
    words = np.array([6, 3], np.uint32)
    longs = np.array([1, 7], np.uint64)
    sums = np.zeros(1)
    seen = np.zeros(n, I32)
    run(
        """(int* i, unsigned* u, unsigned long long* l, double* d, int* seen) { int t = threadIdx.x;
            seen[t] = atomicAdd(&i[0], 1); atomicMin(&i[1], -t); atomicMax(&i[2], t); atomicAnd(&i[3], ~(1 << (t & 7)));
            atomicOr(&i[4], t); atomicXor(&i[5], t * t); atomicExch(&i[6], t); atomicCAS(&i[7], t - 1, t);
            atomicInc(&u[0], 9); atomicDec(&u[1], 4); atomicAdd(&l[0], 1ull << 33); atomicMax(&l[1], 3ull * t);
            unsigned long long* bits = (unsigned long long*)d; unsigned long long old = *bits, was;
            do { was = old; old = atomicCAS(bits, was, __double_as_longlong(0.5 + __longlong_as_double(was))); }
            while (was != old); }""",
        1, n, ints, words, longs, sums, seen, lane_width=width,
    )  # fmt: skip
    t = np.arange(n)
    assert sorted(seen.tolist()) == t.tolist()
    squares = int(np.bitwise_xor.reduce(t * t))
    assert ints.tolist() == [n, -(n - 1), n - 1, ~255, 255, squares, n - 1, n - 1, 0]
    up, down = 6, 3
    for _ in range(n):
        up = 0 if up >= 9 else up + 1
        down = 4 if down == 0 or down > 4 else down - 1
    assert words.tolist() == [up, down]
    assert longs.tolist() == [1 + n * 2**33, 3 * (n - 1)]
    assert sums[0] == n / 2


def test_denormals_flush_with_and_without_double_arithmetic():
    """Alone, the processor flushes; beside double arithmetic, whose denormals count, code does."""
    tiny = np.array([1e-40, -1e-40, 1e-30, 2e-38], np.float32)
    small = np.array([1e-310, 5e-324, 1.0, 2.0])
    alone, mixed, doubles = np.ones(4, np.float32), np.ones(4, np.float32), np.zeros(4)
    run("(const float* x, float* y) { y[threadIdx.x] = x[threadIdx.x] * 0.5f; }", 1, 4, tiny, alone)
    run(
        """(const float* x, float* y, const double* a, double* b) {
            y[threadIdx.x] = x[threadIdx.x] * 0.5f; b[threadIdx.x] = a[threadIdx.x] * 3.0; }""",
        1, 4, tiny, mixed, small, doubles,
    )  # fmt: skip
    want = np.array([0, -0.0, 5e-31, 0], np.float32)
    for got in (alone, mixed):
        np.testing.assert_array_equal(got.view(I32), want.view(I32))
    np.testing.assert_array_equal(doubles, small * 3)
    assert np.float32(1e-40) * np.float32(1) != 0  # the caller's mode is as it was


# --- modes ------------------------------------------------------------------------------------------------------------

SCATTER = """(const float4* x, float4* grid, int n) {
    int p = blockIdx.x * blockDim.x + threadIdx.x; if (p >= n) return;
    float4 v = x[p]; int b = (int)v.w;
    #pragma unroll
    for (int i = 0; i < 4; ++i) { float w = 0.1f * i + v.x; float* g = &grid[b + i].x;
        atomicAdd(g, w * v.x); atomicAdd(g + 1, w * v.y); atomicAdd(g + 2, w * v.z); atomicAdd(g + 3, w); } }"""


def test_run_and_count_give_the_same_bits(rng):
    x = rng.normal(size=(1000, 4)).astype(np.float32)
    x[:, 3] = rng.integers(0, 30, 1000)
    grids = []
    for mode in ("run", "count", "run"):
        grid = np.zeros((40, 4), np.float32)
        run(SCATTER, 8, 128, x, grid, I32(1000), mode=mode)
        grids.append(grid)
    want = np.zeros((40, 4))
    for i in range(4):
        w = 0.1 * i + x[:, 0].astype(float)
        np.add.at(want, x[:, 3].astype(int) + i, np.stack([w * x[:, 0], w * x[:, 1], w * x[:, 2], w], -1))
    np.testing.assert_allclose(grids[0], want, atol=2e-4)
    for grid in grids[1:]:
        np.testing.assert_array_equal(grid.view(I32), grids[0].view(I32))


@pytest.mark.parametrize("space", ["global", "shared"])
def test_sums_of_floats_do_not_depend_on_the_chunk_width(space, rng):
    """Adds between loads, under two masks, in loops, and with used results: one order, whatever the lanes at a time."""
    x = rng.normal(size=(200, 4)).astype(np.float32)
    place = rng.integers(0, 12, 200).astype(I32)
    body = f"""(const float4* x, const int* place, float* out, float* seen) {{
        __shared__ float s[64]; int t = threadIdx.x; float* g = {"s" if space == "shared" else "out"};
        volatile float* v = g;
        if ({int(space == "shared")} && t < 64) s[t] = 0;
        __syncthreads();
        float4 p = x[t]; int b = 4 * place[t];
        atomicAdd(g + b, p.x); atomicAdd(g + b + 1, p.y);
        float sum = v[b] * 0;
        atomicAdd(g + b, p.y + sum); atomicAdd(g + b + 1, p.z);
        if (p.z > 0) atomicAdd(g + b + 2, p.z); if (p.w > 0) atomicAdd(g + b + 2, p.w);
        atomicAdd(g + b + 1, p.w + sum); atomicAdd(g + b + 2, p.x);
        atomicAdd(g + b + 3, p.y); atomicAdd(g + b + 4, p.z);
        #pragma unroll 1
        for (int k = 0; k < (t & 3); ++k) {{ atomicAdd(g + b + k, p.x * k); atomicAdd(g + b + k + 5, p.y); }}
        seen[t] = atomicAdd(g + 50, p.x);
        __syncthreads();
        if ({int(space == "shared")} && t < 64) out[t] = s[t]; }}"""
    results = []
    for width, mode in ((8, "run"), (16, "run"), (32, "run"), (16, "count")):
        out, seen = np.zeros(64, np.float32), np.zeros(200, np.float32)
        run(body, 1, 200, x, place, out, seen, lane_width=width, mode=mode)
        results.append(np.concatenate([out, seen]).view(I32))
    for other in results[1:]:
        np.testing.assert_array_equal(other, results[0])


def test_float_sums_in_global_memory_flush_denormals():
    tiny = np.array([1e-40, 0, 3e-39, 1e-38, -1.2e-38, 1, 1, 1], np.float32)
    for options in (OPTIONS, ("-lineinfo",)):
        out = tiny.copy()
        text = """extern "C" __global__ void kernel(float* o) { atomicAdd(o + threadIdx.x, -1e-38f);
            if (threadIdx.x > 5) atomicAdd(o + threadIdx.x, 1e-37f); }"""
        engine.compile_ptx(nvrtc.compile_cuda(text, "sm_70", options)).kernel("kernel").launch((1,), (8,), (out,))
        np.testing.assert_array_equal(out[:5], np.array([0, 0, 0, 0, -1.2e-38], np.float32))
