// Writes results of deeply sorted particles back in the order in which the particles were given.
// A thread owns one particle.
#include "particles.cuh"

extern "C" __global__ void restore_order(
    const int particle_count,
    const int* __restrict__ order,
    const real4* __restrict__ sorted_results,
    real4* __restrict__ results) {
    const int s = blockIdx.x * blockDim.x + threadIdx.x;
    if (s >= particle_count) return;
    const int p = order[s];
#pragma unroll
    for (int a = 0; a < RESULT_COUNT; ++a) {
        const real4 value = sorted_results[attribute_index<RESULT_COUNT>(particle_count, s, a)];
        store_result(results, particle_count, p, a, value);
    }
}
