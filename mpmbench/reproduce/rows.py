"""Rows of tables 5-16: what is printed, and what the performance model says of the same launches."""

from __future__ import annotations

import json
import multiprocessing
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, field, replace
from functools import cache as cached
from pathlib import Path
from typing import Any

from mpmbench import presets
from mpmbench.device import KernelInfo, LaunchProfile
from mpmbench.environment import Environment
from mpmbench.gpu import CALIBRATED, Constant, Gpu
from mpmbench.gpu.calibration import CELLS, Cell, calibrate, to_toml
from mpmbench.gpu.model import busy_sms, issue_cycles, metrics_of, model_launches, rates_of
from mpmbench.gpu.modelled import ModelledTime
from mpmbench.primitive_runs import PrimitiveCase
from mpmbench.profile import Modeller, occupancy_warps, run_modelled
from mpmbench.runner import Case, Inputs
from mpmbench.simt import cache as disk
from mpmbench.simt.codegen_trace import CAS_PASSES
from mpmbench.simt.counters import Counters, Tally
from mpmbench.simt.machine import MemoryCounters, MemoryTally

Constants = Mapping[str, Constant]  # of the model, by name
Progress = Callable[[str, int, int], None]  # (what runs, steps done, steps in all)

# The published rows of these tables time one dispatch and leave partial results; ours go on to one result.
FIRST_LAUNCH_TABLES = (7, 8)

FORM = "2"  # of what the cache keeps of a row: another one counts anew

CHUNK = 4  # rows that one process counts in a row, so that a dataset is made once

# What a row's counters depend on besides its axes and the GPU: the code that runs and the code that counts.
_SOURCES = (
    "simt", "raw_kernels", "variants", "primitives", "operations", "device", "gpu/sass.py", "gpu/machine.py",
    "gpu/occupancy.py", "dataset.py", "recipes.py", "motion.py", "plan.py", "preprocess.py", "workspace.py",
    "kernel.py", "launcher.py", "layout.py", "grid.py",
)  # fmt: skip


@dataclass(frozen=True)
class Row:
    """One printed row and its counterpart.

    row, place: the printed name, and where in its table it stands.  published: the other printed figures, as printed
    (vram_percent, sm_percent, l2_percent, l2_hit_percent, top_stall, occupancy_warps, ...).  metrics: the counted and
    modelled counterparts under the same names, and dram_bytes.  floor_bytes: what must cross global memory, each input
    and result once.  kernel_hash: of the sources of all its launches.
    failed: why there is no modelled time.  state: what ``retime`` needs; opaque.
    """

    table: int
    row: str
    place: int
    published_us: float | None
    published: Mapping[str, str]
    erratum: str | None
    modelled: ModelledTime | None
    metrics: Mapping[str, float]
    kernel_hash: str
    dataset_fingerprint: str
    failed: str | None = None
    floor_bytes: int | None = None
    state: Any = field(default=None, repr=False, compare=False)

    @property
    def modelled_us(self) -> float | None:
        return None if self.modelled is None else 1e6 * self.modelled.seconds


@dataclass(frozen=True)
class State:
    """The GPU that a row was counted for, and its launches without their source lines."""

    gpu: Gpu
    launches: tuple[LaunchProfile, ...]


def model_constants(gpu: Gpu) -> Constants:
    """Every constant that a modelled time on this GPU rests on, with its source."""
    return dict(gpu.constants)


def thesis_rows(
    gpu: Gpu, constants: Constants, progress: Progress | None = None, jobs: int = 2, cache: bool = True
) -> list[Row]:
    """Count and model every row of tables 5-16, in printed order."""
    cases = sorted(
        presets.thesis(), key=lambda case: ((case.preset_row or {})["table"], (case.preset_row or {})["place"])
    )
    keys = [_key(case, gpu) for case in cases]
    counted = {key: found for key in keys if cache and (found := _load(key)) is not None}
    missing = [(key, case) for key, case in zip(keys, cases, strict=True) if key not in counted]
    for key, found in _count(missing, gpu, jobs, cache, progress, len(counted), len(cases)):
        counted[key] = found
    chosen = replace(gpu, constants=dict(constants))
    return [_row(case, gpu, chosen, counted[key]) for key, case in zip(keys, cases, strict=True)]


def retime(rows: Sequence[Row], constants: Constants) -> list[Row]:
    """The same counters under other constants.

    Rates act on the terms exactly; latencies act on the latency term by the share of the warps' time that was spent on
    each. Sizes (caches, channels, residency) shaped the counters and are not counted anew.
    """
    result = []
    for row in rows:
        if row.state is None or row.modelled is None:
            result.append(row)
            continue
        gpu = replace(row.state.gpu, constants=dict(constants))
        launches = [_with_latencies(launch, row.state.gpu, gpu) for launch in row.state.launches]
        result.append(replace(row, modelled=model_launches(gpu, launches, rates_of(gpu))))
    return result


def write_calibration(rows: Sequence[Row], gpu: Gpu) -> Path:
    """Set the calibrated constants from their cells. Raises InputError where one of those has no counts."""
    cells = {}
    for row in rows:
        if (row.table, row.row) in CELLS.values() and row.state is not None and row.published_us:
            total = MemoryTally()
            for launch in row.state.launches:
                total = total + launch.memory.total
            cells[row.table, row.row] = Cell(
                1e-6 * row.published_us, total.dram_sectors, total.dram_activations, total.atomic_lanes
            )
    path = CALIBRATED / f"{gpu.name}.toml"
    path.write_text(to_toml(calibrate(cells, gpu["launch_overhead"])), encoding="utf-8")
    return path


def _with_latencies(launch: LaunchProfile, counted_for: Gpu, gpu: Gpu) -> LaunchProfile:
    """The latency term moves with the busiest pipe of the SMs for the part that this fills, else with the latencies."""
    before, now = (max(issue_cycles(one, launch) / busy_sms(one, launch.blocks), 1e-9) for one in (counted_for, gpu))
    filled = min(1.0, before / max(1, launch.memory.latency_cycles))
    waiting = 1.0
    for name, share in latency_shares(launch, counted_for).items():
        waiting += share * (gpu[name] / counted_for[name] - 1)
    factor = filled * now / before + (1 - filled) * waiting
    return replace(launch, memory=replace(launch.memory, latency_cycles=round(factor * launch.memory.latency_cycles)))


def latency_shares(launch: LaunchProfile, gpu: Gpu) -> dict[str, float]:
    """Share of each latency in the time that warps do not wait for each other; instructions have what is left."""
    memory, tally = launch.memory, launch.counters.total
    busy = max(1, memory.warp_cycles - memory.barrier_wait_cycles)
    shares = {
        "l1_latency": memory.l1_wait_cycles / busy,
        "l2_latency": memory.l2_wait_cycles / busy,
        "dram_latency": memory.dram_wait_cycles / busy,
        "barrier_latency": tally.bar * gpu["barrier_latency"] / busy,
    }
    left = max(0.0, 1 - sum(shares.values()))
    # A shared load is waited for in full where nothing else is left to do, and never longer.
    shares["shared_latency"] = min(left, (tally.sld_req + CAS_PASSES * tally.satom_iter) * gpu["shared_latency"] / busy)
    return {**shares, "alu_latency": left - shares["shared_latency"]}


def _row(case: Any, gpu: Gpu, chosen: Gpu, found: Mapping[str, Any]) -> Row:
    """A row from its counts. gpu: what they were counted for. chosen: the same with the constants asked for."""
    printed = case.preset_row
    launches = tuple(_launch(plain) for plain in found["launches"])
    row = Row(
        printed["table"],
        printed["row"],
        printed["place"],
        printed["published_us"],
        printed["published"],
        printed["erratum"],
        None,
        {},
        found["kernel_hash"],
        found["fingerprint"],
        found["failed"] or None,
        found["floor_bytes"],
        None if found["failed"] else State(gpu, launches),
    )
    if found["failed"]:
        return row
    (row,) = retime([replace(row, modelled=model_launches(gpu, launches, rates_of(gpu)))], chosen.constants)
    assert row.modelled is not None
    metrics = {**metrics_of(chosen, launches, row.modelled), "occupancy_warps": occupancy_warps(gpu, launches)}
    return replace(row, metrics=metrics)


# --- counting ----------------------------------------------------------------------------------------------------


def _count(
    missing: Sequence[tuple[str, Any]],
    gpu: Gpu,
    jobs: int,
    keep: bool,
    progress: Progress | None,
    done: int,
    total: int,
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Count rows in ``jobs`` processes, those of one dataset side by side in one."""
    tell = progress or (lambda what, done, total: None)
    if not missing:
        return
    ordered = sorted(missing, key=lambda item: repr(getattr(item[1], "dataset", "")))
    chunks = [ordered[at : at + CHUNK] for at in range(0, len(ordered), CHUNK)]
    # A fresh interpreter: compiled code and threads of this one do not survive a fork.
    with ProcessPoolExecutor(min(jobs, len(chunks)), multiprocessing.get_context("spawn")) as pool:
        tasks: list[Future[list[tuple[str, dict[str, Any]]]]] = [
            pool.submit(_count_chunk, [(key, _number(case)) for key, case in chunk], gpu, keep) for chunk in chunks
        ]
        try:
            for task in as_completed(tasks):
                for key, found in task.result():
                    done += 1
                    tell("counting rows", done, total)
                    yield key, found
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _number(case: Any) -> tuple[int, int]:
    return case.preset_row["table"], case.preset_row["place"]


@cached
def _inputs() -> Inputs:
    return Inputs()


def _count_chunk(
    items: Sequence[tuple[str, tuple[int, int]]], gpu: Gpu, keep: bool
) -> list[tuple[str, dict[str, Any]]]:
    """In a process of its own: cases hold functions and do not travel, so they are found again by table and place.

    keep: put each row into the cache as soon as it is counted, so that an interruption loses one.
    """
    cases = {_number(case): case for case in presets.thesis()}
    counted = []
    for key, number in items:
        found = _count_case(cases[number], gpu)
        if keep and not found["failed"]:
            disk.store("rows", key, json.dumps(found).encode())
        counted.append((key, found))
    return counted


def _count_case(case: Case | PrimitiveCase, gpu: Gpu) -> dict[str, Any]:
    """Run and check a row; its launches as JSON."""
    model = Modeller(gpu)
    record = run_modelled(case, model, _inputs(), Environment.capture(argv=[]))
    launches = model.seen
    if (case.preset_row or {})["table"] in FIRST_LAUNCH_TABLES:
        launches = launches[:1]
    failed = record.skipped_because or record.failed_because
    if not failed and record.status != "ok":
        failed = "its result does not agree with the reference" if record.status == "wrong" else record.status
    return {
        "launches": [_plain(launch) for launch in launches],
        "kernel_hash": disk.content_key(*(f"{name} {sha}" for name, sha in sorted(record.hashes.items()))),
        "fingerprint": record.dataset.fingerprint,
        "floor_bytes": record.floor_bytes,
        "failed": failed,
    }


# --- the cache ---------------------------------------------------------------------------------------------------


@cached
def _source_digest() -> str:
    root = Path(__file__).parents[1]
    files = [
        path
        for name in _SOURCES
        for path in (sorted((root / name).rglob("*")) if (root / name).is_dir() else [root / name])
        if path.suffix in (".py", ".cu", ".cuh")
    ]
    return disk.content_key(*(path.read_bytes() for path in files))


def _key(case: Any, gpu: Gpu) -> str:
    """Of a row's counts: the sources, the GPU and what the row executes."""
    constants = json.dumps(
        {name: constant.value for name, constant in sorted(gpu.constants.items()) if name not in CELLS}
    )
    what = repr((case.name, sorted(case.axes.items()), getattr(case, "dataset", None), getattr(case, "size", None)))
    recipe = getattr(case, "dataset", None)
    text = (presets.DATASETS_FOLDER / f"{recipe.name}.toml").read_text() if recipe is not None else ""
    table = str((case.preset_row or {})["table"] in FIRST_LAUNCH_TABLES)
    return disk.content_key("row", FORM, _source_digest(), gpu.arch, constants, what, text, table)


def _load(key: str) -> dict[str, Any] | None:
    stored = disk.load("rows", key)
    return None if stored is None else json.loads(stored)


def _plain(launch: LaunchProfile) -> dict[str, Any]:
    memory = {name: value for name, value in vars(launch.memory).items() if name not in ("total", "lines")}
    return {
        "entry": launch.entry,
        "blocks": launch.blocks,
        "threads": launch.threads,
        "shared_bytes": launch.shared_bytes,
        "info": asdict(launch.info),
        "tally": asdict(launch.counters.total),
        "memory": {**memory, "total": asdict(launch.memory.total)},
        "opcodes": [[opcode, literal, times] for (opcode, literal), times in launch.opcodes.items()],
    }


def _launch(plain: Mapping[str, Any]) -> LaunchProfile:
    memory = {**plain["memory"], "total": MemoryTally(**plain["memory"]["total"])}
    return LaunchProfile(
        plain["entry"],
        plain["blocks"],
        plain["threads"],
        plain["shared_bytes"],
        KernelInfo(**plain["info"]),
        Counters(Tally(**plain["tally"])),
        MemoryCounters(**memory),
        {(opcode, literal): times for opcode, literal, times in plain["opcodes"]},
    )
