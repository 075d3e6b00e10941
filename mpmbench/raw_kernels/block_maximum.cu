// The largest particle count of a bin, per block. A warp owns one block: its lanes stride over the cells, then reduce.
// Constants: HALO, 1 to include the bins that a pull reads around the block.
#include "block.cuh"
#include "operators.cuh"

extern "C" __global__ void block_maximum(
    const Domain domain, const int block_count, const int* __restrict__ bin_start, int* __restrict__ maximum) {
    constexpr int EDGE_X = HALO ? ARENA_X : BLOCK_X;
    constexpr int EDGE_Y = HALO ? ARENA_Y : BLOCK_Y;
    constexpr int EDGE_Z = HALO ? ARENA_Z : BLOCK_Z;
    constexpr int BELOW = HALO ? RIGHT : 0;

    const int lane = threadIdx.x % WARP;
    const int index = (blockIdx.x * blockDim.x + threadIdx.x) / WARP;
    if (index >= block_count) return;  // whole warps leave: blockDim is a multiple of the warp

    const Block block = block_at(domain, index);
    int largest = 0;
    for (int i = lane; i < EDGE_X * EDGE_Y * EDGE_Z; i += WARP) {
        const int x = block.first.x - BELOW + i % EDGE_X;
        const int y = block.first.y - BELOW + i / EDGE_X % EDGE_Y;
        const int z = block.first.z - BELOW + i / (EDGE_X * EDGE_Y);
        largest = max(largest, bin_of(domain, bin_start, x, y, z).count);
    }
#pragma unroll
    for (int reach = WARP / 2; reach > 0; reach /= 2) {
        largest = max(largest, __shfl_xor_sync(0xffffffffu, largest, reach));
    }
    if (lane == 0) maximum[index] = largest;
}
