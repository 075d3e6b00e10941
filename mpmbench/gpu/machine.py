"""A GPU description as the simulated memory system takes it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from mpmbench.device import KernelInfo
from mpmbench.errors import InputError
from mpmbench.gpu import Gpu
from mpmbench.gpu.occupancy import occupancy, shared_bytes_of_block
from mpmbench.gpu.sass import CAS_TRIP, instruction_weight
from mpmbench.simt.machine import Machine
from mpmbench.simt.ptx import Instruction

KIB = 1024
# Shared memory is carved out of L1 in one of these sizes [KiB]: CUDA C++ Programming Guide, one section per compute
# capability. Where an architecture is missing, as Maxwell and Pascal are, the two are separate memories.
CARVE_OUTS = {
    "sm_70": (0, 8, 16, 32, 64, 96),
    "sm_75": (32, 64),
    "sm_80": (0, 8, 16, 32, 64, 100, 132, 164),
    "sm_86": (0, 8, 16, 32, 64, 100),
    "sm_87": (0, 8, 16, 32, 64, 100, 132, 164),
    "sm_89": (0, 8, 16, 32, 64, 100),
    "sm_90": (0, 8, 16, 32, 64, 100, 132, 164, 196, 228),
    "sm_100": (0, 8, 16, 32, 64, 100, 132, 164, 196, 228),
    "sm_120": (0, 8, 16, 32, 64, 100),
}


def machine_of(gpu: Gpu, blocks_per_sm: int, shared_bytes: int = 0) -> Machine:
    """The memory system of a GPU that holds ``blocks_per_sm`` thread blocks of ``shared_bytes`` each on every SM.

    shared_bytes: static and dynamic, per thread block; what it leaves of L1 where both are one memory.
    """
    return Machine(
        sms=int(gpu["sm_count"]),
        blocks_per_sm=blocks_per_sm,
        l1_bytes=int(gpu["l1_bytes"]) - carve_out(gpu, blocks_per_sm, shared_bytes),
        l1_per_sm=int(gpu["l1_per_sm"]),
        l1_holds_plain_loads=bool(gpu["l1_holds_plain_loads"]),
        l2_bytes=int(gpu["l2_bytes"]),
        dram_channels=int(gpu["dram_channels"]),
        dram_banks=int(gpu["dram_banks"]),
        dram_row_bytes=int(gpu["dram_row_bytes"]),
        alu_latency=int(gpu["alu_latency"]),
        shared_latency=int(gpu["shared_latency"]),
        l1_latency=int(gpu["l1_latency"]),
        l2_latency=int(gpu["l2_latency"]),
        dram_latency=int(gpu["dram_latency"]),
        barrier_latency=int(gpu["barrier_latency"]),
        block_start=int(gpu["block_start_cycles"]),
        issue_cycles=partial(_issue_cycles, gpu),
        cas_issue_cycles=sum(CAS_TRIP.values()) * slot_cycles(gpu),
    )


def _issue_cycles(gpu: Gpu, instruction: Instruction) -> float:
    return instruction_weight(instruction, gpu.arch)[1] * slot_cycles(gpu)


def slot_cycles(gpu: Gpu) -> float:
    """Cycles of an SM that one machine instruction takes, given the share of issue slots that busy kernels use."""
    return 1 / (gpu["schedulers_per_sm"] * gpu["issue_efficiency"])


def machine_for(gpu: Gpu) -> Callable[[KernelInfo, int, int], Machine]:
    """For the simulated device: the machine that a kernel sees, by its facts, threads and shared bytes per block.

    Raises InputError for a kernel of which not one thread block fits.
    """

    def machine(info: KernelInfo, threads: int, shared_bytes: int) -> Machine:
        held = occupancy(gpu, threads, info.registers or 0, shared_bytes)
        if held.blocks < 1:
            raise InputError(
                f"{gpu.title} cannot hold a thread block of {threads} threads, {info.registers} registers each, and "
                f"{shared_bytes} bytes of shared memory ({held.limiter})"
            )
        return machine_of(gpu, held.blocks, shared_bytes)

    return machine


def carve_out(gpu: Gpu, blocks_per_sm: int, shared_bytes: int) -> int:
    """Bytes of L1 that the shared memory of the resident thread blocks takes: the smallest size that holds it.

    The driver chooses in the same way unless a program prefers otherwise.
    """
    needed = blocks_per_sm * shared_bytes_of_block(gpu, shared_bytes)
    sizes = [size * KIB for size in CARVE_OUTS.get(gpu.arch, (0,))]
    return next((size for size in sizes if size >= needed), sizes[-1])
