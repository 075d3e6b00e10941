// Exclusive scan of integers: what every strategy shares. Values past the end count as zero.
//
// Constants: FLAGS (1 to scan value > 0 instead of the value, for stream compaction), GROUP (threads of a thread block).
#pragma once
#include "operators.cuh"

__device__ inline int counted(int value) { return FLAGS ? value > 0 : value; }

__device__ inline int value_at(const int* values, int count, int i) { return i < count ? counted(values[i]) : 0; }

// Four neighbouring values in one access where all four exist. `first` is a multiple of four.
__device__ inline int4 four_at(const int* values, int count, int first) {
    if (first + 3 < count) {
        const int4 four = *reinterpret_cast<const int4*>(values + first);
        return {counted(four.x), counted(four.y), counted(four.z), counted(four.w)};
    }
    return {value_at(values, count, first), value_at(values, count, first + 1), value_at(values, count, first + 2),
            value_at(values, count, first + 3)};
}

// Scans the four values from `before` on and writes them.
__device__ inline void store_scanned(int* scanned, int count, int first, const int4& four, int before) {
    const int4 sums = {before, before + four.x, before + four.x + four.y, before + four.x + four.y + four.z};
    if (first + 3 < count) {
        *reinterpret_cast<int4*>(scanned + first) = sums;
        return;
    }
    if (first < count) scanned[first] = sums.x;
    if (first + 1 < count) scanned[first + 1] = sums.y;
    if (first + 2 < count) scanned[first + 2] = sums.z;
}

__device__ inline int sum_of(const int4& four) { return four.x + four.y + four.z + four.w; }

// Turns one sum per warp into the sums before each warp, by one warp. Returns, in every lane, the sum of all.
template <int WARPS>
__device__ inline int scan_warp_sums(int* warp_sums, int lane) {
    const int sum = lane < WARPS ? warp_sums[lane] : 0;
    const int up_to_here = warp_inclusive_scan<Add>(sum, lane);
    if (lane < WARPS) warp_sums[lane] = up_to_here - sum;
    return __shfl_sync(ALL_LANES, up_to_here, WARP - 1);
}
