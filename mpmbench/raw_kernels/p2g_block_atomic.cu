// Idea: collect a block's sums in shared memory with shared atomics, and touch the grid once per node of the arena.
// A thread block owns one block and its arena; a thread owns one cell and spreads its particles, BATCH at a time,
// summed in registers per node step, so that shared atomics divide by BATCH.
// Constants: BATCH and those of the headers. Shared memory: one real4 per node of the arena.
#include "arena_sum.cuh"

extern "C" __global__ void __launch_bounds__(THREADS, 1) p2g_block_atomic(
    const Domain domain,
    const int particle_count,
    const real4* __restrict__ particles,
    const int* __restrict__ order,
    const int* __restrict__ bin_start,
    const int* __restrict__ active_blocks,
    real4* __restrict__ nodes) {
    __shared__ real4 arena[ARENA];

    const Block block = own_block(domain, active_blocks);
    clear_arena(arena);
    __syncthreads();

    const Cell own = own_cell();
    const int home = arena_index(own.x, own.y, own.z);
    const Bin bin = bin_of(domain, bin_start, block.first.x + own.x, block.first.y + own.y, block.first.z + own.z);

    for (int first = 0; first < bin.count; first += BATCH) {
        Batch batch;
        batch.load(domain, particles, particle_count, order, bin, first);
#pragma unroll NODE_UNROLL
        for (int n = 0; n < SUPPORT; ++n) {
            const Offset o = support_offset(n);
            atomic_add(arena + home + arena_index(o.x, o.y, o.z), batch.sum(o));
        }
    }
    __syncthreads();
    flush_arena(domain, block, arena, nodes);
}
