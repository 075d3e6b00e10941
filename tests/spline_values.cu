// Writes out what transfers compute from the fractions of a particle: weights of one axis and of the whole support, and
// the factors that an affine G2P multiplies node velocities by. A thread owns one particle.
#include "transfer.cuh"

extern "C" __global__ void spline_values(
    const int count, const real* fractions, real* axis_weights, real* weights, real* factors) {
    const int t = blockIdx.x * blockDim.x + threadIdx.x;
    if (t >= count) return;
    const real3 f = {fractions[t], fractions[count + t], fractions[2 * count + t]};
    Weights w;
    w.set(f);
#pragma unroll NODE_UNROLL
    for (int o = 0; o < NODES; ++o) axis_weights[o * count + t] = w.x.at(o);
#pragma unroll NODE_UNROLL
    for (int n = 0; n < SUPPORT; ++n) {
        const Offset o = support_offset(n);
        const real product = w.scaled(real(1), o);
        const real3 g = affine_factor(w, product, f, o);
        weights[n * count + t] = product;
        factors[(3 * n) * count + t] = g.x;
        factors[(3 * n + 1) * count + t] = g.y;
        factors[(3 * n + 2) * count + t] = g.z;
    }
}
