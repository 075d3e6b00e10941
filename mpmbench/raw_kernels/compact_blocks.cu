// Stream compaction: the list of blocks with a particle, and its length. A thread owns one block.
// slots is the exclusive scan of (maximum > 0).
extern "C" __global__ void compact_blocks(
    const int block_count,
    const int* __restrict__ maximum,
    const int* __restrict__ slots,
    int* __restrict__ active_blocks,
    int* __restrict__ active_count) {
    const int block = blockIdx.x * blockDim.x + threadIdx.x;
    if (block >= block_count) return;
    const bool occupied = maximum[block] > 0;
    const int slot = slots[block];
    if (occupied) active_blocks[slot] = block;
    if (block == block_count - 1) *active_count = slot + occupied;
}
