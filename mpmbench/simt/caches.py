"""The caches and the DRAM of profile mode, compiled: sectored lines, least recently used line first out, open rows.

A cache is four arrays: tags (16 lines a set, one host cache line), order (per set, its lines from the most to the least
recently used, four bits each), and per line the bits of its sectors: valid below, dirty above. Sets are picked by hash.
"""

from __future__ import annotations

from dataclasses import fields

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from mpmbench.simt.compiled import inlined
from mpmbench.simt.machine import MemoryTally

WAYS = 16
LINE_BYTES = 128
IN_ORDER = np.uint64(0xFEDCBA9876543210)

_HASH = np.uint64(0x9E3779B97F4A7C15)
_U4, _U32, _U60 = np.uint64(4), np.uint64(32), np.uint64(60)
_ONE, _ZERO, _ALL = np.uint64(1), np.uint64(0), np.uint64(0xFFFFFFFFFFFFFFFF)
_EACH, _TOP = np.uint64(0x1111111111111111), np.uint64(0x8888888888888888)


@intrinsic
def _trailing_zeros(typing_context, value):
    def generate(target_context, builder, signature, arguments):
        return builder.cttz(arguments[0], ir.Constant(ir.IntType(1), 0))

    return types.uint64(types.uint64), generate


@inlined
def pick(key, places):
    """A place by hash of a number."""
    return np.int64((((np.uint64(key) * _HASH) >> _U32) * np.uint64(places)) >> _U32)


@inlined
def find_line(tags, order, chosen, tag):
    """-> (line, whether it holds the tag) in a set; it counts as used now. A line that does not is the one to evict."""
    first = chosen * WAYS
    way: np.int32 | np.int64 = np.int32(-1)
    sought = np.int32(tag)
    for number in range(WAYS):  # no early end: sixteen compares at once
        way = max(way, np.int32(number) if tags[first + number] == sought else np.int32(-1))
    word = order[chosen]
    found = way >= 0
    shift = _U60
    if found:
        # The place of a way in the order is the lowest four bits that differ from it in nothing.
        differs = word ^ (np.uint64(way) * _EACH)
        shift = _trailing_zeros((differs - _EACH) & ~differs & _TOP) & np.uint64(0x3C)  # type: ignore[call-arg]
    else:
        way = np.int64(word >> _U60)
    before = word & ((_ONE << shift) - _ONE)
    after = (word >> shift >> _U4) << shift << _U4
    order[chosen] = after | (before << _U4) | np.uint64(way)
    return first + way, found


@inlined
def l1_access(tags, order, bits, sets, unit, sector):
    """-> whether L1 number ``unit`` held the sector; from now on it does."""
    tag, bit = sector >> 2, np.uint8(1 << (sector & 3))
    at, found = find_line(tags, order, unit * sets + pick(tag, sets), tag)
    if not found:
        tags[at] = tag
        bits[at] = bit
        return False
    hit = (bits[at] & bit) != 0
    bits[at] |= bit
    return hit


# --- L2 and DRAM ------------------------------------------------------------------------------------------------------

# Columns of a site's tally, as MemoryTally has them.
TALLY = tuple(field.name for field in fields(MemoryTally))
L2_HIT, L2_MISS, DRAM_READ, DRAM_WRITE, ACTIVATIONS = (
    TALLY.index(name) for name in ("l2_hit", "l2_miss", "dram_read", "dram_write", "dram_activations")
)

# What an access to L2 does: fetch a sector, fill it, write a part of it, add to it.
FETCH, FILL, PART, ADD = range(4)


@inlined
def transfer(open_rows, channels, banks, row_pieces, tallies, site, sector):
    """One sector between L2 and DRAM: 256-byte pieces go to channels by a hash, rows to a channel's banks by another.

    row_pieces: pieces in one row of all channels together.
    """
    piece = sector >> 3
    row = piece // row_pieces
    at = pick(piece, channels) * banks + pick(row, banks)
    if open_rows[at] != row:
        open_rows[at] = row
        tallies[site, ACTIVATIONS] += 1


@inlined
def write_back(open_rows, channels, banks, row_pieces, tallies, site, tag, dirty):
    """The dirty sectors of a line go to DRAM, charged to the site that wrote last."""
    for part in range(4):
        if (dirty >> part) & 1:
            tallies[site, DRAM_WRITE] += 1
            transfer(open_rows, channels, banks, row_pieces, tallies, site, (np.int64(tag) << 2) + part)


@inlined
def l2_access(tags, order, bits, writers, sets, open_rows, channels, banks, row_pieces, tallies, site, sector, action):
    """-> whether L2 held what the access needs."""
    tag, part = sector >> 2, sector & 3
    valid, dirty = np.uint8(1 << part), np.uint8(16 << part)
    at, found = find_line(tags, order, pick(tag, sets), tag)
    if not found:
        if bits[at] >> 4:
            write_back(open_rows, channels, banks, row_pieces, tallies, writers[at], tags[at], bits[at] >> 4)
        tags[at] = tag
        bits[at] = 0
    has = bits[at]
    if action == FILL:
        hit = True
        has |= valid
    elif action == PART:
        hit = (has & (valid | dirty)) != 0
    else:
        hit = (has & valid) != 0
        if not hit:
            tallies[site, DRAM_READ] += 1
            transfer(open_rows, channels, banks, row_pieces, tallies, site, sector)
            has |= valid
    if action != FETCH:
        has |= dirty
        writers[at] = site
    bits[at] = has
    if hit:
        tallies[site, L2_HIT] += 1
    else:
        tallies[site, L2_MISS] += 1
    return hit
