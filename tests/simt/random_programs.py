"""Seeded generators of programs without races: structured CUDA C++ with barriers and shuffles in uniform flow, and PTX
whose branches go anywhere."""

from __future__ import annotations

import random
from dataclasses import dataclass

INTS = ("a", "b", "c", "d")
FLOATS = ("f", "g", "h")
SLOTS = 8  # output values of each kind per thread


@dataclass(frozen=True)
class Program:
    text: str  # CUDA C++ or PTX; the kernel is called "kernel"
    block: int  # threads per thread block


class CudaWriter:
    """Writes ``kernel(const unsigned* in, const float* fin, unsigned* out, float* fout, unsigned* sums)``.

    Shared memory is touched only in pairs of barriers, other threads' outputs never, and ``sums`` only by atomics
    whose order does not show. Everything that could raise the trip count of a loop is bounded.
    """

    def __init__(self, seed: int) -> None:
        self.rng = random.Random(seed)
        self.block = self.rng.choice((32, 40, 64, 96, 128))
        self.lines: list[str] = []
        self.depth = 1
        self.loops = 0
        self.uses_double = self.rng.random() < 0.3

    def program(self) -> Program:
        for _ in range(self.rng.randint(5, 10)):
            self.uniform_statement()
        body = "\n".join(self.lines)
        text = f"""
__noinline__ __device__ unsigned mix(unsigned x, float y, int n) {{
    for (int k = 0; k < (n & 3); ++k) x = x * 747796405u + (unsigned)(y > 0.5f);
    return x ^ (x >> 7);
}}
__constant__ unsigned table[8] = {{3u, 1u, 4u, 1u, 5u, 9u, 2u, 6u}};
extern "C" __global__ void kernel(const unsigned* in, const float* fin, unsigned* out, float* fout, unsigned* sums) {{
    __shared__ unsigned words[{self.block}];
    __shared__ float reals[{self.block}];
    __shared__ unsigned totals[4];
    const int t = threadIdx.x, i = blockIdx.x * blockDim.x + t;
    unsigned a = in[2 * i], b = in[2 * i + 1], c = t, d = 7;
    float f = fin[2 * i], g = fin[2 * i + 1], h = 0.5f;
    unsigned local[6] = {{1, 2, 3, 4, 5, 6}};
    double wide = f;
{body}
    unsigned* o = out + i * {SLOTS};
    float* p = fout + i * {SLOTS};
    o[5] = a;
    if {self.condition(0)} return;
    o[0] = a; o[1] = b; o[2] = c; o[3] = d; o[4] = local[a % 6]; p[0] = f; p[1] = g; p[2] = h; p[3] = (float)wide;
}}
"""
        return Program(text, self.block)

    # --- expressions ---

    def integer(self, depth: int = 2) -> str:
        pick = self.rng.random()
        if depth == 0 or pick < 0.25:
            return self.rng.choice(
                (*INTS, "(unsigned)t", "table[a & 7]", "local[b % 6]", str(self.rng.randint(0, 99)) + "u")
            )
        x, y = self.integer(depth - 1), self.integer(depth - 1)
        if pick < 0.7:
            return f"({x} {self.rng.choice(('+', '-', '*', '&', '|', '^'))} {y})"
        return self.rng.choice(
            (
                f"({x} / ({y} | 1u))",
                f"({x} % ({y} | 1u))",
                f"({x} << ({y} & 31))",
                f"({x} >> ({y} & 31))",
                f"__popc({x})",
                f"__brev({x})",
                f"min({x}, {y})",
                f"__umulhi({x}, {y})",
                f"(unsigned)((int){x} >> 3)",
                f"({self.condition(depth - 1)} ? {x} : {y})",
                f"(unsigned)(unsigned short)({x} * 3)",
                f"(unsigned)(int)(fminf(fmaxf({self.real(1)}, -1e6f), 1e6f))",
                f"__funnelshift_l({x}, {y}, {self.rng.randint(0, 31)})",
                f"mix({x}, {self.real(1)}, {self.rng.randint(0, 5)})",
                f"(unsigned)(((unsigned long long){x} * {y}) >> {self.rng.randint(0, 40)})",
                f"(unsigned)((long long)(int){x} % (long long)({y} | 1u))",
                f"(unsigned)((signed char){x} + (short){y})",
                f"__byte_perm({x}, {y}, {self.rng.randint(0, 0x7777)})",
            )
        )

    def real(self, depth: int = 2) -> str:
        pick = self.rng.random()
        if depth == 0 or pick < 0.25:
            return self.rng.choice((*FLOATS, f"{self.rng.uniform(-4, 4):.3f}f"))
        x, y = self.real(depth - 1), self.real(depth - 1)
        if pick < 0.6:
            return f"({x} {self.rng.choice(('+', '-', '*'))} {y})"
        return self.rng.choice(
            (
                f"fmaf({x}, {y}, {self.real(depth - 1)})",
                f"({x} / (fabsf({y}) + 1.0f))",
                f"sqrtf(fabsf({x}))",
                f"fminf({x}, {y})",
                f"fmaxf({x}, {y})",
                f"floorf({x})",
                f"(float)(int)({self.integer(1)} & 1023u)",
                f"fin[{self.integer(1)} % 32u]",
                f"({self.condition(depth - 1)} ? {x} : {y})",
                f"copysignf({x}, {y})",
            )
        )

    def condition(self, depth: int = 1) -> str:
        compare = self.rng.choice(("<", "<=", ">", ">=", "==", "!="))
        if self.rng.random() < 0.5:
            simple = f"({self.integer(depth)} & 7u) {compare} {self.rng.randint(0, 7)}u"
        else:
            simple = f"{self.real(depth)} {compare} {self.real(depth)}"
        if depth and self.rng.random() < 0.3:
            return f"(({simple}) {self.rng.choice(('&&', '||'))} ({self.condition(0)}))"
        return f"({simple})"

    # --- statements ---

    def line(self, text: str) -> None:
        self.lines.append("    " * self.depth + text)

    def scope(self, head: str, count: int) -> None:
        self.line(head + " {")
        self.depth += 1
        for _ in range(count):
            self.statement()
        self.depth -= 1

    def statement(self) -> None:
        """One that lanes may run apart: no barriers, no shuffles."""
        pick = self.rng.random()
        few = self.rng.randint(1, 3)
        if self.depth > 4 or pick < 0.45:
            self.assignment()
        elif pick < 0.65:
            self.scope(f"if {self.condition()}", few)
            if self.rng.random() < 0.6:
                self.scope("} else", self.rng.randint(1, 2))
            self.line("}")
        elif pick < 0.8:
            self.loop(few)
        elif pick < 0.86:
            self.line(f"switch ({self.integer(1)} % 6u) {{")
            for case in range(self.rng.randint(2, 5)):
                self.scope(f"case {case}:", 1)
                self.line("}" + (" break;" if self.rng.random() < 0.7 else ""))
            self.line(f"default: d += {self.rng.randint(1, 9)}u; }}")
        elif pick < 0.93:
            self.line(f"atomicAdd(sums + {self.integer(1)} % 16u, {self.integer(1)} & 255u);")
        else:
            self.line(f"local[{self.integer(1)} % 6u] = {self.integer(1)};")

    def assignment(self) -> None:
        if self.uses_double and self.rng.random() < 0.2:
            self.line(f"wide = wide * {self.rng.uniform(-1, 1):.3f} + {self.real(1)} / (1.0 + wide * wide);")
        elif self.rng.random() < 0.5:
            self.line(f"{self.rng.choice(INTS)} {self.rng.choice(('=', '+=', '^='))} {self.integer()};")
        else:
            self.line(f"{self.rng.choice(FLOATS)} = {self.real()};")

    def loop(self, few: int) -> None:
        self.loops += 1
        k = f"k{self.loops}"
        trips = self.rng.choice((f"(int)({self.integer(1)} % 5u)", str(self.rng.randint(1, 4))))
        unroll = "#pragma unroll 1\n" if self.rng.random() < 0.6 else ""
        if unroll:
            self.lines.append(unroll.strip())
        self.line(f"for (int {k} = 0, n{k} = {trips}; {k} < n{k}; ++{k}) {{")
        self.depth += 1
        for number in range(few):
            self.statement()
            if number == 0 and self.rng.random() < 0.4:
                self.line(f"if {self.condition(0)} {self.rng.choice(('break', 'continue'))};")
        self.depth -= 1
        self.line("}")

    def uniform_statement(self) -> None:
        """At top level, where all threads of a block are together."""
        pick = self.rng.random()
        if pick < 0.45:
            self.statement()
        elif pick < 0.6:
            self.exchange()
        elif pick < 0.7:
            self.line(f"#pragma unroll 1\n    for (int u = 0; u < {self.rng.randint(2, 3)}; ++u) {{")
            self.depth += 1
            self.statement()
            self.exchange()
            self.depth -= 1
            self.line("}")
        elif pick < 0.8:
            self.line("if (t < 4) totals[t] = 0;")
            self.line("__syncthreads();")
            self.line(f"if {self.condition(0)} atomicAdd(totals + ({self.integer(1)} & 3u), {self.integer(1)});")
            self.line("__syncthreads();")
            self.line(f"{self.rng.choice(INTS)} += totals[{self.integer(1)} & 3u];")
            self.line("__syncthreads();")
        elif pick < 0.85:
            self.scope(f"if (blockIdx.x {self.rng.choice(('== 1', '!= 1', '< 2'))})", 1)
            self.depth += 1
            self.exchange()
            self.depth -= 1
            self.line("}")
        elif self.block % 32 == 0:
            self.rng.choice((self.warp_operation, self.warp_operation, self.half_warps, self.warp_exchange))()
        else:
            self.assignment()

    def exchange(self) -> None:
        array, value, kind = self.rng.choice((("words", self.integer(1), INTS), ("reals", self.real(1), FLOATS)))
        step, shift = self.rng.choice((1, 3, 5, 7)), self.rng.randint(0, self.block - 1)
        self.line(f"{array}[t] = {value};")
        self.line("__syncthreads();")
        self.line(f"{self.rng.choice(kind)} = {array}[(t * {step} + {shift}) % {self.block}];")
        self.line("__syncthreads();")

    def half_warps(self) -> None:
        """The halves of each warp run other code, then work among themselves."""
        name = self.rng.choice(INTS)
        for head, mask in (("if ((t & 31) < 16)", "0x0000ffffu"), ("} else", "0xffff0000u")):
            self.scope(head, 1)
            operation = self.rng.choice(
                (
                    f"__shfl_xor_sync({mask}, {self.integer(1)}, {self.rng.randint(1, 15)})",
                    f"__ballot_sync({mask}, {self.condition()})",
                    f"__shfl_sync({mask}, {self.integer(1)}, {self.rng.randint(0, 15)}, 16)",
                )
            )
            self.line(f"    {name} += {operation};")
        self.line("}")
        self.line("__syncwarp();")

    def warp_exchange(self) -> None:
        """Through shared memory, among the lanes of one warp only."""
        self.line("__syncthreads();")
        self.line(f"words[t] = {self.integer(1)};")
        self.line("__syncwarp();")
        self.line(f"{self.rng.choice(INTS)} += words[(t & ~31) + ((t * 3 + {self.rng.randint(0, 31)}) & 31)];")
        self.line("__syncthreads();")

    def warp_operation(self) -> None:
        name = self.rng.choice(INTS)
        every = "0xffffffffu"
        self.line(
            self.rng.choice(
                (
                    f"{name} = __shfl_sync({every}, {self.integer(1)}, {self.integer(1)} & 31u);",
                    f"{name} ^= __shfl_xor_sync({every}, {self.integer(1)}, {self.rng.randint(1, 31)});",
                    f"{name} += __shfl_down_sync({every}, {self.integer(1)}, {self.rng.randint(1, 31)}, 16);",
                    f"f = __shfl_up_sync({every}, {self.real(1)}, {self.rng.randint(1, 31)});",
                    f"{name} = __ballot_sync({every}, {self.condition()});",
                    f"if (__any_sync({every}, {self.condition()})) {name} += 3u;",
                    f"{name} += __popc(__activemask());",
                    "__syncwarp();",
                )
            )
        )


def cuda_program(seed: int) -> Program:
    return CudaWriter(seed).program()


# --- PTX with branches to anywhere ------------------------------------------------------------------------------------

REGISTERS = 6

_PTX = """.version 8.8
.target sm_90
.address_size 64
.visible .entry kernel(.param .u64 p0, .param .u64 p1, .param .u64 p2, .param .u64 p3, .param .u64 p4)
{{
.reg .b32 %r<{count}>, %fuel, %i, %n, %b, %t, %k;
.reg .pred %p<4>;
.reg .b64 %in, %out, %sums, %at, %w;
ld.param.u64 %in, [p0];
ld.param.u64 %out, [p2];
ld.param.u64 %sums, [p4];
mov.u32 %t, %tid.x;
mov.u32 %n, %ntid.x;
mov.u32 %b, %ctaid.x;
mad.lo.s32 %i, %b, %n, %t;
mul.wide.u32 %at, %i, 8;
add.s64 %in, %in, %at;
mul.wide.u32 %at, %i, {stride};
add.s64 %out, %out, %at;
ld.global.u32 %r0, [%in];
ld.global.u32 %r1, [%in+4];
mov.u32 %r2, %tid.x;
mov.u32 %r3, 17;
mov.u32 %r4, %laneid;
mov.u32 %r5, 0;
mov.u32 %fuel, {fuel};
setp.eq.u32 %p0, %r0, %r0;
setp.ne.u32 %p1, %r0, %r0;
and.b32 %k, %r1, 3;
setp.gt.u32 %p2, %k, 1;
setp.lt.s32 %p3, %r0, 0;
{body}
END:
st.global.v4.u32 [%out], {{%r0, %r1, %r2, %r3}};
st.global.v2.u32 [%out+16], {{%r4, %r5}};
st.global.u32 [%out+24], %fuel;
ret;
}}
"""


def ptx_program(seed: int) -> Program:
    """Blocks of arithmetic joined by random branches: irreducible loops, branches into loops, tables, early exits.

    Which lanes run together is part of the result (``activemask``), so the order of execution is compared as well. A
    counter of passed blocks ends every program.
    """
    rng = random.Random(seed)
    blocks = rng.randint(4, 9)
    block = rng.choice((32, 45, 64))

    def reg() -> str:
        return f"%r{rng.randrange(REGISTERS)}"

    def predicate() -> str:
        return f"%p{rng.randrange(4)}"

    def operation() -> str:
        guard = f"@{rng.choice(('', '!'))}{predicate()} " if rng.random() < 0.3 else ""
        kind = rng.random()
        if kind < 0.5:
            name = rng.choice(
                ("add.s32", "sub.s32", "mul.lo.s32", "xor.b32", "and.b32", "or.b32", "min.u32", "max.s32")
            )
            return f"{guard}{name} {reg()}, {reg()}, {rng.choice((reg(), str(rng.randint(-50, 5000))))};"
        if kind < 0.6:
            return f"{guard}{rng.choice(('shl.b32', 'shr.u32', 'shr.s32'))} {reg()}, {reg()}, {rng.randint(0, 33)};"
        if kind < 0.75:
            compare = rng.choice(("lt", "gt", "eq", "ne", "le"))
            return f"{guard}setp.{compare}.{rng.choice(('s32', 'u32'))} {predicate()}, {reg()}, {reg()};"
        if kind < 0.82:
            return f"and.b32 %k, {reg()}, {rng.choice((1, 2, 4))};\nsetp.ne.u32 {predicate()}, %k, 0;"
        if kind < 0.88:
            collective = rng.choice(
                (
                    f"mov.b32 {reg()}, %k;",
                    f"vote.sync.ballot.b32 {reg()}, {predicate()}, %k;",
                    f"vote.sync.any.pred {predicate()}, {predicate()}, %k;",
                    f"match.any.sync.b32 {reg()}, {reg()}, %k;",
                    f"redux.sync.add.s32 {reg()}, {reg()}, %k;",
                    "bar.warp.sync %k;",
                )
            )
            return f"activemask.b32 %k;\n{collective}"
        if kind < 0.94:
            place = f"and.b32 %k, {reg()}, 60;\ncvt.u64.u32 %w, %k;\nadd.s64 %w, %sums, %w;\n"
            return f"{place}{guard}red.global.add.u32 [%w], 3;"
        return f"{guard}st.global.u32 [%out+28], {reg()};\nld.global.u32 {reg()}, [%out+28];"

    def ending(number: int) -> str:
        fuel = "add.s32 %fuel, %fuel, -1;\nsetp.lt.s32 %p3, %fuel, 0;\n@%p3 bra END;\n"
        guard = f"@{rng.choice(('', '!'))}%p{rng.randrange(3)} "
        kind = rng.random()
        if kind < 0.55:
            return f"{fuel}{guard}bra B{rng.randrange(blocks)};"
        if kind < 0.65:
            return f"{fuel}bra B{rng.randrange(blocks)};"
        if kind < 0.78:
            targets = ", ".join(f"B{rng.randrange(blocks)}" for _ in range(3))
            table = f"T{number}: .branchtargets {targets};\n"
            return f"{fuel}rem.u32 %k, {reg()}, 3;\n{table}brx.idx %k, T{number};"
        if kind < 0.84:
            return f"{fuel}{guard}exit;"
        return ""  # straight on into a block where others may wait

    body = []
    for number in range(blocks):
        body.append(f"B{number}:")
        body += [operation() for _ in range(rng.randint(1, 5))]
        body.append(ending(number))
    text = _PTX.format(count=REGISTERS, stride=4 * SLOTS, fuel=rng.randint(20, 60), body="\n".join(body))
    return Program(text, block)
