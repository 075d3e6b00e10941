"""Profile: what the performance model says of one record on one named GPU, and the counts that it says it from.

Everything here depends on the description of that GPU, its caches and DRAM included: none of it was measured, and none
of it is an exact count of the kernel, as ``Counters`` are.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from mpmbench.gpu.modelled import ModelledTime
from mpmbench.simt.counters import SourceLine
from mpmbench.simt.machine import MemoryTally

# Metrics of thesis table 2, by key: as it prints them, and what they mean here. Percentages are 0 to 100.
METRICS = {
    "vram_percent": ("VRAM SOL%", "DRAM bytes per second over the GPU's limit"),
    "sm_percent": ("SM SOL%", "instructions issued per second over the GPU's limit"),
    "l2_percent": ("L2 SOL%", "L2 bytes per second over the GPU's limit"),
    "tex_percent": ("Tex SOL%", "L1 / texture bytes per second over the GPU's limit"),
    "l2_hit_percent": ("L2-Hitrate%", "sectors found in L2 over all sectors asked of it"),
    "sm_issue_percent": ("SM Issue Util.%", "cycles in which a scheduler issued an instruction"),
    "sm_occupancy_warps": ("SM Occupancy", "resident warps per SM, mean over the run"),
    "read_percent": ("Read Active%", "share of the time that DRAM spends on reads"),
    "write_percent": ("Write Active%", "share of the time that DRAM spends on writes"),
}

# Peak rates that the percentages and the instruction roofline refer to, per second.
PEAKS = ("warp_inst", "l1_bytes", "l2_bytes", "dram_bytes")


@dataclass(frozen=True)
class Residency:
    """What one SM holds at a time. limiter: "warps", "blocks", "registers" or "shared memory"."""

    warps: int
    blocks: int
    limiter: str
    max_warps: int  # of an SM of this GPU


@dataclass(frozen=True)
class LineProfile:
    """One source line. share: of the term that binds, 0 to 1."""

    warp_inst: int = 0
    dram_sectors: int = 0
    l2_sectors: int = 0
    share: float = 0.0


@dataclass(frozen=True)
class Profile:
    """One record on one GPU.

    time: of the transfer alone.  steps: of each step before and after it, by the record's names for them.
    metrics: by the keys of METRICS.  peak: by the keys of PEAKS.  hot_address: atomics on the word that got most.
    warp_cycles: life of all warps if latencies and barriers alone took time; barrier_wait_cycles: waiting, of these.
    """

    gpu: str  # name of its description: "gtx970"
    title: str  # what its vendor calls it
    time: ModelledTime
    occupancy: Residency
    memory: MemoryTally
    steps: Mapping[str, ModelledTime] = field(default_factory=dict)
    hot_address: int = 0
    latency_cycles: int = 0
    warp_cycles: int = 0
    barrier_wait_cycles: int = 0
    metrics: Mapping[str, float] = field(default_factory=dict)
    lines: Mapping[SourceLine, LineProfile] = field(default_factory=dict)
    peak: Mapping[str, float] = field(default_factory=dict)


def to_plain(profile: Profile) -> dict[str, Any]:
    """Nested dicts and lists; lines become [file, line, counts]."""
    lines = [[line.file, line.line, asdict(counts)] for line, counts in profile.lines.items()]
    return {**asdict(_without_lines(profile)), "lines": lines}


def from_plain(plain: Mapping[str, Any]) -> Profile:
    """Inverse of ``to_plain``. Raises KeyError or TypeError for what is no profile."""
    return Profile(**{
        **plain,
        "time": ModelledTime(**plain["time"]),
        "occupancy": Residency(**plain["occupancy"]),
        "memory": MemoryTally(**plain["memory"]),
        "steps": {name: ModelledTime(**time) for name, time in plain["steps"].items()},
        "lines": {SourceLine(file, line): LineProfile(**counts) for file, line, counts in plain["lines"]},
    })  # fmt: skip


def _without_lines(profile: Profile) -> Profile:
    """``asdict`` would copy the lines with their keys, which JSON cannot hold."""
    return Profile(**{**vars(profile), "lines": {}})
