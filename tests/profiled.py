"""Made-up records with made-up profiles: for tests of the pages, not of the model."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

from mpmbench.environment import Environment
from mpmbench.gpu.modelled import ModelledTime
from mpmbench.grid import Grid
from mpmbench.profile_record import LineProfile, Profile, Residency
from mpmbench.record import Check, DatasetSummary, Record, StepCost
from mpmbench.simt.counters import Counters, SourceLine, Tally
from mpmbench.simt.machine import MemoryTally

ENVIRONMENT = Environment(
    mpmbench="0.1.0", git_commit="c0ffee", git_dirty=False, python="3.11.0", numpy="2.0", numba="0.68", llvmlite="0.50",
    nvrtc="12.9", cpu="A CPU", cores=2, os="Linux", date="2026-01-01T00:00:00+00:00", argv=("mpmbench", "profile"),
    seed=1,
)  # fmt: skip
N = 1_000_000
DATASET = DatasetSummary("uniform_cube", {"particles_per_cell": 4}, 1, N, Grid((128,) * 3, 1 / 128), "ab" * 32)
GLOBAL_AXES = {
    "dtype": "float32", "spline": "cubic", "payload": "pic", "layout": "soa", "particle_order": "given",
    "writing": "hoisted", "block_shape": (8, 4, 4),
}  # fmt: skip
BLOCK_AXES = {
    **GLOBAL_AXES, "particle_order": "deep", "batching": 1, "blocks": "active",
}  # fmt: skip
TITLES = {
    "gtx970": "NVIDIA GeForce GTX 970",
    "a100": "NVIDIA A100 80GB",
    "h100": "NVIDIA H100 PCIe",
    "h200": "NVIDIA H200 (SXM)",
    "rtx4090": "NVIDIA GeForce RTX 4090",
}
PEAK = {"warp_inst": 61.2e9, "l1_bytes": 1.2e12, "l2_bytes": 594e9, "dram_bytes": 175e9}
LINES = {SourceLine("raw_kernels/p2g.cu", 40 + i): 1 / (i + 2) for i in range(8)}


def modelled_time(
    gpu: str, bound: str, seconds: float, low: float = 0.75, high: float = 1.25, reason: str = "", **shares: float
) -> ModelledTime:
    """A time bound by one term; the shares of the others default to a tenth. low, high: over seconds."""
    launch = min(5e-6, seconds / 10)
    terms = {t: 0.1 * seconds for t in ("issue", "shared", "l1", "l2", "dram", "activations", "atomics", "latency")}
    terms |= {name: share * seconds for name, share in shares.items()}
    terms |= {bound: seconds - launch, "launch": launch}
    return ModelledTime(gpu, seconds, low * seconds, high * seconds, bound, terms, not reason, reason)


def profile(
    time: ModelledTime, steps: Mapping[str, float] | None = None, sectors: tuple[int, int] = (6_000_000, 3_000_000),
    **changes,
) -> Profile:  # fmt: skip
    """steps: seconds by name.  sectors: of L2 and DRAM."""
    l2, dram = sectors
    made = Profile(
        gpu=time.gpu,
        title=TITLES[time.gpu],
        time=time,
        occupancy=Residency(44, 11, "shared memory", 64),
        memory=MemoryTally(
            l1_hit=10,
            l1_miss=20,
            l2_hit=l2 - dram // 2,
            l2_miss=dram // 2,
            dram_read=dram - 1000,
            dram_write=1000,
            dram_activations=dram // 9,
            l1_request_bytes=960,
            atomic_lanes=N,
            atomic_sectors=N // 4,
        ),
        steps={name: modelled_time(time.gpu, "dram", seconds) for name, seconds in (steps or {}).items()},
        hot_address=12,
        latency_cycles=1000,
        warp_cycles=40_000,
        barrier_wait_cycles=4000,
        metrics={
            "vram_percent": 61.25,
            "sm_percent": 55.0,
            "l2_percent": 30.5,
            "tex_percent": 12.0,
            "l2_hit_percent": 40.1,
            "sm_issue_percent": 65.0,
            "sm_occupancy_warps": 43.3,
            "read_percent": 44.0,
            "write_percent": 11.0,
        },
        lines={line: LineProfile(1000 * i, 300 * i, 500 * i, share) for i, (line, share) in enumerate(LINES.items())},
        peak=PEAK,
    )
    return dataclasses.replace(made, **changes)


def record(variant: str = "p2g_global_atomic", profiles: tuple[Profile, ...] = (), **changes) -> Record:
    """A run that passed its check, with a profile for each GPU."""
    defaults = BLOCK_AXES if "block" in variant else GLOBAL_AXES
    axes = {**defaults, **changes.pop("axes", {})}
    tally = Tally(
        warp_inst=20_000_000, lane_inst=600_000_000, branch=100_000, div_branch=5, gld_req=40_000, gld_sectors=400_000,
        gatom_req=2_000_000, gatom_lane=64_000_000, gatom_sectors=9_000_000, gatom_pass=18_000_000,
    )  # fmt: skip
    if "block" in variant:
        tally.sld_req, tally.sst_req, tally.shm_wavefronts = 2_000_000, 2_000_000, 7_000_000
    if variant == "p2g_block_atomic":
        tally.satom_req, tally.satom_lane, tally.satom_iter = 4_000_000, 120_000_000, 13_000_000
        tally.satom_wavefronts = 13_000_000
    steps = {"grid_clear": StepCost(Counters(Tally(warp_inst=100, gst_sectors=1000)))}
    if axes["particle_order"] != "given":
        steps["bin"] = StepCost(Counters(Tally(warp_inst=200_000, gld_sectors=400_000)))
        steps["reorder_deep"] = StepCost(Counters(Tally(warp_inst=300_000, gld_sectors=900_000)))
    made = Record(
        variant=variant,
        transfer=variant[:3],
        dataset=DATASET,
        axes=axes,
        default_axes=defaults,
        device="simulated",
        arch="sm_52",
        environment=ENVIRONMENT,
        variant_summary="what it does",
        check=Check(True, 1e-7, 1e-6, (1, 2, 3)),
        preprocess=steps,
        transfer_counters=Counters(tally, dict.fromkeys(LINES, Tally(warp_inst=2_500_000))),
        line_texts={line: f"add(nodes.mass, at, w_{i} * mass);" for i, line in enumerate(LINES)},
        kernel_info={variant: {"arch": "sm_52", "registers": 40, "shared_bytes": 0, "spill_bytes": 0}},
        hashes={variant: "cd" * 32},
        floor_bytes=60_000_000,
        modelled={p.gpu: p for p in profiles} or None,
    )
    return dataclasses.replace(made, **changes)


SORT = {"grid_clear": 40e-6, "bin": 150e-6, "reorder_deep": 210e-6}


def strategies(gpus: tuple[str, ...] = ("gtx970",), speed: float = 1.0, **changes) -> list[Record]:
    """Five strategies on each GPU: activations, atomics, issue and shared memory bind; two cannot be told apart."""

    def on_all(bound: str, seconds: float, sectors: tuple[int, int], steps: Mapping[str, float], **more):
        made = []
        for i, gpu in enumerate(gpus):
            unknown = "the atomic rate of this GPU is not known" if bound == "atomics" and gpu != "gtx970" else ""
            span = {"low": 0.3, "high": 3.0} if unknown else {}
            scale = speed / (1 + i)
            time = modelled_time(gpu, bound, scale * seconds, reason=unknown, **span, **more)
            made.append(profile(time, {k: scale * v for k, v in steps.items()}, sectors))
        return tuple(made)

    clear = {"grid_clear": 40e-6}
    sorted_axes = {"axes": {"particle_order": "deep"}}
    return [
        record(profiles=on_all("activations", 44.4e-3, (90_000_000, 80_000_000), clear, atomics=0.45), **changes),
        record(profiles=on_all("atomics", 5.12e-3, (9_000_000, 2_100_000), SORT, l2=0.4), **{**sorted_axes, **changes}),
        record("p2g_block_sync", on_all("issue", 3.05e-3, (5_000_000, 2_200_000), SORT, latency=0.8), **changes),
        record("p2g_block_atomic", on_all("shared", 6.4e-3, (5_000_000, 2_200_000), SORT, issue=0.5), **changes),
        record("p2g_block_pull", on_all("issue", 3.4e-3, (5_000_000, 2_300_000), SORT), **changes),
    ]
