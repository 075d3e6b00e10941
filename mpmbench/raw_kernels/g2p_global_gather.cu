// Idea: particles are independent and nodes are only read, so each gathers on its own through the caches.
// A thread owns BATCH particles, a thread-block width apart so that neighbouring lanes stay on neighbouring particles.
// Constants: BATCH and those of the headers.
#include "transfer.cuh"

extern "C" __global__ void g2p_global_gather(
    const Domain domain,
    const int particle_count,
    const real4* __restrict__ particles,
    const int* __restrict__ order,
    const real4* __restrict__ velocities,
    real4* __restrict__ results) {
    const int start = blockIdx.x * (blockDim.x * BATCH) + threadIdx.x;
    if (start >= particle_count) return;

    real3 f[BATCH];
    Weights weights[BATCH];
    const real4* lowest[BATCH];
    Gathered sum[BATCH];
    int p[BATCH];
#pragma unroll
    for (int j = 0; j < BATCH; ++j) {
        // Past the end the first particle is gathered again and not stored: no branch inside the node loop.
        const int s = start + j * blockDim.x;
        p[j] = stored_at(order, s < particle_count ? s : start);
        const Cell bin = split_position(domain, load_attribute(particles, particle_count, p[j], 0), f[j]);
        lowest[j] = velocities + node_index(domain, bin.x - LEFT, bin.y - LEFT, bin.z - LEFT);
        weights[j].set(f[j]);
        sum[j] = nothing_gathered();
    }

#pragma unroll NODE_UNROLL
    for (int n = 0; n < SUPPORT; ++n) {
        const Offset o = support_offset(n);
#pragma unroll
        for (int j = 0; j < BATCH; ++j) {
            gather(sum[j], weights[j], f[j], o, load(node_at(domain, lowest[j], o)));
        }
    }

#pragma unroll
    for (int j = 0; j < BATCH; ++j) {
        if (start + j * blockDim.x < particle_count) store_gathered(domain, sum[j], results, particle_count, p[j]);
    }
}
