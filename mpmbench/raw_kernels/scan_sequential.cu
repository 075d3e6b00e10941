// Idea: raking. A leaf of the tree in shared memory is the sum of LOADS neighbouring values, which one thread scans on its
// own; then it spreads what the tree says over them. The tree is that of scan_interleaved: two leaves per thread.
// A thread block owns 2 * GROUP * LOADS values; a thread owns LOADS neighbouring ones at each of two leaves, GROUP apart.
// Constants: LOADS, UNROLL (LOADS to unroll the loops over them, 1 to keep them rolled: the values then lie in local
// memory), and those of scan_tree.cuh and scan.cuh. Shared memory: one integer per leaf, and the padding.
#include "scan_tree.cuh"

extern "C" __global__ void __launch_bounds__(GROUP) scan_sequential(
    const int count, const int* __restrict__ values, int* __restrict__ scanned, int* __restrict__ segment_sums) {
    constexpr int LEAVES = 2 * GROUP;
    __shared__ int tile[padded(LEAVES - 1) + 1];

    const int t = threadIdx.x;
    int before[2][LOADS];
#pragma unroll
    for (int half = 0; half < 2; ++half) {
        const int leaf = t + half * GROUP;
        const int first = (blockIdx.x * LEAVES + leaf) * LOADS;
        int sum = 0;
#pragma unroll UNROLL
        for (int j = 0; j < LOADS; ++j) {
            before[half][j] = sum;
            sum += value_at(values, count, first + j);
        }
        tile[padded(leaf)] = sum;
    }
    const int total = tree_scan<LEAVES>(tile);
    if (t == 0) segment_sums[blockIdx.x] = total;
#pragma unroll
    for (int half = 0; half < 2; ++half) {
        const int leaf = t + half * GROUP;
        const int first = (blockIdx.x * LEAVES + leaf) * LOADS;
        const int before_leaf = tile[padded(leaf)];
#pragma unroll UNROLL
        for (int j = 0; j < LOADS; ++j) {
            if (first + j < count) scanned[first + j] = before_leaf + before[half][j];
        }
    }
}
