// Counting sort, part 3, by index: where each particle stands in sorted order. A thread owns one particle.
struct Ticket {
    int bin, place;
};

extern "C" __global__ void sort_index(
    const int particle_count,
    const Ticket* __restrict__ tickets,
    const int* __restrict__ bin_start,
    int* __restrict__ order) {
    const int p = blockIdx.x * blockDim.x + threadIdx.x;
    if (p >= particle_count) return;
    const Ticket ticket = tickets[p];
    order[bin_start[ticket.bin] + ticket.place] = p;
}
