"""Loads, stores and atomics of one chunk of lanes.

Lanes that must not touch memory are redirected to a *sink* area, so that wide accesses need no branch per lane.
Atomics without a used result are put off to the next access that could see them and then carried out lane after lane:
adds to neighbouring words become one wide add. That is one of the orders the memory model allows, always the same.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from mpmbench.simt.codegen_arith import ELEMENT, Refused, flush, is_float, is_signed
from mpmbench.simt.codegen_ir import ELEMENT_BYTES, WARP, integer_of
from mpmbench.simt.ptx import Address, Imm, Instruction, Operand, Reg, Symbol, Vector

if TYPE_CHECKING:
    from mpmbench.simt.codegen import SegmentBody

SINK_REACH = 1 << 15  # bytes around the middle of the sink that an access may be displaced by
SINK_BYTES = 2 * SINK_REACH + 64

# Say how to cache or order, not what to do: lanes of one launch run in one fixed order here.
_HINTS = re.compile(
    r"(volatile|relaxed|acquire|release|acq_rel|weak|gpu|sys|cta|cluster|nc|ca|cg|cs|lu|cv|wb|wt|mmio|unified"
    r"|L1::\w+|L2::\w+)$"
)
_SPACES = frozenset({"global", "shared", "local", "const", "param"})


MOST_GATHERS = 64  # of a segment; with more, each lane loads for itself
_SHARED_QUADS = 4  # runs that must share a quad before it is worth staging it apart


@dataclass(frozen=True)
class Access:
    """What a memory instruction does, from its modifiers. space is ``generic`` where none is named."""

    space: str
    operation: str  # of atomics: add, cas, ...
    kind: str  # type of one element
    count: int  # elements: 1, 2 or 4
    order: str = "weak"  # as of a Site

    @property
    def width(self) -> int:
        """Bytes per lane."""
        return ELEMENT_BYTES[ELEMENT[self.kind]] * self.count


def access_of(item: Instruction) -> Access:
    space, operation, count = "generic", item.root, 1
    *flags, kind = item.modifiers
    if kind not in ELEMENT:
        raise Refused
    for flag in flags:
        if flag in _SPACES or flag == "shared::cta":
            space = flag.removesuffix("::cta")
        elif flag in ("v2", "v4"):
            count = int(flag[1])
        elif item.root in ("atom", "red") and flag in _ATOMIC:
            operation = flag
        elif not _HINTS.match(flag):
            raise Refused
    return Access(space, operation, kind, count, _order(flags))


def gathers_of(item: Instruction) -> int:
    """How many gathers a load becomes where its segment has few of them."""
    if item.root != "ld" or "param" in item.modifiers or item.modifiers[-1] not in ELEMENT:
        return 0
    count = 4 if "v4" in item.modifiers else 2 if "v2" in item.modifiers else 1
    return {4: 1, 8: 1, 16: 2 if count == 2 else 0}.get(count * ELEMENT_BYTES[ELEMENT[item.modifiers[-1]]], 0)


def _order(flags: Sequence[str]) -> str:
    if {"release", "acq_rel"} & set(flags):
        return "release"
    return "strong" if {"volatile", "relaxed", "acquire", "mmio"} & set(flags) else "weak"


_ATOMIC = frozenset({"add", "min", "max", "inc", "dec", "and", "or", "xor", "exch", "cas"})


@dataclass(frozen=True)
class Site:
    """A memory instruction that is counted or checked. kind: load, store or atomic."""

    index: int  # instruction in the kernel
    kind: str
    space: str
    width: int  # bytes per lane
    element: int  # bytes of one element
    order: str = "weak"  # weak, strong (volatile, relaxed, acquire), or release: strong with a fence before it
    run: int = 1  # neighbouring accesses, one site each, that are checked in one go with this one


@dataclass
class Place:
    """Where the lanes of one access point: ``base`` plus a 64-bit vector plus ``displacement`` bytes."""

    base: str  # scalar pointer; "null" for absolute addresses
    vector: str
    displacement: int


@dataclass
class Deferred:
    """An atomic add that has been put off."""

    index: int
    access: Access
    key: object  # equal for addresses that differ by a constant and have the same active lanes
    offset: int  # that constant
    value: str
    buffer: str  # of addresses
    displacement: int
    base: str
    mask: str  # bits of the chunk's active lanes, i32


def emit_access(ctx: SegmentBody, index: int, item: Instruction) -> None:
    access = access_of(item)
    address = next(operand for operand in item.srcs if isinstance(operand, Address))
    if access.space == "param":
        _load_parameter(ctx, item, access, address)
        return
    if access.space == "const":
        if item.root != "ld":
            raise Refused
        _load(ctx, index, item, access, address)
        return
    if item.root in ("atom", "red"):
        values = [operand for operand in item.srcs if not isinstance(operand, Address)]
        used = any(dst is not None and dst in ctx.live_after(index) for dst in item.dsts)
        if access.operation == "add" and not used and access.count == 1:
            _defer_add(ctx, index, access, address, values[0])
        else:
            flush_deferred(ctx)
            _atomic(ctx, index, item, access, address, values, used)
        return
    if _sees_deferred(item):
        flush_deferred(ctx)
    if item.root == "ld":
        _load(ctx, index, item, access, address)
    else:
        _store(ctx, index, item, access, address)


# --- addresses ----------------------------------------------------------------------------------------------------


def _place(ctx: SegmentBody, space: str, address: Address) -> Place:
    w = ctx.w
    base = ctx.shared_pointer() if space == "shared" else "null"
    match address.base:
        case Reg(_, kind):
            vector = ctx.read(address.base, "u64" if kind == "b64" else "u32")
            if kind != "b64":
                vector = w.cast("zext", vector, "i32", "i64")
            return Place(base, vector, address.offset)
        case Symbol(_, "shared", offset) if space == "shared":
            return Place(base, "zeroinitializer", offset + address.offset)
        case Symbol():
            return Place(base, ctx.read(address.base, "u64"), address.offset)
        case Imm(value):
            return Place(base, "zeroinitializer", value + address.offset)
    raise Refused


def _address_buffer(ctx: SegmentBody, index: int, space: str, address: Address) -> tuple[str, int, str, object, int]:
    """Addresses in memory, where scalar code finds them: -> buffer, displacement, base pointer, key, constant.

    Dead lanes' addresses are those of the sink. One buffer serves all accesses whose addresses differ by constants.
    """
    form = ctx.forms[index]
    mask_name, mask = ctx.active()
    in_shared = space == "shared"
    key = (form.terms, in_shared, mask_name)
    known = ctx.anchors.get(key)
    if known is not None and abs(form.constant - known[1]) < SINK_REACH - 64:
        buffer, anchored, base = known
        return buffer, form.constant - anchored, base, key, form.constant
    w = ctx.w
    place = _place(ctx, space, address)
    vector = place.vector
    if place.displacement and abs(place.displacement) >= SINK_REACH - 64:
        vector = w.binary("add", "i64", vector, w.splat_int("i64", place.displacement))
        place = Place(place.base, vector, 0)
    sink = w.splat("i64", ctx.sink(in_shared))
    safe = w.select("i64", mask, vector, sink)
    buffer = ctx.lane_buffer("i64")
    ctx.store_chunk(buffer, "i64", safe)
    ctx.anchors[key] = (buffer, form.constant - place.displacement, place.base)
    return buffer, place.displacement, place.base, key, form.constant


def _lane_address(ctx: SegmentBody, buffer: str, lane: int | str, base: str, displacement: int) -> str:
    """Scalar pointer of one lane of the chunk."""
    w = ctx.w
    at = w.at(buffer, 8 * lane) if isinstance(lane, int) else w.value(f"getelementptr i64, ptr {buffer}, i64 {lane}")
    offset = w.load("i64", at, 8)
    if displacement:
        offset = w.value(f"add i64 {offset}, {displacement}")
    if base == "null":
        return w.value(f"inttoptr i64 {offset} to ptr")
    return w.value(f"getelementptr i8, ptr {base}, i64 {offset}")


def _pointers(ctx: SegmentBody, place: Place, extra: int = 0) -> str:
    """Vector of pointers for gathers and scatters."""
    w = ctx.w
    vector = place.vector
    displacement = place.displacement + extra
    if displacement:
        vector = w.binary("add", "i64", vector, w.splat_int("i64", displacement))
    if place.base == "null":
        return w.cast("inttoptr", vector, "i64", "ptr")
    return w.value(f"getelementptr i8, ptr {place.base}, {w.vector('i64')} {vector}")


def _account(
    ctx: SegmentBody, index: int, kind: str, access: Access, address: Address, stored: Sequence[str] = ()
) -> None:
    """Count the access, or check it: then only the lanes that pass go on. stored: values that a store writes."""
    if not ctx.observes:
        return
    buffer, displacement, base, _, _ = _address_buffer(ctx, index, access.space, address)
    element = ELEMENT_BYTES[ELEMENT[access.kind]]
    site = Site(index, kind, access.space, access.width, element, access.order)
    if ctx.counts:
        ctx.observe_run([site], buffer, displacement)
    else:
        ctx.check(site, buffer, displacement, base, _fingerprints(ctx, stored, ELEMENT[access.kind]))


def _fingerprints(ctx: SegmentBody, values: Sequence[str], element: str) -> str:
    """Memory with a number per lane that stands for what it stores: lanes that store the same do not race."""
    if not values:
        return "null"
    w, integer = ctx.w, integer_of(element)
    total = w.splat_int("i64", 0)
    for value in values:
        bits = w.reinterpret(value, element, integer)
        wide = bits if integer == "i64" else w.cast("zext", bits, integer, "i64")
        total = w.binary("mul", "i64", total, w.splat_int("i64", 0x9E3779B97F4A7C15))
        total = w.binary("add", "i64", total, wide)
    memory = w.buffer(8 * WARP)
    w.store(w.vector("i64"), total, memory, 64)
    return memory


# --- loads --------------------------------------------------------------------------------------------------------


def _load(ctx: SegmentBody, index: int, item: Instruction, access: Access, address: Address) -> None:
    if access.space != "const":
        _account(ctx, index, "load", access, address)
    element = ELEMENT[access.kind]
    if access.count == 4 and access.width == 16:
        values = _load_quads(ctx, index, access, address, element)
    elif access.width in (1, 2):
        whole = _load_small(ctx, index, access, address, f"i{8 * access.width}")
        values = _split(ctx, whole, 8 * access.width, access.count, element)
    elif access.width in (4, 8):
        if ctx.loads_by_lane:
            whole = _load_lane_by_lane(ctx, index, access, address, f"i{8 * access.width}")
        else:
            whole = _gather(ctx, _place(ctx, access.space, address), f"i{8 * access.width}", access.width)
        values = _split(ctx, whole, 8 * access.width, access.count, element)
    elif access.count == 2 and access.width == 16:
        if ctx.loads_by_lane:
            values = [_load_lane_by_lane(ctx, index, access, address, element, 8 * part) for part in range(2)]
        else:
            place = _place(ctx, access.space, address)
            values = [_gather(ctx, place, element, 8, 8 * part) for part in range(2)]
    else:
        raise Refused
    for position, value in enumerate(values):
        dst = item.dsts[position]
        if dst is not None:
            _write_loaded(ctx, item, position, value, access.kind, dst)


def _write_loaded(ctx: SegmentBody, item: Instruction, position: int, value: str, kind: str, dst: Reg) -> None:
    """Loads into a wider register extend by the loaded type's sign."""
    element = ELEMENT[kind]
    register = ctx.element(dst)
    wide = integer_of(register)
    if ELEMENT_BYTES[element] < ELEMENT_BYTES[register]:
        value = ctx.w.cast("sext" if is_signed(kind) else "zext", value, element, wide)
        element = wide
    ctx.write(item, position, value, element)


def _gather(ctx: SegmentBody, place: Place, element: str, align: int, extra: int = 0) -> str:
    w = ctx.w
    _, mask = ctx.active()
    pointers = _pointers(ctx, place, extra)
    suffix = f"v{w.lanes}{ {'float': 'f32', 'double': 'f64'}.get(element, element) }.v{w.lanes}p0"
    vector, masks = w.vector(element), w.vector("i1")
    w.declare(f"declare {vector} @llvm.masked.gather.{suffix}({w.vector('ptr')}, {masks}, {vector})")
    return w.value(
        f"call {vector} @llvm.masked.gather.{suffix}({w.vector('ptr')} align {align} {pointers}, {masks} {mask}, "
        f"{vector} zeroinitializer)"
    )


def _load_lane_by_lane(
    ctx: SegmentBody, index: int, access: Access, address: Address, element: str, extra: int = 0
) -> str:
    """What a gather gives the active lanes, in straight code; lanes that are not active read from the sink.

    For a processor without fast gathers LLVM turns each into a branch per lane, with the whole vector in a phi after
    every one. Joining their registers takes a time that grows with the square of the number of gathers, or faster.
    """
    w = ctx.w
    buffer, displacement, base, _, _ = _address_buffer(ctx, index, access.space, address)
    chunk, vector = ctx.chunk_of(buffer), w.vector(element)
    value = "poison"
    for lane in range(w.lanes):
        pointer = _lane_address(ctx, chunk, lane, base, displacement + extra)
        one = w.load(element, pointer, ELEMENT_BYTES[element])
        value = w.value(f"insertelement {vector} {value}, {element} {one}, i32 {lane}")
    return value


def _split(ctx: SegmentBody, whole: str, bits: int, count: int, element: str) -> list[str]:
    """One integer per lane -> its ``count`` parts, lowest first."""
    w = ctx.w
    part_bits = bits // count
    if count == 1:
        return [w.reinterpret(whole, f"i{bits}", element)]
    parts = []
    for part in range(count):
        value = w.binary("lshr", f"i{bits}", whole, w.splat_int(f"i{bits}", part * part_bits)) if part else whole
        value = w.cast("trunc", value, f"i{bits}", f"i{part_bits}")
        parts.append(w.reinterpret(value, f"i{part_bits}", element))
    return parts


def _load_quads(ctx: SegmentBody, index: int, access: Access, address: Address, element: str) -> list[str]:
    """Four words per lane: 16-byte loads, transposed in registers."""
    w, n = ctx.w, ctx.w.lanes
    buffer, displacement, base, _, _ = _address_buffer(ctx, index, access.space, address)
    rows = []
    for tile_lane in range(4):
        quads = []
        for tile in range(n // 4):
            pointer = _lane_address(ctx, ctx.chunk_of(buffer), 4 * tile + tile_lane, base, displacement)
            quads.append(w.load(f"<4 x {element}>", pointer, 4))
        rows.append(_concatenate(ctx, quads, element))
    return w.transpose4(element, rows)


def _concatenate(ctx: SegmentBody, parts: Sequence[str], element: str) -> str:
    """Vectors of equal length, one after the other."""
    w, size = ctx.w, 4
    values = list(parts)
    while len(values) > 1:
        mask = ", ".join(f"i32 {i}" for i in range(2 * size))
        kind = f"<{size} x {element}>"
        values = [
            w.value(f"shufflevector {kind} {a}, {kind} {b}, <{2 * size} x i32> <{mask}>")
            for a, b in zip(values[::2], values[1::2], strict=True)
        ]
        size *= 2
    return values[0]


def _load_small(ctx: SegmentBody, index: int, access: Access, address: Address, element: str) -> str:
    """One or two bytes per lane."""
    w = ctx.w
    buffer, displacement, base, _, _ = _address_buffer(ctx, index, access.space, address)
    result = w.buffer(8 * WARP)
    size = ELEMENT_BYTES[element]

    def body(lane: str) -> None:
        pointer = _lane_address(ctx, ctx.chunk_of(buffer), lane, base, displacement)
        value = w.load(element, pointer, size)
        w.store(element, value, w.value(f"getelementptr {element}, ptr {result}, i64 {lane}"), size)

    _for_each_lane(ctx, ctx.active_bits(), body)
    return w.load(w.vector(element), result, min(64, size * w.lanes))


def _load_parameter(ctx: SegmentBody, item: Instruction, access: Access, address: Address) -> None:
    """Parameters are the same for all lanes, save where the address is computed."""
    if item.root != "ld":
        raise Refused
    w, element = ctx.w, ELEMENT[access.kind]
    size = ELEMENT_BYTES[element]
    for position, dst in enumerate(item.dsts):
        if dst is None:
            continue
        if isinstance(address.base, Symbol):
            offset = address.base.offset + address.offset + position * size
            scalar = w.load(element, w.at(ctx.params_pointer(), offset), size)
            value = w.splat(element, scalar)
        else:
            if size < 4:
                raise Refused
            vector = ctx.read(address.base, "u64")
            place = Place(ctx.params_pointer(), vector, address.offset)
            value = _gather(ctx, place, element, size, position * size)
        _write_loaded(ctx, item, position, value, access.kind, dst)


# --- stores -------------------------------------------------------------------------------------------------------


def _store(ctx: SegmentBody, index: int, item: Instruction, access: Access, address: Address) -> None:
    source = item.srcs[1]
    operands: Sequence[Operand | None] = source.items if isinstance(source, Vector) else [source]
    element = ELEMENT[access.kind]
    values = [ctx.read(operand, access.kind) for operand in operands if operand is not None]
    _account(ctx, index, "store", access, address, values)
    if access.count == 4 and access.width == 16:
        _store_quads(ctx, index, access, address, element, values)
    elif access.width in (1, 2):
        whole = _join(ctx, values, 8 * access.width, element)
        _store_small(ctx, index, access, address, f"i{8 * access.width}", whole)
    elif access.width in (4, 8):
        whole = _join(ctx, values, 8 * access.width, element)
        _scatter(ctx, _place(ctx, access.space, address), f"i{8 * access.width}", access.width, whole)
    elif access.count == 2 and access.width == 16:
        place = _place(ctx, access.space, address)
        for part, value in enumerate(values):
            _scatter(ctx, place, element, 8, value, 8 * part)
    else:
        raise Refused


def _scatter(ctx: SegmentBody, place: Place, element: str, align: int, value: str, extra: int = 0) -> None:
    """Where lanes meet at one address, the highest one is the last to write."""
    w = ctx.w
    _, mask = ctx.active()
    pointers = _pointers(ctx, place, extra)
    suffix = f"v{w.lanes}{ {'float': 'f32', 'double': 'f64'}.get(element, element) }.v{w.lanes}p0"
    vector, masks = w.vector(element), w.vector("i1")
    w.declare(f"declare void @llvm.masked.scatter.{suffix}({vector}, {w.vector('ptr')}, {masks})")
    w.emit(
        f"call void @llvm.masked.scatter.{suffix}({vector} {value}, {w.vector('ptr')} align {align} {pointers}, "
        f"{masks} {mask})"
    )


def _join(ctx: SegmentBody, values: Sequence[str], bits: int, element: str) -> str:
    """Parts, lowest first -> one integer per lane."""
    w = ctx.w
    part = f"i{bits // len(values)}"
    integers = [w.reinterpret(value, element, part) for value in values]
    if len(values) == 1:
        return integers[0]
    whole = w.cast("zext", integers[0], part, f"i{bits}")
    for position, value in enumerate(integers[1:], 1):
        wide = w.cast("zext", value, part, f"i{bits}")
        shifted = w.binary("shl", f"i{bits}", wide, w.splat_int(f"i{bits}", position * bits // len(values)))
        whole = w.binary("or", f"i{bits}", whole, shifted)
    return whole


def _store_quads(
    ctx: SegmentBody, index: int, access: Access, address: Address, element: str, values: Sequence[str]
) -> None:
    w, n = ctx.w, ctx.w.lanes
    buffer, displacement, base, _, _ = _address_buffer(ctx, index, access.space, address)
    columns = w.transpose4(element, values)
    for lane in range(n):
        tile, tile_lane = divmod(lane, 4)
        mask = ", ".join(f"i32 {4 * tile + part}" for part in range(4))
        vector = w.vector(element)
        quad = w.value(f"shufflevector {vector} {columns[tile_lane]}, {vector} poison, <4 x i32> <{mask}>")
        pointer = _lane_address(ctx, ctx.chunk_of(buffer), lane, base, displacement)
        w.store(f"<4 x {element}>", quad, pointer, 4)


def _store_small(ctx: SegmentBody, index: int, access: Access, address: Address, element: str, value: str) -> None:
    w = ctx.w
    buffer, displacement, base, _, _ = _address_buffer(ctx, index, access.space, address)
    size = ELEMENT_BYTES[element]
    values = w.buffer(8 * WARP)
    w.store(w.vector(element), value, values, min(64, size * w.lanes))

    def body(lane: str) -> None:
        pointer = _lane_address(ctx, ctx.chunk_of(buffer), lane, base, displacement)
        scalar = w.load(element, w.value(f"getelementptr {element}, ptr {values}, i64 {lane}"), size)
        w.store(element, scalar, pointer, size)

    _for_each_lane(ctx, ctx.active_bits(), body)


# --- atomics ------------------------------------------------------------------------------------------------------


def _for_each_lane(ctx: SegmentBody, bits: str, body: Callable[[str], None]) -> None:
    """Code for every set bit of an i32, lowest first. body gets the lane's number in the chunk as an i64."""
    w = ctx.w
    number = ctx.fresh_label()
    before, loop, after = f"before{number}", f"lane{number}", f"after{number}"
    w.emit(f"br label %{before}")
    w.label(before)
    empty = w.value(f"icmp eq i32 {bits}, 0")
    w.emit(f"br i1 {empty}, label %{after}, label %{loop}")
    w.label(loop)
    left, rest = f"%left{number}", f"%rest{number}"
    w.emit(f"{left} = phi i32 [ {bits}, %{before} ], [ {rest}, %{loop}.end ]")
    w.declare("declare i32 @llvm.cttz.i32(i32, i1)")
    position = w.value(f"call i32 @llvm.cttz.i32(i32 {left}, i1 true)")
    body(w.value(f"zext nneg i32 {position} to i64"))
    w.emit(f"br label %{loop}.end")
    w.label(f"{loop}.end")
    less = w.value(f"add i32 {left}, -1")
    w.emit(f"{rest} = and i32 {left}, {less}")
    done = w.value(f"icmp eq i32 {rest}, 0")
    w.emit(f"br i1 {done}, label %{after}, label %{loop}")
    w.label(after)


def _atomic(
    ctx: SegmentBody,
    index: int,
    item: Instruction,
    access: Access,
    address: Address,
    operands: Sequence[Operand],
    used: bool,
) -> None:
    """Lane after lane: read, combine, write; the old values are the result."""
    w, element = ctx.w, ELEMENT[access.kind]
    size = ELEMENT_BYTES[element]
    if size < 4 and access.operation != "cas":
        raise Refused
    align = min(64, size * w.lanes)
    # The operands of every element; a vector atomic has several.
    columns = [operand.items if isinstance(operand, Vector) else (operand,) for operand in operands]
    staged: list[list[str]] = []
    for row in zip(*columns, strict=True):
        buffers = []
        for operand in row:
            if operand is None:
                raise Refused
            buffers.append(w.buffer(8 * WARP))
            w.store(w.vector(element), ctx.read(operand, access.kind), buffers[-1], align)
        staged.append(buffers)
    _account(ctx, index, "atomic", access, address)
    addresses, displacement, base, _, _ = _address_buffer(ctx, index, access.space, address)
    results = [w.buffer(8 * WARP) for _ in staged]

    def body(lane: str) -> None:
        for position, (buffers, result) in enumerate(zip(staged, results, strict=True)):
            at = displacement + position * size
            pointer = _lane_address(ctx, ctx.chunk_of(addresses), lane, base, at)
            values = [w.load(element, _lane_slot(ctx, element, buffer, lane), size) for buffer in buffers]
            old = w.load(element, pointer, size)
            w.store(element, _combine(ctx, access, element, old, values), pointer, size)
            w.store(element, old, _lane_slot(ctx, element, result, lane), size)

    _for_each_lane(ctx, ctx.active_bits(), body)
    if used:
        for position, result in enumerate(results):
            dst = item.dsts[position]
            if dst is not None:
                old = w.load(w.vector(element), result, align)
                _write_loaded(ctx, item, position, old, access.kind, dst)


def _lane_slot(ctx: SegmentBody, element: str, buffer: str, lane: str) -> str:
    return ctx.w.value(f"getelementptr {element}, ptr {buffer}, i64 {lane}")


def _combine(ctx: SegmentBody, access: Access, element: str, old: str, values: Sequence[str]) -> str:
    """New value at the address."""
    w, operation = ctx.w, access.operation
    if operation == "exch":
        return values[0]
    if operation == "cas":
        integer = integer_of(element)
        bits = [w.value(f"bitcast {element} {v} to {integer}") if integer != element else v for v in (old, values[0])]
        same = w.value(f"icmp eq {integer} {bits[0]}, {bits[1]}")
        return w.value(f"select i1 {same}, {element} {values[1]}, {element} {old}")
    value = values[0]
    if is_float(access.kind):
        if operation == "add":
            return _float_sum(ctx, access, element, 1, old, value)
        raise Refused
    if operation in ("add", "and", "or", "xor"):
        return w.value(f"{operation} {element} {old}, {value}")
    if operation in ("min", "max"):
        less = "slt" if is_signed(access.kind) else "ult"
        below = w.value(f"icmp {less} {element} {old}, {value}")
        low, high = (old, value) if operation == "min" else (value, old)
        return w.value(f"select i1 {below}, {element} {low}, {element} {high}")
    if operation == "inc":  # old >= limit ? 0 : old + 1
        at_end = w.value(f"icmp uge {element} {old}, {value}")
        more = w.value(f"add {element} {old}, 1")
        return w.value(f"select i1 {at_end}, {element} 0, {element} {more}")
    # dec: old == 0 or old > limit ? limit : old - 1
    is_zero = w.value(f"icmp eq {element} {old}, 0")
    is_above = w.value(f"icmp ugt {element} {old}, {value}")
    wraps = w.value(f"or i1 {is_zero}, {is_above}")
    less_one = w.value(f"sub {element} {old}, 1")
    return w.value(f"select i1 {wraps}, {element} {value}, {element} {less_one}")


def _float_sum(ctx: SegmentBody, access: Access, kind: str, length: int, old: str, value: str) -> str:
    """Sum of scalars, or of vectors of ``length``. kind: their LLVM type.

    f32 sums in global memory flush denormals (PTX ISA, ``atom``): where the processor does not, code does. Sums in
    shared memory keep them, save in kernels for which the processor flushes.
    """
    w = ctx.w
    if access.kind != "f32" or access.space == "shared" or ctx.hardware_ftz:
        return w.value(f"fadd {kind} {old}, {value}")
    lanes, w.lanes = w.lanes, length
    if length == 1:
        old, value = (w.value(f"insertelement <1 x float> poison, float {term}, i32 0") for term in (old, value))
    total = flush(w, w.binary("fadd", "float", flush(w, old), flush(w, value)))
    w.lanes = lanes
    return total if length > 1 else w.value(f"extractelement <1 x float> {total}, i32 0")


def _defer_add(ctx: SegmentBody, index: int, access: Access, address: Address, operand: Operand) -> None:
    if ELEMENT_BYTES[ELEMENT[access.kind]] < 4:
        raise Refused
    value = ctx.read(operand, access.kind)
    buffer, displacement, base, key, constant = _address_buffer(ctx, index, access.space, address)
    entry = Deferred(index, access, (key, access.kind), constant, value, buffer, displacement, base, ctx.active_bits())
    ctx.deferred.append(entry)


def flush_deferred(ctx: SegmentBody) -> None:
    """Carry out the adds that were put off, lane after lane, neighbouring words together."""
    if not ctx.deferred:
        return
    entries, ctx.deferred = ctx.deferred, []
    by_mask: dict[str, list[list[Deferred]]] = {}
    for run in _runs(entries):
        by_mask.setdefault(run[0].mask, []).append(run)
        _count_run(ctx, run)
    for mask, runs in by_mask.items():
        _add_runs(ctx, _check_runs(ctx, mask, runs) if ctx.checks else mask, runs)


def ordered_starts(instructions: Sequence[Instruction], borders: Container[int]) -> set[int]:
    """Where a segment must start so that the order of atomics does not depend on how many lanes a chunk has.

    Adds that are put off run at the end of their segment, lane after lane: in one order for every chunk width, if a
    segment carries them out only once and under one mask. An atomic whose result is used stands alone.
    borders: instructions that start a segment anyway.
    """
    read = {reg for item in instructions for reg in item.reads()}
    starts: set[int] = set()
    pending: tuple[Reg | None, bool] | None = None
    after_used = False
    for index, item in enumerate(instructions):
        if index in borders:
            pending = None
        elif after_used:
            starts.add(index)
        after_used = False
        if item.root in ("atom", "red"):
            guard = (item.guard, item.negated)
            if "add" in item.modifiers and not any(dst in read for dst in item.dsts):
                if pending not in (None, guard):
                    starts.add(index)
                pending = guard
            else:
                starts.add(index)
                pending, after_used = None, True
        elif item.root in ("membar", "fence") or _sees_deferred(item):
            if pending is not None:
                starts.add(index)
            pending = None
        elif pending is not None and pending[0] is not None and pending[0] in item.writes():
            pending = (None, True)  # the guard's old value: equal to no other
    return starts


def joined_adds(instructions: Sequence[Instruction]) -> frozenset[int]:
    """Adds that may be put off until another one follows, by ``id``: all but the last of at most four in a row."""
    read = {reg for item in instructions for reg in item.reads()}
    joined: set[int] = set()
    last, length = None, 0
    for item in instructions:
        if item.root in ("atom", "red") and "add" in item.modifiers and not any(dst in read for dst in item.dsts):
            if last is not None and length < _JOINED:
                joined.add(id(last))
                length += 1
            else:
                length = 1
            last = item
        elif item.root in _BREAKS:
            last, length = None, 0
    return frozenset(joined)


_JOINED = 4
_BREAKS = frozenset(
    {"ld", "st", "atom", "red", "bra", "brx", "bar", "barrier", "membar", "fence", "ret", "exit", "trap", "shfl"}
)


def _sees_deferred(item: Instruction) -> bool:
    """Whether a load or store must find the adds that were put off carried out."""
    if item.root not in ("ld", "st") or {"param", "const"} & set(item.modifiers):
        return False
    return not (item.root == "ld" and {"nc", "local"} & set(item.modifiers))


def _count_run(ctx: SegmentBody, run: list[Deferred]) -> None:
    if not ctx.counts:
        return
    first = run[0]
    sites = [Site(entry.index, "atomic", entry.access.space, entry.access.width, entry.access.width) for entry in run]
    ctx.observe_run(sites, first.buffer, first.displacement, first.mask)


def _check_runs(ctx: SegmentBody, mask: str, runs: list[list[Deferred]]) -> str:
    """The lanes that may carry out these adds: those that pass the check of every run."""
    passed = mask
    for run in runs:
        first = run[0]
        sites = [
            Site(entry.index, "atomic", entry.access.space, entry.access.width, entry.access.width, entry.access.order)
            for entry in run
        ]
        sites[0] = replace(sites[0], run=len(run))
        allowed = ctx.ask(sites, first.buffer, first.displacement, first.base, mask)
        passed = ctx.w.value(f"and i32 {passed}, {allowed}")
    return passed


def _runs(entries: list[Deferred]) -> list[list[Deferred]]:
    """Split into runs of 4, 2 or 1 adds to consecutive words, in order of first appearance."""
    groups: dict[object, dict[int, list[Deferred]]] = {}
    for entry in entries:
        groups.setdefault(entry.key, {}).setdefault(entry.offset, []).append(entry)
    runs: list[list[Deferred]] = []
    for group in groups.values():
        size = next(iter(group.values()))[0].access.width
        while group:
            start = min(group)
            length = 1
            while length < 4 and start + length * size in group:
                length += 1
            length = 2 if length == 3 else length
            run = []
            for offset in range(start, start + length * size, size):
                run.append(group[offset].pop(0))
                if not group[offset]:
                    del group[offset]
            runs.append(run)
    return sorted(runs, key=lambda run: min(entry.index for entry in run))


def _add_runs(ctx: SegmentBody, mask: str, runs: list[list[Deferred]]) -> None:
    w, n = ctx.w, ctx.w.lanes
    products = _products(ctx, runs)
    staged = [(run, None if at in products else _stage(ctx, run)) for at, run in enumerate(runs)]

    def body(lane: str) -> None:
        # Element of the lane in transposed quads: row lane % 4, tile lane / 4.
        row = w.value(f"and i64 {lane}, 3")
        tile = w.value(f"lshr i64 {lane}, 2")
        row_at = w.value(f"mul i64 {row}, {n}")
        tile_at = w.value(f"shl i64 {tile}, 2")
        quad_at = w.value(f"add i64 {row_at}, {tile_at}")
        pair_at = w.value(f"shl i64 {lane}, 1")
        offsets: dict[str, str] = {}
        quads: dict[str, str] = {}
        for number, (run, values) in enumerate(staged):
            first = run[0]
            element = ELEMENT[first.access.kind]
            length = len(run)
            kind = element if length == 1 else f"<{length} x {element}>"
            if first.buffer not in offsets:
                at = w.value(f"getelementptr i64, ptr {ctx.chunk_of(first.buffer)}, i64 {lane}")
                offsets[first.buffer] = w.load("i64", at, 8)
            place = offsets[first.buffer]
            if first.displacement:
                place = w.value(f"add i64 {place}, {first.displacement}")
            if first.base == "null":
                pointer = w.value(f"inttoptr i64 {place} to ptr")
            else:
                pointer = w.value(f"getelementptr i8, ptr {first.base}, i64 {place}")
            size = ELEMENT_BYTES[element]
            if values is None:
                quad, factor = products[number]
                if quad not in quads:
                    quad_pointer = w.value(f"getelementptr {element}, ptr {quad}, i64 {quad_at}")
                    quads[quad] = w.load(kind, quad_pointer, size * length)
                value = _scaled(ctx, kind, element, quads[quad], factor, lane)
            else:
                at = {1: lane, 2: pair_at, 4: quad_at}[length]
                value = w.load(kind, w.value(f"getelementptr {element}, ptr {values}, i64 {at}"), size * length)
            old = w.load(kind, pointer, size)
            if is_float(first.access.kind):
                new = _float_sum(ctx, first.access, kind, length, old, value)
            else:
                new = w.value(f"add {kind} {old}, {value}")
            w.store(kind, new, pointer, size)

    _for_each_lane(ctx, mask, body)


def _products(ctx: SegmentBody, runs: list[list[Deferred]]) -> dict[int, tuple[str, str]]:
    """Runs of four whose values are one quad times a factor of their own: run -> (staged quad, staged factor).

    A transfer adds w (vx, vy, vz, 1) to many nodes, with another w for each: it is cheaper to put the quad into memory
    once and to multiply lane by lane, which rounds alike, than to transpose four products for every node.
    """
    w = ctx.w
    groups: dict[tuple[str, tuple[str | None, ...]], list[tuple[int, str]]] = {}
    for at, run in enumerate(runs):
        if len(run) == 4 and is_float(run[0].access.kind):
            values = [entry.value for entry in run]
            for factor in _common_factors(ctx, values):
                quad = tuple(_cofactor(ctx, value, factor) for value in values)
                groups.setdefault((run[0].access.kind, quad), []).append((at, factor))
    found: dict[int, tuple[str, str]] = {}
    for (kind, quad), members in groups.items():
        fresh = [(at, factor) for at, factor in members if at not in found]
        if len(fresh) < _SHARED_QUADS:
            continue
        element = ELEMENT[kind]
        one = w.splat_bits(element, 0x3F800000 if element == "float" else 0x3FF0000000000000)
        staged = _stage_values(ctx, element, [one if part is None else part for part in quad])
        for at, factor in fresh:
            found[at] = staged, _stage_values(ctx, element, [factor])
    return found


def _common_factors(ctx: SegmentBody, values: Sequence[str]) -> list[str]:
    """What divides all values: each is it, or a product with it."""
    parts = [dict.fromkeys((value, *ctx.w.factors.get(value, ()))) for value in values]
    return [part for part in parts[0] if all(part in others for others in parts[1:])]


def _cofactor(ctx: SegmentBody, value: str, factor: str) -> str | None:
    """The other factor, or None for one."""
    if value == factor:
        return None
    left, right = ctx.w.factors[value]
    return right if left == factor else left


def _scaled(ctx: SegmentBody, kind: str, element: str, quad: str, factor: str, lane: str) -> str:
    """A lane's quad times its factor."""
    w = ctx.w
    scalar = w.load(element, w.value(f"getelementptr {element}, ptr {factor}, i64 {lane}"), ELEMENT_BYTES[element])
    first = w.value(f"insertelement {kind} poison, {element} {scalar}, i32 0")
    splat = w.value(f"shufflevector {kind} {first}, {kind} poison, <4 x i32> zeroinitializer")
    return w.value(f"fmul {kind} {quad}, {splat}")


def _stage(ctx: SegmentBody, run: list[Deferred]) -> str:
    """Put the values of a run into memory so that those of one lane stand together."""
    return _stage_values(ctx, ELEMENT[run[0].access.kind], [entry.value for entry in run])


def _stage_values(ctx: SegmentBody, element: str, values: Sequence[str]) -> str:
    w, n = ctx.w, ctx.w.lanes
    size = ELEMENT_BYTES[element]
    buffer = w.buffer(n * size * len(values))
    align = min(64, n * size)
    if len(values) == 4:
        for row, column in enumerate(w.transpose4(element, values)):
            w.store(w.vector(element), column, w.at(buffer, row * n * size), align)
    elif len(values) == 2:
        for half in range(2):
            lanes = range(half * n // 2, (half + 1) * n // 2)
            pairs = w.shuffle(element, values[0], values[1], [i for lane in lanes for i in (lane, lane + n)])
            w.store(w.vector(element), pairs, w.at(buffer, half * n * size), align)
    else:
        w.store(w.vector(element), values[0], buffer, align)
    return buffer
