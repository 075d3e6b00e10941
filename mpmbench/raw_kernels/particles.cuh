// The particle buffer: ATTRIBUTE_COUNT four-component attributes per particle in one allocation.
//
// Attribute 0 is position and mass, 1 velocity; APIC adds 2, 3, 4, the rows of the affine matrix C [1/s]. Attribute a of
// particle p sits at a * n + p (SOA) or p * ATTRIBUTE_COUNT + a. G2P writes a buffer of its own with velocity and, for
// APIC, the rows of C, laid out the same way.
//
// Constants: SOA, APIC, INDEXED (read through the sorted index), and ATTRIBUTES for particles with another number of them.
#pragma once
#include "real.cuh"

#ifdef ATTRIBUTES
constexpr int ATTRIBUTE_COUNT = ATTRIBUTES;
#else
constexpr int ATTRIBUTE_COUNT = APIC ? 5 : 2;
#endif
constexpr int RESULT_COUNT = APIC ? 4 : 1;

template <int COUNT>
__device__ inline int attribute_index(int particle_count, int p, int a) {
    return SOA ? a * particle_count + p : p * COUNT + a;
}

__device__ inline real4 load_attribute(const real4* particles, int particle_count, int p, int a) {
    return load(particles + attribute_index<ATTRIBUTE_COUNT>(particle_count, p, a));
}

__device__ inline void store_result(real4* results, int particle_count, int p, int a, const real4& value) {
    results[attribute_index<RESULT_COUNT>(particle_count, p, a)] = value;
}

// Where the s-th particle in processing order is stored.
__device__ inline int stored_at(const int* order, int s) { return INDEXED ? order[s] : s; }
