"""Forms that compilers seldom print: directed roundings, carry chains, byte-permutation modes, gross reciprocals.

Semantics as in codegen_arith. Directed roundings switch the processor's rounding mode inside a small function of their
own, marked ``strictfp``, so that no other arithmetic can move under the changed mode.
"""

from __future__ import annotations

from collections.abc import Callable

from mpmbench.simt.codegen_arith import (
    ELEMENT,
    Lanes,
    Refused,
    _constant,
    _reads,
    _write_float,
    is_float,
    is_signed,
)
from mpmbench.simt.codegen_ir import Writer, bits_of
from mpmbench.simt.ptx import Instruction

_MODES = {"rz": 0, "rp": 2, "rm": 3}  # numbers of llvm.set.rounding
_NEAREST = 1
_SUFFIX = {"float": "f32", "double": "f64", "i8": "i8", "i16": "i16", "i32": "i32", "i64": "i64"}


def emit(ctx: Lanes, item: Instruction) -> bool:
    """Write code for the instruction if it is one of these forms; -> whether it is."""
    modifiers = set(item.modifiers)
    if item.root == "cvt":
        if not modifiers & set(_MODES):
            return False
        _directed_conversion(ctx, item)
    elif modifiers & set(_MODES) and item.root in _DIRECTED:
        _directed(ctx, item)
    elif "cc" in modifiers or item.root in ("addc", "subc", "madc"):
        _with_carry(ctx, item)
    elif item.root == "prmt" and len(item.modifiers) == 2:
        _permute(ctx, item)
    elif item.root in ("mul24", "mad24") and "hi" in modifiers:
        _high_24(ctx, item)
    elif item.root in ("rcp", "rsqrt") and {"approx", "ftz", "f64"} <= modifiers:
        _gross(ctx, item)
    elif item.root == "fns":
        _find_nth_set(ctx, item)
    else:
        return False
    return True


# --- directed roundings -----------------------------------------------------------------------------------------------


def _rounded_call(w: Writer, operation: str, mode: str, sources: list[tuple[str, str]], target: str) -> str:
    """Call a constrained intrinsic under a rounding mode. sources: (element, value)."""
    vectors = [w.vector(element) for element, _ in sources]
    result = w.vector(target)
    name = f"{operation}.{mode}.v{w.lanes}.{'.'.join(_SUFFIX[e] for e in (target, *(e for e, _ in sources)))}"
    intrinsic = f"llvm.experimental.constrained.{operation}.v{w.lanes}{_SUFFIX[target]}"
    if operation in ("sitofp", "uitofp", "fptrunc"):
        intrinsic += f".v{w.lanes}{_SUFFIX[sources[0][0]]}"
    w.declare(f"declare {result} @{intrinsic}({', '.join(vectors)}, metadata, metadata)")
    w.declare("declare void @llvm.set.rounding(i32)")
    parameters = ", ".join(f"{vector} %p{number}" for number, vector in enumerate(vectors))
    w.declare(
        f"define internal {result} @{name}({parameters}) noinline strictfp {{\n"
        f"call void @llvm.set.rounding(i32 {_MODES[mode]}) strictfp\n"
        f"%r = call {result} @{intrinsic}({parameters}, "
        'metadata !"round.dynamic", metadata !"fpexcept.ignore") strictfp\n'
        f"call void @llvm.set.rounding(i32 {_NEAREST}) strictfp\n"
        f"ret {result} %r\n}}"
    )
    arguments = ", ".join(f"{vector} {value}" for vector, (_, value) in zip(vectors, sources, strict=True))
    return w.value(f"call {result} @{name}({arguments})")


_DIRECTED = {"add": "fadd", "sub": "fsub", "mul": "fmul", "fma": "fma", "mad": "fma", "div": "fdiv"}
_DIRECTED |= {"rcp": "fdiv", "sqrt": "sqrt"}


def _mode(item: Instruction, allowed: set[str]) -> str:
    (mode,) = set(item.modifiers) & set(_MODES)
    if not set(item.modifiers) - {mode} <= allowed:
        raise Refused
    return mode


def _directed(ctx: Lanes, item: Instruction) -> None:
    kind = item.modifiers[-1]
    mode = _mode(item, {"ftz", "sat", kind})
    if not is_float(kind):
        raise Refused
    element = ELEMENT[kind]
    values = _reads(ctx, item, kind)
    if item.root == "rcp":
        values = [_constant(ctx.w, element, 1.0), *values]
    sources = [(element, value) for value in values]
    _write_float(ctx, item, kind, _rounded_call(ctx.w, _DIRECTED[item.root], mode, sources, element))


def _directed_conversion(ctx: Lanes, item: Instruction) -> None:
    target, source = item.modifiers[-2:]
    mode = _mode(item, {"ftz", "sat", target, source})
    value = ctx.read(item.srcs[0], source)
    if is_float(source):
        if (target, source) != ("f32", "f64"):
            raise Refused
        operation = "fptrunc"
    else:
        operation = "sitofp" if is_signed(source) else "uitofp"
    result = _rounded_call(ctx.w, operation, mode, [(ELEMENT[source], value)], ELEMENT[target])
    if is_float(source):
        _write_float(ctx, item, target, result)
    else:
        if operation == "uitofp":
            # Where the processor has no such conversion, LLVM subtracts, and zero rounded downwards becomes -0.
            result = ctx.w.intrinsic("llvm.fabs", ELEMENT[target], result)
        ctx.write(item, 0, result, ELEMENT[target])


# --- carries ----------------------------------------------------------------------------------------------------------


def _with_carry(ctx: Lanes, item: Instruction) -> None:
    """A sum with its carry, a difference with its borrow; the flag is a predicate register."""
    *flags, kind = item.modifiers
    root, w, element = item.root[:3], ctx.w, ELEMENT[kind]
    if not set(flags) <= {"cc", "lo", "hi"} or is_float(kind):
        raise Refused
    taken = item.srcs[-1] if item.root.endswith("c") else None
    operands = list(item.srcs[:-1] if taken is not None else item.srcs)
    first = _product_part(ctx, item, kind) if root == "mad" else ctx.read(operands[0], kind)
    second = ctx.read(operands[-1], kind)
    operation = "sub" if root == "sub" else "add"
    result = w.binary(operation, element, first, second)
    # A sum has wrapped if it is below its first term; a difference if the first term is below the second.
    flag = w.compare("icmp ult", element, *((first, second) if root == "sub" else (result, first)))
    if taken is not None:
        unit = w.cast("zext", ctx.read(taken, "pred"), "i1", element)
        before = result
        result = w.binary(operation, element, before, unit)
        again = w.compare("icmp ult", element, *((before, unit) if root == "sub" else (result, before)))
        flag = w.binary("or", "i1", flag, again)
    ctx.write(item, 0, result, element)
    if "cc" in flags:
        ctx.write(item, 1, flag, "i1")


def _product_part(ctx: Lanes, item: Instruction, kind: str) -> str:
    w, narrow = ctx.w, ELEMENT[kind]
    wide, extend = f"i{2 * bits_of(narrow)}", "sext" if is_signed(kind) else "zext"
    factors = [w.cast(extend, ctx.read(operand, kind), narrow, wide) for operand in item.srcs[:2]]
    product = w.binary("mul", wide, *factors)
    if "hi" in item.modifiers:
        product = w.binary("lshr", wide, product, f"splat ({wide} {bits_of(narrow)})")
    return w.cast("trunc", product, wide, narrow)


# --- bits -------------------------------------------------------------------------------------------------------------


def _permute(ctx: Lanes, item: Instruction) -> None:
    """``prmt`` whose mode derives all four byte numbers from the selector's low two bits."""
    kind, mode = item.modifiers
    if kind != "b32":
        raise Refused
    w = ctx.w
    a, b, selector = (w.cast("zext", ctx.read(operand, "b32"), "i32", "i64") for operand in item.srcs)

    def number(value: int) -> str:
        return w.splat_int("i64", value)

    pair = w.binary("or", "i64", a, w.binary("shl", "i64", b, number(32)))
    low = w.binary("and", "i64", selector, number(3))
    half = w.binary("shl", "i64", w.binary("and", "i64", selector, number(1)), number(1))
    indices: dict[str, Callable[[int], str]] = {
        "f4e": lambda i: w.binary("add", "i64", low, number(i)),
        "b4e": lambda i: w.binary("and", "i64", w.binary("sub", "i64", low, number(i)), number(7)),
        "rc8": lambda i: low,
        "ecl": lambda i: w.intrinsic("llvm.umax", "i64", low, number(i)),
        "ecr": lambda i: w.intrinsic("llvm.umin", "i64", low, number(i)),
        "rc16": lambda i: w.binary("add", "i64", half, number(i & 1)),
    }
    result = number(0)
    for byte in range(4):
        shift = w.binary("shl", "i64", indices[mode](byte), number(3))
        picked = w.binary("and", "i64", w.binary("lshr", "i64", pair, shift), number(255))
        result = w.binary("or", "i64", result, w.binary("shl", "i64", picked, number(8 * byte)))
    ctx.write(item, 0, w.cast("trunc", result, "i64", "i32"), "i32")


def _high_24(ctx: Lanes, item: Instruction) -> None:
    """Bits 16 to 47 of a 24 x 24 bit product, plus the third operand of mad24."""
    *flags, kind = item.modifiers
    if flags != ["hi"]:
        raise Refused
    w, up = ctx.w, ctx.w.splat_int("i64", 40)
    back = "ashr" if is_signed(kind) else "lshr"
    factors = []
    for operand in item.srcs[:2]:
        wide = w.cast("zext", ctx.read(operand, kind), "i32", "i64")
        factors.append(w.binary(back, "i64", w.binary("shl", "i64", wide, up), up))
    product = w.binary("lshr", "i64", w.binary("mul", "i64", *factors), w.splat_int("i64", 16))
    result = w.cast("trunc", product, "i64", "i32")
    if item.root == "mad24":
        result = w.binary("add", "i32", result, ctx.read(item.srcs[2], kind))
    ctx.write(item, 0, result, "i32")


def _find_nth_set(ctx: Lanes, item: Instruction) -> None:
    """``fns``: walk from bit ``base`` up or down until as many set bits are passed as the offset says."""
    w = ctx.w
    mask, base, offset = (ctx.read(operand, "b32") for operand in item.srcs)
    zero, one, none = w.splat_int("i32", 0), w.splat_int("i32", 1), w.splat_int("i32", -1)
    down = w.compare("icmp slt", "i32", offset, zero)
    at_base = w.compare("icmp eq", "i32", offset, zero)
    step = w.select("i32", down, none, one)
    left = w.intrinsic("llvm.umax", "i32", w.select("i32", down, w.binary("sub", "i32", zero, offset), offset), one)
    # A walk that leaves the word has ended, even where the bit number wraps around.
    walks, position, result = w.compare("icmp ult", "i32", base, w.splat_int("i32", 32)), base, none
    for distance in range(32):
        inside = w.compare("icmp ult", "i32", position, w.splat_int("i32", 32))
        shift = w.intrinsic("llvm.umin", "i32", position, w.splat_int("i32", 31))
        bit = w.binary("and", "i32", w.binary("lshr", "i32", mask, shift), one)
        bit = w.select("i32", inside, bit, zero)
        before = left
        left = w.binary("sub", "i32", left, bit)
        found = w.compare("icmp eq", "i32", left, zero)
        found = w.binary("and", "i1", found, w.compare("icmp ne", "i32", before, zero))
        found = w.binary("and", "i1", found, walks)
        if distance:  # a plain look at the base goes no further
            found = w.binary("and", "i1", found, w.invert(at_base))
        result = w.select("i32", found, position, result)
        position = w.binary("add", "i32", position, step)
    ctx.write(item, 0, result, "i32")


# --- gross reciprocals ------------------------------------------------------------------------------------------------


def _gross(ctx: Lanes, item: Instruction) -> None:
    """``rcp``/``rsqrt.approx.ftz.f64``: the upper 32 bits of the operand give those of the result; denormals flush."""
    w = ctx.w
    value = ctx.read(item.srcs[0], "f64")
    upper = w.splat_int("i64", 0xFFFFFFFF00000000)

    def cut(number: str) -> str:
        bits = w.binary("and", "i64", w.reinterpret(number, "double", "i64"), upper)
        exponent = w.binary("and", "i64", bits, w.splat_int("i64", 0x7FF0000000000000))
        is_small = w.compare("icmp eq", "i64", exponent, w.splat_int("i64", 0))
        sign = w.binary("and", "i64", bits, w.splat_int("i64", 1 << 63))
        return w.reinterpret(w.select("i64", is_small, sign, bits), "i64", "double")

    is_nan = w.compare("fcmp uno", "double", value, value)
    operand = cut(value)
    if item.root == "rsqrt":
        operand = w.intrinsic("llvm.sqrt", "double", operand)
    result = cut(w.binary("fdiv", "double", _constant(w, "double", 1.0), operand))
    ctx.write(item, 0, w.select("double", is_nan, value, result), "double")


__all__ = ["emit"]
