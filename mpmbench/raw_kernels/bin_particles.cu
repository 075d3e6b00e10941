// Counting sort, part 1: each particle draws a ticket at its bin. A thread owns one particle.
// The ticket holds the bin and the particle's place in it; places follow the order of the atomics.
// Constants: BLOCK_INDEX chooses the numbering of bins.
#include "domain.cuh"
#include "particles.cuh"

struct Ticket {
    int bin, place;
};

extern "C" __global__ void bin_particles(
    const Domain domain,
    const int particle_count,
    const real4* __restrict__ particles,
    int* __restrict__ bin_count,
    Ticket* __restrict__ tickets) {
    const int p = blockIdx.x * blockDim.x + threadIdx.x;
    if (p >= particle_count) return;
    real3 ignored;
    const int bin = bin_index(domain, split_position(domain, load_attribute(particles, particle_count, p, 0), ignored));
    tickets[p] = {bin, atomicAdd(&bin_count[bin], 1)};
}
