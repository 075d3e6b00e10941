// Zeroes integer counters. A thread owns one.
extern "C" __global__ void clear_counts(const int count, int* __restrict__ counts) {
    const int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i < count) counts[i] = 0;
}
