// Zeroes every node. A thread owns one.
#include "real.cuh"

extern "C" __global__ void grid_clear(const int node_count, real4* __restrict__ nodes) {
    const int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i < node_count) nodes[i] = {0, 0, 0, 0};
}
