// Accesses outside of an array, of shared memory, of a thread's own memory. FINDS marks the lines of a defect.
extern "C" __global__ void write_4_bad(float* x, int n) {
    int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i <= n) x[i] = 1.f;  // FINDS out-of-bounds
}
extern "C" __global__ void write_4_good(float* x, int n) {
    int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i < n) x[i] = 1.f;
}
extern "C" __global__ void read_8_bad(double* x, double* y, int n) {
    int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i < n) y[i] = x[i - 1];  // FINDS out-of-bounds
}
extern "C" __global__ void read_8_good(double* x, double* y, int n) {
    int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i < n) y[i] = x[max(i - 1, 0)];
}
extern "C" __global__ void read_16_bad(float4* x, float4* y, int n) {
    int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i < n) y[i] = x[i + 1];  // FINDS out-of-bounds
}
extern "C" __global__ void read_16_good(float4* x, float4* y, int n) {
    int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i < n) y[i] = x[min(i + 1, n - 1)];
}
extern "C" __global__ void loop_bad(int* x, int n) {
    int sum = 0;
    for (int i = threadIdx.x; i <= n; i += blockDim.x) sum += x[i];  // FINDS out-of-bounds
    if (sum == 12345 && blockIdx.x == 0 && threadIdx.x == 0) x[0] = sum;
}
extern "C" __global__ void loop_good(int* x, int n) {
    int sum = 0;
    for (int i = threadIdx.x; i < n; i += blockDim.x) sum += x[i];
    if (sum == 12345 && blockIdx.x == 0 && threadIdx.x == 0) x[0] = sum;
}
extern "C" __global__ void atomic_4_bad(float* x, int n) {
    atomicAdd(x + n - threadIdx.x, 1.f);  // FINDS out-of-bounds
}
extern "C" __global__ void atomic_4_good(float* x, int n) {
    atomicAdd(x + n - 1 - threadIdx.x, 1.f);
}
extern "C" __global__ void shared_4_bad(float* x) {
    extern __shared__ float s[];
    s[threadIdx.x + 1] = 1.f;  // FINDS out-of-bounds
    __syncthreads();
    if (blockIdx.x == 0) x[threadIdx.x] = s[max(int(threadIdx.x), 1)];
}
extern "C" __global__ void shared_4_good(float* x) {
    extern __shared__ float s[];
    s[threadIdx.x] = 1.f;
    __syncthreads();
    if (blockIdx.x == 0) x[threadIdx.x] = s[max(int(threadIdx.x), 1)];
}
extern "C" __global__ void shared_16_bad(float4* x) {
    __shared__ float4 s[64];
    s[threadIdx.x] = make_float4(1, 2, 3, 4);
    __syncthreads();
    if (blockIdx.x == 0) x[threadIdx.x] = s[64 - threadIdx.x];  // FINDS out-of-bounds
}
extern "C" __global__ void shared_16_good(float4* x) {
    __shared__ float4 s[64];
    s[threadIdx.x] = make_float4(1, 2, 3, 4);
    __syncthreads();
    if (blockIdx.x == 0) x[threadIdx.x] = s[63 - threadIdx.x];
}
extern "C" __global__ void local_4_bad(int* x, int n) {
    int a[8];
    for (int i = 0; i < 8; ++i) a[i] = i * n;
    a[(threadIdx.x + n) % 9] = 5;  // FINDS out-of-bounds
    if (blockIdx.x == 0) x[threadIdx.x] = a[(threadIdx.x + x[0]) % 8];
}
extern "C" __global__ void local_4_good(int* x, int n) {
    int a[8];
    for (int i = 0; i < 8; ++i) a[i] = i * n;
    a[(threadIdx.x + n) % 8] = 5;
    if (blockIdx.x == 0) x[threadIdx.x] = a[(threadIdx.x + n) % 8];
}
