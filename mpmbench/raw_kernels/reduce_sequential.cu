// Idea: a tree that folds the upper half of the places onto the lower half. Active lanes always take neighbouring places,
// so no two share a bank; and each thread first combines LOADS elements in a register, which the tree then never sees.
// A thread block owns GROUP * LOADS elements; a thread owns one place.
// Constants: those of reduce.cuh. Shared memory: one value per thread.
#include "reduce.cuh"
#include "tile.cuh"

extern "C" __global__ void __launch_bounds__(GROUP) reduce_sequential(
    const int count, const element* __restrict__ values, decltype(Unary::of(values, 0, 0))* __restrict__ partials) {
    using Value = decltype(Unary::of(values, 0, 0));
    __shared__ Tile<Value, GROUP> tile;

    const int t = threadIdx.x;
    tile.set(t, sequential_part(values, count));
    __syncthreads();
#pragma unroll
    for (int half = GROUP / 2; half > 0; half /= 2) {
        if (t < half) tile.set(t, Binary::combine(tile.get(t), tile.get(t + half)));
        __syncthreads();
    }
    if (t == 0) partials[blockIdx.x] = tile.get(0);
}
