// Loops that never end. Each launch is stopped when its budget is spent.
#define OUT out[64 * blockIdx.x + threadIdx.x]
extern "C" __global__ void endless_bad(volatile int* out) {
    while (true) out[0] = out[0] + 1;  // FINDS runaway
}
extern "C" __global__ void endless_good(int* out) {
    for (int i = 0; i < 100; ++i) OUT = i;
}
__device__ int lock_of_bad, lock_of_good;
extern "C" __global__ void lock_bad(int* out) {
    while (atomicCAS(&lock_of_bad, 0, 1) != 0) {  // FINDS runaway
    }
    __syncwarp();
    OUT = 1;
    __threadfence();
    atomicExch(&lock_of_bad, 0);
}
extern "C" __global__ void lock_good(int* out) {
    if (threadIdx.x % 32) return;
    while (atomicCAS(&lock_of_good, 0, 1) != 0) {
    }
    OUT = 1;
    __threadfence();
    atomicExch(&lock_of_good, 0);
}
extern "C" __global__ void flag_bad(int* out) {
    __shared__ volatile int ready;
    if (threadIdx.x == 0) ready = 0;
    __syncthreads();
    if (threadIdx.x < 32) {
        while (ready < 2) {  // FINDS runaway race
        }
    } else if (threadIdx.x == 32) {
        ready = 1;  // FINDS race
    }
    OUT = 1;
}
extern "C" __global__ void flag_good(int* out) {
    __shared__ volatile int ready;
    if (threadIdx.x == 0) ready = 0;
    __syncthreads();
    if (threadIdx.x == 32) ready = 1;
    __syncthreads();
    while (ready < 1) {
    }
    OUT = 1;
}
