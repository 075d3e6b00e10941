"""Profile mode: compiled code keeps each warp's clock and writes down its memory requests for ``memory_system``.

The clock counts the cycles that a warp's own instructions take, as ``timing`` works them out for each segment; what it
waits for memory is added by whoever replays the requests. A record is 36 words of 64 bits: number of the first memory
site with the active lanes above it, the clock when the segment began, what to add to the addresses, how many sites
of neighbouring words the request stands for, and the 32 lanes' addresses.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from mpmbench.simt import scheduler
from mpmbench.simt.codegen_ir import WARP

if TYPE_CHECKING:
    from mpmbench.simt.codegen import _Generator
    from mpmbench.simt.codegen_memory import Site
    from mpmbench.simt.flow import Block

RECORD_SITE, RECORD_CLOCK, RECORD_DISPLACEMENT, RECORD_RUN = range(4)
RECORD_LANES = 4  # first of the addresses
RECORD_WORDS = RECORD_LANES + WARP

# Passes through the shared-memory pipe of one round of a float atomic: a load, and a swap that takes two.
CAS_PASSES = 3


def advance_clock(g: _Generator, number: int) -> None:
    """The warp runs a segment; ``%clock.N`` is when it began."""
    w = g.w
    at = w.at("%context", scheduler.CONTEXT_CLOCK)
    w.emit(f"%clock.{number} = load i64, ptr {at}, align 8")
    table = g.job_field("segments", pointer=True)
    cycles = w.load("i64", w.at(table, 16 * number), 8)
    w.store("i64", w.value(f"add i64 %clock.{number}, {cycles}"), at, 8)
    _add(g, scheduler.CONTEXT_ISSUE, w.load("i64", w.at(table, 16 * number + 8), 8))


def take_shared(g: _Generator, sites: Sequence[Site], taken: str) -> None:
    """A request of shared memory takes its pipe and keeps the warp longer than one without conflicts.

    taken: i64 as ``count_sites`` gives it; 0 if no lane takes part. Float atomics are compare-and-swap loops: a round
    loads, adds and swaps, which takes the pipe three times.
    """
    w, first = g.w, sites[0]
    item = g.kernel.instructions[first.index]
    is_loop = first.kind == "atomic" and item.modifiers[-1] in ("f32", "f64")
    passes = CAS_PASSES if is_loop else 1
    rounds = waves = taken
    if first.kind == "atomic":
        rounds, waves = w.value(f"and i64 {taken}, {0xFFFFFFFF}"), w.value(f"lshr i64 {taken}, 32")
    _add(g, scheduler.CONTEXT_SHARED, w.value(f"mul i64 {waves}, {passes * len(sites)}"))
    w.declare("declare i64 @llvm.usub.sat.i64(i64, i64)")
    if is_loop:
        slots = w.value(f"mul i64 {g.job_field('cas_issue')}, {len(sites)}")
        _add(g, scheduler.CONTEXT_ISSUE, w.value(f"mul i64 {rounds}, {slots}"))
        more = w.value(f"call i64 @llvm.usub.sat.i64(i64 {rounds}, i64 1)")
        conflicts = w.value(f"mul i64 {w.value(f'sub i64 {waves}, {rounds}')}, {passes}")
        trips = w.value(f"mul i64 {more}, {g.job_field('cas_trip')}")
        cycles = w.value(f"add i64 {trips}, {conflicts}")
    else:
        cycles = w.value(f"call i64 @llvm.usub.sat.i64(i64 {waves}, i64 1)")
    _add(g, scheduler.CONTEXT_CLOCK, w.value(f"mul i64 {cycles}, {len(sites)}"))


def _add(g: _Generator, field: int, amount: str) -> None:
    w = g.w
    at = w.at("%context", field)
    w.store("i64", w.value(f"add i64 {w.load('i64', at, 8)}, {amount}"), at, 8)


def record_request(g: _Generator, number: int, site: int, run: int, buffer: str, displacement: int, mask: str) -> None:
    """Write down a request of segment ``number``. buffer: addresses of 32 lanes. mask: i32, lanes that take part.

    No branch for a request without lanes: its record is overwritten by the next one.
    """
    w = g.w
    at = w.at("%context", scheduler.CONTEXT_TRACE)
    address = w.load("i64", at, 8)
    record = w.value(f"inttoptr i64 {address} to ptr")
    lanes = w.value(f"shl i64 {w.value(f'zext i32 {mask} to i64')}, 32")
    w.store("i64", w.value(f"or i64 {lanes}, {site}"), w.at(record, 8 * RECORD_SITE), 8)
    w.store("i64", f"%clock.{number}", w.at(record, 8 * RECORD_CLOCK), 8)
    w.store("i64", str(displacement), w.at(record, 8 * RECORD_DISPLACEMENT), 8)
    w.store("i64", str(run), w.at(record, 8 * RECORD_RUN), 8)
    w.store("<32 x i64>", w.load("<32 x i64>", buffer, 64), w.at(record, 8 * RECORD_LANES), 8)
    some = w.value(f"icmp ne i32 {mask}, 0")
    step = w.value(f"select i1 {some}, i64 {8 * RECORD_WORDS}, i64 0")
    w.store("i64", w.value(f"add i64 {address}, {step}"), at, 8)


def yield_if_full(g: _Generator, target: int) -> None:
    """At a branch backward to ``target``, whose lanes are pending: stop there if many requests are written down."""
    w = g.w
    at = w.load("i64", w.at("%context", scheduler.CONTEXT_TRACE), 8)
    limit = w.load("i64", w.at("%context", scheduler.CONTEXT_TRACE_LIMIT), 8)
    label = g.label()
    w.emit(f"br i1 {w.value(f'icmp uge i64 {at}, {limit}')}, label %full{label}, label %room{label}")
    w.label(f"full{label}")
    w.store("i32", str(target), "%context", 4)
    w.emit(f"ret i32 {scheduler.STATUS_YIELD}")
    w.label(f"room{label}")


def loop_heads(segments: Sequence[Block], known: Sequence[tuple[int, str]]) -> list[tuple[int, str]]:
    """Where a warp goes on that stopped at a branch backward, save for the places already known."""
    heads = {target for n, segment in enumerate(segments) for target in segment.successors if target <= n}
    return [(head, f"run{head}") for head in sorted(heads - {number for number, _ in known})]
