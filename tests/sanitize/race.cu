// Shared memory without a barrier between two warps (block), or two lanes of one warp (warp).
#define OUT out[64 * blockIdx.x + threadIdx.x]
extern "C" __global__ void block_4_bad(int* out) {
    __shared__ int s[64];
    s[threadIdx.x] = threadIdx.x;  // FINDS race
    OUT = s[63 - threadIdx.x];  // FINDS race
}
extern "C" __global__ void block_4_good(int* out) {
    __shared__ int s[64];
    s[threadIdx.x] = threadIdx.x;
    __syncthreads();
    OUT = s[63 - threadIdx.x];
}
extern "C" __global__ void block_8_bad(double* out) {
    __shared__ double s[64];
    s[threadIdx.x] = threadIdx.x;  // FINDS race
    __syncwarp();
    OUT = s[63 - threadIdx.x];  // FINDS race
}
extern "C" __global__ void block_8_good(double* out) {
    __shared__ double s[64];
    s[threadIdx.x] = threadIdx.x;
    __syncwarp();
    OUT = s[threadIdx.x ^ 1];
}
extern "C" __global__ void block_16_bad(float4* out) {
    __shared__ float4 s[64];
    s[threadIdx.x] = make_float4(1, 2, 3, threadIdx.x);  // FINDS race
    OUT = s[(threadIdx.x + 32) % 64];  // FINDS race
}
extern "C" __global__ void block_16_good(float4* out) {
    __shared__ float4 s[64];
    s[threadIdx.x] = make_float4(1, 2, 3, threadIdx.x);
    __syncthreads();
    OUT = s[(threadIdx.x + 32) % 64];
}
extern "C" __global__ void block_loop_bad(int* out, int n) {
    __shared__ int s[64];
    int sum = 0;
    for (int i = 0; i < n; ++i) {
        s[threadIdx.x] = i * threadIdx.x;  // FINDS race
        __syncthreads();
        sum += s[(threadIdx.x + 32) % 64];  // FINDS race
    }
    OUT = sum;
}
extern "C" __global__ void block_loop_good(int* out, int n) {
    __shared__ int s[64];
    int sum = 0;
    for (int i = 0; i < n; ++i) {
        s[threadIdx.x] = i * threadIdx.x;
        __syncthreads();
        sum += s[(threadIdx.x + 32) % 64];
        __syncthreads();
    }
    OUT = sum;
}
extern "C" __global__ void warp_4_bad(int* out) {
    __shared__ int s[64];
    s[threadIdx.x] = threadIdx.x;  // FINDS race
    int other = __shfl_xor_sync(0xffffffffu, threadIdx.x, 1);
    OUT = s[other];  // FINDS race
}
extern "C" __global__ void warp_4_good(int* out) {
    __shared__ int s[64];
    s[threadIdx.x] = threadIdx.x;
    int other = __shfl_xor_sync(0xffffffffu, threadIdx.x, 1);
    __syncwarp();
    OUT = s[other];
}
extern "C" __global__ void warp_8_bad(double* out) {
    __shared__ double s[64];
    s[threadIdx.x] = threadIdx.x;  // FINDS race
    OUT = s[threadIdx.x ^ 16];  // FINDS race
}
extern "C" __global__ void warp_8_good(double* out) {
    __shared__ double s[64];
    s[threadIdx.x] = threadIdx.x;
    __syncwarp();
    OUT = s[threadIdx.x ^ 16];
}
extern "C" __global__ void warp_16_bad(float4* out) {
    __shared__ float4 s[64];
    s[threadIdx.x] = make_float4(0, 0, 0, 0);  // FINDS race
    s[threadIdx.x ^ 1].w = threadIdx.x + 1.f;  // FINDS race
    __syncwarp();
    OUT = s[threadIdx.x];
}
extern "C" __global__ void warp_16_good(float4* out) {
    __shared__ float4 s[64];
    s[threadIdx.x] = make_float4(0, 0, 0, 0);
    __syncwarp();
    s[threadIdx.x ^ 1].w = threadIdx.x + 1.f;
    __syncwarp();
    OUT = s[threadIdx.x];
}
extern "C" __global__ void warp_loop_bad(float* out, int n) {
    __shared__ float s[65];
    s[threadIdx.x] = threadIdx.x;
    if (threadIdx.x == 0) s[64] = 0.f;
    __syncthreads();
    for (int i = 0; i < n; ++i) {
        float next = threadIdx.x % 32 < 31 ? s[threadIdx.x + 1] : 0.f;  // FINDS race
        __syncwarp();
        s[threadIdx.x] = next;  // FINDS race
    }
    OUT = s[threadIdx.x];
}
extern "C" __global__ void warp_loop_good(float* out, int n) {
    __shared__ float s[65];
    s[threadIdx.x] = threadIdx.x;
    if (threadIdx.x == 0) s[64] = 0.f;
    __syncthreads();
    for (int i = 0; i < n; ++i) {
        float next = threadIdx.x % 32 < 31 ? s[threadIdx.x + 1] : 0.f;
        __syncwarp();
        s[threadIdx.x] = next;
        __syncwarp();
    }
    OUT = s[threadIdx.x];
}
