"""How many machine instructions (SASS) a PTX instruction becomes, and which unit of an SM they keep busy.

An estimate by opcode and by the literal among the operands. Arithmetic weights are what ``ptxas`` 12.9 makes of the
instruction between a load and a store; weights below one say how often it vanishes in a neighbour: an address sum in
the offset of a load, a copy in the choice of registers, a sign in an operand. Tests hold the sum over every shipped
kernel to the instructions that ``ptxas`` writes for it.

Sequences (division, square root) count as their fast path; the slow path is a call that ordinary numbers never take.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

from mpmbench.simt.ptx import Instruction

# "control" and "move" cost an issue slot and no unit that could bind; the others have a rate in GPU descriptions.
CLASSES = (
    "fp32",
    "fp64",
    "int_add",
    "int_mul",
    "logic",
    "shift",
    "compare",
    "convert",
    "special",
    "load_store",
    "control",
    "move",
)

# One trip of the loop that an addition of floats in shared memory becomes (load, add, compare-and-swap, test, branch).
# It goes round until every lane has won its word: Tally.satom_iter counts trips. 64-bit floats take the same.
CAS_TRIP: Mapping[str, float] = {"load_store": 2.0, "fp32": 1.0, "compare": 1.0, "control": 1.0}

_SPECIAL = ("rcp", "sqrt", "rsqrt", "sin", "cos", "ex2", "lg2", "tanh")


def is_shared_float_add(opcode: str) -> bool:
    """Whether an opcode becomes the loop of CAS_TRIP."""
    root, *modifiers = opcode.split(".")
    return root in ("atom", "red") and "shared" in modifiers and "add" in modifiers and modifiers[-1] in ("f32", "f64")


def instruction_weight(instruction: Instruction, arch: str) -> tuple[str, float]:
    """``weight`` of a parsed instruction."""
    return weight(instruction.opcode, arch, instruction.literal)


@lru_cache(maxsize=65536)
def weight(opcode: str, arch: str, literal: int | None = None) -> tuple[str, float]:
    """(class, machine instructions per PTX instruction) of an opcode such as "ld.global.v4.f32" on "sm_52".

    literal: value of the integer literal among its operands, None if all are registers. An addition of floats in
    shared memory counts what stands around its loop; the trips are CAS_TRIP each. Opcodes that this project's kernels
    do not use count as one move.
    """
    root, *modifiers = opcode.split(".")
    kind = modifiers[-1] if modifiers else ""
    maxwell = int(arch.removeprefix("sm_").rstrip("af")) < 70
    if root in ("ld", "ldu", "st", "atom", "red", "shfl", "prefetch"):
        return _memory(root, modifiers, opcode)
    if root in ("bra", "brx", "bar", "barrier", "ret", "exit", "call", "membar", "fence", "trap", "nanosleep"):
        # A branch that may part a warp needs a second instruction where its lanes meet again.
        return "control", 0.5 if opcode == "bra.uni" else 1.5 if root == "bra" else 1.0
    if root in ("mov", "cvta", "isspacep"):
        return "move", 0.0 if root == "cvta" else 0.3
    if root == "cvt":
        return _conversion(modifiers, maxwell)
    if root in ("setp", "set", "min", "max"):
        return "compare", _wide(kind, 2.0)
    if root in _SPECIAL and kind != "f64" and "approx" in modifiers:
        return "special", 2.0 if root in ("sin", "cos") or (root == "ex2" and maxwell) else 1.0
    if kind in ("f32", "f16", "f16x2", "bf16", "f64"):
        return _floating(root, modifiers, "fp64" if kind == "f64" else "fp32")
    return _integer(root, modifiers, kind, maxwell, literal)


def _memory(root: str, modifiers: list[str], opcode: str) -> tuple[str, float]:
    if root == "ld" and "param" in modifiers:
        return "move", 0.3  # an operand in the constant bank
    if is_shared_float_add(opcode):
        return "control", 3.0
    return "load_store", 1.0


def _conversion(modifiers: list[str], maxwell: bool) -> tuple[str, float]:
    kinds = [name for name in modifiers if name[1:].isdecimal() and name[0] in "subf"]
    to, origin = kinds[-2:]
    if "f" not in to[0] + origin[0]:  # between integers: the sign or nothing
        return "shift", 0.5 if int(to[1:]) > int(origin[1:]) else 0.0
    return "convert", 1.8 if maxwell and "64" in to + origin else 1.0


def _floating(root: str, modifiers: list[str], unit: str) -> tuple[str, float]:
    double = unit == "fp64"
    if root in ("abs", "neg"):
        return unit, 0.0
    if root == "copysign":
        return "logic", 2.0 if double else 1.0
    if root == "selp":
        return "logic", 2.0 if double else 1.0
    if root == "div":
        return unit, 20.0 if double else 2.0 if "approx" in modifiers else 8.0 if "full" in modifiers else 10.0
    if root in ("rcp", "sqrt", "rsqrt"):
        return unit, 14.0 if double else 8.0
    return unit, 1.0


def _integer(root: str, modifiers: list[str], kind: str, maxwell: bool, literal: int | None) -> tuple[str, float]:
    long = kind.endswith("64")
    if root in ("mul", "mad"):
        if "wide" in modifiers:  # nearly always the size of an array element: shifts on Maxwell
            return ("shift", 2.0) if maxwell else ("int_mul", 1.0)
        if "hi" in modifiers:
            return "int_mul", 5.4 if maxwell else 1.0
        if long:
            return "int_mul", 16.0 if maxwell else 5.0
        return "int_mul", (3.0 if literal is None else 2.0) if maxwell else 1.0
    if root in ("div", "rem"):
        signed = kind[0] == "s"
        return "int_add", 150.0 if long else (33.0 if signed else 29.0) if maxwell else (23.0 if signed else 17.0)
    if root in ("add", "sub", "neg", "abs", "addc", "subc"):
        if long and literal is not None:  # the offset in a load or store
            return "int_add", 0.0
        # Two instructions, but many share a part, and Volta multiplies and adds to 64 bits at once.
        return "int_add", (1.5 if maxwell else 1.0) if long else 1.0
    if root in ("shl", "shr", "shf", "bfe", "bfi", "prmt"):
        return "shift", _wide(kind, 2.0)
    if root in ("popc", "brev", "bfind", "clz"):
        return "special", 2.0 if root == "clz" else 1.0
    if kind == "pred":
        return "logic", 0.5
    if root in ("and", "or", "xor", "not", "lop3", "selp", "cnot"):
        return "logic", _wide(kind, 2.0)
    return "move", 1.0


def _wide(kind: str, factor: float) -> float:
    return factor if kind.endswith("64") and kind[0] != "f" else 1.0
