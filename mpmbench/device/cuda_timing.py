"""What a sample on a GPU needs beside its two events: a stream held back, and the clock of the SMs meanwhile.

Hold: a kernel of one thread spins on a word in mapped host memory, so that the host has enqueued a whole sample before
any of it starts. Python needs some 10 us per call; without the hold the gaps between events and kernels would be timed.
Stamp: a kernel reads SM 0's cycle counter and the GPU's global timer; two of them around a sample give the clock of it.
NVBench holds and stamps likewise (NVIDIA/nvbench: blocking_kernel.cu, timestamps_kernel.cu).

Whatever waits for the GPU while it is held never returns, as the GPU waits for us: loading a module, allocating,
freeing, synchronising, a full launch queue (some 1000 launches). Hence every kernel runs once before the first sample,
and a hold that is not let go ends by itself; its sample is worth nothing.

Compiled for every GPU and executed by the NumPy executor of the simulated device. Never run on hardware.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from mpmbench.device import CompiledKernel, Launch
from mpmbench.kernel import KernelSource

HOLD_LIMIT = 10.0  # [s]
HOLD_LIMIT_WATCHED = 1.0  # [s] where the driver kills long kernels: a GPU that draws a desktop

STAMPS = 2  # kept: before and after a sample
LONGEST_STEP = 200_000  # cycles, some 100 us

SOURCE = r"""
__device__ unsigned long long global_nanoseconds()
{
    unsigned long long time;
    asm volatile("mov.u64 %0, %%globaltimer;" : "=l"(time));
    return time;
}

// Ends once the host has let this ticket go. Where it has not in time, by the global timer or, should that stand still,
// by cycles (no GPU clock exceeds 4 GHz), it says so. Tickets only grow.
extern "C" __global__ void mpmbench_hold(
    const volatile unsigned* let_go, volatile unsigned* expired, unsigned ticket, unsigned long long nanoseconds)
{
    const unsigned long long begin = global_nanoseconds();
    const long long first_cycle = clock64();
    while (*let_go < ticket) {
        if (global_nanoseconds() - begin >= nanoseconds
            || (unsigned long long)(clock64() - first_cycle) >= 4 * nanoseconds) {
            *expired = ticket;
            return;
        }
    }
}

// One thread block per SM: one of them lands on SM 0, as a rule. Cycle counters of two SMs have nothing in common, so
// no other may answer, and of several blocks on SM 0 only the first does. The global timer may advance in steps of a
// microsecond and more; cycles are read right after a step, which keeps the steps out of the clock of a short sample.
extern "C" __global__ void mpmbench_stamp(unsigned long long* stamps, unsigned long long number)
{
    unsigned long long* stamp = stamps + 3 * (number % STAMPS);  // number, cycles, nanoseconds
    unsigned multiprocessor;
    asm volatile("mov.u32 %0, %%smid;" : "=r"(multiprocessor));
    if (multiprocessor != 0 || atomicExch(stamp, number) == number) return;
    const long long first_cycle = clock64();
    const unsigned long long before = global_nanoseconds();
    unsigned long long now = before;
    while (now == before && clock64() - first_cycle < LONGEST_STEP) now = global_nanoseconds();
    stamp[1] = clock64();
    stamp[2] = now == before ? 0 : now;
}
""".replace("LONGEST_STEP", str(LONGEST_STEP)).replace("STAMPS", str(STAMPS))

KERNELS = KernelSource("mpmbench_timing", SOURCE, (), hashlib.sha256(SOURCE.encode()).hexdigest())


@dataclass(frozen=True)
class Stamp:
    """A stamp that the stream will make, or has made."""

    number: int


class StreamTimer:
    """Holds and stamps of one device. Making it loads both kernels and runs each once, so that no hold meets a load."""

    def __init__(self, device: Any, mailbox: np.ndarray, mailbox_address: int) -> None:
        """mailbox: (2,) uint32 in pinned host memory that kernels reach at ``mailbox_address``: let go, expired."""
        self._device = device
        self._let_go, self._expired = mailbox[0:1], mailbox[1:2]
        mailbox[:] = 0
        self._addresses = np.uint64(mailbox_address), np.uint64(mailbox_address + mailbox.itemsize)
        self._hold_kernel: CompiledKernel = device.compile(KERNELS, "mpmbench_hold")
        self._stamp_kernel: CompiledKernel = device.compile(KERNELS, "mpmbench_stamp")
        self._stamps = device.upload(np.zeros((STAMPS, 3), np.uint64))
        watched = device.properties.get("kernelExecTimeoutEnabled")
        self._limit = round((HOLD_LIMIT_WATCHED if watched else HOLD_LIMIT) * 1e9)  # [ns]
        self._ticket = self._number = 0
        self._launch_hold(0)  # let go already
        self.stamp()
        device.synchronize()

    def hold(self) -> None:
        """Keep the stream from going on until ``release``."""
        self._ticket += 1
        self._launch_hold(self._ticket)

    def release(self) -> None:
        """Let the stream go on; without a hold it changes nothing."""
        self._let_go[0] = self._ticket

    @property
    def expired(self) -> bool:
        """Whether the last hold ended by itself, as far as the stream has come."""
        return self._ticket != 0 and int(self._expired[0]) == self._ticket

    def stamp(self) -> Stamp:
        """Read both clocks at this point of the stream. Only the last two stamps are kept."""
        self._number += 1
        blocks = int(self._device.properties["multiProcessorCount"])
        arguments = (self._stamps, np.uint64(self._number))
        self._device.launch(Launch("stamp", self._stamp_kernel, (blocks, 1, 1), (1, 1, 1), arguments))
        return Stamp(self._number)

    def clock_between(self, first: Stamp, second: Stamp) -> float | None:
        """Clock of SM 0 between two successive stamps [Hz], once the stream is past them; None where no thread block
        landed on SM 0, or the global timer did not move."""
        rows = self._device.download(self._stamps)
        found = []
        for stamp in (first, second):
            number, cycles, nanoseconds = map(int, rows[stamp.number % STAMPS])
            if number != stamp.number or nanoseconds == 0:
                return None
            found.append((cycles, nanoseconds))
        (begin_cycles, begin), (end_cycles, end) = found
        if end <= begin or end_cycles <= begin_cycles:
            return None
        return (end_cycles - begin_cycles) / (end - begin) * 1e9

    def _launch_hold(self, ticket: int) -> None:
        arguments = (*self._addresses, np.uint32(ticket), np.uint64(self._limit))
        self._device.launch(Launch("hold", self._hold_kernel, (1, 1, 1), (1, 1, 1), arguments))
