// B-spline weights of degree 1, 2 and 3: the one place where they are written down.
//
// A particle at xi (in cells) belongs to the bin node b = floor(xi) (linear, cubic) or floor(xi - 1/2) (quadratic) and
// reaches the nodes b - LEFT .. b + RIGHT per axis. Its fraction is f = xi - b; offset o names node b - LEFT + o.
//
// Constants: SPLINE (degree), UNITY (one inner weight is one minus the others), LITERAL (evaluate a weight wherever a
// node loop asks for it, loop kept rolled) or not (1-D weights once per particle, loop unrolled).
#pragma once
#include "real.cuh"

constexpr int NODES = SPLINE + 1;  // per axis
constexpr int LEFT = SPLINE == 3 ? 1 : 0;
constexpr int RIGHT = NODES - 1 - LEFT;
constexpr int SUPPORT = NODES * NODES * NODES;
constexpr int NODE_UNROLL = LITERAL ? 1 : SUPPORT;
constexpr int UNITY_OFFSET = SPLINE == 3 ? 2 : 1;  // the inner node whose weight follows from the others

// Position of a node inside a support, each component 0 .. NODES - 1.
struct Offset {
    int x, y, z;
};

// The n-th node of a support, x fastest.
__device__ constexpr Offset support_offset(int n) { return {n % NODES, n / NODES % NODES, n / (NODES * NODES)}; }

// Node minus particle, in cells.
__device__ inline real distance(real f, int o) { return real(o - LEFT) - f; }

// The textbook formula N(|distance|); which polynomial piece applies follows from the offset.
__device__ inline real textbook_weight(real f, int o) {
    const real t = fabs(distance(f, o));
    if constexpr (SPLINE == 1) {
        return real(1) - t;
    } else if constexpr (SPLINE == 2) {
        const real s = real(1.5) - t;
        return o == 1 ? real(0.75) - t * t : real(0.5) * s * s;
    } else {
        const real s = real(2) - t;
        return o == 1 || o == 2 ? (real(0.5) * t - real(1)) * t * t + real(2.0 / 3.0) : s * s * s * real(1.0 / 6.0);
    }
}

__device__ inline real weight(real f, int o) {
    if (UNITY && o == UNITY_OFFSET) {
        real rest = real(1) - textbook_weight(f, 0);
        if constexpr (SPLINE == 3) rest -= textbook_weight(f, 1);
        if constexpr (SPLINE > 1) rest -= textbook_weight(f, NODES - 1);
        return rest;
    }
    return textbook_weight(f, o);
}

// The weights of one axis, evaluated on demand or kept.
struct AxisWeights {
#if LITERAL
    real f;
    __device__ void set(real fraction) { f = fraction; }
    __device__ real at(int o) const { return weight(f, o); }
#else
    real w[NODES];
    __device__ void set(real fraction) {
#pragma unroll
        for (int o = 0; o < NODES; ++o) w[o] = weight(fraction, o);
    }
    __device__ real at(int o) const { return w[o]; }
#endif
};

struct Weights {
    AxisWeights x, y, z;
    __device__ void set(const real3& f) {
        x.set(f.x);
        y.set(f.y);
        z.set(f.z);
    }
    // scale * w; the z and y factors come first so that a row of nodes shares their product.
    __device__ real scaled(real scale, const Offset& o) const { return scale * z.at(o.z) * y.at(o.y) * x.at(o.x); }
};
