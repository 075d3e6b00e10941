// Counting sort, part 3, in full: every attribute of every particle moves to its sorted place in a second buffer.
// A thread owns one particle. Constants: KEEP_ORDER writes the index too, for results that must find their way back.
#include "particles.cuh"

struct Ticket {
    int bin, place;
};

extern "C" __global__ void sort_deep(
    const int particle_count,
    const Ticket* __restrict__ tickets,
    const int* __restrict__ bin_start,
    const real4* __restrict__ particles,
    real4* __restrict__ sorted,
    int* __restrict__ order) {
    const int p = blockIdx.x * blockDim.x + threadIdx.x;
    if (p >= particle_count) return;
    const Ticket ticket = tickets[p];
    const int s = bin_start[ticket.bin] + ticket.place;
#pragma unroll
    for (int a = 0; a < ATTRIBUTE_COUNT; ++a) {
        sorted[attribute_index<ATTRIBUTE_COUNT>(particle_count, s, a)] = load_attribute(particles, particle_count, p, a);
    }
    if (KEEP_ORDER) order[s] = p;
}
