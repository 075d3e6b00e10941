"""How long a launch would take on a GPU: the time of each unit, were it the only limit, and the largest of them.

The template is Zhang and Owens (HPCA 2011), throughput of the busiest unit, with a term for DRAM row activations and a
latency bound after Volkov (2016). With counts per launch, N SMs that have work, and f the SM clock:

    issue        machine instructions / (4 eta) or, if that is more, those of one class / its rate; / (N f)
    shared       (wavefronts + 3 x those of shared atomics + global requests) / (N f)
    l1           bytes that loads ask for / bytes per cycle / (N f)
    l2           32 B x sectors / L2 bandwidth
    dram         32 B x sectors read and written / achieved DRAM bandwidth
    activations  row activations / their rate
    atomics      the larger of lanes / their rate, and atomics on one word at one per cycle
    latency      end of the last warp if idle latencies, barriers and the SMs' own pipes were all that took time

The time is the launch overhead plus the largest term. The latency term holds the work of the SMs' pipes as it comes
from barrier to barrier, so it is a little longer than those: it is named as what binds only where it exceeds every
other term by a tenth. The range goes from 1/1.25 of the term to 1.25 times it or, where that is more, to the longest
term of the SMs and the longest of the memory one after the other, as if they did not overlap at all.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

from mpmbench.device import LaunchProfile
from mpmbench.gpu import Gpu, get_gpu
from mpmbench.gpu.machine import slot_cycles
from mpmbench.gpu.modelled import TERMS, ModelledTime
from mpmbench.gpu.sass import CAS_TRIP, is_shared_float_add, weight
from mpmbench.simt.codegen_trace import CAS_PASSES

SECTOR_BYTES = 32
SM_TERMS = ("issue", "shared", "l1", "latency")
MEMORY_TERMS = ("l2", "dram", "activations", "atomics")
CLEARLY = 1.1  # by how much the latency term must exceed the others to be named
ERROR = 1.25  # what models of this kind reach on codes that they were not made for: 15 to 25 %
ATOMIC_RANGE = (0.5, 4.0)  # of one addition per cycle and L2 slice, where no rate is known
ACTIVATION_RANGE = (0.5, 2.0)  # of the calibrated rate per bank, where no rate is known
CALIBRATED_GPU = "gtx970"
UNCALIBRATED_BANK = 1e7  # activations/s of a bank before anything was calibrated: one every 100 ns


@dataclass(frozen=True)
class Rates:
    """What descriptions do not give for every GPU. dram_bandwidth [bytes/s]; atomics [lanes/s]; activations [1/s].

    uncalibrated: what of these is a guess, for a reader.
    """

    dram_bandwidth: float
    atomics: float
    activations: float
    atomics_range: tuple[float, float] = (1.0, 1.0)
    activations_range: tuple[float, float] = (1.0, 1.0)
    uncalibrated: str = ""


def rates_of(gpu: Gpu) -> Rates:
    """The rates of a GPU's description, and guesses for those that it lacks: one addition per cycle and L2 slice, and
    banks as fast as those of the calibrated GPU."""
    atomics, activations = gpu.get("atomic_word_rate"), gpu.get("row_activation_rate")
    slices = gpu.get("l2_slices") or gpu["l2_bandwidth"] / (SECTOR_BYTES * gpu["clock_mhz"] * 1e6)
    missing = [name for name, rate in (("atomics", atomics), ("scattered DRAM access", activations)) if rate is None]
    return Rates(
        gpu.get("dram_bandwidth_achieved") or 0.8 * gpu["dram_bandwidth"],
        atomics or slices * gpu["clock_mhz"] * 1e6,
        activations or _activations_per_bank() * gpu["dram_channels"] * gpu["dram_banks"],
        (1.0, 1.0) if atomics else ATOMIC_RANGE,
        (1.0, 1.0) if activations else ACTIVATION_RANGE,
        f"the rate of {' and of '.join(missing)} is not known for this GPU" if missing else "",
    )


@cache
def _activations_per_bank() -> float:
    gpu = get_gpu(CALIBRATED_GPU)
    rate = gpu.get("row_activation_rate")
    return rate / (gpu["dram_channels"] * gpu["dram_banks"]) if rate else UNCALIBRATED_BANK


def busy_sms(gpu: Gpu, blocks: int) -> float:
    """SMs' worth of work that runs at a time: the SM with the most thread blocks decides when a launch ends."""
    sms = gpu["sm_count"]
    return blocks / -(-blocks // sms) if blocks else 1.0


def instruction_counts(gpu: Gpu, launch: LaunchProfile) -> dict[str, float]:
    """Machine instructions of a launch by class, warp by warp."""
    counts: dict[str, float] = {}
    satomics = float_satomics = 0
    for (opcode, literal), times in launch.opcodes.items():
        kind, each = weight(opcode, gpu.arch, literal)
        counts[kind] = counts.get(kind, 0.0) + times * each
        if opcode.startswith(("atom.", "red.")) and ".shared" in opcode:
            satomics += times
            float_satomics += times * is_shared_float_add(opcode)
    if satomics:
        trips = launch.counters.total.satom_iter * float_satomics / satomics
        for kind, each in CAS_TRIP.items():
            counts[kind] = counts.get(kind, 0.0) + trips * each
    return counts


def unit_cycles(gpu: Gpu, counts: Mapping[str, float]) -> float:
    """Cycles of one SM that the busiest unit takes for ``instruction_counts``; units work side by side."""
    return max((count / rate for kind, count in counts.items() if (rate := gpu.get(f"rate_{kind}"))), default=0.0)


def issue_cycles(gpu: Gpu, launch: LaunchProfile) -> float:
    """Cycles of one SM for all instructions: its issue slots, or the busiest unit where that takes longer.

    What units share is the issue slots, of which busy kernels fill the share ``issue_efficiency``.
    """
    counts = instruction_counts(gpu, launch)
    return max(sum(counts.values()) * slot_cycles(gpu), unit_cycles(gpu, counts))


def terms_of(gpu: Gpu, launch: LaunchProfile, rates: Rates) -> dict[str, float]:
    """Each of TERMS [s]."""
    tally, memory = launch.counters.total, launch.memory.total
    clock = gpu["clock_mhz"] * 1e6
    sm_cycles = busy_sms(gpu, launch.blocks) * clock
    requests = tally.gld_req + tally.gst_req + tally.gatom_req
    return {
        "issue": issue_cycles(gpu, launch) / sm_cycles,
        "shared": (tally.shm_wavefronts + CAS_PASSES * tally.satom_wavefronts + requests) / sm_cycles,
        "l1": memory.l1_request_bytes / gpu["l1_bytes_per_clk"] / sm_cycles,
        "l2": SECTOR_BYTES * memory.l2_sectors / gpu["l2_bandwidth"],
        "dram": SECTOR_BYTES * memory.dram_sectors / rates.dram_bandwidth,
        "latency": launch.memory.latency_cycles / clock,
        **_rate_terms(gpu, launch, rates),
    }


def _rate_terms(gpu: Gpu, launch: LaunchProfile, rates: Rates) -> dict[str, float]:
    """The terms whose rate may be a guess [s]."""
    memory = launch.memory.total
    return {
        "activations": memory.dram_activations / rates.activations,
        "atomics": max(memory.atomic_lanes / rates.atomics, launch.memory.hot_address / (gpu["clock_mhz"] * 1e6)),
    }


def model_launch(gpu: Gpu, launch: LaunchProfile, rates: Rates) -> ModelledTime:
    """Predicted time of one launch."""
    overhead = gpu["launch_overhead"]
    terms = terms_of(gpu, launch, rates)
    slow, fast = ({**terms, **_rate_terms(gpu, launch, _scaled(rates, end))} for end in (0, 1))
    first, fastest, slowest = (max(found.values()) for found in (terms, fast, slow))
    apart = max(slow[name] for name in SM_TERMS) + max(slow[name] for name in MEMORY_TERMS)
    uncertain = fastest < first or slowest > first
    return ModelledTime(
        gpu.name,
        overhead + first,
        overhead + fastest / ERROR,
        overhead + max(ERROR * slowest, apart),
        _bound(terms),
        {"launch": overhead, **terms},
        not uncertain,
        rates.uncalibrated if uncertain else "",
    )


def _bound(terms: Mapping[str, float]) -> str:
    longest = max((name for name in TERMS if name != "latency"), key=lambda name: terms[name])
    return "latency" if terms["latency"] > CLEARLY * terms[longest] else longest


def _scaled(rates: Rates, end: int) -> Rates:
    """Rates at the slow (0) or fast (1) end of their ranges."""
    return replace(
        rates,
        atomics=rates.atomics * rates.atomics_range[end],
        activations=rates.activations * rates.activations_range[end],
    )


def model_launches(gpu: Gpu, launches: Sequence[LaunchProfile], rates: Rates) -> ModelledTime:
    """Predicted time of launches one after the other."""
    return add_times(gpu, [model_launch(gpu, launch, rates) for launch in launches])


def add_times(gpu: Gpu, times: Iterable[ModelledTime]) -> ModelledTime:
    """Times one after the other; the bound of the sum is that under which most of it is spent."""
    times = list(times)
    spent: dict[str, float] = {}
    for time in times:
        spent[time.bound] = spent.get(time.bound, 0.0) + time.seconds
    reasons = dict.fromkeys(time.reason for time in times if time.reason)
    return ModelledTime(
        gpu.name,
        sum(time.seconds for time in times),
        sum(time.low for time in times),
        sum(time.high for time in times),
        max(spent, key=lambda name: spent[name]) if spent else "latency",
        {name: sum(time.terms.get(name, 0.0) for time in times) for name in ("launch", *TERMS)},
        all(time.calibrated for time in times),
        "; ".join(reasons),
    )


def metrics_of(gpu: Gpu, launches: Sequence[LaunchProfile], time: ModelledTime) -> Mapping[str, float]:
    """The metrics of the thesis's table 2, modelled: shares of a unit's peak over the modelled time, in percent.

    l2_hit_percent: of all sectors that L2 is asked for; a store that fills its sector counts as a hit.
    """
    total = launches[0].memory.total if launches else None
    if total is None or not time.seconds:
        return {}
    for launch in launches[1:]:
        total = total + launch.memory.total
    counts = [instruction_counts(gpu, launch) for launch in launches]
    issued = sum(sum(of_launch.values()) for of_launch in counts) / gpu["schedulers_per_sm"]
    busiest = sum(unit_cycles(gpu, of_launch) for of_launch in counts)
    cycles = gpu["sm_count"] * gpu["clock_mhz"] * 1e6 * time.seconds
    peak_bytes = gpu["dram_bandwidth"] * time.seconds

    def share(amount: float, most: float) -> float:
        return 100 * amount / most if most else 0.0

    return {
        "vram_percent": share(SECTOR_BYTES * total.dram_sectors, peak_bytes),
        "read_percent": share(SECTOR_BYTES * total.dram_read, peak_bytes),
        "write_percent": share(SECTOR_BYTES * total.dram_write, peak_bytes),
        "sm_percent": share(max(busiest, issued), cycles),
        "sm_issue_percent": share(issued, cycles),
        "l2_percent": share(SECTOR_BYTES * total.l2_sectors, gpu["l2_bandwidth"] * time.seconds),
        "tex_percent": share(total.l1_request_bytes / gpu["l1_bytes_per_clk"], cycles),
        "l2_hit_percent": share(total.l2_hit, total.l2_sectors),
        "l1_hit_percent": share(total.l1_hit, total.l1_hit + total.l1_miss),
        "dram_bytes": float(SECTOR_BYTES * total.dram_sectors),
    }
