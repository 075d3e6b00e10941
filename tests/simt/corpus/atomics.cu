// Atomics on global and shared memory. What the order of lanes decides (old values) is left out of the outputs.
#include "corpus.cuh"

template <class T> __device__ u64 distinct(T* place, int i) {  // one lane per place: even old values are determined
    return (u64)atomicAdd(&place[i], (T)3);
}

KERNEL(atomics_global_integer) {
    int i = thread_index(), t = threadIdx.x;
    u64 a = uin[3 * i];
    u32 x = (u32)a;
    u64* o = uout + (i - t) * ROOM;
    u32* w = (u32*)(o + 20);
    atomicAdd(w + (t & 3), x); atomicSub(w + 4 + (t & 1), x); atomicMin((int*)w + 6, (int)x); atomicMax((int*)w + 7, (int)x);
    atomicMin(w + 8, x); atomicMax(w + 9, x); atomicAnd(w + 10, x); atomicOr(w + 11, x); atomicXor(w + 12, x);
    atomicInc(w + 13, 17); atomicDec(w + 14, 11);
    atomicAdd(o + 40, a); atomicMin(o + 41, a); atomicMax(o + 42, a); atomicAnd(o + 43, a); atomicOr(o + 44, a);
    atomicXor(o + 45, a); atomicMin((s64*)o + 46, (s64)a); atomicMax((s64*)o + 47, (s64)a);
    o[48 + t] = atomicExch(o + 200 + t, a) + atomicExch(w + 200 + 2 * t + 400, x);
    o[400 + t] = atomicCAS(o + 600 + t, 0ull, a) + distinct<u64>(o + 600, t) + distinct<u32>((u32*)o + 1600, t);
    u32 old = atomicOr(w + 16, 0), seen;
    do { seen = old; old = atomicCAS(w + 16, seen, seen + (x & 255)); } while (old != seen);
}

KERNEL(atomics_shared_integer) {
    __shared__ u32 w[32];
    __shared__ u64 v[32];
    int i = thread_index(), t = threadIdx.x;
    u64 a = uin[3 * i];
    u32 x = (u32)a;
    if (t < 32) { w[t] = 7 * t; v[t] = 9 * t; }
    __syncthreads();
    atomicAdd(w + (t & 3), x); atomicSub(w + 4 + (t & 1), x); atomicMin((int*)w + 6, (int)x); atomicMax((int*)w + 7, (int)x);
    atomicMin(w + 8, x); atomicMax(w + 9, x); atomicAnd(w + 10, x); atomicOr(w + 11, x); atomicXor(w + 12, x);
    atomicInc(w + 13, 17); atomicDec(w + 14, 11); atomicExch(w + 15, 5u);
    atomicAdd(v, a); atomicMin(v + 1, a); atomicMax(v + 2, a); atomicAnd(v + 3, a); atomicOr(v + 4, a);
    atomicXor(v + 5, a); atomicMin((s64*)v + 6, (s64)a); atomicMax((s64*)v + 7, (s64)a);
    atomicCAS(v + 8, 72ull, 1ull); atomicCAS(w + 16, 112u, 2u); atomicExch(v + 9, 3ull);
    u32 old = atomicOr(w + 17, 0), seen;
    do { seen = old; old = atomicCAS(w + 17, seen, seen + (x & 255)); } while (old != seen);
    __syncthreads();
    if (t < 32) { uout[i * ROOM] = w[t]; uout[i * ROOM + 1] = v[t]; }
}

__device__ void add_f64(double* place, double value) {  // the compare-and-swap form for architectures before sm_60
    u64* bits = (u64*)place;
    u64 old = atomicCAS(bits, 0, 0), seen;
    do {
        seen = old;
        old = atomicCAS(bits, seen, __double_as_longlong(value + __longlong_as_double(seen)));
    } while (old != seen);
}

KERNEL(atomics_float) {
    __shared__ float s[32];
    __shared__ double d[8];
    int i = thread_index(), t = threadIdx.x;
    float a = (float)(int)(uin[3 * i] & 1023) * 0.25f;  // sums are exact, so their order does not matter
    if (t < 32) s[t] = 0.0f;
    if (t < 8) d[t] = 0.0;
    __syncthreads();
    float* f = fout + (i - t) * ROOM;
    double* g = dout + (i - t) * ROOM;
    atomicAdd(f + (t & 7), a);
    fout[(i - t) * ROOM + 64 + t] = atomicAdd(f + 256 + t, a);
    atomicAdd(s + (t & 7), a);
    atomicExch(s + 8 + (t & 7), 2.0f);
    add_f64(g + (t & 3), a);
    add_f64(d + (t & 3), a);
#if __CUDA_ARCH__ >= 600
    atomicAdd(g + 8 + (t & 3), (double)a);
    atomicAdd(d + 4 + (t & 3), (double)a);
#endif
    __syncthreads();
    if (t < 32) fout[(i - t) * ROOM + 600 + t] = s[t & 15];
    if (t < 8) dout[(i - t) * ROOM + 600 + t] = d[t];
}

#if __CUDA_ARCH__ >= 700
KERNEL(atomics_half_words) {
    int i = thread_index(), t = threadIdx.x;
    u16* h = (u16*)(uout + (i - t) * ROOM);
    const u16 none = 0;
    u16 old = atomicCAS(h + (t & 7), none, none), seen;
    do { seen = old; old = atomicCAS(h + (t & 7), seen, (u16)(seen + 1)); } while (old != seen);
    __shared__ u16 w[16];
    if (t < 16) w[t] = 0;
    __syncthreads();
    old = atomicCAS(w + (t & 3), none, none);
    do { seen = old; old = atomicCAS(w + (t & 3), seen, (u16)(seen + 1)); } while (old != seen);
    __syncthreads();
    if (t < 4) h[100 + t] = w[t];
}
#endif

#if __CUDA_ARCH__ >= 900
KERNEL(atomics_vectors) {
    int i = thread_index(), t = threadIdx.x;
    float4* f = (float4*)(fout + (i - t) * ROOM);
    float a = (float)(int)(uin[3 * i] & 1023);
    atomicAdd(f + (t & 7), make_float4(a, 2 * a, 3.0f, -a));
    atomicAdd((float2*)(f + 16) + (t & 3), make_float2(a, 1.0f));
}
#endif
