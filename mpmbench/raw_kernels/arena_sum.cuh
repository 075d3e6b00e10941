// An arena of node sums in shared memory: cleared, filled by a strategy, then added to the grid. Used by the pushes.
#pragma once
#include "block.cuh"
#include "transfer.cuh"

__device__ inline void clear_arena(real4* arena) {
    for (int place = threadIdx.x; place < ARENA; place += THREADS) arena[place] = {0, 0, 0, 0};
}

// No other block's cells reach this coordinate of the arena.
__device__ inline bool owned_alone(int place, int block_edge) { return place >= LEFT + RIGHT && place < block_edge; }

// Adds the arena to the grid: atomically where a neighbour may add too, by a plain store elsewhere (the grid starts at
// zero), and not at all where nothing arrived. Call after a barrier.
__device__ inline void flush_arena(const Domain& domain, const Block& block, const real4* arena, real4* nodes) {
    for (int index = threadIdx.x; index < ARENA; index += THREADS) {
        const Cell place = arena_place(index);
        const int x = block.first.x - LEFT + place.x;
        const int y = block.first.y - LEFT + place.y;
        const int z = block.first.z - LEFT + place.z;
        const real4 sum = arena[index];
        if (sum.w == real(0) || !in_grid(domain, x, y, z)) continue;
        real4* node = nodes + node_index(domain, x, y, z);
        if (owned_alone(place.x, BLOCK_X) && owned_alone(place.y, BLOCK_Y) && owned_alone(place.z, BLOCK_Z)) {
            *node = sum;
        } else {
            atomic_add(node, sum);
        }
    }
}

// Up to BATCH particles of one bin, in registers.
struct Batch {
    Source source[BATCH];
    Weights weights[BATCH];

    // Loads particles first .. first + BATCH - 1 of the bin, as far as it has them.
    __device__ void load(const Domain& domain, const real4* particles, int particle_count, const int* order,
                         const Bin& bin, int first) {
#pragma unroll
        for (int j = 0; j < BATCH; ++j) {
            source[j] = no_source();
            if (first + j < bin.count) {
                const int p = stored_at(order, bin.start + first + j);
                Cell ignored;
                source[j] = load_particle(domain, particles, particle_count, p, ignored);
            }
            weights[j].set(source[j].f);
        }
    }

    // What the node at this offset receives from the whole batch.
    __device__ real4 sum(const Offset& o) const {
        real4 sum = contribution(source[0], weights[0].scaled(source[0].mass, o), o);
#pragma unroll
        for (int j = 1; j < BATCH; ++j) {
            sum = sum + contribution(source[j], weights[j].scaled(source[j].mass, o), o);
        }
        return sum;
    }
};
