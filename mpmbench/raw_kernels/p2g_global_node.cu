// Idea: run the loop over the support in parallel too, for more threads in flight and adjacent lanes on adjacent nodes.
// A thread owns one (particle, node) pair; the SUPPORT threads of a particle are consecutive, x fastest.
// Constants: those of the headers. Each thread evaluates its weights exactly once, whatever LITERAL says.
#include "transfer.cuh"

extern "C" __global__ void p2g_global_node(
    const Domain domain,
    const int particle_count,
    const real4* __restrict__ particles,
    const int* __restrict__ order,
    real4* __restrict__ nodes) {
    // Unsigned: pairs outnumber particles 64 to 1 and may pass 2^31.
    const unsigned pair = blockIdx.x * blockDim.x + threadIdx.x;
    const unsigned s = pair / SUPPORT;
    if (s >= unsigned(particle_count)) return;

    Cell bin;
    const Source source = load_particle(domain, particles, particle_count, stored_at(order, s), bin);
    const Offset o = support_offset(pair % SUPPORT);
    const real w = weight(source.f.x, o.x) * weight(source.f.y, o.y) * weight(source.f.z, o.z);
    real4* node = nodes + node_index(domain, bin.x - LEFT + o.x, bin.y - LEFT + o.y, bin.z - LEFT + o.z);
    atomic_add(node, contribution(source, w * source.mass, o));
}
