// Idea: raking with register exchange: a thread adds four neighbouring values, a warp scans the sums of its lanes by
// shuffles, the first warp scans the sums of all warps. No bank is ever shared, and two barriers are enough.
// A thread block owns 4 * GROUP values; a thread owns four neighbouring ones.
// Constants: those of scan.cuh. Shared memory: one integer per warp.
#include "scan.cuh"

extern "C" __global__ void __launch_bounds__(GROUP) scan_shuffle(
    const int count, const int* __restrict__ values, int* __restrict__ scanned, int* __restrict__ segment_sums) {
    constexpr int WARPS = GROUP / WARP;
    __shared__ int warp_sums[WARPS];

    const int lane = threadIdx.x % WARP;
    const int warp = threadIdx.x / WARP;
    const int first = 4 * (blockIdx.x * GROUP + threadIdx.x);
    const int4 four = four_at(values, count, first);
    const int up_to_here = warp_inclusive_scan<Add>(sum_of(four), lane);
    if (lane == WARP - 1) warp_sums[warp] = up_to_here;
    __syncthreads();
    if (warp == 0) {
        const int total = scan_warp_sums<WARPS>(warp_sums, lane);
        if (lane == 0) segment_sums[blockIdx.x] = total;
    }
    __syncthreads();
    store_scanned(scanned, count, first, four, warp_sums[warp] + up_to_here - sum_of(four));
}
