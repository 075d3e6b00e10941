"""Correctly rounded float arithmetic in NumPy, in each of PTX's four roundings (rn, rz, rm, rp).

NumPy has neither a fused multiply-add nor directed roundings. float32 goes through float64 values *rounded to odd*
(truncated, last bit set where anything was lost), which any later rounding to 24 bits gets right (Boldo and
Melquiond, "Emulation of a FMA and correctly rounded sums", 2008). float64 uses the same idea where nothing can
overflow, and exact fractions, lane by lane, everywhere else.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from fractions import Fraction

import numpy as np

Array = np.ndarray


def add(a: Array, b: Array, mode: str) -> Array:
    if mode == "rn":
        return a + b
    if a.dtype == np.float32:
        total, lost = _two_sum(a.astype(np.float64), b.astype(np.float64))
        return _zero_sign(_to_f32(_odd(total, lost), mode), a, b, mode)
    return _lanes(lambda x, y: x + y, mode, a + b, a, b, terms=lambda x, y: (x, y))


def mul(a: Array, b: Array, mode: str) -> Array:
    if mode == "rn":
        return a * b
    if a.dtype == np.float32:
        return _to_f32(a.astype(np.float64) * b.astype(np.float64), mode)
    return _lanes(lambda x, y: x * y, mode, a * b, a, b)


def fma(a: Array, b: Array, c: Array, mode: str) -> Array:
    if a.dtype == np.float32:
        product = a.astype(np.float64) * b.astype(np.float64)  # exact: 24 + 24 bits
        total, lost = _two_sum(product, c.astype(np.float64))
        return _zero_sign(_to_f32(_odd(total, lost), mode), product, c, mode)
    if mode == "rn" and _is_tame(a) and _is_tame(b) and _is_tame(c):
        return _fma_f64(a, b, c)
    plain = np.where(np.isfinite(a) & np.isfinite(b), c, a * b + c)  # right where an operand is not finite
    return _lanes(
        lambda x, y, z: x * y + z,
        mode,
        plain,
        a,
        b,
        c,
        terms=lambda x, y, z: (math.copysign(1.0, x) * math.copysign(1.0, y), z),
    )


def div(a: Array, b: Array, mode: str) -> Array:
    if mode == "rn":
        return a / b
    with np.errstate(all="ignore"):
        plain = a / b
    return _lanes(lambda x, y: x / y, mode, plain, a, b, only=b != 0)


def sqrt(a: Array, mode: str) -> Array:
    if mode == "rn":
        return np.sqrt(a)
    return _lanes(_odd_root, mode, np.sqrt(a), a, only=a > 0)


def narrow(a: Array, mode: str) -> Array:
    """float64 -> float32."""
    return _to_f32(a, mode)


def from_integers(a: Array, dtype: np.dtype, mode: str) -> Array:
    if mode == "rn":
        return a.astype(dtype)
    return np.array([_round(Fraction(int(x)), dtype, mode) for x in a], dtype=dtype)


# --- round to odd -----------------------------------------------------------------------------------------------------


def _two_sum(a: Array, b: Array) -> tuple[Array, Array]:
    """a + b and exactly what that rounding lost (Knuth); NaN where the sum is not finite."""
    total = a + b
    back = total - a
    return total, (a - (total - back)) + (b - back)


def _odd(total: Array, lost: Array) -> Array:
    """Replace the nearest float64 ``total`` by the one rounded to odd, given the error of the former."""
    bits = total.view(np.int64)
    inexact = np.isfinite(total) & (lost != 0) & ((bits & 1) == 0)
    outwards = (lost > 0) == (total > 0)
    return np.where(inexact, bits + np.where(outwards, 1, -1), bits).view(np.float64)


def _to_f32(x: Array, mode: str) -> Array:
    """Round float64 to float32; right also for results of ``_odd``."""
    with np.errstate(all="ignore"):
        nearest = x.astype(np.float32)
        wide = nearest.astype(np.float64)
        if mode == "rz":
            wrong, towards = np.abs(wide) > np.abs(x), np.float32(0)
        elif mode == "rm":
            wrong, towards = wide > x, np.float32(-np.inf)
        elif mode == "rp":
            wrong, towards = wide < x, np.float32(np.inf)
        else:
            return nearest
        return np.where(wrong, np.nextafter(nearest, towards), nearest)


def _zero_sign(result: Array, a: Array, b: Array, mode: str) -> Array:
    """A sum that cancels is +0, rounding down -0; (+0) + (+0) keeps its sign."""
    if mode != "rm":
        return result
    both_positive = ~np.signbit(a) & ~np.signbit(b)
    exact_zero = (result == 0) & (a.astype(np.float64) + b.astype(np.float64) == 0)
    return np.where(exact_zero & ~both_positive, np.float32(-0.0), result)


def _is_tame(x: Array) -> bool:
    """All lanes zero or within 2^-200 .. 2^200: no product or error term of them over- or underflows."""
    size = np.abs(x)
    return bool(np.all((size == 0) | ((size > 2.0**-200) & (size < 2.0**200))))


def _two_product(a: Array, b: Array) -> tuple[Array, Array]:
    """a * b and exactly what that rounding lost (Dekker, with Veltkamp's split)."""
    splitter = 2.0**27 + 1
    a_high = splitter * a - (splitter * a - a)
    b_high = splitter * b - (splitter * b - b)
    a_low, b_low = a - a_high, b - b_high
    product = a * b
    return product, ((a_high * b_high - product) + a_high * b_low + a_low * b_high) + a_low * b_low


def _fma_f64(a: Array, b: Array, c: Array) -> Array:
    high, low = _two_product(a, b)
    middle, lowest = _two_sum(c, low)
    total, rest = _two_sum(high, middle)
    tail = _odd(*_two_sum(rest, lowest))
    return total + tail


# --- exact fractions --------------------------------------------------------------------------------------------------


def _lanes(
    compute: Callable[..., Fraction],
    mode: str,
    plain: Array,
    *sources: Array,
    only: Array | bool = True,
    terms: Callable[..., tuple[float, float]] | None = None,
) -> Array:
    """Exact lane by lane where every operand is finite (and ``only`` holds), else ``plain``.

    terms: the two terms of a sum, whose signs decide the sign of a result of zero; else a zero comes from ``plain``.
    """
    result = plain.copy()
    finite = np.logical_and.reduce([np.isfinite(s) for s in sources]) & only
    for lane in np.flatnonzero(finite):
        operands = [float(s[lane]) for s in sources]
        exact = compute(*map(Fraction, operands))
        if exact:
            result[lane] = _round(exact, plain.dtype, mode)
        elif terms is not None:
            result[lane] = _zero([math.copysign(1.0, term) for term in terms(*operands)], mode)
    return result


def _zero(signs: list[float], mode: str) -> float:
    """The sum of two terms that cancel, or of two zeros: terms of one sign keep it, else +0, rounding down -0."""
    if signs[0] == signs[1]:
        return math.copysign(0.0, signs[0])
    return -0.0 if mode == "rm" else 0.0


def _round(x: Fraction, dtype: np.dtype, mode: str) -> float:
    """The float of ``dtype`` that ``x`` rounds to; overflow as IEEE 754 has it."""
    digits, lowest, highest = (24, -149, 128) if dtype == np.float32 else (53, -1074, 1024)
    size = abs(x)
    if size == 0:
        return 0.0
    exponent = size.numerator.bit_length() - size.denominator.bit_length()
    if size < Fraction(2) ** exponent:
        exponent -= 1
    quantum = max(exponent - digits + 1, lowest)
    scaled = size / Fraction(2) ** quantum
    whole = scaled.numerator // scaled.denominator
    rest = scaled - whole
    away = {"rn": rest > Fraction(1, 2) or (rest == Fraction(1, 2) and whole & 1 == 1), "rz": False}
    away |= {"rm": rest > 0 and x < 0, "rp": rest > 0 and x > 0}
    whole += away[mode]
    if whole.bit_length() + quantum > highest:
        outwards = mode == "rn" or (mode == "rm" and x < 0) or (mode == "rp" and x > 0)
        value = math.inf if outwards else math.ldexp((1 << digits) - 1, highest - digits)
    else:
        value = math.ldexp(whole, quantum)
    return -value if x < 0 else value


def _odd_root(x: Fraction) -> Fraction:
    """The square root, rounded to odd far below the last digit of any float."""
    shift = 2 * (600 + max(0, x.denominator.bit_length() - x.numerator.bit_length()))
    scaled = (x.numerator << shift) // x.denominator
    root = math.isqrt(scaled)
    if root * root != scaled or scaled * x.denominator != x.numerator << shift:
        root |= 1
    return Fraction(root, 1 << (shift // 2))
