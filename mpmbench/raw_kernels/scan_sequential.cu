// Idea: raking. Each thread first scans LOADS neighbouring values on its own and hands only their sum to the tree in
// shared memory, then spreads what the tree says over its values.
// A thread block owns GROUP * LOADS values; a thread owns LOADS neighbouring ones and one leaf of the tree.
// Constants: LOADS, UNROLL (LOADS to unroll the loops over them, 1 to keep them rolled: the values then lie in local
// memory), and those of scan_tree.cuh and scan.cuh. Shared memory: one integer per thread, and the padding.
#include "scan_tree.cuh"

extern "C" __global__ void __launch_bounds__(GROUP) scan_sequential(
    const int count, const int* __restrict__ values, int* __restrict__ scanned, int* __restrict__ segment_sums) {
    __shared__ int tile[padded(GROUP - 1) + 1];

    const int t = threadIdx.x;
    const int first = (blockIdx.x * GROUP + t) * LOADS;
    int before[LOADS];
    int sum = 0;
#pragma unroll UNROLL
    for (int j = 0; j < LOADS; ++j) {
        before[j] = sum;
        sum += value_at(values, count, first + j);
    }
    tile[padded(t)] = sum;
    const int total = tree_scan<GROUP>(tile);
    if (t == 0) segment_sums[blockIdx.x] = total;
    const int before_thread = tile[padded(t)];
#pragma unroll UNROLL
    for (int j = 0; j < LOADS; ++j) {
        if (first + j < count) scanned[first + j] = before_thread + before[j];
    }
}
