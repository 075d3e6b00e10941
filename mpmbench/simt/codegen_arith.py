"""What an arithmetic, logic, compare, select, move or convert instruction computes in one lane, as LLVM vector code.

Semantics: PTX ISA 8.8, chapter 9.7. IEEE operations are exact (LLVM ``fadd``, ``llvm.fma``, ... without fast-math
flags); ``.approx`` forms are at least as accurate as the ISA promises. Results that the ISA leaves open: an integer
quotient and remainder by zero are all ones, as on NVIDIA hardware; NaN results are quiet but keep the CPU's payload.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Protocol

from mpmbench.simt.codegen_ir import Writer, bits_of, integer_of
from mpmbench.simt.ptx import Imm, Instruction, Operand, Vector

ELEMENT = {"pred": "i1", "f32": "float", "f64": "double"}
ELEMENT |= {f"{kind}{bits}": f"i{bits}" for kind in "sub" for bits in (8, 16, 32, 64)}


class Refused(Exception):
    """The form is not supported; the caller adds opcode and source line."""


class Lanes(Protocol):
    """What the emitters below need from the code generator of a block."""

    w: Writer
    hardware_ftz: bool  # denormal f32 inputs and results are flushed by the processor

    def read(self, operand: Operand, kind: str) -> str:
        """Value of an operand as PTX type ``kind`` (registers of more bits are cut)."""

    def write(self, item: Instruction, position: int, value: str, element: str) -> None:
        """Set destination ``position``; the guard is applied here."""


Emitter = Callable[[Lanes, Instruction], None]
EMITTERS: dict[str, Emitter] = {}

_FLAGS = frozenset({"ftz", "rn", "approx", "full", "lo", "sat", "uni", "wide", "hi", "clamp"})


def emits(*roots: str) -> Callable[[Emitter], Emitter]:
    def register(emitter: Emitter) -> Emitter:
        for root in roots:
            EMITTERS[root] = emitter
        return emitter

    return register


def is_float(kind: str) -> bool:
    return kind in ("f32", "f64")


def is_signed(kind: str) -> bool:
    return kind[0] == "s"


def flush(w: Writer, value: str) -> str:
    """Denormal f32 -> zero of the same sign, by explicit code."""
    bits = w.reinterpret(value, "float", "i32")
    exponent = w.binary("and", "i32", bits, w.splat_int("i32", 0x7F800000))
    is_small = w.compare("icmp eq", "i32", exponent, w.splat_int("i32", 0))
    sign = w.binary("and", "i32", bits, w.splat_int("i32", 0x80000000))
    return w.reinterpret(w.select("i32", is_small, sign, bits), "i32", "float")


def _flushes(ctx: Lanes, item: Instruction, kind: str) -> bool:
    """Whether explicit flushing is needed around an operation that the floating-point unit carries out."""
    return kind == "f32" and "ftz" in item.modifiers and not ctx.hardware_ftz


def _reads(ctx: Lanes, item: Instruction, kind: str) -> list[str]:
    values = [ctx.read(operand, kind) for operand in item.srcs]
    return [flush(ctx.w, value) for value in values] if _flushes(ctx, item, kind) else values


def _write_float(ctx: Lanes, item: Instruction, kind: str, value: str) -> None:
    if _flushes(ctx, item, kind):
        value = flush(ctx.w, value)
    if "sat" in item.modifiers:
        value = _saturate(ctx.w, value, kind)
    ctx.write(item, 0, value, ELEMENT[kind])


def _saturate(w: Writer, value: str, kind: str) -> str:
    """Clamp to [0, 1]; NaN becomes +0."""
    element = ELEMENT[kind]
    at_least = w.intrinsic("llvm.maximumnum", element, value, "zeroinitializer")
    return w.intrinsic("llvm.minimumnum", element, at_least, _one(w, element))


def _float_bits(element: str, value: float) -> int:
    code, size = ("<f", 4) if element == "float" else ("<d", 8)
    return int.from_bytes(struct.pack(code, value)[:size], "little")


def _constant(w: Writer, element: str, value: float) -> str:
    return w.splat_bits(element, _float_bits(element, value))


def _one(w: Writer, element: str) -> str:
    return _constant(w, element, 1.0)


def _check_modifiers(item: Instruction, *also: str) -> str:
    """-> the type; refuses modifiers that change the result in a way nobody emits here."""
    *flags, kind = item.modifiers
    if kind not in ELEMENT or not set(flags) <= _FLAGS | set(also):
        raise Refused
    return kind


# --- arithmetic ---------------------------------------------------------------------------------------------------


@emits("add", "sub", "mul")
def _add_sub_mul(ctx: Lanes, item: Instruction) -> None:
    kind = _check_modifiers(item)
    if is_float(kind):
        a, b = _reads(ctx, item, kind)
        _write_float(ctx, item, kind, ctx.w.binary(f"f{item.root}", ELEMENT[kind], a, b))
    elif item.root == "mul" and ("wide" in item.modifiers or "hi" in item.modifiers):
        _write_wide(ctx, item, kind, _wide_product(ctx, item, kind))
    else:
        a, b = (ctx.read(operand, kind) for operand in item.srcs)
        element = ELEMENT[kind]
        if "sat" in item.modifiers:
            if kind != "s32" or item.root == "mul":
                raise Refused
            ctx.write(item, 0, ctx.w.intrinsic(f"llvm.s{item.root}.sat", element, a, b), element)
        else:
            ctx.write(item, 0, ctx.w.binary(item.root, element, a, b), element)


def _wide_product(ctx: Lanes, item: Instruction, kind: str) -> str:
    """Both factors extended to twice the width, multiplied."""
    narrow, wide = ELEMENT[kind], f"i{2 * bits_of(ELEMENT[kind])}"
    extend = "sext" if is_signed(kind) else "zext"
    factors = []
    for operand in item.srcs[:2]:
        if isinstance(operand, Imm) and wide == "i64":
            value = operand.value & 0xFFFFFFFF if narrow == "i32" else operand.value & 0xFFFF
            if is_signed(kind) and value >> (bits_of(narrow) - 1):
                value -= 1 << bits_of(narrow)
            factors.append(ctx.w.splat_int(wide, value))
        else:
            factors.append(ctx.w.cast(extend, ctx.read(operand, kind), narrow, wide))
    return ctx.w.binary("mul", wide, *factors)


def _write_wide(ctx: Lanes, item: Instruction, kind: str, product: str) -> None:
    """Store a double-width product as it is (``.wide``) or its upper half (``.hi``); ``mad`` adds its third operand."""
    w, narrow = ctx.w, ELEMENT[kind]
    wide = f"i{2 * bits_of(narrow)}"
    if "wide" in item.modifiers:
        if item.root == "mad":
            addend = ctx.read(item.srcs[2], f"{kind[0]}{2 * bits_of(narrow)}")
            product = w.binary("add", wide, product, addend)
        ctx.write(item, 0, product, wide)
        return
    upper = w.cast("trunc", w.binary("lshr", wide, product, _wide_shift(wide)), wide, narrow)
    if item.root == "mad":
        upper = w.binary("add", narrow, upper, ctx.read(item.srcs[2], kind))
    ctx.write(item, 0, upper, narrow)


def _wide_shift(wide: str) -> str:
    return f"splat ({wide} {int(wide[1:]) // 2})"


@emits("mad")
def _mad(ctx: Lanes, item: Instruction) -> None:
    kind = _check_modifiers(item)
    if is_float(kind):
        _fma(ctx, item)
    elif "wide" in item.modifiers or "hi" in item.modifiers:
        _write_wide(ctx, item, kind, _wide_product(ctx, item, kind))
    else:
        a, b, c = (ctx.read(operand, kind) for operand in item.srcs)
        element = ELEMENT[kind]
        ctx.write(item, 0, ctx.w.binary("add", element, ctx.w.binary("mul", element, a, b), c), element)


@emits("fma")
def _fma(ctx: Lanes, item: Instruction) -> None:
    kind = _check_modifiers(item)
    if not is_float(kind):
        raise Refused
    _write_float(ctx, item, kind, ctx.w.intrinsic("llvm.fma", ELEMENT[kind], *_reads(ctx, item, kind)))


@emits("mul24", "mad24")
def _mul24(ctx: Lanes, item: Instruction) -> None:
    """The low 32 bits of a 24 x 24 bit product, plus the third operand of mad24."""
    kind = _check_modifiers(item)
    if "hi" in item.modifiers or "sat" in item.modifiers:
        raise Refused
    w, eight = ctx.w, ctx.w.splat_int("i32", 8)
    factors = []
    for operand in item.srcs[:2]:
        shifted = w.binary("shl", "i32", ctx.read(operand, kind), eight)
        factors.append(w.binary("ashr" if is_signed(kind) else "lshr", "i32", shifted, eight))
    product = w.binary("mul", "i32", *factors)
    if item.root == "mad24":
        product = w.binary("add", "i32", product, ctx.read(item.srcs[2], kind))
    ctx.write(item, 0, product, "i32")


@emits("sad")
def _sad(ctx: Lanes, item: Instruction) -> None:
    kind = _check_modifiers(item)
    w, element = ctx.w, ELEMENT[kind]
    a, b, c = (ctx.read(operand, kind) for operand in item.srcs)
    larger = w.compare(f"icmp {'sgt' if is_signed(kind) else 'ugt'}", element, a, b)
    distance = w.select(element, larger, w.binary("sub", element, a, b), w.binary("sub", element, b, a))
    ctx.write(item, 0, w.binary("add", element, distance, c), element)


@emits("div")
def _div(ctx: Lanes, item: Instruction) -> None:
    kind = _check_modifiers(item)
    if is_float(kind):
        _write_float(ctx, item, kind, ctx.w.binary("fdiv", ELEMENT[kind], *_reads(ctx, item, kind)))
    else:
        quotient, _ = _quotient(ctx, item, kind)
        ctx.write(item, 0, quotient, ELEMENT[kind])


@emits("rem")
def _rem(ctx: Lanes, item: Instruction) -> None:
    kind = _check_modifiers(item)
    _, remainder = _quotient(ctx, item, kind)
    ctx.write(item, 0, remainder, ELEMENT[kind])


def _quotient(ctx: Lanes, item: Instruction, kind: str) -> tuple[str, str]:
    """Integer quotient and remainder in every lane, dead or alive, without ever trapping."""
    w, element = ctx.w, ELEMENT[kind]
    a, b = (ctx.read(operand, kind) for operand in item.srcs)
    by_zero = w.compare("icmp eq", element, b, w.splat_int(element, 0))
    safe = w.select(element, by_zero, w.splat_int(element, 1), b)
    if bits_of(element) <= 32:
        # Exact: numbers of 32 bits have exact doubles, and a rounded quotient cannot reach the next integer, which
        # is at least 1/b >= 2^-32 away while the rounding error is below 2^-21 of that.
        to_float, to_int = ("sitofp", "fptosi") if is_signed(kind) else ("uitofp", "fptoui")
        ratio = w.binary(
            "fdiv",
            "double",
            w.cast(to_float, a, element, "double"),
            w.cast(to_float, safe, element, "double"),
        )
        quotient = w.cast("trunc", w.cast(to_int, ratio, "double", "i64"), "i64", element)
    else:
        if is_signed(kind):  # the one overflow: INT64_MIN / -1, whose quotient wraps to INT64_MIN = -INT64_MIN
            minus = w.compare("icmp eq", element, safe, w.splat_int(element, -1))
            negated = w.binary("sub", element, w.splat_int(element, 0), a)
            divisor = w.select(element, minus, w.splat_int(element, 1), safe)
            quotient = w.select(element, minus, negated, w.binary("sdiv", element, a, divisor))
        else:
            quotient = w.binary("udiv", element, a, safe)
    remainder = w.binary("sub", element, a, w.binary("mul", element, quotient, safe))
    return (
        w.select(element, by_zero, w.splat_int(element, -1), quotient),
        w.select(element, by_zero, w.splat_int(element, -1), remainder),
    )


@emits("min", "max")
def _min_max(ctx: Lanes, item: Instruction) -> None:
    """Of numbers; a NaN loses against a number, -0 is below +0. ``.NaN`` forms let the NaN win."""
    kind = _check_modifiers(item, "NaN")
    w, element = ctx.w, ELEMENT[kind]
    values = [ctx.read(operand, kind) for operand in item.srcs]
    if not is_float(kind):
        name = f"llvm.{'s' if is_signed(kind) else 'u'}{item.root}"
        ctx.write(item, 0, w.intrinsic(name, element, *values), element)
        return
    rule = "imum" if "NaN" in item.modifiers else "imumnum"
    result = w.intrinsic(f"llvm.{item.root}{rule}", element, *values)
    # The processor's min and max hand a denormal through, whatever its flushing mode.
    ctx.write(item, 0, flush(w, result) if "ftz" in item.modifiers else result, element)


@emits("abs", "neg")
def _abs_neg(ctx: Lanes, item: Instruction) -> None:
    kind = _check_modifiers(item)
    w, element = ctx.w, ELEMENT[kind]
    a = ctx.read(item.srcs[0], kind)
    if not is_float(kind):
        zero = w.splat_int(element, 0)
        negated = w.binary("sub", element, zero, a)
        if item.root == "abs":
            negated = w.select(element, w.compare("icmp slt", element, a, zero), negated, a)
        ctx.write(item, 0, negated, element)
        return
    result = _flip_sign(w, element, a) if item.root == "neg" else w.intrinsic("llvm.fabs", element, a)
    ctx.write(item, 0, flush(w, result) if "ftz" in item.modifiers else result, element)


def _flip_sign(w: Writer, element: str, value: str) -> str:
    return w.value(f"fneg {w.vector(element)} {value}")


@emits("copysign")
def _copysign(ctx: Lanes, item: Instruction) -> None:
    kind = _check_modifiers(item)
    sign, magnitude = (ctx.read(operand, kind) for operand in item.srcs)
    ctx.write(item, 0, ctx.w.intrinsic("llvm.copysign", ELEMENT[kind], magnitude, sign), ELEMENT[kind])


@emits("sqrt", "rcp", "rsqrt")
def _roots(ctx: Lanes, item: Instruction) -> None:
    kind = _check_modifiers(item)
    w, element = ctx.w, ELEMENT[kind]
    if not is_float(kind):
        raise Refused
    (value,) = _reads(ctx, item, kind)
    if item.root in ("sqrt", "rsqrt"):
        value = w.intrinsic("llvm.sqrt", element, value)
    if item.root in ("rcp", "rsqrt"):
        value = w.binary("fdiv", element, _one(w, element), value)
    _write_float(ctx, item, kind, value)


@emits("ex2", "lg2", "sin", "cos", "tanh")
def _transcendental(ctx: Lanes, item: Instruction) -> None:
    """The ``.approx`` functions, by the C library in double precision and rounded: below the ISA's error bounds."""
    kind = _check_modifiers(item)
    if kind != "f32":
        raise Refused
    w = ctx.w
    (value,) = _reads(ctx, item, kind)
    name = {"ex2": "exp2", "lg2": "log2"}.get(item.root, item.root)
    wide = w.cast("fpext", value, "float", "double")
    result = w.intrinsic(f"llvm.{name}", "double", wide)
    _write_float(ctx, item, kind, w.cast("fptrunc", result, "double", "float"))


@emits("testp")
def _testp(ctx: Lanes, item: Instruction) -> None:
    test, kind = item.modifiers
    w, element = ctx.w, ELEMENT[kind]
    classes = {
        "finite": 0x1F8,
        "infinite": 0x204,
        "number": 0x3FC,
        "notanumber": 3,
        "normal": 0x108,
        "subnormal": 0x90,
    }
    value = ctx.read(item.srcs[0], kind)
    full = f"llvm.is.fpclass.v{w.lanes}{kind}"
    w.declare(f"declare {w.vector('i1')} @{full}({w.vector(element)}, i32 immarg)")
    result = w.value(f"call {w.vector('i1')} @{full}({w.vector(element)} {value}, i32 {classes[test]})")
    ctx.write(item, 0, result, "i1")


# --- logic, shifts, bit fields ------------------------------------------------------------------------------------


@emits("and", "or", "xor")
def _logic(ctx: Lanes, item: Instruction) -> None:
    kind = _check_modifiers(item)
    a, b = (ctx.read(operand, kind) for operand in item.srcs)
    ctx.write(item, 0, ctx.w.binary(item.root, ELEMENT[kind], a, b), ELEMENT[kind])


@emits("not")
def _not(ctx: Lanes, item: Instruction) -> None:
    kind = _check_modifiers(item)
    element = ELEMENT[kind]
    value = ctx.w.binary("xor", element, ctx.read(item.srcs[0], kind), ctx.w.splat_int(element, -1))
    ctx.write(item, 0, value, element)


@emits("cnot")
def _cnot(ctx: Lanes, item: Instruction) -> None:
    kind = _check_modifiers(item)
    w, element = ctx.w, ELEMENT[kind]
    is_zero = w.compare("icmp eq", element, ctx.read(item.srcs[0], kind), w.splat_int(element, 0))
    ctx.write(item, 0, w.cast("zext", is_zero, "i1", element), element)


@emits("lop3")
def _lop3(ctx: Lanes, item: Instruction) -> None:
    """Any function of three bits: the truth table's set rows, or-ed."""
    kind = _check_modifiers(item)
    w, element = ctx.w, ELEMENT[kind]
    a, b, c = (ctx.read(operand, kind) for operand in item.srcs[:3])
    table = item.srcs[3]
    if not isinstance(table, Imm):
        raise Refused
    ones = w.splat_int(element, -1)
    inverted = [w.binary("xor", element, value, ones) for value in (a, b, c)]
    result = w.splat_int(element, 0)
    for row in range(8):
        if table.value >> row & 1:
            picked = [
                plain if row >> bit & 1 else flipped
                for plain, flipped, bit in zip((a, b, c), inverted, (2, 1, 0), strict=True)
            ]
            term = w.binary("and", element, w.binary("and", element, picked[0], picked[1]), picked[2])
            result = w.binary("or", element, result, term)
    ctx.write(item, 0, result, element)


@emits("shl", "shr")
def _shift(ctx: Lanes, item: Instruction) -> None:
    """Amounts of the width or more shift everything out."""
    kind = _check_modifiers(item)
    w, element = ctx.w, ELEMENT[kind]
    bits = bits_of(element)
    a = ctx.read(item.srcs[0], kind)
    arithmetic = item.root == "shr" and is_signed(kind)
    operation = "shl" if item.root == "shl" else "ashr" if arithmetic else "lshr"
    amount = item.srcs[1]
    if isinstance(amount, Imm):
        count = amount.value & 0xFFFFFFFF
        if count >= bits and not arithmetic:
            ctx.write(item, 0, w.splat_int(element, 0), element)
        else:
            ctx.write(item, 0, w.binary(operation, element, a, w.splat_int(element, min(count, bits - 1))), element)
        return
    narrow = ctx.read(amount, "u32")
    limit = w.intrinsic("llvm.umin", "i32", narrow, w.splat_int("i32", bits - 1))
    count_text = limit if bits == 32 else w.cast("zext" if bits > 32 else "trunc", limit, "i32", element)
    result = w.binary(operation, element, a, count_text)
    if not arithmetic:
        too_far = w.compare("icmp uge", "i32", narrow, w.splat_int("i32", bits))
        result = w.select(element, too_far, w.splat_int(element, 0), result)
    ctx.write(item, 0, result, element)


@emits("shf")
def _funnel_shift(ctx: Lanes, item: Instruction) -> None:
    """Shift of the pair (second, first) operand: ``.l`` keeps the upper word, ``.r`` the lower."""
    direction, mode, _ = item.modifiers
    w = ctx.w
    low, high, amount = (ctx.read(operand, "b32") for operand in item.srcs)
    if mode == "clamp":
        amount = w.intrinsic("llvm.umin", "i32", amount, w.splat_int("i32", 32))
    name = "llvm.fshl" if direction == "l" else "llvm.fshr"
    result = w.intrinsic(name, "i32", high, low, amount)
    if mode == "clamp":  # fshl and fshr count modulo 32
        all_out = w.compare("icmp eq", "i32", amount, w.splat_int("i32", 32))
        result = w.select("i32", all_out, low if direction == "l" else high, result)
    ctx.write(item, 0, result, "i32")


@emits("popc", "clz", "brev")
def _bit_counts(ctx: Lanes, item: Instruction) -> None:
    kind = _check_modifiers(item)
    w, element = ctx.w, ELEMENT[kind]
    value = ctx.read(item.srcs[0], kind)
    if item.root == "brev":
        ctx.write(item, 0, w.intrinsic("llvm.bitreverse", element, value), element)
        return
    if item.root == "popc":
        count = w.intrinsic("llvm.ctpop", element, value)
    else:
        count = w.intrinsic("llvm.ctlz", element, value, extra=", i1 false")
    ctx.write(item, 0, count if element == "i32" else w.cast("trunc", count, element, "i32"), "i32")


@emits("bfind")
def _bfind(ctx: Lanes, item: Instruction) -> None:
    """Position of the highest bit that differs from the sign; all ones where there is none."""
    *flags, kind = item.modifiers
    w, element = ctx.w, ELEMENT[kind]
    value = ctx.read(item.srcs[0], kind)
    if is_signed(kind):
        sign = w.binary("ashr", element, value, w.splat_int(element, bits_of(element) - 1))
        value = w.binary("xor", element, value, sign)
    leading = w.intrinsic("llvm.ctlz", element, value, extra=", i1 false")
    highest = w.splat_int(element, bits_of(element) - 1)
    position = leading if "shiftamt" in flags else w.binary("sub", element, highest, leading)
    none = w.compare("icmp eq", element, value, w.splat_int(element, 0))
    position = w.select(element, none, w.splat_int(element, -1), position)
    ctx.write(item, 0, position if element == "i32" else w.cast("trunc", position, element, "i32"), "i32")


@emits("bfe")
def _bit_field_extract(ctx: Lanes, item: Instruction) -> None:
    """``len`` bits from ``pos`` up, extended with zeros or the field's sign; bits past the top read as sign or zero."""
    kind = _check_modifiers(item)
    w, element = ctx.w, ELEMENT[kind]
    bits = bits_of(element)
    value = ctx.read(item.srcs[0], kind)
    position, length = (_byte_operand(ctx, operand, element) for operand in item.srcs[1:3])
    zero, top = w.splat_int(element, 0), w.splat_int(element, bits - 1)
    shift_in = w.intrinsic("llvm.umin", element, position, top)
    out = w.compare("icmp ugt", element, position, top)
    shifted = w.binary("ashr" if is_signed(kind) else "lshr", element, value, shift_in)
    if not is_signed(kind):
        shifted = w.select(element, out, zero, shifted)
    # Move the field to the top and back; a field of the full width or more stays where it is.
    room = w.binary(
        "sub",
        element,
        w.splat_int(element, bits),
        w.intrinsic("llvm.umin", element, length, w.splat_int(element, bits)),
    )
    room = w.intrinsic("llvm.umin", element, room, top)
    back = "ashr" if is_signed(kind) else "lshr"
    field = w.binary(back, element, w.binary("shl", element, shifted, room), room)
    empty = w.compare("icmp eq", element, length, zero)
    ctx.write(item, 0, w.select(element, empty, zero, field), element)


@emits("bfi")
def _bit_field_insert(ctx: Lanes, item: Instruction) -> None:
    """The low ``len`` bits of the first operand replace those of the second from ``pos`` up."""
    kind = _check_modifiers(item)
    w, element = ctx.w, ELEMENT[kind]
    bits = bits_of(element)
    source, target = (ctx.read(operand, kind) for operand in item.srcs[:2])
    position, length = (_byte_operand(ctx, operand, element) for operand in item.srcs[2:4])
    zero, top, full = w.splat_int(element, 0), w.splat_int(element, bits - 1), w.splat_int(element, bits)
    short = w.intrinsic("llvm.umin", element, length, top)
    ones = w.binary("sub", element, w.binary("shl", element, w.splat_int(element, 1), short), w.splat_int(element, 1))
    ones = w.select(element, w.compare("icmp uge", element, length, full), w.splat_int(element, -1), ones)
    shift = w.intrinsic("llvm.umin", element, position, top)
    mask = w.binary("shl", element, ones, shift)
    mask = w.select(element, w.compare("icmp uge", element, position, full), zero, mask)
    moved = w.binary("and", element, w.binary("shl", element, source, shift), mask)
    kept = w.binary("and", element, target, w.binary("xor", element, mask, w.splat_int(element, -1)))
    ctx.write(item, 0, w.binary("or", element, moved, kept), element)


def _byte_operand(ctx: Lanes, operand: Operand, element: str) -> str:
    """Bits 0..7 of a u32 operand, as ``element``."""
    w = ctx.w
    low = w.binary("and", "i32", ctx.read(operand, "u32"), w.splat_int("i32", 255))
    return low if element == "i32" else w.cast("zext", low, "i32", element)


@emits("prmt")
def _permute_bytes(ctx: Lanes, item: Instruction) -> None:
    """Each result byte picks one of eight source bytes by four selector bits; the highest replicates its sign."""
    if item.modifiers != ("b32",):
        raise Refused
    w = ctx.w
    a, b, selector = (ctx.read(operand, "b32") for operand in item.srcs)
    pair = w.binary(
        "or",
        "i64",
        w.cast("zext", a, "i32", "i64"),
        w.binary("shl", "i64", w.cast("zext", b, "i32", "i64"), w.splat_int("i64", 32)),
    )
    wide_selector = w.cast("zext", selector, "i32", "i64")
    result = w.splat_int("i64", 0)
    for byte in range(4):
        nibble = w.binary("lshr", "i64", wide_selector, w.splat_int("i64", 4 * byte))
        index = w.binary("and", "i64", nibble, w.splat_int("i64", 7))
        shift = w.binary("shl", "i64", index, w.splat_int("i64", 3))
        picked = w.binary("and", "i64", w.binary("lshr", "i64", pair, shift), w.splat_int("i64", 255))
        sign_bit = w.binary("lshr", "i64", picked, w.splat_int("i64", 7))
        sign = w.binary("mul", "i64", sign_bit, w.splat_int("i64", 255))
        mode = w.binary("and", "i64", nibble, w.splat_int("i64", 8))
        is_sign = w.compare("icmp ne", "i64", mode, w.splat_int("i64", 0))
        chosen = w.select("i64", is_sign, sign, picked)
        result = w.binary("or", "i64", result, w.binary("shl", "i64", chosen, w.splat_int("i64", 8 * byte)))
    ctx.write(item, 0, w.cast("trunc", result, "i64", "i32"), "i32")


@emits("dp4a", "dp2a")
def _dot_product(ctx: Lanes, item: Instruction) -> None:
    """c + sum over four bytes of a times b (dp4a), or over two halves of a times two bytes of b (dp2a)."""
    first, second = item.modifiers[-2:]
    w = ctx.w
    a, b, total = (ctx.read(operand, "b32") for operand in item.srcs)

    def part(value: str, low: int, bits: int, kind: str) -> str:
        moved = w.binary("shl", "i32", value, w.splat_int("i32", 32 - bits - low))
        return w.binary("ashr" if is_signed(kind) else "lshr", "i32", moved, w.splat_int("i32", 32 - bits))

    if item.root == "dp4a":
        pairs = [((8 * i, 8), (8 * i, 8)) for i in range(4)]
    else:
        start = 16 if "hi" in item.modifiers else 0
        pairs = [((16 * i, 16), (start + 8 * i, 8)) for i in range(2)]
    for of_a, of_b in pairs:
        product = w.binary("mul", "i32", part(a, *of_a, first), part(b, *of_b, second))
        total = w.binary("add", "i32", total, product)
    ctx.write(item, 0, total, "i32")


# --- compare and select -------------------------------------------------------------------------------------------

_SIGNED = {c: f"s{c}" for c in ("lt", "le", "gt", "ge")} | {"eq": "eq", "ne": "ne"}
_UNSIGNED = {c: f"u{c}" for c in ("lt", "le", "gt", "ge")} | {"eq": "eq", "ne": "ne"}
_UNSIGNED |= {"lo": "ult", "ls": "ule", "hi": "ugt", "hs": "uge"}
_ORDERED = {c: f"o{c}" for c in ("eq", "ne", "lt", "le", "gt", "ge")}
_ORDERED |= {f"{c}u": f"u{c}" for c in ("eq", "lt", "le", "gt", "ge")} | {
    "neu": "une",
    "num": "ord",
    "nan": "uno",
}


def _comparison(ctx: Lanes, item: Instruction, test: str, kind: str) -> str:
    w, element = ctx.w, ELEMENT[kind]
    a, b = (ctx.read(operand, kind) for operand in item.srcs[:2])
    if is_float(kind):
        if _flushes(ctx, item, kind):
            a, b = flush(w, a), flush(w, b)
        return w.compare(f"fcmp {_ORDERED[test]}", element, a, b)
    table = _SIGNED if is_signed(kind) else _UNSIGNED
    if test not in table:
        raise Refused
    return w.compare(f"icmp {table[test]}", element, a, b)


@emits("setp", "set")
def _set_predicate(ctx: Lanes, item: Instruction) -> None:
    """``setp.cmp[.bool]`` writes the test, and its complement to a second register; ``set`` writes all ones or 1.0."""
    parts = [part for part in item.modifiers if part != "ftz"]
    test, rest = parts[0], parts[1:]
    combine = rest.pop(0) if rest[0] in ("and", "or", "xor") else None
    source = rest[-1]
    w = ctx.w
    outcome = _comparison(ctx, item, test, source)

    def combined(value: str) -> str:
        return w.binary(combine, "i1", value, ctx.read(item.srcs[2], "pred")) if combine else value

    if item.root == "set":
        target = rest[0]
        element = ELEMENT[target]
        ones = _one(w, element) if is_float(target) else w.splat_int(element, -1)
        ctx.write(item, 0, w.select(element, combined(outcome), ones, "zeroinitializer"), element)
        return
    ctx.write(item, 0, combined(outcome), "i1")
    if len(item.dsts) > 1:
        ctx.write(item, 1, combined(w.invert(outcome)), "i1")


@emits("selp")
def _select(ctx: Lanes, item: Instruction) -> None:
    kind = _check_modifiers(item)
    yes, no = (ctx.read(operand, kind) for operand in item.srcs[:2])
    ctx.write(item, 0, ctx.w.select(ELEMENT[kind], ctx.read(item.srcs[2], "pred"), yes, no), ELEMENT[kind])


@emits("slct")
def _select_by_sign(ctx: Lanes, item: Instruction) -> None:
    """The first operand where the third is >= 0."""
    *_, kind, test = item.modifiers
    w = ctx.w
    yes, no = (ctx.read(operand, kind) for operand in item.srcs[:2])
    sign = ctx.read(item.srcs[2], test)
    if test == "f32":
        if _flushes(ctx, item, "f32"):
            sign = flush(w, sign)
        condition = w.compare("fcmp oge", "float", sign, "zeroinitializer")
    else:
        condition = w.compare("icmp sge", "i32", sign, w.splat_int("i32", 0))
    ctx.write(item, 0, w.select(ELEMENT[kind], condition, yes, no), ELEMENT[kind])


# --- moves and conversions ----------------------------------------------------------------------------------------


@emits("mov")
def _move(ctx: Lanes, item: Instruction) -> None:
    kind = item.modifiers[-1]
    if len(item.dsts) > 1:
        _unpack(ctx, item, kind)
    elif isinstance(item.srcs[0], Vector):
        _pack(ctx, item, kind)
    else:
        ctx.write(item, 0, ctx.read(item.srcs[0], kind), ELEMENT[kind])


def _pack(ctx: Lanes, item: Instruction, kind: str) -> None:
    """``mov.b64 %rd, {lo, hi}``: the first item gets the lowest bits."""
    w, element = ctx.w, ELEMENT[kind]
    vector = item.srcs[0]
    assert isinstance(vector, Vector)
    part_bits = bits_of(element) // len(vector.items)
    result = w.splat_int(element, 0)
    for position, part in enumerate(vector.items):
        assert part is not None
        value = w.cast("zext", ctx.read(part, f"b{part_bits}"), f"i{part_bits}", element)
        if position:
            value = w.binary("shl", element, value, w.splat_int(element, position * part_bits))
        result = w.binary("or", element, result, value)
    ctx.write(item, 0, result, element)


def _unpack(ctx: Lanes, item: Instruction, kind: str) -> None:
    w, element = ctx.w, integer_of(ELEMENT[kind])
    part_bits = bits_of(element) // len(item.dsts)
    whole = ctx.read(item.srcs[0], f"b{bits_of(element)}")
    for position, dst in enumerate(item.dsts):
        if dst is None:
            continue
        shifted = w.binary("lshr", element, whole, w.splat_int(element, position * part_bits)) if position else whole
        ctx.write(item, position, w.cast("trunc", shifted, element, f"i{part_bits}"), f"i{part_bits}")


@emits("cvt")
def _convert(ctx: Lanes, item: Instruction) -> None:
    *flags, target, source = item.modifiers
    if target not in ELEMENT or source not in ELEMENT:
        raise Refused
    if is_float(source):
        (_float_to_float if is_float(target) else _float_to_int)(ctx, item, flags, target, source)
    else:
        (_int_to_float if is_float(target) else _int_to_int)(ctx, item, flags, target, source)


_TO_INTEGRAL = {"rni": "llvm.roundeven", "rzi": "llvm.trunc", "rmi": "llvm.floor", "rpi": "llvm.ceil"}


def _rounding(flags: list[str], allowed: set[str]) -> str | None:
    """The one rounding modifier among flags; refuses directed rounding and unknown modifiers."""
    rest = [flag for flag in flags if flag not in ("ftz", "sat")]
    if len(rest) > 1 or not set(rest) <= allowed:
        raise Refused
    return rest[0] if rest else None


def _float_to_float(ctx: Lanes, item: Instruction, flags: list[str], target: str, source: str) -> None:
    w = ctx.w
    rounding = _rounding(flags, {"rn", *_TO_INTEGRAL})
    value = ctx.read(item.srcs[0], source)
    if source == "f32" and "ftz" in flags:
        value = flush(w, value)
    if rounding in _TO_INTEGRAL:
        value = w.intrinsic(_TO_INTEGRAL[rounding], ELEMENT[source], value)
    if source != target:
        value = w.cast("fpext" if target == "f64" else "fptrunc", value, ELEMENT[source], ELEMENT[target])
    if target == "f32" and "ftz" in flags:
        value = flush(w, value)
    if "sat" in flags:
        value = _saturate(w, value, target)
    ctx.write(item, 0, value, ELEMENT[target])


def _float_to_int(ctx: Lanes, item: Instruction, flags: list[str], target: str, source: str) -> None:
    """Round, clamp to the target's range, and give NaN its value: 0, or the top bit where 64-bit types take part."""
    w, wide = ctx.w, ELEMENT[source]
    rounding = _rounding(flags, set(_TO_INTEGRAL))
    value = ctx.read(item.srcs[0], source)
    if source == "f32" and "ftz" in flags and not ctx.hardware_ftz:
        value = flush(w, value)
    bits = int(target[1:])
    element = ELEMENT[target]
    low = -(1 << (bits - 1)) if is_signed(target) else 0
    high = (1 << (bits - int(is_signed(target)))) - 1
    if rounding != "rzi":
        value = w.intrinsic(_TO_INTEGRAL[rounding or "rzi"], wide, value)
    # Clamp on the float side to the largest float inside the range: conversions outside it are undefined in LLVM.
    limit = _constant(w, wide, _largest_below(wide, high))
    over = w.compare("fcmp ogt", wide, value, limit)
    inside = w.intrinsic(
        "llvm.minnum", wide, w.intrinsic("llvm.maxnum", wide, value, _constant(w, wide, float(low))), limit
    )
    is_nan = w.compare("fcmp uno", wide, value, value)
    inside = w.select(wide, is_nan, _constant(w, wide, 0.0), inside)
    step = element if bits >= 32 else "i32"
    result = w.cast("fptosi" if is_signed(target) or bits < 32 else "fptoui", inside, wide, step)
    result = w.select(step, over, w.splat_int(step, high), result)
    of_nan = 1 << (bits - 1) if source == "f64" or bits == 64 else 0
    if of_nan:
        result = w.select(step, is_nan, w.splat_int(step, of_nan), result)
    if step != element:
        result = w.cast("trunc", result, step, element)
    _write_extended(ctx, item, result, target)


def _largest_below(element: str, limit: int) -> float:
    """The largest float of the type that is not above limit."""
    bits = 24 if element == "float" else 53
    spare = max(limit.bit_length() - bits, 0)
    return float(limit >> spare << spare)


def _int_to_float(ctx: Lanes, item: Instruction, flags: list[str], target: str, source: str) -> None:
    if _rounding(flags, {"rn"}) is None and not (target == "f64" and int(source[1:]) <= 32):
        raise Refused
    w = ctx.w
    value = w.cast(
        "sitofp" if is_signed(source) else "uitofp",
        ctx.read(item.srcs[0], source),
        ELEMENT[source],
        ELEMENT[target],
    )
    ctx.write(item, 0, _saturate(w, value, target) if "sat" in flags else value, ELEMENT[target])


def _int_to_int(ctx: Lanes, item: Instruction, flags: list[str], target: str, source: str) -> None:
    if flags not in ([], ["sat"]):
        raise Refused
    w = ctx.w
    from_bits, to_bits = int(source[1:]), int(target[1:])
    value, element = ctx.read(item.srcs[0], source), ELEMENT[source]
    if "sat" in flags:
        low = -(1 << (to_bits - 1)) if is_signed(target) else 0
        high = (1 << (to_bits - int(is_signed(target)))) - 1
        if is_signed(source):
            if low > -(1 << (from_bits - 1)):
                value = w.intrinsic("llvm.smax", element, value, w.splat_int(element, low))
            if high < (1 << (from_bits - 1)) - 1:
                value = w.intrinsic("llvm.smin", element, value, w.splat_int(element, high))
        elif high < (1 << from_bits) - 1:
            value = w.intrinsic("llvm.umin", element, value, w.splat_int(element, high))
    if to_bits > from_bits:
        value = w.cast("sext" if is_signed(source) else "zext", value, element, ELEMENT[target])
    elif to_bits < from_bits:
        value = w.cast("trunc", value, element, ELEMENT[target])
    _write_extended(ctx, item, value, target)


def _write_extended(ctx: Lanes, item: Instruction, value: str, kind: str) -> None:
    """Write a value that may be narrower than its register: it is extended by its own signedness."""
    dst = item.dsts[0]
    assert dst is not None
    register_bits = {"b16": 16, "b32": 32, "b64": 64, "f32": 32, "f64": 64}[dst.type]
    element = ELEMENT[kind]
    if register_bits > bits_of(element):
        wide = f"i{register_bits}"
        value = ctx.w.cast("sext" if is_signed(kind) else "zext", value, element, wide)
        element = wide
    ctx.write(item, 0, value, element)


@emits("cvta")
def _convert_address(ctx: Lanes, item: Instruction) -> None:
    """Between generic addresses and a state space. Only shared addresses differ: they count from the block's window."""
    kind = item.modifiers[-1]
    value = ctx.read(item.srcs[0], kind)
    if "shared" in item.modifiers:
        w, element = ctx.w, ELEMENT[kind]
        if element != "i64":
            raise Refused
        window = w.splat("i64", ctx.shared_window())  # type: ignore[attr-defined]
        value = w.binary("sub" if "to" in item.modifiers else "add", "i64", value, window)
    ctx.write(item, 0, value, ELEMENT[kind])


@emits("isspacep")
def _is_space(ctx: Lanes, item: Instruction) -> None:
    ctx.write(item, 0, ctx.is_in_space(ctx.read(item.srcs[0], "u64"), item.modifiers[0]), "i1")  # type: ignore[attr-defined]


def is_float_arithmetic(item: Instruction) -> tuple[bool, bool, bool]:
    """Which flushing the instruction asks for: (f32 with .ftz, f32 without, f64), as far as the FPU computes it."""
    if item.root in ("atom", "red"):
        # Float sums in global memory flush denormals whatever the compiler was asked for.
        return {"add", "f32"} <= set(item.modifiers) and "shared" not in item.modifiers, False, False
    if item.root not in _FPU_ROOTS:
        return False, False, False
    kinds = item.modifiers
    # Conversions between an integer and f32 can neither read nor make a denormal, save float -> int with .ftz.
    single = "f32" in kinds and not (item.root == "cvt" and kinds[-2] == "f32" and not is_float(kinds[-1]))
    flushed = "ftz" in kinds
    return single and flushed, single and not flushed, "f64" in kinds


_FPU_ROOTS = frozenset(
    {"add", "sub", "mul", "mad", "fma", "div", "rcp", "sqrt", "rsqrt", "ex2", "lg2", "sin", "cos", "tanh"}
    | {"setp", "set", "slct", "cvt", "min", "max"}
)
