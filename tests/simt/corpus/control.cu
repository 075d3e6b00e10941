// Control flow and memory: switches, loops, calls, local arrays, structures by value, constant and global variables.
#include "corpus.cuh"

struct Small { int a; float b; };
struct Large { double weights[5]; Small parts[3]; unsigned char tag; };

__constant__ float table[16] = {1, 2, 4, 8, 16, 32, 64, 128, -1, -2, -4, -8, 0.5f, 0.25f, 0.125f, 3};
__constant__ short steps[7] = {3, -1, 4, 1, -5, 9, 2};
__device__ u32 counter[4] = {10, 20, 30, 40};
__device__ double factors[3] = {0.5, 2.0, -1.25};

__noinline__ __device__ float polynomial(float x, int degree) {
    float sum = 0.0f;
    for (int k = 0; k <= degree; ++k) sum = sum * x + table[k & 15];
    return sum;
}
__noinline__ __device__ Small combine(Small s, int by) {
    s.a += by;
    s.b *= 2.0f;
    return s;
}
__noinline__ __device__ double total(const double* values, int count) {
    double sum = 0.0;
    for (int k = 0; k < count; ++k) sum += values[k];
    return sum;
}
__noinline__ __device__ void swap_if(bool condition, u64& a, u64& b) {
    if (condition) { u64 c = a; a = b; b = c; }
}

KERNEL(control_switch) {
    int i = thread_index();
    u64 a = uin[3 * i], *o = uout + i * ROOM;
    u64 r;
    switch ((u32)a % 11) {
        case 0: r = a * 3; break;
        case 1: r = a ^ 0x55; break;
        case 2: r = a >> 3;  // falls through
        case 3: r = a + 17; break;
        case 4: r = __popcll(a); break;
        case 5: r = a / 5; break;
        case 7: r = a << 2; break;
        case 8: r = ~a; break;
        case 9: r = a & 0xff00; break;
        default: r = 99;
    }
    o[0] = r;
    switch ((int)(a & 0xf0)) {
        case 0x10: o[1] = 5; break;
        case 0x70: o[1] = 6; break;
        case 0xf0: o[1] = 7; break;
        default: o[1] = 8;
    }
}

KERNEL(control_loops) {
    int i = thread_index();
    u32 a = (u32)uin[3 * i] & 0xffff;
    u64* o = uout + i * ROOM;
    int trips = 0;
    for (u32 n = a | 1; n != 1 && trips < 40; ++trips) n = n & 1 ? 3 * n + 1 : n / 2;
    o[0] = trips;
    u32 sum = 0;
    for (u32 k = 0; k < (a & 15); ++k) {
        if (k == 7) continue;
        for (u32 j = k; j < 12; ++j) {
            sum += k * j;
            if (sum > 300) goto done;
        }
    }
done:
    o[1] = sum;
    if (a & 1) {
        if (a & 2) o[2] = 1; else if (a & 4) o[2] = 2; else o[2] = 3;
        if (a & 8) return;
        o[3] = 4;
    }
    do { sum -= a & 7; } while (sum > 50 && sum < 400 && (a & 7));
    o[4] = sum;
}

KERNEL(control_calls) {
    int i = thread_index();
    float f = fin[3 * i];
    int n = (int)(uin[3 * i] & 7);
    fout[i * ROOM] = polynomial(f, n);
    if (n > 3) fout[i * ROOM + 1] = polynomial(-f, 3);
    Small s = {n, f};
    s = combine(s, 5);
    if (n & 1) s = combine(s, -n);
    uout[i * ROOM] = (u32)s.a;
    fout[i * ROOM + 2] = s.b;
    double values[6];
    for (int k = 0; k < 6; ++k) values[k] = din[3 * i] * k;
    dout[i * ROOM] = total(values, n % 6 + 1);
    u64 a = uin[3 * i], b = uin[3 * i + 1];
    swap_if(a > b, a, b);
    uout[i * ROOM + 1] = a;
    uout[i * ROOM + 2] = b;
}

KERNEL(control_local_arrays) {
    int i = thread_index();
    float stack[12];
    u8 bytes[16];
    u32 a = (u32)uin[3 * i];
    for (int k = 0; k < 12; ++k) stack[k] = fin[3 * i] + k;
    for (int k = 0; k < 16; ++k) bytes[k] = a >> k;
    for (int k = 0; k < 5; ++k) {  // indices known at run time only
        int p = (a >> k) % 12, q = (a >> (k + 5)) % 12;
        float t = stack[p]; stack[p] = stack[q]; stack[q] = t;
        bytes[p] += bytes[q];
    }
    for (int k = 0; k < 12; ++k) fout[i * ROOM + k] = stack[k];
    for (int k = 0; k < 16; ++k) uout[i * ROOM + k] = bytes[k];
    s64 wide[4] = {1, 2, 3, 4};
    wide[a & 3] = (s64)uin[3 * i + 1];
    uout[i * ROOM + 16] = wide[(a >> 2) & 3];
}

KERNEL(control_variables) {
    int i = thread_index();
    u32 a = (u32)uin[3 * i];
    fout[i * ROOM] = table[a & 15] + steps[a % 7];
    dout[i * ROOM] = factors[a % 3] * 3.0;
    atomicAdd(&counter[a & 3], 1u);
    const float* either = (a & 16) ? table : fin;  // generic: constant or global memory
    fout[i * ROOM + 1] = either[a & 7] == either[a & 7] ? either[a & 7] : 0.0f;
}

KERNEL(control_memory) {
    extern __shared__ float4 dynamic[];
    __shared__ u8 bytes[64];
    __shared__ double2 pairs[64];
    int i = thread_index(), t = threadIdx.x;
    const float4* v = (const float4*)fin;
    const float2* w = (const float2*)fin;
    float4 a = __ldg(v + (i >> 1));
    float2 b = __ldcs(w + i);
    dynamic[t] = a;
    if (t < 64) { bytes[t] = (u8)(i * 7); pairs[t] = make_double2(din[i], din[i + 1]); }
    __syncthreads();
    a = dynamic[blockDim.x - 1 - t];
    double2 d = pairs[t & 63];
    dout[i * ROOM + 2] = pairs[t & 1].x + pairs[(t & 3) * 5].y;  // broadcasts of 8 and 16 bytes
    double2 same = pairs[t >> 5 & 1];
    dout[i * ROOM + 3] = same.x * same.y;
    ((float4*)(fout + i * ROOM))[0] = make_float4(a.w, a.z, b.x, b.y);
    ((double2*)(dout + i * ROOM))[0] = make_double2(d.y, d.x);
    ((uchar4*)(uout + i * ROOM))[0] = make_uchar4(bytes[t & 63], bytes[0], 1, 2);
    ((short2*)(uout + i * ROOM + 1))[0] = make_short2((short)i, -3);
    ((ulonglong2*)(uout + i * ROOM + 2))[0] = ((const ulonglong2*)uin)[i];
    ((uint2*)(uout + i * ROOM + 4))[0] = __ldg((const uint2*)uin + i);
    volatile float* f = fout + i * ROOM + 8;
    *f = a.x;
    *f = *f + 1.0f;
    __syncthreads();
    volatile u8* byte = bytes;
    if (t == 0) byte[3] = 9;
    const float* somewhere = (i & 1) ? (const float*)dynamic : fin;  // generic: shared or global memory
    fout[i * ROOM + 12] = somewhere[t & 3];
    __stcs(fout + i * ROOM + 13, b.y);
    __stcg(fout + i * ROOM + 14, b.x);
    uout[i * ROOM + 6] = blockDim.x + gridDim.x * 1000 + blockIdx.y + threadIdx.y + threadIdx.z + gridDim.y * 7;
}

extern "C" __global__ void control_structures(Large large, Small small, const float* fin, double* dout, u64* uout) {
    int i = thread_index();
    double sum = large.tag;
    for (int k = 0; k < 5; ++k) sum += large.weights[k] * (k + i);
    dout[i] = sum + large.weights[i % 5] + large.parts[i % 3].b + small.b + fin[i];
    uout[i] = large.parts[2].a * small.a + large.parts[i % 3].a;
}
