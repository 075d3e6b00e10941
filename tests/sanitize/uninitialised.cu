// Reads of memory that nobody has written: shared, global, a thread's own.
#define I (64 * blockIdx.x + threadIdx.x)
extern "C" __global__ void shared_4_bad(float* out) {
    __shared__ float s[64];
    if (threadIdx.x < 60) s[threadIdx.x] = 1.f;
    __syncthreads();
    out[I] = s[threadIdx.x];  // FINDS uninitialised
}
extern "C" __global__ void shared_4_good(float* out) {
    __shared__ float s[64];
    s[threadIdx.x] = 1.f;
    __syncthreads();
    out[I] = s[threadIdx.x];
}
extern "C" __global__ void shared_8_bad(double* out) {
    __shared__ double s[64];
    if (threadIdx.x % 32) s[threadIdx.x] = 1.0;
    __syncthreads();
    out[I] = s[threadIdx.x ^ 32];  // FINDS uninitialised
}
extern "C" __global__ void shared_8_good(double* out) {
    __shared__ double s[64];
    s[threadIdx.x] = 1.0;
    __syncthreads();
    out[I] = s[threadIdx.x ^ 32];
}
extern "C" __global__ void shared_16_bad(float4* out) {
    __shared__ float4 s[64];
    s[threadIdx.x].x = s[threadIdx.x].y = s[threadIdx.x].z = 1.f;
    __syncthreads();
    out[I] = s[threadIdx.x];  // FINDS uninitialised
}
extern "C" __global__ void shared_16_good(float4* out) {
    __shared__ float4 s[64];
    s[threadIdx.x] = make_float4(1.f, 1.f, 1.f, 0.f);
    __syncthreads();
    out[I] = s[threadIdx.x];
}
extern "C" __global__ void shared_loop_bad(int* out, int n) {
    __shared__ int s[64];
    int sum = 0;
    for (int i = 0; i < n; ++i) {
        sum += s[(threadIdx.x + i) % 64];  // FINDS uninitialised
        __syncthreads();
        s[threadIdx.x] = i;
        __syncthreads();
    }
    out[I] = sum;
}
extern "C" __global__ void shared_loop_good(int* out, int n) {
    __shared__ int s[64];
    int sum = 0;
    s[threadIdx.x] = 0;
    __syncthreads();
    for (int i = 0; i < n; ++i) {
        sum += s[(threadIdx.x + i) % 64];
        __syncthreads();
        s[threadIdx.x] = i;
        __syncthreads();
    }
    out[I] = sum;
}
extern "C" __global__ void global_4_bad(float* fresh4, float* out) {
    if (threadIdx.x < 60) fresh4[I] = 1.f;
    out[I] = fresh4[I];  // FINDS uninitialised
}
extern "C" __global__ void global_4_good(float* clean4, float* out) {
    clean4[I] = 1.f;
    out[I] = clean4[I];
}
extern "C" __global__ void global_8_bad(double* fresh8, double* out) {
    out[I] = fresh8[I];  // FINDS uninitialised
}
extern "C" __global__ void global_8_good(double* clean8, double* out) {
    clean8[I] = 1.0;
    out[I] = clean8[I];
}
extern "C" __global__ void global_16_bad(float* fresh16, float4* out) {
    fresh16[4 * I] = fresh16[4 * I + 1] = fresh16[4 * I + 2] = 1.f;
    out[I] = ((float4*)fresh16)[I];  // FINDS uninitialised
}
extern "C" __global__ void global_16_good(float* clean16, float4* out) {
    ((float4*)clean16)[I] = make_float4(1, 2, 3, 4);
    out[I] = ((float4*)clean16)[I];
}
extern "C" __global__ void sum_bad(float* fresh_sum) { atomicAdd(fresh_sum, 1.f); }  // FINDS uninitialised
extern "C" __global__ void sum_good(float* cleared_sum) { atomicAdd(cleared_sum, 1.f); }
extern "C" __global__ void clear_good(float* cleared_sum) {
    if (I == 0) *cleared_sum = 0.f;
}
extern "C" __global__ void local_4_bad(int* out, int n) {
    int a[16];
    for (int i = 0; i < n; ++i) a[(i + threadIdx.x) % 16] = i;
    out[I] = a[(threadIdx.x + 3) % 16];  // FINDS uninitialised
}
extern "C" __global__ void local_4_good(int* out, int n) {
    int a[16];
    for (int i = 0; i < n; ++i) a[(i + threadIdx.x) % 16] = i;
    out[I] = a[(threadIdx.x + 2) % 16];
}
extern "C" __global__ void local_8_bad(double* out, int n) {
    double a[16];
    for (int i = 0; i < n; ++i) a[(i + threadIdx.x) % 16] = i;
    out[I] = a[(threadIdx.x + n) % 16];  // FINDS uninitialised
}
extern "C" __global__ void local_8_good(double* out, int n) {
    double a[16];
    for (int i = 0; i < n; ++i) a[(i + threadIdx.x) % 16] = i;
    out[I] = a[(threadIdx.x + n - 1) % 16];
}
extern "C" __global__ void local_16_bad(float4* out, int n) {
    float4 a[16];
    for (int i = 0; i < n; ++i) a[(i + threadIdx.x) % 16] = make_float4(i, i, i, i);
    out[I] = a[(threadIdx.x + n) % 16];  // FINDS uninitialised
}
extern "C" __global__ void local_16_good(float4* out, int n) {
    float4 a[16];
    for (int i = 0; i < n; ++i) a[(i + threadIdx.x) % 16] = make_float4(i, i, i, i);
    out[I] = a[(threadIdx.x + n - 1) % 16];
}
