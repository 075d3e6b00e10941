// float: arithmetic in all roundings, minimum and maximum, classification, rounding to whole numbers.
#include "corpus.cuh"

KERNEL(float32_rounded) {
    int i = thread_index();
    float a = fin[3 * i], b = fin[3 * i + 1], c = fin[3 * i + 2], *o = fout + i * ROOM;
    o[0] = __fadd_rn(a, b); o[1] = __fadd_rz(a, b); o[2] = __fadd_ru(a, b); o[3] = __fadd_rd(a, b);
    o[4] = __fsub_rn(a, b); o[5] = __fsub_rz(a, b); o[6] = __fsub_ru(a, b); o[7] = __fsub_rd(a, b);
    o[8] = __fmul_rn(a, b); o[9] = __fmul_rz(a, b); o[10] = __fmul_ru(a, b); o[11] = __fmul_rd(a, b);
    o[12] = __fmaf_rn(a, b, c); o[13] = __fmaf_rz(a, b, c); o[14] = __fmaf_ru(a, b, c); o[15] = __fmaf_rd(a, b, c);
    o[16] = __fdiv_rn(a, b); o[17] = __fdiv_rz(a, b); o[18] = __fdiv_ru(a, b); o[19] = __fdiv_rd(a, b);
    o[20] = __frcp_rn(a); o[21] = __frcp_rz(a); o[22] = __frcp_ru(a); o[23] = __frcp_rd(a);
    o[24] = __fsqrt_rn(a); o[25] = __fsqrt_rz(a); o[26] = __fsqrt_ru(a); o[27] = __fsqrt_rd(a);
    o[28] = __saturatef(a); o[29] = __saturatef(a * b + c); o[30] = __saturatef(a + b); o[31] = __saturatef(a * b);
}

KERNEL(float32_plain) {
    int i = thread_index();
    float a = fin[3 * i], b = fin[3 * i + 1], c = fin[3 * i + 2], *o = fout + i * ROOM;
    o[0] = a + b; o[1] = a - b; o[2] = a * b; o[3] = a / b; o[4] = a * b + c; o[5] = sqrtf(a); o[6] = fabsf(a);
    o[7] = -a; o[8] = fminf(a, b); o[9] = fmaxf(a, b); o[10] = copysignf(a, b); o[11] = floorf(a); o[12] = ceilf(a);
    o[13] = truncf(a); o[14] = rintf(a); o[15] = nearbyintf(a); o[16] = roundf(a); o[17] = fmodf(a, b);
    o[18] = fdimf(a, b); o[19] = fminf(fmaxf(a, 0.0f), 1.0f); o[20] = remainderf(a, b); o[21] = a < b ? a : c;
    o[22] = a >= b ? c : b; o[23] = !(a <= b) ? a : c; o[24] = !(a > b) ? b : c; o[25] = a == b ? a : 1.0f;
    o[26] = a != b ? c : 2.0f; o[27] = ldexpf(a, 3); o[28] = __int_as_float(__float_as_int(a) & 0x7fffffff);
    int exponent;
    o[29] = frexpf(a, &exponent);
    o[30] = (float)exponent;
    o[31] = hypotf(a, b);
    u64 bits = 0;
    bits |= (u64)isnan(a) | (u64)isinf(a) << 1 | (u64)isfinite(a) << 2 | (u64)signbit(a) << 3;
    bits |= (u64)(a < b && b < c) << 4 | (u64)(a < b || b > c) << 5 | (u64)((a <= b) != (b >= c)) << 6;
    bits |= (u64)(a != a || b != b) << 7 | (u64)!(a < b) << 8 | (u64)(a >= b && !(b > c)) << 9;
    uout[i * ROOM] = bits;
}

KERNEL(approx_float32_fast) {
    int i = thread_index();
    float a = fin[3 * i], b = fin[3 * i + 1], *o = fout + i * ROOM;
    o[0] = __expf(a); o[1] = __logf(a); o[2] = __log2f(a); o[3] = __log10f(a); o[4] = __sinf(a); o[5] = __cosf(a);
    o[6] = __tanf(a); o[7] = __powf(a, b); o[8] = __fdividef(a, b); o[9] = rsqrtf(a); o[10] = __frsqrt_rn(a);
    o[11] = exp2f(a); o[12] = __exp10f(a); float s, c; __sincosf(a, &s, &c); o[13] = s; o[14] = c;
    float r;
    asm("rcp.approx.f32 %0, %1;" : "=f"(r) : "f"(a)); o[15] = r;
    asm("sqrt.approx.f32 %0, %1;" : "=f"(r) : "f"(a)); o[16] = r;
    asm("div.full.f32 %0, %1, %2;" : "=f"(r) : "f"(a), "f"(b)); o[17] = r;
}

KERNEL(approx_float32_math) {
    int i = thread_index();
    float a = fin[3 * i], b = fin[3 * i + 1], *o = fout + i * ROOM;
    o[0] = expf(a); o[1] = logf(a); o[2] = log2f(a); o[3] = log10f(a); o[4] = sinf(a); o[5] = cosf(a);
    o[6] = tanf(a); o[7] = powf(a, b); o[8] = expm1f(a); o[9] = log1pf(a); o[10] = sinhf(a); o[11] = coshf(a);
    o[12] = tanhf(a); o[13] = asinf(a); o[14] = acosf(a); o[15] = atanf(a); o[16] = atan2f(a, b); o[17] = cbrtf(a);
    o[18] = erff(a); o[19] = sinpif(a); o[20] = cospif(a); o[21] = exp10f(a); o[22] = rnorm3df(a, b, 1.0f);
}
