// Exclusive scan within segments of SCAN_SEGMENT values, and the sum of each segment for the level above.
// A thread block owns one segment. Any length: values past the end count as zero.
// Constants: SCAN_FLAGS, 1 to scan (value > 0) instead of the value, for stream compaction.
#include "scan.cuh"

extern "C" __global__ void __launch_bounds__(SCAN_THREADS) scan_segments(
    const int count, const int* __restrict__ values, int* __restrict__ scanned, int* __restrict__ segment_sums) {
    __shared__ int warp_sums[SCAN_WARPS];
    const int lane = threadIdx.x % 32;
    const int warp = threadIdx.x / 32;
    const int first = blockIdx.x * SCAN_SEGMENT + threadIdx.x * SCAN_ITEMS;

    int item[SCAN_ITEMS];
    int sum = 0;
#pragma unroll
    for (int i = 0; i < SCAN_ITEMS; ++i) {
        int value = first + i < count ? values[first + i] : 0;
        if (SCAN_FLAGS) value = value > 0;
        item[i] = sum;
        sum += value;
    }

    const int up_to_here = warp_inclusive_scan(sum, lane);
    if (lane == 31) warp_sums[warp] = up_to_here;
    __syncthreads();
    if (warp == 0) {
        const int total = lane < SCAN_WARPS ? warp_sums[lane] : 0;
        const int up_to_warp = warp_inclusive_scan(total, lane);
        if (lane < SCAN_WARPS) warp_sums[lane] = up_to_warp - total;
        if (lane == SCAN_WARPS - 1) segment_sums[blockIdx.x] = up_to_warp;
    }
    __syncthreads();

    const int before = warp_sums[warp] + up_to_here - sum;
#pragma unroll
    for (int i = 0; i < SCAN_ITEMS; ++i) {
        if (first + i < count) scanned[first + i] = before + item[i];
    }
}
