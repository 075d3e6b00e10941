// Momentum to velocity: divides by mass; empty nodes get zero velocity. A thread owns one node.
#include "real.cuh"

extern "C" __global__ void grid_divide(
    const int node_count, const real4* __restrict__ nodes, real4* __restrict__ velocities) {
    const int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i >= node_count) return;
    const real4 node = nodes[i];
    real4 velocity = {0, 0, 0, node.w};
    if (node.w > real(0)) velocity = {node.x / node.w, node.y / node.w, node.z / node.w, node.w};
    velocities[i] = velocity;
}
