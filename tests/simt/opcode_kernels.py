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
shr.u32 %warp, %i, 5;
mul.wide.u32 %at, %warp, 4;
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
            ".reg .b32 %t, %n, %b, %i, %warp, %mask, %lane, %bit, %junk;",
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


def literal(kind: str, bits: int) -> str:
    """A literal operand of a type with these (low) bits."""
    size = numpy_ops.DTYPES[kind].itemsize
    bits &= (1 << 8 * size) - 1
    if kind in ("f32", "f64"):
        return f"0{'f' if kind == 'f32' else 'd'}{bits:0{2 * size}X}"
    return str(bits - (1 << 8 * size) if kind[0] == "s" and bits >> (8 * size - 1) else bits)


def lanewise_kernel(cases: tuple[Case, ...], style: str, data: np.ndarray | None = None) -> str:
    """style ``guard``: each instruction under a predicate; ``branch``: all behind one branch; ``literal``: its last
    operand that can be one is a literal, the first thread's value in ``data``."""
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
        if style == "literal" and data is not None:
            number = next(n for n, (other, _, _) in enumerate(body) if other is case)
            slot = max(s for s, kind in enumerate(case.sources) if kind != "pred")
            sources[slot] = literal(case.sources[slot], int(data[number, slot, 0]))
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


def launch_arguments(data: np.ndarray, seed: int, planes: int = 2) -> list[np.ndarray]:
    """Input, zeroed output (cases, planes, THREADS) and masks."""
    out = np.zeros((len(data), planes, THREADS), np.uint64)
    return [corpus.aligned(data), corpus.aligned(out), corpus.aligned(masks(np.random.default_rng(seed)))]


# --- memory -----------------------------------------------------------------------------------------------------------

_TYPES = ("u8", "s8", "u16", "s16", "u32", "b32", "u64", "f32", "f64")
_SPACES = ("global", "shared", "local", "")
ROOM = 512  # bytes that loads choose from
OWN = 16  # bytes per thread that stores go to
PLANES = 4  # outputs per memory case


def memory_forms(root: str) -> tuple[str, ...]:
    """Loads or stores of every space, type and vector length that a lane's 16 bytes allow."""
    forms = []
    for space in _SPACES:
        for kind in _TYPES:
            for count in (1, 2, 4):
                if count * numpy_ops.DTYPES[kind].itemsize <= OWN:
                    vector = f"v{count}" if count > 1 else ""
                    forms.append(".".join(part for part in (root, space, vector, kind) if part))
    return tuple(forms)


_WINDOWS = f"""
.shared .align 16 .b8 choice[{ROOM}];
.shared .align 16 .b8 own[{OWN * BLOCK}];
.local .align 16 .b8 mine[{ROOM + OWN}];
.reg .b64 %all, %everyone, %from_global, %from_shared, %from_local, %from_any;
.reg .b64 %to_global, %to_shared, %to_local, %to_any;
.reg .b64 %word, %half;
.reg .b32 %index, %quarter, %odd;
.reg .pred %is_odd;
"""


def memory_kernel(forms: tuple[str, ...]) -> str:
    """Guarded accesses: loads at an offset that the input chooses, stores to a place of the thread's own, read back."""
    text = Text()
    add = text.add
    add("ld.param.u64 %all, [kernel_param_0];")
    add("ld.param.u64 %everyone, [kernel_param_1];")
    # Shared room: four bytes per thread. Local room: the same words, shifted by the thread's number.
    add("ld.global.u32 %quarter, [%in];")
    add("shl.b32 %index, %t, 2;")
    add("cvt.u64.u32 %half, %index;")
    add("mov.u64 %from_shared, choice;")
    add("add.s64 %half, %from_shared, %half;")
    add("st.shared.u32 [%half], %quarter;")
    add("mov.u64 %from_local, mine;")
    for at in range(0, ROOM, 8):
        add(f"ld.global.u64 %word, [%in+{at % 64 // 8 * PLANE}];")
        add(f"add.s64 %word, %word, {at};")
        add(f"st.local.u64 [%from_local+{at}], %word;")
    add("bar.sync 0;")
    add("mul.wide.u32 %word, %t, 16;")
    add("mov.u64 %to_shared, own;")
    add("add.s64 %to_shared, %to_shared, %word;")
    add(f"add.s64 %to_local, %from_local, {ROOM};")
    add("and.b32 %odd, %t, 1;")
    add("setp.eq.u32 %is_odd, %odd, 1;")
    for number, form in enumerate(forms):
        _memory_case(text, number, form)
    return text.kernel(_WINDOWS)


def _memory_case(text: Text, number: int, form: str) -> None:
    root, *rest = form.split(".")
    kind = rest[-1]
    count = int(next((part[1] for part in rest if part in ("v2", "v4")), "1"))
    size = count * numpy_ops.DTYPES[kind].itemsize
    space = rest[0] if rest[0] in _SPACES else ""
    add = text.add
    values = [text.register(destination(kind)) for _ in range(count)]
    listed = "{" + ", ".join(values) + "}" if count > 1 else values[0]
    planes = [number * PLANES + position for position in range(count)]
    if root == "ld":
        add(f"ld.global.u32 %index, [%in+{number * SLOTS * PLANE}];")
        add(f"and.b32 %index, %index, {ROOM // size - 1};")
        add(f"mul.wide.u32 %word, %index, {size};")
        add(f"add.s64 %from_global, %all, {(number * SLOTS + 1) * PLANE};")
        add("cvta.shared.u64 %half, %from_shared;")
        add("selp.b64 %from_any, %half, %from_global, %is_odd;")
        add(f"add.s64 %word, %word, %from_{space or 'any'};")
        for position, value in enumerate(values):
            add(f"ld.global.{_REGISTER[destination(kind)]} {value}, [%in+{(number * SLOTS + 2) * PLANE}];")
            planes[position] = number * PLANES + position
        add(f"@%on {form} {listed}, [%word];")
        for plane, value in zip(planes, values, strict=True):
            text.store(destination(kind), value, plane)
        return
    for position, value in enumerate(values):
        add(f"ld.global.{_REGISTER[destination(kind)]} {value}, [%in+{(number * SLOTS + position) * PLANE}];")
    add("mul.wide.u32 %word, %i, 16;")
    add(f"add.s64 %word, %word, {number * PLANES * PLANE};")
    add("add.s64 %to_global, %everyone, %word;")
    if space == "global":
        add(f"@%on {form} [%to_global], {listed};")
        return
    add("cvta.shared.u64 %half, %to_shared;")
    add("cvta.local.u64 %to_any, %to_local;")
    add("selp.b64 %to_any, %half, %to_any, %is_odd;")
    place = f"%to_{space or 'any'}"
    load = f"ld.{space}.u64" if space else "ld.u64"
    for at in (0, 8):
        add(f"mov.u64 %word, {number + at};")
        add(f"{load.replace('ld', 'st', 1)} [{place}+{at}], %word;")
    add(f"@%on {form} [{place}], {listed};")
    for at in (0, 8):
        add(f"{load} %word, [{place}+{at}];")
        add(f"st.global.u64 [%to_global+{at}], %word;")


# --- atomics ----------------------------------------------------------------------------------------------------------

CELLS = 8  # places that the threads of a block share
CELL_BYTES = 16


def atomic_forms() -> tuple[str, ...]:
    """The atomics of the corpus, and those without a result."""
    found = [form for form in sorted(corpus.forms()) if form.startswith("atom.")]
    plain = [form.replace("atom", "red", 1) for form in found if not {"cas", "exch"} & set(form.split("."))]
    return (*found, *plain)


def atomic_kernel(forms: tuple[str, ...]) -> str:
    """Each form has cells of its own per thread block, in a fourth argument; several lanes meet in each."""
    text = Text()
    add = text.add
    per_block = len(forms) * CELLS * CELL_BYTES
    add("ld.param.u64 %cells, [kernel_param_3];")
    add(f"mul.wide.u32 %word, %b, {per_block};")
    add("add.s64 %cells, %cells, %word;")
    add("mov.u64 %shared, scratch;")
    add("mul.wide.u32 %word, %t, 8;")
    add("add.s64 %mine, %shared, %word;")
    add("add.s64 %word, %cells, %word;")
    rounds = range(0, per_block, 8 * BLOCK)
    for at in rounds:
        add(f"ld.global.u64 %value, [%word+{at}];")
        add(f"st.shared.u64 [%mine+{at}], %value;")
    add("bar.sync 0;")
    for number, form in enumerate(forms):
        root, space, *rest = form.split(".")
        kind, count = rest[-1], int(next((part[1] for part in rest if part in ("v2", "v4")), "1"))
        sources = 2 if "cas" in rest else 1
        before = [text.load(kind, number * SLOTS + 5) for _ in range(count)]
        operands = []
        for source in range(sources):
            parts = [text.load(kind, number * SLOTS + 1 + source + position) for position in range(count)]
            operands.append("{" + ", ".join(parts) + "}" if count > 1 else parts[0])
        listed = "{" + ", ".join(before) + "}" if count > 1 else before[0]
        add(f"ld.global.u32 %index, [%in+{number * SLOTS * PLANE}];")
        add(f"and.b32 %index, %index, {CELLS - 1};")
        add(f"mul.wide.u32 %value, %index, {CELL_BYTES};")
        add(f"add.s64 %value, %value, {number * CELLS * CELL_BYTES};")
        add(f"add.s64 %value, %value, {'%cells' if space == 'global' else '%shared'};")
        result = f"{listed}, " if root == "atom" else ""
        add(f"@%on {form} {result}[%value], {', '.join(operands)};")
        for position, name in enumerate(before):
            text.store(kind, name, number * PLANES + position)
    add("bar.sync 0;")
    shared = [number for number, form in enumerate(forms) if ".shared." in form]
    for number in shared:  # half of the threads copy the cells back, eight bytes each
        start = number * CELLS * CELL_BYTES
        add(f"setp.lt.u32 %first, %t, {CELLS * CELL_BYTES // 8};")
        add(f"@%first ld.shared.u64 %value, [%mine+{start}];")
        add(f"@%first st.global.u64 [%word+{start}], %value;")
    extra = f""".shared .align 16 .b8 scratch[{-(-per_block // (8 * BLOCK)) * 8 * BLOCK}];
.reg .b64 %cells, %word, %shared, %mine, %value;
.reg .b32 %index;
.reg .pred %first;"""
    return text.kernel(extra).replace("kernel_param_2)", "kernel_param_2, .param .u64 kernel_param_3)")


def atomic_arguments(forms: tuple[str, ...], seed: int) -> list[np.ndarray]:
    """As for other kernels, and the cells: (blocks, forms, CELLS, CELL_BYTES / 8) uint64, padded.

    No f32 sum is subnormal: PTX has them flushed in global and kept in shared memory, while the engine does in both as
    the processor's mode has it for the kernel's arithmetic.
    """
    rng = np.random.default_rng(seed)
    kinds = [form.split(".")[-1] for form in forms]
    data = rng.integers(0, 1 << 64, (len(forms), SLOTS, THREADS), dtype=np.uint64)
    blocks = THREADS // BLOCK
    cells = np.zeros((blocks, len(forms), CELLS, CELL_BYTES // 8), np.uint64)
    for number, kind in enumerate(kinds):
        for slot in range(1, SLOTS):
            data[number, slot] = operands(rng, kind)
        few = rng.integers(0, 3, (blocks, CELLS, CELL_BYTES // 8)).astype(np.uint64)
        cells[:, number] = few if "cas" in forms[number] else operands(rng, kind)[: few.size].reshape(few.shape)
        if "cas" in forms[number]:
            data[number, 1] = rng.integers(0, 3, THREADS)
            data[number, 2] = rng.integers(0, 3, THREADS)
        if kind == "f32":  # two values in each word of the input, so that vectors have no empty elements
            cells[:, number] |= cells[:, number] << np.uint64(32)
            for words in (data[number], cells[:, number]):
                values = words.view(np.float32)
                values[np.abs(values) < 1e-25] = 0.0
    padded = np.concatenate([cells.reshape(-1), np.zeros(8 * BLOCK, np.uint64)])
    return [*launch_arguments(data, seed, PLANES), corpus.aligned(padded)]


def same_values(form: str, got: np.ndarray, want: np.ndarray) -> bool:
    """Equal bits; for floats any NaN equals any NaN."""
    kind = form.split(".")[-1]
    if kind not in ("f32", "f64"):
        return bool(np.array_equal(got, want))
    a, b = (np.ascontiguousarray(x).view(f"f{int(kind[1:]) // 8}") for x in (got, want))
    bits = [x.view(f"u{x.dtype.itemsize}") for x in (a, b)]
    return bool(np.all((bits[0] == bits[1]) | (np.isnan(a) & np.isnan(b))))


# --- operations across lanes ------------------------------------------------------------------------------------------


def warp_forms() -> tuple[str, ...]:
    roots = ("shfl", "vote", "match", "redux", "activemask")
    return tuple(form for form, item in sorted(corpus.forms().items()) if item.root in roots)


def warp_kernel(forms: tuple[str, ...]) -> str:
    """Behind one branch, with the lanes' own mask as the member mask. Of a shuffle the last plane holds the lane that
    it read from, so that reads of absent lanes can be left out."""
    text = Text()
    add = text.add
    bodies: list[list[str]] = []
    results: list[list[tuple[str, str]]] = []
    for number, form in enumerate(forms):
        root, *rest = form.split(".")
        first = text.load("b64" if rest[-1] == "b64" else "b32", number * SLOTS)
        second, third = (text.load("b32", number * SLOTS + slot) for slot in (1, 2))
        out, source = (text.load("b32", number * SLOTS + slot) for slot in (3, 4))
        flag = text.load("pred", number * SLOTS + 5)
        body = []
        if root == "shfl":
            # Segments of 1 to 32 lanes; clamps anywhere.
            body += [f"and.b32 {third}, {third}, 7967;"]
            body += [f"{form} {source}, %lane, {second}, {third}, %mask;"]
            body += [f"{form} {out}|{flag}, {first}, {second}, {third}, %mask;"]
        elif root == "vote":
            body += [f"setp.lt.s32 {flag}, {first}, {second};"]
            body += [f"{form} {flag if rest[-1] == 'pred' else out}, {flag}, %mask;"]
        elif root == "match":
            limit = f"and.{rest[-1]} {first}, {first}, {3 if 'any' in rest else 0};"
            both = f"{out}|{flag}" if "all" in rest else out
            body += [limit, f"{form} {both}, {first}, %mask;"]
        elif root == "redux":
            body += [f"{form} {out}, {first}, %mask;"]
        else:
            body += [f"{form} {out};"]
        bodies.append(body)
        results.append([("b32", out), ("pred", flag), ("b32", source)])
    add("@!%on bra AFTER;")
    for body in bodies:
        text.code += body
    add("AFTER:")
    for number, outputs in enumerate(results):
        for position, (kind, name) in enumerate(outputs):
            text.store(kind, name, number * PLANES + position)
    return text.kernel()


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
