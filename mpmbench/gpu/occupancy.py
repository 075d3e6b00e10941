"""How many thread blocks of a kernel one SM can hold, and what limits it.

Rules of NVIDIA's occupancy calculator: registers are given out per warp in units of 256, warps in groups of four
(one per scheduler); shared memory in units of the GPU's granularity, after what it reserves per thread block.
"""

from __future__ import annotations

from dataclasses import dataclass

from mpmbench.gpu import Gpu

WARP = 32
REGISTER_UNIT = 256  # registers, per warp
WARP_UNIT = 4  # warps that share out the register file


@dataclass(frozen=True)
class Occupancy:
    """blocks, warps: resident per SM.  limiter: "warps", "blocks", "registers" or "shared memory"."""

    blocks: int
    warps: int
    limiter: str


def occupancy(gpu: Gpu, threads: int, registers: int, shared_bytes: int) -> Occupancy:
    """Residency of thread blocks of ``threads`` threads, ``registers`` per thread, ``shared_bytes`` per block."""
    warps = -(-threads // WARP)
    limits = {
        "warps": int(gpu["warps_per_sm"]) // warps,
        "blocks": int(gpu["blocks_per_sm"]),
        "registers": _by_registers(gpu, warps, registers),
        "shared memory": _by_shared(gpu, shared_bytes),
    }
    limiter = min(limits, key=lambda name: limits[name])
    return Occupancy(limits[limiter], limits[limiter] * warps, limiter)


def shared_bytes_of_block(gpu: Gpu, shared_bytes: int) -> int:
    """What one thread block takes of an SM's shared memory [bytes], rounding and the system's share included."""
    reserved = int(gpu["shared_reserved_bytes_per_block"])
    return _round_up(shared_bytes + reserved, int(gpu["shared_granularity_bytes"]))


def _by_registers(gpu: Gpu, warps: int, registers: int) -> int:
    per_warp = _round_up(max(registers, 1) * WARP, REGISTER_UNIT)
    resident = int(gpu["registers_per_sm"]) // per_warp // WARP_UNIT * WARP_UNIT
    return resident // warps


def _by_shared(gpu: Gpu, shared_bytes: int) -> int:
    if shared_bytes > gpu["shared_bytes_per_block"]:
        return 0
    per_block = shared_bytes_of_block(gpu, shared_bytes)
    return int(gpu["shared_bytes_per_sm"]) // per_block if per_block else int(gpu["blocks_per_sm"])


def _round_up(value: int, unit: int) -> int:
    return -(-value // unit) * unit
