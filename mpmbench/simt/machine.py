"""What profile mode is told of a GPU, and what it counts in that GPU's memory system. Knows nothing of any one GPU."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields

from mpmbench.simt.counters import SourceLine
from mpmbench.simt.ptx import Instruction


@dataclass(frozen=True)
class Machine:
    """A GPU as the memory system sees it. Sizes in bytes, latencies in SM clock cycles."""

    sms: int
    blocks_per_sm: int  # thread blocks of this kernel that one SM holds at a time
    l1_bytes: int  # of one L1 or texture cache
    l1_per_sm: int
    l1_holds_plain_loads: bool  # or those of the read-only path (ld.global.nc) alone
    l2_bytes: int
    dram_channels: int
    dram_banks: int  # per channel
    dram_row_bytes: int  # of one bank
    alu_latency: int
    shared_latency: int
    l1_latency: int
    l2_latency: int
    dram_latency: int
    barrier_latency: int
    block_start: int = 0  # cycles between the end of a thread block and the start of the next one in its place
    # What a warp takes of its SM's issue slots for a PTX instruction [cycles]; a quarter if four warps issue at once.
    issue_cycles: Callable[[Instruction], float] = lambda instruction: 0.25
    cas_issue_cycles: float = 1.25  # the same for one round of a float atomic in shared memory


@dataclass
class MemoryTally:
    """Counts of the modelled caches and DRAM, in 32-byte sectors unless said otherwise."""

    l1_hit: int = 0  # load sectors found in L1
    l1_miss: int = 0  # load sectors asked of L2; all of them where L1 does not hold them
    l2_hit: int = 0  # sectors found in L2; a store that fills its sector counts as a hit
    l2_miss: int = 0
    dram_read: int = 0  # sectors fetched from DRAM
    dram_write: int = 0  # dirty sectors written back, those still dirty at the end included; charged to the last writer
    dram_activations: int = 0  # transfers to a (channel, bank) whose open row is another
    l1_request_bytes: int = 0  # what load requests ask of L1: active lanes x bytes per lane
    atomic_lanes: int = 0  # lanes of global atomics
    atomic_sectors: int = 0  # sectors that their requests touch, at L2

    def __add__(self, other: MemoryTally) -> MemoryTally:
        return MemoryTally(**{f.name: getattr(self, f.name) + getattr(other, f.name) for f in fields(self)})

    @property
    def l2_sectors(self) -> int:
        return self.l2_hit + self.l2_miss

    @property
    def dram_sectors(self) -> int:
        return self.dram_read + self.dram_write


@dataclass
class MemoryCounters:
    """The memory system of one launch, in total and by source line; the lines add up to the total."""

    total: MemoryTally = field(default_factory=MemoryTally)
    lines: dict[SourceLine, MemoryTally] = field(default_factory=dict)
    hot_address: int = 0  # atomics on the word that got most of them
    latency_cycles: int = 0  # end of the last warp if nothing but latencies and barriers took time
    warp_cycles: int = 0  # the same, summed over warps
    barrier_wait_cycles: int = 0  # of these, cycles that warps spent waiting for others at block barriers,
    l1_wait_cycles: int = 0  # for values from L1,
    l2_wait_cycles: int = 0  # from L2
    dram_wait_cycles: int = 0  # and from DRAM
    resident_warps: int = 0  # most warps that were resident at a time, whole GPU
