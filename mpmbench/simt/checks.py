"""Debug mode: every memory access is looked at before it happens. The rules, exactly, are in docs/sanitizer.md.

Bounds and alignment: each lane's bytes lie inside one array of the launch, the shared memory of its block or the local
memory of its thread, and its address is a multiple of the access's width. Lanes that fail do not access memory.

Shared memory, granule by granule (a granule is the narrowest element that the kernel accesses): accesses without a
barrier between them, by different warps or by different lanes of one warp. Since Volta the lanes of a warp do not run
in step, and shuffles, votes and matches do not order memory.

Global memory, granule by granule: accesses by different thread blocks of one launch, which no barrier orders. A block
is ordered after another only by reading, atomically or with a volatile or stronger load, what that block published
after a fence.

Uninitialised: a byte is read that nobody has written since its thread block started (shared, local) or since it was
allocated (global).

The checker is compiled by numba (``compiled``).
"""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import types
from numba.extending import intrinsic

from mpmbench.simt.compiled import callback, compiled
from mpmbench.simt.counters import ERROR, INFO, WARNING, Finding, SourceLine
from mpmbench.simt.naming import block_text, line_text, threads_text
from mpmbench.simt.scheduler import CONTEXT_FENCED, CONTEXT_WARP, CONTEXT_WARP_EPOCH, JOB

if TYPE_CHECKING:
    from mpmbench.simt.engine import _Description, _Job

_KINDS = ("load", "store", "atomic")
_LOAD, _STORE, _ATOMIC = range(3)
_ORDERS = ("weak", "strong", "release")
_SPACES = {"shared": 1, "generic": 2, "local": 3}  # 0: any other, which is global memory

# Words of the checker's data, before the tables that they point into.
(
    _RANGES_AT, _RANGE_COUNT, _SITES_AT, _SHADOW_AT, _GRANULE_SHIFT, _FINDINGS_AT, _FINDING_COUNT, _GLOBAL_SHIFT,
    _BLOCKS, _ACQUIRED, _LOCAL_AT, _LOCAL_SHIFT, _LOCAL_BYTES,
) = range(13)  # fmt: skip
_HEADER = 16

_RANGE_WORDS = 5  # start, end, address of the shadow or 0, of the written bits or 0, start of what these two describe
_SITE_WORDS = 7  # kind, width, space, accesses in the run, order, last range, bytes of an element

# Shadow of a shared granule: epoch and the kinds of access in it; the block that wrote it; per kind two slots of two
# words (site and lanes; warp epoch and warp); what the two stores wrote.
_SLOT_WORDS = 2
_SLOTS, _STORED = 2, 2 + 3 * 2 * _SLOT_WORDS
_SHADOW_WORDS = _STORED + 2

# Shadow of a global granule, one word: plain site (16 bits) and atomic site (16), both plus one; what has been done to
# it (6: plain reads and writes; strong reads, and strong writes or atomics; whether several blocks did; whether a fence
# came before); the thread block that did (25).
_READ, _WRITTEN, _STRONG_READ, _ATOMICALLY, _SEVERAL, _PUBLISHED = (1 << 32 + bit for bit in range(6))
_DONE = 63 << 32
_BLOCK_SHIFT = 38
_BLOCK_MASK = (1 << 25) - 1
_SITE_MASK = 0xFFFF

_FINDING_WORDS = 11  # kind, site, other site, count, block, address, warp, lanes, other block, other warp, other lanes
_FINDINGS = 512

(
    _RACE, _HAZARD, _CLASH, _SAME, _MIX, _BLOCK_RACE, _BLOCK_SAME, _BLOCK_MIX,
    _UNINITIALISED, _OUTSIDE, _MISALIGNED,
) = range(1, 12)  # fmt: skip

# Places in a job and a context, in words.
_BLOCK, _EPOCH = JOB["block"] // 8, JOB["epoch"] // 8
_SHARED_BASE, _SHARED_BYTES = JOB["shared"] // 8, JOB["shared_bytes"] // 8
_LOCAL, _LOCAL_END = JOB["local"] // 8, JOB["local_end"] // 8
_WARP, _WARP_EPOCH, _FENCED = CONTEXT_WARP // 8, CONTEXT_WARP_EPOCH // 8, CONTEXT_FENCED // 8
_FENCED_BITS = 0xFFFF << 48  # of that word

_WORD = types.CPointer(types.int64)
_SIGNATURE = types.int32(_WORD, _WORD, _WORD, types.int64, types.int64, types.int32, _WORD, types.int64, _WORD)


def _pointer_to(element: types.Type) -> Any:
    @intrinsic
    def at(typing_context, address):
        def generate(context, builder, signature, arguments):
            return builder.inttoptr(arguments[0], context.get_value_type(signature.return_type))

        return types.CPointer(element)(types.int64), generate

    return at


_words = _pointer_to(types.int64)
_bytes = _pointer_to(types.uint8)
_stamps = _pointer_to(types.int32)


@compiled
def _report(data, kind, site, other, block, address, warp, lane, other_block, other_warp, other_lanes):
    start = data[_FINDINGS_AT]
    count = data[_FINDING_COUNT]
    for number in range(count):
        at = start + number * _FINDING_WORDS
        if data[at] == kind and data[at + 1] == site and data[at + 2] == other:
            data[at + 3] += 1
            if data[at + 4] == block and data[at + 6] == warp:
                data[at + 7] |= np.int64(1) << lane
            return
    if count < _FINDINGS:
        at = start + count * _FINDING_WORDS
        data[at] = kind
        data[at + 1] = site
        data[at + 2] = other
        data[at + 3] = 1
        data[at + 4] = block
        data[at + 5] = address
        data[at + 6] = warp
        data[at + 7] = np.int64(1) << lane
        data[at + 8] = other_block
        data[at + 9] = other_warp
        data[at + 10] = other_lanes
        data[_FINDING_COUNT] = count + 1


@compiled
def _range_of(data, address, width):
    """Place of the allocation that holds the bytes in the table of ranges, or -1."""
    at = data[_RANGES_AT]
    for _ in range(data[_RANGE_COUNT]):
        if data[at] <= address and address + width <= data[at + 1]:
            return at
        at += _RANGE_WORDS
    return np.int64(-1)


# --- shared memory ----------------------------------------------------------------------------------------------------


@compiled
def _compare(data, shadow, other, kind, site, warp, lane, warp_epoch, stored, block, address):
    """Report conflicts of an access with the earlier ones of one kind in this epoch."""
    for number in range(2):
        at = shadow + _SLOTS + (2 * other + number) * _SLOT_WORDS
        who = data[at + 1]
        if who == 0:
            continue
        lanes, where = data[at] & 0xFFFFFFFF, data[at] >> 32
        elsewhere = (who & 0xFF) - 1 != warp
        if not elsewhere and not ((who >> 8) == warp_epoch and lanes & ~(np.int64(1) << lane)):
            continue
        if kind == _STORE and other == _STORE and data[shadow + _STORED + number] == stored:
            conflict = _SAME
        elif kind == _ATOMIC or other == _ATOMIC:
            conflict = _MIX
        elif elsewhere:
            conflict = _RACE
        elif where == site:
            conflict = _CLASH  # two lanes store to one address in one instruction, or in turns of a loop
        else:
            conflict = _HAZARD
        others = lanes if elsewhere else lanes & ~(np.int64(1) << lane)
        _report(data, conflict, site, where, block, address, warp, lane, block, (who & 0xFF) - 1, others)
        return


@compiled
def _remember(data, shadow, kind, fresh, site, warp, lane, warp_epoch, stored):
    """Two different warps are enough to find every race with a third; of one warp, the lanes since its last barrier."""
    first = shadow + _SLOTS + 2 * kind * _SLOT_WORDS
    bit = np.int64(1) << lane
    who = (warp_epoch << 8) | (warp + 1)
    if fresh:
        data[first + _SLOT_WORDS + 1] = 0
        chosen = 0
    else:
        chosen = 0 if (data[first + 1] & 0xFF) == warp + 1 else 1
        at = first + chosen * _SLOT_WORDS
        if data[at + 1] == who:
            bit |= data[at] & 0xFFFFFFFF
    at = first + chosen * _SLOT_WORDS
    data[at] = (site << 32) | bit
    data[at + 1] = who
    if kind == _STORE:
        data[shadow + _STORED + chosen] = stored


@compiled
def _look_at_shared(data, job, offset, width, kind, site, warp, lane, warp_epoch, stored):
    block = job[_BLOCK]
    epoch = job[_EPOCH]
    shift = data[_GRANULE_SHIFT]
    who = (warp_epoch << 8) | (warp + 1)
    against = 6 if kind == _LOAD else 7 if kind == _STORE else 3
    for granule in range(offset >> shift, ((offset + width - 1) >> shift) + 1):
        shadow = data[_SHADOW_AT] + granule * _SHADOW_WORDS
        if kind != _STORE and data[shadow] == ((epoch << 3) | (1 << kind)) and data[shadow + 1] == block + 1:
            # Nothing but this kind of access in this epoch: no conflict, and this warp may be noted already.
            slot = shadow + _SLOTS + 2 * kind * _SLOT_WORDS
            if data[slot + 1] != who:
                slot += _SLOT_WORDS
            if data[slot + 1] == who:
                data[slot] |= np.int64(1) << lane
                continue
        if data[shadow + 1] != block + 1:
            if kind != _STORE:
                _report(data, _UNINITIALISED, site, np.int64(-1), block, granule << shift, warp, lane, block, 0, 0)
            if kind != _LOAD:
                data[shadow + 1] = block + 1
        done = data[shadow] & 7 if data[shadow] >> 3 == epoch else 0
        if done & against:
            for other in range(3):
                if done & against & (1 << other):
                    _compare(data, shadow, other, kind, site, warp, lane, warp_epoch, stored, block, granule << shift)
        _remember(data, shadow, kind, not done & (1 << kind), site, warp, lane, warp_epoch, stored)
        data[shadow] = (epoch << 3) | done | (1 << kind)


# --- global memory ----------------------------------------------------------------------------------------------------


@compiled
def _fingerprint(address, width, element):
    """Of what memory holds, as stores compute it of what they write."""
    memory = _bytes(address)
    total = np.uint64(0)
    for start in range(0, width, element):
        value = np.uint64(0)
        for byte in range(element):
            value |= np.uint64(memory[start + byte]) << np.uint64(8 * byte)
        total = total * np.uint64(0x9E3779B97F4A7C15) + value
    return np.int64(total)


@compiled
def _deed(kind, plain):
    if plain:
        return _READ if kind == _LOAD else _WRITTEN
    return _STRONG_READ if kind == _LOAD else _ATOMICALLY


@compiled
def _between_blocks(data, context, shadow, granule, kind, order, site, warp, lane, block, address, width, element,
                    stored):  # fmt: skip
    """An access to a granule that this block does not have to itself, or does something new to."""
    word = shadow[granule]
    mine = block & _BLOCK_MASK
    plain = kind != _ATOMIC and order == 0
    does = _deed(kind, plain)
    by_others = word != 0 and ((word & _SEVERAL) != 0 or word >> _BLOCK_SHIFT != mine)
    if by_others and not plain and kind != _STORE and word & _PUBLISHED:
        data[_ACQUIRED] = block + 1
    if by_others and data[_ACQUIRED] != block + 1:
        conflict = 0
        other = word & _SITE_MASK
        if does == _READ and word & _WRITTEN:
            conflict = _BLOCK_RACE
        elif does == _WRITTEN and word & (_READ | _WRITTEN):
            conflict = _BLOCK_RACE
            if word & _WRITTEN and stored == _fingerprint(address, width, element):
                conflict = _BLOCK_SAME
        elif (does == _STRONG_READ and word & _WRITTEN) or (does == _ATOMICALLY and word & (_READ | _WRITTEN)):
            conflict = _BLOCK_MIX
        elif plain and word & (_ATOMICALLY if does == _READ else _ATOMICALLY | _STRONG_READ):
            conflict = _BLOCK_MIX
            other = (word >> 16) & _SITE_MASK
        if conflict:
            owner = word >> _BLOCK_SHIFT
            _report(data, conflict, site, other - 1, block, address, warp, lane, owner, np.int64(-1), np.int64(0))
            word = np.int64(0)
    if by_others:  # what several blocks did alike goes on; what one did before others were told of it is settled
        word = word | _SEVERAL if word & does else np.int64(0)
    if not word & _SEVERAL:
        word = (word & ((np.int64(1) << _BLOCK_SHIFT) - 1)) | (mine << _BLOCK_SHIFT)
    number = min(site + 1, _SITE_MASK)
    if not plain:
        if kind != _LOAD or not word & _ATOMICALLY:
            word = (word & ~(np.int64(_SITE_MASK) << 16)) | (number << 16)
        if kind != _LOAD and (order == 2 or context[_FENCED] & _FENCED_BITS):
            word |= _PUBLISHED
    elif kind == _STORE or not word & _WRITTEN:
        word = (word & ~np.int64(_SITE_MASK)) | number
    shadow[granule] = word | does


@compiled
def _look_at_written(data, kind, site, width, address, start, bits, warp, lane, block):
    """Bytes that are read must have been written; those that are written, have. One bit per byte."""
    memory = _bytes(bits)
    offset = address - start
    missing = False
    while width >= 8 and offset & 7 == 0:
        if memory[offset >> 3] != 0xFF:
            missing = True
            if kind != _LOAD:
                memory[offset >> 3] = np.uint8(0xFF)
        offset += 8
        width -= 8
    while width > 0:
        bit = offset & 7
        count = min(8 - bit, width)
        mask = np.uint8(((1 << count) - 1) << bit)
        here = memory[offset >> 3]
        if here & mask != mask:
            missing = True
            if kind != _LOAD:
                memory[offset >> 3] = np.uint8(here | mask)
        offset += count
        width -= count
    if missing and kind != _STORE:
        _report(data, _UNINITIALISED, site, np.int64(-1), block, address, warp, lane, block, 0, 0)


@compiled
def _look_at_local(data, kind, site, width, offset, warp, lane, block, address):
    stamps = _stamps(data[_LOCAL_AT])
    shift = data[_LOCAL_SHIFT]
    stamp = np.int32((block + 1) & 0x7FFFFFFF)
    missing = False
    for granule in range(offset >> shift, ((offset + width - 1) >> shift) + 1):
        missing |= stamps[granule] != stamp
        if kind != _LOAD:
            stamps[granule] = stamp
    if missing and kind != _STORE:
        _report(data, _UNINITIALISED, site, np.int64(-1), block, address, warp, lane, block, 0, 0)


# --- the check --------------------------------------------------------------------------------------------------------


@callback(_SIGNATURE)
def _check(data, job, context, site, first_lane, bits, addresses, displacement, stored_values):
    """-> the lanes that may go on. addresses: of the chunk's lanes, the first of which is ``first_lane``."""
    about = data[_SITES_AT] + site * _SITE_WORDS
    kind, width, space, run = data[about], data[about + 1], data[about + 2], data[about + 3]
    order, element = data[about + 4], data[about + 6]
    whole = width * run
    shared, shared_bytes = job[_SHARED_BASE], job[_SHARED_BYTES]
    local, local_bytes = job[_LOCAL], data[_LOCAL_BYTES]
    in_locals = job[_LOCAL_END] - local
    block = job[_BLOCK]
    mine = block & _BLOCK_MASK
    warp = context[_WARP] >> 32
    warp_epoch = context[_WARP_EPOCH]
    several_blocks = data[_BLOCKS] > 1
    shift = data[_GLOBAL_SHIFT]
    plain = kind != _ATOMIC and order == 0
    does = _deed(kind, plain)
    publishes = not plain and kind != _LOAD and (order == 2 or context[_FENCED] & _FENCED_BITS != 0)
    at = data[about + 5]
    passed = 0
    for place in range(32):
        left = (bits & 0xFFFFFFFF) >> place
        if left == 0:
            break
        if not left & 1:
            continue
        address = addresses[place] + displacement
        lane = first_lane + place
        offset = address - shared
        if space == 1 or (space == 2 and 0 <= offset < shared_bytes):
            if offset & width - 1:
                _report(data, _MISALIGNED, site, np.int64(-1), block, offset, warp, lane, block, 0, 0)
                continue
            if offset < 0 or offset + whole > shared_bytes:
                _report(data, _OUTSIDE, site, np.int64(-1), block, offset, warp, lane, block, 0, 0)
                continue
            stored = np.int64(0)
            if kind == _STORE:
                # The place belongs to it: equal vectors that overlap by half do not store the same.
                stored = stored_values[place] ^ (offset << 44)
            for step in range(run):
                _look_at_shared(
                    data, job, offset + step * width, width, kind, site + step, warp, lane, warp_epoch, stored
                )
            passed |= 1 << place
            continue
        if address & width - 1:
            _report(data, _MISALIGNED, site, np.int64(-1), block, address, warp, lane, block, 0, 0)
            continue
        if space == 3 or (space == 2 and 0 <= address - local < in_locals):
            own = address - local - (32 * warp + lane) * local_bytes
            if own < 0 or own + whole > local_bytes:
                _report(data, _OUTSIDE, site, np.int64(-1), block, address, warp, lane, block, 0, 0)
                continue
            _look_at_local(data, kind, site, whole, address - local, warp, lane, block, address)
            passed |= 1 << place
            continue
        if not (data[at] <= address and address + whole <= data[at + 1]):
            found = _range_of(data, address, whole)
            if found < 0:
                _report(data, _OUTSIDE, site, np.int64(-1), block, address, warp, lane, block, 0, 0)
                continue
            at = found
            data[about + 5] = at
        if data[at + 3] != 0:
            _look_at_written(data, kind, site, whole, address, data[at + 4], data[at + 3], warp, lane, block)
        if several_blocks and data[at + 2] != 0:
            shadow = _words(data[at + 2])
            start = data[at] >> shift
            first = (address >> shift) - start
            last = ((address + whole - 1) >> shift) - start
            for granule in range(first, last + 1):
                word = shadow[granule]
                # Nothing new: this block did the same before and nobody else anything, or all do this alone.
                done = word & _DONE
                if word & does and not (publishes and not word & _PUBLISHED):
                    if not done & _SEVERAL:
                        if word >> _BLOCK_SHIFT == mine:
                            continue
                    elif done == (does | _SEVERAL):
                        continue
                step = ((granule + start << shift) - address) // width if run > 1 else 0
                stored = stored_values[place] if kind == _STORE else np.int64(0)
                _between_blocks(
                    data, context, shadow, granule, kind, order, site + step, warp, lane, block,
                    address + step * width, width, element, stored,
                )  # fmt: skip
        passed |= 1 << place
    if kind == _STORE and plain:
        context[_FENCED] &= ~_FENCED_BITS
    return np.int32(np.uint32(passed))


class Written:
    """Which bytes of device memory have been written since they were allocated: one bit per byte.

    Memory that was never announced counts as written.
    """

    def __init__(self) -> None:
        self._bits: dict[int, np.ndarray] = {}

    def allocate(self, array: np.ndarray) -> None:
        """The memory behind an array is fresh: nothing in it has been written."""
        owner = _owner(array)
        self._bits[id(owner)] = np.zeros(owner.nbytes // 8 + 8, np.uint8)
        weakref.finalize(owner, self._bits.pop, id(owner), None)

    def address(self, array: np.ndarray) -> int:
        """Address of the bits of the memory behind an array, or 0."""
        bits = self._bits.get(id(_owner(array)))
        return 0 if bits is None else int(bits.ctypes.data)


def _owner(array: np.ndarray) -> np.ndarray:
    """The array whose memory a view shows."""
    while isinstance(array.base, np.ndarray):
        array = array.base
    return array


class Checker:
    """The checker's memory for one launch.

    allocations: arrays that the kernel may touch; what is no array is ignored. names: of the allocations, by position.
    written: what is known of the memory behind them.
    """

    def __init__(
        self,
        facts: _Description,
        job: _Job,
        allocations: Sequence[Any],
        seed: int,
        names: Sequence[str] = (),
        written: Written | None = None,
    ) -> None:
        self._facts, self._job = facts, job
        widths = [site.width for site in facts.sites if site.space in ("global", "generic")]
        self._arrays: list[tuple[str, int, int]] = []  # name, start, end: for messages
        self._shadows: dict[int, np.ndarray] = {}
        global_shift = 0 if min(widths, default=4) < 4 else 2
        local_widths = [site.width for site in facts.sites if site.space in ("local", "generic")]
        local_shift = 0 if min(local_widths, default=4) < 4 else 2
        local_bytes = 32 * job.warps * facts.local_bytes
        self._stamps = np.zeros((local_bytes >> local_shift) + 1, np.int32)
        blocks = job.get("grid_x") * job.get("grid_y") * job.get("grid_z")

        ranges = []
        for position, array in enumerate(allocations):
            if _is_memory(array):
                name = names[position] if position < len(names) else f"argument {position}"
                bits = 0 if written is None else written.address(array)
                ranges.append(self._range(name, array, global_shift, blocks > 1, bits))
        for (name, *_), array in zip(facts.variables, job.variables, strict=True):
            ranges.append(self._range(name, array, global_shift, blocks > 1, 0))
        params = job.params.ctypes.data
        ranges.append((params, params + facts.param_bytes, 0, 0, 0))

        shift = max(facts.shared_granule.bit_length() - 1, 0)
        granules = (job.shared_bytes >> shift) + 1
        ranges_at = _HEADER
        sites_at = ranges_at + _RANGE_WORDS * len(ranges)
        shadow_at = sites_at + _SITE_WORDS * len(facts.sites)
        findings_at = shadow_at + _SHADOW_WORDS * granules
        self.data = data = np.zeros(findings_at + _FINDING_WORDS * _FINDINGS, np.int64)
        data[_RANGES_AT], data[_RANGE_COUNT], data[_SITES_AT], data[_SHADOW_AT] = (
            ranges_at, len(ranges), sites_at, shadow_at,
        )  # fmt: skip
        data[_GRANULE_SHIFT], data[_GLOBAL_SHIFT], data[_LOCAL_SHIFT] = shift, global_shift, local_shift
        data[_FINDINGS_AT], data[_BLOCKS] = findings_at, blocks
        data[_LOCAL_AT], data[_LOCAL_BYTES] = self._stamps.ctypes.data, facts.local_bytes
        data[ranges_at:sites_at] = np.array(ranges, np.int64).ravel()
        for number, site in enumerate(facts.sites):
            order = _ORDERS.index(site.order)
            row = _KINDS.index(site.kind), site.width, _SPACES.get(site.space, 0), site.run, order, ranges_at
            data[sites_at + _SITE_WORDS * number :][:_SITE_WORDS] = *row, site.element
        job.set("check", _check.address)
        job.set("check_data", data.ctypes.data)
        # The generator must not start at zero; neighbouring seeds should start far apart.
        job.set("random", int(np.random.default_rng(seed).integers(1, 2**63)))

    def _range(self, name: str, array: np.ndarray, shift: int, races: bool, bits: int) -> tuple[int, ...]:
        """One row of the table of ranges. Views of one memory share their shadow."""
        start, owner = array.ctypes.data, _owner(array)
        base, shadow = owner.ctypes.data, 0
        self._arrays.append((name, start, start + array.nbytes))
        if races:
            if base not in self._shadows:  # zeros that are never touched take no memory
                self._shadows[base] = np.zeros((owner.nbytes >> shift) + 2, np.int64)
            shadow = self._shadows[base].ctypes.data
        return start, start + array.nbytes, shadow, bits, base

    def findings(self, kernel: str) -> list[Finding]:
        data = self.data
        at, count = int(data[_FINDINGS_AT]), int(data[_FINDING_COUNT])
        merged: dict[tuple, Finding] = {}
        for row in data[at : at + count * _FINDING_WORDS].reshape(count, _FINDING_WORDS).tolist():
            finding = self._finding(kernel, *row)
            # Several instructions may stand on one line, and either of two may come first.
            key = (finding.kind, finding.severity, frozenset((finding.line, finding.other_line)))
            if key in merged:
                finding = replace(merged[key], count=finding.count + merged[key].count)
            merged[key] = finding
        return [*merged.values(), *self._barriers(kernel)]

    def _barriers(self, kernel: str) -> list[Finding]:
        """Warps that wait where others of their thread block never come."""
        job, result = self._job, []
        stranded = job.get("stranded")
        if stranded:
            line = self._line_at_barrier(job.get("stranded_segment"))
            waiting = job.get("stranded_waiting")
            warps = [warp for warp in range(job.warps) if waiting >> warp & 1]
            ended = [warp for warp in range(job.warps) if not waiting >> warp & 1]
            block = block_text(job, job.get("stranded_block"))
            threads = f"warps {_numbers(warps)} of block {block}"
            message = (
                f"{kernel}: Divergent thread(s) in block: {threads} wait at the barrier in {line_text(line)}, "
                f"warps {_numbers(ended)} end without it"
            )
            result.append(Finding("divergent-barrier", kernel, message, line, None, stranded, threads=threads))
        line, other = (self._line_at_barrier(job.get(name)) for name in ("mixed_segment", "mixed_other"))
        mixed = job.get("mixed")
        if mixed and line != other:  # a loop's barrier may stand in the code several times
            threads = f"block {block_text(job, job.get('mixed_block'))}"
            message = (
                f"{kernel}: Divergent thread(s) in block: warps of {threads} wait at different barriers, in "
                f"{line_text(line)} and {line_text(other)}"
            )
            result.append(Finding("divergent-barrier", kernel, message, line, other, mixed, threads=threads))
        return result

    def _line_at_barrier(self, segment: int) -> SourceLine | None:
        return self._line_at(self._facts.segments[segment][1] - 1)

    def _line_at(self, instruction: int) -> SourceLine | None:
        line = self._facts.lines[instruction]
        return SourceLine(*line) if line else None

    def _finding(
        self,
        kernel: str,
        kind: int,
        site: int,
        other: int,
        count: int,
        block: int,
        address: int,
        warp: int,
        lanes: int,
        other_block: int,
        other_warp: int,
        other_lanes: int,
    ) -> Finding:
        job, what = self._job, self._facts.sites[site]
        line = self._line_at(what.index)
        space, place = self._address(what.space, address, warp, lanes)
        size = f"{what.width * (what.run if kind in _WHOLE_RUN else 1)} bytes"
        threads = f"{threads_text(job, warp, lanes)} in block {block_text(job, block)}"
        verb = "atomic" if what.kind == "atomic" else "read" if what.kind == "load" else "write"
        if kind in _ALONE:
            name, text = _ALONE[kind]
            text = text.format(space=space, verb=verb, size=size, width=what.width)
            message = f"{kernel}: {text} at {line_text(line)} by {threads}: {place}"
            return Finding(name, kernel, message, line, None, count, ERROR, threads, place)
        before = self._facts.sites[other]
        other_line = self._line_at(before.index)
        name, severity, text = _TOGETHER[kind]
        if other_warp < 0:
            others = f"block {block_text(job, other_block)}"
        elif other_block == block:
            others = threads_text(job, other_warp, other_lanes)
        else:
            others = f"{threads_text(job, other_warp, other_lanes)} in block {block_text(job, other_block)}"
        message = (
            f"{kernel}: Race reported between {_ACCESS[before.kind]} access at {line_text(other_line)} by {others} and "
            f"{_ACCESS[what.kind]} access at {line_text(line)} by {threads}: {text}; {size}, {place}"
        )
        return Finding(name, kernel, message, line, other_line, count, severity, f"{others}; {threads}", place)

    def _address(self, space: str, address: int, warp: int, lanes: int) -> tuple[str, str]:
        """compute-sanitizer's name of the address space, and where in it the address is."""
        job = self._job
        if space == "shared" or 0 <= address < job.shared_bytes:
            outside = "" if 0 <= address < job.shared_bytes else f", block has {job.shared_bytes} bytes"
            return "__shared__", f"__shared__ {address:#x}{outside}"
        local = job.get("local")
        if space == "local" or local <= address < job.get("local_end"):
            thread = 32 * warp + (lanes & -lanes).bit_length() - 1
            offset = address - local - thread * self._facts.local_bytes
            return "__local__", f"__local__ {offset:+#x}, thread has {self._facts.local_bytes} bytes"
        if not self._arrays:
            return "__global__", f"address {address:#x}"

        def distance(entry: tuple[str, int, int]) -> int:
            return max(entry[1] - address, address - entry[2] + 1, 0)

        name, start, end = min(self._arrays, key=distance)
        if start <= address < end:
            return "__global__", f"{name} + {address - start} of {end - start} bytes"
        if address < start:
            return "__global__", f"address {address:#x}, {start - address} bytes before {name} of {end - start} bytes"
        return "__global__", f"address {address:#x}, {address - end} bytes after {name} of {end - start} bytes"


_ACCESS = {"load": "Read", "store": "Write", "atomic": "Atomic"}
_WHOLE_RUN = frozenset({_UNINITIALISED, _OUTSIDE})

# Defects of one access: name, text.
_ALONE = {
    _UNINITIALISED: ("uninitialised", "Uninitialized {space} memory read of size {size}"),
    _OUTSIDE: ("out-of-bounds", "Invalid {space} {verb} of size {size}, out of bounds,"),
    _MISALIGNED: ("misaligned", "Invalid {space} {verb} of size {size}, address no multiple of {width},"),
}
# Defects of two accesses: name, severity, text.
_TOGETHER = {
    _RACE: ("race", ERROR, "different warps without a barrier between them"),
    _HAZARD: ("race", ERROR, "different lanes of a warp without a barrier between them"),
    _CLASH: ("race", ERROR, "several lanes of a warp at one address, in one instruction or in turns of a loop"),
    _SAME: ("equal-stores", INFO, "both store the same value"),
    _MIX: ("atomic-mix", WARNING, "an atomic and a plain access without a barrier between them"),
    _BLOCK_RACE: ("global-race", ERROR, "different thread blocks of one launch, which nothing orders"),
    _BLOCK_SAME: ("equal-stores", INFO, "thread blocks of one launch store the same value"),
    _BLOCK_MIX: ("atomic-mix", WARNING, "an atomic or volatile and a plain access by different thread blocks"),
}


def _numbers(values: Sequence[int]) -> str:
    return ", ".join(map(str, values)) or "none"


def _is_memory(argument: Any) -> bool:
    return isinstance(argument, np.ndarray) and argument.ndim > 0
