"""Profile mode: caches, DRAM and latencies against patterns that can be worked out by hand."""

from __future__ import annotations

import random
from collections import OrderedDict
from dataclasses import replace

import numpy as np
import pytest
from engine_programs import run

from mpmbench.errors import InputError
from mpmbench.simt import caches
from mpmbench.simt.counters import SourceLine
from mpmbench.simt.machine import Machine, MemoryCounters, MemoryTally

F32, I32 = np.float32, np.int32

# One SM, one thread block at a time, an L2 of 16 lines, latencies that cannot be mistaken for each other.
SMALL = Machine(
    sms=1, blocks_per_sm=1, l1_bytes=2048, l1_per_sm=1, l1_holds_plain_loads=False, l2_bytes=2048, dram_channels=1,
    dram_banks=1, dram_row_bytes=1024, alu_latency=10, shared_latency=100, l1_latency=1_000, l2_latency=10_000,
    dram_latency=100_000, barrier_latency=20,
)  # fmt: skip
# Caches that hold everything the tests touch.
LARGE = replace(SMALL, l1_bytes=1 << 17, l2_bytes=1 << 20)


def aligned(count: int, dtype: type) -> np.ndarray:
    raw = np.zeros(np.dtype(dtype).itemsize * count + 4096, np.uint8)
    start = -raw.ctypes.data % 4096
    return raw[start : start + np.dtype(dtype).itemsize * count].view(dtype)


def profile(body: str, grid: int, block: int, *args, machine: Machine = LARGE, arch: str = "sm_52") -> MemoryCounters:
    result = run(body, grid, block, *args, mode="profile", arch=arch, machine=machine)
    assert result.findings == ()
    assert result.memory is not None
    assert sum(result.memory.lines.values(), MemoryTally()) == result.memory.total
    return result.memory


def test_a_copy_reads_and_writes_every_sector_once():
    x, y = aligned(4 * 256, F32), aligned(4 * 256, F32)
    x[:] = np.arange(len(x))
    body = "(const float4* x, float4* y) { int i = blockIdx.x * 64 + threadIdx.x; y[i] = x[i]; }"
    total = profile(body, 4, 64, x, y).total
    sectors = x.nbytes // 32
    np.testing.assert_array_equal(x, y)
    assert (total.l1_miss, total.dram_read, total.dram_write) == (sectors, sectors, sectors)
    assert (total.l2_hit, total.l2_miss) == (sectors, sectors), "a store that fills its sector hits"
    assert total.l1_request_bytes == x.nbytes


def test_a_store_that_does_not_fill_its_sector_fetches_nothing():
    y = aligned(8 * 32, F32)
    total = profile("(float* y) { y[8 * threadIdx.x] = 1.f; y[8 * threadIdx.x + 1] = 2.f; }", 1, 32, y).total
    assert (total.dram_read, total.dram_write) == (0, 32)
    assert (total.l2_miss, total.l2_hit) == (32, 32), "the second part finds the first"


def test_a_load_after_a_partial_store_fetches_the_rest():
    y, z = aligned(8 * 32, F32), aligned(32, F32)
    body = """(volatile float* y, float* z) {
        y[8 * threadIdx.x] = 1.f; __syncthreads(); z[threadIdx.x] = y[8 * threadIdx.x + 1]; }"""
    assert profile(body, 1, 32, y, z).total.dram_read == 32


def test_only_the_read_only_path_goes_through_l1_where_plain_loads_do_not():
    x, y = aligned(32, F32), aligned(64, F32)
    twice = "{ float a = x[threadIdx.x]; __syncthreads(); y[threadIdx.x] = a + x[threadIdx.x ^ 1]; }"
    plain, cached = (
        f"(const float* x, float* y) {twice}",
        f"(const float* __restrict__ x, float* __restrict__ y) {twice}",
    )
    holds = replace(LARGE, l1_holds_plain_loads=True)
    assert profile(plain, 1, 32, x, y).total.l1_hit == 0
    assert profile(cached, 1, 32, x, y).total.l1_hit == 4
    assert profile(plain, 1, 32, x, y, machine=holds).total.l1_hit == 4


def test_the_least_recently_used_line_goes_first():
    """17 lines in a cache of 16, in turn: every access misses; 16 lines: only the first round does."""
    x, y = aligned(32 * 17, F32), aligned(1, F32)
    body = """(volatile const float* x, float* y, int lines) {
        float sum = 0.f; for (int k = 0; k < 3 * lines; ++k) sum += x[32 * (k % lines)]; y[0] = sum; }"""
    for lines, missed in ((16, 16), (17, 3 * 17)):
        tally = profile(body, 1, 1, x, y, I32(lines), machine=SMALL).total
        assert tally.l1_miss == 3 * lines
        assert tally.dram_read == missed


def test_the_cache_against_a_dictionary():
    """Random sectors, some of them close together, in a cache of 8 sets."""
    sets = 8
    tags = np.full(sets * caches.WAYS, -1, np.int32)
    order, bits = np.full(sets, caches.IN_ORDER, np.uint64), np.zeros(sets * caches.WAYS, np.uint8)
    model: list[OrderedDict[int, int]] = [OrderedDict() for _ in range(sets)]
    chance = random.Random(1)
    hits = 0
    for _ in range(20_000):
        sector = chance.randrange(4 * 2 * sets * caches.WAYS)
        tag, bit = sector >> 2, 1 << (sector & 3)
        lines = model[int(caches.pick(tag, sets))]
        expected = bool(lines.get(tag, 0) & bit)
        if tag not in lines and len(lines) == caches.WAYS:
            lines.popitem(last=False)
        lines[tag] = lines.pop(tag, 0) | bit
        assert caches.l1_access(tags, order, bits, sets, 0, sector) == expected
        hits += expected
    assert 1_000 < hits < 19_000


def test_atomics_fetch_and_write_back_their_sector():
    y = aligned(64, F32)
    memory = profile("(float* y) { atomicAdd(&y[threadIdx.x & 1], 1.f); }", 4, 32, y)
    assert y[0] == y[1] == 64
    assert (memory.total.atomic_lanes, memory.total.atomic_sectors) == (128, 4)
    assert (memory.total.dram_read, memory.total.dram_write) == (1, 1)
    assert memory.hot_address == 64


def test_a_run_of_atomics_on_neighbouring_words_is_as_many_requests():
    y = aligned(4 * 32, F32)
    body = "(float* y) { for (int k = 0; k < 4; ++k) atomicAdd(&y[4 * threadIdx.x + k], 1.f); }"
    memory = profile(body, 1, 32, y)
    assert (y == 1).all()
    assert (memory.total.atomic_lanes, memory.total.atomic_sectors) == (128, 4 * 16)
    assert memory.total.l2_sectors == 64
    assert memory.total.l2_miss == 16
    assert memory.hot_address == 1


def test_turns_between_warps_reach_the_cache():
    """Two warps whose four atomics per lane touch 16 lines each: alone they stay in an L2 of 16 lines, taking turns
    they throw each other out."""
    y = aligned(2 * 32 * 32, F32)
    body = """(float* y) {
        float* mine = y + 32 * (blockIdx.x * 16 + (threadIdx.x & 15));
        for (int k = 0; k < 4; ++k) atomicAdd(mine + k, 1.f); }"""
    alone = profile(body, 2, 32, y, machine=SMALL).total
    together = profile(body, 2, 32, y, machine=replace(SMALL, blocks_per_sm=2)).total
    assert alone.dram_read == 2 * 16
    assert together.dram_read > 3 * alone.dram_read / 2


def test_row_activations():
    """A row of one bank holds 1,024 bytes: a walk opens each row once, steps of a row open one every time."""
    x, y = aligned(16 * 256, F32), aligned(1, F32)
    body = """(volatile const float* x, float* y, int step) {
        float sum = 0.f; for (int k = 0; k < 16; ++k) sum += x[(k * step) & 4095]; y[0] = sum; }"""
    walk, jumps = (
        profile(body, 1, 1, x, y, I32(step)).lines[SourceLine("test.cu", 2)].dram_activations for step in (8, 256)
    )
    # Arrays start half a row into the modelled memory, so that the walk stays in one; the result's write opens another.
    assert walk == 1 + 1
    assert jumps == 16 + 1


# --- latencies --------------------------------------------------------------------------------------------------------


def latency(body: str, *args, machine: Machine = LARGE, grid: int = 1, block: int = 32) -> int:
    return profile(body, grid, block, *args, machine=machine).latency_cycles


def slope(body: str, few: int, many: int, *args, **options) -> float:
    """Cycles per turn of a kernel's loop; its last argument is the number of turns."""
    first, last = (latency(body, *args, I32(turns), **options) for turns in (few, many))
    return (last - first) / (many - few)


def test_dependent_arithmetic_takes_its_latency():
    y = aligned(32, F32)
    body = """(float* y, float a, int n) {
        float x = a;
        #pragma unroll 1
        for (int k = 0; k < n; ++k) { x = x * a + a; x = x * a + a; x = x * a + a; x = x * a + a; x = x * a + a;
                                      x = x * a + a; x = x * a + a; x = x * a + a; }
        y[threadIdx.x] = x; }"""
    # The loop's own end adds a compare and a branch.
    assert 8 * 10 <= slope(body, 10, 20, y, F32(0.5)) <= 8 * 10 + 25


@pytest.mark.parametrize(("path", "expected"), [("__restrict__ ", 1_000), ("", 10_000)])
def test_a_chain_of_loads_takes_the_latency_of_where_they_hit(path, expected):
    """All on one sector, which stays where the path may hold it."""
    x, y = aligned(8, I32), aligned(1, I32)
    x[:] = np.roll(np.arange(8), -1)
    body = f"""(const int* {path}x, int* {path}y, int n) {{
        int at = 0;
        #pragma unroll 1
        for (int k = 0; k < n; ++k) at = x[at];
        y[0] = at; }}"""
    turn = slope(body, 8, 24, x, y, block=1)
    assert expected <= turn <= expected + 60


def test_a_first_touch_waits_for_dram():
    x, y = aligned(32, F32), aligned(32, F32)
    cycles = latency("(const float* x, float* y) { y[threadIdx.x] = x[threadIdx.x] + 1.f; }", x, y)
    assert 100_000 <= cycles <= 100_100


def test_loads_that_do_not_depend_on_each_other_overlap():
    x, y = aligned(32 * 64, F32), aligned(32, F32)
    body = """(const float* x, float* y) {
        float a = x[threadIdx.x], b = x[threadIdx.x + 512], c = x[threadIdx.x + 1024];
        y[threadIdx.x] = a + b + c; }"""
    assert 100_000 <= latency(body, x, y) <= 100_200


def test_a_barrier_waits_for_the_slowest_warp():
    """One warp of four works 400 instructions longer between two barriers; the others wait for it."""
    y = aligned(128, F32)
    body = """(float* y, float a) {
        __syncthreads();
        float x = a;
        if (threadIdx.x < 32) {
            #pragma unroll
            for (int k = 0; k < 400; ++k) x = x * a + a;
        }
        __syncthreads();
        y[threadIdx.x] = x; }"""
    memory = profile(body, 1, 128, y, F32(0.5))
    assert 3 * 3_900 <= memory.barrier_wait_cycles <= 3 * 4_200
    assert 4_000 <= memory.latency_cycles <= 4_300


def test_bank_conflicts_keep_the_warp():
    y = aligned(32, F32)
    body = """(float* y, int stride, int n) {
        __shared__ float s[1024];
        for (int k = threadIdx.x; k < 1024; k += 32) s[k] = k;
        __syncthreads();
        float sum = 0.f;
        volatile float* v = s;
        #pragma unroll 1
        for (int k = 0; k < n; ++k) sum += v[(threadIdx.x * stride) & 1023];
        y[threadIdx.x] = sum; }"""
    free, conflicts = (slope(body, 10, 30, y, I32(stride)) for stride in (1, 32))
    assert 100 <= free <= 160
    assert conflicts - free == 31


def test_float_atomics_in_shared_memory_are_loops():
    y = aligned(32, F32)
    body = """(float* y, int same, int n) {
        __shared__ float s[32];
        s[threadIdx.x] = 0.f;
        __syncthreads();
        #pragma unroll 1
        for (int k = 0; k < n; ++k) atomicAdd(&s[same ? 0 : threadIdx.x], 1.f);
        __syncthreads();
        y[threadIdx.x] = s[threadIdx.x]; }"""
    apart, together = (slope(body, 4, 12, y, I32(same)) for same in (0, 1))
    trip = 3 * 100 + 10
    assert trip <= apart <= trip + 60
    assert together - apart == 31 * trip


def test_work_of_a_block_between_barriers_takes_its_pipes():
    """32 warps without latencies to speak of: what is left is the issue slots that they share."""
    y = aligned(1024, F32)
    body = """(float* y, float a) { float x = a, z = a + 1.f; __syncthreads();
        #pragma unroll
        for (int k = 0; k < 200; ++k) { x = x * a + a; z = z * a + a; }
        y[threadIdx.x] = x + z; }"""
    quick = replace(LARGE, alu_latency=1, issue_cycles=lambda instruction: 0.5)
    cycles = latency(body, y, F32(0.5), machine=quick, block=1024)
    assert 32 * 400 / 2 <= cycles <= 1.1 * 32 * 400 / 2


def test_a_second_wave_starts_when_the_first_ends():
    x, y = aligned(32 * 8, F32), aligned(32 * 8, F32)
    body = "(const float* x, float* y) { int i = 32 * blockIdx.x + threadIdx.x; y[i] = x[i] + 1.f; }"
    one = latency(body, x, y, grid=2, machine=replace(LARGE, blocks_per_sm=2))
    two = latency(body, x, y, grid=4, machine=replace(LARGE, blocks_per_sm=2))
    late = latency(body, x, y, grid=4, machine=replace(LARGE, blocks_per_sm=2, block_start=7_777))
    assert one < 100_200
    assert two == 2 * one
    assert late == two + 7_777


# --- the schedule -----------------------------------------------------------------------------------------------------


def test_results_and_counters_are_those_of_count_mode():
    text = """(const float* x, float* y, int n) {
        __shared__ float s[128];
        int i = blockIdx.x * 128 + threadIdx.x;
        s[threadIdx.x] = i < n ? x[i] : 0.f;
        __syncthreads();
        for (int step = 64; step; step >>= 1) {
            if (threadIdx.x < step) s[threadIdx.x] += s[threadIdx.x + step];
            __syncthreads();
        }
        if (threadIdx.x == 0) y[blockIdx.x] = s[0];
        if (threadIdx.x % 3 == 1 && i < n) atomicAdd(&y[gridDim.x + i % 5], x[i]);
    }"""
    x = aligned(1000, F32)
    x[:] = np.arange(1000) % 7
    y, z = aligned(13, F32), aligned(13, F32)
    counted = run(text, 8, 128, x, y, I32(1000), mode="count", arch="sm_52")
    profiled = run(text, 8, 128, x, z, I32(1000), mode="profile", arch="sm_52", machine=replace(LARGE, blocks_per_sm=3))
    np.testing.assert_array_equal(y, z)
    assert profiled.counters == counted.counters
    assert profiled.opcodes == counted.opcodes


def test_a_block_that_waits_for_an_earlier_one_sees_it_move_on():
    """Each block spins on its predecessor's flag: loops yield, so that the predecessor gets its turn."""
    flags = aligned(8, I32)
    body = """(volatile int* flags) {
        if (threadIdx.x == 0) {
            if (blockIdx.x) while (flags[blockIdx.x - 1] == 0) {}
            flags[blockIdx.x] = flags[blockIdx.x ? blockIdx.x - 1 : 0] + 1;
        } }"""
    profile(body, 8, 32, flags, machine=replace(LARGE, sms=2, blocks_per_sm=4))
    np.testing.assert_array_equal(flags, np.arange(1, 9))


def test_addresses_of_the_host_do_not_matter():
    body = "(const float* x, float* y) { atomicAdd(&y[(threadIdx.x * 37) & 1023], x[(threadIdx.x * 91) & 1023]); }"
    seen = []
    for shift in (0, 5, 77):
        keep = [aligned(1024 + 64 * shift, F32) for _ in range(2)]
        x, y = (array[64 * shift :] for array in keep)
        seen.append(profile(body, 4, 256, x, y, machine=replace(SMALL, blocks_per_sm=2)))
    assert seen[0] == seen[1] == seen[2]


def test_a_fault_stops_the_launch():
    body = "(float* y) { if (threadIdx.x < 16) __syncthreads(); y[threadIdx.x] = 1.f; }"
    result = run(body, 3, 32, aligned(32, F32), mode="profile", machine=LARGE, arch="sm_70")
    assert [finding.kind for finding in result.findings] == ["divergent-barrier"]


def test_a_runaway_loop_spends_its_budget():
    body = "(volatile int* y) { while (y[0] == 0) {} }"
    result = run(body, 1, 32, aligned(1, I32), mode="profile", machine=LARGE, budget=10_000)
    assert [finding.kind for finding in result.findings] == ["runaway"]


def test_no_blocks_and_no_machine():
    y = aligned(1, F32)
    assert profile("(float* y) { y[0] = 1.f; }", 0, 32, y).total == MemoryTally()
    with pytest.raises(InputError, match="needs a machine"):
        run("(float* y) { y[0] = 1.f; }", 1, 32, y, mode="profile")
