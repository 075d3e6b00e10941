// Several lanes of a warp store to one address in one instruction: a race, or a note where all store the same.
#define OUT out[64 * blockIdx.x + threadIdx.x]
extern "C" __global__ void lanes_4_bad(int* out) {
    __shared__ int s[2];
    s[threadIdx.x / 32] = threadIdx.x;  // FINDS race
    __syncthreads();
    OUT = s[threadIdx.x / 32];
}
extern "C" __global__ void lanes_4_good(int* out) {
    __shared__ int s[2];
    if (threadIdx.x % 32 == 0) s[threadIdx.x / 32] = threadIdx.x;
    __syncthreads();
    OUT = s[threadIdx.x / 32];
}
extern "C" __global__ void lanes_8_bad(double* out) {
    __shared__ double s[32];
    s[threadIdx.x / 2] = threadIdx.x;  // FINDS race
    __syncthreads();
    OUT = s[threadIdx.x / 2];
}
extern "C" __global__ void lanes_8_good(double* out) {
    __shared__ double s[32];
    if (threadIdx.x % 2) s[threadIdx.x / 2] = threadIdx.x;
    __syncthreads();
    OUT = s[threadIdx.x / 2];
}
extern "C" __global__ void lanes_16_bad(float4* out) {
    __shared__ float4 s[32];
    s[threadIdx.x / 32 * 16 + threadIdx.x % 16] = make_float4(1, 2, 3, threadIdx.x);  // FINDS race
    __syncthreads();
    OUT = s[threadIdx.x / 2];
}
extern "C" __global__ void lanes_16_good(float4* out) {
    __shared__ float4 s[32];
    if (threadIdx.x % 32 < 16) s[threadIdx.x / 32 * 16 + threadIdx.x % 16] = make_float4(1, 2, 3, threadIdx.x);
    __syncthreads();
    OUT = s[threadIdx.x / 2];
}
extern "C" __global__ void turns_bad(int* out, int n) {
    __shared__ int s[64];
    for (int i = 0; i < n; ++i) s[threadIdx.x / 32 * 32 + (threadIdx.x + i) % 32] = threadIdx.x;  // FINDS race
    __syncthreads();
    OUT = s[threadIdx.x];
}
extern "C" __global__ void turns_good(int* out, int n) {
    __shared__ int s[64];
    for (int i = 0; i < n; ++i, __syncwarp()) s[threadIdx.x / 32 * 32 + (threadIdx.x + i) % 32] = threadIdx.x;
    __syncthreads();
    OUT = s[threadIdx.x];
}
extern "C" __global__ void equal_note(int* out, int value) {
    __shared__ int s;
    s = value;  // FINDS equal-stores
    __syncthreads();
    OUT = s;
}
