// Member masks of warp operations that do not match the lanes. Each launch is stopped there.
#define OUT out[64 * blockIdx.x + threadIdx.x]
extern "C" __global__ void unnamed_bad(int* out) {
    OUT = __shfl_xor_sync(0x0000ffffu, threadIdx.x, 1);  // FINDS bad-mask
}
extern "C" __global__ void unnamed_good(int* out) { OUT = __shfl_xor_sync(0xffffffffu, threadIdx.x, 1); }
extern "C" __global__ void never_bad(int* out) {
    int v = 0;
    if (threadIdx.x % 32 < 8) v = __ballot_sync(0xffffffffu, threadIdx.x & 1);  // FINDS bad-mask
    OUT = v;
}
extern "C" __global__ void never_good(int* out) {
    int v = 0;
    if (threadIdx.x % 32 < 8) v = __ballot_sync(0x000000ffu, threadIdx.x & 1);
    OUT = v;
}
extern "C" __global__ void loop_bad(int* out, int n) {
    int sum = 0;
    for (int i = 0; i < n + threadIdx.x % 2; ++i) {
        __syncwarp();  // FINDS bad-mask
        sum += i;
        OUT = sum;
    }
}
extern "C" __global__ void loop_good(int* out, int n) {
    int sum = 0;
    for (int i = 0; i < n; ++i) {
        __syncwarp();
        sum += i;
        OUT = sum;
    }
}
