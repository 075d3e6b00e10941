"""Memory of a launch for the NumPy executor: host arrays by their real addresses, checked, and counted by request."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from mpmbench.errors import InputError
from mpmbench.simt.counters import Tally
from mpmbench.simt.ptx import Module

Array = np.ndarray

SECTOR_BYTES = 32
BANKS = 32


class FaultError(Exception):
    """An access that a GPU would refuse; ends the launch. kind: as in Finding."""

    def __init__(self, kind: str, message: str) -> None:
        super().__init__(message)
        self.kind = kind


@dataclass(frozen=True)
class Piece:
    """The lanes of a request (``lanes``, numbers) that fall in one allocation, at byte ``offsets`` of ``data``."""

    space: str
    data: Array
    lanes: Array
    offsets: Array

    def cells(self, size: int) -> Array:
        """Indices into ``data``, one row of ``size`` bytes per lane."""
        return self.offsets[:, None] + np.arange(size)


def module_variables(module: Module) -> dict[str, Array]:
    """Fresh storage of a module's ``.global`` and ``.const`` variables; hand it to several runs to keep their state."""
    storage = {}
    for name, variable in module.variables.items():
        room = np.zeros(variable.size + 256, dtype=np.uint8)
        start = -room.ctypes.data % 256
        storage[name] = room[start : start + variable.size]
        storage[name][:] = np.frombuffer(variable.initial[: variable.size], dtype=np.uint8)
    return storage


class Memory:
    """All allocations a launch may touch. Addresses are the host's own, so generic addressing needs no tags."""

    def __init__(self, allocations: Iterable[tuple[str, Array]]) -> None:
        """allocations: (space, array); overlapping global arrays, such as views of one buffer, become one."""
        spans: list[tuple[int, int, str]] = []
        self._keep = list(allocations)
        wanted = [(a.ctypes.data, a.ctypes.data + a.nbytes, space) for space, a in self._keep if a.nbytes]
        for start, stop, space in sorted(wanted):
            if spans and start < spans[-1][1] and space == spans[-1][2]:
                spans[-1] = (spans[-1][0], max(stop, spans[-1][1]), space)
            else:
                spans.append((start, stop, space))
        self.starts = np.array([s for s, _, _ in spans], dtype=np.uint64)
        self.stops = np.array([s for _, s, _ in spans], dtype=np.uint64)
        self.spaces = [space for _, _, space in spans]
        self.data = [
            np.ctypeslib.as_array((ctypes.c_uint8 * (stop - start)).from_address(start)) for start, stop, _ in spans
        ]

    def locate(self, addresses: Array, active: Array, size: int, space: str) -> list[Piece]:
        """Split a request of ``size`` bytes per lane by allocation. space: where it must lie, "" for anywhere."""
        lanes = np.flatnonzero(active)
        at = addresses[lanes]
        if not len(lanes):
            return []
        if (at % np.uint64(size)).any():
            raise FaultError("misaligned", f"{size}-byte access of address {int(at[at % np.uint64(size) != 0][0]):#x}")
        which = np.searchsorted(self.starts, at, side="right") - 1
        inside = (which >= 0) & (at < self.stops[which]) & (self.stops[which] - at >= np.uint64(size))
        if not inside.all():
            lane = int(np.flatnonzero(~inside)[0])
            raise FaultError(
                "out-of-bounds", f"{size}-byte access of address {int(at[lane]):#x} by lane {int(lanes[lane])}"
            )
        pieces = []
        for number in np.unique(which):
            here = which == number
            if space and self.spaces[number] != space:
                raise FaultError("out-of-bounds", f"{space} access of address {int(at[here][0]):#x}")
            offsets = (at[here] - self.starts[number]).astype(np.int64)
            pieces.append(Piece(self.spaces[number], self.data[number], lanes[here], offsets))
        return pieces


def load(pieces: list[Piece], dtype: np.dtype, count: int) -> Array:
    """-> (32, count) values, zero on lanes that are off."""
    values = np.zeros((32, count), dtype=dtype)
    for piece in pieces:
        values[piece.lanes] = piece.data[piece.cells(dtype.itemsize * count)].view(dtype)
    return values


def store(pieces: list[Piece], values: Array) -> None:
    """values: (32, count). Of lanes that write to one address the highest wins."""
    size = values.shape[1] * values.dtype.itemsize
    octets = np.ascontiguousarray(values).view(np.uint8)
    for piece in pieces:
        piece.data[piece.cells(size)] = octets[piece.lanes]


def atomic(pieces: list[Piece], dtype: np.dtype, count: int, change: Callable[[Array, Array, str], Array]) -> Array:
    """Read-modify-write in the order of lanes. change(old (n, count), lane numbers, space) -> new; -> old, (32, count).

    Lanes with different addresses do not see each other, so the k-th lanes of all addresses go together.
    """
    before = np.zeros((32, count), dtype=dtype)
    for piece in pieces:
        order = np.argsort(piece.offsets, kind="stable")
        ordered = piece.offsets[order]
        first = np.searchsorted(ordered, ordered, side="left")
        turn = np.empty(len(order), dtype=np.int64)
        turn[order] = np.arange(len(order)) - first
        cells = piece.cells(dtype.itemsize * count)
        for now in range(turn.max() + 1):
            chosen = turn == now
            old = piece.data[cells[chosen]].view(dtype)
            before[piece.lanes[chosen]] = old
            new = change(old, piece.lanes[chosen], piece.space).astype(dtype)
            piece.data[cells[chosen]] = np.ascontiguousarray(new).view(np.uint8)
    return before


# --- counting ---------------------------------------------------------------------------------------------------------


def count_load(tally: Tally, pieces: list[Piece], size: int, is_generic: bool) -> None:
    """Constant memory has a path of its own, but not by generic addresses."""
    for space, at, lanes in _by_space(pieces, is_generic):
        if space == "global":
            tally.gld_req += 1
            tally.gld_sectors += _sectors(at)
        elif space == "shared":
            tally.sld_req += 1
            tally.shm_wavefronts += _wavefronts(at, lanes, size)
        elif space == "local":
            tally.lld_req += 1


def count_store(tally: Tally, pieces: list[Piece], size: int) -> None:
    for space, at, lanes in _by_space(pieces):
        if space == "global":
            tally.gst_req += 1
            tally.gst_sectors += _sectors(at)
        elif space == "shared":
            tally.sst_req += 1
            tally.shm_wavefronts += _wavefronts(at, lanes, size)
        elif space == "local":
            tally.lst_req += 1


def count_atomic(tally: Tally, pieces: list[Piece], size: int) -> None:
    for space, at, lanes in _by_space(pieces):
        words, times = np.unique(at, return_counts=True)
        if space == "global":
            tally.gatom_req += 1
            tally.gatom_lane += len(at)
            sectors = words // SECTOR_BYTES
            tally.gatom_sectors += len(np.unique(sectors))
            tally.gatom_pass += sum(int(times[sectors == s].max()) for s in np.unique(sectors))
        elif space == "shared":
            tally.satom_req += 1
            tally.satom_lane += len(at)
            words = at // max(4, size)  # half words take turns at the word that they share
            turns = np.array([np.count_nonzero(words[:i] == words[i]) for i in range(len(at))])
            tally.satom_iter += int(turns.max()) + 1
            for turn in range(int(turns.max()) + 1):
                tally.satom_wavefronts += _wavefronts(at[turns >= turn], lanes[turns >= turn], size)


def _by_space(pieces: list[Piece], const_is_global: bool = False) -> Iterable[tuple[str, Array, Array]]:
    """-> space, byte positions, lane numbers. Positions are addresses (global) or offsets from a bank-0 byte."""
    sorted_by: dict[str, list[Piece]] = {}
    for piece in pieces:
        space = "global" if const_is_global and piece.space == "const" else piece.space
        sorted_by.setdefault(space, []).append(piece)
    for space, mine in sorted(sorted_by.items()):
        bases = [piece.data.ctypes.data if space == "global" else 0 for piece in mine]
        at = np.concatenate([piece.offsets + base for piece, base in zip(mine, bases, strict=True)])
        yield space, at, np.concatenate([piece.lanes for piece in mine])


def _sectors(at: Array) -> int:
    """Distinct 32-byte sectors; an aligned access of up to 16 bytes lies in one."""
    return len(np.unique(at // SECTOR_BYTES))


def _wavefronts(at: Array, lanes: Array, size: int) -> int:
    """Passes through the 32 banks: 4-byte (and smaller) lanes in one group, 8-byte in 2, 16-byte in 4 groups."""
    lanes_per_group = 32 // max(1, size // 4)
    passes = 0
    for group in np.unique(lanes // lanes_per_group):
        first = at[lanes // lanes_per_group == group] // 4
        words = np.unique(first[:, None] + np.arange(max(1, size // 4)))
        passes += int(np.bincount(words % BANKS).max())
    return passes


# --- kernel arguments -------------------------------------------------------------------------------------------------


def argument_bytes(argument: object, size: int, name: str) -> bytes:
    """What a kernel parameter of ``size`` bytes holds: an array's address, or a scalar or structure itself."""
    if isinstance(argument, np.ndarray):
        if not argument.flags.c_contiguous:
            raise InputError(f"argument {name}: the array is not C-contiguous; pass np.ascontiguousarray(...)")
        raw = int(argument.ctypes.data).to_bytes(8, "little")
    elif isinstance(argument, np.generic):
        raw = argument.tobytes()
    else:
        raise InputError(f"argument {name}: {type(argument).__name__} is neither a NumPy array nor a NumPy scalar")
    if len(raw) != size:
        raise InputError(f"argument {name}: {len(raw)} bytes given, the kernel takes {size}")
    return raw
