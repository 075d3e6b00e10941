"""The NumPy executor held to plain NumPy, Python integers and exact fractions, and its counters to patterns that can
be counted by hand."""

from __future__ import annotations

from fractions import Fraction

import corpus_kernels as corpus
import numpy as np
import pytest

from mpmbench.errors import InputError
from mpmbench.simt import numpy_exec, numpy_ops, numpy_rounding, nvrtc, ptx
from mpmbench.simt.counters import Tally

THREADS = 128


def run_corpus(stem: str, name: str, arch: str = "sm_75", tame: bool = False, **options):
    """-> inputs (threads, ...) and outputs (threads, ROOM) of a corpus kernel, by the oracle."""
    module = corpus.module(stem, arch)
    arrays = corpus.arguments(THREADS, tame=tame)
    result = numpy_exec.run(module.kernels[name], module, (2,), (THREADS // 2,), arrays, **options)
    assert result.findings == ()
    inputs = [a[: 3 * THREADS].reshape(THREADS, 3) for a in arrays[:3]]
    outputs = [a[: corpus.ROOM * THREADS].reshape(THREADS, corpus.ROOM) for a in arrays[3:]]
    return inputs, outputs


def run_cuda(body: str, grid: int, block: int, *args, arch: str = "sm_75", shared_bytes: int = 0, **options):
    """Run ``kernel``, given in CUDA C++, by the oracle."""
    text = nvrtc.compile_cuda(body, arch, corpus.OPTIONS, name="kernel.cu")
    module = ptx.parse(text)
    return numpy_exec.run(module.kernels["kernel"], module, (grid,), (block,), args, shared_bytes, **options)


# --- arithmetic -------------------------------------------------------------------------------------------------------


def exact(compute, dtype, mode, *operands) -> float:
    return numpy_rounding._round(compute(*(Fraction(float(x)) for x in operands)), np.dtype(dtype), mode)


@pytest.mark.parametrize("mode", ["rn", "rz", "rm", "rp"])
@pytest.mark.parametrize("dtype", ["f4", "f8"])
def test_rounded_arithmetic_agrees_with_exact_fractions(dtype, mode):
    rng = np.random.default_rng(5)
    spread = 30 if dtype == "f4" else 200
    a, b, c = ((rng.normal(size=400) * 2.0 ** rng.integers(-spread, spread, 400)).astype(dtype) for _ in range(3))
    c[:200] = -(a * b)[:200]  # cancellation: what a fused multiply-add is for
    cases = {
        "add": (lambda x, y: x + y, (a, b)),
        "mul": (lambda x, y: x * y, (a, b)),
        "fma": (lambda x, y, z: x * y + z, (a, b, c)),
        "div": (lambda x, y: x / y, (a, b)),
    }
    for name, (compute, operands) in cases.items():
        got = getattr(numpy_rounding, name)(*operands, mode)
        want = [exact(compute, dtype, mode, *lane) for lane in zip(*operands, strict=True)]
        np.testing.assert_array_equal(got, np.array(want, dtype), err_msg=f"{name}.{mode}")


def test_square_root_in_all_roundings_encloses_the_root():
    a = np.random.default_rng(6).uniform(1e-30, 1e30, 200).astype("f4")
    down, up, nearest = (numpy_rounding.sqrt(a, mode).astype("f8") for mode in ("rm", "rp", "rn"))
    exact_squares = a.astype("f8")
    assert np.all(down**2 <= exact_squares)
    assert np.all(up**2 >= exact_squares)
    assert np.all((nearest == down) | (nearest == up))
    np.testing.assert_array_equal(numpy_rounding.sqrt(a, "rz"), down.astype("f4"))
    np.testing.assert_array_equal(up.astype("f4"), np.nextafter(down.astype("f4"), np.float32(np.inf)))


def test_sums_that_cancel_are_minus_zero_only_when_rounding_down():
    x, y = np.float32([1, 0, -0.0, 0]), np.float32([-1, -0.0, -0.0, 0])
    for wide in (np.float32, np.float64):
        for mode in ("rn", "rz", "rp"):
            got = numpy_rounding.add(x.astype(wide), y.astype(wide), mode)
            assert np.signbit(got).tolist() == [False, False, True, False]
        assert np.signbit(numpy_rounding.add(x.astype(wide), y.astype(wide), "rm")).tolist() == [
            True,
            True,
            True,
            False,
        ]
        one = np.ones(4, wide)
        fused = numpy_rounding.fma(x.astype(wide), one, y.astype(wide), "rm")
        assert np.signbit(fused).tolist() == [True, True, True, False]


def lanes(opcode: str, *operands, dsts: int = 1):
    """Apply one opcode to short lists of Python numbers."""
    regs = tuple(ptx.Reg(f"%d{i}", "b32") for i in range(dsts))
    op = numpy_ops.lane_op(ptx.Instruction(opcode, regs))
    arrays = [np.array(x, numpy_ops.DTYPES[kind]) for x, kind in zip(operands, op.sources, strict=True)]
    result = op.apply(*arrays)
    return [r.tolist() for r in result] if isinstance(result, tuple) else result.tolist()


NAN = float("nan")
INF = float("inf")


@pytest.mark.parametrize(
    ("opcode", "operands", "expected"),
    [
        ("min.f32", ([NAN, 1.0, -0.0, 0.0], [2.0, NAN, 0.0, -0.0]), [2.0, 1.0, -0.0, -0.0]),
        ("max.f32", ([NAN, 1.0, -0.0, 0.0], [2.0, NAN, 0.0, -0.0]), [2.0, 1.0, 0.0, 0.0]),
        ("max.NaN.f32", ([NAN, 1.0], [2.0, 3.0]), [NAN, 3.0]),
        ("cvt.rni.s32.f32", ([0.5, 1.5, 2.5, -0.5, 3e9, -3e9, NAN],), [0, 2, 2, 0, 2**31 - 1, -(2**31), 0]),
        ("cvt.rzi.u32.f32", ([-1.0, 1.9, 5e9, INF, -INF],), [0, 1, 2**32 - 1, 2**32 - 1, 0]),
        ("cvt.rzi.s64.f32", ([NAN, 1e30],), [-(2**63), 2**63 - 1]),
        ("cvt.rzi.s32.f64", ([NAN, -1e300],), [-(2**31), -(2**31)]),
        ("cvt.rmi.ftz.s32.f32", ([-1e-40, -0.5],), [0, -1]),
        ("cvt.rzi.u8.f32", ([300.0, -5.0, 7.7],), [255, 0, 7]),
        ("cvt.sat.s8.s32", ([300, -300, 5],), [127, -128, 5]),
        ("cvt.sat.u32.s64", ([-1, 2**40],), [0, 2**32 - 1]),
        ("cvt.rz.f32.u32", ([2**32 - 1, 2**24 + 1],), [4294967040.0, 16777216.0]),
        ("cvt.rp.f32.s32", ([2**24 + 1, -(2**24) - 1],), [16777218.0, -16777216.0]),
        ("div.s32", ([-(2**31), 7, -7, 5], [-1, -2, 2, 0]), [-(2**31), -3, -3, -1]),
        ("rem.s32", ([-(2**31), 7, -7, 5], [-1, -2, 2, 0]), [0, 1, -1, -1]),
        ("div.u64", ([5, 2**64 - 1], [0, 10]), [2**64 - 1, (2**64 - 1) // 10]),
        ("shl.b32", ([1, 1, 1], [31, 32, 2**32 - 1]), [2**31, 0, 0]),
        ("shr.s32", ([-8, -8, 8], [1, 40, 40]), [-4, -1, 0]),
        ("shr.u16", ([0x8000, 0x8000], [15, 16]), [1, 0]),
        ("shf.l.wrap.b32", ([1, 1], [2, 2], [4, 36]), [32, 32]),
        ("shf.r.clamp.b32", ([1, 1], [2, 2], [32, 50]), [2, 2]),
        ("bfe.u32", ([0xABCD1234, 0xABCD1234, 5], [8, 28, 40], [8, 16, 3]), [0x12, 0xA, 0]),
        ("bfe.s32", ([0x80000000, 0xF0, 0xF0], [31, 4, 4], [1, 4, 0]), [2**32 - 1, 2**32 - 1, 0]),
        ("bfi.b32", ([0xFF, 0xFF, 0xFF], [0, 0, 7], [4, 28, 32], [4, 8, 4]), [0xF0, 0xF0000000, 7]),
        ("prmt.b32", ([0x04030201] * 2, [0x88070605] * 2, [0x7531, 0x000F]), [0x88060402, 0x010101FF]),
        ("prmt.b32.ecr", ([0x04030201], [0x08070605], [1]), [0x02020201]),
        ("mad.hi.s32", ([-1], [1], [5]), [4]),
        ("mul.hi.u64", ([2**64 - 1], [2**64 - 1]), [2**64 - 2]),
        ("mul.wide.s32", ([-(2**31)], [-(2**31)]), [2**62]),
        ("mad.wide.u16", ([0xFFFF], [0xFFFF], [2**32 - 1]), [(0xFFFF * 0xFFFF - 1) % 2**32]),
        ("mul24.lo.s32", ([0x800000], [2]), [-(2**24)]),
        ("add.sat.s32", ([2**31 - 1, -(2**31)], [1, -1]), [2**31 - 1, -(2**31)]),
        ("bfind.s32", ([-1, 0, 1, -(2**31)],), [2**32 - 1, 2**32 - 1, 0, 30]),
        ("bfind.shiftamt.u32", ([1, 2**31, 0],), [31, 0, 2**32 - 1]),
        ("copysign.f32", ([-1.0, 1.0], [3.0, -4.0]), [-3.0, 4.0]),
        ("testp.subnormal.f32", ([1e-40, 0.0, 1.0, NAN],), [True, False, False, False]),
        ("setp.ltu.f32", ([NAN, 1.0, 2.0], [1.0, 2.0, 1.0]), [True, True, False]),
        ("setp.ne.f32", ([NAN, 1.0, 1.0], [1.0, 2.0, 1.0]), [False, True, False]),
        ("setp.neu.f32", ([NAN, 1.0, 1.0], [1.0, 2.0, 1.0]), [True, True, False]),
        ("setp.eq.ftz.f32", ([1e-40, 1e-30], [0.0, 0.0]), [True, False]),
        ("add.sat.f32", ([NAN, 0.75, -3.0], [0.0, 0.75, 0.0]), [0.0, 1.0, 0.0]),
        ("mul.ftz.f32", ([1e-40, 1e-30, -1e-30], [1e30, 1e-10, 1e-10]), [0.0, 0.0, -0.0]),
        ("slct.u32.f32", ([1, 1, 1], [2, 2, 2], [-0.0, NAN, -1.0]), [1, 2, 2]),
        ("fns.b32", ([0b10110] * 3, [0, 4, 2], [2, -2, 0]), [2, 2, 2]),
        ("lop3.b32", ([0b1100], [0b1010], [0b1001], [0x80]), [0b1000]),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_edge_cases_of_an_opcode(opcode, operands, expected):
    got = lanes(opcode, *operands)
    got = got[0] if isinstance(got[0], list) else got
    assert str(got) == str(expected)  # as text: tells -0.0 from 0.0 and has NaN equal NaN


def test_a_carry_travels_from_word_to_word():
    low, carry = lanes("add.cc.u32", [2**32 - 1, 1], [1, 1], dsts=2)
    assert (low, carry) == ([0, 2], [True, False])
    assert lanes("addc.u32", [2**32 - 1, 5], [0, 5], carry) == [0, 10]
    low, borrow = lanes("sub.cc.u32", [0, 5], [1, 5], dsts=2)
    assert (low, borrow) == ([2**32 - 1, 0], [True, False])
    high, carry = lanes("madc.hi.cc.u32", [2**32 - 1], [2**32 - 1], [1], [True], dsts=2)
    assert (high, carry) == ([0], [True])


def wrap(value: int, bits: int, signed: bool) -> int:
    value &= (1 << bits) - 1
    return value - (1 << bits) if signed and value >> (bits - 1) else value


@pytest.mark.parametrize("kind", ["u16", "s16", "u32", "s32", "u64", "s64"])
def test_compiled_integer_arithmetic_is_that_of_c(kind):
    bits, signed = int(kind[1:]), kind[0] == "s"
    (_, _, raw), (_, _, out) = run_corpus("integers", f"integers_{kind}")
    for words, row in zip(raw, out, strict=True):
        if bits == 64:
            given = [int(w) for w in words]
        else:
            given = [int(x) for x in np.ascontiguousarray(words).view(f"u{bits // 8}")[:3]]
        a, b, c = (wrap(x, bits, signed) for x in (given[0], given[1] | 1, given[2]))
        quotient = abs(a) // abs(b) * (1 if (a < 0) == (b < 0) else -1)
        by = b & 7
        expected = [
            a + b,
            a - b,
            a * b,
            quotient,
            a - quotient * b,
            a * b + c,
            a & b,
            a | b,
            a ^ b,
            ~a,
            a << by,
            a >> by,
        ]
        expected += [min(a, b), max(a, b), None, -a, abs(a) if signed else a, int(a == 0)]
        for number, value in enumerate(expected):
            if value is not None:
                # The kernel returns the value converted to 64 bits.
                assert int(row[number]) == wrap(value, bits, signed) % 2**64, (kind, number, a, b, c)


def test_compiled_float_functions_are_close_to_numpy():
    """Exercises fma, ex2, lg2, cvt, bit twiddling and local arrays together, on tame arguments."""
    (f, d, _), (out, _, _) = run_corpus("float32", "approx_float32_math", tame=True)
    a, b = f[:, 0].astype("f8"), f[:, 1].astype("f8")
    with np.errstate(all="ignore"):
        expected = [np.exp(a), np.log(a), np.log2(a), np.log10(a), np.sin(a), np.cos(a), np.tan(a), np.power(a, b)]
        expected += [np.expm1(a), np.log1p(a), np.sinh(a), np.cosh(a), np.tanh(a), np.arcsin(a), np.arccos(a)]
        expected += [np.arctan(a), np.arctan2(a, b), np.cbrt(a)]
    for number, values in enumerate(expected):
        np.testing.assert_allclose(out[:, number], values, rtol=2e-6, atol=1e-37, err_msg=str(number))
    _, (_, out64, _) = run_corpus("float64", "approx_float64_math", tame=True)
    a, b = d[:, 0], d[:, 1]
    with np.errstate(all="ignore"):
        wide = [np.exp(a), np.log(a), np.log2(a), np.log10(a), np.sin(a), np.cos(a), np.power(a, b), np.exp2(a)]
        wide += [1 / np.sqrt(a), np.tanh(a), np.arctan2(a, b), np.cbrt(a)]
    for number, values in enumerate(wide):
        np.testing.assert_allclose(out64[:, number], values, rtol=1e-13, err_msg=str(number))


def test_large_arguments_of_sine_take_the_path_with_carries_and_local_memory():
    module = corpus.module("float64", "sm_75")
    arrays = corpus.arguments(32, tame=True)
    arrays[1][:96] = np.random.default_rng(3).uniform(1e9, 1e15, 96)
    result = numpy_exec.run(module.kernels["approx_float64_math"], module, (1,), (32,), arrays)
    out = arrays[4][: 32 * corpus.ROOM].reshape(32, corpus.ROOM)
    angles = arrays[1][:96:3]
    np.testing.assert_allclose(out[:, 4], np.sin(angles), rtol=1e-12)
    np.testing.assert_allclose(out[:, 5], np.cos(angles), rtol=1e-12)
    assert result.counters.total.lst_req > 0


# --- warps ------------------------------------------------------------------------------------------------------------


def test_shuffles_votes_and_matches():
    (_, _, raw), (_, _, out) = run_corpus("warp", "warp_shuffles")
    a = raw[:, 0].astype(np.uint32).reshape(-1, 32)
    lane = np.arange(32)
    rows = out.reshape(-1, 32, corpus.ROOM).astype(np.uint32)
    np.testing.assert_array_equal(rows[..., 0], np.repeat(a[:, 5:6], 32, axis=1))
    np.testing.assert_array_equal(rows[..., 2], np.where(lane >= 3, a[:, np.maximum(lane - 3, 0)], a))
    np.testing.assert_array_equal(rows[..., 3], np.where(lane < 23, a[:, np.minimum(lane + 9, 31)], a))
    np.testing.assert_array_equal(rows[..., 4], a[:, lane ^ 17])
    np.testing.assert_array_equal(rows[..., 5], a[:, (lane & ~7) | ((lane + 3) & 7)])
    np.testing.assert_array_equal(rows[..., 6], np.where(lane % 16 >= 2, a[:, np.maximum(lane - 2, 0)], a))
    np.testing.assert_array_equal(rows[..., 7], np.where(lane % 4 < 3, a[:, np.minimum(lane + 1, 31)], a))
    np.testing.assert_array_equal(rows[..., 11], np.cumsum(a, axis=1, dtype=np.uint32))
    _, (_, _, out) = run_corpus("warp", "warp_match")
    same = [[sum(1 << j for j in range(32) if x & 3 == row[j] & 3) for x in row] for row in a.tolist()]
    np.testing.assert_array_equal(out.reshape(-1, 32, corpus.ROOM)[..., 0], same)
    _, (_, _, out) = run_corpus("warp", "warp_votes")
    ballots = [sum((int(x) & 1) << j for j, x in enumerate(row)) for row in a]
    np.testing.assert_array_equal(out.reshape(-1, 32, corpus.ROOM)[:, 0, 2], ballots)
    _, (_, _, out) = run_corpus("warp", "warp_reductions", arch="sm_90")
    np.testing.assert_array_equal(out.reshape(-1, 32, corpus.ROOM)[:, 3, 4], a.max(axis=1))


def test_votes_across_a_thread_block():
    (_, _, raw), (_, _, out) = run_corpus("warp", "warp_block_barriers")
    a = raw[:, 0].astype(np.uint32).reshape(2, 64)
    rows = out.reshape(2, 64, corpus.ROOM)
    np.testing.assert_array_equal(rows[..., 0], a[:, ::-1])
    np.testing.assert_array_equal(rows[..., 1], np.repeat((a & 1).sum(axis=1), 64).reshape(2, 64))
    np.testing.assert_array_equal(rows[..., 4], (a + np.uint32(1))[:, np.arange(64) ^ 1])


def test_atomics_add_in_the_order_of_lanes_and_give_the_old_value():
    values = np.random.default_rng(1).normal(size=64).astype("f4")
    total, old = np.zeros(1, "f4"), np.zeros(64, "f4")
    body = """extern "C" __global__ void kernel(const float* v, float* total, float* old) {
        int i = threadIdx.x; old[i] = atomicAdd(total, v[i]); }"""
    run_cuda(body, 1, 64, values, total, old)
    running = np.float32(0)
    for i, value in enumerate(values):
        assert old[i] == running
        running = np.float32(running + value)
    assert total[0] == running


def test_lanes_that_an_operation_names_are_waited_for():
    """The two sides of the branch reach different shuffles of the whole warp: legal from Volta on."""
    out = np.zeros(32, "u4")
    body = """extern "C" __global__ void kernel(unsigned* out) {
        int i = threadIdx.x; unsigned seen;
        if (i & 1) { asm volatile("bar.warp.sync 0xffffffff;"); seen = i * 10; } else { seen = i + 100;
            asm volatile("bar.warp.sync 0xffffffff;"); }
        out[i] = seen; }"""
    result = run_cuda(body, 1, 32, out)
    np.testing.assert_array_equal(out, np.where(np.arange(32) % 2, np.arange(32) * 10, np.arange(32) + 100))
    assert {f.kind for f in result.findings} <= {"bad-mask"}


# --- arguments, state and findings ------------------------------------------------------------------------------------


def test_structures_pass_by_value():
    small = np.dtype([("a", "i4"), ("b", "f4")])
    large = np.dtype([("weights", "f8", 5), ("parts", small, 3), ("tag", "u1")], align=True)
    module = corpus.module("control", "sm_52")
    parts = [(7, 0.5), (-2, 1.5), (11, 2.5)]
    big, little = np.zeros((), large), np.array((3, 0.25), small)
    big["weights"], big["parts"], big["tag"] = [1, 2, 3, 4, 5], parts, 9
    values = np.arange(32, dtype="f4")
    sums, products = np.zeros(32), np.zeros(32, "u8")
    kernel = module.kernels["control_structures"]
    numpy_exec.run(kernel, module, (1,), (32,), [big[()], little[()], values, sums, products])
    for i in range(32):
        expected = 9 + sum((k + 1) * (k + i) for k in range(5)) + (i % 5 + 1) + parts[i % 3][1] + 0.25 + i
        assert sums[i] == pytest.approx(expected)
        assert products[i] == (33 + parts[i % 3][0]) % 2**64


def test_module_variables_keep_their_state_between_runs_that_share_them():
    from mpmbench.simt.numpy_memory import module_variables

    module = corpus.module("control", "sm_52")
    state = module_variables(module)
    kernel = module.kernels["control_variables"]
    for _ in range(2):
        numpy_exec.run(kernel, module, (1,), (32,), corpus.arguments(32), variables=state)
    assert int(state["counter"].view("u4").sum()) == 10 + 20 + 30 + 40 + 64


@pytest.mark.parametrize(
    ("body", "kind"),
    [
        ("out[i + 40] = 1;", "out-of-bounds"),
        ("*(double*)(out + 1) = 1;", "misaligned"),
        ("if (i < 7) __syncthreads(); out[i] = 1;", "divergent-barrier"),
        ("while (out[0] == 0) out[i] = 0;", "runaway"),
        ("if (i > 3) out[i] = __ballot_sync(0xf, 1);", "bad-mask"),
        ("if (i == 5) __trap();", "trap"),
        ("__shared__ int s[8]; s[i + 100] = 3; out[i] = s[0];", "out-of-bounds"),
    ],
)
def test_defects_are_found_and_named_with_their_line(body, kind):
    out = np.zeros(32, "u4")
    text = 'extern "C" __global__ void kernel(volatile unsigned* out) {\n int i = threadIdx.x;\n ' + body + "\n}"
    result = run_cuda(text, 1, 32, out, budget=10_000)
    assert [f.kind for f in result.findings] == [kind]
    assert result.findings[0].line is not None
    assert result.findings[0].line.line == 3


def test_warps_in_another_order_give_the_same_result_without_races():
    _, plain = run_corpus("warp", "warp_block_barriers")
    _, shuffled = run_corpus("warp", "warp_block_barriers", seed=4)
    for a, b in zip(plain, shuffled, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(
    ("args", "message"),
    [
        ((np.zeros(4, "f4"),), "takes 2 arguments, 1 given"),
        ((np.zeros(4, "f4"), 3), "int is neither"),
        ((np.zeros(4, "f4"), np.int64(3)), "8 bytes given, the kernel takes 4"),
        ((np.zeros((4, 4), "f4")[:, 0], np.int32(3)), "not C-contiguous"),
    ],
)
def test_wrong_arguments_are_refused(args, message):
    body = 'extern "C" __global__ void kernel(float* x, int n) { x[threadIdx.x % n] = n; }'
    with pytest.raises(InputError, match=message):
        run_cuda(body, 1, 4, *args)


def test_an_unknown_opcode_is_refused_with_its_name_and_line():
    body = """extern "C" __global__ void kernel(unsigned* x) {
        asm("vabsdiff4.u32.u32.u32 %0, %0, %0, %0;" : "+r"(x[0])); }"""
    with pytest.raises(InputError, match=r"vabsdiff4\.u32\.u32\.u32 at .*kernel\.cu:2"):
        run_cuda(body, 1, 1, np.zeros(1, "u4"))


# --- counters ---------------------------------------------------------------------------------------------------------


def count(body: str, block: int = 32, floats: int = 4096, **options) -> Tally:
    data = corpus.aligned(np.zeros(floats, "f4"))
    text = 'extern "C" __global__ void kernel(float* x) { int i = threadIdx.x; ' + body + " }"
    return run_cuda(text, 1, block, data, **options).counters.total


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        ("x[i] = 1;", {"gst_req": 1, "gst_sectors": 4}),
        ("x[8 * i] = 1;", {"gst_req": 1, "gst_sectors": 32}),
        ("x[i + 1] = 1;", {"gst_req": 1, "gst_sectors": 5}),
        ("x[0] = 1;", {"gst_req": 1, "gst_sectors": 1}),
        ("if (i < 8) x[i] = 1;", {"gst_req": 1, "gst_sectors": 1}),
        ("((float4*)x)[i + 64] = ((float4*)x)[i];", {"gld_req": 1, "gld_sectors": 16, "gst_sectors": 16}),
        ("atomicAdd(x, 1.0f);", {"gatom_req": 1, "gatom_lane": 32, "gatom_sectors": 1, "gatom_pass": 32}),
        ("atomicAdd(x + i, 1.0f);", {"gatom_req": 1, "gatom_lane": 32, "gatom_sectors": 4, "gatom_pass": 4}),
        ("atomicAdd(x + i / 4, 1.0f);", {"gatom_sectors": 1, "gatom_pass": 4}),
        ("atomicAdd(x + i / 4 * 8, 1.0f);", {"gatom_sectors": 8, "gatom_pass": 32}),
    ],
)
def test_global_requests_sectors_and_atomic_passes(body, expected):
    tally = count(body)
    assert {name: getattr(tally, name) for name in expected} == expected


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        ("volatile __shared__ float s[1024]; s[i] = 1;", {"sst_req": 1, "shm_wavefronts": 1}),
        ("volatile __shared__ float s[1024]; s[2 * i] = 1;", {"sst_req": 1, "shm_wavefronts": 2}),
        ("volatile __shared__ float s[1024]; s[32 * i] = 1;", {"sst_req": 1, "shm_wavefronts": 32}),
        ("volatile __shared__ float s[1024]; s[33 * i % 1024] = 1;", {"sst_req": 1, "shm_wavefronts": 1}),
        ("volatile __shared__ float s[4]; s[2] = 1;", {"sst_req": 1, "shm_wavefronts": 1}),
        ("volatile __shared__ double s[64]; s[i] = 1;", {"sst_req": 1, "shm_wavefronts": 2}),
        ("__shared__ float4 s[64]; s[i] = make_float4(x[0], 1, 2, 3); __syncthreads(); x[i] = s[31 - i].x;",
         {"sst_req": 1, "sld_req": 1, "shm_wavefronts": 4 + 4, "bar": 1}),
        ("__shared__ double s[2]; s[i & 1] = x[0]; __syncthreads(); x[i] = s[0];",
         {"sst_req": 1, "sld_req": 1, "shm_wavefronts": 2 + 2}),
        ("__shared__ float4 s[2]; s[i & 1] = make_float4(x[0], 1, 2, 3); __syncthreads(); float4 v = s[0]; "
         "x[i] = v.x + v.y + v.z + v.w;", {"sst_req": 1, "sld_req": 1, "shm_wavefronts": 4 + 4}),
        ("volatile __shared__ unsigned char s[64]; s[i] = 1;", {"sst_req": 1, "shm_wavefronts": 1}),
        ("__shared__ float s[8]; atomicAdd(s + i % 8, 1.0f);",
         {"satom_req": 1, "satom_lane": 32, "satom_iter": 4, "satom_wavefronts": 4}),
        # One word in each lane's bank; four words in each of eight banks.
        ("__shared__ float s[32]; atomicAdd(s + i, 1.0f);", {"satom_iter": 1, "satom_wavefronts": 1}),
        ("__shared__ float s[128]; atomicAdd(s + 4 * i, 1.0f);", {"satom_iter": 1, "satom_wavefronts": 4}),
        # Lanes 0 to 15 each want a word of bank 0, two lanes a word: 8 words, then the 8 of the lanes that lost.
        ("__shared__ float s[512]; if (i < 16) atomicAdd(s + i / 2 * 32, 1.0f);",
         {"satom_lane": 16, "satom_iter": 2, "satom_wavefronts": 8 + 8}),
        # 8-byte words pass in two halves of the warp. Lane 31 wants lane 0's word: its half has two words in bank 0,
        # and a second round has it alone.
        ("__shared__ double s[64]; atomicAdd(s + i % 31, 1.0);", {"satom_iter": 2, "satom_wavefronts": 1 + 2 + 1}),
        ("__syncwarp(); __syncthreads(); __syncthreads();", {"bar": 2, "bar_warp": 1}),
    ],
)  # fmt: skip
def test_shared_requests_wavefronts_and_barriers(body, expected):
    tally = count(body)
    assert {name: getattr(tally, name) for name in expected} == expected


def test_branches_and_lanes():
    tally = count("if (i & 1) atomicAdd(x, 1.0f); else atomicMax((int*)x, 3); if (i < 64) atomicAdd(x + 1, 2.0f);")
    assert (tally.div_branch, tally.gatom_req, tally.gatom_lane) == (1, 3, 64)
    uniform = count("if (i < 32) atomicAdd(x, 1.0f); else atomicMax((int*)x, 3);", block=64)
    assert (uniform.branch, uniform.div_branch, uniform.gatom_req) == (2, 0, 2)


def test_lines_add_up_to_the_total():
    module = corpus.module("control", "sm_52")
    for name in ("control_loops", "control_calls", "control_memory"):
        arrays = corpus.arguments(96)
        counters = numpy_exec.run(module.kernels[name], module, (2,), (48,), arrays, 4096).counters
        total = Tally()
        for tally in counters.lines.values():
            total = total + tally
        assert total == counters.total
        assert len(counters.lines) > 3
