// Idea: reverse the scatter. Every node pulls from the bins around it, so nothing is ever added concurrently.
// A thread block owns one block; in each round BATCH particles of every bin of the block and its halo are staged in
// shared memory, then each thread sums, for its one node, over the bins of the reversed support. One plain store per
// node at the end. The number of rounds is the largest bin of block and halo, so barriers are in uniform flow.
// Constants: BATCH and those of the headers. Shared memory: STAGED arrays of real4 per bin and batch place, plus the
// range of each bin.
#include "block.cuh"
#include "transfer.cuh"

constexpr int STAGED = APIC ? 5 : 2;  // fraction and mass, velocity, rows of dx C

__device__ inline void stage(real4 (*staged)[STAGED][ARENA], int j, int place, const Source& source) {
    staged[j][0][place] = {source.f.x, source.f.y, source.f.z, source.mass};
    staged[j][1][place] = {source.v.x, source.v.y, source.v.z, 0};
    if constexpr (APIC) {
#pragma unroll
        for (int row = 0; row < 3; ++row) {
            staged[j][2 + row][place] = {source.c[row].x, source.c[row].y, source.c[row].z, 0};
        }
    }
}

__device__ inline Source staged_source(const real4 (*staged)[STAGED][ARENA], int j, int place) {
    Source source = no_source();
    const real4 head = staged[j][0][place];
    source.f = xyz(head);
    source.mass = head.w;
    source.v = xyz(staged[j][1][place]);
    if constexpr (APIC) {
#pragma unroll
        for (int row = 0; row < 3; ++row) source.c[row] = xyz(staged[j][2 + row][place]);
    }
    return source;
}

extern "C" __global__ void __launch_bounds__(THREADS, 1) p2g_block_pull(
    const Domain domain,
    const int particle_count,
    const real4* __restrict__ particles,
    const int* __restrict__ order,
    const int* __restrict__ bin_start,
    const int* __restrict__ halo_maximum,
    const int* __restrict__ active_blocks,
    real4* __restrict__ nodes) {
    __shared__ real4 staged[BATCH][STAGED][ARENA];
    __shared__ Bin bins[ARENA];

    const Block block = own_block(domain, active_blocks);
    // A node hears from bins RIGHT below to LEFT above it.
    for (int index = threadIdx.x; index < ARENA; index += THREADS) {
        const Cell place = arena_place(index);
        bins[index] = bin_of(domain, bin_start, block.first.x - RIGHT + place.x, block.first.y - RIGHT + place.y,
                             block.first.z - RIGHT + place.z);
    }
    __syncthreads();

    const Cell own = own_cell();
    const int home = arena_index(own.x, own.y, own.z);
    const int largest = halo_maximum[block.index];
    real4 sum = {0, 0, 0, 0};

    for (int first = 0; first < largest; first += BATCH) {
        for (int index = threadIdx.x; index < ARENA; index += THREADS) {
            const Bin bin = bins[index];
#pragma unroll
            for (int j = 0; j < BATCH; ++j) {
                Source source = no_source();
                if (first + j < bin.count) {
                    const int p = stored_at(order, bin.start + first + j);
                    Cell ignored;
                    source = load_particle(domain, particles, particle_count, p, ignored);
                }
                stage(staged, j, index, source);
            }
        }
        __syncthreads();

#pragma unroll NODE_UNROLL
        for (int n = 0; n < SUPPORT; ++n) {
            const Offset bin = support_offset(n);
            // The lowest bin sees this node as its highest one.
            const Offset o = {NODES - 1 - bin.x, NODES - 1 - bin.y, NODES - 1 - bin.z};
            const int place = home + arena_index(bin.x, bin.y, bin.z);
#pragma unroll
            for (int j = 0; j < BATCH; ++j) {
                const Source source = staged_source(staged, j, place);
                const real w = weight(source.f.x, o.x) * weight(source.f.y, o.y) * weight(source.f.z, o.z);
                sum = sum + contribution(source, w * source.mass, o);
            }
        }
        // The next round overwrites what others may still be reading.
        __syncthreads();
    }

    const int x = block.first.x + own.x, y = block.first.y + own.y, z = block.first.z + own.z;
    if (in_grid(domain, x, y, z)) nodes[node_index(domain, x, y, z)] = sum;
}
