// double: arithmetic in all roundings, and the library's functions.
#include "corpus.cuh"

KERNEL(float64_rounded) {
    int i = thread_index();
    double a = din[3 * i], b = din[3 * i + 1], c = din[3 * i + 2], *o = dout + i * ROOM;
    o[0] = __dadd_rn(a, b); o[1] = __dadd_rz(a, b); o[2] = __dadd_ru(a, b); o[3] = __dadd_rd(a, b);
    o[4] = __dsub_rn(a, b); o[5] = __dsub_rz(a, b); o[6] = __dsub_ru(a, b); o[7] = __dsub_rd(a, b);
    o[8] = __dmul_rn(a, b); o[9] = __dmul_rz(a, b); o[10] = __dmul_ru(a, b); o[11] = __dmul_rd(a, b);
    o[12] = __fma_rn(a, b, c); o[13] = __fma_rz(a, b, c); o[14] = __fma_ru(a, b, c); o[15] = __fma_rd(a, b, c);
    o[16] = __ddiv_rn(a, b); o[17] = __ddiv_rz(a, b); o[18] = __ddiv_ru(a, b); o[19] = __ddiv_rd(a, b);
    o[20] = __drcp_rn(a); o[21] = __drcp_rz(a); o[22] = __drcp_ru(a); o[23] = __drcp_rd(a);
    o[24] = __dsqrt_rn(a); o[25] = __dsqrt_rz(a); o[26] = __dsqrt_ru(a); o[27] = __dsqrt_rd(a);
}

KERNEL(float64_plain) {
    int i = thread_index();
    double a = din[3 * i], b = din[3 * i + 1], c = din[3 * i + 2], *o = dout + i * ROOM;
    o[0] = a + b; o[1] = a - b; o[2] = a * b; o[3] = a / b; o[4] = a * b + c; o[5] = sqrt(a); o[6] = fabs(a);
    o[7] = -a; o[8] = fmin(a, b); o[9] = fmax(a, b); o[10] = copysign(a, b); o[11] = floor(a); o[12] = ceil(a);
    o[13] = trunc(a); o[14] = rint(a); o[15] = round(a); o[16] = fmod(a, b); o[17] = a < b ? a : c;
    o[18] = a >= b ? c : b; o[19] = !(a <= b) ? a : c; o[20] = !(a > b) ? b : c; o[21] = a == b ? a : 1.0;
    o[22] = a != b ? c : 2.0; o[23] = __hiloint2double(__double2loint(a), __double2hiint(b));
    o[24] = __longlong_as_double(__double_as_longlong(a) ^ 1); o[25] = modf(a, &o[26]); o[27] = scalbn(a, 5);
    uout[i * ROOM] = (u64)isnan(a) | (u64)isinf(a) << 1 | (u64)isfinite(a) << 2 | (u64)signbit(a) << 3;
}

KERNEL(approx_float64_math) {
    int i = thread_index();
    double a = din[3 * i], b = din[3 * i + 1], *o = dout + i * ROOM;
    o[0] = exp(a); o[1] = log(a); o[2] = log2(a); o[3] = log10(a); o[4] = sin(a); o[5] = cos(a); o[6] = pow(a, b);
    o[7] = exp2(a); o[8] = rsqrt(a); o[9] = tanh(a); o[10] = atan2(a, b); o[11] = cbrt(a); o[12] = erf(a);
    o[13] = asin(a); o[14] = acos(a); o[15] = tan(a); o[16] = hypot(a, b); o[17] = expm1(a); o[18] = log1p(a);
    double r;
    asm("rcp.approx.ftz.f64 %0, %1;" : "=d"(r) : "d"(a)); o[19] = r;
    asm("rsqrt.approx.ftz.f64 %0, %1;" : "=d"(r) : "d"(a)); o[20] = r;
}
