"""What PTX arithmetic means, one NumPy expression on 32 lanes per instruction: the oracle's half of the semantics.

Written for plainness, and on purpose without a line in common with the code generator. Values travel as raw bits in
unsigned arrays of shape (32,), predicates as bool arrays; an operation views them as the types its opcode names.

Source: PTX ISA 8.8, chapters "Instruction Set". Where the ISA leaves a result open, this file says what it picks:
NaN results of float arithmetic are the canonical quiet NaN; a quotient or remainder by integer zero is all ones.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np

from mpmbench.errors import InputError
from mpmbench.simt import numpy_rounding as rounding
from mpmbench.simt.ptx import Instruction

Array = np.ndarray

DTYPES: dict[str, np.dtype] = {"pred": np.dtype(np.bool_), "b128": np.dtype("V16")}
DTYPES |= {f"{kind}{bits}": np.dtype(f"u{bits // 8}") for kind in "bu" for bits in (8, 16, 32, 64)}
DTYPES |= {f"s{bits}": np.dtype(f"i{bits // 8}") for bits in (8, 16, 32, 64)}
DTYPES |= {f"f{bits}": np.dtype(f"f{bits // 8}") for bits in (32, 64)}

NAN: dict[np.dtype, np.unsignedinteger] = {
    np.dtype("f4"): np.uint32(0x7FFFFFFF),
    np.dtype("f8"): np.uint64(0x7FFFFFFFFFFFFFFF),
}
ROUNDINGS = ("rn", "rz", "rm", "rp")


@dataclass(frozen=True)
class LaneOp:
    """An operation on lanes. ``apply`` maps arrays of the ``sources`` types to one array (or a tuple of arrays) of
    the ``results`` types; it may compute garbage, but must not raise, on lanes that are switched off."""

    sources: tuple[str, ...]
    results: tuple[str, ...]
    apply: Callable[..., Array | tuple[Array, ...]]


class Modifiers:
    """Reads an opcode's modifiers one by one; what nobody asked for makes the opcode unsupported."""

    def __init__(self, item: Instruction) -> None:
        self.item = item
        self.rest = list(item.modifiers)

    def flag(self, name: str) -> bool:
        if name in self.rest:
            self.rest.remove(name)
            return True
        return False

    def choice(self, names: Collection[str], default: str | None = None) -> str:
        """Take the first modifier that is one of ``names``."""
        for name in self.rest:
            if name in names:
                self.rest.remove(name)
                return name
        if default is None:
            raise self.refusal()
        return default

    def type(self, *allowed: str) -> str:
        """Take the first modifier that is a type."""
        kind = self.choice(tuple(DTYPES))
        if allowed and kind not in allowed:
            raise self.refusal()
        return kind

    def done(self) -> None:
        if self.rest:
            raise self.refusal()

    def refusal(self) -> InputError:
        return InputError(f"PTX opcode {self.item.opcode} at {self.item.where()} is not supported by the simulator")


def lane_op(item: Instruction) -> LaneOp:
    """The meaning of an arithmetic, logic, comparison or conversion instruction; InputError for an unknown one."""
    modifiers = Modifiers(item)
    build = _BUILDERS.get(item.root)
    if build is None:
        raise modifiers.refusal()
    op = build(modifiers)
    modifiers.done()
    return op


# --- float helpers ----------------------------------------------------------------------------------------------------


def flush(x: Array) -> Array:
    """Subnormal f32 values become zero of the same sign."""
    if x.dtype != np.float32:
        return x
    bits = x.view(np.uint32)
    return np.where((bits & 0x7F800000) == 0, bits & np.uint32(0x80000000), bits).view(np.float32)


def flush64(x: Array) -> Array:
    bits = x.view(np.uint64)
    small = (bits & np.uint64(0x7FF0000000000000)) == 0
    return np.where(small, bits & np.uint64(0x8000000000000000), bits).view(np.float64)


def canonical(x: Array) -> Array:
    """Any NaN becomes the canonical quiet NaN."""
    bits = x.view(f"u{x.dtype.itemsize}")
    return np.where(np.isnan(x), NAN[x.dtype], bits).view(x.dtype)


def saturate(x: Array) -> Array:
    """Clamp to [0, 1]; NaN and -0 become +0."""
    one = x.dtype.type(1)
    return np.where(x > 0, np.minimum(x, one), x.dtype.type(0))


def _float_op(count: int, kind: str, ftz: bool, sat: bool, compute: Callable[..., Array]) -> LaneOp:
    def apply(*sources: Array) -> Array:
        if ftz:
            sources = tuple(map(flush, sources))
        with np.errstate(all="ignore"):
            result = compute(*sources)
        if ftz:
            result = flush(result)
        return saturate(result) if sat else canonical(result)

    return LaneOp((kind,) * count, (kind,), apply)


def _bits(kind: str) -> int:
    return 8 * DTYPES[kind].itemsize


# --- add, sub, mul, fma, div, sqrt ... --------------------------------------------------------------------------------


def _add(m: Modifiers) -> LaneOp:
    return _with_carry(m, takes=False) if "cc" in m.rest else _add_or_sub(m, negate=False)


def _sub(m: Modifiers) -> LaneOp:
    return _with_carry(m, takes=False) if "cc" in m.rest else _add_or_sub(m, negate=True)


def _with_carry(m: Modifiers, takes: bool) -> LaneOp:
    """``add.cc``, ``addc``, ``subc``, ``madc.lo`` ...: sums of unbounded integers, cut to the width. The carry flag is
    the carry of a sum and the borrow of a difference."""
    root = m.item.root[:3]
    kind = m.type("u32", "s32", "u64", "s64")
    part = m.choice(("lo", "hi")) if root == "mad" else ""
    gives = m.flag("cc")
    bits = _bits(kind)
    unsigned = f"u{bits}"
    count = 3 if root == "mad" else 2

    def apply(*sources: Array) -> Array | tuple[Array, ...]:
        carry = sources[count].tolist() if takes else [False] * len(sources[0])
        first, addend = sources[0], sources[count - 1]
        if root == "mad":
            high, low = _full_product(sources[0].view(DTYPES[kind]), sources[1].view(DTYPES[kind]))
            first = (high if part == "hi" else low).view(DTYPES[unsigned])
        if root == "sub":
            exact = [x - y - c for x, y, c in zip(first.tolist(), addend.tolist(), carry, strict=True)]
        else:
            exact = [x + y + c for x, y, c in zip(first.tolist(), addend.tolist(), carry, strict=True)]
        value = np.array([x % (1 << bits) for x in exact], dtype=DTYPES[unsigned])
        return (value, np.array([not 0 <= x < 1 << bits for x in exact])) if gives else value

    sources = (unsigned,) * count + (("pred",) if takes else ())
    return LaneOp(sources, (unsigned, "pred") if gives else (unsigned,), apply)


def _add_or_sub(m: Modifiers, negate: bool) -> LaneOp:
    kind = m.type("u16", "s16", "u32", "s32", "u64", "s64", "f32", "f64")
    if kind[0] == "f":
        mode, ftz, sat = m.choice(ROUNDINGS, "rn"), m.flag("ftz"), m.flag("sat")
        return _float_op(2, kind, ftz, sat, lambda a, b: rounding.add(a, -b if negate else b, mode))
    if m.flag("sat"):
        if kind != "s32":
            raise m.refusal()

        def saturated(a: Array, b: Array) -> Array:
            exact = a.astype(np.int64) - b if negate else a.astype(np.int64) + b
            return np.clip(exact, -(2**31), 2**31 - 1).astype(np.int32)

        return LaneOp((kind, kind), (kind,), saturated)
    return LaneOp((kind, kind), (kind,), np.subtract if negate else np.add)


def _full_product(a: Array, b: Array) -> tuple[Array, Array]:
    """High and low half of the product of two arrays of one integer type, in that type."""
    bits = 8 * a.dtype.itemsize
    if bits < 64:
        wide = np.dtype(f"{a.dtype.kind}{a.dtype.itemsize * 2}")
        product = a.astype(wide) * b.astype(wide)
        return (product >> bits).astype(a.dtype), product.astype(a.dtype)
    exact = [int(x) * int(y) for x, y in zip(a, b, strict=True)]
    unsigned = [(p >> 64 & (2**64 - 1), p & (2**64 - 1)) for p in exact]
    high, low = np.array(unsigned, dtype=np.uint64).T.copy()
    return high.view(a.dtype), low.view(a.dtype)


def _multiply(kind: str, part: str, m: Modifiers) -> tuple[str, Callable[[Array, Array], Array]]:
    """-> result type and integer multiplication of ``kind``; part: lo, hi or wide."""
    if part == "lo":
        return kind, np.multiply
    if part == "hi":
        return kind, lambda a, b: _full_product(a, b)[0]
    if _bits(kind) > 32:
        raise m.refusal()
    wide = f"{kind[0]}{2 * _bits(kind)}"
    return wide, lambda a, b: a.astype(DTYPES[wide]) * b.astype(DTYPES[wide])


def _mul(m: Modifiers) -> LaneOp:
    kind = m.type("u16", "s16", "u32", "s32", "u64", "s64", "f32", "f64")
    if kind[0] == "f":
        mode, ftz, sat = m.choice(ROUNDINGS, "rn"), m.flag("ftz"), m.flag("sat")
        return _float_op(2, kind, ftz, sat, lambda a, b: rounding.mul(a, b, mode))
    result, product = _multiply(kind, m.choice(("lo", "hi", "wide")), m)
    return LaneOp((kind, kind), (result,), product)


def _mad(m: Modifiers) -> LaneOp:
    if "cc" in m.rest:
        return _with_carry(m, takes=False)
    kind = m.type("u16", "s16", "u32", "s32", "u64", "s64", "f32", "f64")
    if kind[0] == "f":  # since sm_20 another spelling of fma
        m.rest.append(kind)
        return _fma(m)
    part = m.choice(("lo", "hi", "wide"))
    result, product = _multiply(kind, part, m)
    if m.flag("sat"):
        if (kind, part) != ("s32", "hi"):
            raise m.refusal()

        def saturated(a: Array, b: Array, c: Array) -> Array:
            exact = product(a, b).astype(np.int64) + c
            return np.clip(exact, -(2**31), 2**31 - 1).astype(np.int32)

        return LaneOp((kind, kind, kind), (kind,), saturated)
    return LaneOp((kind, kind, result), (result,), lambda a, b, c: product(a, b) + c)


def _low_24(x: Array) -> Array:
    """The low 24 bits, sign-extended where the type is signed, as 64-bit integers."""
    wide = (x.astype(np.int64) & 0xFFFFFF) << 40
    return wide >> 40 if x.dtype.kind == "i" else wide.view(np.uint64) >> 40


def _product_24(part: str) -> Callable[[Array, Array], Array]:
    shift = 16 if part == "hi" else 0
    return lambda a, b: ((_low_24(a) * _low_24(b)) >> shift).astype(a.dtype)


def _mul24(m: Modifiers) -> LaneOp:
    kind, part = m.type("u32", "s32"), m.choice(("lo", "hi"))
    return LaneOp((kind, kind), (kind,), _product_24(part))


def _mad24(m: Modifiers) -> LaneOp:
    kind, part = m.type("u32", "s32"), m.choice(("lo", "hi"))
    product = _product_24(part)
    return LaneOp((kind,) * 3, (kind,), lambda a, b, c: product(a, b) + c)


def _fma(m: Modifiers) -> LaneOp:
    kind = m.type("f32", "f64")
    mode, ftz, sat = m.choice(ROUNDINGS, "rn"), m.flag("ftz"), m.flag("sat")
    return _float_op(3, kind, ftz, sat, lambda a, b, c: rounding.fma(a, b, c, mode))


def _sad(m: Modifiers) -> LaneOp:
    kind = m.type("u16", "s16", "u32", "s32", "u64", "s64")
    return LaneOp((kind,) * 3, (kind,), lambda a, b, c: c + np.where(a < b, b - a, a - b))


def _div(m: Modifiers) -> LaneOp:
    kind = m.type("u16", "s16", "u32", "s32", "u64", "s64", "f32", "f64")
    if kind[0] == "f":
        mode = m.choice((*ROUNDINGS, "approx", "full"))
        ftz = m.flag("ftz")
        mode = "rn" if mode in ("approx", "full") else mode
        return _float_op(2, kind, ftz, False, lambda a, b: rounding.div(a, b, mode))
    return LaneOp((kind, kind), (kind,), lambda a, b: _quotient_and_remainder(a, b)[0])


def _rem(m: Modifiers) -> LaneOp:
    kind = m.type("u16", "s16", "u32", "s32", "u64", "s64")
    return LaneOp((kind, kind), (kind,), lambda a, b: _quotient_and_remainder(a, b)[1])


def _quotient_and_remainder(a: Array, b: Array) -> tuple[Array, Array]:
    """Division that truncates towards zero; by zero both are all ones; INT_MIN / -1 wraps to INT_MIN, remainder 0."""
    quotients, remainders = [], []
    low = (1 << 8 * a.dtype.itemsize) - 1
    for x, y in zip(a.tolist(), b.tolist(), strict=True):
        if y == 0:
            quotient = remainder = low
        else:
            quotient = abs(x) // abs(y) * (1 if (x < 0) == (y < 0) else -1)
            remainder = x - quotient * y
        quotients.append(quotient & low)
        remainders.append(remainder & low)
    unsigned = np.dtype(f"u{a.dtype.itemsize}")
    return np.array(quotients, unsigned).view(a.dtype), np.array(remainders, unsigned).view(a.dtype)


def _rcp(m: Modifiers) -> LaneOp:
    kind = m.type("f32", "f64")
    mode = m.choice((*ROUNDINGS, "approx"))
    ftz = m.flag("ftz")
    if kind == "f64" and mode == "approx":
        return _gross(lambda x: 1 / x)
    mode = "rn" if mode == "approx" else mode
    return _float_op(1, kind, ftz, False, lambda a: rounding.div(np.ones_like(a), a, mode))


def _sqrt(m: Modifiers) -> LaneOp:
    kind = m.type("f32", "f64")
    mode = m.choice((*ROUNDINGS, "approx"))
    ftz = m.flag("ftz")
    mode = "rn" if mode == "approx" else mode
    return _float_op(1, kind, ftz, False, lambda a: rounding.sqrt(a, mode))


def _rsqrt(m: Modifiers) -> LaneOp:
    kind = m.type("f32", "f64")
    m.choice(("approx",))
    ftz = m.flag("ftz")
    if kind == "f64":
        return _gross(lambda x: 1 / np.sqrt(x)) if ftz else _approximate(kind, False, lambda x: 1 / np.sqrt(x))
    return _approximate(kind, ftz, lambda x: 1 / np.sqrt(x))


def _gross(compute: Callable[[Array], Array]) -> LaneOp:
    """``rcp``/``rsqrt.approx.ftz.f64``: only the upper 32 bits of input and result count, subnormals are flushed."""

    def apply(x: Array) -> Array:
        upper = np.uint64(0xFFFFFFFF00000000)
        with np.errstate(all="ignore"):
            result = canonical(compute(flush64((x.view(np.uint64) & upper).view(np.float64))))
        cut = (flush64(result).view(np.uint64) & upper).view(np.float64)
        return np.where(np.isnan(x), canonical(x), cut)

    return LaneOp(("f64",), ("f64",), apply)


def _approximate(kind: str, ftz: bool, compute: Callable[[Array], Array]) -> LaneOp:
    """Functions that the hardware approximates: here in float64, rounded once."""
    return _float_op(1, kind, ftz, False, lambda x: compute(x.astype(np.float64)).astype(DTYPES[kind]))


def _approximation(compute: Callable[[Array], Array]) -> Callable[[Modifiers], LaneOp]:
    def build(m: Modifiers) -> LaneOp:
        kind = m.type("f32")
        m.choice(("approx",))
        return _approximate(kind, m.flag("ftz"), compute)

    return build


# --- abs, neg, min, max, copysign, testp ------------------------------------------------------------------------------


def _abs(m: Modifiers) -> LaneOp:
    kind = m.type("s16", "s32", "s64", "f32", "f64")
    if kind[0] == "f":
        return _float_op(1, kind, m.flag("ftz"), False, np.abs)
    return LaneOp((kind,), (kind,), lambda a: np.where(a < 0, -a, a))


def _neg(m: Modifiers) -> LaneOp:
    kind = m.type("s16", "s32", "s64", "f32", "f64")
    if kind[0] == "f":
        return _float_op(1, kind, m.flag("ftz"), False, np.negative)
    return LaneOp((kind,), (kind,), np.negative)


def _minimum(a: Array, b: Array) -> Array:
    """IEEE 754-2019 minimumNumber: a NaN loses against a number, -0 is less than +0."""
    less = (a < b) | ((a == b) & np.signbit(a))
    return np.where(np.isnan(a), b, np.where(np.isnan(b) | less, a, b))


def _maximum(a: Array, b: Array) -> Array:
    return -_minimum(-a, -b)


def _min_or_max(m: Modifiers, is_min: bool) -> LaneOp:
    kind = m.type("u16", "s16", "u32", "s32", "u64", "s64", "f32", "f64")
    if kind[0] != "f":
        return LaneOp((kind, kind), (kind,), np.minimum if is_min else np.maximum)
    ftz, propagate, xorsign = m.flag("ftz"), m.flag("NaN"), m.flag("xorsign")
    if xorsign and not m.flag("abs"):
        raise m.refusal()
    pick = _minimum if is_min else _maximum

    def compute(a: Array, b: Array) -> Array:
        negative = np.signbit(a) ^ np.signbit(b)
        result = pick(np.abs(a), np.abs(b)) if xorsign else pick(a, b)
        if xorsign:
            result = np.where(negative, -result, result)
        return np.where(np.isnan(a) | np.isnan(b), a.dtype.type(np.nan), result) if propagate else result

    return _float_op(2, kind, ftz, False, compute)


def _copysign(m: Modifiers) -> LaneOp:
    """The sign of the first source on the second."""
    kind = m.type("f32", "f64")
    return LaneOp((kind, kind), (kind,), lambda a, b: np.copysign(b, a))


_TESTS: dict[str, Callable[[Array], Array]] = {
    "finite": np.isfinite,
    "infinite": np.isinf,
    "number": lambda x: ~np.isnan(x),
    "notanumber": np.isnan,
    "normal": lambda x: np.isfinite(x) & (np.abs(x) >= np.finfo(x.dtype).tiny),
    "subnormal": lambda x: (x != 0) & (np.abs(x) < np.finfo(x.dtype).tiny),
}


def _testp(m: Modifiers) -> LaneOp:
    kind = m.type("f32", "f64")
    return LaneOp((kind,), ("pred",), _TESTS[m.choice(_TESTS)])


# --- comparison and selection -----------------------------------------------------------------------------------------

_ORDERED: dict[str, Callable[[Array, Array], Array]] = {
    "eq": np.equal,
    "ne": np.not_equal,
    "lt": np.less,
    "le": np.less_equal,
    "gt": np.greater,
    "ge": np.greater_equal,
}
_UNSIGNED = {"lo": "lt", "ls": "le", "hi": "gt", "hs": "ge"}
_COMPARISONS = (*_ORDERED, *_UNSIGNED, "equ", "neu", "ltu", "leu", "gtu", "geu", "num", "nan")
_COMBINERS: dict[str, Callable[[Array, Array], Array]] = {
    "and": np.logical_and,
    "or": np.logical_or,
    "xor": np.logical_xor,
}


def _comparison(m: Modifiers) -> tuple[str, Callable[[Array, Array], Array], str]:
    """-> type, comparison, combiner or ''."""
    name = m.choice(_COMPARISONS)
    combine = m.choice(_COMBINERS, "")
    ftz = m.flag("ftz")
    kind = m.choice(tuple(DTYPES))
    is_float = kind[0] == "f"
    if is_float != (name in _COMPARISONS[-8:]) and name not in _ORDERED:
        raise m.refusal()
    if kind[0] == "b" and name not in ("eq", "ne"):
        raise m.refusal()
    if not is_float:
        return kind, _ORDERED[_UNSIGNED.get(name, name)], combine

    def compare(a: Array, b: Array) -> Array:
        if ftz:
            a, b = flush(a), flush(b)
        unordered = np.isnan(a) | np.isnan(b)
        if name in ("num", "nan"):
            return unordered if name == "nan" else ~unordered
        result = _ORDERED[name[:2]](a, b)
        return result | unordered if name[2:] == "u" else result & ~unordered

    return kind, compare, combine


def _setp(m: Modifiers) -> LaneOp:
    """``setp p|q, a, b[, c]``: p is the comparison, q its opposite, each combined with c."""
    kind, compare, combine = _comparison(m)
    pair = len(m.item.dsts) == 2

    def apply(a: Array, b: Array, c: Array | None = None) -> tuple[Array, ...]:
        result = compare(a, b)
        opposite = ~result
        if combine and c is not None:
            result, opposite = _COMBINERS[combine](result, c), _COMBINERS[combine](opposite, c)
        return (result, opposite) if pair else (result,)

    return LaneOp((kind, kind, *(("pred",) if combine else ())), ("pred",) * (1 + pair), apply)


def _set(m: Modifiers) -> LaneOp:
    """Like ``setp`` with an integer (all ones) or float (1.0) result."""
    name, combine = m.choice(_COMPARISONS), m.choice(_COMBINERS, "")
    ftz = m.flag("ftz")
    result = m.type("u32", "s32", "f32")
    m.rest = [name, *([combine] if combine else []), *(["ftz"] if ftz else []), *m.rest]
    kind, compare, combine = _comparison(m)
    true = np.float32(1) if result == "f32" else DTYPES[result].type(-1 if result == "s32" else 0xFFFFFFFF)

    def apply(a: Array, b: Array, c: Array | None = None) -> Array:
        holds = compare(a, b)
        if combine and c is not None:
            holds = _COMBINERS[combine](holds, c)
        return np.where(holds, true, DTYPES[result].type(0))

    return LaneOp((kind, kind, *(("pred",) if combine else ())), (result,), apply)


def _selp(m: Modifiers) -> LaneOp:
    kind = m.type()
    return LaneOp((kind, kind, "pred"), (kind,), lambda a, b, p: np.where(p, a, b))


def _slct(m: Modifiers) -> LaneOp:
    """a where c >= 0, else b; a NaN selects b, and -0 is >= 0."""
    ftz = m.flag("ftz")
    kind, test = m.type(), m.type("s32", "f32")

    def apply(a: Array, b: Array, c: Array) -> Array:
        return np.where((flush(c) if ftz else c) >= 0, a, b)

    return LaneOp((kind, kind, test), (kind,), apply)


# --- logic, shifts, bit fields ----------------------------------------------------------------------------------------


def _logic(integer: Callable[..., Array], logical: Callable[..., Array], count: int = 2):
    def build(m: Modifiers) -> LaneOp:
        kind = m.type("pred", "b16", "b32", "b64")
        return LaneOp((kind,) * count, (kind,), logical if kind == "pred" else integer)

    return build


def _cnot(m: Modifiers) -> LaneOp:
    kind = m.type("b16", "b32", "b64")
    return LaneOp((kind,), (kind,), lambda a: (a == 0).astype(a.dtype))


def _lop3(m: Modifiers) -> LaneOp:
    """Bit by bit the value that the truth table d holds at index 4a + 2b + c."""
    m.type("b32")
    combine = m.choice(("or", "and"), "")

    def apply(a: Array, b: Array, c: Array, table: Array, q: Array | None = None) -> Array | tuple[Array, ...]:
        result = np.zeros_like(a)
        for index in range(8):
            chosen = (a if index & 4 else ~a) & (b if index & 2 else ~b) & (c if index & 1 else ~c)
            result |= np.where(table >> np.uint32(index) & 1, chosen, np.uint32(0))
        if q is None:
            return result
        return result, ((result != 0) | q) if combine == "or" else ((result != 0) & q)

    if combine:
        return LaneOp(("b32",) * 4 + ("pred",), ("b32", "pred"), apply)
    return LaneOp(("b32",) * 4, ("b32",), apply)


def _shl(m: Modifiers) -> LaneOp:
    kind = m.type("b16", "b32", "b64")
    bits = _bits(kind)

    def apply(a: Array, by: Array) -> Array:
        shifted = a << np.minimum(by, bits - 1).astype(a.dtype)
        return np.where(by >= bits, a.dtype.type(0), shifted)

    return LaneOp((kind, "u32"), (kind,), apply)


def _shr(m: Modifiers) -> LaneOp:
    """Amounts beyond the width count as the width: zero, or the sign everywhere."""
    kind = m.type("b16", "b32", "b64", "u16", "u32", "u64", "s16", "s32", "s64")
    bits = _bits(kind)

    def apply(a: Array, by: Array) -> Array:
        shifted = a >> np.minimum(by, bits - 1).astype(a.dtype)
        return shifted if kind[0] == "s" else np.where(by >= bits, a.dtype.type(0), shifted)

    return LaneOp((kind, "u32"), (kind,), apply)


def _shf(m: Modifiers) -> LaneOp:
    """Funnel shift of the 64 bits b:a; left gives the upper, right the lower word."""
    m.type("b32")
    left, wrap = m.choice(("l", "r")) == "l", m.choice(("wrap", "clamp")) == "wrap"

    def apply(a: Array, b: Array, c: Array) -> Array:
        by = (c & 31 if wrap else np.minimum(c, 32)).astype(np.uint64)
        both = b.astype(np.uint64) << 32 | a
        return (((both << by) >> 32) if left else (both >> by)).astype(np.uint32)

    return LaneOp(("b32", "b32", "u32"), ("b32",), apply)


def _per_lane(function: Callable[..., int]) -> Callable[..., Array]:
    """Lift a function of Python integers to arrays of raw bits."""

    def apply(*sources: Array) -> Array:
        return np.array([function(*map(int, lane)) for lane in zip(*sources, strict=True)], dtype=np.uint64)

    return apply


def _narrow(kind: str, compute: Callable[..., Array]) -> Callable[..., Array]:
    return lambda *sources: compute(*sources).astype(DTYPES[kind])


def _popc(m: Modifiers) -> LaneOp:
    kind = m.type("b32", "b64")
    return LaneOp((kind,), ("u32",), _narrow("u32", _per_lane(int.bit_count)))


def _clz(m: Modifiers) -> LaneOp:
    kind = m.type("b32", "b64")
    return LaneOp((kind,), ("u32",), _narrow("u32", _per_lane(lambda a: _bits(kind) - a.bit_length())))


def _bfind(m: Modifiers) -> LaneOp:
    """Position of the highest bit that is no sign bit, all ones where none is; shiftamt: distance from the top."""
    kind, shiftamt = m.type("u32", "s32", "u64", "s64"), m.flag("shiftamt")
    bits = _bits(kind)

    def find(a: int) -> int:
        position = (~a if a < 0 else a).bit_length() - 1
        if position < 0:
            return 0xFFFFFFFF
        return bits - 1 - position if shiftamt else position

    return LaneOp((kind,), ("u32",), _narrow("u32", _per_lane(find)))


def _brev(m: Modifiers) -> LaneOp:
    kind = m.type("b32", "b64")
    bits = _bits(kind)
    return LaneOp((kind,), (kind,), _narrow(kind, _per_lane(lambda a: int(f"{a:0{bits}b}"[::-1], 2))))


def _bfe(m: Modifiers) -> LaneOp:
    """Field of c bits from bit b (both taken modulo 256); beyond the top: zeros, or the sign of the field's top bit."""
    kind = m.type("u32", "s32", "u64", "s64")
    bits = _bits(kind)
    unsigned = f"u{bits}"

    def extract(a: int, position: int, length: int) -> int:
        position, length = position & 255, length & 255
        if length == 0:
            return 0
        field = (a >> position) & ((1 << length) - 1)
        top = min(position + length - 1, bits - 1)
        if kind[0] == "s" and a >> top & 1:
            have = max(top - position + 1, 0)
            field |= ((1 << bits) - 1) >> have << have
        return field & ((1 << bits) - 1)

    return LaneOp((unsigned, "u32", "u32"), (unsigned,), _narrow(unsigned, _per_lane(extract)))


def _bfi(m: Modifiers) -> LaneOp:
    """Put the low d bits of a into b at bit c (c, d modulo 256); what would go beyond the top is dropped."""
    kind = m.type("b32", "b64")
    bits = _bits(kind)

    def insert(a: int, b: int, position: int, length: int) -> int:
        position, length = position & 255, length & 255
        field = (((1 << length) - 1) << position) & ((1 << bits) - 1)
        return (b & ~field) | ((a << position) & field)

    return LaneOp((kind, kind, "u32", "u32"), (kind,), _narrow(kind, _per_lane(insert)))


def _bmsk(m: Modifiers) -> LaneOp:
    """A mask of b bits from bit a."""
    m.type("b32")
    wrap = m.choice(("clamp", "wrap")) == "wrap"

    def mask(a: int, b: int) -> int:
        a, b = (a & 31, b & 31) if wrap else (min(a, 32), min(b, 32))
        return ((1 << b) - 1) << a & 0xFFFFFFFF

    return LaneOp(("u32", "u32"), ("b32",), _narrow("b32", _per_lane(mask)))


def _szext(m: Modifiers) -> LaneOp:
    """Sign- or zero-extend the low b bits of a."""
    kind = m.type("u32", "s32")
    wrap = m.choice(("clamp", "wrap")) == "wrap"

    def extend(a: int, b: int) -> int:
        b = b & 31 if wrap else min(b, 32)
        field = a & ((1 << b) - 1)
        if kind == "s32" and b and field >> (b - 1):
            field |= ~((1 << b) - 1)
        return field & 0xFFFFFFFF

    return LaneOp(("u32", "u32"), ("u32",), _narrow("u32", _per_lane(extend)))


_PRMT_MODES: dict[str, Callable[[int], tuple[int, ...]]] = {
    "f4e": lambda n: (n, n + 1, n + 2, n + 3),
    "b4e": lambda n: (n, n - 1, n - 2, n - 3),
    "rc8": lambda n: (n, n, n, n),
    "ecl": lambda n: tuple(max(i, n) for i in range(4)),
    "ecr": lambda n: tuple(min(i, n) for i in range(4)),
    "rc16": lambda n: (2 * (n & 1), 2 * (n & 1) + 1) * 2,
}


def _prmt(m: Modifiers) -> LaneOp:
    """Pick four of the eight bytes b:a; a nibble's top bit replicates the byte's sign instead."""
    m.type("b32")
    mode = m.choice(_PRMT_MODES, "")

    def permute(a: int, b: int, selector: int) -> int:
        octets = (a | b << 32).to_bytes(8, "little")
        if mode:
            return int.from_bytes(bytes(octets[i & 7] for i in _PRMT_MODES[mode](selector & 3)), "little")
        result = 0
        for position in range(4):
            nibble = selector >> 4 * position & 15
            octet = octets[nibble & 7]
            if nibble & 8:
                octet = 0xFF if octet & 0x80 else 0
            result |= octet << 8 * position
        return result

    return LaneOp(("b32", "b32", "b32"), ("b32",), _narrow("b32", _per_lane(permute)))


def _fns(m: Modifiers) -> LaneOp:
    """Position of the n-th set bit of a mask, counted from bit ``base`` upwards (n > 0) or downwards (n < 0)."""
    m.type("b32")

    def find(mask: int, base: int, offset: int) -> int:
        if offset == 0:
            return base if base < 32 and mask >> base & 1 else 0xFFFFFFFF
        left, step, position = abs(offset), (1 if offset > 0 else -1), base
        while 0 <= position < 32:
            left -= mask >> position & 1
            if left == 0:
                return position
            position += step
        return 0xFFFFFFFF

    return LaneOp(("b32", "b32", "s32"), ("b32",), _narrow("b32", _per_lane(find)))


def _dot(a: Array, b: Array, types: tuple[str, str], width: int) -> tuple[Array, Array]:
    """The sub-words of a, ``width`` bits each, and the bytes of b; (32, ...) int64."""
    columns = 32 // width
    x = a.view(f"{'i' if types[0] == 's32' else 'u'}{width // 8}").reshape(-1, columns).astype(np.int64)
    y = b.view("i1" if types[1] == "s32" else "u1").reshape(-1, 4).astype(np.int64)
    return x, y


def _dp4a(m: Modifiers) -> LaneOp:
    types = (m.type("u32", "s32"), m.type("u32", "s32"))
    result = "s32" if "s32" in types else "u32"

    def apply(a: Array, b: Array, c: Array) -> Array:
        x, y = _dot(a, b, types, 8)
        return ((x * y).sum(axis=1) + c.astype(np.int64)).astype(DTYPES[result])

    return LaneOp(("b32", "b32", result), (result,), apply)


def _dp2a(m: Modifiers) -> LaneOp:
    types = (m.type("u32", "s32"), m.type("u32", "s32"))
    first = 0 if m.choice(("lo", "hi")) == "lo" else 2
    result = "s32" if "s32" in types else "u32"

    def apply(a: Array, b: Array, c: Array) -> Array:
        x, y = _dot(a, b, types, 16)
        return ((x * y[:, first : first + 2]).sum(axis=1) + c.astype(np.int64)).astype(DTYPES[result])

    return LaneOp(("b32", "b32", result), (result,), apply)


# --- moves and conversions --------------------------------------------------------------------------------------------


def _mov(m: Modifiers) -> LaneOp:
    kind = m.type()
    return LaneOp((kind,), (kind,), lambda a: a)


_TO_INTEGER = {"rni": np.rint, "rzi": np.trunc, "rmi": np.floor, "rpi": np.ceil}


def _cvt(m: Modifiers) -> LaneOp:
    ftz, sat = m.flag("ftz"), m.flag("sat")
    mode = m.choice((*ROUNDINGS, *_TO_INTEGER), "")
    target, source = m.type(), m.type()
    if "pred" in (target, source) or target[0] == "b" or source[0] == "b":
        raise m.refusal()
    from_float, to_float = source[0] == "f", target[0] == "f"
    if from_float and to_float:
        convert = _float_to_float(target, source, mode, ftz, sat)
    elif from_float:
        if mode not in _TO_INTEGER:
            raise m.refusal()
        convert = _float_to_integer(target, source, mode, ftz)
    elif to_float:
        if mode not in ROUNDINGS:
            raise m.refusal()

        def convert(a: Array) -> Array:
            result = rounding.from_integers(a, DTYPES[target], mode)
            return saturate(result) if sat else result
    else:
        convert = _integer_to_integer(target, sat)
    return LaneOp((source,), (target,), convert)


def _float_to_float(target: str, source: str, mode: str, ftz: bool, sat: bool) -> Callable[[Array], Array]:
    def convert(a: Array) -> Array:
        with np.errstate(all="ignore"):
            x = flush(a) if ftz else a
            if mode in _TO_INTEGER:
                x = _TO_INTEGER[mode](x)
            result = rounding.narrow(x, mode) if (target, source) == ("f32", "f64") else x.astype(DTYPES[target])
        result = flush(result) if ftz else result
        return saturate(result) if sat else canonical(result)

    return convert


def _float_to_integer(target: str, source: str, mode: str, ftz: bool) -> Callable[[Array], Array]:
    """Results are clamped to the target's range. NaN: zero, but where a 64-bit type takes part the value with only the
    target's top bit set (PTX ISA, ``cvt``)."""
    dtype, bits = DTYPES[target], _bits(target)
    low, high = (-(1 << bits - 1), (1 << bits - 1) - 1) if target[0] == "s" else (0, (1 << bits) - 1)
    nan = 1 << (bits - 1) if source == "f64" or bits == 64 else 0

    def convert(a: Array) -> Array:
        with np.errstate(all="ignore"):
            whole = _TO_INTEGER[mode](flush(a) if ftz else a).astype(np.float64)
        results = []
        for x in whole.tolist():
            if x != x:
                results.append(nan)
            elif x in (float("inf"), float("-inf")):
                results.append(high if x > 0 else low)
            else:
                results.append(min(max(int(x), low), high))
        unsigned = np.array([r & ((1 << bits) - 1) for r in results], dtype=f"u{bits // 8}")
        return unsigned.view(dtype)

    return convert


def _integer_to_integer(target: str, sat: bool) -> Callable[[Array], Array]:
    dtype = DTYPES[target]
    if not sat:
        return lambda a: a.astype(dtype)
    limits = np.iinfo(dtype)
    return lambda a: np.array([min(max(int(x), limits.min), limits.max) for x in a], dtype=dtype)


_BUILDERS: dict[str, Callable[[Modifiers], LaneOp]] = {
    "abs": _abs,
    "add": _add,
    "addc": lambda m: _with_carry(m, takes=True),
    "and": _logic(np.bitwise_and, np.logical_and),
    "bfe": _bfe,
    "bfi": _bfi,
    "bfind": _bfind,
    "bmsk": _bmsk,
    "brev": _brev,
    "clz": _clz,
    "cnot": _cnot,
    "copysign": _copysign,
    "cos": _approximation(np.cos),
    "cvt": _cvt,
    "div": _div,
    "dp2a": _dp2a,
    "dp4a": _dp4a,
    "ex2": _approximation(np.exp2),
    "fma": _fma,
    "fns": _fns,
    "lg2": _approximation(np.log2),
    "lop3": _lop3,
    "mad": _mad,
    "madc": lambda m: _with_carry(m, takes=True),
    "mad24": _mad24,
    "max": lambda m: _min_or_max(m, is_min=False),
    "min": lambda m: _min_or_max(m, is_min=True),
    "mov": _mov,
    "mul": _mul,
    "mul24": _mul24,
    "neg": _neg,
    "not": _logic(np.bitwise_not, np.logical_not, count=1),
    "or": _logic(np.bitwise_or, np.logical_or),
    "prmt": _prmt,
    "popc": _popc,
    "rcp": _rcp,
    "rem": _rem,
    "rsqrt": _rsqrt,
    "sad": _sad,
    "selp": _selp,
    "set": _set,
    "setp": _setp,
    "shf": _shf,
    "shl": _shl,
    "shr": _shr,
    "sin": _approximation(np.sin),
    "slct": _slct,
    "sqrt": _sqrt,
    "sub": _sub,
    "subc": lambda m: _with_carry(m, takes=True),
    "szext": _szext,
    "tanh": _approximation(np.tanh),
    "testp": _testp,
    "xor": _logic(np.bitwise_xor, np.logical_xor),
}
