// Scalars and the four-component value that particles and nodes are made of; sums into shared places.
//
// Constants: REAL (float | double), REAL_IS_DOUBLE (0 | 1).
#pragma once

using real = REAL;

#if REAL_IS_DOUBLE
// CUDA's own double4 changed its alignment between toolkits; 16 bytes is what two 16-byte loads need.
struct alignas(16) real4 {
    double x, y, z, w;
};
#else
using real4 = float4;
#endif

struct real3 {
    real x, y, z;
};

// Reads memory that nothing writes during the kernel. Always whole 16-byte requests: left to itself the compiler splits a
// vector of which one component is not used.
__device__ inline real4 load(const real4* place) {
#if REAL_IS_DOUBLE
    const double2* halves = reinterpret_cast<const double2*>(place);
    const double2 low = __ldg(halves), high = __ldg(halves + 1);
    return {low.x, low.y, high.x, high.y};
#else
    return __ldg(place);
#endif
}

constexpr int WARP = 32;

// Rounded product that is never fused with an addition, so that all kernels compute the same cell.
__device__ inline float rounded_product(float a, float b) { return __fmul_rn(a, b); }
__device__ inline double rounded_product(double a, double b) { return __dmul_rn(a, b); }

__device__ inline int floor_to_int(float a) { return __float2int_rd(a); }
__device__ inline int floor_to_int(double a) { return __double2int_rd(a); }

__device__ inline void atomic_add(float* place, float value) { atomicAdd(place, value); }

__device__ inline void atomic_add(double* place, double value) {
#if __CUDA_ARCH__ >= 600
    atomicAdd(place, value);
#else
    // No 64-bit float atomics before Pascal. Compare bits, not numbers: a NaN would never equal itself.
    auto* bits = reinterpret_cast<unsigned long long*>(place);
    unsigned long long seen = *bits;
    unsigned long long assumed;
    do {
        assumed = seen;
        const double sum = __longlong_as_double(assumed) + value;
        seen = atomicCAS(bits, assumed, __double_as_longlong(sum));
    } while (seen != assumed);
#endif
}

// Four atomic sums, one after another: a node is never seen half updated by itself, only by other readers.
__device__ inline void atomic_add(real4* node, const real4& value) {
    atomic_add(&node->x, value.x);
    atomic_add(&node->y, value.y);
    atomic_add(&node->z, value.z);
    atomic_add(&node->w, value.w);
}

__device__ inline real4 operator+(const real4& a, const real4& b) {
    return {a.x + b.x, a.y + b.y, a.z + b.z, a.w + b.w};
}
