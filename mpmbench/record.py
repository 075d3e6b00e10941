"""Record: everything known about one run of one strategy, as one line of JSON.

A record keeps the kinds of number apart (measured, simulated, modelled, published), and its constructor refuses
what would be dishonest: a time whose result was not checked, or a time from the simulated device.
Nothing that reads records needs a device, so any report can be rebuilt anywhere.
"""

from __future__ import annotations

import errno
import fcntl
import json
import math
import os
import re
import statistics
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from mpmbench.environment import Environment
from mpmbench.errors import InputError
from mpmbench.grid import Grid
from mpmbench.profile_record import Profile, from_plain, to_plain
from mpmbench.simt.counters import Counters, Finding, SourceLine, Tally

if TYPE_CHECKING:
    import pandas as pd

SCHEMA = 2  # raised when a reader of the old number could not read the new lines
READABLE = (1, SCHEMA)  # rows of 1 have no comparison, no tuning and no clocks

# Nodes in a particle's support, in three dimensions: 2, 3 or 4 per axis.
SUPPORT_NODES = {"linear": 8, "quadratic": 27, "cubic": 64}

# Preprocessing that every transfer needs anew; the rest is done once per sort.
PER_TRANSFER_STEPS = ("grid_clear", "grid_divide")


@dataclass(frozen=True)
class Measurement:
    """Times of one step.

    samples: [s], every one that was kept, in the order taken.  mode: state of the caches before each sample: "cold"
    (overwritten), "hot" (a run of the same before it) or "step" (what the step of a simulation leaves there).
    stopped_by: why sampling ended, e.g. "verdict", "precision", "time limit".  hertz: clock of the processor during
    each sample, empty where it is not known.  discarded: samples that were thrown away, by reason.  held_down: rounds
    at whose end the driver held the clocks down, by its reason.
    """

    samples: tuple[float, ...]
    mode: str
    warmups: int
    stopped_by: str
    hertz: tuple[float, ...] = ()
    discarded: Mapping[str, int] = field(default_factory=dict)
    held_down: Mapping[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.samples or not all(math.isfinite(s) and s >= 0 for s in self.samples):
            raise ValueError("a Measurement needs at least one sample, all finite and not negative")
        if self.hertz and len(self.hertz) != len(self.samples):
            raise ValueError("a Measurement needs a clock for each sample, or none")

    @property
    def median(self) -> float:
        """[s]"""
        return statistics.median(self.samples)

    @property
    def quartiles(self) -> tuple[float, float]:
        """First and third quartile [s]."""
        q1, q3 = np.quantile(self.samples, (0.25, 0.75))
        return float(q1), float(q3)

    @property
    def noise(self) -> float:
        """Interquartile range over median."""
        q1, q3 = self.quartiles
        return (q3 - q1) / self.median if self.median else 0.0


@dataclass(frozen=True)
class Comparison:
    """A row beside the others that were timed in the same rounds.

    contest: rows of one contest are paired: sample i of one was taken moments apart from sample i of the other.
    baseline: its label.  is_baseline: whether this row is it.  speedup: median, low and high of the baseline's time
    over this row's, pair by pair; None for the baseline and where there is none.  verdict: FAST, SLOW, SAME, AMBG or
    ????.  leads: no other row of the contest was found to be faster.  noise: the same three numbers of two copies of
    the baseline.  margin: smaller differences are not called differences.  p_value: corrected for the contest's rows.
    """

    contest: str
    baseline: str
    is_baseline: bool
    verdict: str
    speedup: tuple[float, float, float] | None
    leads: bool
    noise: tuple[float, float, float]
    margin: float
    p_value: float
    confidence: float
    rounds: int
    seed: int


@dataclass(frozen=True)
class Tried:
    """One configuration of a search. seconds: [s], None where it did not run, and ``reason`` says why."""

    axes: Mapping[str, Any]
    seconds: float | None
    reason: str = ""


@dataclass(frozen=True)
class Tuning:
    """How a row's axes were found: every configuration that was tried, the chosen one first.

    searched: the axes that were free.  budget: configurations allowed.  possible: how many there are.  kind: of the
    times, "measured (events)", "measured (wall, CPU)" or "modelled", for which ``gpu``.
    """

    searched: tuple[str, ...]
    budget: int
    possible: int
    kind: str
    gpu: str | None
    tried: tuple[Tried, ...]


@dataclass(frozen=True)
class Repeat:
    """Two runs on the same input, bit by bit: atomics add in any order. differing of ``of`` numbers differ, by at most
    ``largest`` relative to the largest of all."""

    differing: int
    of: int
    largest: float


@dataclass(frozen=True)
class StepCost:
    """What a step cost: counters on the simulated device, a measurement on a GPU."""

    counters: Counters | None = None
    measurement: Measurement | None = None


@dataclass(frozen=True)
class DatasetSummary:
    """The dataset as a record remembers it: enough to make it again and to know that it is the same one.

    n: particles.  fingerprint: sha256 of the arrays and the grid.  statistics: density and order.
    """

    name: str
    recipe: Mapping[str, Any]
    seed: int | None
    n: int
    grid: Grid
    fingerprint: str
    statistics: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, dataset: Any) -> DatasetSummary:
        """Summarise a ``Dataset``."""
        return cls(
            name=dataset.name,
            recipe=dict(dataset.recipe or {}),
            seed=dataset.seed,
            n=len(dataset.position),
            grid=dataset.grid,
            fingerprint=dataset.fingerprint,
            statistics=dict(_plain(dataset.statistics) or {}),
        )

    @classmethod
    def of_array(cls, name: str, size: int, seed: int, fingerprint: str) -> DatasetSummary:
        """Summarise the input of a primitive: its grid is a row of ``size`` places."""
        return cls(name, {"size": size}, seed, size, Grid((size, 1, 1), 1.0), fingerprint)


@dataclass(frozen=True)
class Check:
    """The comparison with the float64 reference.

    worst_error and allowed are those of the node (or particle) where their ratio is largest.
    conserved: relative error of each conserved sum (mass, momentum, ...).
    """

    passed: bool
    worst_error: float
    allowed: float
    worst_node: tuple[int, ...] | None = None
    conserved: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, result: Any) -> Check:
        """Summarise a ``CheckResult``."""
        conserved = asdict(result.conserved) if is_dataclass(result.conserved) else result.conserved  # type: ignore[arg-type]
        if conserved is not None and not isinstance(conserved, Mapping):
            conserved = {"all": conserved}
        node = _plain(result.worst_node)
        return cls(
            passed=bool(result.passed),
            worst_error=float(result.worst_error),
            allowed=float(result.allowed),
            worst_node=None if node is None else tuple(node) if isinstance(node, list) else (node,),
            conserved=dict(_plain(conserved) or {}),
        )

    @property
    def ratio(self) -> float:
        """Error over allowance; up to 1 is agreement."""
        if self.allowed == 0:
            return 0.0 if self.worst_error == 0 else math.inf
        return self.worst_error / self.allowed


@dataclass(frozen=True)
class Record:
    """One strategy, on one dataset, with one choice of axes, on one device."""

    variant: str
    transfer: str  # "p2g" | "g2p", or the operation of a primitive: "reduce", "scan", ...
    dataset: DatasetSummary
    axes: Mapping[str, Any]
    device: str  # "simulated", "cuda:0", "cpu"
    arch: str  # "sm_52", what the kernels were compiled for
    environment: Environment
    schema: int = SCHEMA
    cache: str | None = None  # state of the caches before each sample, where the device keeps time: Measurement.mode
    variant_summary: str = ""
    default_axes: Mapping[str, Any] = field(default_factory=dict)  # of this variant
    kernel_info: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  # kernel -> registers, shared_bytes..
    hashes: Mapping[str, str] = field(default_factory=dict)  # kernel -> sha256 of its source text
    check: Check | None = None
    preprocess: Mapping[str, StepCost] = field(default_factory=dict)  # step -> cost, in the order run
    transfer_counters: Counters | None = None
    transfer_measurement: Measurement | None = None
    finish: Mapping[str, StepCost] = field(default_factory=dict)  # steps after the transfer (order restored, ...)
    rest_of_step: Mapping[str, StepCost] = field(default_factory=dict)  # mode "step": what ran around the transfer
    comparison: Comparison | None = None  # with the rows timed in the same rounds
    repeat: Repeat | None = None  # the transfer run twice, where it was measured
    tuning: Tuning | None = None  # how axes were chosen, where they were searched for
    modelled: Mapping[str, Profile] | None = None  # by the performance model, for each GPU by name
    line_texts: Mapping[SourceLine, str] = field(default_factory=dict)  # of the lines in transfer_counters
    floor_bytes: int | None = None  # compulsory global traffic: each particle and touched node once
    device_bytes_predicted: int | None = None
    findings: tuple[Finding, ...] = ()
    host_seconds: float | None = None  # wall clock that the run itself took here; never a GPU time
    skipped_because: str | None = None  # cannot exist or does not fit: not run
    failed_because: str | None = None  # was run and broke: compiler refusal, launch error, ...
    preset_row: Mapping[str, Any] | None = (
        None  # source, table, row, place, published_us, published_speedup, erratum, ...
    )

    def __post_init__(self) -> None:
        timed = [s for s in self.steps.values() if s.measurement] or self.transfer_measurement
        if timed and self.device == "simulated":
            raise ValueError("a simulated record has no time: it counts, it does not measure")
        if timed and (self.check is None or not self.check.passed):
            raise ValueError("a time needs a passed check: verify before measuring, drop the time if it fails")
        counted = [s for s in self.steps.values() if s.counters] or self.transfer_counters
        if counted and self.device != "simulated":
            raise ValueError(f"counters come from the simulated device, not from {self.device}")
        if self.modelled and (not self.simulated or self.check is None or not self.check.passed):
            raise ValueError("a modelled time needs counters of a simulated run whose check passed")
        if any(gpu != profile.gpu for gpu, profile in (self.modelled or {}).items()):
            raise ValueError("a profile stands under the name of another GPU")
        if self.comparison and not self.transfer_measurement:
            raise ValueError("a comparison needs the times that it compares")
        if self.preprocess.keys() & self.finish.keys():
            raise ValueError("a step before the transfer and one after it share a name")
        if self.skipped_because and (timed or counted or self.check):
            raise ValueError("a skipped record holds no results")

    @property
    def steps(self) -> dict[str, StepCost]:
        """Every step but the transfer."""
        return {**self.preprocess, **self.finish}

    @property
    def status(self) -> Literal["ok", "skipped", "broken", "wrong", "findings", "unchecked"]:
        """``ok``: ran, agrees with the reference, the engine found nothing. Only such records are ranked."""
        if self.skipped_because:
            return "skipped"
        if self.failed_because:
            return "broken"
        if self.check is not None and not self.check.passed:
            return "wrong"
        if self.findings:
            return "findings"
        return "ok" if self.check is not None else "unchecked"

    @property
    def is_transfer(self) -> bool:
        """False for a primitive."""
        return self.transfer in ("p2g", "g2p")

    @property
    def simulated(self) -> bool:
        return self.device == "simulated"

    @property
    def node_visits(self) -> int:
        """Particle-node pairs of one transfer: the unit of work that no strategy can avoid."""
        return self.dataset.n * SUPPORT_NODES[self.axes.get("spline", "cubic")]


def line_texts(source_text: str, lines: Iterable[SourceLine]) -> dict[SourceLine, str]:
    """The text of some lines of an inlined kernel source, found by its ``#line N "file"`` marks."""
    wanted = set(lines)
    found: dict[SourceLine, str] = {}
    file, number = "", 1
    for text in source_text.splitlines():
        mark = re.match(r'\s*#\s*line\s+(\d+)(?:\s+"([^"]*)")?', text)
        if mark:
            number, file = int(mark[1]), mark[2] or file
            continue
        here = SourceLine(file, number)
        if here in wanted:
            found.setdefault(here, text.strip())
        number += 1
    return found


# ---- JSON --------------------------------------------------------------------------------------------------

_NON_FINITE = "non_finite"  # JSON has no NaN or infinity: {"non_finite": "nan"}


def _plain(value: Any) -> Any:
    """Reduce to dict, list, str, int, float, bool and None."""
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, str | int | float | bool):
        return value
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, Tally):
        return {f.name: int(n) for f in fields(value) if (n := getattr(value, f.name))}
    if isinstance(value, Counters):
        lines = [[line.file, line.line, _plain(tally)] for line, tally in value.lines.items()]
        return {"total": _plain(value.total), "lines": lines}
    if isinstance(value, Profile):
        return _plain(to_plain(value))
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: _plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, Iterable):
        return [_plain(item) for item in value]
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"a record cannot hold a {type(value).__name__}")


def _strict(value: Any) -> Any:
    """Plain value -> what JSON can write."""
    if isinstance(value, float) and not math.isfinite(value):
        return {_NON_FINITE: repr(value)}
    if isinstance(value, dict):
        return {key: _strict(item) for key, item in value.items()}
    return [_strict(item) for item in value] if isinstance(value, list) else value


def to_json(record: Record) -> str:
    """One line, without the newline."""
    plain = {f.name: _plain(getattr(record, f.name)) for f in fields(record) if f.name != "line_texts"}
    plain["line_texts"] = [[line.file, line.line, text] for line, text in record.line_texts.items()]
    return json.dumps(_strict(plain), ensure_ascii=False, allow_nan=False, separators=(",", ":"))


def from_json(line: str) -> Record:
    """Inverse of ``to_json``. Raises ValueError, KeyError or TypeError for what is no record."""
    d = json.loads(line, object_hook=_revive)
    if not isinstance(d, dict) or "schema" not in d:
        raise ValueError("no record: it has no 'schema'")
    if d["schema"] not in READABLE:
        raise UnknownSchema(d["schema"])
    grid = d["dataset"]["grid"]
    d["dataset"]["grid"] = Grid(tuple(grid["shape"]), grid["dx"], tuple(grid["origin"]))
    environment = {**d["environment"], "argv": tuple(d["environment"]["argv"])}
    check = d["check"]
    return Record(**{
        **d,
        "dataset": DatasetSummary(**d["dataset"]),
        "axes": _axes(d["axes"]),
        "default_axes": _axes(d["default_axes"]),
        "environment": Environment(**environment),
        "check": None if check is None else _check(check),
        "preprocess": {name: _step(step) for name, step in d["preprocess"].items()},
        "finish": {name: _step(step) for name, step in d["finish"].items()},
        "transfer_counters": _counters(d["transfer_counters"]),
        "transfer_measurement": _measurement(d["transfer_measurement"]),
        "modelled": _modelled(d["modelled"]),
        "rest_of_step": {name: _step(step) for name, step in d.get("rest_of_step", {}).items()},
        "comparison": _comparison(d.get("comparison")),
        "repeat": _maybe(Repeat, d.get("repeat")),
        "tuning": _tuning(d.get("tuning")),
        "line_texts": {SourceLine(file, number): text for file, number, text in d["line_texts"]},
        "findings": tuple(_finding(f) for f in d["findings"]),
    })  # fmt: skip


class UnknownSchema(ValueError):
    """Written by another version of mpmbench."""


def _revive(d: dict[str, Any]) -> Any:
    return float(d[_NON_FINITE]) if d.keys() == {_NON_FINITE} else d


def _axes(d: dict[str, Any]) -> dict[str, Any]:
    return {name: tuple(value) if isinstance(value, list) else value for name, value in d.items()}


def _check(d: dict[str, Any]) -> Check:
    return Check(**{**d, "worst_node": None if d["worst_node"] is None else tuple(d["worst_node"])})


def _counters(d: dict[str, Any] | None) -> Counters | None:
    if d is None:
        return None
    lines = {SourceLine(file, number): Tally(**tally) for file, number, tally in d["lines"]}
    return Counters(Tally(**d["total"]), lines)


def _measurement(d: dict[str, Any] | None) -> Measurement | None:
    return None if d is None else Measurement(**{**d, **{key: tuple(d.get(key, ())) for key in ("samples", "hertz")}})


def _comparison(d: dict[str, Any] | None) -> Comparison | None:
    if d is None:
        return None
    speedup = None if d["speedup"] is None else tuple(d["speedup"])
    return Comparison(**{**d, "speedup": speedup, "noise": tuple(d["noise"])})


def _tuning(d: dict[str, Any] | None) -> Tuning | None:
    if d is None:
        return None
    tried = tuple(Tried(_axes(t["axes"]), t["seconds"], t["reason"]) for t in d["tried"])
    return Tuning(**{**d, "searched": tuple(d["searched"]), "tried": tried})


def _maybe(kind: Callable[..., Any], d: dict[str, Any] | None) -> Any:
    return None if d is None else kind(**d)


def _step(d: dict[str, Any]) -> StepCost:
    return StepCost(_counters(d["counters"]), _measurement(d["measurement"]))


def _modelled(d: dict[str, Any] | None) -> dict[str, Profile] | None:
    return None if d is None else {gpu: from_plain(profile) for gpu, profile in d.items()}


def _finding(d: dict[str, Any]) -> Finding:
    places = {key: SourceLine(*d[key]) if d[key] else None for key in ("line", "other_line")}
    return Finding(**{**d, **places})


# ---- files -------------------------------------------------------------------------------------------------


class RecordWriter:
    """Writes records to a JSON-lines file, each on disk before ``write`` returns.

    existing: what to do with a file that is already there: "refuse" it, "append" after its last whole row, or
    "replace" it, which happens only when the first row is on disk.
    A file has one writer at a time: a second one, in whatever process, is an InputError.
    """

    def __init__(self, path: str | Path, existing: Literal["refuse", "append", "replace"] = "refuse") -> None:
        self.path = Path(path)
        self.rows = 0  # written by this writer
        if existing == "refuse" and self.path.exists() and self.path.stat().st_size > 0:
            raise InputError(f"{self.path} exists: choose another file, or delete it first")
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._fd = os.open(self.path, os.O_RDWR | os.O_CREAT, 0o644)  # now, not after an hour of work
        except OSError as error:
            raise InputError(f"cannot write records to {self.path}: {_reason(error)}") from None
        if not _lock(self._fd, self.path):
            self.close()
            raise InputError(
                f"{self.path} is being written by another process: wait until it ends, or name another file"
            )
        self._replace = existing == "replace"
        self._end = 0  # bytes of whole rows
        if existing == "append":
            try:
                self._end = self._whole_rows()
            except InputError:
                self.close()
                raise

    def _whole_rows(self) -> int:
        """Length of the file without a torn last row; a last row that only lacks its newline gets it."""
        text = self.path.read_bytes()
        end = text.rfind(b"\n") + 1
        if end < len(text):
            try:
                from_json(text[end:].decode())
            except (ValueError, KeyError, TypeError):
                if not _torn(text[end:]):
                    raise InputError(f"{self.path}: its last line is not a record of mpmbench: remove it") from None
                os.ftruncate(self._fd, end)
                warnings.warn(f"{self.path}: dropped a torn last row before appending", stacklevel=3)
            else:
                os.pwrite(self._fd, b"\n", len(text))
                end = len(text) + 1
        return end

    def write(self, record: Record) -> None:
        """Append one row and wait until it is on disk."""
        row = to_json(record).encode() + b"\n"
        try:
            if self._replace:
                self._start_over(row)
            else:
                _put(self._fd, row, self._end)
        except KeyboardInterrupt:
            if not self._replace and os.fstat(self._fd).st_size < self._end + len(row):
                os.ftruncate(self._fd, self._end)
            raise
        except OSError as error:
            if not self._replace:
                os.ftruncate(self._fd, self._end)  # a shorter file needs no space: earlier rows stay whole
            raise InputError(
                f"cannot write row {self.rows + 1} to {self.path}: {_reason(error)}; earlier rows are intact,"
                " make room and run again"
            ) from None
        self._end += len(row)
        self.rows += 1

    def _start_over(self, row: bytes) -> None:
        """Put a new file with this row in the place of the old one, which stays as it is if the disk is full."""
        target = self.path.resolve()
        beside = target.with_name(f".{target.name}.new")
        new = os.open(beside, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o644)
        try:
            _lock(new, beside)
            _put(new, row, 0)
            beside.replace(target)
        except BaseException:
            os.close(new)
            beside.unlink(missing_ok=True)
            raise
        os.close(self._fd)
        self._fd, self._replace = new, False

    def close(self) -> None:
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def __enter__(self) -> RecordWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _lock(fd: int, path: Path) -> bool:
    """Take the file for as long as ``fd`` is open; False where somebody else has it, or has just put another file in
    its place. The lock goes with the open file: a process that is killed leaves none behind."""
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        return error.errno not in (errno.EWOULDBLOCK, errno.EACCES)  # some network file systems have no locks
    try:
        return os.path.samestat(os.fstat(fd), os.stat(path))
    except OSError:
        return False


def _put(fd: int, data: bytes, offset: int) -> None:
    """Write all of ``data`` and wait until it is on disk."""
    written = 0
    while written < len(data):
        written += os.pwrite(fd, data[written:], offset + written)
    os.fsync(fd)


def _torn(row: bytes) -> bool:
    """Whether this can be the beginning of a record: any other text is somebody's, not ours to drop."""
    begin = f'{{"{fields(Record)[0].name}":'.encode()
    return row[: len(begin)] == begin[: len(row)]


def read_records(path: str | Path) -> list[Record]:
    """All records of a JSON-lines file. A torn last row (the run was killed) is dropped with a warning."""
    path = Path(path)
    try:
        text = path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot read records from {path}: {_reason(error)}") from None
    *rows, last = text.split(b"\n")
    records = []
    for number, row in enumerate([*rows, last], start=1):
        if not row.strip():
            continue
        try:
            records.append(from_json(row.decode()))
        except UnknownSchema as error:
            known = " and ".join(map(str, READABLE))
            raise InputError(
                f"{path}:{number}: record schema {error} is not known, this mpmbench reads schema {known}:"
                " use the version that wrote the file"
            ) from None
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            if row is last and _torn(row):  # rows end in a newline: this one was being written when the run ended
                warnings.warn(f"{path}:{number}: dropped a torn last row", stacklevel=2)
                continue
            raise InputError(
                f"{path}:{number}: not a record of mpmbench ({type(error).__name__}: {error}): remove the line"
            ) from None
    return records


def _reason(error: OSError) -> str:
    return (error.strerror or str(error)).lower()


# ---- data frame --------------------------------------------------------------------------------------------


def load_records(paths: str | Path | Sequence[str | Path]) -> pd.DataFrame:
    """Records of one or more JSON-lines files as a pandas DataFrame: one row per record, flat columns.

    Columns are prefixed by what they hold: ``axis_``, ``check_``, ``transfer_``, ``preprocess_`` (all its
    steps together), ``step_<name>_``, ``modelled_<gpu>_``, ``environment_``. Counters end in
    the counter's name, times in ``_s``.
    """
    import pandas as pd

    files = [paths] if isinstance(paths, str | Path) else list(paths)
    return pd.DataFrame([flatten(record) for file in files for record in read_records(file)])


def flatten(record: Record) -> dict[str, Any]:
    """One record as a flat row of plain values."""
    row: dict[str, Any] = {
        "variant": record.variant,
        "transfer": record.transfer,
        "status": record.status,
        "device": record.device,
        "cache": record.cache,
        "arch": record.arch,
        "dataset": record.dataset.name,
        "particles": record.dataset.n,
        "grid": "x".join(map(str, record.dataset.grid.shape)),
        "dataset_seed": record.dataset.seed,
        "fingerprint": record.dataset.fingerprint,
    }
    for name, value in record.axes.items():
        row[f"axis_{name}"] = "x".join(map(str, value)) if isinstance(value, tuple) else value
    if record.check:
        row |= {f"check_{key}": getattr(record.check, key) for key in ("passed", "worst_error", "allowed", "ratio")}
    row |= _flat_cost("transfer", StepCost(record.transfer_counters, record.transfer_measurement))
    if record.comparison:
        row |= {f"comparison_{name}": value for name, value in asdict(record.comparison).items()
                if name not in ("speedup", "noise")}  # fmt: skip
        for name in ("speedup", "noise"):
            three = getattr(record.comparison, name) or (None, None, None)
            row |= dict(zip((f"comparison_{name}{end}" for end in ("", "_low", "_high")), three, strict=True))
    if record.repeat:
        row |= {f"repeat_{name}": value for name, value in asdict(record.repeat).items()}
    row |= _flat_cost("preprocess", total_cost(record.preprocess.values()))
    for name, step in record.steps.items():
        row |= _flat_cost(f"step_{name}", step)
    for gpu, profile in (record.modelled or {}).items():
        time = profile.time
        shown = {"s": time.seconds, "low_s": time.low, "high_s": time.high, "bound": time.bound}
        row |= {f"modelled_{gpu}_{name}": value for name, value in shown.items()}
    row |= {
        "device_bytes_predicted": record.device_bytes_predicted,
        "findings": len(record.findings),
        "host_s": record.host_seconds,
        "skipped_because": record.skipped_because,
        "failed_because": record.failed_because,
    }
    for name, value in (record.preset_row or {}).items():
        row[f"preset_{name}"] = value
    for name, value in asdict(record.environment).items():
        row[f"environment_{name}"] = " ".join(value) if name == "argv" else value
    row |= {f"environment_gpu_{name}": value for name, value in row.pop("environment_gpu").items()}
    return row


def _flat_cost(prefix: str, cost: StepCost) -> dict[str, Any]:
    row: dict[str, Any] = {}
    if cost.counters:
        total = cost.counters.total
        row |= {f"{prefix}_{f.name}": getattr(total, f.name) for f in fields(total)}
        row[f"{prefix}_sectors"] = total.sectors
    if cost.measurement:
        q1, q3 = cost.measurement.quartiles
        row |= {f"{prefix}_median_s": cost.measurement.median, f"{prefix}_q1_s": q1, f"{prefix}_q3_s": q3}
        row[f"{prefix}_samples"] = len(cost.measurement.samples)
        row[f"{prefix}_cache"] = cost.measurement.mode
        if cost.measurement.hertz:
            row[f"{prefix}_median_hz"] = statistics.median(cost.measurement.hertz)
    return row


def total_cost(steps: Iterable[StepCost]) -> StepCost:
    """Sum of steps. Times add by their medians, as one sample: steps are sampled apart from each other."""
    steps = list(steps)
    counters = [s.counters for s in steps if s.counters is not None]
    times = [s.measurement for s in steps if s.measurement is not None]
    measurement = None
    if times and len(times) == len(steps):
        measurement = Measurement(
            (sum(t.median for t in times),), times[0].mode, min(t.warmups for t in times), "sum of medians"
        )
    return StepCost(sum(counters[1:], counters[0]) if counters else None, measurement)
