// Idea: particles are independent, so each scatters on its own and the atomics sort out the collisions.
// A thread owns one particle and adds to every node of its support, four atomic sums per node.
// Constants: those of the headers.
#include "transfer.cuh"

extern "C" __global__ void p2g_global_atomic(
    const Domain domain,
    const int particle_count,
    const real4* __restrict__ particles,
    const int* __restrict__ order,
    real4* __restrict__ nodes) {
    const int s = blockIdx.x * blockDim.x + threadIdx.x;
    if (s >= particle_count) return;

    Cell bin;
    const Source source = load_particle(domain, particles, particle_count, stored_at(order, s), bin);
    Weights weights;
    weights.set(source.f);
    real4* lowest = nodes + node_index(domain, bin.x - LEFT, bin.y - LEFT, bin.z - LEFT);

#pragma unroll NODE_UNROLL
    for (int n = 0; n < SUPPORT; ++n) {
        const Offset o = support_offset(n);
        const real4 value = contribution(source, weights.scaled(source.mass, o), o);
        atomic_add(node_at(domain, lowest, o), value);
    }
}
