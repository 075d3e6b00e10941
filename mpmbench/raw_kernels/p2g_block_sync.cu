// Idea: all cells of a block visit the same offset of their supports at the same time, so their nodes differ and plain
// adds to shared memory are enough; a barrier after every node step keeps them together (Algorithm 6).
// A thread block owns one block and its arena; a thread owns one cell and spreads its particles, BATCH at a time, summed
// in registers per node step, so that barriers divide by BATCH. Every thread runs the particle loop to the largest bin
// of the block, because a barrier must be reached by all of them.
// Constants: BATCH and those of the headers. Shared memory: one real4 per node of the arena.
#include "arena_sum.cuh"

extern "C" __global__ void __launch_bounds__(THREADS, 1) p2g_block_sync(
    const Domain domain,
    const int particle_count,
    const real4* __restrict__ particles,
    const int* __restrict__ order,
    const int* __restrict__ bin_start,
    const int* __restrict__ block_maximum,
    const int* __restrict__ active_blocks,
    real4* __restrict__ nodes) {
    __shared__ real4 arena[ARENA];

    const Block block = own_block(domain, active_blocks);
    clear_arena(arena);
    __syncthreads();

    const Cell own = own_cell();
    const int home = arena_index(own.x, own.y, own.z);
    const Bin bin = bin_of(domain, bin_start, block.first.x + own.x, block.first.y + own.y, block.first.z + own.z);
    const int largest = block_maximum[block.index];

    for (int first = 0; first < largest; first += BATCH) {
        Batch batch;
        batch.load(domain, particles, particle_count, order, bin, first);
        const bool occupied = first < bin.count;
#pragma unroll NODE_UNROLL
        for (int n = 0; n < SUPPORT; ++n) {
            const Offset o = support_offset(n);
            real4* node = arena + home + arena_index(o.x, o.y, o.z);
            if (occupied) *node = *node + batch.sum(o);
            __syncthreads();
        }
    }
    flush_arena(domain, block, arena, nodes);
}
