"""Counting: what compiled code adds up, and the functions that look at the 32 addresses of a request.

Counters are 64-bit words: three per segment (executions by a warp, lanes, divergent branches), then four per memory
site (requests, lanes, amount, passes). What ``amount`` and ``passes`` mean depends on the site; see ``tally``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from mpmbench.simt.codegen_ir import WARP, Writer

if TYPE_CHECKING:
    from mpmbench.simt.codegen import _Generator
    from mpmbench.simt.codegen_memory import Site

SEGMENT_WORDS = 3
SITE_WORDS = 12  # of the global, the shared and the local part of a site's requests, four each
PART_WORDS = 4
PARTS = ("global", "shared", "local")


SUPPORT_FUNCTIONS = (
    "count_global",
    "count_atomics",
    "count_shared_atomics_4",
    "count_shared_atomics_8",
    "count_shared_4",
    "count_shared_8",
    "count_shared_16",
    "count_local",
)


def counter_words(segments: int, sites: int) -> int:
    return SEGMENT_WORDS * segments + SITE_WORDS * sites


def _counters(g: _Generator) -> str:
    return g.job_field("counters", pointer=True)


def _add(g: _Generator, word: int, amount: str) -> None:
    w = g.w
    address = w.at(_counters(g), 8 * word)
    old = w.load("i64", address, 8)
    w.store("i64", w.value(f"add i64 {old}, {amount}"), address, 8)


def count_segment(g: _Generator, number: int, mask: str) -> None:
    """A warp runs the segment with these lanes."""
    w = g.w
    w.declare("declare i32 @llvm.ctpop.i32(i32)")
    lanes = w.value(f"call i32 @llvm.ctpop.i32(i32 {mask})")
    _add(g, SEGMENT_WORDS * number, "1")
    _add(g, SEGMENT_WORDS * number + 1, w.value(f"zext i32 {lanes} to i64"))


def count_branch(g: _Generator, number: int, taken: str, stay: str) -> None:
    """The segment's conditional branch had these outcomes."""
    w = g.w
    both = w.value(f"and i1 {w.value(f'icmp ne i32 {taken}, 0')}, {w.value(f'icmp ne i32 {stay}, 0')}")
    _add(g, SEGMENT_WORDS * number + 2, w.value(f"zext i1 {both} to i64"))


def count_table_branch(g: _Generator, number: int, ways: Sequence[str], mask: str) -> None:
    """The segment's branch by table sent these lanes to different places; divergent unless one got all of them."""
    w = g.w
    together = "false"
    for lanes in ways:
        together = w.value(f"or i1 {together}, {w.value(f'icmp eq i32 {lanes}, {mask}')}")
    _add(g, SEGMENT_WORDS * number + 2, w.value(f"zext i1 {w.value(f'xor i1 {together}, true')} to i64"))


def count_sites(g: _Generator, sites: Sequence[Site], first: int, buffer: str, displacement: int, mask: str) -> str:
    """One request of each of ``sites``, which access consecutive words; first: number of the first of them.

    buffer: addresses of the 32 lanes; in shared memory they may count from its start, which is aligned.
    -> what one site's request takes of shared memory, as an i64: wavefronts; of an atomic its rounds, and from bit 32
    on their wavefronts.
    """
    w, site = g.w, sites[0]
    counters = w.at(_counters(g), 8 * (SEGMENT_WORDS * len(g.segments) + SITE_WORDS * first))
    if site.space == "generic":
        return _count_generic(g, sites, counters, buffer, displacement, mask)
    return _count_part(w, sites, site.space, counters, buffer, displacement, mask)


def _count_part(
    w: Writer, sites: Sequence[Site], space: str, counters: str, buffer: str, displacement: int, mask: str
) -> str:
    """Call the function that counts a request in one space, and give back its result."""
    site = sites[0]
    if space == "local":
        function = "count_local"
    elif space == "shared":
        function = f"count_shared_{'atomics_' if site.kind == 'atomic' else ''}{_group(site.width)}"
    else:
        function = "count_atomics" if site.kind == "atomic" else "count_global"
    part = w.at(counters, 8 * PART_WORDS * PARTS.index(space))
    w.declare(f"declare i64 @{function}(ptr, i64, i32, ptr, i64, i64)")
    return w.value(
        f"call i64 @{function}(ptr {buffer}, i64 {displacement}, i32 {mask}, ptr {part}, i64 {len(sites)}, "
        f"i64 {site.element})"
    )


def _group(width: int) -> int:
    return 16 if width > 8 else 8 if width > 4 else 4


def _count_generic(
    g: _Generator, sites: Sequence[Site], counters: str, buffer: str, displacement: int, mask: str
) -> str:
    """Sort the lanes by the window their addresses fall into; each part is a request of its own."""
    w = g.w
    lanes, w.lanes = w.lanes, WARP
    addresses = w.load("<32 x i64>", buffer, 64)
    if displacement:
        addresses = w.binary("add", "i64", addresses, w.splat_int("i64", displacement))
    shared, local = g.job_field("shared"), g.job_field("local")
    sizes = g.job_field("shared_bytes"), w.value(f"sub i64 {g.job_field('local_end')}, {local}")
    rest, in_shared = mask, "0"
    for space, first, size in (("shared", shared, sizes[0]), ("local", local, sizes[1])):
        distance = w.binary("sub", "i64", addresses, w.splat("i64", first))
        inside = w.compare("icmp ult", "i64", distance, w.splat("i64", size))
        bits = w.value(f"and i32 {w.value(f'bitcast <32 x i1> {inside} to i32')}, {mask}")
        taken = _count_part(w, sites, space, counters, buffer, displacement, bits)
        in_shared = taken if space == "shared" else in_shared
        rest = w.value(f"and i32 {rest}, {w.value(f'xor i32 {bits}, -1')}")
    _count_part(w, sites, "global", counters, buffer, displacement, rest)
    w.lanes = lanes
    return in_shared


# --- the functions, a module of their own -------------------------------------------------------------------------


def support_text() -> str:
    """LLVM text of the counting functions: ``(addresses, displacement, mask, counters, sites, element bytes)``.

    They return what a site's request takes of shared memory, as ``count_sites`` says; 0 elsewhere.
    """
    functions: list[_Function] = [
        _global_function("count_global", atomic=False),
        _global_function("count_atomics", atomic=True),
        *(_shared_atomics_function(width) for width in (4, 8)),
        *(_shared_function(width) for width in (4, 8, 16)),
        _local_function(),
    ]
    declarations = {name: text for function in functions for name, text in function.w.declarations.items()}
    return "\n".join([*declarations.values(), *(function.text() for function in functions)])


class _Function:
    """Writes one counting function. An empty mask returns at once; else addresses come as a 32-lane vector."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.result = "0"
        self.w = Writer(WARP)
        w = self.w
        w.declare("declare i32 @llvm.ctpop.i32(i32)")
        empty = w.value("icmp eq i32 %mask, 0")
        w.emit(f"br i1 {empty}, label %out, label %some")
        w.label("some")

    def addresses(self) -> str:
        w = self.w
        return w.binary("add", "i64", w.load("<32 x i64>", "%addresses", 64), w.splat("i64", "%at"))

    def lanes(self) -> str:
        return self.w.value("bitcast i32 %mask to <32 x i1>")

    def add(self, word: int, amount: str, site: str = "0") -> None:
        w = self.w
        index = w.value(f"mul i64 {site}, {SITE_WORDS}") if site != "0" else "0"
        address = w.value(f"getelementptr i64, ptr %counters, i64 {index}")
        address = w.at(address, 8 * word)
        w.store("i64", w.value(f"add i64 {w.load('i64', address, 8)}, {amount}"), address, 8)

    def count_bits(self, bits: str) -> str:
        count = self.w.value(f"call i32 @llvm.ctpop.i32(i32 {bits})")
        return self.w.value(f"zext i32 {count} to i64")

    def rotated(self, element: str, value: str, by: int, group: int = WARP) -> str:
        """Lane l gets the value of lane l - by, round and round inside groups of lanes."""
        source = [(lane // group) * group + (lane - by) % group for lane in range(WARP)]
        return self.w.shuffle(element, value, value, source)

    def earlier(self, by: int, group: int = WARP) -> str:
        """Lanes for which lane l - by lies in the same group."""
        return "<" + ", ".join(f"i1 {'true' if lane % group >= by else 'false'}" for lane in range(WARP)) + ">"

    def text(self) -> str:
        w = self.w
        last = _last_label_of(w)
        w.emit("br label %out")
        w.label("out")
        w.emit(f"%result = phi i64 [ 0, %entry ], [ {self.result}, %{last} ]")
        w.emit("ret i64 %result")
        parameters = "ptr %addresses, i64 %at, i32 %mask, ptr %counters, i64 %sites, i64 %element"
        head = f'define i64 @{self.name}({parameters}) "prefer-vector-width"="512" "min-legal-vector-width"="512" {{'
        return "\n".join([head, "entry:", *w.allocas, *w.lines, "}"])


def _narrow(f: _Function, values: str) -> str:
    """64-bit keys -> 32-bit keys, equal exactly where those of active lanes are. Dead lanes get keys of their own.

    Keys of one request almost always agree in their upper half, and then the lower half decides. Where they do not,
    a lane's key is the number of the first active lane with the same 64 bits.
    """
    w = f.w
    lanes = f.lanes()
    result = w.buffer(4 * WARP)
    own = "<" + ", ".join(f"i32 {-1 - lane}" for lane in range(WARP)) + ">"
    low = w.cast("trunc", values, "i64", "i32")
    high = w.cast("trunc", w.binary("lshr", "i64", values, w.splat_int("i64", 31)), "i64", "i32")
    w.declare("declare i32 @llvm.cttz.i32(i32, i1)")
    first = w.value("call i32 @llvm.cttz.i32(i32 %mask, i1 false)")
    first_high = w.splat("i32", w.value(f"extractelement <32 x i32> {high}, i32 {first}"))
    differs = w.binary("and", "i1", w.compare("icmp ne", "i32", high, first_high), lanes)
    any_differs = w.value(f"icmp ne i32 {w.value(f'bitcast <32 x i1> {differs} to i32')}, 0")
    positive = w.binary("and", "i32", low, w.splat_int("i32", 0x7FFFFFFF))
    w.store("<32 x i32>", w.select("i32", lanes, positive, own), result, 64)
    number = len(w.allocas)
    w.emit(f"br i1 {any_differs}, label %far{number}, label %near{number}")
    w.label(f"far{number}")
    memory = w.buffer(8 * WARP)
    w.store("<32 x i64>", values, memory, 64)
    for lane in range(WARP):
        key = w.load("i64", w.at(memory, 8 * lane), 8)
        same = w.compare("icmp eq", "i64", values, w.splat("i64", key))
        bits = w.value(f"and i32 {w.value(f'bitcast <32 x i1> {same} to i32')}, %mask")
        leader = w.value(f"call i32 @llvm.cttz.i32(i32 {bits}, i1 false)")
        active = w.value(f"icmp ne i32 {w.value(f'and i32 %mask, {1 << lane if lane < 31 else -(1 << 31)}')}, 0")
        w.store("i32", w.value(f"select i1 {active}, i32 {leader}, i32 {-1 - lane}"), w.at(result, 4 * lane), 4)
    w.emit(f"br label %near{number}")
    w.label(f"near{number}")
    return w.load("<32 x i32>", result, 64)


def _firsts(f: _Function, keys: str, group: int = WARP) -> str:
    """Predicate: no earlier lane of the group has the same key."""
    w = f.w
    seen = None
    for by in range(1, group):
        same = w.compare("icmp eq", "i32", keys, f.rotated("i32", keys, by, group))
        same = w.binary("and", "i1", same, f.earlier(by, group))
        seen = same if seen is None else w.binary("or", "i1", seen, same)
    assert seen is not None
    return w.invert(seen)


def _multiplicity(f: _Function, keys: str) -> str:
    """How many lanes have this lane's key."""
    w = f.w
    count = w.splat_int("i32", 1)
    for by in range(1, WARP):
        same = w.compare("icmp eq", "i32", keys, f.rotated("i32", keys, by))
        count = w.binary("sub", "i32", count, w.cast("sext", same, "i1", "i32"))
    return count


def _turns(f: _Function, keys: str) -> str:
    """How many earlier lanes have this lane's key."""
    w = f.w
    count = w.splat_int("i32", 0)
    for by in range(1, WARP):
        same = w.binary("and", "i1", w.compare("icmp eq", "i32", keys, f.rotated("i32", keys, by)), f.earlier(by))
        count = w.binary("sub", "i32", count, w.cast("sext", same, "i1", "i32"))
    return count


def _active_bits(f: _Function, predicate: str) -> str:
    w = f.w
    return w.value(f"and i32 {w.value(f'bitcast <32 x i1> {predicate} to i32')}, %mask")


def _global_function(name: str, atomic: bool) -> _Function:
    """Requests, lanes, sectors; for atomics also passes: per sector the largest number of lanes on one word, summed.

    Sites of a run access consecutive words. Where all their addresses are multiples of the run's size, the run lies in
    one sector, and what holds for its first word holds for all.
    """
    f = _Function(name)
    w = f.w
    addresses = f.addresses()
    span = w.value("mul i64 %element, %sites")
    below = w.value(f"sub i64 {span}, 1")
    odd = w.compare("icmp ne", "i64", w.binary("and", "i64", addresses, w.splat("i64", below)), w.splat_int("i64", 0))
    is_odd = w.value(f"icmp ne i32 {_active_bits(f, odd)}, 0")
    several = w.value("icmp ugt i64 %sites, 1")
    apart = w.value(f"and i1 {several}, {is_odd}")
    rounds = w.value(f"select i1 {apart}, i64 %sites, i64 1")
    copies = w.value(f"select i1 {apart}, i64 1, i64 %sites")
    w.emit("br label %round")
    w.label("round")
    w.emit("%site = phi i64 [ 0, %some ], [ %site.next, %round.end ]")
    shift = w.value("mul i64 %site, %element")
    here = w.binary("add", "i64", addresses, w.splat("i64", shift))
    sectors = _narrow(f, w.binary("lshr", "i64", here, w.splat_int("i64", 5)))
    first_bits = _active_bits(f, _firsts(f, sectors))
    lanes = f.count_bits("%mask")
    count = f.count_bits(first_bits)
    passes = "0"
    if atomic:
        words = _narrow(f, here)
        largest = shared = _multiplicity(f, words)
        for by in range(1, WARP):
            same = w.compare("icmp eq", "i32", sectors, f.rotated("i32", sectors, by))
            other = w.select("i32", same, f.rotated("i32", shared, by), w.splat_int("i32", 0))
            largest = w.intrinsic("llvm.umax", "i32", largest, other)
        firsts = w.value(f"bitcast i32 {first_bits} to <32 x i1>")
        kept = w.select("i32", firsts, largest, w.splat_int("i32", 0))
        w.declare("declare i32 @llvm.vector.reduce.add.v32i32(<32 x i32>)")
        total = w.value(f"call i32 @llvm.vector.reduce.add.v32i32(<32 x i32> {kept})")
        passes = w.value(f"zext i32 {total} to i64")
    w.emit("br label %copy")
    w.label("copy")
    w.emit("%extra = phi i64 [ 0, %" + _last_label(w, "copy") + " ], [ %extra.next, %copy ]")
    target = w.value("add i64 %site, %extra")
    for word, amount in enumerate(("1", lanes, count, passes)):
        f.add(word, amount, target)
    w.emit("%extra.next = add i64 %extra, 1")
    more = w.value(f"icmp ult i64 %extra.next, {copies}")
    w.emit(f"br i1 {more}, label %copy, label %round.end")
    w.label("round.end")
    w.emit("%site.next = add i64 %site, 1")
    again = w.value(f"icmp ult i64 %site.next, {rounds}")
    w.emit(f"br i1 {again}, label %round, label %all")
    w.label("all")
    return f


def _last_label(w: Writer, before: str) -> str:
    """The label of the block that is being written when ``before`` begins."""
    labels = [line[:-1] for line in w.lines if line.endswith(":") and " " not in line]
    return labels[labels.index(before) - 1]


def _shared_atomics_function(width: int) -> _Function:
    """Requests, lanes, rounds (one lane per word in each: the largest number of lanes on one), and the
    wavefronts of those rounds, in each of the lanes that are not served yet.

    -> rounds, and from bit 32 on wavefronts.
    """
    f = _Function(f"count_shared_atomics_{width}")
    w = f.w
    group = WARP * 4 // width
    units = 32 * 4 // width
    unit = w.binary("lshr", "i64", f.addresses(), w.splat_int("i64", width.bit_length() - 1))
    keys = _narrow(f, unit)
    turns = w.select("i32", f.lanes(), _turns(f, keys), w.splat_int("i32", 0))
    w.declare("declare i32 @llvm.vector.reduce.umax.v32i32(<32 x i32>)")
    last = w.value(f"call i32 @llvm.vector.reduce.umax.v32i32(<32 x i32> {turns})")
    largest = w.value(f"add i32 {last}, 1")
    banks = w.binary("and", "i32", w.cast("trunc", unit, "i64", "i32"), w.splat_int("i32", units - 1))
    firsts = _firsts(f, keys, group)
    before = _last_label_of(w)
    w.emit("br label %round")
    w.label("round")
    w.emit(f"%served = phi i32 [ 0, %{before} ], [ %served.next, %round ]")
    w.emit(f"%waves = phi i32 [ 0, %{before} ], [ %waves.next, %round ]")
    # Of the lanes of a group that still want a word, the first one: it is served now, or an earlier group's lane is.
    now = w.compare("icmp eq", "i32", turns, w.splat("i32", "%served"))
    later = w.binary("and", "i1", firsts, w.compare("icmp ugt", "i32", turns, w.splat("i32", "%served")))
    leaders = w.binary("and", "i1", w.binary("or", "i1", now, later), f.lanes())
    w.emit(f"%waves.next = add i32 %waves, {_bank_passes(f, leaders, banks, group)}")
    w.emit("%served.next = add i32 %served, 1")
    again = w.value(f"icmp ult i32 %served.next, {largest}")
    w.emit(f"br i1 {again}, label %round, label %counted")
    w.label("counted")
    rounds, wide = (w.value(f"zext i32 {each} to i64") for each in (largest, "%waves.next"))
    f.result = w.value(f"or i64 {rounds}, {w.value(f'shl i64 {wide}, 32')}")
    lanes = f.count_bits("%mask")
    w.emit("br label %copy")
    w.label("copy")
    w.emit("%site = phi i64 [ 0, %counted ], [ %site.next, %copy ]")
    for word, amount in enumerate(("1", lanes, rounds, wide)):
        f.add(word, amount, "%site")
    w.emit("%site.next = add i64 %site, 1")
    more = w.value("icmp ult i64 %site.next, %sites")
    w.emit(f"br i1 {more}, label %copy, label %all")
    w.label("all")
    return f


def _bank_passes(f: _Function, leaders: str, banks: str, group: int) -> str:
    """i32: per group of lanes the largest number of leaders, one a word, in one bank, summed."""
    w = f.w
    one = w.cast("zext", leaders, "i1", "i32")
    words = one
    for by in range(1, group):
        same = w.compare("icmp eq", "i32", banks, f.rotated("i32", banks, by, group))
        words = w.binary(
            "add",
            "i32",
            words,
            w.select("i32", same, f.rotated("i32", one, by, group), w.splat_int("i32", 0)),
        )
    words = w.select("i32", leaders, words, w.splat_int("i32", 0))
    by = group // 2
    while by:
        words = w.intrinsic("llvm.umax", "i32", words, f.rotated("i32", words, by, group))
        by //= 2
    heads = "<" + ", ".join(f"i1 {'true' if lane % group == 0 else 'false'}" for lane in range(WARP)) + ">"
    kept = w.select("i32", heads, words, w.splat_int("i32", 0))
    w.declare("declare i32 @llvm.vector.reduce.add.v32i32(<32 x i32>)")
    return w.value(f"call i32 @llvm.vector.reduce.add.v32i32(<32 x i32> {kept})")


def _last_label_of(w: Writer) -> str:
    return next(line[:-1] for line in reversed(w.lines) if line.endswith(":") and " " not in line)


def _shared_function(width: int) -> _Function:
    """Requests, lanes, wavefronts: groups of 32, 16 or 8 lanes for 4, 8 or 16 bytes; per group the largest number of
    distinct words in one of the 32 banks.

    An aligned access of ``width`` bytes covers width/4 neighbouring banks: units of that size are enough to look at.
    """
    f = _Function(f"count_shared_{width}")
    w = f.w
    group = WARP * 4 // width
    units = 32 * 4 // width
    unit = w.binary("lshr", "i64", f.addresses(), w.splat_int("i64", width.bit_length() - 1))
    keys = _narrow(f, unit)
    banks = w.binary("and", "i32", w.cast("trunc", unit, "i64", "i32"), w.splat_int("i32", units - 1))
    leaders = w.binary("and", "i1", _firsts(f, keys, group), f.lanes())
    total = _bank_passes(f, leaders, banks, group)
    f.add(0, "1")
    f.add(1, f.count_bits("%mask"))
    f.result = w.value(f"zext i32 {total} to i64")
    f.add(2, f.result)
    return f


def _local_function() -> _Function:
    f = _Function("count_local")
    f.add(0, "1")
    f.add(1, f.count_bits("%mask"))
    return f
