"""Rows to compare, from a journal of ours or from an NVBench JSON, ours or NVBench's own.

Both become the same rows: a journal is turned into the document that ``write_nvbench`` would write, without the disk,
so that a journal and its NVBench file cannot compare differently.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mpmbench.errors import InputError
from mpmbench.nvbench import CPU_TIME, EVENTS, GPU_TIME, WALL, document
from mpmbench.record import Record, read_records


@dataclass(frozen=True)
class Row:
    """One state of an NVBench document.

    transfer: or the benchmark's name in a file of NVBench's own, which is its strategy too.  fingerprint: of the
    dataset, empty where only a name is known.  axes: name and value as text, by name.  kind: of number.  device: name,
    and what tells apart GPUs of one name.  environment: flat, GPU facts as ``gpu.*``.  hashes: kernel -> sha256.
    without_time: why there is none; empty where there is.  state: as in the file.  path: of the file.  sidecars: binary
    files by name, or None where they are on disk.
    """

    transfer: str
    strategy: str
    dataset: str
    fingerprint: str
    axes: tuple[tuple[str, str], ...]
    cache: str
    kind: str
    device: tuple[str, str]
    environment: Mapping[str, Any]
    hashes: Mapping[str, str]
    without_time: str
    state: Mapping[str, Any]
    path: Path
    sidecars: Mapping[str, bytes] | None = field(default=None, repr=False)

    @property
    def title(self) -> str:
        words = [self.strategy, self.dataset, *(f"{name}={value}" for name, value in self.axes), self.cache]
        return " ".join(filter(None, words))

    def seconds(self, figure: str) -> float | None:
        """A figure of the times [s], by the last part of NVBench's tag: min, mean, median, ..."""
        tag = f"{CPU_TIME if self.kind == WALL else GPU_TIME}/{figure}"
        for summary in self.state["summaries"]:
            if summary["tag"] == tag:
                value = next((datum.get("value") for datum in summary["data"] if datum["name"] == "value"), None)
                return None if value is None else float(value)
        return None


def read_rows(path: str | Path) -> list[Row]:
    """Rows of a journal (its first line is a record) or of an NVBench JSON. Raises InputError for anything else."""
    path = Path(path)
    try:
        with path.open("rb") as file:
            first = file.readline()
    except OSError as error:
        raise InputError(f"cannot read {path}: {(error.strerror or str(error)).lower()}") from None
    if not first:
        raise InputError(f"{path} is empty: nothing to compare")
    rows = rows_of_records(read_records(path), path) if _is_record(first) else read_nvbench(path)
    if not rows:
        raise InputError(f"{path} holds no rows: nothing to compare")
    return rows


def _is_record(line: bytes) -> bool:
    """A whole record, or the beginning of one in a file that was torn in its first row."""
    try:
        content = json.loads(line)
    except ValueError:
        return line.startswith(b'{"variant":')
    return isinstance(content, dict) and "schema" in content


def rows_of_records(records: Sequence[Record], path: str | Path) -> list[Row]:
    """``path``: that the records were read from, for messages."""
    root, sidecars = document(records, Path(path).name)
    return _rows(root, Path(path), sidecars)


def read_nvbench(path: str | Path) -> list[Row]:
    """Rows of an NVBench JSON 1.0.0. Samples stay on disk until they are asked for."""
    path = Path(path)
    try:
        root = json.loads(path.read_bytes())
    except OSError as error:
        raise InputError(f"cannot read {path}: {(error.strerror or str(error)).lower()}") from None
    except ValueError:
        root = None
    if not isinstance(root, dict) or "benchmarks" not in root:
        raise InputError(f"{path} is neither a journal of mpmbench nor an NVBench JSON: name what run --json wrote")
    try:
        return _rows(root, path, None)
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path} is not what NVBench writes ({type(error).__name__}: {error}): write the file anew"
        ) from None


def _rows(root: Mapping[str, Any], path: Path, sidecars: Mapping[str, bytes] | None) -> list[Row]:
    devices = {device["id"]: device for device in root.get("devices") or ()}
    rows = []
    for benchmark in root["benchmarks"]:
        for state in benchmark["states"]:
            whole = {**state, "summaries": state.get("summaries") or [], "axis_values": state.get("axis_values") or []}
            own = state.get("mpmbench")
            about = _of_ours(own, root) if own else _of_nvbench(benchmark["name"], whole, devices, root)
            rows.append(Row(**about, without_time=_why(whole), state=whole, path=path, sidecars=sidecars))
            rows[-1].seconds("median")  # malformed figures are found here, not halfway through a table
    return rows


def _of_ours(own: Mapping[str, Any], root: Mapping[str, Any]) -> dict[str, Any]:
    label, identity = own["device"]
    environment = dict(root["mpmbench"]["environments"][own["environment"]])
    gpu = environment.pop("gpu", {})
    return {
        **{name: own[name] for name in ("transfer", "strategy", "dataset", "fingerprint", "cache", "kind", "hashes")},
        "axes": tuple(sorted(own["axes"].items())),
        "device": (label, identity),
        "environment": environment | {f"gpu.{name}": value for name, value in gpu.items()},
    }


def _of_nvbench(
    benchmark: str, state: Mapping[str, Any], devices: Mapping[int, Mapping[str, Any]], root: Mapping[str, Any]
) -> dict[str, Any]:
    number = state.get("device")
    device = devices.get(number, {}) if number is not None else {}
    version = root.get("meta", {}).get("version", {}).get("nvbench", {}).get("string")
    facts = {f"gpu.{name}": value for name, value in device.items() if name != "id"}
    wall = any(summary["tag"].startswith(CPU_TIME) for summary in state["summaries"])
    return {
        "transfer": benchmark,
        "strategy": benchmark,
        "dataset": "",
        "fingerprint": "",
        "axes": tuple(sorted((value["name"], str(value.get("value"))) for value in state["axis_values"])),
        "cache": "cold",  # its isolated measurement, the only one that its own comparison reads
        "kind": WALL if wall else EVENTS,
        "device": ("cpu" if number is None else f"cuda:{number}", str(device.get("name", ""))),
        "environment": {"nvbench": version} | facts,
        "hashes": {},
    }


def _why(state: Mapping[str, Any]) -> str:
    if state.get("is_skipped"):
        return state.get("skip_reason") or "skipped without a reason"
    timed = any(summary["tag"] in (f"{GPU_TIME}/mean", f"{CPU_TIME}/mean") for summary in state["summaries"])
    return "" if timed else "no isolated times in the file"
