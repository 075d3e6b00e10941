"""What a user waits for: compiling each strategy's kernel, loading it from the cache, counting a transfer.

    python benchmarks/compile_and_count.py [--quick]

Kernel compile is CUDA C++ to PTX (NVRTC), PTX to LLVM text (front end, code generator) and LLVM, with warm imports and
an empty cache. Kind of number: measured (wall, CPU). Leaves reports/bench/compile_and_count.md and .json.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import machine
import numpy as np

from mpmbench.device import Device, open_device, run_all
from mpmbench.device.cpu import CpuDevice
from mpmbench.kernel import KernelSource, load_source
from mpmbench.plan import build_plan, run_steps
from mpmbench.runner import DatasetChoice, Inputs, check_outputs
from mpmbench.simt.ptx import parse
from mpmbench.variants import Variant, discover, resolve_axes
from mpmbench.workspace import kernel_constants

REPORTS = Path(__file__).resolve().parent.parent / "reports" / "bench"
PARTICLES, QUICK_PARTICLES = 1_000_188, 100_000
KIND = "measured (wall, CPU)"
MODES = ("run", "count")
COMPILE_AIM, LOAD_AIM, COUNT_AIM = 1.5, 0.050, 1.5  # s
COUNTED = ("p2g_global_atomic", "g2p_global_gather", "p2g_block_sync", "g2p_block_gather")


@dataclass(frozen=True)
class CompileTime:
    """Medians over the repeats [s] for one strategy at default axes, in one mode of the engine."""

    variant: str
    mode: str
    nvrtc: float
    front_end: float  # reading the PTX, on its own; part of engine
    engine: float  # PTX to machine code
    load: float  # everything again with a warm cache and a fresh device

    @property
    def total(self) -> float:
        return self.nvrtc + self.engine


@dataclass(frozen=True)
class CountTime:
    """Counting one sorted transfer [s]; plain is the same launch without counters."""

    variant: str
    particles: int
    seconds: float
    plain: float
    warp_inst: int


def open_engine(mode: str = "run") -> Device:
    """The simulated device for the default architecture."""
    return open_device("simulated", mode=mode)


def source_of(variant: Variant) -> KernelSource:
    """The strategy's kernel at default axes."""
    return load_source(variant.kernel_path, kernel_constants(resolve_axes(variant, {})))


def timed(call: Callable[[], Any]) -> tuple[float, Any]:
    begin = time.perf_counter()
    value = call()
    return time.perf_counter() - begin, value


def compile_times(variant: Variant, mode: str, repeats: int) -> CompileTime:
    """Compile from an empty cache folder, then load, ``repeats`` times."""
    source, samples = source_of(variant), []
    for _ in range(repeats):
        with tempfile.TemporaryDirectory(prefix="mpmbench-") as folder:
            os.environ["MPMBENCH_CACHE_DIR"] = folder
            device = open_engine(mode)
            nvrtc, ptx = timed(lambda device=device: device.ptx(source))
            front_end, _ = timed(lambda ptx=ptx: parse(ptx))
            engine, _ = timed(lambda device=device: device.compile(source, variant.kernel))
            fresh = open_engine(mode)
            load_time, _ = timed(lambda device=fresh: device.compile(source, variant.kernel))
        samples.append((nvrtc, front_end, engine, load_time))
    return CompileTime(variant.name, mode, *(float(m) for m in np.median(np.array(samples), axis=0)))


def all_compile_times(repeats: int) -> list[CompileTime]:
    """Every strategy in every mode."""
    variants = discover()
    kept_folder = os.environ.get("MPMBENCH_CACHE_DIR")
    try:
        for mode in MODES:  # imports, NVRTC and LLVM's tables are loaded once, by a kernel that is not timed
            compile_times(variants[0], mode, repeats=1)
        return [compile_times(variant, mode, repeats) for variant in variants for mode in MODES]
    finally:
        if kept_folder is None:
            os.environ.pop("MPMBENCH_CACHE_DIR", None)
        else:
            os.environ["MPMBENCH_CACHE_DIR"] = kept_folder


def count_times(names: tuple[str, ...], particles: int, repeats: int) -> list[CountTime]:
    """Count sorted transfers of ``uniform_cube_shuffled``; a result that fails the check is an error."""
    inputs = Inputs()
    dataset = inputs.select(DatasetChoice("uniform_cube_shuffled", particles))
    found = {variant.name: variant for variant in discover()}
    times = []
    for name in names:
        variant, seconds = found[name], {}
        axes = resolve_axes(variant, {"particle_order": "deep"})
        nodes = inputs.rounded_nodes(axes) if variant.transfer == "g2p" else None
        for mode in MODES:
            device = open_engine(mode)
            plan = build_plan(variant, dataset, device, axes, nodes)
            plan.run_once(device)
            launches, samples = plan.transfer.launches, []
            for _ in range(repeats):
                run_steps(device, plan.reset())
                duration, report = timed(lambda device=device, launches=launches: run_all(device, launches))
                samples.append(duration)
            run_steps(device, plan.finish)
            verdict = check_outputs(plan.outputs(), variant.transfer, inputs, axes)
            if not verdict.passed:
                raise SystemExit(f"{name} in mode {mode}: {verdict}")
            seconds[mode] = float(np.median(samples))
        times.append(CountTime(name, particles, seconds["count"], seconds["run"], report.counters.total.warp_inst))
    return times


# --- report -----------------------------------------------------------------------------------------------------------


def verdict(value: float, aim: float) -> str:
    return "met" if value <= aim else "missed"


def compile_table(times: list[CompileTime]) -> list[str]:
    lines = [
        "| strategy | mode | NVRTC s | PTX to machine code s | of it reading PTX s | compile s | from cache ms |",
        "|---|---|---|---|---|---|---|",
    ]
    for t in times:
        lines.append(
            f"| {t.variant} | {t.mode} | {t.nvrtc:.2f} | {t.engine:.2f} | {t.front_end:.2f} | {t.total:.2f} "
            f"| {1e3 * t.load:.0f} |"
        )
    for mode in MODES:
        chosen = [t for t in times if t.mode == mode]
        total, cached = np.median([t.total for t in chosen]), np.median([t.load for t in chosen])
        lines.append(
            f"| **median** | {mode} | | | | {total:.2f} (aim {COMPILE_AIM:g}: {verdict(total, COMPILE_AIM)}) "
            f"| {1e3 * cached:.0f} (aim {1e3 * LOAD_AIM:.0f}: {verdict(cached, LOAD_AIM)}) |"
        )
    return lines


def count_table(times: list[CountTime]) -> list[str]:
    lines = [
        "| strategy, sorted uniform_cube | particles | count s | no counters s | warp instructions | aim s | verdict |",
        "|---|---|---|---|---|---|---|",
    ]
    for t in times:
        lines.append(
            f"| {t.variant} | {t.particles:,} | {t.seconds:.2f} | {t.plain:.2f} | {t.warp_inst:,} | <= {COUNT_AIM:g} "
            f"| {verdict(t.seconds, COUNT_AIM)} |"
        )
    return lines


def markdown(compiles: list[CompileTime], counts: list[CountTime], about: Mapping[str, Any]) -> str:
    lines = [
        "# Compile and count",
        "",
        f"Kind: {KIND}, one pinned thread, default axes, medians of {about['repeats']} repeats. Compile starts from an "
        f"empty cache with warm imports; target {about['arch']}.",
        "",
        machine.markdown(about["machine"]),
        "",
        *compile_table(compiles),
        "",
        *count_table(counts),
    ]
    if warning := machine.load_warning(about["machine"]["load_average_before"]):
        lines += ["", f"Warning: {warning}"]
    return "\n".join(lines) + "\n"


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one repeat, 100k particles: does it run?")
    parser.add_argument("--particles", type=int, help=f"to count with, default {PARTICLES}")
    parser.add_argument("--repeats", type=int, help="default 3")
    parser.add_argument("--out", type=Path, default=REPORTS, help="folder of the report")
    given = parser.parse_args(arguments)
    core = max(os.sched_getaffinity(0))
    repeats = given.repeats or (1 if given.quick else 3)
    about = {"machine": machine.describe(core), "repeats": repeats, "arch": open_engine().arch, "quick": given.quick}
    with CpuDevice().undisturbed():
        compiles = all_compile_times(repeats)
        counts = count_times(COUNTED, given.particles or (QUICK_PARTICLES if given.quick else PARTICLES), repeats)

    text = markdown(compiles, counts, about)
    given.out.mkdir(parents=True, exist_ok=True)
    (given.out / "compile_and_count.md").write_text(text)
    record = {
        "kind": KIND,
        **about,
        "compile": [asdict(t) | {"total": t.total} for t in compiles],
        "count": [asdict(t) for t in counts],
    }
    (given.out / "compile_and_count.json").write_text(json.dumps(record, indent=1) + "\n")
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
