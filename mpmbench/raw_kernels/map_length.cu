// Idea: the least that a kernel can do with a record: read one attribute or two, write the length of each.
// A thread owns one record.
// Constants: USED (attributes read, 1 or 2), and those of layout.cuh.
#include "layout.cuh"
#include "operators.cuh"

extern "C" __global__ void map_length(
    const int count, const int capacity, const char* __restrict__ bytes, real* __restrict__ speeds,
    real* __restrict__ distances) {
    const int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i >= count) return;
    const Records particles(bytes, capacity);
    speeds[i] = length(particles.velocity(i));
    if (USED > 1) distances[i] = length(particles.position(i));
}
