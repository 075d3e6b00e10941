"""Operations among the lanes of a warp, and barriers: on all 32 lanes at once, on registers in their slots."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from mpmbench.simt import scheduler
from mpmbench.simt.codegen_arith import ELEMENT, Refused
from mpmbench.simt.codegen_ir import WARP, Writer, bits_of
from mpmbench.simt.ptx import Imm, Instruction, NotReg, Operand, Reg

if TYPE_CHECKING:
    from mpmbench.simt.codegen import _Generator

_COLLECTIVES = frozenset({"shfl", "vote", "match", "redux", "activemask"})


def is_barrier(item: Instruction) -> bool:
    return item.root in ("bar", "barrier") and "warp" not in item.modifiers


def is_warp_barrier(item: Instruction) -> bool:
    return item.root in ("bar", "barrier") and "warp" in item.modifiers


def is_collective(item: Instruction) -> bool:
    return item.root in _COLLECTIVES or is_warp_barrier(item)


def gathers(item: Instruction) -> bool:
    """Whether the instruction waits for other lanes of its warp."""
    return is_barrier(item) or (is_collective(item) and item.root != "activemask")


def is_reducing_barrier(item: Instruction) -> bool:
    return is_barrier(item) and "red" in item.modifiers


def check_barrier(item: Instruction) -> None:
    """Only the barrier of the whole thread block is supported: ``bar.sync 0``, ``bar.red``, newer spellings of both."""
    kind = [modifier for modifier in item.modifiers if modifier not in ("cta", "aligned")]
    sources = 2 if kind[:1] == ["red"] else 1
    if kind not in (["sync"], ["red", "popc", "u32"], ["red", "and", "pred"], ["red", "or", "pred"]):
        raise Refused
    if len(item.srcs) != sources or item.srcs[0] != Imm(0):
        raise Refused


def arrive_with_vote(g: _Generator, number: int, item: Instruction, warp_mask: str) -> None:
    """Add the warp's lanes and its votes to the barrier's, and clear those of the next barrier."""
    w = g.w
    with whole_warp(w):
        votes = _Collective(g, number, item, warp_mask).votes(item.srcs[1])
        turn = w.load("i64", w.at("%context", scheduler.CONTEXT_REDUCTIONS), 8)
        w.declare("declare i32 @llvm.ctpop.i32(i32)")
        for field, bits in (("votes_0", votes), ("arrived_0", warp_mask)):
            here, after = (_in_rotation(w, field, turn, step) for step in (0, 1))
            count = w.value(f"zext i32 {w.value(f'call i32 @llvm.ctpop.i32(i32 {bits})')} to i64")
            w.store("i64", w.value(f"add i64 {w.load('i64', here, 8)}, {count}"), here, 8)
            w.store("i64", "0", after, 8)
        more = w.value(f"add i64 {turn}, 1")
        w.store("i64", more, w.at("%context", scheduler.CONTEXT_REDUCTIONS), 8)


def read_votes(g: _Generator, number: int, item: Instruction, warp_mask: str) -> None:
    """After the barrier: its outcome, the same for all threads."""
    w = g.w
    with whole_warp(w):
        turn = w.load("i64", w.at("%context", scheduler.CONTEXT_REDUCTIONS), 8)
        votes, arrived = (w.load("i64", _in_rotation(w, field, turn, -1), 8) for field in ("votes_0", "arrived_0"))
        _Collective(g, number, item, warp_mask).write_outcome(votes, arrived)


def _in_rotation(w: Writer, field: str, turn: str, step: int) -> str:
    """Address of a field of the three sets of votes, counted from ``turn``."""
    place = w.value(f"urem i64 {w.value(f'add i64 {turn}, {step + 3}')}, 3")
    offset = w.value(f"mul i64 {place}, {scheduler.JOB['votes_1'] - scheduler.JOB['votes_0']}")
    return w.value(f"getelementptr i8, ptr {w.at('%job', scheduler.JOB[field])}, i64 {offset}")


@contextmanager
def whole_warp(w: Writer) -> Iterator[None]:
    """Write code for vectors of 32 lanes."""
    lanes, w.lanes = w.lanes, WARP
    try:
        yield
    finally:
        w.lanes = lanes


def emit_collective(
    g: _Generator, number: int, item: Instruction, warp_mask: str, gather: Callable[[str, str, int], None]
) -> None:
    """mask: lanes that execute the instruction together. gather: (lanes named, lanes here, fault if one never
    comes) writes the code that waits for them."""
    with whole_warp(g.w):
        _Collective(g, number, item, warp_mask).emit(gather)


class _Collective:
    def __init__(self, g: _Generator, number: int, item: Instruction, warp_mask: str) -> None:
        self.g, self.w, self.number, self.item = g, g.w, number, item
        self.mask = warp_mask
        if item.guard is not None:
            guard = self._predicate_bits(item.guard)
            if item.negated:
                guard = self.w.value(f"xor i32 {guard}, -1")
            self.mask = self.w.value(f"and i32 {guard}, {warp_mask}")
        self.mask_vector = self.w.value(f"bitcast i32 {self.mask} to <32 x i1>")

    def emit(self, gather: Callable[[str, str, int], None]) -> None:
        item = self.item
        if item.root == "activemask":
            self._write(0, self.w.splat("i32", self.mask), "i32")
        elif is_warp_barrier(item):
            self._check_members(item.srcs[0], gather)
            if self.g.mode == "debug":
                address = self.w.at("%context", scheduler.CONTEXT_WARP_EPOCH)
                old = self.w.load("i64", address, 8)
                self.w.store("i64", self.w.value(f"add i64 {old}, 1"), address, 8)
        elif "sync" not in item.modifiers:
            raise Refused
        else:
            self._check_members(item.srcs[-1], gather)
            {"shfl": self._shuffle, "vote": self._vote, "match": self._match, "redux": self._reduce}[item.root]()

    def votes(self, operand: Operand) -> str:
        """Lanes that hold a predicate, as bits."""
        return self.w.value(f"and i32 {self._predicate_bits(operand)}, {self.mask}")

    def write_outcome(self, votes: str, arrived: str) -> None:
        """Result of a reducing barrier from its two counts."""
        w = self.w
        operation = next(m for m in self.item.modifiers if m in ("popc", "and", "or"))
        if operation == "popc":
            self._write(0, w.splat("i32", w.value(f"trunc i64 {votes} to i32")), "i32")
            return
        test = f"icmp eq i64 {votes}, {arrived}" if operation == "and" else f"icmp ne i64 {votes}, 0"
        self._write_predicate(0, w.value(f"sext i1 {w.value(test)} to i32"))

    # --- operands ---

    def _predicate_bits(self, operand: Operand) -> str:
        """Predicate of 32 lanes as an i32."""
        w = self.w
        if isinstance(operand, NotReg):
            return w.value(f"xor i32 {self._predicate_bits(operand.reg)}, -1")
        if isinstance(operand, Imm):
            return "-1" if operand.value else "0"
        assert isinstance(operand, Reg)
        return w.load("i32", w.at("%context", self.g.slot[operand]), 4)

    def _read(self, operand: Operand, kind: str) -> str:
        w, element = self.w, ELEMENT[kind]
        if isinstance(operand, Imm):
            return w.splat_bits(element, operand.value)
        if not isinstance(operand, Reg):
            raise Refused
        return w.load(w.vector(element), w.at("%context", self.g.slot[operand]), 64)

    def _write(self, position: int, value: str, element: str) -> None:
        dst = self.item.dsts[position]
        if dst is None:
            return
        self.w.masked_store(element, value, self.w.at("%context", self.g.slot[dst]), self.mask_vector, 64)

    def _write_predicate(self, position: int, bits: str) -> None:
        dst = self.item.dsts[position]
        if dst is None:
            return
        w = self.w
        address = w.at("%context", self.g.slot[dst])
        old = w.load("i32", address, 4)
        changed = w.value(f"and i32 {w.value(f'xor i32 {old}, {bits}')}, {self.mask}")
        w.store("i32", w.value(f"xor i32 {old}, {changed}"), address, 4)

    def _check_members(self, operand: Operand, gather: Callable[[str, str, int], None]) -> None:
        """Wait for every live lane that the member mask names; every lane here must be named."""
        from mpmbench.simt.codegen import emit_fault

        w = self.w
        if isinstance(operand, Imm):
            named = str(operand.value & 0xFFFFFFFF)
            unnamed = w.value(f"and i32 {self.mask}, {w.value(f'xor i32 {named}, -1')}")
        else:
            # A register may name another group in every lane; each lane must be in its own group.
            members = self._read(operand, "b32")
            executing = w.select("i32", self.mask_vector, members, w.splat_int("i32", 0))
            w.declare("declare i32 @llvm.vector.reduce.or.v32i32(<32 x i32>)")
            named = w.value(f"call i32 @llvm.vector.reduce.or.v32i32(<32 x i32> {executing})")
            own = w.binary("and", "i32", members, w.binary("shl", "i32", w.splat_int("i32", 1), _lane_constant()))
            is_unnamed = w.compare("icmp eq", "i32", own, w.splat_int("i32", 0))
            unnamed = w.value(f"and i32 {w.value(f'bitcast <32 x i1> {is_unnamed} to i32')}, {self.mask}")
        gather(named, self.mask, scheduler.FAULT_MASK)
        emit_fault(self.g, w.value(f"icmp ne i32 {unnamed}, 0"), scheduler.FAULT_MASK, self.number)

    # --- operations ---

    def _shuffle(self) -> None:
        """PTX ISA 9.7.9.6: bits 8..12 of the third operand cut the warp into segments, bits 0..4 clamp."""
        w, item = self.w, self.item
        mode = item.modifiers[1]
        value = item.srcs[0]
        amount = w.binary("and", "i32", self._read(item.srcs[1], "b32"), w.splat_int("i32", 31))
        control = self._read(item.srcs[2], "b32")
        clamp = w.binary("and", "i32", control, w.splat_int("i32", 31))
        segment = w.binary(
            "and", "i32", w.binary("lshr", "i32", control, w.splat_int("i32", 8)), w.splat_int("i32", 31)
        )
        free = w.binary("xor", "i32", segment, w.splat_int("i32", -1))
        lane = _lane_constant()
        low = w.binary("and", "i32", lane, segment)
        high = w.binary("or", "i32", low, w.binary("and", "i32", clamp, free))
        if mode == "up":
            source = w.binary("sub", "i32", lane, amount)
        elif mode == "down":
            source = w.binary("add", "i32", lane, amount)
        elif mode == "bfly":
            source = w.binary("xor", "i32", lane, amount)
        elif mode == "idx":
            source = w.binary("or", "i32", low, w.binary("and", "i32", amount, free))
        else:
            raise Refused
        inside = w.compare("icmp sge" if mode == "up" else "icmp sle", "i32", source, high)
        source = w.select("i32", inside, source, lane)
        if isinstance(value, Reg):
            base = w.at("%context", self.g.slot[value])
            pointers = w.value(f"getelementptr i32, ptr {base}, <32 x i32> {source}")
            w.declare("declare <32 x i32> @llvm.masked.gather.v32i32.v32p0(<32 x ptr>, <32 x i1>, <32 x i32>)")
            result = w.value(
                f"call <32 x i32> @llvm.masked.gather.v32i32.v32p0(<32 x ptr> align 4 {pointers}, "
                "<32 x i1> splat (i1 true), <32 x i32> zeroinitializer)"
            )
        else:
            result = self._read(value, "b32")
        self._write(0, result, "i32")
        if len(item.dsts) > 1:
            self._write_predicate(1, w.value(f"bitcast <32 x i1> {inside} to i32"))

    def _vote(self) -> None:
        w, item = self.w, self.item
        mode = item.modifiers[1]
        held = w.value(f"and i32 {self._predicate_bits(item.srcs[0])}, {self.mask}")
        if mode == "ballot":
            self._write(0, w.splat("i32", held), "i32")
            return
        some = w.value(f"icmp ne i32 {held}, 0")
        every = w.value(f"icmp eq i32 {held}, {self.mask}")
        if mode == "uni":
            outcome = w.value(f"or i1 {every}, {w.value(f'icmp eq i32 {held}, 0')}")
        else:
            outcome = {"any": some, "all": every}[mode]
        self._write_predicate(0, w.value(f"sext i1 {outcome} to i32"))

    def _match(self) -> None:
        """``any``: the lanes with this lane's value. ``all``: all lanes if they agree, else none; and a predicate."""
        w, item = self.w, self.item
        kind = item.modifiers[-1]
        element = ELEMENT[kind]
        size = bits_of(element) // 8
        operand = item.srcs[0]
        values = self._read(operand, kind)
        results = w.buffer(4 * WARP)
        if not isinstance(operand, Reg):
            raise Refused
        for lane in range(WARP):
            scalar = w.load(element, w.at("%context", self.g.slot[operand] + size * lane), size)
            same = w.compare("icmp eq", element, values, w.splat(element, scalar))
            bits = w.value(f"and i32 {w.value(f'bitcast <32 x i1> {same} to i32')}, {self.mask}")
            w.store("i32", bits, w.at(results, 4 * lane), 4)
        groups = w.load("<32 x i32>", results, 64)
        if "any" in item.modifiers:
            self._write(0, groups, "i32")
            return
        whole = w.compare("icmp eq", "i32", groups, w.splat("i32", self.mask))
        self._write(0, w.select("i32", whole, groups, w.splat_int("i32", 0)), "i32")
        if len(item.dsts) > 1:
            self._write_predicate(1, w.value(f"bitcast <32 x i1> {whole} to i32"))

    def _reduce(self) -> None:
        w, item = self.w, self.item
        operation, kind = item.modifiers[-2:]
        if kind not in ("s32", "u32", "b32"):
            raise Refused
        letter = "s" if kind == "s32" else "u"
        name = f"{letter}{operation}" if operation in ("min", "max") else operation
        neutral = {
            "add": 0,
            "or": 0,
            "xor": 0,
            "and": -1,
            "umin": -1,
            "umax": 0,
            "smin": 2**31 - 1,
            "smax": -(2**31),
        }
        value = self._read(item.srcs[0], kind)
        masked = w.select("i32", self.mask_vector, value, w.splat_int("i32", neutral[name]))
        w.declare(f"declare i32 @llvm.vector.reduce.{name}.v32i32(<32 x i32>)")
        total = w.value(f"call i32 @llvm.vector.reduce.{name}.v32i32(<32 x i32> {masked})")
        self._write(0, w.splat("i32", total), "i32")


def _lane_constant() -> str:
    return "<" + ", ".join(f"i32 {lane}" for lane in range(WARP)) + ">"
