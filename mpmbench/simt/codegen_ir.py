"""Writing LLVM text: fresh names, vector types, constants. One value per lane is a vector of ``lanes`` elements."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

from mpmbench.simt.ptx import Reg

WARP = 32

# Element type in LLVM of a register's declared type, and its bytes in a register slot (predicates are one bit).
REGISTER_ELEMENT = {"pred": "i1", "b16": "i16", "b32": "i32", "b64": "i64", "f32": "float", "f64": "double"}
ELEMENT_BYTES = {"i8": 1, "i16": 2, "i32": 4, "i64": 8, "float": 4, "double": 8}
_INTEGER_OF = {"float": "i32", "double": "i64"}
_MANGLED = {"float": "f32", "double": "f64"}


def element_of(reg: Reg) -> str:
    return REGISTER_ELEMENT[reg.type]


def integer_of(element: str) -> str:
    """The integer element of the same width."""
    return _INTEGER_OF.get(element, element)


def bits_of(element: str) -> int:
    return 1 if element == "i1" else 8 * ELEMENT_BYTES[element]


class Writer:
    """Collects the lines of one LLVM function for vectors of ``lanes`` lanes, and the intrinsics they call."""

    def __init__(self, lanes: int) -> None:
        self.lanes = lanes
        self.lines: list[str] = []
        self.allocas: list[str] = []
        self.declarations: dict[str, str] = {}
        self.factors: dict[str, tuple[str, str]] = {}  # of every product of floats
        self._count = 0

    # --- lines and names ---

    def name(self) -> str:
        self._count += 1
        return f"%t{self._count}"

    def emit(self, line: str) -> None:
        self.lines.append(line)

    def value(self, expression: str) -> str:
        """Emit ``%new = expression`` and return the name."""
        name = self.name()
        self.lines.append(f"{name} = {expression}")
        return name

    def label(self, label: str) -> None:
        self.lines.append(f"{label}:")

    def buffer(self, size: int) -> str:
        """Stack bytes that live as long as the function."""
        name = self.name()
        self.allocas.append(f"{name} = alloca [{size} x i8], align 64")
        return name

    # --- types and constants ---

    def vector(self, element: str, lanes: int | None = None) -> str:
        return f"<{lanes or self.lanes} x {element}>"

    def splat_int(self, element: str, value: int) -> str:
        """A constant with the same integer in every lane (wrapped to the element's width)."""
        if element == "i1":
            return f"splat (i1 {'true' if value & 1 else 'false'})"
        bits = bits_of(element)
        value &= (1 << bits) - 1
        signed = value - (1 << bits) if value >> (bits - 1) else value
        return f"splat ({element} {signed})"

    def splat_bits(self, element: str, pattern: int) -> str:
        """A constant with this bit pattern in every lane."""
        integer = integer_of(element)
        if integer == element:
            return self.splat_int(element, pattern)
        return self.cast("bitcast", self.splat_int(integer, pattern), integer, element)

    def splat(self, element: str, scalar: str) -> str:
        """Every lane gets the scalar value."""
        vector = self.vector(element)
        first = self.value(f"insertelement {vector} poison, {element} {scalar}, i32 0")
        return self.value(f"shufflevector {vector} {first}, {vector} poison, <{self.lanes} x i32> zeroinitializer")

    # --- operations ---

    def binary(self, operation: str, element: str, left: str, right: str) -> str:
        name = self.value(f"{operation} {self.vector(element)} {left}, {right}")
        if operation == "fmul":
            self.factors[name] = left, right
        return name

    def compare(self, operation: str, element: str, left: str, right: str) -> str:
        """operation: ``icmp slt``, ``fcmp olt``, ..."""
        return self.value(f"{operation} {self.vector(element)} {left}, {right}")

    def select(self, element: str, condition: str, yes: str, no: str) -> str:
        vector = self.vector(element)
        return self.value(f"select {self.vector('i1')} {condition}, {vector} {yes}, {vector} {no}")

    def cast(self, operation: str, value: str, source: str, target: str) -> str:
        return self.value(f"{operation} {self.vector(source)} {value} to {self.vector(target)}")

    def reinterpret(self, value: str, source: str, target: str) -> str:
        """The same bits as another element type of the same width."""
        return value if source == target else self.cast("bitcast", value, source, target)

    def invert(self, predicate: str) -> str:
        return self.binary("xor", "i1", predicate, "splat (i1 true)")

    def intrinsic(self, name: str, element: str, *operands: str, extra: str = "") -> str:
        """Call an element-wise intrinsic, ``llvm.fma`` on ``<16 x float>``; extra: trailing scalar arguments."""
        vector = self.vector(element)
        full = f"{name}.v{self.lanes}{_MANGLED.get(element, element)}"
        arguments = ", ".join(f"{vector} {operand}" for operand in operands)
        self.declare(f"declare {vector} @{full}({', '.join([vector] * len(operands))}{', i1' if extra else ''})")
        return self.value(f"call {vector} @{full}({arguments}{extra})")

    def shuffle(self, element: str, left: str, right: str, indices: Iterable[int]) -> str:
        chosen = list(indices)
        vector = self.vector(element)
        mask = ", ".join(f"i32 {index}" for index in chosen)
        return self.value(f"shufflevector {vector} {left}, {vector} {right}, <{len(chosen)} x i32> <{mask}>")

    def declare(self, declaration: str) -> None:
        found = re.search(r"@([\w.]+)\(", declaration)
        assert found
        self.declarations[found[1]] = declaration

    # --- memory ---

    def at(self, base: str, offset: int | str) -> str:
        """``base`` plus bytes."""
        if offset == 0:
            return base
        return self.value(f"getelementptr i8, ptr {base}, i64 {offset}")

    def load(self, kind: str, address: str, align: int) -> str:
        return self.value(f"load {kind}, ptr {address}, align {align}")

    def store(self, kind: str, value: str, address: str, align: int) -> None:
        self.emit(f"store {kind} {value}, ptr {address}, align {align}")

    def masked_store(self, element: str, value: str, address: str, mask: str, align: int) -> None:
        vector, mask_vector = self.vector(element), self.vector("i1")
        full = f"llvm.masked.store.v{self.lanes}{_MANGLED.get(element, element)}.p0"
        self.declare(f"declare void @{full}({vector}, ptr, {mask_vector})")
        self.emit(f"call void @{full}({vector} {value}, ptr align {align} {address}, {mask_vector} {mask})")

    def transpose4(self, element: str, rows: Sequence[str]) -> list[str]:
        """Transpose the 4x4 tiles of four vectors: tile k is elements 4k..4k+3 of each.

        Four vectors of one component per lane become four of whole lanes, and back: element 4k+q of result j is
        component q of lane 4k+j.
        """
        tiles, n = range(self.lanes // 4), self.lanes
        low = [i for k in tiles for i in (4 * k, 4 * k + n, 4 * k + 1, 4 * k + 1 + n)]
        high = [i + 2 for i in low]
        first = [i for k in tiles for i in (4 * k, 4 * k + 1, 4 * k + n, 4 * k + 1 + n)]
        second = [i + 2 for i in first]
        a, b, c, d = rows
        ab_low, ab_high = self.shuffle(element, a, b, low), self.shuffle(element, a, b, high)
        cd_low, cd_high = self.shuffle(element, c, d, low), self.shuffle(element, c, d, high)
        return [
            self.shuffle(element, ab_low, cd_low, first),
            self.shuffle(element, ab_low, cd_low, second),
            self.shuffle(element, ab_high, cd_high, first),
            self.shuffle(element, ab_high, cd_high, second),
        ]
