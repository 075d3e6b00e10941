// Conversions between all widths and kinds, in all roundings, with saturation, and reinterpretation of bits.
#include "corpus.cuh"

KERNEL(conversions_from_float32) {
    int i = thread_index();
    float a = fin[3 * i];
    u64* o = uout + i * ROOM;
    o[0] = (u64)(s64)__float2int_rn(a); o[1] = (u64)(s64)__float2int_rz(a); o[2] = (u64)(s64)__float2int_ru(a);
    o[3] = (u64)(s64)__float2int_rd(a); o[4] = __float2uint_rn(a); o[5] = __float2uint_rz(a); o[6] = __float2uint_ru(a);
    o[7] = __float2uint_rd(a); o[8] = __float2ll_rn(a); o[9] = __float2ll_rz(a); o[10] = __float2ll_ru(a);
    o[11] = __float2ll_rd(a); o[12] = __float2ull_rn(a); o[13] = __float2ull_rz(a); o[14] = __float2ull_ru(a);
    o[15] = __float2ull_rd(a); o[16] = (u8)a; o[17] = (u64)(s64)(signed char)a; o[18] = (u16)a;
    o[19] = (u64)(s64)(short)a; o[20] = __float_as_uint(a); o[21] = (u64)(s64)(int)a; o[22] = (u32)a;
    o[23] = (u64)lrintf(a); o[24] = (u64)llroundf(a);
    dout[i * ROOM] = a;
}
KERNEL(conversions_from_float64) {
    int i = thread_index();
    double a = din[3 * i];
    u64* o = uout + i * ROOM;
    float* f = fout + i * ROOM;
    o[0] = (u64)(s64)__double2int_rn(a); o[1] = (u64)(s64)__double2int_rz(a); o[2] = (u64)(s64)__double2int_ru(a);
    o[3] = (u64)(s64)__double2int_rd(a); o[4] = __double2uint_rn(a); o[5] = __double2uint_rz(a);
    o[6] = __double2uint_ru(a); o[7] = __double2uint_rd(a); o[8] = __double2ll_rn(a); o[9] = __double2ll_rz(a);
    o[10] = __double2ll_ru(a); o[11] = __double2ll_rd(a); o[12] = __double2ull_rn(a); o[13] = __double2ull_rz(a);
    o[14] = __double2ull_ru(a); o[15] = __double2ull_rd(a); o[16] = __double_as_longlong(a);
    o[17] = __double2hiint(a); o[18] = __double2loint(a); o[19] = (u16)a; o[20] = (u64)(s64)(short)a;
    f[0] = __double2float_rn(a); f[1] = __double2float_rz(a); f[2] = __double2float_ru(a); f[3] = __double2float_rd(a);
    f[4] = (float)a;
}
KERNEL(conversions_from_integers) {
    int i = thread_index();
    u64 a = uin[3 * i], *o = uout + i * ROOM;
    u32 x = (u32)a;
    float* f = fout + i * ROOM;
    double* d = dout + i * ROOM;
    f[0] = __int2float_rn(x); f[1] = __int2float_rz(x); f[2] = __int2float_ru(x); f[3] = __int2float_rd(x);
    f[4] = __uint2float_rn(x); f[5] = __uint2float_rz(x); f[6] = __uint2float_ru(x); f[7] = __uint2float_rd(x);
    f[8] = __ll2float_rn(a); f[9] = __ll2float_rz(a); f[10] = __ll2float_ru(a); f[11] = __ll2float_rd(a);
    f[12] = __ull2float_rn(a); f[13] = __ull2float_rz(a); f[14] = __ull2float_ru(a); f[15] = __ull2float_rd(a);
    f[16] = (u8)a; f[17] = (signed char)a; f[18] = (u16)a; f[19] = (short)a; f[20] = __uint_as_float(x);
    d[0] = __int2double_rn(x); d[1] = __uint2double_rn(x); d[2] = __ll2double_rn(a); d[3] = __ll2double_rz(a);
    d[4] = __ll2double_ru(a); d[5] = __ll2double_rd(a); d[6] = __ull2double_rn(a); d[7] = __ull2double_rz(a);
    d[8] = __ull2double_ru(a); d[9] = __ull2double_rd(a); d[10] = (short)a; d[11] = (u8)a;
    d[12] = __longlong_as_double(a);
    o[0] = (u64)(s64)(signed char)a; o[1] = (u8)a; o[2] = (u64)(s64)(short)a; o[3] = (u16)a; o[4] = (u64)(s64)(int)a;
    o[5] = (u32)(int)(short)a; o[6] = (u16)(short)(signed char)a; o[7] = (u64)(short)(u8)(a >> 9);
    u32 r;
    u16 h;
    asm("cvt.sat.s8.s32 %0, %1;" : "=r"(r) : "r"(x)); o[8] = r;
    asm("cvt.sat.u8.s32 %0, %1;" : "=r"(r) : "r"(x)); o[9] = r;
    asm("cvt.sat.s16.s32 %0, %1;" : "=h"(h) : "r"(x)); o[10] = h;
    asm("cvt.sat.u16.u32 %0, %1;" : "=h"(h) : "r"(x)); o[11] = h;
    asm("cvt.sat.u32.s64 %0, %1;" : "=r"(r) : "l"(a)); o[12] = r;
    asm("cvt.sat.s32.s64 %0, %1;" : "=r"(r) : "l"(a)); o[13] = r;
}
