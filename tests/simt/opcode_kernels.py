"""Kernels of generated PTX that apply single instructions to chosen operands under chosen masks."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import corpus_kernels as corpus
import numpy as np

from mpmbench.simt import numpy_ops

THREADS = 512
BLOCK = 128
SLOTS = 6  # operands, and what the destinations hold before
PLANE = 8 * THREADS  # bytes of one operand of all threads

_REGISTER = {"pred": "pred", "f32": "f32", "f64": "f64"}
_REGISTER |= {f"{kind}{bits}": f"b{max(bits, 16)}" for kind in "bus" for bits in (8, 16, 32, 64)}

LOP3_TABLES = (0x96, 0xE8, 0xCA, 0x01, 0x80, 0xFE, 0x3C)


@dataclass(frozen=True)
class Case:
    """An instruction on registers. sources, results: PTX types; immediates: appended operands."""

    form: str
    opcode: str
    sources: tuple[str, ...]
    results: tuple[str, ...]
    immediates: tuple[int, ...] = ()


@functools.cache
def lanewise_cases() -> tuple[Case, ...]:
    """One case (for ``lop3`` several) of every arithmetic form that occurs in the corpus."""
    cases = {}
    for form, item in sorted(corpus.forms().items()):
        if item.root not in numpy_ops._BUILDERS or form.endswith(("pack", "unpack")):
            continue
        op = numpy_ops.lane_op(item)
        if item.root == "lop3":
            for table in LOP3_TABLES:
                cases[f"{form} {table:#x}"] = Case(form, item.opcode, op.sources[:3], op.results, (table,))
        else:
            cases[form] = Case(form, item.opcode, op.sources, op.results)
    return tuple(cases.values())


def is_approximate(opcode: str) -> bool:
    return bool({"approx", "full"} & set(opcode.split(".")))


# --- inputs -----------------------------------------------------------------------------------------------------------


def masks(rng: np.random.Generator) -> np.ndarray:
    """One mask per warp: full, empty, single lanes, halves, random."""
    values = rng.integers(0, 1 << 32, THREADS // 32, dtype=np.uint64)
    values[rng.permutation(len(values))[: len(values) // 2]] = 0xFFFFFFFF
    values[:6] = [0xFFFFFFFF, 0, 1, 1 << 31, 0xFFFF, 0xFFFF0000]
    return values.astype(np.uint32)


def operands(rng: np.random.Generator, kind: str) -> np.ndarray:
    """THREADS values of a type as uint64 bits."""
    if kind in ("f32", "f64"):
        values = corpus.floats(rng, THREADS, np.dtype(f"f{int(kind[1:]) // 8}"), tame=False)
        # Neighbouring magnitudes in every fourth lane, so that sums round and cancel.
        values[::4] = rng.normal(size=THREADS // 4)
        return values.view(f"u{values.dtype.itemsize}").astype(np.uint64)
    return corpus.integers(rng, THREADS)


def inputs(cases: tuple[Case, ...], seed: int) -> np.ndarray:
    """(cases, SLOTS, THREADS) uint64; the last two slots are what the destinations hold before."""
    rng = np.random.default_rng(seed)
    data = rng.integers(0, 1 << 64, (len(cases), SLOTS, THREADS), dtype=np.uint64)
    for row, case in zip(data, cases, strict=True):
        for slot, kind in enumerate(case.sources):
            row[slot] = operands(rng, kind)
            if slot:  # equal operands are special too
                same = rng.random(THREADS) < 0.1
                row[slot] = np.where(same, row[0], row[slot])
    return data


# --- text -------------------------------------------------------------------------------------------------------------

HEAD = """.version 8.8
.target sm_90
.address_size 64
.visible .entry kernel(.param .u64 kernel_param_0, .param .u64 kernel_param_1, .param .u64 kernel_param_2)
{
"""

PROLOGUE = """ld.param.u64 %in, [kernel_param_0];
ld.param.u64 %out, [kernel_param_1];
ld.param.u64 %masks, [kernel_param_2];
mov.u32 %t, %tid.x;
mov.u32 %n, %ntid.x;
mov.u32 %b, %ctaid.x;
mad.lo.s32 %i, %b, %n, %t;
mul.wide.u32 %at, %i, 8;
add.s64 %in, %in, %at;
add.s64 %out, %out, %at;
shr.u32 %word, %i, 5;
mul.wide.u32 %at, %word, 4;
add.s64 %masks, %masks, %at;
ld.global.u32 %mask, [%masks];
mov.u32 %lane, %laneid;
shr.u32 %bit, %mask, %lane;
and.b32 %bit, %bit, 1;
setp.ne.u32 %on, %bit, 0;
"""


class Text:
    """Collects a kernel: declarations, then code."""

    def __init__(self) -> None:
        self.declared = [
            ".reg .b64 %in, %out, %masks, %at;",
            ".reg .b32 %t, %n, %b, %i, %word, %mask, %lane, %bit, %junk;",
            ".reg .pred %on;",
        ]
        self.code: list[str] = []
        self.count = 0

    def register(self, kind: str) -> str:
        self.count += 1
        name = f"%v{self.count}"
        self.declared.append(f".reg .{_REGISTER[kind]} {name};")
        return name

    def add(self, line: str) -> None:
        self.code.append(line)

    def load(self, kind: str, plane: int) -> str:
        """A new register with the thread's value in a plane of the input."""
        name = self.register(kind)
        at = f"[%in+{plane * PLANE}]"
        if kind == "pred":
            word = self.register("b32")
            self.add(f"ld.global.u32 {word}, {at};")
            self.add(f"and.b32 {word}, {word}, 1;")
            self.add(f"setp.ne.u32 {name}, {word}, 0;")
        else:
            self.add(f"ld.global.{_REGISTER[kind]} {name}, {at};")
        return name

    def store(self, kind: str, name: str, plane: int) -> None:
        if kind == "pred":
            word = self.register("b32")
            self.add(f"selp.b32 {word}, 1, 0, {name};")
            kind, name = "b32", word
        self.add(f"st.global.{_REGISTER[kind]} [%out+{plane * PLANE}], {name};")

    def kernel(self, extra: str = "") -> str:
        lines = [*self.declared, extra, PROLOGUE, *self.code, "ret;"]
        return HEAD + "\n".join(lines) + "\n}\n"


def destination(kind: str) -> str:
    """The type of the register that takes a result: for bytes a 32-bit one, so that the extension shows."""
    return {"s8": "b32", "u8": "b32"}.get(kind, kind)


def lanewise_kernel(cases: tuple[Case, ...], style: str) -> str:
    """style ``guard``: each instruction under a predicate; ``branch``: all behind one branch."""
    text = Text()
    body: list[tuple[Case, list[str], list[str]]] = []
    for number, case in enumerate(cases):
        sources = [text.load(kind, number * SLOTS + slot) for slot, kind in enumerate(case.sources)]
        results = [
            text.load(destination(kind), number * SLOTS + SLOTS - 2 + slot) for slot, kind in enumerate(case.results)
        ]
        body.append((case, sources, results))
    guard = "@%on " if style == "guard" else ""
    if style == "branch":
        text.add("@!%on bra AFTER;")
    for case, sources, results in body:
        root = case.opcode.partition(".")[0]
        if root in ("addc", "subc", "madc"):
            flag = sources.pop()
            text.add(f"selp.b32 %junk, 1, 0, {flag};")
            text.add("sub.cc.u32 %junk, 0, %junk;" if root == "subc" else "add.cc.u32 %junk, %junk, -1;")
        has_carry = "cc" in case.opcode.split(".")
        shown = results[:-1] if has_carry else results
        immediates = [str(value) for value in case.immediates]
        text.add(f"{guard}{case.opcode} {', '.join(['|'.join(shown), *sources, *immediates])};")
        if has_carry:  # the flag read back as a number
            text.add("subc.u32 %junk, 0, 0;" if root.startswith("sub") else "addc.u32 %junk, 0, 0;")
            text.add(f"{guard}setp.ne.u32 {results[-1]}, %junk, 0;")
    if style == "branch":
        text.add("AFTER:")
    for number, (case, _, results) in enumerate(body):
        for slot, (kind, name) in enumerate(zip(case.results, results, strict=True)):
            text.store(destination(kind), name, number * 2 + slot)
    return text.kernel()


def launch_arguments(data: np.ndarray, seed: int) -> list[np.ndarray]:
    """Input, zeroed output (cases, 2, THREADS) and masks."""
    out = np.zeros((len(data), 2, THREADS), np.uint64)
    return [corpus.aligned(data), corpus.aligned(out), corpus.aligned(masks(np.random.default_rng(seed)))]


# --- comparison -------------------------------------------------------------------------------------------------------


def disagreements(case: Case, slot: int, got: np.ndarray, want: np.ndarray) -> np.ndarray:
    """Threads whose result bits differ. Any NaN equals any NaN; approximate functions may be 2^-20 off (absolutely for
    sine and cosine, whose error grows towards their zeros); a flushed result whose exact value lies between the largest
    subnormal and the smallest normal number may be either zero or that number."""
    kind = case.results[slot]
    differ = got != want
    if kind not in ("f32", "f64") or not differ.any():
        return differ
    size = int(kind[1:]) // 8
    a, b = (x.astype(f"u{size}").view(f"f{size}") for x in (got, want))
    differ &= ~(np.isnan(a) & np.isnan(b))
    if "ftz" in case.opcode:
        tiny = np.finfo(a.dtype).tiny
        edge = ((a == 0) & (np.abs(b) == tiny)) | ((b == 0) & (np.abs(a) == tiny))
        differ &= ~(edge & (np.signbit(a) == np.signbit(b)))
    if is_approximate(case.opcode):
        with np.errstate(all="ignore"):
            error = np.abs(a.astype("f8") - b.astype("f8"))
            scale = np.maximum(np.abs(b.astype("f8")), 1.0 if case.opcode.startswith(("sin", "cos")) else 0.0)
            differ &= ~(error <= 2.0**-20 * scale)
    return differ


def describe(case: Case, data: np.ndarray, slot: int, got: np.ndarray, want: np.ndarray, differ: np.ndarray) -> str:
    """The first few differing threads: operands, got, want."""
    lines = [f"{case.opcode} {case.immediates or ''} result {slot}: {differ.sum()} of {THREADS} threads differ"]
    for thread in np.flatnonzero(differ)[:4]:
        given = ", ".join(f"{int(data[s, thread]):#x}" for s in range(len(case.sources)))
        lines.append(f"  thread {thread}: ({given}) -> {int(got[thread]):#x}, want {int(want[thread]):#x}")
    return "\n".join(lines)
