// Exclusive scan of integers in segments. A thread adds SCAN_ITEMS values of its own in registers, a warp scans the
// sums of its lanes by shuffles, and the first warp scans the sums of all warps: no shared-memory bank conflicts.
#pragma once

constexpr int SCAN_THREADS = 256;
constexpr int SCAN_ITEMS = 4;
constexpr int SCAN_SEGMENT = SCAN_THREADS * SCAN_ITEMS;
constexpr int SCAN_WARPS = SCAN_THREADS / 32;
constexpr unsigned ALL_LANES = 0xffffffffu;

// Sum of value over this lane and those below it.
__device__ inline int warp_inclusive_scan(int value, int lane) {
#pragma unroll
    for (int reach = 1; reach < 32; reach *= 2) {
        const int below = __shfl_up_sync(ALL_LANES, value, reach);
        if (lane >= reach) value += below;
    }
    return value;
}
