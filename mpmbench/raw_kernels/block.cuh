// Blocks and arenas: a thread block owns one block of BLOCK_X x BLOCK_Y x BLOCK_Z cells, one thread per cell (x fastest).
//
// Its arena is the tile of places that its cells reach: the block and a halo. For a push (or a G2P) the places are nodes
// and the halo is LEFT low and RIGHT high; for a pull they are bins and the supports are reversed.
//
// Constants: BLOCK_X, BLOCK_Y, BLOCK_Z, ACTIVE_ONLY (thread blocks are numbered through the active list), BATCH.
#pragma once
#include "domain.cuh"

constexpr int THREADS = BLOCK_X * BLOCK_Y * BLOCK_Z;
constexpr int ARENA_X = BLOCK_X + LEFT + RIGHT;
constexpr int ARENA_Y = BLOCK_Y + LEFT + RIGHT;
constexpr int ARENA_Z = BLOCK_Z + LEFT + RIGHT;
constexpr int ARENA = ARENA_X * ARENA_Y * ARENA_Z;

// Launch bounds of block kernels are (THREADS, 1): the one block says that registers may be spent, not spilled.

// Keeps loads of the arena inside the particle loop. They do not change there, and the compiler would otherwise move all
// SUPPORT of them in front of it, into more registers than there are.
__device__ inline void forget_loads() { asm volatile("" ::: "memory"); }

// A range of sorted particles.
struct Bin {
    int start, count;
};

struct Block {
    int index;
    Cell first;  // its lowest cell
};

__device__ inline Block block_at(const Domain& domain, int index) {
    const int plane = domain.bx * domain.by;
    const int z = index / plane;
    const int rest = index - z * plane;
    const int y = rest / domain.bx;
    return {index, {(rest - y * domain.bx) * BLOCK_X, y * BLOCK_Y, z * BLOCK_Z}};
}

__device__ inline Block own_block(const Domain& domain, const int* active_blocks) {
    return block_at(domain, ACTIVE_ONLY ? active_blocks[blockIdx.x] : blockIdx.x);
}

// This thread's cell, counted from the first cell of the block.
__device__ inline Cell own_cell() {
    const int t = threadIdx.x;
    return {t % BLOCK_X, t / BLOCK_X % BLOCK_Y, t / (BLOCK_X * BLOCK_Y)};
}

__device__ inline constexpr int arena_index(int x, int y, int z) { return (z * ARENA_Y + y) * ARENA_X + x; }

__device__ inline Cell arena_place(int index) {
    return {index % ARENA_X, index / ARENA_X % ARENA_Y, index / (ARENA_X * ARENA_Y)};
}

// The particles of a cell; none outside the grid, where the last blocks of an axis may reach.
__device__ inline Bin bin_of(const Domain& domain, const int* bin_start, int x, int y, int z) {
    if (!in_grid(domain, x, y, z)) return {0, 0};
    const int bin = bin_index(domain, {x, y, z});
    const int start = bin_start[bin];
    return {start, bin_start[bin + 1] - start};
}
