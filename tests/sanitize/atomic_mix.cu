// Atomic and plain accesses to one place of shared memory without a barrier between them.
#define OUT out[64 * blockIdx.x + threadIdx.x]
extern "C" __global__ void read_4_bad(int* out) {
    __shared__ int s;
    if (threadIdx.x == 0) s = 0;
    __syncthreads();
    atomicAdd(&s, 1);  // FINDS atomic-mix
    OUT = s;  // FINDS atomic-mix
}
extern "C" __global__ void read_4_good(int* out) {
    __shared__ int s;
    if (threadIdx.x == 0) s = 0;
    __syncthreads();
    atomicAdd(&s, 1);
    __syncthreads();
    OUT = s;
}
extern "C" __global__ void write_8_bad(unsigned long long* out) {
    __shared__ unsigned long long s;
    if (threadIdx.x == 0) s = 5;  // FINDS atomic-mix
    if (threadIdx.x > 31) atomicMax(&s, (unsigned long long)threadIdx.x);  // FINDS atomic-mix uninitialised
    __syncthreads();
    OUT = s;
}
extern "C" __global__ void write_8_good(unsigned long long* out) {
    __shared__ unsigned long long s;
    if (threadIdx.x == 0) s = 5;
    __syncthreads();
    if (threadIdx.x > 31) atomicMax(&s, (unsigned long long)threadIdx.x);
    __syncthreads();
    OUT = s;
}
extern "C" __global__ void read_16_bad(float4* out) {
    __shared__ float4 s[64];
    s[threadIdx.x] = make_float4(0, 0, 0, 0);
    __syncthreads();
    atomicAdd(&s[threadIdx.x ^ 1].y, 1.f);  // FINDS atomic-mix
    OUT = s[threadIdx.x];  // FINDS atomic-mix
}
extern "C" __global__ void read_16_good(float4* out) {
    __shared__ float4 s[64];
    s[threadIdx.x] = make_float4(0, 0, 0, 0);
    __syncthreads();
    atomicAdd(&s[threadIdx.x ^ 1].y, 1.f);
    __syncwarp();
    OUT = s[threadIdx.x];
}
extern "C" __global__ void loop_bad(int* out, int n) {
    __shared__ int s;
    if (threadIdx.x == 0) s = 0;
    __syncthreads();
    for (int i = 0; i < n; ++i) {
        if (threadIdx.x == 40) s += 1;  // FINDS atomic-mix
        __syncthreads();
        atomicAdd(&s, 1);  // FINDS atomic-mix
    }
    OUT = n;
}
extern "C" __global__ void loop_good(int* out, int n) {
    __shared__ int s;
    if (threadIdx.x == 0) s = 0;
    __syncthreads();
    for (int i = 0; i < n; ++i) {
        if (threadIdx.x == 40) s += 1;
        __syncthreads();
        atomicAdd(&s, 1);
        __syncthreads();
    }
    OUT = n;
}
