// A barrier that some warps of the thread block never reach, or reach somewhere else.
#define OUT out[64 * blockIdx.x + threadIdx.x]
extern "C" __global__ void return_bad(int* out) {
    if (threadIdx.x >= 32) return;
    __syncthreads();  // FINDS divergent-barrier
    OUT = 1;
}
extern "C" __global__ void return_good(int* out) {
    __syncthreads();
    if (threadIdx.x >= 32) return;
    OUT = 1;
}
extern "C" __global__ void loop_bad(int* out, int n) {
    for (int i = 0; i < n + threadIdx.x / 32; ++i) {
        __syncthreads();  // FINDS divergent-barrier
        OUT = i;
    }
}
extern "C" __global__ void loop_good(int* out, int n) {
    for (int i = 0; i < n + 1; ++i) {
        __syncthreads();
        if (i < n + threadIdx.x / 32) OUT = i;
    }
}
extern "C" __global__ void else_bad(int* out, int n) {
    if (threadIdx.x < 32) {
        OUT = n;
        __syncthreads();  // FINDS divergent-barrier
        OUT = 2 * n;
    } else {
        OUT = 3 * n;
        __syncthreads();  // FINDS divergent-barrier
    }
}
extern "C" __global__ void else_good(int* out, int n) {
    OUT = threadIdx.x < 32 ? n : 3 * n;
    __syncthreads();
    if (threadIdx.x < 32) OUT = 2 * n;
}
