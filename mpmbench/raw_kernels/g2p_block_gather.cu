// Idea: load the nodes of a block and its halo into shared memory once, then gather from there (Algorithm 5).
// A thread block owns one block and its arena; a thread owns one cell and gathers its particles, BATCH at a time, so
// that one visit of a node serves BATCH particles.
// Constants: BATCH and those of the headers. Shared memory: one real4 per node of the arena.
#include "block.cuh"
#include "transfer.cuh"

extern "C" __global__ void __launch_bounds__(THREADS, 1) g2p_block_gather(
    const Domain domain,
    const int particle_count,
    const real4* __restrict__ particles,
    const int* __restrict__ order,
    const int* __restrict__ bin_start,
    const int* __restrict__ active_blocks,
    const real4* __restrict__ velocities,
    real4* __restrict__ results) {
    __shared__ real4 arena[ARENA];

    const Block block = own_block(domain, active_blocks);
    for (int index = threadIdx.x; index < ARENA; index += THREADS) {
        const Cell place = arena_place(index);
        const int x = block.first.x - LEFT + place.x;
        const int y = block.first.y - LEFT + place.y;
        const int z = block.first.z - LEFT + place.z;
        real4 node = {0, 0, 0, 0};
        if (in_grid(domain, x, y, z)) node = load(velocities + node_index(domain, x, y, z));
        arena[index] = node;
    }
    __syncthreads();

    const Cell own = own_cell();
    const int home = arena_index(own.x, own.y, own.z);
    const Bin bin = bin_of(domain, bin_start, block.first.x + own.x, block.first.y + own.y, block.first.z + own.z);

    for (int first = 0; first < bin.count; first += BATCH) {
        forget_loads();
        real3 f[BATCH];
        Weights weights[BATCH];
        Gathered sum[BATCH];
        int p[BATCH];
#pragma unroll
        for (int j = 0; j < BATCH; ++j) {
            // Past the end the first particle of the batch is gathered again and not stored.
            p[j] = stored_at(order, bin.start + (first + j < bin.count ? first + j : first));
            split_position(domain, load_attribute(particles, particle_count, p[j], 0), f[j]);
            weights[j].set(f[j]);
            sum[j] = nothing_gathered();
        }

#pragma unroll NODE_UNROLL
        for (int n = 0; n < SUPPORT; ++n) {
            const Offset o = support_offset(n);
            const real4 node = arena[home + arena_index(o.x, o.y, o.z)];
#pragma unroll
            for (int j = 0; j < BATCH; ++j) gather(sum[j], weights[j], f[j], o, node);
        }

#pragma unroll
        for (int j = 0; j < BATCH; ++j) {
            if (first + j < bin.count) store_gathered(domain, sum[j], results, particle_count, p[j]);
        }
    }
}
