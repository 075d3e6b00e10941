// Addresses that are no multiple of the access's width.
extern "C" __global__ void write_4_bad(char* x) {
    *(int*)(x + 4 * (64 * blockIdx.x + threadIdx.x) + 1) = 1;  // FINDS misaligned
}
extern "C" __global__ void write_4_good(char* x) { *(int*)(x + 4 * (64 * blockIdx.x + threadIdx.x)) = 1; }
extern "C" __global__ void read_8_bad(float* x, double* y) {
    y[64 * blockIdx.x + threadIdx.x] = *(double*)(x + 2 * threadIdx.x + 1);  // FINDS misaligned
}
extern "C" __global__ void read_8_good(float* x, double* y) {
    y[64 * blockIdx.x + threadIdx.x] = *(double*)(x + 2 * threadIdx.x);
}
extern "C" __global__ void read_16_bad(float* x, float4* y) {
    y[64 * blockIdx.x + threadIdx.x] = *(float4*)(x + threadIdx.x);  // FINDS misaligned
}
extern "C" __global__ void read_16_good(float* x, float4* y) {
    y[64 * blockIdx.x + threadIdx.x] = *(float4*)(x + 4 * threadIdx.x);
}
extern "C" __global__ void loop_8_bad(float* x, int n) {
    for (int i = threadIdx.x + 64 * blockIdx.x; i < n; i += 128) *(float2*)(x + 3 * i) = make_float2(1, 2);  // FINDS misaligned
}
extern "C" __global__ void loop_8_good(float* x, int n) {
    for (int i = threadIdx.x + 64 * blockIdx.x; i < n; i += 128) *(float2*)(x + 2 * i) = make_float2(1, 2);
}
extern "C" __global__ void shared_8_bad(float2* y) {
    __shared__ float s[130];
    s[threadIdx.x] = s[threadIdx.x + 64] = 1.f;
    __syncthreads();
    y[64 * blockIdx.x + threadIdx.x] = *(float2*)(s + threadIdx.x);  // FINDS misaligned
}
extern "C" __global__ void shared_8_good(float2* y) {
    __shared__ __align__(8) float s[130];
    s[threadIdx.x] = s[threadIdx.x + 64] = 1.f;
    __syncthreads();
    y[64 * blockIdx.x + threadIdx.x] = *(float2*)(s + 2 * threadIdx.x);
}
