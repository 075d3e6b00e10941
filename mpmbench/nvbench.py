"""Records as NVBench writes its results: JSON 1.0.0 beside binary samples, for the tools that GPU engineers have.

A transfer is a benchmark and a record is one of its states. Only event times stand under NVBench's tags of GPU time.
Wall times of a CPU stand under its ``cpu_only`` tags in a benchmark of their own, and a record without a measured time
is a skipped state with its reason. What NVBench has no place for (environment, fingerprint, kernel hashes) is kept
under the key ``mpmbench``, which its tools pass over.

The layout follows what cuda-bench 0.3.0 reads (nvbench-json-summary, nvbench-compare-robust); tests hold it to them.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from mpmbench.errors import InputError
from mpmbench.record import Measurement, Record, StepCost, _plain, _strict, total_cost
from mpmbench.runner import format_axis

FORMAT = "1.0.0"
ABSENT = "-"  # value of an axis that a strategy does not have, and of a cache state that is not known
EVENTS, WALL = "measured (events)", "measured (wall, CPU)"
TIMES = "nv/json/bin:"
CLOCKS = "nv/json/freqs-bin:nv/cold/sample_freqs"
GPU_TIME, CPU_TIME = "nv/cold/time/gpu", "nv/cpu_only/time/cpu"
CLOCK_MEAN = "nv/cold/sm_clock_rate/mean"
LEAST_SAMPLES = 5  # below it NVBench gives no noise


def kind_of(record: Record) -> str:
    """Which kind of number the record's time is, or would be; simulated and modelled ones are no times."""
    if record.simulated:
        return "modelled" if record.modelled else "simulated"
    return WALL if record.device.partition(":")[0] == "cpu" else EVENTS


def cache_of(record: Record) -> str | None:
    """State of the caches, of a row that was not timed the one it was meant for; older journals do not know that."""
    return record.transfer_measurement.mode if record.transfer_measurement else record.cache


def why_no_time(record: Record) -> str:
    """Empty where the transfer was measured."""
    if record.transfer_measurement:
        return ""
    if reason := record.skipped_because or record.failed_because:
        return reason
    if record.check is not None and not record.check.passed:
        return f"wrong result: error {record.check.ratio:.3g} x allowed"
    if record.modelled:
        return f"modelled for {', '.join(record.modelled)}: it has no measured time"
    if record.simulated:
        return "counted on the simulated device: it has no time"
    return "checked, not timed"


def write_nvbench(records: Sequence[Record], path: str | Path) -> None:
    """Write the JSON and, in folders beside it named as NVBench names them, its samples and clocks.

    Samples are named after their content and the JSON appears last, so that neither the old JSON nor the new one ever
    lacks them. Raises InputError where the disk is full or the folder cannot be written to; an old file is then whole.
    """
    path = Path(path)
    root, sidecars = document(records, path.name)
    text = json.dumps(root, indent=1, allow_nan=False).encode() + b"\n"  # ASCII: read under any locale
    fresh = [path.parent / name for name in sidecars if not (path.parent / name).exists()]
    try:
        for name, data in sidecars.items():
            _put(path.parent / name, data)
        _put(path, text)
    except OSError as error:
        for unused in fresh:
            unused.unlink(missing_ok=True)
        reason = (error.strerror or str(error)).lower()
        raise InputError(f"cannot write {path}: {reason}; make room or name another file, and run again") from None
    for folder in _folders(path.name):
        for left in (path.parent / folder).glob("*.bin"):
            if f"{folder}/{left.name}" not in sidecars:
                left.unlink()


def _folders(name: str) -> tuple[str, str]:
    """Of sample times and of clocks, relative to the JSON of this name."""
    return f"{name}-bin", f"{name}-freqs-bin"


def _put(path: Path, data: bytes) -> None:
    """The whole file or nothing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".partial")
    try:
        partial.write_bytes(data)
        os.replace(partial, path)
    except OSError:
        with contextlib.suppress(OSError):
            partial.unlink()
        raise


# ---- the document --------------------------------------------------------------------------------------------------


def document(records: Sequence[Record], name: str) -> tuple[dict[str, Any], dict[str, bytes]]:
    """Content of the JSON called ``name``, and its binary files by path relative to it."""
    sidecars: dict[str, bytes] = {}
    environments: list[Any] = []
    devices = _devices(records)
    benchmarks: dict[str, list[Record]] = {}
    for record in records:
        benchmarks.setdefault(_benchmark(record), []).append(record)
    written = []
    for index, (benchmark, rows) in enumerate(benchmarks.items()):
        axes = list(dict.fromkeys(axis for row in rows for axis in row.axes))
        modes = {row.transfer_measurement.mode for row in rows if row.transfer_measurement}
        mode = modes.pop() if len(modes) == 1 else ABSENT  # what a row of an older journal would have had
        states: list[dict[str, Any]] = []
        for row in rows:
            environment = _strict(_plain(asdict(row.environment)))
            if environment not in environments:
                environments.append(environment)
            device = devices.get(device_identity(row))
            state = _state(row, axes, mode, None if device is None else device["id"], name, sidecars)
            states.append({"index": len(states), **state, "mpmbench": _own(row, environments.index(environment))})
        written.append({
            "index": index,
            "name": benchmark,
            "devices": sorted({state["device"] for state in states} - {None}),
            "axes": _axes(states),
            "states": states,
        })  # fmt: skip
    newest = environments[-1] if environments else {}
    major, minor, patch = map(int, FORMAT.split("."))
    root = {
        "meta": {
            "argv": newest.get("argv", []),
            "version": {"json": {"major": major, "minor": minor, "patch": patch, "string": FORMAT}},
        },
        "devices": list(devices.values()),
        "benchmarks": written,
        "mpmbench": {"version": newest.get("mpmbench"), "environments": environments},
    }
    return root, sidecars


def _benchmark(record: Record) -> str:
    """NVBench pairs the devices of a benchmark by position, and a CPU is none of its devices: it stands apart."""
    return f"{record.transfer} (CPU)" if kind_of(record) == WALL else record.transfer


def _own(record: Record, environment: int) -> dict[str, Any]:
    """What says which row this is, without reading it back from names."""
    return {
        "transfer": record.transfer,
        "strategy": record.variant,
        "dataset": record.dataset.name,
        "fingerprint": record.dataset.fingerprint,
        "axes": {name: format_axis(value) for name, value in record.axes.items()},
        "cache": cache_of(record) or ABSENT,
        "kind": kind_of(record),
        "device": list(device_identity(record)),
        "environment": environment,
        "hashes": dict(record.hashes),
    }


def device_identity(record: Record) -> tuple[str, str]:
    """Device name and what tells apart two GPUs that bear it in files merged from several machines."""
    gpu = record.environment.gpu
    return record.device, str(gpu.get("uuid") or gpu.get("name") or "")


def _devices(records: Sequence[Record]) -> dict[tuple[str, str], dict[str, Any]]:
    """NVBench's description of every GPU, as far as the records know it; numbered as CUDA does if that is free."""
    found: dict[tuple[str, str], dict[str, Any]] = {}
    for record in records:
        identity = device_identity(record)
        if kind_of(record) != EVENTS or identity in found:
            continue
        taken = {device["id"] for device in found.values()}
        index = record.device.rpartition(":")[2]
        number = int(index) if index.isdigit() and int(index) not in taken else max(taken, default=-1) + 1
        found[identity] = {"id": number, **_device(record)}
    return found


def _device(record: Record) -> dict[str, Any]:
    gpu = record.environment.gpu
    hertz, memory_hertz = (1000 * gpu[k] if gpu.get(k) else None for k in ("clock_khz", "memory_clock_khz"))
    bits = gpu.get("memory_bus_bits")
    known = {
        "name": gpu.get("name") or record.device,
        "sm_version": _version(gpu.get("arch") or record.arch),
        "ptx_version": _version(record.arch),
        "sm_default_clock_rate": hertz,
        "number_of_sms": gpu.get("multiprocessors"),
        "global_memory_size": gpu.get("memory_bytes"),
        "global_memory_bus_peak_clock_rate": memory_hertz,
        "global_memory_bus_width": bits,
        "global_memory_bus_bandwidth": 2 * memory_hertz * bits // 8 if memory_hertz and bits else None,
        "l2_cache_size": gpu.get("l2_bytes"),
        "ecc_state": gpu.get("ecc"),
    }
    return {key: _plain(value) for key, value in known.items() if value is not None}


def _version(arch: str) -> int | None:
    """sm_90 -> 900"""
    digits = "".join(filter(str.isdigit, arch))
    return 10 * int(digits) if digits else None


def _state(
    record: Record, axes: Sequence[str], mode: str, device: int | None, name: str, sidecars: dict[str, bytes]
) -> dict[str, Any]:
    """One row. Adds its samples to ``sidecars``."""
    time = record.transfer_measurement
    # Every state has every axis, always as text: NVBench matches states by names, types and values.
    texts = {
        "strategy": record.variant,
        "dataset": record.dataset.name,
        **{axis: format_axis(record.axes[axis]) if axis in record.axes else ABSENT for axis in axes},
        "cache": cache_of(record) or mode,
    }
    values = [{"name": axis, "type": "string", "value": text} for axis, text in texts.items()]
    values.insert(2, {"name": "particles", "type": "int64", "value": str(record.dataset.n)})
    described = " ".join(f"{value['name']}={value['value']}" for value in values)
    reason = why_no_time(record)
    state: dict[str, Any] = {
        "name": described if device is None else f"Device={device} {described}",
        "description": described,
        "device": device,
        "type_config_index": 0,
        "axis_values": values,
        "summaries": _summaries(record, time, name, sidecars) if time else [],
        "is_skipped": bool(reason),
    }
    return {**state, "skip_reason": reason} if reason else state


def _axes(states: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The axes of a benchmark with every value that occurs."""
    axes: dict[str, dict[str, Any]] = {}
    for value in (value for state in states for value in state["axis_values"]):
        axis = axes.setdefault(value["name"], {"name": value["name"], "type": value["type"], "flags": "", "values": []})
        entry = {"input_string": value["value"], "description": "", "value": value["value"]}
        if entry not in axis["values"]:
            axis["values"].append(entry)
    return list(axes.values())


# ---- summaries -----------------------------------------------------------------------------------------------------


def _summaries(record: Record, time: Measurement, name: str, sidecars: dict[str, bytes]) -> list[dict[str, Any]]:
    """What NVBench's tools show and compare, under their tags; figures of ours under ``mpmbench/``."""
    wall = kind_of(record) == WALL
    group, processor = ("nv/cpu_only", "CPU") if wall else ("nv/cold", "GPU")
    tag = CPU_TIME if wall else GPU_TIME
    found = [_summary(f"{group}/sample_size", "Samples", "sample_size", len(time.samples))]
    figures = statistics_of(time.samples)
    for part, title, hint, shown in (
        ("min", f"Min {processor} Time", "duration", False),
        ("max", f"Max {processor} Time", "duration", False),
        ("mean", f"{processor} Time", "duration", True),
        ("median", f"Median {processor} Time", "duration", True),
        ("q1", f"Q1 {processor} Time", "duration", False),
        ("q3", f"Q3 {processor} Time", "duration", False),
        ("stdev/absolute", "Noise", "duration", False),
        ("stdev/relative", "Noise", "percentage", True),
        ("iqr/absolute", "IQR", "duration", False),
        ("iqr/relative", "IQR", "percentage", False),
    ):
        found.append(_summary(f"{tag}/{part}", title, hint, figures[part], hide=not shown))
    mean = figures["mean"]
    if mean:
        about = "particles, or elements of a primitive, per second"
        found.append(_summary(f"{group}/bw/item_rate", "Elem/s", "item_rate", record.dataset.n / mean, about))
        if record.floor_bytes:
            # Not NVBench's GlobalMem BW: that is of bytes said to be moved, this of bytes that cannot be avoided.
            about = "compulsory bytes (each particle and touched node once) over the mean time: no measured traffic"
            rate = record.floor_bytes / mean
            found.append(_summary("mpmbench/floor_bandwidth", "Floor BW", "byte_rate", rate, about))
    steps = total_cost(record.steps.values()) if record.steps else StepCost()
    if steps.measurement:
        about = "medians of the steps before and after the transfer, added: " + ", ".join(record.steps)
        found.append(_summary("mpmbench/other_steps", "Other Steps", "duration", steps.measurement.median, about))
    found.append(_summary("mpmbench/stopped_by", "Stopped By", "", time.stopped_by, hide=True))
    if time.discarded:
        told = ", ".join(f"{count} {reason}" for reason, count in time.discarded.items())
        found.append(_summary("mpmbench/discarded", "Discarded Samples", "", told, hide=True))
    folder, clock_folder = _folders(name)
    found.append(_sidecar(f"{TIMES}{group}/sample_times", "times", time.samples, folder, sidecars))
    if time.hertz and not wall:
        clock = math.fsum(time.hertz) / len(time.hertz)
        found.append(_summary(CLOCK_MEAN, "Clock Rate", "frequency", clock, "Mean SM clock rate", hide=True))
        found.append(_sidecar(CLOCKS, "freqs", time.hertz, clock_folder, sidecars))
    return found


def statistics_of(samples: Sequence[float]) -> dict[str, float | None]:
    """Figures by the last part of NVBench's tag, with its definitions.

    Quartiles are samples, by rank; fewer than five samples have no noise.
    """
    ordered = sorted(samples)
    count = len(ordered)
    q1, median, q3 = (ordered[(percent * (count - 1) + 50) // 100] for percent in (25, 50, 75))
    mean = math.fsum(ordered) / count
    enough = count >= LEAST_SAMPLES
    stdev = math.sqrt(math.fsum((s - mean) ** 2 for s in ordered) / (count - 1)) if enough else None
    iqr = q3 - q1 if enough else None
    return {
        "min": ordered[0],
        "max": ordered[-1],
        "mean": mean,
        "median": median,
        "q1": q1,
        "q3": q3,
        "stdev/absolute": stdev,
        "stdev/relative": stdev / mean if stdev is not None and mean else None,
        "iqr/absolute": iqr,
        "iqr/relative": iqr / median if iqr is not None and median else None,
    }


def _summary(
    tag: str, name: str, hint: str, value: float | int | str | None, description: str = "", hide: bool = False
) -> dict[str, Any]:
    summary: dict[str, Any] = {"tag": tag, "name": name}
    summary |= {"hint": hint} if hint else {}
    summary |= {"description": description} if description else {}
    summary |= {"hide": "Hidden by default."} if hide else {}
    return {**summary, "data": [_datum("value", value)]}


def _sidecar(tag: str, what: str, values: Sequence[float], folder: str, sidecars: dict[str, bytes]) -> dict[str, Any]:
    data = np.asarray(values, dtype="<f4").tobytes()
    filename = f"{folder}/{hashlib.sha256(data).hexdigest()[:16]}.bin"
    sidecars[filename] = data
    return {
        "tag": tag,
        "name": f"Sample {what.title()} File",
        "hint": f"file/sample_{what}",
        "hide": "Not needed in table.",
        "data": [_datum("filename", filename), _datum("size", len(values))],
    }


def _datum(name: str, value: float | int | str | None) -> dict[str, Any]:
    """Numbers are decimal text, as NVBench writes them; null stands for what is not known."""
    kind = "string" if isinstance(value, str) else "int64" if isinstance(value, int) else "float64"
    return {"name": name, "type": kind, "value": None if value is None else str(value)}
