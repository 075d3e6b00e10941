// Moves particles with their velocity: x += dt v. A thread owns one particle.
#include "particles.cuh"

extern "C" __global__ void advect(const int particle_count, const real dt, real4* __restrict__ particles) {
    const int p = blockIdx.x * blockDim.x + threadIdx.x;
    if (p >= particle_count) return;
    real4& position = particles[attribute_index<ATTRIBUTE_COUNT>(particle_count, p, 0)];
    const real4 velocity = load_attribute(particles, particle_count, p, 1);
    position = {position.x + dt * velocity.x, position.y + dt * velocity.y, position.z + dt * velocity.z, position.w};
}
