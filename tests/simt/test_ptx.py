"""The front end: statements, operands, declarations, inlining, source lines, basic blocks and liveness."""

from __future__ import annotations

import corpus_kernels as corpus
import numpy as np
import pytest

from mpmbench.errors import InputError
from mpmbench.simt import numpy_exec, nvrtc, ptx
from mpmbench.simt.counters import SourceLine
from mpmbench.simt.flow import basic_blocks
from mpmbench.simt.ptx import CARRY, Address, Imm, NotReg, Reg, Special, Symbol, Vector

REGISTERS = ".reg .pred %p<4>; .reg .b16 %rs<4>; .reg .b32 %r<9>; .reg .f32 %f<9>; .reg .b64 %rd<9>; .reg .f64 %fd<4>;"


def parse(body: str, before: str = "", params: str = ".param .u64 k_param_0") -> ptx.Kernel:
    text = f".version 8.8\n.target sm_75\n.address_size 64\n{before}\n.visible .entry k({params})\n{{\n{REGISTERS}\n"
    return ptx.parse(f"{text}{body}\n}}\n").kernels["k"]


def one(statement: str, before: str = "") -> ptx.Instruction:
    (item,) = parse(statement, before).instructions
    return item


def r(number: int) -> Reg:
    return Reg(f"%r{number}", "b32")


def rd(number: int) -> Reg:
    return Reg(f"%rd{number}", "b64")


P1, P2 = Reg("%p1", "pred"), Reg("%p2", "pred")


# --- operands ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("statement", "dsts", "srcs"),
    [
        ("add.s32 %r1, %r2, -7;", (r(1),), (r(2), Imm(-7))),
        ("and.b32 %r1, %r2, 0xFF;", (r(1),), (r(2), Imm(255))),
        ("mov.u32 %r1, %tid.x;", (r(1),), (Special("%tid.x"),)),
        ("mov.u32 %r1, %lanemask_lt;", (r(1),), (Special("%lanemask_lt"),)),
        ("mov.f32 %f1, 0f3F800000;", (Reg("%f1", "f32"),), (Imm(0x3F800000, 32),)),
        ("mov.f64 %fd1, 0dBFF0000000000000;", (Reg("%fd1", "f64"),), (Imm(0xBFF0000000000000, 64),)),
        ("ld.global.u32 %r1, [%rd1+8];", (r(1),), (Address(rd(1), 8),)),
        ("ld.global.u32 %r1, [%rd1+-8];", (r(1),), (Address(rd(1), -8),)),
        ("ld.global.u32 %r1, [%rd1];", (r(1),), (Address(rd(1)),)),
        ("ld.param.u64 %rd1, [k_param_0+4];", (rd(1),), (Address(Symbol("k_param_0", "param"), 4),)),
        ("st.shared.u32 [64], %r1;", (), (Address(Imm(64)), r(1))),
        ("ld.global.v4.u32 {%r1, %r2, _, %r4}, [%rd1];", (r(1), r(2), None, r(4)), (Address(rd(1)),)),
        ("st.global.v2.u32 [%rd1], {%r1, 5};", (), (Address(rd(1)), Vector((r(1), Imm(5))))),
        ("mov.b64 {%r1, %r2}, %rd1;", (r(1), r(2)), (rd(1),)),
        ("mov.b64 %rd1, {%r1, %r2};", (rd(1),), (Vector((r(1), r(2))),)),
        ("atom.global.add.u32 _, [%rd1], %r1;", (None,), (Address(rd(1)), r(1))),
        ("red.global.add.u32 [%rd1], %r1;", (), (Address(rd(1)), r(1))),
        ("shfl.sync.up.b32 %r1|%p1, %r2, 1, 0, -1;", (r(1), P1), (r(2), Imm(1), Imm(0), Imm(-1))),
        ("setp.lt.and.s32 %p1|%p2, %r1, %r2, !%p3;", (P1, P2), (r(1), r(2), NotReg(Reg("%p3", "pred")))),
        ("bar.sync 0;", (), (Imm(0),)),
        ("bar.red.popc.u32 %r1, 0, %p1;", (r(1),), (Imm(0), P1)),
        ("bar.red.and.pred %p1, 0, !%p1;", (P1,), (Imm(0), NotReg(P1))),
        ("add.cc.u32 %r1, %r2, %r3;", (r(1), CARRY), (r(2), r(3))),
        ("madc.hi.cc.u32 %r1, %r2, %r3, %r4;", (r(1), CARRY), (r(2), r(3), r(4), CARRY)),
        ("subc.u32 %r1, %r2, 0;", (r(1),), (r(2), Imm(0), CARRY)),
        ("add.s32\t%r1,\t%r2, %r3;", (r(1),), (r(2), r(3))),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)  # fmt: skip
def test_operands(statement, dsts, srcs):
    item = one(statement)
    assert item.dsts == dsts
    assert item.srcs == srcs


def test_guards():
    item = one("@!%p1 add.s32 %r1, %r2, %r3;")
    assert (item.guard, item.negated) == (P1, True)
    assert set(item.reads()) == {P1, r(2), r(3)}
    assert set(item.writes()) == {r(1)}
    assert one("@%p1 bar.sync 0;").negated is False


def test_statements_may_share_a_line_or_span_several():
    kernel = parse(
        "add.s32 %r1,\n %r2,\n %r3; add.s32 %r2, %r1, 1;\n// mov.u32 %r3, 1;\n/* st.global\n;*/ LOOP: bra\n LOOP;"
    )
    assert [item.opcode for item in kernel.instructions] == ["add.s32", "add.s32", "bra"]
    assert kernel.labels == {"LOOP": 2}


def test_registers_of_an_inner_scope_are_its_own():
    kernel = parse("{\n.reg .b32 tmp;\nmov.u32 tmp, 1;\n}\n{\n.reg .b32 tmp;\nmov.u32 tmp, 2;\n}\nret;")
    first, second = (item.dsts[0] for item in kernel.instructions[:2])
    assert first != second


def test_an_undeclared_register_or_symbol_is_refused():
    with pytest.raises(InputError, match=r"register %x at .* is not declared"):
        parse("mov.u32 %x, 1;")
    with pytest.raises(InputError, match="unknown symbol nowhere"):
        parse("mov.u64 %rd1, nowhere;")


# --- declarations -----------------------------------------------------------------------------------------------------


def test_parameters_are_aligned():
    kernel = parse(
        "ret;",
        params=".param .u32 k_param_0, .param .u64 k_param_1, .param .align 8 .b8 k_param_2[13], .param .u16 k_param_3",
    )
    assert [(p.offset, p.size) for p in kernel.params] == [(0, 4), (8, 8), (16, 13), (30, 2)]
    assert kernel.param_bytes == 32


def test_shared_memory_lies_in_order_and_dynamic_memory_after_it():
    before = ".shared .align 4 .b8 first[6];\n.shared .align 16 .b8 second[32];\n.extern .shared .align 16 .b8 more[];"
    body = "mov.u64 %rd1, first; mov.u64 %rd2, second; mov.u64 %rd3, more; st.shared.u32 [more+4], %r1;"
    kernel = parse(body, before)
    offsets = [item.srcs[0].offset for item in kernel.instructions[:3]]
    assert offsets[0] == 0
    assert offsets[1] == 16
    assert offsets[2] == kernel.shared_bytes == 48
    assert kernel.instructions[3].srcs[0] == Address(Symbol("more", "shared", 48), 4)


def test_initial_values_of_module_variables():
    text = """.version 8.8
.target sm_75
.address_size 64
.global .align 4 .u32 plain;
.const .align 4 .b8 bytes[6] = {1, 2, 255};
.global .align 8 .f64 halves[2] = {0d3FE0000000000000, 0d4000000000000000};
.const .align 2 .u16 words[3] = {1, 65535, 3};
.global .align 4 .f32 one = 0f3F800000;
"""
    variables = ptx.parse(text).variables
    assert variables["plain"].initial == bytes(4)
    assert variables["bytes"].initial == b"\x01\x02\xff\0\0\0"
    assert np.frombuffer(variables["halves"].initial, "f8").tolist() == [0.5, 2.0]
    assert np.frombuffer(variables["words"].initial, "u2").tolist() == [1, 65535, 3]
    assert np.frombuffer(variables["one"].initial, "f4").tolist() == [1.0]
    assert (variables["words"].space, variables["words"].align, variables["words"].size) == ("const", 2, 6)


def test_branch_tables():
    kernel = parse("T: .branchtargets A, B, A;\nbrx.idx %r1, T;\nA: ret;\nB: exit;")
    assert kernel.instructions[0].targets == ("A", "B", "A")
    assert [block.successors for block in basic_blocks(kernel)] == [(1, 2, 1), (), ()]


# --- functions --------------------------------------------------------------------------------------------------------


def run(body: str, *args, threads: int = 32, arch: str = "sm_75", **options) -> numpy_exec.Result:
    text = nvrtc.compile_cuda(body, arch, corpus.OPTIONS, name="kernel.cu")
    module = ptx.parse(text)
    return numpy_exec.run(module.kernels["kernel"], module, (1,), (threads,), args, **options)


def test_a_function_called_twice_keeps_its_registers_and_arrays_apart():
    out = np.zeros(32, "i4")
    run("""__noinline__ __device__ int pick(int seed, int at) {
               int kept[4]; for (int k = 0; k < 4; ++k) kept[k] = seed * (k + 1); return kept[at & 3]; }
           __noinline__ __device__ int both(int a, int b) { return pick(a, b) * 1000 + pick(b, a); }
           extern "C" __global__ void kernel(int* out) {
               int t = threadIdx.x; out[t] = both(t, t + 1) + pick(t, 2); }""",
        out)  # fmt: skip
    t = np.arange(32)

    def pick(seed, at):
        return seed * ((at & 3) + 1)

    np.testing.assert_array_equal(out, pick(t, t + 1) * 1000 + pick(t + 1, t) + pick(t, 2))


def test_a_shared_variable_is_one_place_for_a_kernel_and_its_functions():
    out = np.zeros(32, "i4")
    run("""__shared__ int other[5]; __shared__ int common[32];
           __noinline__ __device__ int read(int at) { return common[at & 31]; }
           extern "C" __global__ void kernel(int* out) {
               int t = threadIdx.x; if (t < 5) other[t] = -1;
               common[t] = 10 * t; __syncthreads(); out[t] = read(t + 1) + other[t % 5] * 0; }""", out)  # fmt: skip
    np.testing.assert_array_equal(out, 10 * ((np.arange(32) + 1) % 32))


def test_structures_pass_through_functions():
    out = np.zeros(32)
    run("""struct Mixed { char tag; short count; float4 vector; double sum; };
           __noinline__ __device__ Mixed step(Mixed m, bool odd) {
               m.sum += m.vector.x * m.count + m.tag; if (odd) { m.tag += 1; m.vector.x = m.vector.w; } return m; }
           extern "C" __global__ void kernel(double* out) {
               int t = threadIdx.x; Mixed m = {(char)(t - 5), (short)(-t), make_float4(t, 1, 2, 0.5f), 1.0};
               m = step(m, t & 1); m = step(m, false); out[t] = m.sum; }""", out)  # fmt: skip
    for t in range(32):
        total, tag, x = 1.0, t - 5, float(t)
        total += x * -t + tag
        if t & 1:
            tag, x = tag + 1, 0.5
        total += x * -t + tag
        assert out[t] == total


def test_functions_return_from_the_middle_for_some_lanes_only():
    out = np.zeros(32, "i4")
    run("""__noinline__ __device__ int f(int x) {
               if (x < 4) return 1; for (int k = 0; k < x; ++k) if (k * k > x) return k;
               return -1; }
           extern "C" __global__ void kernel(int* out) {
               int t = threadIdx.x; if (t != 9) out[t] = f(t); }""", out)  # fmt: skip

    def f(x):
        return 1 if x < 4 else next((k for k in range(x) if k * k > x), -1)

    np.testing.assert_array_equal(out, [0 if t == 9 else f(t) for t in range(32)])


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("__noinline__ __device__ int f(int n) { return n < 2 ? n : f(n - 1) * f(n - 2) + n; }\n"
         'extern "C" __global__ void kernel(int* x) { x[0] = f(x[1]); }', "recursive call"),
        ('extern "C" __global__ void kernel(int* x) { printf("%d", x[0]); }', "no body"),
        ("__noinline__ __device__ int f(int n) { return n + 1; }\n"
         "__noinline__ __device__ int g(int n) { return n * n; }\n"
         'extern "C" __global__ void kernel(int* x) { int (*h)(int) = x[1] ? f : g; x[0] = h(x[2]); }',
         "function .* is taken"),
    ],
)  # fmt: skip
def test_calls_that_cannot_be_inlined_are_refused(body, message):
    with pytest.raises(InputError, match=message):
        run(body, np.zeros(4, "i4"))


# --- source lines -----------------------------------------------------------------------------------------------------


def test_lines_are_those_of_the_innermost_inlined_function():
    body = """__device__ float inner(float x) {
    return __fmul_rn(x, 3.0f);
}
extern "C" __global__ void kernel(float* x) {
    x[threadIdx.x] = __fadd_rn(inner(x[threadIdx.x]), 1.0f);
}"""
    text = nvrtc.compile_cuda(body, "sm_75", corpus.OPTIONS, name="kernel.cu")
    items = ptx.parse(text).kernels["kernel"].instructions
    (product,) = (item for item in items if item.root == "mul" and "f32" in item.modifiers)
    (total,) = (item for item in items if item.root == "add" and "f32" in item.modifiers)
    assert product.line is not None
    assert product.line.line == 2
    assert total.line is not None
    assert total.line.line == 5
    assert product.line.file.endswith("kernel.cu")


def test_line_zero_belongs_to_the_line_before():
    body = (
        ".loc 1 7 3\nadd.s32 %r1, %r2, %r3;\n.loc 1 0 0\nadd.s32 %r2, %r2, %r3;\n"
        ".loc 1 9 1, function_name x, inlined_at 1 3 1\nret;"
    )
    text = f'.version 8.8\n.target sm_75\n.entry k()\n{{\n{REGISTERS}\n{body}\n}}\n.file 1 "a.cu"\n'
    items = ptx.parse(text).kernels["k"].instructions
    assert [item.line for item in items] == [SourceLine("a.cu", 7), SourceLine("a.cu", 7), SourceLine("a.cu", 9)]


# --- control flow -----------------------------------------------------------------------------------------------------


def test_blocks_end_at_branches_and_begin_at_labels():
    kernel = parse(
        "mov.u32 %r1, 0;\nL: add.s32 %r1, %r1, 1;\nsetp.lt.s32 %p1, %r1, 9;\n@%p1 bra L;\n"
        "bra END;\nmov.u32 %r2, 1;\nEND: ret;"
    )
    blocks = basic_blocks(kernel)
    assert [(b.start, b.stop) for b in blocks] == [(0, 1), (1, 4), (4, 5), (5, 6), (6, 7)]
    assert [b.successors for b in blocks] == [(1,), (1, 2), (4,), (4,), ()]


def test_blocks_end_and_begin_where_the_caller_asks():
    kernel = parse("mov.u32 %r1, 0;\nbar.sync 0;\nmov.u32 %r2, 1;\nret;")

    def is_barrier(item):
        return item.root == "bar"

    assert [(b.start, b.stop) for b in basic_blocks(kernel, is_barrier)] == [(0, 2), (2, 4)]
    assert [(b.start, b.stop) for b in basic_blocks(kernel, starts_block=is_barrier)] == [(0, 1), (1, 4)]


def test_guarded_exits_fall_through():
    kernel = parse("@%p1 exit;\nmov.u32 %r1, 1;\nret;")
    assert [b.successors for b in basic_blocks(kernel)] == [(1,), ()]


def test_liveness_around_a_loop():
    kernel = parse(
        "mov.u32 %r1, 0;\nmov.u32 %r2, 5;\nL: add.s32 %r1, %r1, %r2;\nsetp.lt.s32 %p1, %r1, 9;\n"
        "@%p1 bra L;\nst.global.u32 [%rd1], %r1;\nret;"
    )
    entry, loop, end = basic_blocks(kernel)
    assert entry.live_in == {rd(1)}
    assert loop.live_in == {r(1), r(2), rd(1)}
    assert loop.live_out == {r(1), r(2), rd(1)}
    assert end.live_in == {r(1), rd(1)}


def test_a_guarded_write_keeps_the_old_value_alive():
    kernel = parse("@%p1 mov.u32 %r1, 3;\nbra NEXT;\nNEXT: st.global.u32 [%rd1], %r1;\nret;")
    first, second = basic_blocks(kernel)
    assert first.live_in == {P1, r(1), rd(1)}
    assert second.live_in == {r(1), rd(1)}


def test_a_carry_is_alive_between_the_words_of_a_sum():
    kernel = parse(
        "add.cc.u32 %r1, %r2, %r3;\nbra NEXT;\nNEXT: addc.u32 %r4, %r5, %r6;\nst.global.u32 [%rd1], %r4;\nret;"
    )
    first, second = basic_blocks(kernel)
    assert CARRY in first.live_out
    assert CARRY in second.live_in


def test_the_whole_corpus_parses_and_knows_its_lines():
    for arch in corpus.ARCHS:
        for stem in corpus.FILES:
            for kernel in corpus.module(stem, arch).kernels.values():
                # What a compiler adds without a line of its own is a small part.
                unknown = sum(item.line is None for item in kernel.instructions)
                assert unknown < 0.2 * len(kernel.instructions), kernel.name
