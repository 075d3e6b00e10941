// Idea: elastic forces need only R and S of F = R S. As U and V are quaternions, R = U V^T is one quaternion product,
// and U is never written out.
// A thread owns one matrix, from loading to storing. All data is SoA: entry (row, column) of matrix t of `count` is at
// [(3 row + column) count + t]; the symmetric S has six: xx, yy, zz, xy, yz, zx.
// Constants: those of the headers.
#include "svd.cuh"

extern "C" __global__ void polar_decompose(
    const int count, const real* __restrict__ f, real* __restrict__ r, real* __restrict__ s) {
    const int t = blockIdx.x * blockDim.x + threadIdx.x;
    if (t >= count) return;

    Columns rotation;
    Symmetric stretch;
    polar_decomposition(load_matrix(f, count, t), rotation, stretch);
    store_matrix(r, count, t, rotation);
    store_symmetric(s, count, t, stretch);
}
