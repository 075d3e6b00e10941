"""Debug mode: every memory access is looked at before it happens.

Bounds and alignment: each lane's bytes lie inside one array of the launch (or shared, local or module memory) and its
address is a multiple of the access's width; lanes that fail do not access memory.

Races, on every *granule* of shared memory (the narrowest element that the kernel accesses): two accesses, at least one
of them a write and not both atomic,

- by different warps, with no block barrier between them;
- by different lanes of one warp, with neither a block barrier nor a warp barrier between them. Since Volta the lanes
  of a warp do not run in step, and shuffles, votes and matches do not order memory.

Two stores of the same value to the same place are no race: whoever comes last, the outcome is the same.

Uninitialised: a shared granule is read that its thread block has not written.

The checker is compiled by numba and kept in numba's own cache.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numba
import numpy as np
from numba import carray, types

from mpmbench.simt.counters import Finding, SourceLine
from mpmbench.simt.scheduler import CONTEXT_WARP, CONTEXT_WARP_EPOCH, JOB, JOB_BYTES

if TYPE_CHECKING:
    from mpmbench.simt.engine import _Description, _Job

_KINDS = ("load", "store", "atomic")
_LOAD, _STORE, _ATOMIC = range(3)

# Words of the checker's data, before the tables that they point into.
_RANGES_AT, _RANGE_COUNT, _SITES_AT, _SHADOW_AT, _GRANULE_SHIFT, _FINDINGS_AT, _FINDING_COUNT, _LAST_RANGE = range(8)
_HEADER = 8

_SITE_WORDS = 3  # kind, width, space: 1 shared, 2 any, 0 another

# Shadow of a granule: the thread block that wrote it, then two slots for each kind of access.
_SLOT_WORDS = 6  # epoch, warp, lanes, warp epoch, site, what was stored
_SHADOW_WORDS = 1 + 2 * 3 * _SLOT_WORDS

_FINDING_WORDS = 6  # kind, site, other site, count, thread block, byte address (in shared memory: offset)
_FINDINGS = 512

_RACE, _HAZARD, _CLASH, _UNINITIALISED, _OUTSIDE, _MISALIGNED = range(1, 7)

# Places in a job and a context, in words.
_BLOCK, _EPOCH = JOB["block"] // 8, JOB["epoch"] // 8
_SHARED_BASE, _SHARED_BYTES = JOB["shared"] // 8, JOB["shared_bytes"] // 8
_JOB_WORDS = JOB_BYTES // 8
_WARP, _WARP_EPOCH = CONTEXT_WARP // 8, CONTEXT_WARP_EPOCH // 8

_WORD = types.CPointer(types.int64)
_SIGNATURE = types.int32(_WORD, _WORD, _WORD, types.int64, types.int64, types.int32, _WORD, types.int64, _WORD)
_UNBOUNDED = 1 << 40


def _compiled(function: Callable[..., Any]) -> Any:
    """Compile, and keep the result where numba finds a folder for it."""
    try:
        return numba.njit(cache=True)(function)
    except RuntimeError:  # neither the package's folder nor the user's cache can be written
        return numba.njit(function)


def _callback(function: Callable[..., Any]) -> Any:
    try:
        return numba.cfunc(_SIGNATURE, cache=True)(function)
    except RuntimeError:
        return numba.cfunc(_SIGNATURE)(function)


@_compiled
def _report(data, kind, site, other, block, address):
    start = data[_FINDINGS_AT]
    count = data[_FINDING_COUNT]
    for number in range(count):
        at = start + number * _FINDING_WORDS
        if data[at] == kind and data[at + 1] == site and data[at + 2] == other:
            data[at + 3] += 1
            return
    if count < _FINDINGS:
        at = start + count * _FINDING_WORDS
        data[at] = kind
        data[at + 1] = site
        data[at + 2] = other
        data[at + 3] = 1
        data[at + 4] = block
        data[at + 5] = address
        data[_FINDING_COUNT] = count + 1


@_compiled
def _inside(data, address, width):
    """Whether the bytes lie in one allocation. The one that held the last access is tried first."""
    ranges, count = data[_RANGES_AT], data[_RANGE_COUNT]
    at = ranges + 2 * data[_LAST_RANGE]
    if data[at] <= address and address + width <= data[at + 1]:
        return True
    for number in range(count):
        at = ranges + 2 * number
        if data[at] <= address and address + width <= data[at + 1]:
            data[_LAST_RANGE] = number
            return True
    return False


@_compiled
def _conflict(data, slots, epoch, warp, lane, warp_epoch, both_store, stored):
    """-> (kind of conflict or 0, site) of an access with the earlier ones in a granule's two slots.

    stored: stands for what a store writes.
    """
    for number in range(2):
        at = slots + number * _SLOT_WORDS
        if data[at] != epoch:
            continue
        if both_store and data[at + 5] == stored:
            continue
        if data[at + 1] != warp:
            return _RACE, data[at + 4]
        if data[at + 3] == warp_epoch and data[at + 2] & ~(np.int64(1) << lane):
            return _HAZARD, data[at + 4]
    return 0, np.int64(-1)


@_compiled
def _remember(data, slots, epoch, warp, lane, warp_epoch, site, stored):
    """Two different warps are enough to find every race with a third; of one warp, the lanes since its last barrier."""
    chosen = slots
    if data[slots] == epoch and data[slots + 1] != warp:
        chosen = slots + _SLOT_WORDS
    elif data[slots] != epoch:
        data[slots + _SLOT_WORDS] = -1
    bit = np.int64(1) << lane
    if data[chosen] == epoch and data[chosen + 1] == warp and data[chosen + 3] == warp_epoch:
        data[chosen + 2] |= bit
    else:
        data[chosen + 2] = bit
    data[chosen] = epoch
    data[chosen + 1] = warp
    data[chosen + 3] = warp_epoch
    data[chosen + 4] = site
    data[chosen + 5] = stored


@_compiled
def _look_at_shared(data, job, offset, width, kind, site, warp, lane, warp_epoch, stored):
    block = job[_BLOCK]
    epoch = job[_EPOCH]
    shift = data[_GRANULE_SHIFT]
    for granule in range(offset >> shift, ((offset + width - 1) >> shift) + 1):
        shadow = data[_SHADOW_AT] + granule * _SHADOW_WORDS
        if kind != _STORE and data[shadow] != block + 1:
            _report(data, _UNINITIALISED, site, np.int64(-1), block, granule << shift)
        for other in range(3):
            if (kind == _LOAD and other == _LOAD) or (kind == _ATOMIC and other == _ATOMIC):
                continue
            slots = shadow + 1 + 2 * _SLOT_WORDS * other
            both_store = kind == _STORE and other == _STORE
            conflict, where = _conflict(data, slots, epoch, warp, lane, warp_epoch, both_store, stored)
            if conflict == _HAZARD and where == site:
                conflict = _CLASH  # two lanes store to one address in one instruction, or in turns of a loop
            if conflict:
                _report(data, conflict, site, where, block, granule << shift)
        slots = shadow + 1 + 2 * _SLOT_WORDS * kind
        _remember(data, slots, epoch, warp, lane, warp_epoch, site, stored)
        if kind != _LOAD:
            data[shadow] = block + 1


@_callback
def _check(data_at, job_at, context_at, site, first_lane, bits, addresses_at, displacement, stored_at):
    """-> the lanes that may go on. addresses: of the chunk's lanes, the first of which is ``first_lane``."""
    data = carray(data_at, _UNBOUNDED)
    job = carray(job_at, _JOB_WORDS)
    context = carray(context_at, 64)
    addresses = carray(addresses_at, 32)
    stored_values = carray(stored_at, 32)
    about = data[_SITES_AT] + site * _SITE_WORDS
    kind, width, may_be_shared = data[about], data[about + 1], data[about + 2]
    shared, shared_bytes = job[_SHARED_BASE], job[_SHARED_BYTES]
    block = job[_BLOCK]
    warp = context[_WARP] >> 32
    warp_epoch = context[_WARP_EPOCH]
    passed = 0
    for lane in range(32):
        if not (bits >> lane) & 1:
            continue
        address = addresses[lane] + displacement
        offset = address - shared
        in_shared = may_be_shared == 1 or (may_be_shared == 2 and 0 <= offset < shared_bytes)
        place = offset if in_shared else address
        if place % width:
            _report(data, _MISALIGNED, site, np.int64(-1), block, place)
            continue
        if in_shared:
            if offset < 0 or offset + width > shared_bytes:
                _report(data, _OUTSIDE, site, np.int64(-1), block, place)
                continue
            stored = np.int64(0)
            if kind == _STORE:
                # The place belongs to it: equal vectors that overlap by half do not store the same.
                stored = stored_values[lane] ^ (offset << 44)
            _look_at_shared(data, job, offset, width, kind, site, warp, first_lane + lane, warp_epoch, stored)
        elif not _inside(data, address, width):
            _report(data, _OUTSIDE, site, np.int64(-1), block, place)
            continue
        passed |= 1 << lane
    return np.int32(np.uint32(passed))


class Checker:
    """The checker's memory for one launch. allocations: arrays that the kernel may touch; others are ignored."""

    def __init__(self, facts: _Description, job: _Job, allocations: Sequence[Any], seed: int) -> None:
        self._facts, self._job = facts, job
        ranges = [(a.ctypes.data, a.ctypes.data + a.nbytes) for a in allocations if _is_memory(a)]
        ranges += [(a.ctypes.data, a.ctypes.data + a.nbytes) for a in job.variables]
        ranges.append((job.get("local"), job.get("local_end")))
        ranges.append((job.params.ctypes.data, job.params.ctypes.data + facts.param_bytes))
        shift = max(facts.shared_granule.bit_length() - 1, 0)
        granules = (job.shared_bytes >> shift) + 1
        ranges_at = _HEADER
        sites_at = ranges_at + 2 * len(ranges)
        shadow_at = sites_at + _SITE_WORDS * len(facts.sites)
        findings_at = shadow_at + _SHADOW_WORDS * granules
        self.data = data = np.zeros(findings_at + _FINDING_WORDS * _FINDINGS, np.int64)
        header = (ranges_at, len(ranges), sites_at, shadow_at, shift, findings_at, 0, 0)
        data[:_HEADER] = header
        data[ranges_at:sites_at] = np.array(ranges, np.int64).ravel()
        for number, site in enumerate(facts.sites):
            shared = {"shared": 1, "generic": 2}.get(site.space, 0)
            data[sites_at + _SITE_WORDS * number :][:_SITE_WORDS] = _KINDS.index(site.kind), site.width, shared
        data[shadow_at:findings_at].reshape(granules, _SHADOW_WORDS)[:, 1::_SLOT_WORDS] = -1
        job.set("check", _check.address)
        job.set("check_data", data.ctypes.data)
        # The generator must not start at zero; neighbouring seeds should start far apart.
        job.set("random", int(np.random.default_rng(seed).integers(1, 2**63)))

    def findings(self, kernel: str) -> list[Finding]:
        data, facts = self.data, self._facts
        at, count = int(data[_FINDINGS_AT]), int(data[_FINDING_COUNT])
        found = []
        for row in data[at : at + count * _FINDING_WORDS].reshape(count, _FINDING_WORDS).tolist():
            found.append(self._finding(kernel, *row))
        merged: dict[tuple, Finding] = {}
        for finding in found:  # several instructions may stand on one line
            key = (finding.kind, finding.line, finding.other_line)
            if key in merged:
                finding = Finding(
                    finding.kind,
                    kernel,
                    merged[key].message,
                    finding.line,
                    finding.other_line,
                    finding.count + merged[key].count,
                )
            merged[key] = finding
        stranded = self._job.get("stranded")
        result = list(merged.values())
        if stranded:
            line = self._line_at(facts.segments[self._job.get("stranded_segment")][1] - 1)
            message = f"{kernel}: warps end while others of their thread block wait at the barrier in {_place(line)}"
            result.append(Finding("divergent-barrier", kernel, message, line, None, stranded))
        return result

    def _line_at(self, instruction: int) -> SourceLine | None:
        line = self._facts.lines[instruction]
        return SourceLine(*line) if line else None

    def _finding(self, kernel: str, kind: int, site: int, other: int, count: int, block: int, address: int) -> Finding:
        facts = self._facts
        what = facts.sites[site]
        line = self._line_at(what.index)
        other_line = self._line_at(facts.sites[other].index) if other >= 0 else None
        here = f"{what.kind} in {_place(line)}"
        there = f"{facts.sites[other].kind} in {_place(other_line)}" if other >= 0 else ""
        in_shared = what.space == "shared" or 0 <= address < self._job.shared_bytes
        byte = f"shared byte {address}" if in_shared else f"address {address:#x}"
        where = f"({byte}, thread block {block})"
        name, text = {
            _RACE: ("race", f"{here} and {there} by different warps without a barrier between them"),
            _HAZARD: ("race", f"{here} and {there} by different lanes of a warp without a barrier between them"),
            _CLASH: ("race", f"{here} by several lanes of a warp at one address"),
            _UNINITIALISED: ("uninitialised", f"{here} reads shared memory that was never written"),
            _OUTSIDE: ("out-of-bounds", f"{here}, {what.width} bytes, outside every array"),
            _MISALIGNED: ("misaligned", f"{here}: the address is no multiple of {what.width}"),
        }[kind]
        return Finding(name, kernel, f"{kernel}: {text} {where}", line, other_line, count)


def _place(line: SourceLine | None) -> str:
    return f"{line.file}:{line.line}" if line else "an unknown line"


def _is_memory(argument: Any) -> bool:
    return isinstance(argument, np.ndarray) and argument.ndim > 0
