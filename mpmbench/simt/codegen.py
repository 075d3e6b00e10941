"""A parsed kernel -> LLVM text that runs one warp of it until a barrier, a yield or its end.

The kernel is cut into *segments*: basic blocks that also end after every barrier and warp-level operation. Registers
are SSA values inside a segment and 32-lane *slots* in the warp's context between segments, so any segment can be
resumed by any set of lanes. A segment's body runs for ``lanes`` lanes at a time (a *chunk*), under their mask.

Divergence: ``pending[s]`` holds the lanes that wait to run segment s. The lowest pending segment always runs next, so
lanes that took different ways meet again at the first segment both reach. Only a branch backward runs a lower one.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Container
from dataclasses import dataclass, field

from mpmbench.errors import InputError
from mpmbench.simt import codegen_count, codegen_memory, codegen_rare, codegen_trace, codegen_warp, scheduler
from mpmbench.simt.address_forms import AddressForms
from mpmbench.simt.codegen_arith import ELEMENT, EMITTERS, Refused, is_float_arithmetic
from mpmbench.simt.codegen_ir import ELEMENT_BYTES, WARP, Writer, bits_of, element_of, integer_of
from mpmbench.simt.codegen_memory import Site
from mpmbench.simt.flow import Block, basic_blocks
from mpmbench.simt.ptx import Address, Imm, Instruction, Kernel, NotReg, Operand, Reg, Special, Symbol
from mpmbench.simt.scheduler import JOB

MODES = ("run", "count", "debug", "profile")

_NOTHING = frozenset({"membar", "fence", "nanosleep", "prefetch", "prefetchu", "call", "pmevent", "griddepcontrol"})
_UNIFORM_ROOTS = frozenset({"mov", "cvta", "cvt", "add", "sub", "mul", "mad", "shl"})
_BRANCHES = frozenset({"bra", "brx", "ret", "exit", "trap"})


@dataclass
class KernelCode:
    """What compiling a kernel yields: text for LLVM and what the engine must know to launch and to read counters."""

    name: str
    text: str
    context_bytes: int
    segments: list[tuple[int, int]]  # first instruction, one past the last
    sites: list[Site]
    counter_words: int
    hardware_ftz: bool
    shared_granule: int = 4  # bytes: the narrowest access of the kernel to shared memory
    lines: list[tuple[str, int] | None] = field(default_factory=list)  # of the instructions


def generate(kernel: Kernel, variables: dict[str, int], mode: str, lanes: int) -> KernelCode:
    """LLVM text of a kernel. variables: number of each module variable in the launch's table of addresses."""
    return _Generator(kernel, variables, mode, lanes).code()


def refusal(item: Instruction) -> InputError:
    return InputError(f"the simulated device does not support {item.opcode!r} ({item.where()})")


class _Generator:
    def __init__(self, kernel: Kernel, variables: dict[str, int], mode: str, lanes: int) -> None:
        self.kernel, self.variables, self.mode = kernel, variables, mode
        self.counts, self.traces = mode in ("count", "profile"), mode == "profile"
        self.w = Writer(lanes)
        self.lanes = lanes
        # Debug: adds that run together with the next one.
        self.unbroken = codegen_memory.joined_adds(kernel.instructions) if mode == "debug" else frozenset()
        self.segments = self._segments()
        self.forms = AddressForms(kernel.instructions)
        self.sites: list[Site] = []
        self.entry_values: dict[str, tuple[str, list[str]]] = {}
        self.hardware_ftz, self.explicit_ftz = self._flushing()
        self.joinable = self._joinable()
        self.uniform = self._find_uniform()
        self._lay_out()
        self.labels = 0

    def _segments(self) -> list[Block]:
        segments = basic_blocks(self.kernel, self._ends_segment, codegen_warp.gathers)
        instructions = self.kernel.instructions
        more = codegen_memory.ordered_starts(instructions, {segment.start for segment in segments})
        if not more:
            return segments
        chosen = {id(instructions[index]) for index in more}
        return basic_blocks(
            self.kernel, self._ends_segment, lambda item: codegen_warp.gathers(item) or id(item) in chosen
        )

    def _ends_segment(self, item: Instruction) -> bool:
        if codegen_warp.is_collective(item) or codegen_warp.is_barrier(item):
            return True
        if self.mode != "debug" or item.root not in ("ld", "st", "atom", "red") or id(item) in self.unbroken:
            return False
        # Debug: other warps get a turn after every access to shared memory.
        return not {"global", "local", "const", "param"} & set(item.modifiers)

    def _flushing(self) -> tuple[bool, bool]:
        """-> (the processor flushes f32 denormals, code does). The processor would flush f64 and plain f32 as well."""
        wants = [is_float_arithmetic(item) for item in self.kernel.instructions]
        flushed, kept, double = (any(column) for column in zip(*wants, strict=True)) if wants else (False,) * 3
        return flushed and not kept and not double, flushed and (kept or double)

    def _joinable(self) -> set[int]:
        """Segments at which lanes may wait for others."""
        result: set[int] = set()
        for segment in self.segments:
            last = self.kernel.instructions[segment.stop - 1]
            if last.root in _BRANCHES:
                result.update(segment.successors)
        return result

    def _find_uniform(self) -> dict[Reg, Instruction]:
        """Registers that hold the same for all lanes whenever they are read, and their only definition.

        Parameters, and sums and products of them: cheaper to compute where they are read than to keep in slots, and
        LLVM sees that all lanes agree. What whole warps read after a segment's body stays in slots.
        """
        instructions = self.kernel.instructions
        writes = Counter(reg for item in instructions for reg in item.writes())
        read_by_warps = {reg for item in instructions if _is_tail(item) for reg in item.reads()}
        found: dict[Reg, Instruction] = {}
        for item in instructions:
            if item.guard is not None or len(item.dsts) != 1 or (reg := item.dsts[0]) is None:
                continue
            if writes[reg] == 1 and reg not in read_by_warps and _is_uniform(item, found):
                found[reg] = item
        return found

    def _lay_out(self) -> None:
        """Give every register that outlives a segment a slot in the context."""
        stored: set[Reg] = set()
        for segment in self.segments:
            stored |= segment.live_in - self.uniform.keys()
            last = self.kernel.instructions[segment.stop - 1]
            if _is_tail(last):
                stored.update(last.reads())
                stored.update(last.writes())
        at = scheduler.CONTEXT_SLOTS
        self.pending_at = at
        at = -(-(at + 4 * len(self.segments)) // 64) * 64
        self.slot: dict[Reg, int] = {}
        for reg in sorted(stored, key=lambda r: (-bits_of(element_of(r)), r.name)):
            self.slot[reg] = at
            at += 4 if reg.type == "pred" else WARP * ELEMENT_BYTES[element_of(reg)]
        # An odd number of cache lines, so that the same slot of different warps falls into different cache sets.
        self.context_bytes = (-(-at // 64) | 1) * 64

    # --- scalars that are loaded once, at the kernel's start ---

    def entry_value(self, name: str, lines: list[str]) -> str:
        """A value computed in the entry block; lines use ``%name``."""
        self.entry_values.setdefault(name, (name, lines))
        return f"%{name}"

    def job_field(self, field_name: str, pointer: bool = False) -> str:
        kind, suffix = ("ptr", "pointer") if pointer else ("i64", "value")
        name = f"job.{field_name}.{suffix}"
        address = f"%{name}.address = getelementptr i8, ptr %job, i64 {JOB[field_name]}"
        return self.entry_value(name, [address, f"%{name} = load {kind}, ptr %{name}.address, align 8"])

    def label(self) -> int:
        self.labels += 1
        return self.labels

    # --- the function ---

    def code(self) -> KernelCode:
        for number, segment in enumerate(self.segments):
            _Segment(self, number, segment).emit()
        w = self.w
        body, w.lines = w.lines, []
        entry = [line for _, lines in self.entry_values.values() for line in lines]
        resumes = " ".join(f"i32 {number}, label %{label}" for number, label in self.resume_points())
        count = len(self.segments)
        function = [
            "define i32 @warp(ptr noalias align 64 %context, ptr noalias %job) #0 {",
            "entry:",
            *w.allocas,
            *entry,
            "%resume = load i32, ptr %context, align 4",
            f"switch i32 %resume, label %start [ {resumes} ]",
            "start:",
            f"%start.live.at = getelementptr i8, ptr %context, i64 {scheduler.CONTEXT_LIVE}",
            "%start.live = load i32, ptr %start.live.at, align 4",
            f"%start.pending = getelementptr i8, ptr %context, i64 {self.pending_at}",
            "store i32 %start.live, ptr %start.pending, align 4",
            "br label %run0" if count else "br label %ended",
            *body,
            *self._end(),
            "}",
            'attributes #0 = { nounwind "prefer-vector-width"="512" "min-legal-vector-width"="512" }',
        ]
        # Wrong lanes of a collective, traps and spent budgets end here.
        launch = scheduler.launch_text(self.context_bytes, self.hardware_ftz, self.mode == "debug")
        resume = scheduler.resume_text(self.hardware_ftz) if self.traces else ""
        text = "\n".join([*w.declarations.values(), *function, launch, resume])
        widths = [site.width for site in self.sites if site.space in ("shared", "generic")]
        return KernelCode(
            self.kernel.name,
            text,
            self.context_bytes,
            [(segment.start, segment.stop) for segment in self.segments],
            self.sites,
            codegen_count.counter_words(len(self.segments), len(self.sites)),
            self.hardware_ftz,
            min(widths, default=4),
            [(item.line.file, item.line.line) if item.line else None for item in self.kernel.instructions],
        )

    def _end(self) -> list[str]:
        """The kernel's last code. Lanes that wait for others now do so in vain."""
        if self.mode == "debug" and self.segments:
            # Lanes that a random choice has put off go first.
            return [
                "ended:",
                f"%end.aside.at = getelementptr i8, ptr %context, i64 {scheduler.CONTEXT_SET_ASIDE}",
                "%end.aside = load i16, ptr %end.aside.at, align 2",
                "store i16 0, ptr %end.aside.at, align 2",
                "%end.none.aside = icmp eq i16 %end.aside, 0",
                f"br i1 %end.none.aside, label %really.ended, label %{self.chain(0)}",
                *self._really_end("really.ended"),
            ]
        return self._really_end("ended")

    def _really_end(self, label: str) -> list[str]:
        if not any(codegen_warp.gathers(item) for item in self.kernel.instructions):
            return [f"{label}:", f"ret i32 {scheduler.STATUS_ENDED}"]

        def field(name: str, offset: int) -> list[str]:
            return [
                f"%{name}.at = getelementptr i8, ptr %context, i64 {offset}",
                f"%{name} = load i32, ptr %{name}.at, align 4",
            ]

        return [
            f"{label}:",
            *field("end.live", scheduler.CONTEXT_LIVE),
            "%end.none = icmp eq i32 %end.live, 0",
            "br i1 %end.none, label %end.all, label %end.waiting",
            "end.all:",
            f"ret i32 {scheduler.STATUS_ENDED}",
            "end.waiting:",
            *field("end.status", scheduler.CONTEXT_STUCK),
            *field("end.segment", scheduler.CONTEXT_STUCK_SEGMENT),
            "%end.segment.wide = zext i32 %end.segment to i64",
            f"%end.stop = getelementptr i8, ptr %job, i64 {JOB['stop_segment']}",
            "store i64 %end.segment.wide, ptr %end.stop, align 8",
            "ret i32 %end.status",
        ]

    def resume_points(self) -> list[tuple[int, str]]:
        """Where a warp goes on that has returned: the number of a segment, and a label."""
        points = []
        for number, segment in enumerate(self.segments[:-1]):
            last = self.kernel.instructions[segment.stop - 1]
            if codegen_warp.is_reducing_barrier(last):
                points.append((number + 1, f"reduced{number}"))
            elif codegen_warp.is_barrier(last) or (self.mode == "debug" and self.yields_after(last)):
                points.append((number + 1, f"run{number + 1}"))
        if self.traces:
            points += codegen_trace.loop_heads(self.segments, points)
        return points

    def yields_after(self, item: Instruction) -> bool:
        return item.root in ("ld", "st", "atom", "red") and self._ends_segment(item)

    def chain(self, number: int) -> str:
        """Label of the first segment from ``number`` on at which lanes may be waiting."""
        while number < len(self.segments):
            if number in self.joinable:
                return f"check{number}"
            number += 1
        return "ended"


def _is_tail(item: Instruction) -> bool:
    """Whether the warp as a whole carries it out, after the chunks."""
    return item.root in _BRANCHES or codegen_warp.is_collective(item) or codegen_warp.is_barrier(item)


def _is_uniform(item: Instruction, known: Container[Reg]) -> bool:
    """Whether the result depends on parameters and the launch alone. known: registers of which that is so."""
    if item.root == "ld":
        address = item.srcs[0]
        return "param" in item.modifiers and isinstance(address, Address) and isinstance(address.base, Symbol)
    if item.root not in _UNIFORM_ROOTS:
        return False
    return all(
        isinstance(operand, Imm)
        or (isinstance(operand, Reg) and operand in known)
        or (isinstance(operand, Special) and operand.name.partition(".")[0] in ("%ntid", "%nctaid", "%ctaid"))
        for operand in item.srcs
    )


class SegmentBody:
    """Code for one chunk of lanes through the body of a segment: what the instruction emitters write into."""

    def __init__(self, generator: _Generator, number: int, segment: Block) -> None:
        self.g, self.number, self.segment = generator, number, segment
        self.w = generator.w
        self.hardware_ftz, self.explicit_ftz = generator.hardware_ftz, generator.explicit_ftz
        self.counts, self.checks = generator.counts, generator.mode == "debug"
        self.observes = self.counts or self.checks
        instructions = generator.kernel.instructions[segment.start : segment.stop]
        self.loads_by_lane = sum(map(codegen_memory.gathers_of, instructions)) > codegen_memory.MOST_GATHERS
        self.forms = generator.forms.of_block(instructions, segment.start)
        self.values: dict[Reg, str] = {}
        self.written: set[Reg] = set()
        self.guard: str | None = None
        self.checked: tuple[str, str] | None = None
        self.anchors: dict[object, tuple[str, int, str]] = {}
        self.deferred: list[codegen_memory.Deferred] = []
        self.after_chunks: list[Callable[[str], None]] = []  # code for the whole warp; argument: its mask
        self._live_after: dict[int, frozenset[Reg]] | None = None
        self._slot_bases: dict[int, str] = {}

    # --- operands ---

    def element(self, reg: Reg) -> str:
        return element_of(reg)

    def read(self, operand: Operand, kind: str) -> str:
        w, element = self.w, ELEMENT[kind]
        match operand:
            case Reg():
                return self._fit(self.register(operand), element_of(operand), element)
            case Imm(value, 0):
                return w.splat_int(element, value) if integer_of(element) == element else w.splat_bits(element, value)
            case Imm(value, bits):
                if bits != bits_of(element):
                    raise Refused
                return w.splat_bits(element, value)
            case NotReg(reg):
                return w.invert(self.register(reg))
            case Special(name):
                return self._fit(self._special(name), "i64" if name in _WIDE_SPECIAL else "i32", element)
            case Symbol():
                return self._fit(self._symbol(operand), "i64", element)
        raise Refused

    def _fit(self, value: str, have: str, want: str) -> str:
        """The low bits of a register as the type an instruction names."""
        w = self.w
        if have == want:
            return value
        if bits_of(have) == bits_of(want):
            return w.reinterpret(value, have, want)
        if bits_of(have) < bits_of(want):
            raise Refused
        value = w.cast("trunc", w.reinterpret(value, have, integer_of(have)), integer_of(have), integer_of(want))
        return w.reinterpret(value, integer_of(want), want)

    def register(self, reg: Reg) -> str:
        if reg not in self.values:
            w = self.w
            if reg in self.g.uniform:
                self._compute_here(reg)
            elif reg not in self.g.slot:  # never written before: the value is undefined, take zero
                self.values[reg] = "zeroinitializer"
            elif reg.type == "pred":
                bits = w.load(f"i{w.lanes}", self.slot_address(reg), w.lanes // 8)
                self.values[reg] = w.value(f"bitcast i{w.lanes} {bits} to {w.vector('i1')}")
            else:
                element = element_of(reg)
                align = min(64, w.lanes * ELEMENT_BYTES[element])
                self.values[reg] = w.load(w.vector(element), self.slot_address(reg), align)
        return self.values[reg]

    def _compute_here(self, reg: Reg) -> None:
        """Repeat the definition of a uniform register, for all lanes; it has no other effect."""
        guard, checked = self.guard, self.checked
        self.guard = self.checked = None
        self._emit(-1, self.g.uniform[reg])
        self.guard, self.checked = guard, checked

    def slot_address(self, reg: Reg) -> str:
        """Address of the chunk's part of a register's slot."""
        return self.w.at(self._chunk_base(reg), self.g.slot[reg])

    def _chunk_base(self, reg: Reg) -> str:
        size = 0 if reg.type == "pred" else ELEMENT_BYTES[element_of(reg)]
        return f"%chunk{size}.{self.number}"

    def write(self, item: Instruction, position: int, value: str, element: str) -> None:
        dst = item.dsts[position]
        if dst is None:
            return
        value = self._fit(value, element, element_of(dst))
        if self.guard is not None and self._old_value_matters(dst):
            value = self.w.select(element_of(dst), self.guard, value, self.register(dst))
        self.values[dst] = value
        self.written.add(dst)

    def _old_value_matters(self, dst: Reg) -> bool:
        return dst in self.values or dst in self.g.slot

    def _special(self, name: str) -> str:
        w, g = self.w, self.g
        base, _, axis = name.partition(".")
        if base == "%tid":
            offset = scheduler.CONTEXT_TID + 128 * "xyz".index(axis)
            address = w.at(f"%chunk4.{self.number}", offset)
            return w.load(w.vector("i32"), address, min(64, 4 * w.lanes))
        if base == "%ctaid":
            offset = scheduler.CONTEXT_CTAID + 4 * "xyz".index(axis)
            return w.splat("i32", w.load("i32", w.at("%context", offset), 4))
        if name in ("%laneid",) or base.startswith("%lanemask"):
            lane = self._lane_numbers()
            if name == "%laneid":
                return lane
            bit = w.binary("shl", "i32", w.splat_int("i32", 1), lane)
            below = w.binary("sub", "i32", bit, w.splat_int("i32", 1))
            up_to = w.binary("or", "i32", below, bit)
            ones = w.splat_int("i32", -1)
            return {
                "eq": lambda: bit,
                "lt": lambda: below,
                "le": lambda: up_to,
                "gt": lambda: w.binary("xor", "i32", up_to, ones),
                "ge": lambda: w.binary("xor", "i32", below, ones),
            }[name[-2:]]()
        fields = {"%ntid": "block_", "%nctaid": "grid_"}
        if base in fields:
            scalar = g.job_field(fields[base] + axis)
        elif name == "%warpid":
            return w.splat("i32", w.load("i32", w.at("%context", scheduler.CONTEXT_WARP), 4))
        elif name in _JOB_SPECIAL:
            scalar = g.job_field(_JOB_SPECIAL[name])
        elif name in _CONSTANT_SPECIAL:
            return w.splat_int("i64" if name in _WIDE_SPECIAL else "i32", _CONSTANT_SPECIAL[name])
        else:
            raise Refused
        return w.splat("i32", w.value(f"trunc i64 {scalar} to i32"))

    def _lane_numbers(self) -> str:
        w = self.w
        first = w.value(f"trunc i64 %lane.{self.number} to i32")
        numbers = "<" + ", ".join(f"i32 {lane}" for lane in range(w.lanes)) + ">"
        return w.binary("add", "i32", w.splat("i32", first), numbers)

    def _symbol(self, symbol: Symbol) -> str:
        """An address as a number: absolute, save for shared memory and parameters, which count from their start."""
        w, g = self.w, self.g
        if symbol.space in ("shared", "param"):
            return w.splat_int("i64", symbol.offset)
        if symbol.space == "local":
            warp = w.load("i32", w.at("%context", scheduler.CONTEXT_WARP), 4)
            first = w.value(f"shl i32 {warp}, 5")
            thread = w.binary("add", "i32", w.splat("i32", first), self._lane_numbers())
            wide = w.cast("zext", thread, "i32", "i64")
            at = w.binary("mul", "i64", wide, w.splat_int("i64", g.kernel.local_bytes))
            start = w.value(f"add i64 {g.job_field('local')}, {symbol.offset}")
            return w.binary("add", "i64", w.splat("i64", start), at)
        table = g.job_field("variables", pointer=True)
        address = w.load("i64", w.at(table, 8 * g.variables[symbol.name]), 8)
        return w.splat("i64", w.value(f"add i64 {address}, {symbol.offset}"))

    def shared_window(self) -> str:
        """Scalar: generic address of the start of shared memory."""
        return self.g.job_field("shared")

    def shared_pointer(self) -> str:
        return self.g.job_field("shared", pointer=True)

    def params_pointer(self) -> str:
        return self.g.job_field("params", pointer=True)

    def sink(self, in_shared: bool) -> str:
        """Scalar: where dead lanes' accesses go, counted from the start of shared memory if asked."""
        sink = self.g.job_field("sink")
        if not in_shared:
            return sink
        shared = self.g.job_field("shared")
        return self.g.entry_value("sink.shared", [f"%sink.shared = sub i64 {sink}, {shared}"])

    def is_in_space(self, address: str, space: str) -> str:
        w = self.w

        def inside(start: str, size: str) -> str:
            distance = w.binary("sub", "i64", address, w.splat("i64", start))
            return w.compare("icmp ult", "i64", distance, w.splat("i64", size))

        job = self.g.job_field
        in_shared = inside(job("shared"), job("shared_bytes"))
        local_bytes = self.g.entry_value("local.bytes", [f"%local.bytes = sub i64 {job('local_end')}, {job('local')}"])
        in_local = inside(job("local"), local_bytes)
        if space == "shared":
            return in_shared
        if space == "local":
            return in_local
        if space == "global":
            return w.invert(w.binary("or", "i1", in_shared, in_local))
        raise Refused

    # --- lanes ---

    def active(self) -> tuple[str, str]:
        """(name, mask vector) of the lanes that the instruction at hand runs for."""
        if self.checked is not None:
            return self.checked
        whole = f"%mask.{self.number}"
        if self.guard is None:
            return whole, whole
        both = f"{self.guard}&"
        if both not in self._guarded:
            self._guarded[both] = self.w.binary("and", "i1", whole, self.guard)
        return both, self._guarded[both]

    def active_bits(self) -> str:
        """The same as bits of an i32, bit 0 for the chunk's first lane."""
        name, mask = self.active()
        if name == f"%mask.{self.number}":
            return f"%bits.{self.number}"
        return self._bits(mask)

    def _bits(self, mask: str) -> str:
        w = self.w
        bits = w.value(f"bitcast {w.vector('i1')} {mask} to i{w.lanes}")
        return bits if w.lanes == 32 else w.value(f"zext i{w.lanes} {bits} to i32")

    def fresh_label(self) -> int:
        return self.g.label()

    # --- buffers of one value per lane ---

    def lane_buffer(self, element: str) -> str:
        """Room for one value per lane: of the whole warp where it is looked at after the chunks."""
        return self.w.buffer(WARP * ELEMENT_BYTES[element])

    def chunk_of(self, buffer: str) -> str:
        """The part of an address buffer that belongs to the chunk at hand."""
        if not self.observes:
            return buffer
        if buffer not in self._chunk_buffers:
            self._chunk_buffers[buffer] = self.w.value(f"getelementptr i64, ptr {buffer}, i64 %lane.{self.number}")
        return self._chunk_buffers[buffer]

    def store_chunk(self, buffer: str, element: str, value: str) -> None:
        w = self.w
        align = min(64, w.lanes * ELEMENT_BYTES[element])
        w.store(w.vector(element), value, self.chunk_of(buffer), align)

    # --- counting and checking ---

    def observe_run(self, sites: list[Site], buffer: str, displacement: int, bits: str | None = None) -> None:
        """Count neighbouring accesses once all lanes have stored their addresses.

        bits: the chunk's active lanes, for accesses that were put off; else those of the instruction at hand.
        """
        bits = self.active_bits() if bits is None else bits
        first = len(self.g.sites)
        self.g.sites.extend(sites)
        mask_at = None
        if bits != f"%bits.{self.number}":
            mask_at = self._kept_bits(bits)

        def after(warp_mask: str) -> None:
            mask = warp_mask
            if mask_at is not None:
                mask = self.w.value(f"and i32 {self.w.load('i32', mask_at, 4)}, {warp_mask}")
            taken = codegen_count.count_sites(self.g, sites, first, buffer, displacement, mask)
            if self.g.traces and sites[0].space in ("shared", "generic"):
                codegen_trace.take_shared(self.g, sites, taken)
            if self.g.traces and sites[0].space in ("global", "generic"):
                codegen_trace.record_request(self.g, self.number, first, len(sites), buffer, displacement, mask)

        self.after_chunks.append(after)

    def _kept_bits(self, bits: str) -> str:
        """Memory in which the chunks' bits come to stand side by side."""
        w = self.w
        memory = w.buffer(4)
        narrow = bits if w.lanes == 32 else w.value(f"trunc i32 {bits} to i{w.lanes}")
        at = w.value(f"getelementptr i{w.lanes}, ptr {memory}, i64 %chunk.{self.number}")
        w.store(f"i{w.lanes}", narrow, at, w.lanes // 8)
        return memory

    def check(self, site: Site, buffer: str, displacement: int, base: str, fingerprints: str) -> None:
        """Let only the lanes go on that pass the check. fingerprints: of what the lanes store, or null."""
        w = self.w
        passed = self.ask([site], buffer, displacement, base, self.active_bits(), fingerprints)
        narrow = passed if w.lanes == 32 else w.value(f"trunc i32 {passed} to i{w.lanes}")
        mask = w.value(f"bitcast i{w.lanes} {narrow} to {w.vector('i1')}")
        self.checked = (mask, mask)

    def ask(
        self, sites: list[Site], buffer: str, displacement: int, base: str, bits: str, fingerprints: str = "null"
    ) -> str:
        """Which of the chunk's lanes may go on, as bits of an i32. sites: of a run, the first of which names it."""
        w, g = self.w, self.g
        number = len(g.sites)
        g.sites.extend(sites)
        checker, data = g.job_field("check", pointer=True), g.job_field("check_data", pointer=True)
        absolute = f"{displacement}"
        if base != "null":
            absolute = w.value(f"add i64 {g.job_field('shared')}, {displacement}")
        return w.value(
            f"call i32 {checker}(ptr {data}, ptr %job, ptr %context, i64 {number}, i64 %lane.{self.number}, "
            f"i32 {bits}, ptr {self.chunk_of(buffer)}, i64 {absolute}, ptr {fingerprints})"
        )

    # --- the body ---

    def live_after(self, index: int) -> frozenset[Reg]:
        if self._live_after is None:
            self._live_after = {}
            live = set(self.segment.live_out)
            for at in reversed(range(self.segment.start, self.segment.stop)):
                self._live_after[at] = frozenset(live)
                item = self.g.kernel.instructions[at]
                if item.guard is None:
                    live.difference_update(item.writes())
                live.update(item.reads())
        return self._live_after[index]

    def emit_body(self, stop: int) -> None:
        """Instructions up to ``stop``, then the registers that outlive the segment go to their slots."""
        self._guarded: dict[str, str] = {}
        self._chunk_buffers: dict[str, str] = {}
        for index in range(self.segment.start, stop):
            item = self.g.kernel.instructions[index]
            self._set_guard(item)
            try:
                self._emit(index, item)
            except (Refused, KeyError, ValueError, IndexError) as problem:
                raise refusal(item) from problem
        self.guard = None
        self.checked = None
        codegen_memory.flush_deferred(self)

    def _set_guard(self, item: Instruction) -> None:
        self.checked = None
        self.guard = None
        if item.guard is not None and item.root not in _BRANCHES:
            guard = self.register(item.guard)
            if item.negated:
                key = f"!{guard}"
                if key not in self._guarded:
                    self._guarded[key] = self.w.invert(guard)
                guard = self._guarded[key]
            self.guard = guard

    def _emit(self, index: int, item: Instruction) -> None:
        if item.root in ("ld", "st", "atom", "red"):
            codegen_memory.emit_access(self, index, item)
        elif item.root in _NOTHING:
            if item.root in ("membar", "fence"):
                codegen_memory.flush_deferred(self)
                if self.checks and {"gl", "sys", "gpu"} & set(item.modifiers):
                    self.w.store("i16", "1", self.w.at("%context", scheduler.CONTEXT_FENCED), 2)
        elif codegen_rare.emit(self, item):
            pass
        elif item.root in EMITTERS:
            EMITTERS[item.root](self, item)
        else:
            raise Refused

    def store_registers(self, kept: set[Reg]) -> None:
        w = self.w
        for reg in sorted((self.written & kept) - self.g.uniform.keys(), key=lambda r: r.name):
            value, address = self.values[reg], self.slot_address(reg)
            if reg.type == "pred":
                narrow = f"i{w.lanes}"
                new = w.value(f"bitcast {w.vector('i1')} {value} to {narrow}")
                old = w.load(narrow, address, w.lanes // 8)
                changed = w.value(f"xor {narrow} {old}, {new}")
                changed = w.value(f"and {narrow} {changed}, %narrow.{self.number}")
                w.store(narrow, w.value(f"xor {narrow} {old}, {changed}"), address, w.lanes // 8)
            else:
                element = element_of(reg)
                align = min(64, w.lanes * ELEMENT_BYTES[element])
                w.masked_store(element, value, address, f"%mask.{self.number}", align)


_WIDE_SPECIAL = frozenset({"%gridid"})
_JOB_SPECIAL = {
    "%nwarpid": "warps",
    "%dynamic_smem_size": "dynamic_bytes",
    "%total_smem_size": "shared_bytes",
}
_CONSTANT_SPECIAL = {"%smid": 0, "%nsmid": 1, "%gridid": 0}


class _Segment:
    """One segment: the loop over chunks, what the whole warp does after it, and where its lanes go."""

    def __init__(self, generator: _Generator, number: int, segment: Block) -> None:
        self.g, self.number, self.segment = generator, number, segment
        self.w = generator.w
        self.last = generator.kernel.instructions[segment.stop - 1]

    def emit(self) -> None:
        w, n, g = self.w, self.number, self.g
        if n in g.joinable:
            w.label(f"check{n}")
            waiting = w.load("i32", self._pending(n), 4)
            some = w.value(f"icmp ne i32 {waiting}, 0")
            w.emit(f"br i1 {some}, label %run{n}, label %{g.chain(n + 1)}")
        w.label(f"run{n}")
        w.emit(f"%warp.{n} = load i32, ptr {self._pending(n)}, align 4")
        w.store("i32", "0", self._pending(n), 4)
        if g.counts and not codegen_warp.gathers(self.last):
            codegen_count.count_segment(g, n, f"%warp.{n}")
        if g.traces and not codegen_warp.gathers(self.last):
            codegen_trace.advance_clock(g, n)
        body = SegmentBody(g, n, self.segment)
        stop = self.segment.stop - 1 if _is_tail(self.last) else self.segment.stop
        self._branch_bits: str | None = None
        if stop > self.segment.start:
            self._chunks(body, stop)
        for after in body.after_chunks:
            after(f"%warp.{n}")
        self._leave()

    def _chunks(self, body: SegmentBody, stop: int) -> None:
        w, n, lanes = self.w, self.number, self.g.lanes
        chunks = WARP // lanes
        w.emit(f"br label %chunk.loop{n}")
        w.label(f"chunk.loop{n}")
        w.emit(f"%chunk.{n} = phi i64 [ 0, %{self._block_before(n)} ], [ %chunk.next{n}, %chunk.end{n} ]")
        w.emit(f"%lane.{n} = mul i64 %chunk.{n}, {lanes}")
        w.emit(f"%lane32.{n} = trunc i64 %lane.{n} to i32")
        w.emit(f"%shifted.{n} = lshr i32 %warp.{n}, %lane32.{n}")
        w.emit(f"%narrow.{n} = " + (f"trunc i32 %shifted.{n} to i{lanes}" if lanes < 32 else f"or i32 %shifted.{n}, 0"))
        w.emit(f"%bits.{n} = " + (f"zext i{lanes} %narrow.{n} to i32" if lanes < 32 else f"or i32 %shifted.{n}, 0"))
        w.emit(f"%mask.{n} = bitcast i{lanes} %narrow.{n} to <{lanes} x i1>")
        w.emit(f"%none.{n} = icmp eq i32 %bits.{n}, 0")
        w.emit(f"br i1 %none.{n}, label %chunk.end{n}, label %chunk.body{n}")
        w.label(f"chunk.body{n}")
        for size in (2, 4, 8):
            w.emit(f"%at{size}.{n} = mul i64 %chunk.{n}, {size * lanes}")
            w.emit(f"%chunk{size}.{n} = getelementptr i8, ptr %context, i64 %at{size}.{n}")
        w.emit(f"%at0.{n} = mul i64 %chunk.{n}, {lanes // 8}")
        w.emit(f"%chunk0.{n} = getelementptr i8, ptr %context, i64 %at0.{n}")
        body.emit_body(stop)
        kept = set(self.segment.live_out)
        if codegen_warp.is_collective(self.last) or codegen_warp.is_barrier(self.last):
            kept.update(self.last.reads())
        guard = self.last.guard
        if self.last.root in _BRANCHES:
            kept.update(self.last.reads())
            if guard is not None and guard in body.written:
                self._branch_bits = body._kept_bits(body._bits(body.values[guard]))
                if guard not in self.segment.live_out:
                    kept.discard(guard)
        body.store_registers(kept)
        w.emit(f"br label %chunk.end{n}")
        w.label(f"chunk.end{n}")
        w.emit(f"%chunk.next{n} = add i64 %chunk.{n}, 1")
        w.emit(f"%chunk.last{n} = icmp eq i64 %chunk.next{n}, {chunks}")
        w.emit(f"br i1 %chunk.last{n}, label %chunk.done{n}, label %chunk.loop{n}")
        w.label(f"chunk.done{n}")

    def _block_before(self, n: int) -> str:
        return f"run{n}"

    # --- leaving the segment ---

    def _leave(self) -> None:
        w, n, g, last = self.w, self.number, self.g, self.last
        mask = f"%warp.{n}"
        if codegen_warp.is_barrier(last):
            self._barrier(mask)
            return
        if codegen_warp.is_collective(last):
            try:
                codegen_warp.emit_collective(g, n, last, mask, self._gather)
            except (Refused, KeyError, ValueError, IndexError) as problem:
                raise refusal(last) from problem
            self._fall_through(mask)
        elif last.root == "bra":
            self._branch(mask)
        elif last.root == "brx":
            self._branch_by_index(mask)
        elif last.root in ("ret", "exit"):
            self._end_lanes(mask)
        elif last.root == "trap":
            taken = self._guard_bits(mask)
            some = w.value(f"icmp ne i32 {taken}, 0")
            self.fault(some, scheduler.FAULT_TRAP)
            self._fall_through(mask)
        elif g.mode == "debug" and g.yields_after(last):
            self._add_pending(n + 1, mask)
            w.store("i32", str(n + 1), "%context", 4)
            w.emit(f"ret i32 {scheduler.STATUS_YIELD}")
        else:
            self._fall_through(mask)

    def _gather(self, named: str, arrived: str, status: int) -> None:
        """Let the lanes wait at this segment while live lanes that they name are still on their way.

        named, arrived: lanes as bits. status: how the launch ends if one of those never comes, or leaves meanwhile.
        """
        w, n, g = self.w, self.number, self.g
        live = self._live()
        waited_at = w.at("%context", scheduler.CONTEXT_WAITED)
        waited = w.load("i32", waited_at, 4)
        elsewhere = w.value(f"and i32 {named}, {w.value(f'xor i32 {arrived}, -1')}")
        missing = w.value(f"and i32 {elsewhere}, {live}")
        w.emit(f"br i1 {w.value(f'icmp ne i32 {missing}, 0')}, label %wait{n}, label %gathered{n}")
        w.label(f"wait{n}")
        self._add_pending(n, f"%warp.{n}")
        w.store("i32", str(status), w.at("%context", scheduler.CONTEXT_STUCK), 4)
        w.store("i32", str(n), w.at("%context", scheduler.CONTEXT_STUCK_SEGMENT), 4)
        w.store("i32", w.value(f"or i32 {waited}, {missing}"), waited_at, 4)
        w.emit(f"br label %{g.chain(n + 1)}")
        w.label(f"gathered{n}")
        left = w.value(f"and i32 {elsewhere}, {waited}")  # dead, or they would be missing
        w.store("i32", w.value(f"and i32 {waited}, {w.value(f'xor i32 {arrived}, -1')}"), waited_at, 4)
        self.fault(w.value(f"icmp ne i32 {left}, 0"), status)
        if g.counts:
            codegen_count.count_segment(g, n, f"%warp.{n}")
        if g.traces:
            codegen_trace.advance_clock(g, n)

    def fault(self, condition: str, status: int) -> None:
        """Stop the launch with ``status`` if the condition holds; go on otherwise."""
        emit_fault(self.g, condition, status, self.number)

    def _pending(self, number: int) -> str:
        return self.w.at("%context", self.g.pending_at + 4 * number)

    def _add_pending(self, number: int, mask: str) -> None:
        w = self.w
        address = self._pending(number)
        old = w.load("i32", address, 4)
        w.store("i32", w.value(f"or i32 {old}, {mask}"), address, 4)

    def _live(self) -> str:
        return self.w.load("i32", self.w.at("%context", scheduler.CONTEXT_LIVE), 4)

    def _fall_through(self, mask: str) -> None:
        n = self.number
        if n + 1 >= len(self.g.segments):
            self._end_lanes(mask)
            return
        self._add_pending(n + 1, mask)
        self.w.emit(f"br label %run{n + 1}")

    def _guard_bits(self, mask: str) -> str:
        """Lanes of ``mask`` for which the last instruction's guard holds."""
        w, guard = self.w, self.last.guard
        if guard is None:
            return mask
        if self._branch_bits is not None:
            bits = w.load("i32", self._branch_bits, 4)
        elif guard in self.g.slot:
            bits = w.load("i32", w.at("%context", self.g.slot[guard]), 4)
        else:
            bits = "0"
        if self.last.negated:
            bits = w.value(f"xor i32 {bits}, -1")
        return w.value(f"and i32 {bits}, {mask}")

    def _branch(self, mask: str) -> None:
        w, n, g = self.w, self.number, self.g
        target = self.segment.successors[0]
        count = len(g.segments)
        backward = target <= n
        if self.last.guard is None:
            if target >= count:
                self._end_lanes(mask)
                return
            self._add_pending(target, mask)
            if backward:
                self._spend(target)
                w.emit(f"br label %run{target}")
            else:
                all_here = w.value(f"icmp eq i32 {mask}, {self._live()}")
                if g.mode == "debug":
                    self._choose(w.value(f"xor i1 {all_here}, true"), f"run{target}")
                w.emit(f"br i1 {all_here}, label %run{target}, label %{g.chain(n + 1)}")
            return
        taken = self._guard_bits(mask)
        stay = w.value(f"xor i32 {taken}, {mask}")
        if g.counts:
            codegen_count.count_branch(g, n, taken, stay)
        self._add_pending(target, taken)
        if n + 1 < count:
            self._add_pending(n + 1, stay)
        some = w.value(f"icmp ne i32 {taken}, 0")
        rest = g.chain(n + 1)
        if g.mode == "debug" and target < count:
            part = w.value(f"and i1 {some}, {w.value(f'icmp ne i32 {stay}, 0')}")
            self._choose(part, rest if backward else f"run{target}")
        if backward:
            w.emit(f"br i1 {some}, label %back{n}, label %{rest}")
            w.label(f"back{n}")
            self._spend(target)
            w.emit(f"br label %run{target}")
        elif target < count:
            all_there = w.value(f"icmp eq i32 {taken}, {self._live()}")
            w.emit(f"br i1 {all_there}, label %run{target}, label %{rest}")
        else:
            w.emit(f"br label %{rest}")

    def _choose(self, parted: str, unusual: str) -> None:
        """Where lanes have parted, let a random bit choose another way to go on; who is passed over goes at the end."""
        w, n = self.w, self.number
        w.emit(f"br i1 {parted}, label %part{n}, label %usual{n}")
        w.label(f"part{n}")
        state = w.load("i64", w.at("%job", JOB["random"]), 8)
        for shift, amount in (("shl", 13), ("lshr", 7), ("shl", 17)):
            state = w.value(f"xor i64 {state}, {w.value(f'{shift} i64 {state}, {amount}')}")
        w.store("i64", state, w.at("%job", JOB["random"]), 8)
        bits = w.value(f"and i64 {state}, {w.load('i64', w.at('%job', JOB['split_mask']), 8)}")
        w.emit(f"br i1 {w.value(f'icmp eq i64 {bits}, 0')}, label %unusual{n}, label %usual{n}")
        w.label(f"unusual{n}")
        w.store("i16", "1", w.at("%context", scheduler.CONTEXT_SET_ASIDE), 2)
        w.emit(f"br label %{unusual}")
        w.label(f"usual{n}")

    def _spend(self, target: int) -> None:
        """A backward branch pays for the instructions it is about to repeat."""
        w, g = self.w, self.g
        cost = self.segment.stop - g.segments[target].start
        address = w.at("%job", JOB["budget"])
        left = w.value(f"sub i64 {w.load('i64', address, 8)}, {cost}")
        w.store("i64", left, address, 8)
        self.fault(w.value(f"icmp slt i64 {left}, 0"), scheduler.FAULT_BUDGET)
        if g.traces and self.last.root == "bra":
            codegen_trace.yield_if_full(g, target)

    def _branch_by_index(self, mask: str) -> None:
        w, n, g = self.w, self.number, self.g
        taken = self._guard_bits(mask)
        if self.last.guard is not None:
            self._add_pending(n + 1, w.value(f"xor i32 {taken}, {mask}"))
        index = self.last.srcs[0]
        assert isinstance(index, Reg)
        targets = self.segment.successors[: len(self.last.targets)]
        ways: dict[int, str] = {}  # lanes by where they go
        with codegen_warp.whole_warp(w):
            slot = w.load(w.vector("i32"), w.at("%context", g.slot[index]), 64)
            for position, target in enumerate(targets):
                match = w.compare("icmp eq", "i32", slot, w.splat_int("i32", position))
                bits = w.value(f"and i32 {w.value(f'bitcast <32 x i1> {match} to i32')}, {taken}")
                ways[target] = w.value(f"or i32 {ways[target]}, {bits}") if target in ways else bits
        for target, bits in ways.items():
            self._add_pending(target, bits)
        if g.mode == "count":
            stay = [w.value(f"xor i32 {taken}, {mask}")] if self.last.guard is not None else []
            codegen_count.count_table_branch(g, n, [*ways.values(), *stay], mask)
        lowest = min(*targets, n + 1)  # other lanes may be waiting between here and the lowest target
        if lowest <= n:
            self._spend(lowest)
        w.emit(f"br label %{g.chain(lowest)}")

    def _end_lanes(self, mask: str) -> None:
        w, n, g = self.w, self.number, self.g
        ending = self._guard_bits(mask) if self.last.root in ("ret", "exit") else mask
        address = w.at("%context", scheduler.CONTEXT_LIVE)
        gone = w.value(f"xor i32 {ending}, -1")
        w.store("i32", w.value(f"and i32 {self._live()}, {gone}"), address, 4)
        if self.last.guard is not None and self.last.root in ("ret", "exit") and n + 1 < len(g.segments):
            self._add_pending(n + 1, w.value(f"and i32 {mask}, {gone}"))
        w.emit(f"br label %{g.chain(n + 1)}")

    def _barrier(self, mask: str) -> None:
        w, n, g = self.w, self.number, self.g
        try:
            codegen_warp.check_barrier(self.last)
        except Refused as problem:
            raise refusal(self.last) from problem
        arrived = self._guard_bits(mask)
        self._gather("-1", arrived, scheduler.FAULT_DIVERGENT_BARRIER)
        if g.mode == "debug":
            w.store("i32", str(n), w.at("%context", scheduler.CONTEXT_BARRIER), 4)
        reduces = codegen_warp.is_reducing_barrier(self.last)
        if reduces:
            codegen_warp.arrive_with_vote(g, n, self.last, arrived)
        if n + 1 >= len(g.segments):
            w.emit("br label %ended")
            return
        self._add_pending(n + 1, mask)
        w.store("i32", str(n + 1), "%context", 4)
        w.emit(f"ret i32 {scheduler.STATUS_BARRIER}")
        if reduces:
            w.label(f"reduced{n}")
            waiting = w.load("i32", self._pending(n + 1), 4)
            codegen_warp.read_votes(g, n, self.last, waiting)
            w.emit(f"br label %run{n + 1}")


def emit_fault(g: _Generator, condition: str, status: int, number: int) -> None:
    w = g.w
    label = g.label()
    w.emit(f"br i1 {condition}, label %fault{label}, label %sound{label}")
    w.label(f"fault{label}")
    w.store("i64", str(number), w.at("%job", JOB["stop_segment"]), 8)
    w.emit(f"ret i32 {status}")
    w.label(f"sound{label}")
