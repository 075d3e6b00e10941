// Second half of a scan by levels: adds to each value what all segments before its own sum to.
// A thread owns one value. Constants: SEGMENT (values of a segment).
extern "C" __global__ void scan_add(
    const int count, int* __restrict__ scanned, const int* __restrict__ segments_before) {
    const int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i < count) scanned[i] += segments_before[i / SEGMENT];
}
