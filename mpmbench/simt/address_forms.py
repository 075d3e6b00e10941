"""Which accesses of a block are neighbours: every address as a sum of unknowns plus a constant, where that is provable.

Two addresses with the same unknowns differ by a constant. Four adds to consecutive floats can then be one 16-byte add,
and one vector of addresses serves all of them.

All sums are modulo the register's width, so 32-bit arithmetic that may wrap is only widened where it cannot matter:
``sext(x + 9)`` is ``sext(x + 8) + 1`` if x is known to be a multiple of 2, because no carry leaves the lowest bit.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass

from mpmbench.simt.ptx import Address, Imm, Instruction, Operand, Reg, Symbol

_MEMORY_ROOTS = frozenset({"ld", "st", "atom", "red"})
_DEPTH = 24  # of the chains of definitions that are followed


@dataclass(frozen=True)
class Form:
    """``sum(coefficient * unknown) + constant`` modulo 2^64 or 2^32. zeros: low bits of the sum known to be zero."""

    terms: tuple[tuple[str, int], ...]
    constant: int
    zeros: int

    def shifted(self, constant: int) -> Form:
        return Form(self.terms, self.constant + constant, self.zeros)


def _unknown(name: str, zeros: int = 0) -> Form:
    return Form(((name, 1),), 0, zeros)


def _add(a: Form, b: Form, sign: int, bits: int) -> Form:
    terms = dict(a.terms)
    for name, coefficient in b.terms:
        terms[name] = (terms.get(name, 0) + sign * coefficient) % (1 << bits)
    kept = tuple(sorted((name, c) for name, c in terms.items() if c))
    return Form(
        kept,
        a.constant + sign * b.constant,
        min(a.zeros, b.zeros) if a.terms and b.terms else (a if a.terms else b).zeros,
    )


def _scale(a: Form, factor: int, bits: int) -> Form:
    if factor == 0:
        return Form((), 0, bits)
    zeros = a.zeros + (factor & -factor).bit_length() - 1
    return Form(
        tuple((n, c * factor % (1 << bits)) for n, c in a.terms if c * factor % (1 << bits)),
        a.constant * factor,
        zeros,
    )


def _widen(a: Form, how: str) -> Form:
    """Sign- or zero-extend a 32-bit form: only the constant's part below the known zero bits may come out."""
    low = a.constant & ((1 << min(a.zeros, 31)) - 1)
    high = a.constant - low
    if not a.terms:
        value = a.constant & 0xFFFFFFFF
        return Form((), value - (1 << 32) if how == "sext" and value >> 31 else value, 64)
    inside = ",".join(f"{n}*{c}" for n, c in a.terms)
    zeros = a.zeros if high == 0 else min(a.zeros, (high & -high).bit_length() - 1)
    return Form(((f"{how}({inside}+{high & 0xFFFFFFFF})", 1),), low, zeros)


class _Changing(Exception):
    """A register with several definitions."""


class AddressForms:
    """Forms of the addresses in one kernel. Registers with a single definition are followed across blocks."""

    def __init__(self, instructions: list[Instruction]) -> None:
        self._definition: dict[Reg, Instruction | None] = {}
        for item in instructions:
            for reg in item.writes():
                single = reg not in self._definition and item.guard is None and len(item.dsts) == 1
                self._definition[reg] = item if single else None
        self._single: dict[Reg, Form] = {}

    def of_block(self, instructions: list[Instruction], start: int) -> dict[int, Form]:
        """Form of every memory instruction's address, by its index in the kernel; start: index of the first one."""
        local: dict[Reg, Form] = {}
        result: dict[int, Form] = {}
        for index, item in enumerate(instructions, start):
            if item.root in _MEMORY_ROOTS:
                address = next(s for s in item.srcs if isinstance(s, Address))
                bits = 32 if isinstance(address.base, Reg) and address.base.type == "b32" else 64
                result[index] = self._operand(address.base, local, bits, 0).shifted(address.offset)
            for position, reg in enumerate(item.writes()):
                form = None
                if item.guard is None and len(item.dsts) == 1:
                    form = self._computed(item, local, 0)
                local[reg] = form or _unknown(f"{reg.name}@{index}.{position}")
        return result

    def _operand(self, operand: Operand, local: dict[Reg, Form], bits: int, depth: int) -> Form:
        match operand:
            case Reg():
                return local[operand] if operand in local else self._before(operand, depth)
            case Imm(value, 0):
                return Form((), value, bits)
            case Symbol(name, space, offset) if space == "shared":
                return Form((), offset, bits)
            case Symbol(name, space, offset):
                return Form(((f"&{space}:{name if space in ('global', 'const') else ''}", 1),), offset, 4)
        return _unknown(f"?{operand}")

    def _before(self, reg: Reg, depth: int) -> Form:
        """A register that the block did not write."""
        if reg in self._single:
            return self._single[reg]
        definition = self._definition.get(reg)
        if definition is None and depth:
            raise _Changing  # inside another register's definition: it may have had another value then
        form = None
        if definition is not None and depth < _DEPTH:
            with contextlib.suppress(_Changing):
                form = self._computed(definition, {}, depth + 1)
        self._single[reg] = form = form or _unknown(reg.name)
        return form

    def _computed(self, item: Instruction, local: dict[Reg, Form], depth: int) -> Form | None:
        """Form of an instruction's result, or None for anything but integer sums and products with constants."""
        root, kinds = item.root, item.modifiers
        if not kinds:
            return None
        kind = kinds[-1]
        if kind[1:] not in ("32", "64") or kind[0] not in "usb":
            return None
        bits = int(kind[1:])

        def form(position: int) -> Form:
            return self._operand(item.srcs[position], local, bits, depth)

        def constant(position: int) -> int | None:
            operand = item.srcs[position]
            return operand.value if isinstance(operand, Imm) and not operand.float_bits else None

        if root in ("mov", "cvta") and len(item.srcs) == 1:
            if root == "cvta" and "shared" in kinds:
                return None
            return form(0) if isinstance(item.srcs[0], Reg | Imm | Symbol) else None
        if root in ("add", "sub") and "sat" not in kinds:
            return _add(form(0), form(1), 1 if root == "add" else -1, bits)
        if root == "or" and (low := constant(1)) is not None:
            a = form(0)
            # No set bit of the constant meets a bit of the sum: or is add.
            free = a.zeros if a.constant == 0 else min(a.zeros, (a.constant & -a.constant).bit_length() - 1)
            return a.shifted(low) if 0 <= low < 1 << free else None
        if root == "shl" and (count := constant(1)) is not None and 0 <= count < bits:
            return _scale(form(0), 1 << count, bits)
        if root in ("mul", "mad") and kinds[0] in ("lo", "wide") and (factor := constant(1)) is not None:
            a = form(0)
            if kinds[0] == "wide":
                if bits != 32:
                    return None
                a, bits = _widen(a, "sext" if kind[0] == "s" else "zext"), 64
            product = _scale(a, factor, bits)
            if root == "mul":
                return product
            return _add(product, self._operand(item.srcs[2], local, bits, depth), 1, bits)
        if root == "cvt" and kinds[0][1:] == "64" and kind in ("s32", "u32"):
            return _widen(form(0), "sext" if kind == "s32" else "zext")
        return None
