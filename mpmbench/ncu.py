"""The model beside Nsight Compute: the command line that measures the same counters, and its CSV read back.

Nsight Compute counts machine instructions and the real caches; the simulated device counts PTX instructions exactly and
the model has caches of its own. Where a counter means the same on both sides it stands in COUNTERS, and nowhere else.
"""

from __future__ import annotations

import csv
import re
import shlex
import statistics
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from mpmbench.errors import InputError
from mpmbench.gpu import Gpu
from mpmbench.profile_record import Profile
from mpmbench.record import Record
from mpmbench.report.table import Cell, Column, Kind, Quantity, Row, Table
from mpmbench.simt.counters import Tally

OLDEST = 70  # sm_70, Volta: Nsight Compute knows nothing older
LAUNCH_SKIP = 1  # the first launch is the check's, with cold code

Ours = Callable[[Record, Profile], float | None]


@dataclass(frozen=True)
class Counter:
    """One quantity on both sides. metrics: Nsight Compute's, in base units, added up."""

    title: str
    metrics: tuple[str, ...]
    kind: Kind  # of our number
    ours: Ours
    quantity: Quantity = Quantity.COUNT


def _counted(value: Callable[[Tally], float]) -> Ours:
    return lambda r, p: None if r.transfer_counters is None else value(r.transfer_counters.total)


def _metric(name: str) -> Ours:
    return lambda r, p: p.metrics.get(name)


def _occupancy(record: Record, profile: Profile) -> float | None:
    warps = profile.metrics.get("sm_occupancy_warps")
    return None if warps is None else 100 * warps / profile.occupancy.max_warps


def _registers(record: Record, profile: Profile) -> float | None:
    known = [info["registers"] for info in record.kernel_info.values() if info.get("registers") is not None]
    return max(known) if known else None


_GLOBAL = "l1tex__t_{}_pipe_lsu_mem_global_op_{}.sum"
_SHARED = "l1tex__data_pipe_lsu_wavefronts_mem_shared_op_{}.sum"


def _of_global(what: str, *operations: str) -> tuple[str, ...]:
    return tuple(_GLOBAL.format(what, operation) for operation in operations)


COUNTERS = (
    Counter("duration", ("gpu__time_duration.sum",), Kind.MODELLED, lambda r, p: p.time.seconds, Quantity.SECONDS),
    Counter("warp instructions", ("smsp__inst_executed.sum",), Kind.SIMULATED, _counted(lambda t: t.warp_inst)),
    Counter("lane instructions", ("smsp__thread_inst_executed.sum",), Kind.SIMULATED, _counted(lambda t: t.lane_inst)),
    Counter("global load requests", _of_global("requests", "ld"), Kind.SIMULATED, _counted(lambda t: t.gld_req)),
    Counter("global load sectors", _of_global("sectors", "ld"), Kind.SIMULATED, _counted(lambda t: t.gld_sectors)),
    Counter("global store requests", _of_global("requests", "st"), Kind.SIMULATED, _counted(lambda t: t.gst_req)),
    Counter("global store sectors", _of_global("sectors", "st"), Kind.SIMULATED, _counted(lambda t: t.gst_sectors)),
    Counter(
        "global atomic requests", _of_global("requests", "red", "atom"), Kind.SIMULATED, _counted(lambda t: t.gatom_req)
    ),
    Counter(
        "global atomic sectors", _of_global("sectors", "red", "atom"), Kind.SIMULATED,
        _counted(lambda t: t.gatom_sectors),
    ),
    Counter(
        "shared wavefronts", (_SHARED.format("ld"), _SHARED.format("st")), Kind.SIMULATED,
        _counted(lambda t: t.shm_wavefronts),
    ),
    Counter(
        "L1 hits, load sectors", ("l1tex__t_sectors_pipe_lsu_mem_global_op_ld_lookup_hit.sum",), Kind.MODELLED,
        lambda r, p: p.memory.l1_hit,
    ),
    Counter("L2 sectors", ("lts__t_sectors_srcunit_tex.sum",), Kind.MODELLED, lambda r, p: p.memory.l2_sectors),
    Counter(
        "L2 hit sectors", ("lts__t_sectors_srcunit_tex_lookup_hit.sum",), Kind.MODELLED, lambda r, p: p.memory.l2_hit
    ),
    Counter(
        "L2 atomic sectors", ("lts__t_sectors_op_red.sum", "lts__t_sectors_op_atom.sum"), Kind.MODELLED,
        lambda r, p: p.memory.atomic_sectors,
    ),
    Counter(
        "L2 hit rate [%]", ("lts__t_sector_hit_rate.pct",), Kind.MODELLED, _metric("l2_hit_percent"), Quantity.NUMBER
    ),
    Counter("DRAM sectors read", ("dram__sectors_read.sum",), Kind.MODELLED, lambda r, p: p.memory.dram_read),
    Counter("DRAM sectors written", ("dram__sectors_write.sum",), Kind.MODELLED, lambda r, p: p.memory.dram_write),
    Counter(
        "DRAM throughput [%]", ("dram__throughput.avg.pct_of_peak_sustained_elapsed",), Kind.MODELLED,
        _metric("vram_percent"), Quantity.NUMBER,
    ),
    Counter(
        "issue slots used [%]", ("smsp__issue_active.avg.pct_of_peak_sustained_active",), Kind.MODELLED,
        _metric("sm_issue_percent"), Quantity.NUMBER,
    ),
    Counter(
        "occupancy [%]", ("sm__warps_active.avg.pct_of_peak_sustained_active",), Kind.MODELLED, _occupancy,
        Quantity.NUMBER,
    ),
    Counter("registers / thread", ("launch__registers_per_thread",), Kind.PREDICTED, _registers),
)  # fmt: skip

# Factor to the base unit: seconds, bytes, 1 for what is counted.
_UNITS = {
    "nsecond": 1e-9, "ns": 1e-9, "usecond": 1e-6, "us": 1e-6, "msecond": 1e-3, "ms": 1e-3, "second": 1.0, "s": 1.0,
    **dict.fromkeys(("", "inst", "sector", "request", "warp", "%", "register/thread", "register"), 1.0),
}  # fmt: skip
_NUMBER = re.compile(r"[+-]?(\d{1,3}(,\d{3})+|\d+)(\.\d+)?([eE][+-]?\d+)?")
_NOT_KNOWN = ("", "n/a", "(!) n/a", "nan")
_TROUBLES = {
    "ERR_NVGPUCTRPERM": "Nsight Compute was not allowed to read the counters (ERR_NVGPUCTRPERM): ask an administrator",
    "No kernels were profiled": "Nsight Compute profiled no kernel: run the line that `mpmbench profile --ncu` prints",
}
_HOW = "write it with the line that `mpmbench profile --ncu` prints"


# ---- the command line --------------------------------------------------------------------------------------


def supports(gpu: Gpu) -> bool:
    return int(gpu.arch.removeprefix("sm_")) >= OLDEST


def why_unsupported(gpu: Gpu) -> str:
    return f"Nsight Compute measures sm_{OLDEST} and later; {gpu.title} is {gpu.arch}"


def command(kernel: str, arguments: Sequence[str], log: str) -> str:
    """The shell line that measures one launch of ``kernel`` and leaves the CSV in ``log``.

    arguments: of ``mpmbench run``, without the device. Numbers are written as in English, in base units.
    """
    metrics = ",".join(dict.fromkeys(name for counter in COUNTERS for name in counter.metrics))
    words = [
        "ncu", "--target-processes", "all", "--csv", "--page", "raw", "--print-units", "base", "--log-file", log,
        "--kernel-name", f"regex:^{kernel}$", "--launch-skip", str(LAUNCH_SKIP), "--launch-count", "1",
        "--metrics", metrics, "mpmbench", "run", *arguments, "-d", "cuda",
    ]  # fmt: skip
    return f"LC_ALL=C {shlex.join(words)}"


# ---- the CSV -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Measured:
    """One kernel as Nsight Compute measured it. values: median over its launches, by metric, in base units."""

    kernel: str
    capability: str  # "9.0"; empty where the file does not say
    launches: int
    values: dict[str, float]


def read_csv(path: Path) -> dict[str, Measured]:
    """Kernels of a CSV of Nsight Compute, its raw or its details page, by name.

    Raises InputError for a file that is missing, empty, none of Nsight Compute's, or without any metric of COUNTERS.
    """
    try:
        text = path.read_text(encoding="utf-8-sig", errors="replace")
    except OSError as error:
        raise InputError(f"cannot read {path}: {(error.strerror or str(error)).lower()}") from None
    if not text.strip():
        raise InputError(f"{path} is empty: {_HOW}")
    rows = [row for row in csv.reader(text.splitlines()) if row]
    start = next((i for i, row in enumerate(rows) if "Kernel Name" in row), None)
    if start is None:
        for sign, trouble in _TROUBLES.items():
            if sign in text:
                raise InputError(f"{path}: {trouble}")
        raise InputError(f"{path} is no CSV of Nsight Compute (no column 'Kernel Name'): {_HOW}")
    header = rows[start]
    # A program's own output may stand below: such lines have not the header's number of columns.
    body = [dict(zip(header, row, strict=True)) for row in rows[start + 1 :] if len(row) == len(header)]
    found = _details(path, body) if {"Metric Name", "Metric Value"} <= set(header) else _raw(path, header, body)
    if not any(values for _, _, _, values in found):
        raise InputError(f"{path} has no metric that mpmbench knows: {_HOW}")
    return _by_kernel(found)


# One launch: kernel, compute capability, key of the launch, metrics.
_Launch = tuple[str, str, str, dict[str, float]]


def _raw(path: Path, header: Sequence[str], body: Sequence[dict[str, str]]) -> list[_Launch]:
    """Raw page: one row per launch, one column per metric, units in the first row."""
    if not body:
        return []
    known = [name for name in header if name in _KNOWN]
    units = body[0] if not body[0]["Kernel Name"] else {}
    launches = []
    for i, row in enumerate(body[1:] if units else body):
        values = {name: _value(path, name, row[name], units.get(name, "")) for name in known}
        kept = {name: value for name, value in values.items() if value is not None}
        launches.append((row["Kernel Name"], row.get("CC", ""), row.get("ID") or str(i), kept))
    return launches


def _details(path: Path, body: Sequence[dict[str, str]]) -> list[_Launch]:
    """Details page: one row per launch and metric."""
    launches: dict[tuple[str, str], _Launch] = {}
    for row in body:
        kernel, key = row["Kernel Name"], row.get("ID", "")
        launch = launches.setdefault((kernel, key), (kernel, row.get("CC", ""), key, {}))
        name = row["Metric Name"]
        if name in _KNOWN:
            value = _value(path, name, row["Metric Value"], row.get("Metric Unit", ""))
            if value is not None:
                launch[3][name] = value
    return list(launches.values())


_KNOWN = frozenset(name for counter in COUNTERS for name in counter.metrics)


def _value(path: Path, metric: str, text: str, unit: str) -> float | None:
    text, unit = text.strip(), unit.strip()
    if text.lower() in _NOT_KNOWN:
        return None
    if not _NUMBER.fullmatch(text):
        raise InputError(f"{path}: cannot read {metric} = {text!r}: run ncu with LC_ALL=C, as `--ncu` prints it")
    if unit not in _UNITS:
        raise InputError(f"{path}: {metric} is in {unit!r}: run ncu with --print-units base")
    return float(text.replace(",", "")) * _UNITS[unit]


def _by_kernel(launches: Iterable[_Launch]) -> dict[str, Measured]:
    grouped: dict[str, list[_Launch]] = {}
    for launch in launches:
        grouped.setdefault(_plain_name(launch[0]), []).append(launch)
    found = {}
    for kernel, runs in grouped.items():
        names = dict.fromkeys(name for run in runs for name in run[3])
        values = {name: statistics.median(run[3][name] for run in runs if name in run[3]) for name in names}
        found[kernel] = Measured(kernel, runs[0][1], len(runs), values)
    return found


def _plain_name(kernel: str) -> str:
    """Without the parameter list that some versions print."""
    return kernel.split("(")[0].strip()


# ---- side by side ------------------------------------------------------------------------------------------


def compare(record: Record, profile: Profile, measured: Measured) -> Table:
    """Our counts and model beside Nsight Compute's, a row per counter that it measured.

    Raises InputError if the file is of a GPU of another architecture.
    """
    capability = ".".join((record.arch.removeprefix("sm_")[:-1], record.arch[-1]))
    if measured.capability and measured.capability != capability:
        raise InputError(
            f"{measured.kernel} was measured on compute capability {measured.capability}, but {profile.gpu} is "
            f"{capability}: name the GPU it ran on with --gpu"
        )
    columns = (
        Column("counter", Kind.NAME, Quantity.TEXT),
        *(Column(str(kind), kind, Quantity.TEXT) for kind in (Kind.SIMULATED, Kind.MODELLED, Kind.PREDICTED)),
        Column("measured (ncu)", Kind.MEASURED, Quantity.TEXT),
        Column("ours / measured", Kind.NAME, Quantity.FACTOR),
    )
    rows = []
    for counter in COUNTERS:
        parts = [measured.values[name] for name in counter.metrics if name in measured.values]
        if not parts:
            continue
        theirs, ours = sum(parts), counter.ours(record, profile)
        by_kind = [_text(ours, counter) if counter.kind is column.kind else None for column in columns[1:4]]
        ratio = ours / theirs if ours is not None and theirs else None
        values = (counter.title, *by_kind, _text(theirs, counter), ratio)
        rows.append(Row(tuple(Cell(v, c.kind) for v, c in zip(values, columns, strict=True))))
    notes = (
        "Simulated instructions are PTX, measured ones are machine code.",
        f"Measured: median of {measured.launches} launch{'es' if measured.launches > 1 else ''}.",
    )
    return Table(f"{record.variant} on {profile.title}: model and Nsight Compute", columns, tuple(rows), notes)


def _text(value: float | None, counter: Counter) -> str | None:
    from mpmbench.report.text import format_value

    return None if value is None else format_value(value, counter.quantity)
