"""Cases on named GPUs: run on the simulated device with that GPU's caches and DRAM, checked, counted, time modelled."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

from mpmbench.device import LaunchProfile, LaunchReport
from mpmbench.device.simulated import SimulatedDevice
from mpmbench.environment import Environment
from mpmbench.gpu import Gpu
from mpmbench.gpu.machine import machine_for
from mpmbench.gpu.model import Rates, metrics_of, model_launches, rates_of
from mpmbench.gpu.modelled import ModelledTime
from mpmbench.gpu.occupancy import occupancy
from mpmbench.profile_record import LineProfile, Profile, Residency
from mpmbench.record import Record
from mpmbench.runner import Inputs, refuse_bad_input, resume_key
from mpmbench.simt.codegen_trace import CAS_PASSES
from mpmbench.simt.counters import SourceLine, Tally
from mpmbench.simt.machine import MemoryTally

# By what a source line's share of a term is measured.
_SHARE_OF: Mapping[str, Callable[[Tally, MemoryTally], int]] = {
    "issue": lambda tally, memory: tally.warp_inst,
    "latency": lambda tally, memory: tally.warp_inst,
    "shared": lambda tally, memory: tally.shm_wavefronts + CAS_PASSES * tally.satom_wavefronts,
    "l1": lambda tally, memory: memory.l1_request_bytes,
    "l2": lambda tally, memory: memory.l2_sectors,
    "dram": lambda tally, memory: memory.dram_sectors,
    "activations": lambda tally, memory: memory.dram_activations,
    "atomics": lambda tally, memory: memory.atomic_lanes,
}


@dataclass(frozen=True)
class Modeller:
    """What the runner asks for a GPU's view of what just ran. seen: the transfer launches of the last case."""

    gpu: Gpu
    seen: list[LaunchProfile] = field(default_factory=list)

    @cached_property
    def rates(self) -> Rates:
        return rates_of(self.gpu)

    def device(self) -> SimulatedDevice:
        """A simulated device with this GPU's memory system."""
        return SimulatedDevice(arch=self.gpu.arch, mode="profile", machine=machine_for(self.gpu))

    def __call__(
        self, before: Mapping[str, LaunchReport], transfer: LaunchReport, after: Mapping[str, LaunchReport]
    ) -> dict[str, Profile]:
        """Reports of the steps before, of the transfer and of the steps after -> a record's ``modelled``."""
        self.seen[:] = transfer.profiles
        steps = {
            name: model_launches(self.gpu, report.profiles, self.rates)
            for name, report in {**before, **after}.items()
            if report.profiles
        }
        return {self.gpu.name: profile_of(self.gpu, self.rates, transfer.profiles, steps)}


def profile_of(
    gpu: Gpu, rates: Rates, launches: Sequence[LaunchProfile], steps: Mapping[str, ModelledTime] | None = None
) -> Profile:
    """The launches of a transfer, as a record keeps them. steps: times of the others by name."""
    time = model_launches(gpu, launches, rates)
    memory = MemoryTally()
    for launch in launches:
        memory = memory + launch.memory.total
    clock = gpu["clock_mhz"] * 1e6
    held = residency(gpu, launches)
    return Profile(
        gpu=gpu.name,
        title=gpu.title,
        time=time,
        occupancy=held,
        memory=memory,
        steps=dict(steps or {}),
        hot_address=max((launch.memory.hot_address for launch in launches), default=0),
        latency_cycles=sum(launch.memory.latency_cycles for launch in launches),
        warp_cycles=sum(launch.memory.warp_cycles for launch in launches),
        barrier_wait_cycles=sum(launch.memory.barrier_wait_cycles for launch in launches),
        metrics={**metrics_of(gpu, launches, time), "sm_occupancy_warps": occupancy_warps(gpu, launches)},
        lines=_lines(launches, time.bound),
        peak={
            "warp_inst": gpu["sm_count"] * gpu["schedulers_per_sm"] * clock,
            "l1_bytes": gpu["sm_count"] * gpu["l1_bytes_per_clk"] * clock,
            "l2_bytes": gpu["l2_bandwidth"],
            "dram_bytes": gpu["dram_bandwidth"],
        },
    )


def residency(gpu: Gpu, launches: Sequence[LaunchProfile]) -> Residency:
    """Of the launch with most thread blocks."""
    most = int(gpu["warps_per_sm"])
    if not launches:
        return Residency(0, 0, "blocks", most)
    launch = max(launches, key=lambda one: one.blocks)
    held = occupancy(gpu, launch.threads, launch.info.registers or 0, launch.shared_bytes)
    return Residency(held.warps, held.blocks, held.limiter, most)


def occupancy_warps(gpu: Gpu, launches: Sequence[LaunchProfile]) -> float:
    """Resident warps per SM, mean over the SMs and the modelled life of the launches."""
    cycles = sum(launch.memory.latency_cycles for launch in launches)
    return sum(launch.memory.warp_cycles for launch in launches) / (gpu["sm_count"] * cycles) if cycles else 0.0


def _lines(launches: Sequence[LaunchProfile], bound: str) -> dict[SourceLine, LineProfile]:
    tallies: dict[SourceLine, tuple[Tally, MemoryTally]] = {}
    for launch in launches:
        for line in {**launch.counters.lines, **launch.memory.lines}:
            tally, memory = tallies.get(line, (Tally(), MemoryTally()))
            tallies[line] = (
                tally + launch.counters.lines.get(line, Tally()),
                memory + launch.memory.lines.get(line, MemoryTally()),
            )
    amounts = {line: _SHARE_OF[bound](*found) for line, found in tallies.items()}
    total = sum(amounts.values()) or 1
    return {
        line: LineProfile(tally.warp_inst, memory.dram_sectors, memory.l2_sectors, amounts[line] / total)
        for line, (tally, memory) in tallies.items()
    }


def profile_cases(
    cases: Sequence[Any],
    gpus: Sequence[Gpu],
    progress: Callable[[str, int, int], None],
    keep: Callable[[Record], None] = lambda record: None,
    known: Sequence[Record] = (),
) -> list[Record]:
    """Records with ``modelled`` filled for each GPU, one per case and architecture: GPUs of one architecture run the
    same code and share a record.

    progress: told what runs, the cases done and the cases in all. keep: given each new record as soon as it is whole.
    known: records of an earlier run, taken as they are where they model the same case on all GPUs asked for.
    """
    refuse_bad_input(cases)
    environment = Environment.capture()
    inputs = Inputs()
    earlier = {resume_key(record): record for record in known if record.modelled}
    records: list[Record] = []
    groups = list(itertools.product(cases, _by_architecture(gpus)))
    for done, (case, group) in enumerate(groups):
        progress(f"{', '.join(gpu.name for gpu in group)}: {case.title}", done, len(groups))
        found = earlier.get(case.resume_key(Modeller(group[0]).device(), inputs)) if earlier else None
        if found is None or not {gpu.name for gpu in group} <= set(found.modelled or ()):
            found = _profile_group(case, group, inputs, environment)
            keep(found)
        records.append(found)
    progress("done", len(groups), len(groups))
    return records


def _by_architecture(gpus: Sequence[Gpu]) -> list[list[Gpu]]:
    groups: dict[str, list[Gpu]] = {}
    for gpu in gpus:
        groups.setdefault(gpu.arch, []).append(gpu)
    return list(groups.values())


def _profile_group(case: Any, group: Sequence[Gpu], inputs: Inputs, environment: Environment) -> Record:
    """One case on GPUs of one architecture: the same counts, each GPU's own caches. The first record that lacks a
    model says why."""
    record = run_modelled(case, Modeller(group[0]), inputs, environment)
    for gpu in group[1:]:
        if not record.modelled:
            break
        other = run_modelled(case, Modeller(gpu), inputs, environment)
        if not other.modelled:
            return other
        record = replace(record, modelled={**record.modelled, **other.modelled})
    return record


def run_modelled(case: Any, model: Modeller, inputs: Inputs, environment: Environment) -> Record:
    """Run, check, count and model one case."""
    return case.run(model.device(), inputs, environment, model)
