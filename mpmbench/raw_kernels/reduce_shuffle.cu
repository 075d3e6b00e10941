// Idea: lanes of a warp exchange registers, so that shared memory and barriers are needed once per warp, not per step.
// A thread block owns GROUP * LOADS elements; a thread owns LOADS of them, a warp one place.
// Constants: those of reduce.cuh. Shared memory: one value per warp.
#include "reduce.cuh"
#include "tile.cuh"

extern "C" __global__ void __launch_bounds__(GROUP) reduce_shuffle(
    const int count, const element* __restrict__ values, decltype(Unary::of(values, 0, 0))* __restrict__ partials) {
    using Value = decltype(Unary::of(values, 0, 0));
    constexpr int WARPS = GROUP / WARP;
    __shared__ Tile<Value, WARPS> tile;

    const int lane = threadIdx.x % WARP;
    const int warp = threadIdx.x / WARP;
    Value sum = warp_reduce<Binary>(sequential_part(values, count));
    if (lane == 0) tile.set(warp, sum);
    __syncthreads();
    if (warp > 0) return;
    sum = warp_reduce<Binary>(lane < WARPS ? tile.get(lane) : Binary::neutral(Value()));
    if (lane == 0) partials[blockIdx.x] = sum;
}
