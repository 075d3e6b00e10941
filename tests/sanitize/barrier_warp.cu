// A barrier that only some lanes of a warp reach. Each launch is stopped there.
#define OUT out[64 * blockIdx.x + threadIdx.x]
extern "C" __global__ void half_bad(int* out) {
    if (threadIdx.x % 32 < 16) __syncthreads();  // FINDS divergent-barrier
    OUT = 1;
}
extern "C" __global__ void half_good(int* out) {
    __syncthreads();
    OUT = 1;
}
extern "C" __global__ void loop_bad(int* out, int n) {
    for (int i = 0; i < n + threadIdx.x % 2; ++i) {
        __syncthreads();  // FINDS divergent-barrier
        OUT = i;
    }
}
extern "C" __global__ void loop_good(int* out, int n) {
    for (int i = 0; i < n; ++i) {
        __syncthreads();
        OUT = i;
    }
}
extern "C" __global__ void else_bad(int* out, int n) {
    if (threadIdx.x == 40) {
        OUT = n;
        __syncthreads();  // FINDS divergent-barrier
        OUT = 2 * n;
    } else {
        OUT = 3 * n;
        __syncthreads();  // FINDS divergent-barrier
    }
}
extern "C" __global__ void else_good(int* out, int n) {
    OUT = threadIdx.x == 40 ? n : 3 * n;
    __syncthreads();
    if (threadIdx.x == 40) OUT = 2 * n;
}
