"""Profile mode: every thread block that the GPU holds at a time, interleaved, with L1, L2 and DRAM behind them.

Compiled code runs a warp to its next barrier and writes down its requests (``codegen_trace``). Here the requests of all
resident warps are replayed in the order of the warps' clocks, earliest first, against the caches (``caches``); what a
request costs moves its warp's clock. Running ahead of the clock changes no result of a program without races between
warps. L1 takes loads only; L2 is written back; a store that does not fill its sector fetches nothing, an atomic fetches
its sector.

Every warp has two clocks. One knows latencies and barriers only: it gives the latency term. The other, which orders the
requests, knows as well that an SM exchanges one sector per cycle with L2, so that requests queue and warps take turns.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from mpmbench.simt import scheduler
from mpmbench.simt.caches import (
    ADD,
    FETCH,
    FILL,
    IN_ORDER,
    LINE_BYTES,
    PART,
    TALLY,
    WAYS,
    l1_access,
    l2_access,
    write_back,
)
from mpmbench.simt.codegen_trace import (
    RECORD_CLOCK,
    RECORD_DISPLACEMENT,
    RECORD_LANES,
    RECORD_RUN,
    RECORD_SITE,
    RECORD_WORDS,
)
from mpmbench.simt.compiled import compiled, inlined
from mpmbench.simt.counters import SourceLine
from mpmbench.simt.machine import Machine, MemoryCounters, MemoryTally
from mpmbench.simt.scheduler import ISSUE_UNITS, JOB_BYTES
from mpmbench.simt.timing import NEVER, TimingTables

if TYPE_CHECKING:
    from mpmbench.simt.engine import _Description, _Job

# Requests after which a warp stops at its next branch backward: few, so that spinning warps see others move on.
TRACE_LIMIT = 8

ALLOCATION_ALIGNMENT = 512  # bytes, of arrays in the modelled address space, which does not depend on the host's
_PENDING = 64  # loads that a warp may wait for at a time

_L1_HIT, _L1_MISS, _REQUEST_BYTES, _ATOMIC_LANES, _ATOMIC_SECTORS = (
    TALLY.index(name) for name in ("l1_hit", "l1_miss", "l1_request_bytes", "atomic_lanes", "atomic_sectors")
)

# Words of the machine's parameters.
(
    _SMS, _L1_PER_SM, _L1_SETS, _L2_SETS, _CHANNELS, _BANKS, _ROW_PIECES, _L1_LATENCY, _L2_LATENCY, _DRAM_LATENCY,
    _BLOCK_START,
) = range(11)  # fmt: skip

# Words of a site's facts.
_KIND, _WIDTH, _IN_L1 = range(3)
_LOAD, _STORE, _ATOMIC = range(3)
_KINDS = ("load", "store", "atomic")

# States of a warp.
_READY, _REPLAYING, _WAITING, _ENDED = range(4)

# Words of a launch's facts.
(
    _CODE, _CONTEXTS, _CONTEXT_BYTES, _WARPS, _THREADS, _BLOCKS, _GRID_X, _GRID_Y, _SLOTS, _TRACE, _CAPACITY,
) = range(11)  # fmt: skip

# Columns of a resident warp's row: its state and what the code returned when it stopped; what memory and barriers
# added to its clock, and what queues added to that; when it arrived where it waits; the request to replay next, how
# many are written down, and which of the words of a run; loads that it waits for, and the segment that they belong to;
# sectors and lanes of the request; what it has taken of the issue slots and of the shared-memory pipe.
(
    _STATE, _STATUS_OF, _OFFSET, _QUEUED, _ARRIVAL, _NEXT, _RECORDED, _WORD, _PENDING_COUNT, _PENDING_CLOCK, _SECTORS,
    _LANES, _ISSUED, _SHARED_TAKEN,
) = range(14)  # fmt: skip

# Columns of a slot's row: warps that run, warps that wait at a barrier; when the thread block started, and when its
# last barrier opened; whether it stands in the heap.
_RUNNING, _AT_BARRIER, _STARTED, _OPENED, _QUEUED_SLOT = range(5)

# Outcomes of a replay; the last one is followed by waits for L1, L2 and DRAM.
_FAULT, _STOP_SLOT, _STOP_WARP, _LATENCY_CYCLES, _WARP_CYCLES, _BARRIER_WAIT, _PEAK_WARPS, _WAITS = range(8)

_JOB_WORDS = JOB_BYTES // 8
_JOB_SHARED, _JOB_LOCAL, _JOB_LOCAL_END = (scheduler.JOB[name] // 8 for name in ("shared", "local", "local_end"))
_JOB_BLOCK, _JOB_CONTEXTS = scheduler.JOB["block"] // 8, scheduler.JOB["contexts"] // 8
_JOB_VOTES, _JOB_ARRIVED = scheduler.JOB["votes_0"] // 8, scheduler.JOB["arrived_0"] // 8
_CLOCK, _TRACE_AT, _TRACE_END, _ISSUE, _SHARED_PIPE = (
    offset // 8
    for offset in (
        scheduler.CONTEXT_CLOCK,
        scheduler.CONTEXT_TRACE,
        scheduler.CONTEXT_TRACE_LIMIT,
        scheduler.CONTEXT_ISSUE,
        scheduler.CONTEXT_SHARED,
    )
)
_REDUCTIONS = scheduler.CONTEXT_REDUCTIONS // 8
_LIVE, _CTAID, _WAITED = (
    offset // 4 for offset in (scheduler.CONTEXT_LIVE, scheduler.CONTEXT_CTAID, scheduler.CONTEXT_WAITED)
)
_STATUS_BARRIER, _STATUS_YIELD = scheduler.STATUS_BARRIER, scheduler.STATUS_YIELD
_ALL_USES = np.int64(1) << 40  # later than any use of a value
_FIRST_FAULT = scheduler.FIRST_FAULT

_U32 = np.uint64(32)


@intrinsic
def _run_code(typing_context, code, context, job):
    """Call machine code at an address: i32 (i64 context, i64 job)."""

    def generate(target_context, builder, signature, arguments):
        kind = ir.FunctionType(ir.IntType(32), [ir.IntType(64), ir.IntType(64)])
        return builder.call(builder.inttoptr(arguments[0], kind.as_pointer()), [arguments[1], arguments[2]])

    return types.int32(types.int64, types.int64, types.int64), generate


# --- requests -------------------------------------------------------------------------------------------------------


@inlined
def _place(ranges, last, address):
    """Host address -> address in the modelled GPU's memory, or -1: shared and local memory are not in it."""
    at = last[0]
    if ranges[at, 0] <= address < ranges[at, 1]:
        return address - ranges[at, 0] + ranges[at, 2]
    place = np.int64(-1)
    for at in range(ranges.shape[0]):
        if ranges[at, 0] <= address < ranges[at, 1]:
            last[0] = at
            place = address - ranges[at, 0] + ranges[at, 2]
    return place


@compiled
def _gather_sectors(record, first, span, ranges, last, sectors, covered, table, hot, counts_hot):
    """Distinct sectors of a request in the order of its lanes: -> (how many, lanes, whether a lane's part has two).

    first, span: bytes of each lane's part, from its address on. covered: bits of the bytes that the lanes touch in each
    sector. table: scratch, 128 entries; a lane's at most 32 bytes lie in two sectors.
    """
    mask = np.uint64(record[RECORD_SITE]) >> _U32
    shift = record[RECORD_DISPLACEMENT] + first
    count = 0
    lanes = 0
    split = False
    table[:] = -1
    for lane in range(32):
        if not (mask >> np.uint64(lane)) & np.uint64(1):
            continue
        place = _place(ranges, last, record[RECORD_LANES + lane] + shift)
        if place < 0:
            continue
        lanes += 1
        if counts_hot:
            hot[place >> 2] += 1
        start, end = place, place + span
        split |= (start >> 5) != ((end - 1) >> 5)
        while start < end:
            sector = start >> 5
            stop = min(end, (sector + 1) << 5)
            slot = sector & 127
            while table[slot] >= 0 and sectors[table[slot]] != sector:
                slot = (slot + 1) & 127
            at = table[slot]
            if at < 0:
                at = count
                table[slot] = at
                sectors[at] = sector
                covered[at] = 0
                count += 1
            covered[at] |= ((np.int64(1) << (stop - start)) - 1) << (start & 31)
            start = stop
    return count, lanes, split


# --- a heap of warps by the clock of their next request -------------------------------------------------------------


@inlined
def _push(heap, size, key, warp):
    at = size
    while at > 0 and heap[(at - 1) >> 1, 0] > key:
        above = (at - 1) >> 1
        heap[at, 0] = heap[above, 0]
        heap[at, 1] = heap[above, 1]
        at = above
    heap[at, 0] = key
    heap[at, 1] = warp


@inlined
def _replace_top(heap, size, key, warp):
    """Put an entry in the place of the earliest one and let it sink."""
    at = 0
    below = 1
    while below < size:
        if below + 1 < size and heap[below + 1, 0] < heap[below, 0]:
            below += 1
        if heap[below, 0] >= key:
            break
        heap[at, 0] = heap[below, 0]
        heap[at, 1] = heap[below, 1]
        at = below
        below = 2 * at + 1
    heap[at, 0] = key
    heap[at, 1] = warp


# --- warps and thread blocks ----------------------------------------------------------------------------------------


@compiled
def _start_block(launch, contexts, halves, jobs, warps, slots, slot, block, start, queued):
    """Put a thread block into a slot; its warps begin at the cycle ``start``."""
    count, words = launch[_WARPS], launch[_CONTEXT_BYTES] >> 3
    jobs[slot, _JOB_BLOCK] = block
    jobs[slot, _JOB_VOTES] = 0
    jobs[slot, _JOB_ARRIVED] = 0
    for w in range(count):
        warp = slot * count + w
        at = warp * words
        half = 2 * at
        left = launch[_THREADS] - 32 * w
        halves[half] = 0
        halves[half + _LIVE] = np.int32(-1) if left >= 32 else np.int32((np.int64(1) << left) - 1)
        halves[half + _CTAID] = block % launch[_GRID_X]
        halves[half + _CTAID + 1] = block // launch[_GRID_X] % launch[_GRID_Y]
        halves[half + _CTAID + 2] = block // (launch[_GRID_X] * launch[_GRID_Y])
        halves[half + _WAITED] = 0
        contexts[at + _REDUCTIONS] = 0
        contexts[at + _CLOCK] = 0
        contexts[at + _ISSUE] = 0
        contexts[at + _SHARED_PIPE] = 0
        warps[warp, _STATE] = _READY
        warps[warp, _OFFSET] = start
        warps[warp, _QUEUED] = queued
        warps[warp, _PENDING_COUNT] = 0
        warps[warp, _PENDING_CLOCK] = -1
        warps[warp, _ISSUED] = 0
        warps[warp, _SHARED_TAKEN] = 0
    slots[slot, _RUNNING] = count
    slots[slot, _AT_BARRIER] = 0
    slots[slot, _STARTED] = start
    slots[slot, _OPENED] = start


@inlined
def _wait_for_loads(warps, pending, outcome, warp, clock, until):
    """Stall a warp for the values that it needs up to a cycle of the segment that began at ``clock``."""
    kept = 0
    for number in range(warps[warp, _PENDING_COUNT]):
        done, use = pending[warp, number, 0], pending[warp, number, 1]
        if use <= until:
            stall = max(np.int64(0), done - (clock + use + warps[warp, _OFFSET]))
            warps[warp, _OFFSET] += stall
            outcome[_WAITS + pending[warp, number, 2]] += stall
        else:
            pending[warp, kept, 0] = done
            pending[warp, kept, 1] = use
            pending[warp, kept, 2] = pending[warp, number, 2]
            kept += 1
    warps[warp, _PENDING_COUNT] = kept


@inlined
def _arrive(warps, slots, pipes, contexts, pending, outcome, slot, sm, warp, at):
    """The warp has replayed everything up to a barrier or its end, not before its SM's pipes had time for its work."""
    _wait_for_loads(warps, pending, outcome, warp, warps[warp, _PENDING_CLOCK], _ALL_USES)
    opened = slots[slot, _OPENED]
    issued, shared = contexts[at + _ISSUE], contexts[at + _SHARED_PIPE]
    pipes[sm, 0] = max(pipes[sm, 0], opened * ISSUE_UNITS) + issued - warps[warp, _ISSUED]
    pipes[sm, 1] = max(pipes[sm, 1], opened) + shared - warps[warp, _SHARED_TAKEN]
    warps[warp, _ISSUED] = issued
    warps[warp, _SHARED_TAKEN] = shared
    arrival = max(contexts[at + _CLOCK] + warps[warp, _OFFSET], pipes[sm, 0] // ISSUE_UNITS, pipes[sm, 1])
    warps[warp, _ARRIVAL] = arrival
    at_barrier = warps[warp, _STATUS_OF] == _STATUS_BARRIER
    warps[warp, _STATE] = _WAITING if at_barrier else _ENDED
    slots[slot, _RUNNING] -= 1
    slots[slot, _AT_BARRIER] += at_barrier


@compiled
def replay(
    launch, machine, facts, issue, use, contexts, halves, jobs, ranges, l1_tags, l1_order, l1_bits, l2_tags, l2_order,
    l2_bits, l2_writers, open_rows, tallies, hot, traces, outcome,
):  # fmt: skip
    """Run all thread blocks. outcome: see the words above; tallies: a row per site."""
    count, slot_count, blocks = launch[_WARPS], launch[_SLOTS], launch[_BLOCKS]
    words, capacity = launch[_CONTEXT_BYTES] >> 3, launch[_CAPACITY]
    sms, l1_per_sm, l1_sets, l2_sets = machine[_SMS], machine[_L1_PER_SM], machine[_L1_SETS], machine[_L2_SETS]
    channels, banks, row_pieces = machine[_CHANNELS], machine[_BANKS], machine[_ROW_PIECES]
    l1_latency, l2_latency, dram_latency = machine[_L1_LATENCY], machine[_L2_LATENCY], machine[_DRAM_LATENCY]
    total = slot_count * count
    warps = np.zeros((total, 14), np.int64)
    slots = np.zeros((slot_count, 5), np.int64)
    pending = np.zeros((total, _PENDING, 3), np.int64)
    saved = np.zeros((total, 64), np.int64)
    covered = np.zeros(64, np.int64)
    table = np.zeros(128, np.int64)
    last = np.zeros(1, np.int64)
    port = np.zeros(sms, np.int64)  # when each SM's way to L2 is free
    pipes = np.zeros((sms, 2), np.int64)  # when each SM's issue slots [ISSUE_UNITS] and shared memory are free
    heap = np.zeros((total + slot_count + 1, 2), np.int64)  # of warps with requests, and of slots with code to run
    heap_size = 0
    jobs_at = jobs.ctypes.data
    next_block = np.int64(0)

    # Block b goes to SM b % SMs first, as long as there is room. Slots run code in their order, so that lower blocks
    # are ahead of higher ones where one waits for another.
    for slot in range(slot_count):
        _start_block(launch, contexts, halves, jobs, warps, slots, slot, next_block, np.int64(0), np.int64(0))
        next_block += 1
    for slot in range(slot_count):
        _push(heap, heap_size, slot - slot_count, total + slot)
        heap_size += 1
        slots[slot, _QUEUED_SLOT] = 1
    outcome[_PEAK_WARPS] = total

    while heap_size > 0:
        now, warp = heap[0, 0], heap[0, 1]
        if warp >= total:
            # Run the code of every ready warp of a slot.
            slot = warp - total
            slots[slot, _QUEUED_SLOT] = 0
            heap_size -= 1
            if heap_size > 0:
                _replace_top(heap, heap_size, heap[heap_size, 0], heap[heap_size, 1])
            for warp in range(slot * count, (slot + 1) * count):
                while warps[warp, _STATE] == _READY:
                    at = warp * words
                    trace_at = launch[_TRACE] + warp * capacity * (8 * RECORD_WORDS)
                    contexts[at + _TRACE_AT] = trace_at
                    contexts[at + _TRACE_END] = trace_at + TRACE_LIMIT * (8 * RECORD_WORDS)
                    context = launch[_CONTEXTS] + warp * launch[_CONTEXT_BYTES]
                    status: int = _run_code(launch[_CODE], context, jobs_at + slot * (8 * _JOB_WORDS))  # type: ignore[call-arg]
                    if status >= _FIRST_FAULT:
                        outcome[_FAULT] = status
                        outcome[_STOP_SLOT] = slot
                        outcome[_STOP_WARP] = warp - slot * count
                        return
                    warps[warp, _STATUS_OF] = status
                    recorded = (contexts[at + _TRACE_AT] - trace_at) // (8 * RECORD_WORDS)
                    warps[warp, _RECORDED] = recorded
                    warps[warp, _NEXT] = 0
                    warps[warp, _WORD] = 0
                    if recorded > 0:
                        warps[warp, _STATE] = _REPLAYING
                        first = warp * capacity
                        site = traces[first, RECORD_SITE] & 0xFFFFFFFF
                        key = traces[first, RECORD_CLOCK] + issue[site] + warps[warp, _OFFSET] + warps[warp, _QUEUED]
                        _push(heap, heap_size, key, warp)
                        heap_size += 1
                    elif status != _STATUS_YIELD:
                        _arrive(warps, slots, pipes, contexts, pending, outcome, slot, slot % sms, warp, at)
        else:
            # Replay the earliest request.
            slot = warp // count
            sm = slot % sms
            at = warp * capacity + warps[warp, _NEXT]
            word, run = warps[warp, _WORD], traces[at, RECORD_RUN]
            site = traces[at, RECORD_SITE] & 0xFFFFFFFF
            clock = traces[at, RECORD_CLOCK]
            kind, width = facts[site, _KIND], facts[site, _WIDTH]
            if clock != warps[warp, _PENDING_CLOCK]:
                _wait_for_loads(warps, pending, outcome, warp, warps[warp, _PENDING_CLOCK], _ALL_USES)
                warps[warp, _PENDING_CLOCK] = clock
            elif warps[warp, _PENDING_COUNT] > 0:
                _wait_for_loads(warps, pending, outcome, warp, clock, issue[site])

            # A run of atomics on neighbouring words is as many requests, of the same sectors if no lane's run has two.
            if word == 0:
                sectors, lanes, split = _gather_sectors(
                    traces[at], 0, width * run, ranges, last, saved[warp], covered, table, hot, kind == _ATOMIC
                )
                warps[warp, _SECTORS], warps[warp, _LANES] = (-1 if split and run > 1 else sectors), lanes
            sectors, lanes = warps[warp, _SECTORS], warps[warp, _LANES]
            if sectors < 0:
                sectors, lanes, split = _gather_sectors(
                    traces[at], word * width, width, ranges, last, saved[warp], covered, table, hot, False
                )

            latency = np.int64(0)
            exchanged = np.int64(0)
            unit = sm * l1_per_sm + warp % l1_per_sm
            in_l1 = kind == _LOAD and facts[site, _IN_L1] != 0
            if kind == _LOAD:
                tallies[site, _REQUEST_BYTES] += lanes * width
            elif kind == _ATOMIC:
                tallies[site, _ATOMIC_LANES] += lanes
                tallies[site, _ATOMIC_SECTORS] += sectors
            for number in range(sectors):
                sector = saved[warp, number]
                if in_l1 and l1_access(l1_tags, l1_order, l1_bits, l1_sets, unit, sector):
                    tallies[site, _L1_HIT] += 1
                    latency = max(latency, l1_latency)
                    continue
                action = FETCH
                if kind == _LOAD:
                    tallies[site, _L1_MISS] += 1
                elif kind == _ATOMIC:
                    action = ADD
                else:
                    action = FILL if covered[number] == 0xFFFFFFFF else PART
                hit = l2_access(
                    l2_tags, l2_order, l2_bits, l2_writers, l2_sets, open_rows, channels, banks, row_pieces, tallies,
                    site, sector, action,
                )  # fmt: skip
                exchanged += 1
                latency = max(latency, (l2_latency if hit else dram_latency) + exchanged)

            begin = max(now, port[sm])
            port[sm] = begin + max(np.int64(1), exchanged)
            warps[warp, _QUEUED] += begin - now
            if use[site] != NEVER:
                if warps[warp, _PENDING_COUNT] == _PENDING:
                    _wait_for_loads(warps, pending, outcome, warp, clock, _ALL_USES)
                number = warps[warp, _PENDING_COUNT]
                pending[warp, number, 0] = clock + issue[site] + warps[warp, _OFFSET] + latency
                pending[warp, number, 1] = use[site]
                pending[warp, number, 2] = 0 if exchanged == 0 else 1 if latency < dram_latency else 2
                warps[warp, _PENDING_COUNT] = number + 1

            if word + 1 < run:
                warps[warp, _WORD] = word + 1
                _replace_top(heap, heap_size, begin + 1, warp)
                continue
            warps[warp, _WORD] = 0
            warps[warp, _NEXT] += 1
            if warps[warp, _NEXT] < warps[warp, _RECORDED]:
                following = traces[at + 1, RECORD_SITE] & 0xFFFFFFFF
                key = traces[at + 1, RECORD_CLOCK] + issue[following] + warps[warp, _OFFSET] + warps[warp, _QUEUED]
                _replace_top(heap, heap_size, key, warp)
                continue
            heap_size -= 1
            if heap_size > 0:
                _replace_top(heap, heap_size, heap[heap_size, 0], heap[heap_size, 1])
            if warps[warp, _STATUS_OF] == _STATUS_YIELD:
                warps[warp, _STATE] = _READY
                if not slots[slot, _QUEUED_SLOT]:
                    _push(heap, heap_size, now, total + slot)
                    heap_size += 1
                    slots[slot, _QUEUED_SLOT] = 1
                continue
            _arrive(warps, slots, pipes, contexts, pending, outcome, slot, sm, warp, warp * words)

        if slots[slot, _RUNNING] > 0:
            continue
        # Nobody of the block runs: open its barrier, or let the next block in.
        waits = slots[slot, _AT_BARRIER] > 0
        latest = np.int64(0)
        latest_queued = np.int64(0)
        for warp in range(slot * count, (slot + 1) * count):
            if not waits or warps[warp, _STATE] == _WAITING:
                latest = max(latest, warps[warp, _ARRIVAL])
                latest_queued = max(latest_queued, warps[warp, _ARRIVAL] + warps[warp, _QUEUED])
        queued = max(np.int64(0), latest_queued - latest)
        if waits:
            for warp in range(slot * count, (slot + 1) * count):
                if warps[warp, _STATE] == _WAITING:
                    outcome[_BARRIER_WAIT] += latest - warps[warp, _ARRIVAL]
                    warps[warp, _OFFSET] = latest - contexts[warp * words + _CLOCK]
                    warps[warp, _QUEUED] = queued
                    warps[warp, _STATE] = _READY
            slots[slot, _RUNNING] = slots[slot, _AT_BARRIER]
            slots[slot, _AT_BARRIER] = 0
            slots[slot, _OPENED] = latest
            start = latest
        else:
            for warp in range(slot * count, (slot + 1) * count):
                outcome[_WARP_CYCLES] += warps[warp, _ARRIVAL] - slots[slot, _STARTED]
            outcome[_LATENCY_CYCLES] = max(outcome[_LATENCY_CYCLES], latest)
            if next_block >= blocks:
                continue
            start = latest + machine[_BLOCK_START]
            _start_block(launch, contexts, halves, jobs, warps, slots, slot, next_block, start, queued)
            next_block += 1
        _push(heap, heap_size, start + queued, total + slot)
        heap_size += 1
        slots[slot, _QUEUED_SLOT] = 1

    for at in range(l2_bits.size):
        if l2_bits[at] >> 4:
            write_back(open_rows, channels, banks, row_pieces, tallies, l2_writers[at], l2_tags[at], l2_bits[at] >> 4)


# --- one launch -----------------------------------------------------------------------------------------------------


class MemorySystem:
    """The modelled memory of one launch, cold at its start."""

    def __init__(self, machine: Machine, facts: _Description, tables: TimingTables) -> None:
        self._machine, self._facts, self._tables = machine, facts, tables
        l1_sets = max(1, machine.l1_bytes // (LINE_BYTES * WAYS))
        l2_sets = max(1, machine.l2_bytes // (LINE_BYTES * WAYS))
        row_pieces = max(1, machine.dram_channels * machine.dram_row_bytes // 256)
        self._words = np.array(
            [
                machine.sms, machine.l1_per_sm, l1_sets, l2_sets, machine.dram_channels, machine.dram_banks, row_pieces,
                machine.l1_latency, machine.l2_latency, machine.dram_latency, machine.block_start,
            ],
            np.int64,
        )  # fmt: skip
        self._l1 = _empty_cache(machine.sms * machine.l1_per_sm * l1_sets)
        self._l2 = (*_empty_cache(l2_sets), np.zeros(l2_sets * WAYS, np.int32))
        self._open_rows = np.full(machine.dram_channels * machine.dram_banks, -1, np.int64)
        self._tallies = np.zeros((max(1, len(facts.sites)), len(TALLY)), np.int64)
        self._site_facts = np.array(
            [[_KINDS.index(s.kind), s.width, self._in_l1(s.index)] for s in facts.sites] or [[0, 0, 0]], np.int64
        )

    def _in_l1(self, instruction: int) -> bool:
        """Whether L1 may hold what a load fetches: the read-only path always, plain loads where the machine does."""
        root, *modifiers = self._facts.opcodes[instruction].split(".")
        if root != "ld":
            return False
        if "nc" in modifiers:
            return True
        passes_by = {"volatile", "relaxed", "acquire", "cg", "cv", "mmio"}
        return self._machine.l1_holds_plain_loads and not passes_by & set(modifiers)

    def run(self, code: int, job: _Job, blocks: int, memory: Sequence[np.ndarray]) -> tuple[int, MemoryCounters]:
        """Run all thread blocks of a launch. code: address of the warp function. memory: arrays that it may touch.

        -> (status of the fault that stopped it or 0, counters).
        """
        facts, machine, warps = self._facts, self._machine, job.warps
        slots = max(1, min(machine.sms * machine.blocks_per_sm, blocks))
        contexts = _aligned_words(slots * warps * facts.context_bytes)
        own = job.contexts.view(np.int64)[: warps * facts.context_bytes // 8]
        contexts.reshape(slots, -1)[:] = own
        shared_stride = -(-(job.shared_bytes + 64) // 64) * 64
        shared = _aligned_words(slots * shared_stride)
        local_stride = -(-32 * warps * facts.local_bytes // 64) * 64
        local = _aligned_words(max(64, slots * local_stride))
        jobs = np.empty((slots, _JOB_WORDS), np.int64)
        jobs[:] = job.fields[:_JOB_WORDS]
        number = np.arange(slots)
        jobs[:, _JOB_CONTEXTS] = contexts.ctypes.data + number * (warps * facts.context_bytes)
        jobs[:, _JOB_SHARED] = shared.ctypes.data + number * shared_stride
        jobs[:, _JOB_LOCAL] = local.ctypes.data + number * local_stride
        jobs[:, _JOB_LOCAL_END] = jobs[:, _JOB_LOCAL] + 32 * warps * facts.local_bytes
        ranges, device_bytes = _ranges([*memory, *job.variables])
        requests = sum(site.space in ("global", "generic") for site in facts.sites)
        capacity = TRACE_LIMIT + requests + 1
        traces = np.empty((slots * warps * capacity, RECORD_WORDS), np.int64)
        launch = np.array(
            [
                code, contexts.ctypes.data, facts.context_bytes, warps, job.threads, blocks, job.get("grid_x"),
                job.get("grid_y"), slots, traces.ctypes.data, capacity,
            ],
            np.int64,
        )  # fmt: skip
        atomics = any(site.kind == "atomic" and site.space != "shared" for site in facts.sites)
        hot = np.zeros(device_bytes // 4 + 1 if atomics else 1, np.int32)
        outcome = np.zeros(_WAITS + 3, np.int64)
        if blocks:
            replay(
                launch, self._words, self._site_facts, self._tables.issue, self._tables.use, contexts,
                contexts.view(np.int32), jobs, ranges, *self._l1, *self._l2, self._open_rows, self._tallies, hot,
                traces, outcome,
            )  # fmt: skip
        status = int(outcome[_FAULT])
        if status:
            job.fields[:_JOB_WORDS] = jobs[outcome[_STOP_SLOT]]
            job.set("stop_warp", int(outcome[_STOP_WARP]))
        return status, self._counters(outcome, int(hot.max()))

    def _counters(self, outcome: np.ndarray, hottest: int) -> MemoryCounters:
        counters = MemoryCounters(
            hot_address=hottest,
            latency_cycles=int(outcome[_LATENCY_CYCLES]),
            warp_cycles=int(outcome[_WARP_CYCLES]),
            barrier_wait_cycles=int(outcome[_BARRIER_WAIT]),
            l1_wait_cycles=int(outcome[_WAITS]),
            l2_wait_cycles=int(outcome[_WAITS + 1]),
            dram_wait_cycles=int(outcome[_WAITS + 2]),
            resident_warps=int(outcome[_PEAK_WARPS]),
        )
        for site, row in zip(self._facts.sites, self._tallies.tolist(), strict=False):
            if not any(row):
                continue
            line = self._facts.lines[site.index]
            where = SourceLine(*line) if line else SourceLine("?", 0)
            tally = MemoryTally(**dict(zip(TALLY, row, strict=True)))
            counters.lines[where] = counters.lines.get(where, MemoryTally()) + tally
            counters.total += tally
        return counters


def _ranges(arrays: Sequence[np.ndarray]) -> tuple[np.ndarray, int]:
    """First and last host address of every array and where it stands in the modelled GPU's memory; bytes of that."""
    rows, at = [], ALLOCATION_ALIGNMENT
    seen: set[int] = set()
    for array in arrays:
        start = array.ctypes.data
        if array.nbytes == 0 or start in seen:
            continue
        seen.add(start)
        rows.append((start, start + array.nbytes, at))
        at += -(-array.nbytes // ALLOCATION_ALIGNMENT) * ALLOCATION_ALIGNMENT
    return np.array(rows or [(0, 0, 0)], np.int64), at


def _aligned_words(size: int) -> np.ndarray:
    """Zeroed memory of ``size`` bytes as int64, on a multiple of 4096."""
    raw = np.zeros(size + 4096, np.uint8)
    start = -raw.ctypes.data % 4096
    return raw[start : start + -(-size // 8) * 8].view(np.int64)


def _empty_cache(sets: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Tags, order and sector bits of so many sets."""
    return np.full(sets * WAYS, -1, np.int32), np.full(sets, IN_ORDER, np.uint64), np.zeros(sets * WAYS, np.uint8)
