// Idea: a balanced tree in shared memory, two leaves per thread. Its addresses are 2, 4, 8, ... places apart, so without
// padding the lanes of a warp share banks.
// A thread block owns 2 * GROUP values; a thread owns two of them, GROUP apart, and one pair per step of the tree.
// Constants: those of scan_tree.cuh and scan.cuh. Shared memory: one integer per value, and the padding.
#include "scan_tree.cuh"

extern "C" __global__ void __launch_bounds__(GROUP) scan_interleaved(
    const int count, const int* __restrict__ values, int* __restrict__ scanned, int* __restrict__ segment_sums) {
    constexpr int LEAVES = 2 * GROUP;
    __shared__ int tile[padded(LEAVES - 1) + 1];

    const int t = threadIdx.x;
    const int first = blockIdx.x * LEAVES;
    tile[padded(t)] = value_at(values, count, first + t);
    tile[padded(t + GROUP)] = value_at(values, count, first + t + GROUP);
    const int total = tree_scan<LEAVES>(tile);
    if (t == 0) segment_sums[blockIdx.x] = total;
    if (first + t < count) scanned[first + t] = tile[padded(t)];
    if (first + t + GROUP < count) scanned[first + t + GROUP] = tile[padded(t + GROUP)];
}
