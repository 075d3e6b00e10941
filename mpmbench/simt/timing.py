"""How long a warp takes for its own instructions: an in-order scoreboard, segment by segment.

A warp issues one instruction per cycle and stalls where an operand is not ready. Global loads count as ready at once:
whoever replays the requests adds what the warp waits for memory, at the cycle where the first instruction uses the
value, or at the segment's end where a later one does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mpmbench.simt.codegen_memory import Site
from mpmbench.simt.codegen_trace import CAS_PASSES
from mpmbench.simt.machine import Machine
from mpmbench.simt.ptx import Address, Instruction, Kernel, Reg
from mpmbench.simt.scheduler import ISSUE_UNITS

NEVER = -1

# PTX that costs a warp no cycle of its own: renamed registers, parameters that operands read in place.
_FREE = frozenset({"mov", "cvta"})

# Sequences of machine instructions: how many dependent steps an exact operation takes (division and roots by Newton).
_STEPS = {"div": 9, "rem": 14, "sqrt": 8, "rcp": 6, "rsqrt": 2, "sin": 2, "cos": 2, "ex2": 2, "lg2": 2}


@dataclass(frozen=True)
class TimingTables:
    """Cycles, int64. segments: of every segment, its cycles and what it takes of the issue slots in ISSUE_UNITS.
    issue: of every site, from its segment's start. use: where the value that it fetches is needed first, NEVER where
    nothing waits for it."""

    segments: np.ndarray
    issue: np.ndarray
    use: np.ndarray


def cas_trip_cycles(machine: Machine) -> int:
    """One trip of the loop behind a float atomic in shared memory."""
    return CAS_PASSES * machine.shared_latency + machine.alu_latency


def timing_tables(
    kernel: Kernel, segments: Sequence[tuple[int, int]], sites: Sequence[Site], machine: Machine
) -> TimingTables:
    """Tables for every segment and memory site of a kernel."""
    tables = TimingTables(
        np.zeros((max(1, len(segments)), 2), np.int64),
        np.zeros(max(1, len(sites)), np.int64),
        np.full(max(1, len(sites)), NEVER, np.int64),
    )
    site_at = {site.index: number for number, site in enumerate(sites) if site.space in ("global", "generic")}
    read = {reg for item in kernel.instructions for reg in item.reads()}
    for number, (start, stop) in enumerate(segments):
        _run_segment(kernel.instructions, start, stop, site_at, read, machine, tables, number)
    return tables


def _run_segment(
    instructions: Sequence[Instruction],
    start: int,
    stop: int,
    site_at: dict[int, int],
    read: set[Reg],
    machine: Machine,
    tables: TimingTables,
    number: int,
) -> None:
    ready: dict[Reg, int] = {}
    loaded_by: dict[Reg, int] = {}  # register -> site that fetches it, until its first use
    now = 0
    for index in range(start, stop):
        item = instructions[index]
        issue = now
        for reg in item.reads():
            issue = max(issue, ready.get(reg, 0))
        for reg in item.reads():
            if (site := loaded_by.pop(reg, None)) is not None and tables.use[site] == NEVER:
                tables.use[site] = issue
        site = site_at.get(index)
        if site is not None:
            tables.issue[site] = issue
            for reg in item.writes():
                if reg in read:
                    loaded_by[reg] = site
                    ready[reg] = issue
            now = issue + 1
            continue
        busy, latency = _cost(item, machine)
        now = issue + busy
        for reg in item.writes():
            ready[reg] = issue + latency
            loaded_by.pop(reg, None)
    for site in loaded_by.values():
        if tables.use[site] == NEVER:
            tables.use[site] = now
    slots = sum(machine.issue_cycles(item) for item in instructions[start:stop])
    tables.segments[number] = max(now, 1), round(slots * ISSUE_UNITS)


def _cost(item: Instruction, machine: Machine) -> tuple[int, int]:
    """-> (cycles until the warp may issue its next instruction, cycles until the result is ready)."""
    root, modifiers = item.root, item.modifiers
    alu = machine.alu_latency
    if root in _FREE or (root == "ld" and "param" in modifiers and _is_plain(item)):
        return 0, 0
    if root in ("bar", "barrier"):
        cycles = alu if "warp" in modifiers else machine.barrier_latency
        return cycles, cycles
    if root in ("atom", "red") and "shared" in modifiers and modifiers[-1] in ("f32", "f64"):
        return (cycles := cas_trip_cycles(machine)), cycles
    if root in ("ld", "atom", "shfl", "vote", "match", "redux"):
        return 1, machine.shared_latency
    if root in ("bra", "brx"):
        return alu, alu
    if root in _STEPS and "approx" not in modifiers:
        return _STEPS[root], _STEPS[root] * alu
    if modifiers and modifiers[-1] == "f64":
        return 1, 2 * alu
    return 1, alu


def _is_plain(item: Instruction) -> bool:
    return any(isinstance(operand, Address) and not isinstance(operand.base, Reg) for operand in item.srcs)
