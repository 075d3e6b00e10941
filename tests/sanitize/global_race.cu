// Global memory that several thread blocks of one launch touch, which nothing orders.
extern "C" __global__ void write_4_bad(int* x) { x[threadIdx.x] = blockIdx.x; }  // FINDS global-race
extern "C" __global__ void write_4_good(int* x) { x[64 * blockIdx.x + threadIdx.x] = blockIdx.x; }
extern "C" __global__ void write_8_bad(double* x) {
    x[32 * blockIdx.x + threadIdx.x] = blockIdx.x;  // FINDS global-race
}
extern "C" __global__ void write_8_good(double* x) { x[64 * blockIdx.x + threadIdx.x] = blockIdx.x; }
extern "C" __global__ void write_16_bad(float4* x) {
    x[63 * blockIdx.x + threadIdx.x] = make_float4(blockIdx.x, 2, 3, 4);  // FINDS global-race
}
extern "C" __global__ void write_16_good(float4* x) {
    x[64 * blockIdx.x + threadIdx.x] = make_float4(blockIdx.x, 2, 3, 4);
}
extern "C" __global__ void read_4_bad(float* x, int n) {
    int i = 64 * blockIdx.x + threadIdx.x;
    float right = x[min(i + 1, n - 1)];  // FINDS global-race
    __syncthreads();
    x[i] = 0.5f * right;  // FINDS global-race
}
extern "C" __global__ void read_4_good(float* x, float* y, int n) {
    int i = 64 * blockIdx.x + threadIdx.x;
    y[i] = 0.5f * x[min(i + 1, n - 1)];
}
extern "C" __global__ void loop_bad(int* x, int n) {
    for (int i = threadIdx.x; i < n; i += blockDim.x) x[i] += 1;  // FINDS global-race
}
extern "C" __global__ void loop_good(int* x, int n) {
    for (int i = 64 * blockIdx.x + threadIdx.x; i < n; i += blockDim.x * gridDim.x) x[i] += 1;
}
extern "C" __global__ void mix_4_bad(float* x, float* y) {
    atomicAdd(x, 1.f);  // FINDS atomic-mix
    if (threadIdx.x == 0) y[blockIdx.x] = *x;  // FINDS atomic-mix
}
extern "C" __global__ void mix_4_good(float* x, float* y) {
    float sum = atomicAdd(x, 1.f);
    if (threadIdx.x == 0) y[blockIdx.x] = sum >= 0.f;
}
extern "C" __global__ void byte_bad(char* x) { x[64 - blockIdx.x + threadIdx.x] = blockIdx.x; }  // FINDS global-race
extern "C" __global__ void byte_good(char* x) { x[63 * blockIdx.x + threadIdx.x % 63] = blockIdx.x; }

// The last block to arrive sums what all have written: ordered by a fence before the ticket, or not.
__device__ int ticket_of_bad, ticket_of_good;
extern "C" __global__ void last_block_bad(int* x, int* sum) {
    if (threadIdx.x) return;
    x[blockIdx.x] = blockIdx.x;  // FINDS global-race
    if (atomicAdd(&ticket_of_bad, 1) % gridDim.x != gridDim.x - 1) return;
    int total = 0;
    for (int i = 0; i < gridDim.x; ++i) total += x[i];  // FINDS global-race
    *sum = total;
}
extern "C" __global__ void last_block_good(int* x, int* sum) {
    if (threadIdx.x) return;
    x[blockIdx.x] = blockIdx.x;
    __threadfence();
    if (atomicAdd(&ticket_of_good, 1) % gridDim.x != gridDim.x - 1) return;
    int total = 0;
    for (int i = 0; i < gridDim.x; ++i) total += x[i];
    *sum = total;
}
extern "C" __global__ void flag_note(int* x) { x[0] = 1; }  // FINDS equal-stores
