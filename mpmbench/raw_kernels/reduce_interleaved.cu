// Idea: a tree whose partners stand 1, 2, 4, ... places apart, its active threads packed together. Places of active
// lanes are then 2, 4, 8, ... apart: they share banks.
// A thread block owns GROUP elements; a thread owns one place, and one pair per step of the tree.
// Constants: those of reduce.cuh. Shared memory: one value per thread.
#include "reduce.cuh"
#include "tile.cuh"

extern "C" __global__ void __launch_bounds__(GROUP) reduce_interleaved(
    const int count, const element* __restrict__ values, decltype(Unary::of(values, 0, 0))* __restrict__ partials) {
    using Value = decltype(Unary::of(values, 0, 0));
    __shared__ Tile<Value, GROUP> tile;

    const int t = threadIdx.x;
    tile.set(t, sequential_part(values, count));
    __syncthreads();
#pragma unroll
    for (int apart = 1; apart < GROUP; apart *= 2) {
        const int place = 2 * apart * t;
        if (place < GROUP) tile.set(place, Binary::combine(tile.get(place), tile.get(place + apart)));
        __syncthreads();
    }
    if (t == 0) partials[blockIdx.x] = tile.get(0);
}
