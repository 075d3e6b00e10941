// The transfers as a C++ programmer would write them for one CPU thread: float32, PIC payload, cubic B-spline, 1-D weights once
// per particle, one four-component vector operation per node. The yardstick that tells whether the other peers are fast.
//
// Compiled at run time with -O3 -march=native. Particles: attribute 0 is position and mass at particles[p], attribute 1 is
// velocity at particles[count + p]. Nodes: x fastest, momentum and mass (P2G) or velocity (G2P) in one vector.
#include <cmath>

typedef float float4 __attribute__((vector_size(16)));

struct Domain {
    int nx, ny;
    float ox, oy, oz, inv_dx;
};

// Weights of one axis; returns the lowest node of the support.
static inline int axis_weights(float x, float origin, float inv_dx, float* w) {
    const float xi = (x - origin) * inv_dx;
    const float bin = std::floor(xi);
    const float f = xi - bin;
    const float g = 1.0f - f;
    w[0] = g * g * g * (1.0f / 6.0f);
    w[1] = (0.5f * f - 1.0f) * f * f + 2.0f / 3.0f;
    w[3] = f * f * f * (1.0f / 6.0f);
    w[2] = 1.0f - w[0] - w[1] - w[3];
    return (int)bin - 1;
}

extern "C" void p2g(Domain d, int count, const float4* __restrict particles, float4* __restrict nodes) {
    for (int p = 0; p < count; ++p) {
        const float4 position = particles[p];
        const float mass = position[3];
        float4 payload = particles[count + p] * mass;
        payload[3] = mass;
        float wx[4], wy[4], wz[4];
        const int x = axis_weights(position[0], d.ox, d.inv_dx, wx);
        const int y = axis_weights(position[1], d.oy, d.inv_dx, wy);
        const int z = axis_weights(position[2], d.oz, d.inv_dx, wz);
        float4* corner = nodes + ((long)z * d.ny + y) * d.nx + x;
        for (int k = 0; k < 4; ++k) {
            for (int j = 0; j < 4; ++j) {
                const float4 row = payload * (wz[k] * wy[j]);
                float4* node = corner + ((long)k * d.ny + j) * d.nx;
                for (int i = 0; i < 4; ++i) node[i] += row * wx[i];
            }
        }
    }
}

extern "C" void g2p(Domain d, int count, const float4* __restrict particles, const float4* __restrict nodes,
                    float4* __restrict results) {
    for (int p = 0; p < count; ++p) {
        const float4 position = particles[p];
        float wx[4], wy[4], wz[4];
        const int x = axis_weights(position[0], d.ox, d.inv_dx, wx);
        const int y = axis_weights(position[1], d.oy, d.inv_dx, wy);
        const int z = axis_weights(position[2], d.oz, d.inv_dx, wz);
        const float4* corner = nodes + ((long)z * d.ny + y) * d.nx + x;
        float4 sum = {0, 0, 0, 0};
        for (int k = 0; k < 4; ++k) {
            for (int j = 0; j < 4; ++j) {
                const float w = wz[k] * wy[j];
                const float4* node = corner + ((long)k * d.ny + j) * d.nx;
                for (int i = 0; i < 4; ++i) sum += node[i] * (w * wx[i]);
            }
        }
        sum[3] = 0;
        results[p] = sum;
    }
}
