// Results that the order of warps or lanes decides, though every access by itself is sound.
#define I (64 * blockIdx.x + threadIdx.x)
extern "C" __global__ void ticket_4_bad(int* count, int* out) {  // FINDS schedule
    __shared__ int next;
    if (threadIdx.x == 0) next = 0;
    __syncthreads();
    out[64 * blockIdx.x + atomicAdd(&next, 1)] = threadIdx.x;
}
extern "C" __global__ void ticket_4_good(int* count, int* out) {
    __shared__ int next;
    if (threadIdx.x == 0) next = 0;
    __syncthreads();
    atomicAdd(&next, 1);
    __syncthreads();
    out[I] = next;
}
extern "C" __global__ void last_8_bad(unsigned long long* count, unsigned long long* out) {  // FINDS schedule
    __shared__ unsigned long long last;
    if (threadIdx.x == 0) last = 0;
    __syncthreads();
    if (threadIdx.x % 32 == 0) atomicExch(&last, (unsigned long long)threadIdx.x + 1);
    __syncthreads();
    out[I] = last;
}
extern "C" __global__ void last_8_good(unsigned long long* count, unsigned long long* out) {
    __shared__ unsigned long long last;
    if (threadIdx.x == 0) last = 0;
    __syncthreads();
    if (threadIdx.x % 32 == 0) atomicMax(&last, (unsigned long long)threadIdx.x + 1);
    __syncthreads();
    out[I] = last;
}
extern "C" __global__ void place_16_bad(int* count, float4* out) {  // FINDS schedule
    __shared__ int next;
    if (threadIdx.x == 0) next = 0;
    __syncthreads();
    int first = 0;
    if (threadIdx.x % 32 == 0) first = atomicAdd(&next, 32);
    first = __shfl_sync(0xffffffffu, first, 0);
    out[64 * blockIdx.x + first + threadIdx.x % 32] = make_float4(threadIdx.x, 1, 2, 3);
}
extern "C" __global__ void place_16_good(int* count, float4* out) {
    out[64 * blockIdx.x + threadIdx.x] = make_float4(threadIdx.x, 1, 2, 3);
}
// One warp: which way of a branch goes first.
extern "C" __global__ void lanes_bad(int* count, int* out) {  // FINDS schedule
    if (threadIdx.x >= 32) return;
    int* mine = count + blockIdx.x;
    int before;
    if (threadIdx.x % 2)
        before = atomicAdd(mine, 1);
    else
        before = atomicMax(mine, 100);
    out[I] = before;
}
extern "C" __global__ void lanes_good(int* count, int* out) {
    if (threadIdx.x >= 32) return;
    int* mine = count + 4 + blockIdx.x;
    if (threadIdx.x % 2)
        atomicAdd(mine, 1);
    else
        atomicAdd(mine, 100);
    out[I] = threadIdx.x;
}
extern "C" __global__ void rounding_good(float* count, float* out) { atomicAdd(count + 100 + threadIdx.x % 4, 0.1f * I); }
