// Idea: F = U diag(s) V^T needs no neighbour, and its steps are the same for every F, so no lane waits for another.
// A thread owns one matrix, from loading to storing. All data is SoA: entry (row, column) of matrix t of `count` is at
// [(3 row + column) count + t], singular value k at [k count + t].
// Constants: those of the headers.
#include "svd.cuh"

extern "C" __global__ void svd_polar(
    const int count,
    const real* __restrict__ f,
    real* __restrict__ u,
    real* __restrict__ s,
    real* __restrict__ v) {
    const int t = blockIdx.x * blockDim.x + threadIdx.x;
    if (t >= count) return;

    Columns rotation_u, rotation_v;
    real3 values;
    polar_svd(load_matrix(f, count, t), rotation_u, values, rotation_v);
    store_matrix(u, count, t, rotation_u);
    store_vector(s, count, t, values);
    store_matrix(v, count, t, rotation_v);
}
