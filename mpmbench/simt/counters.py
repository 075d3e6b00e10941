"""What the engine counts, per launch and per source line. All counts are exact; none is an estimate."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import NamedTuple


class SourceLine(NamedTuple):
    """A line of the CUDA source (the innermost one where functions were inlined)."""

    file: str
    line: int


@dataclass
class Tally:
    """The counts themselves. A *request* is one warp-level memory instruction with at least one active lane."""

    warp_inst: int = 0  # PTX instructions issued per warp
    lane_inst: int = 0  # the same, each times the lanes in the active mask
    branch: int = 0  # conditional branches executed by a warp
    div_branch: int = 0  # of these, with both outcomes among the active lanes
    gld_req: int = 0  # global load requests
    gld_sectors: int = 0  # distinct 32-byte sectors per global load request, summed
    gst_req: int = 0  # global store requests
    gst_sectors: int = 0
    gatom_req: int = 0  # global atomic and reduction requests
    gatom_lane: int = 0  # their active lanes
    gatom_sectors: int = 0  # distinct sectors per global atomic request, summed
    gatom_pass: int = 0  # per request: over its distinct sectors, the largest same-word multiplicity, summed
    sld_req: int = 0  # shared load requests
    sst_req: int = 0  # shared store requests
    shm_wavefronts: int = 0  # of shared loads and stores: 4 B lanes in 1 group, 8 B in 2, 16 B in 4 groups of
    # 8 lanes; per group the largest number of distinct words that fall in one of the 32 banks
    satom_req: int = 0  # shared atomic requests
    satom_lane: int = 0
    satom_iter: int = 0  # largest same-word multiplicity per request, summed (trips of a CAS loop)
    satom_wavefronts: int = 0  # of those trips, each of the lanes that still want their word: as shm_wavefronts
    lld_req: int = 0  # local-memory (per-thread array) load requests
    lst_req: int = 0
    bar: int = 0  # block-barrier arrivals, per warp
    bar_warp: int = 0  # warp-barrier (bar.warp.sync) executions, per warp

    def __add__(self, other: Tally) -> Tally:
        return Tally(**{f.name: getattr(self, f.name) + getattr(other, f.name) for f in fields(self)})

    @property
    def sectors(self) -> int:
        """All global sectors moved between SM and L2: loads, stores and atomics."""
        return self.gld_sectors + self.gst_sectors + self.gatom_sectors


@dataclass
class Counters:
    """The tally of a launch, in total and by source line; the lines add up to the total."""

    total: Tally = field(default_factory=Tally)
    lines: dict[SourceLine, Tally] = field(default_factory=dict)

    def __add__(self, other: Counters) -> Counters:
        lines = dict(self.lines)
        for line, tally in other.lines.items():
            lines[line] = lines[line] + tally if line in lines else tally
        return Counters(self.total + other.total, lines)


# How grave a finding is. INFO: the outcome is the same, whoever comes last.
ERROR, WARNING, INFO = "ERROR", "WARNING", "INFO"


@dataclass(frozen=True)
class Finding:
    """A defect that the engine saw while it ran a kernel.

    kind: race, global-race, atomic-mix, equal-stores, uninitialised, out-of-bounds, misaligned, divergent-barrier,
    bad-mask, runaway, trap.
    """

    kind: str
    kernel: str
    message: str  # one line, ready to print
    line: SourceLine | None = None
    other_line: SourceLine | None = None
    count: int = 1
    severity: str = ERROR
    threads: str = ""  # threads and blocks of the first occurrence
    place: str = ""  # array and offset, or address space and offset, of the first occurrence
