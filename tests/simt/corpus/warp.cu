// Operations across the lanes of a warp, and barriers.
#include "corpus.cuh"
#define ALL 0xffffffffu

KERNEL(warp_shuffles) {
    int i = thread_index(), lane = threadIdx.x & 31;
    int a = (int)uin[3 * i];
    float f = fin[3 * i];
    u64* o = uout + i * ROOM;
    o[0] = __shfl_sync(ALL, a, 5); o[1] = __shfl_sync(ALL, a, lane * 7 & 31); o[2] = __shfl_up_sync(ALL, a, 3);
    o[3] = __shfl_down_sync(ALL, a, 9); o[4] = __shfl_xor_sync(ALL, a, 17); o[5] = __shfl_sync(ALL, a, lane + 3, 8);
    o[6] = __shfl_up_sync(ALL, a, 2, 16); o[7] = __shfl_down_sync(ALL, a, 1, 4); o[8] = __shfl_xor_sync(ALL, a, 3, 8);
    fout[i * ROOM] = __shfl_xor_sync(ALL, f, 1);
    dout[i * ROOM] = __shfl_down_sync(ALL, din[3 * i], 4);
    o[9] = __shfl_sync(ALL, uin[3 * i + 1], 31 - lane);
    u32 sum = a;
    for (int step = 16; step > 0; step >>= 1) sum += __shfl_down_sync(ALL, sum, step);
    o[10] = __shfl_sync(ALL, sum, 0);
    int inclusive = a;
    for (int step = 1; step < 32; step <<= 1) {
        int other = __shfl_up_sync(ALL, inclusive, step);
        if (lane >= step) inclusive += other;
    }
    o[11] = (u32)inclusive;
    if (lane < 16) o[12] = __shfl_xor_sync(0x0000ffffu, a, 5);
    else o[12] = __shfl_down_sync(0xffff0000u, a, 2);
}

KERNEL(warp_votes) {
    int i = thread_index(), lane = threadIdx.x & 31;
    int a = (int)uin[3 * i];
    u64* o = uout + i * ROOM;
    o[0] = __all_sync(ALL, a > 0); o[1] = __any_sync(ALL, a > 0); o[2] = __ballot_sync(ALL, a & 1);
    o[3] = __uni_sync(ALL, a >= 0); o[4] = __activemask();
    if (a & 2) o[5] = __ballot_sync(__activemask(), a & 4);
    o[6] = __popc(__ballot_sync(ALL, a & 1) & ((1u << lane) - 1));
    u32 lt, le, gt, ge, eq, id;
    asm("mov.u32 %0, %%lanemask_lt;" : "=r"(lt)); asm("mov.u32 %0, %%lanemask_le;" : "=r"(le));
    asm("mov.u32 %0, %%lanemask_gt;" : "=r"(gt)); asm("mov.u32 %0, %%lanemask_ge;" : "=r"(ge));
    asm("mov.u32 %0, %%lanemask_eq;" : "=r"(eq)); asm("mov.u32 %0, %%laneid;" : "=r"(id));
    o[7] = lt; o[8] = le; o[9] = gt; o[10] = ge; o[11] = eq; o[12] = id;
    __syncwarp();
    if (lane < 8) { o[13] = __any_sync(0xff, a & 1); __syncwarp(0xff); }
}

#if __CUDA_ARCH__ >= 700
KERNEL(warp_match) {
    int i = thread_index();
    int a = (int)uin[3 * i], same;
    u64* o = uout + i * ROOM;
    o[0] = __match_any_sync(ALL, a & 3); o[1] = __match_any_sync(ALL, uin[3 * i] & 5);
    o[2] = __match_all_sync(ALL, a & 1, &same); o[3] = same; o[4] = __match_all_sync(ALL, 7, &same); o[5] = same;
    o[6] = __match_all_sync(ALL, uin[3 * i], &same); o[7] = same;
}
#endif

#if __CUDA_ARCH__ >= 800
KERNEL(warp_reductions) {
    int i = thread_index();
    int a = (int)uin[3 * i];
    u64* o = uout + i * ROOM;
    o[0] = __reduce_add_sync(ALL, a); o[1] = (u32)__reduce_min_sync(ALL, a); o[2] = (u32)__reduce_max_sync(ALL, a);
    o[3] = __reduce_min_sync(ALL, (u32)a); o[4] = __reduce_max_sync(ALL, (u32)a); o[5] = __reduce_and_sync(ALL, (u32)a);
    o[6] = __reduce_or_sync(ALL, (u32)a); o[7] = __reduce_xor_sync(ALL, (u32)a); o[8] = __reduce_add_sync(ALL, (u32)a);
}
#endif

KERNEL(warp_block_barriers) {
    __shared__ int tile[128];
    int i = thread_index(), t = threadIdx.x;
    int a = (int)uin[3 * i];
    u64* o = uout + i * ROOM;
    tile[t] = a;
    __syncthreads();
    o[0] = (u32)tile[blockDim.x - 1 - t];
    o[1] = __syncthreads_count(a & 1); o[2] = __syncthreads_and(a != 12345); o[3] = __syncthreads_or(a == 12345);
    tile[t] = a + 1;
    __syncthreads();
    o[4] = (u32)tile[t ^ 1];
    __threadfence(); __threadfence_block(); __threadfence_system();
}
