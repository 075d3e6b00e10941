// Integers of 8, 16, 32 and 64 bits: arithmetic, division, comparison, bit operations.
#include "corpus.cuh"

template <class T> __device__ void arithmetic(T a, T b, T c, u64* o) {
    o[0] = (T)(a + b); o[1] = (T)(a - b); o[2] = (T)(a * b); o[3] = (T)(a / b); o[4] = (T)(a % b);
    o[5] = (T)(a * b + c); o[6] = (T)(a & b); o[7] = (T)(a | b); o[8] = (T)(a ^ b); o[9] = (T)~a;
    o[10] = (T)(a << (b & 7)); o[11] = (T)(a >> (b & 7)); o[12] = a < b ? a : b; o[13] = a > b ? a : b;
    o[14] = (a == b) | (a != c) << 1 | (a <= b) << 2 | (a >= c) << 3 | (a < c) << 4 | (b > c) << 5; o[15] = (T)-a;
    o[16] = (T)(a < 0 ? -a : a); o[17] = !a; o[18] = (T)(a / 7); o[19] = (T)(a % 10); o[20] = (a && b) || c;
}

KERNEL(integers_8) {
    int i = thread_index();
    const u8* p = (const u8*)(uin + 3 * i);
    arithmetic<u8>(p[0], p[1] | 1, p[2], uout + i * ROOM);
    const signed char* q = (const signed char*)p;
    fout[i * ROOM] = (float)(q[3] + q[4] * q[5]);
    ((u8*)dout)[i * 8] = p[6] + p[7];
}
KERNEL(integers_s8) {
    int i = thread_index();
    const signed char* p = (const signed char*)(uin + 3 * i);
    arithmetic<signed char>(p[0], p[1] | 1, p[2], uout + i * ROOM);
}
KERNEL(integers_u16) {
    int i = thread_index();
    const u16* p = (const u16*)(uin + 3 * i);
    arithmetic<u16>(p[0], p[1] | 1, p[2], uout + i * ROOM);
}
KERNEL(integers_s16) {
    int i = thread_index();
    const short* p = (const short*)(uin + 3 * i);
    arithmetic<short>(p[0], p[1] | 1, p[2], uout + i * ROOM);
}
KERNEL(integers_u32) {
    int i = thread_index();
    const u32* p = (const u32*)(uin + 3 * i);
    arithmetic<u32>(p[0], p[1] | 1, p[2], uout + i * ROOM);
}
KERNEL(integers_s32) {
    int i = thread_index();
    const int* p = (const int*)(uin + 3 * i);
    arithmetic<int>(p[0], p[1] | 1, p[2], uout + i * ROOM);
}
KERNEL(integers_u64) {
    int i = thread_index();
    arithmetic<u64>(uin[3 * i], uin[3 * i + 1] | 1, uin[3 * i + 2], uout + i * ROOM);
}
KERNEL(integers_s64) {
    int i = thread_index();
    const s64* p = (const s64*)uin + 3 * i;
    arithmetic<s64>(p[0], p[1] | 1, p[2], uout + i * ROOM);
}

KERNEL(integers_wide) {
    int i = thread_index();
    u64 a = uin[3 * i], b = uin[3 * i + 1], c = uin[3 * i + 2], *o = uout + i * ROOM;
    u32 x = (u32)a, y = (u32)b, z = (u32)c;
    o[0] = (u64)x * y; o[1] = (s64)(int)x * (int)y; o[2] = (u64)x * y + c; o[3] = (s64)(int)x * (int)y + (s64)c;
    o[4] = __umulhi(x, y); o[5] = __mulhi((int)x, (int)y); o[6] = __umul64hi(a, b); o[7] = __mul64hi((s64)a, (s64)b);
    o[8] = __umul24(x, y); o[9] = __mul24((int)x, (int)y); o[10] = __sad((int)x, (int)y, z); o[11] = __usad(x, y, z);
    o[12] = __hadd((int)x, (int)y); o[13] = __urhadd(x, y); o[14] = abs((int)x); o[15] = llabs((s64)a);
    o[16] = (u32)((u16)x * (u16)y); o[17] = (int)((short)x * (short)y); o[18] = min(a, b); o[19] = max((s64)a, (s64)b);
    o[20] = min((int)x, (int)y); o[21] = max(x, y); o[22] = x % (y | 1); o[23] = a % (b | 1); o[24] = (u16)x * (u16)y + z;
    u32 r;
    asm("mad.hi.u32 %0, %1, %2, %3;" : "=r"(r) : "r"(x), "r"(y), "r"(z)); o[25] = r;
    asm("mad.hi.s32 %0, %1, %2, %3;" : "=r"(r) : "r"(x), "r"(y), "r"(z)); o[26] = r;
    asm("add.sat.s32 %0, %1, %2;" : "=r"(r) : "r"(x), "r"(y)); o[27] = r;
    asm("sub.sat.s32 %0, %1, %2;" : "=r"(r) : "r"(x), "r"(y)); o[28] = r;
    asm("mul24.hi.u32 %0, %1, %2;" : "=r"(r) : "r"(x), "r"(y)); o[29] = r;
    asm("mad24.lo.s32 %0, %1, %2, %3;" : "=r"(r) : "r"(x), "r"(y), "r"(z)); o[30] = r;
    asm("slct.u32.s32 %0, %1, %2, %3;" : "=r"(r) : "r"(x), "r"(y), "r"(z)); o[31] = r;
}

KERNEL(integers_bits) {
    int i = thread_index();
    u64 a = uin[3 * i], b = uin[3 * i + 1], c = uin[3 * i + 2], *o = uout + i * ROOM;
    u32 x = (u32)a, y = (u32)b, z = (u32)c;
    o[0] = __brev(x); o[1] = __brevll(a); o[2] = __popc(x); o[3] = __popcll(a); o[4] = __clz(x); o[5] = __clzll(a);
    o[6] = __ffs(x); o[7] = __ffsll(a); o[8] = __byte_perm(x, y, z); o[9] = __funnelshift_l(x, y, z);
    o[10] = __funnelshift_r(x, y, z); o[11] = __funnelshift_lc(x, y, z); o[12] = __funnelshift_rc(x, y, z);
    o[13] = (x & y) | (~x & z); o[14] = x ^ y ^ z; o[15] = x << (y & 63); o[16] = (int)x >> (y & 31);
    o[17] = a << (b & 63); o[18] = a >> (b & 63); o[19] = (s64)a >> (b & 63); o[20] = (x >> 5) & 0x3f;
    o[21] = (u64)y << 32 | x; o[22] = (u32)(a >> 32); o[23] = x << 13 | x >> 19;
    u32 r;
    asm("bfe.u32 %0, %1, %2, %3;" : "=r"(r) : "r"(x), "r"(y), "r"(z)); o[24] = r;
    asm("bfe.s32 %0, %1, %2, %3;" : "=r"(r) : "r"(x), "r"(y), "r"(z)); o[25] = r;
    asm("bfi.b32 %0, %1, %2, %3, %4;" : "=r"(r) : "r"(x), "r"(y), "r"(z), "r"(z >> 8)); o[26] = r;
    asm("bfind.u32 %0, %1;" : "=r"(r) : "r"(x)); o[27] = r;
    asm("bfind.shiftamt.s32 %0, %1;" : "=r"(r) : "r"(x)); o[28] = r;
    asm("cnot.b32 %0, %1;" : "=r"(r) : "r"(x)); o[29] = r;
    asm("lop3.b32 %0, %1, %2, %3, 0x96;" : "=r"(r) : "r"(x), "r"(y), "r"(z)); o[30] = r;
    asm("set.lt.u32.s32 %0, %1, %2;" : "=r"(r) : "r"(x), "r"(y)); o[31] = r;
}
KERNEL(integers_bits_64) {
    int i = thread_index();
    u64 a = uin[3 * i], b = uin[3 * i + 1], *o = uout + i * ROOM, r;
    u32 y = (u32)b, z = (u32)(b >> 32), w;
    asm("bfe.u64 %0, %1, %2, %3;" : "=l"(r) : "l"(a), "r"(y), "r"(z)); o[0] = r;
    asm("bfe.s64 %0, %1, %2, %3;" : "=l"(r) : "l"(a), "r"(y), "r"(z)); o[1] = r;
    asm("bfi.b64 %0, %1, %2, %3, %4;" : "=l"(r) : "l"(a), "l"(b), "r"(y), "r"(z)); o[2] = r;
    asm("bfind.u64 %0, %1;" : "=r"(w) : "l"(a)); o[3] = w;
    asm("bfind.s64 %0, %1;" : "=r"(w) : "l"(a)); o[4] = w;
    asm("prmt.b32.f4e %0, %1, %2, %3;" : "=r"(w) : "r"((u32)a), "r"(y), "r"(z)); o[5] = w;
    asm("prmt.b32.rc16 %0, %1, %2, %3;" : "=r"(w) : "r"((u32)a), "r"(y), "r"(z)); o[6] = w;
    asm("set.gt.f32.f32 %0, %1, %2;" : "=r"(w) : "f"(fin[3 * i]), "f"(fin[3 * i + 1])); o[7] = w;
    asm("fns.b32 %0, %1, %2, %3;" : "=r"(w) : "r"((u32)a), "r"(y & 31), "r"((int)(z & 15) - 8)); o[8] = w;
    asm("mul.hi.u16 %0, %1, %2;" : "=h"(((u16*)(o + 9))[0]) : "h"((u16)a), "h"((u16)b));
    asm("mul.wide.u16 %0, %1, %2;" : "=r"(w) : "h"((u16)a), "h"((u16)b)); o[10] = w;
    asm("mad.wide.s16 %0, %1, %2, %3;" : "=r"(w) : "h"((u16)a), "h"((u16)b), "r"(z)); o[11] = w;
}
