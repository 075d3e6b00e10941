// Work-efficient scan of a tile in shared memory: sums up a tree, zero at its root, then down again. The tree needs
// interleaved addresses; padding keeps them from sharing banks.
//
// Constants: PADDING, 0 none, 1 one place per 32 (partial), 2 another one per 32 * 32 (full).
#pragma once
#include "scan.cuh"

constexpr int BANKS = 32;

__device__ inline constexpr int padded(int u) {
    return u + (PADDING > 0 ? u / BANKS : 0) + (PADDING > 1 ? u / (BANKS * BANKS) : 0);
}

// Exclusive scan of LEAVES places by LEAVES / 2 threads or more; returns the sum of all in thread 0. Begins and ends
// with a barrier.
template <int LEAVES>
__device__ inline int tree_scan(int* tile) {
    const int t = threadIdx.x;
#pragma unroll
    for (int apart = 1; apart < LEAVES; apart *= 2) {
        __syncthreads();
        if (t < LEAVES / 2 / apart) {
            const int low = padded(apart * (2 * t + 1) - 1);
            const int high = padded(apart * (2 * t + 2) - 1);
            tile[high] += tile[low];
        }
    }
    __syncthreads();
    int total = 0;
    if (t == 0) {
        total = tile[padded(LEAVES - 1)];
        tile[padded(LEAVES - 1)] = 0;
    }
#pragma unroll
    for (int apart = LEAVES / 2; apart > 0; apart /= 2) {
        __syncthreads();
        if (t < LEAVES / 2 / apart) {
            const int low = padded(apart * (2 * t + 1) - 1);
            const int high = padded(apart * (2 * t + 2) - 1);
            const int left = tile[low];
            const int before = tile[high];
            tile[low] = before;
            tile[high] = before + left;
        }
    }
    __syncthreads();
    return total;
}
