// Idea: a tree whose partners stand 1, 2, 4, ... places apart.
// STRIDED 1: its active threads are packed together. Places of active lanes are then 2, 4, 8, ... apart: they share banks.
// STRIDED 0: the thread at a place works if the place is a multiple of twice the distance. No bank is shared, but every
// warp takes every step, the division by a number that is not known when compiling included.
// A thread block owns GROUP elements; a thread owns one place, and at most one pair per step of the tree.
// Constants: STRIDED and those of reduce.cuh. Shared memory: one value per thread.
#include "reduce.cuh"
#include "tile.cuh"

extern "C" __global__ void __launch_bounds__(GROUP) reduce_interleaved(
    const int count, const element* __restrict__ values, decltype(Unary::of(values, 0, 0))* __restrict__ partials) {
    using Value = decltype(Unary::of(values, 0, 0));
    __shared__ Tile<Value, GROUP> tile;

    const int t = threadIdx.x;
    tile.set(t, sequential_part(values, count));
    __syncthreads();
#pragma unroll (STRIDED ? GROUP : 1)
    for (int apart = 1; apart < GROUP; apart *= 2) {
        const int place = STRIDED ? 2 * apart * t : t;
        const bool works = STRIDED ? place < GROUP : threadIdx.x % (2u * apart) == 0;
        if (works) tile.set(place, Binary::combine(tile.get(place), tile.get(place + apart)));
        __syncthreads();
    }
    if (t == 0) partials[blockIdx.x] = tile.get(0);
}
