"""A sweep in parts: each is one ``mpmbench run`` with a journal of its own, in a process or a cluster job of its own.

A part that ends badly keeps its rows and does not stop the others; run again with ``--resume``, each goes on where it
was. At the end the journals become one, in the order in which a single run would have written it.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Protocol

from mpmbench.contest import baseline_of, contests
from mpmbench.errors import InputError
from mpmbench.record import Record, read_records
from mpmbench.runner import Inputs, tuned_key

FINISHED = (0, 1, 4)  # exit codes of a run that came to its end, whatever it found
STOP_SECONDS = 10.0  # that a part has to end after Ctrl-C
POLL_SECONDS = 0.5
FOREVER_MINUTES = 60 * 24 * 365


@dataclass(frozen=True)
class Slot:
    """What one part at a time runs on. environment: of its process."""

    name: str
    environment: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Part:
    """words: of the command line behind ``mpmbench``.  slots: where it may run.  rows: how many it makes.
    group: parts of equal group share their cases out; those of different groups run the same ones."""

    name: str
    words: tuple[str, ...]
    slots: tuple[Slot, ...]
    journal: Path
    rows: int
    group: str = ""

    @property
    def done(self) -> int:
        """Whole rows in its journal."""
        try:
            return self.journal.read_bytes().count(b"\n")
        except OSError:
            return 0


@dataclass(frozen=True)
class Outcome:
    """How a part ended. code: of its process, None where it was killed or crashed.  errors: its standard error."""

    part: Part
    code: int | None
    errors: str

    @property
    def failed(self) -> bool:
        """A run that made all of its rows has not failed, even if some of them are wrong."""
        return self.code not in FINISHED or self.part.done < self.part.rows

    @property
    def last_lines(self) -> list[str]:
        """Of what it had to say, the launcher's own lines left out."""
        lines = [line.rstrip() for line in self.errors.splitlines() if line.strip()]
        return [line for line in lines if not line.startswith("submitit ")][-5:]


# --- running one part -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Command:
    """``mpmbench`` with these words, to be called in a fresh process. Returns the exit code."""

    words: tuple[str, ...]
    environment: Mapping[str, str]

    def __call__(self) -> int:
        from mpmbench.cli import main

        os.environ.update(self.environment)  # no device is open yet
        before, sys.argv = sys.argv, ["mpmbench", *self.words]  # what records say about where they come from
        try:
            main(list(self.words), prog_name="mpmbench")
        except SystemExit as end:
            return end.code if isinstance(end.code, int) else int(end.code is not None)
        finally:
            sys.argv = before
        return 0

    def checkpoint(self) -> Any:
        """What a cluster queues again when the time is up: the same, for it resumes."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self)


class Running(Protocol):
    def done(self) -> bool:
        """Whether it has ended."""

    def outcome(self, part: Part) -> Outcome:
        """How; once it has ended."""

    def stop(self) -> None:
        """Ask it to end as Ctrl-C does."""


class Launcher(Protocol):
    def start(self, part: Part, slot: Slot) -> Running:
        """Start a part."""

    def batch(self) -> AbstractContextManager[Any]:
        """Around starts that may be one request."""


@dataclass
class _Process:
    process: subprocess.Popen[bytes]
    errors: Path

    def done(self) -> bool:
        return self.process.poll() is not None

    def outcome(self, part: Part) -> Outcome:
        code = self.process.wait()
        return Outcome(part, None if code < 0 else code, self.errors.read_text(errors="replace"))

    def stop(self) -> None:
        self.process.terminate()


@dataclass
class Subprocesses:
    """Parts as plain processes of this machine; nothing has to be installed for it. folder: for what they print."""

    folder: Path

    def start(self, part: Part, slot: Slot) -> Running:
        self.folder.mkdir(parents=True, exist_ok=True)
        out, errors = (self.folder / f"{part.name}.{end}" for end in ("out", "err"))
        with out.open("wb") as to_out, errors.open("wb") as to_errors:
            process = subprocess.Popen(
                [sys.executable, "-m", "mpmbench", *part.words],
                stdin=subprocess.DEVNULL,
                stdout=to_out,
                stderr=to_errors,
                env={**os.environ, **slot.environment},
            )
        return _Process(process, errors)

    def batch(self) -> AbstractContextManager[Any]:
        return nullcontext()


@dataclass
class _Job:
    job: Any  # submitit.Job

    def done(self) -> bool:
        return bool(self.job.done())

    def outcome(self, part: Part) -> Outcome:
        problem = self.job.exception()
        errors = self.job.stderr() or ("" if problem is None else str(problem))
        return Outcome(part, self.job.result() if problem is None else None, errors)

    def stop(self) -> None:
        self.job.cancel()


@dataclass
class Submitted:
    """Parts as jobs of submitit. executor: ready to submit.  work: what a job calls."""

    executor: Any  # submitit.Executor
    work: Callable[[tuple[str, ...], Mapping[str, str]], Callable[[], int]] = Command

    def start(self, part: Part, slot: Slot) -> Running:
        return _Job(self.executor.submit(self.work(part.words, slot.environment)))

    def batch(self) -> AbstractContextManager[Any]:
        batch: AbstractContextManager[Any] = self.executor.batch()
        return batch


@dataclass
class _Local(Submitted):
    folder: Path = Path()

    @contextmanager
    def batch(self) -> Iterator[None]:
        """The processes that watch over the jobs inherit standard error, and end with a traceback when they are
        stopped: it goes to the logs."""
        with (self.folder / "watchers.err").open("ab") as log:
            standard = os.dup(2)
            os.dup2(log.fileno(), 2)
            try:
                with self.executor.batch():
                    yield
            finally:
                os.dup2(standard, 2)
                os.close(standard)


def local_launcher(folder: Path) -> Launcher:
    """Processes of this machine: submitit's, where it is installed, else our own."""
    try:
        from submitit import AutoExecutor
    except ImportError:
        return Subprocesses(folder)
    executor = AutoExecutor(folder=folder, cluster="local")
    executor.update_parameters(timeout_min=FOREVER_MINUTES)  # it would end every job after two minutes
    return _Local(executor, folder=folder)


def slurm_launcher(
    folder: Path, gpus: int, minutes: int, partition: str | None, at_once: int | None, options: Sequence[str] = ()
) -> Launcher:
    """Jobs of a SLURM cluster, one array. folder: on a disk that its nodes share.  gpus: per job.  minutes: after which
    a job is queued again, to go on.  options: further ones of sbatch, ``key=value`` or a key alone."""
    try:
        from submitit import AutoExecutor
    except ImportError as error:
        raise InputError("--executor slurm needs submitit: pip install 'mpmbench[slurm]'") from error
    parameters = {"slurm_time": minutes, "slurm_job_name": "mpmbench", **_sbatch_options(options)}
    if gpus and "slurm_gres" not in parameters:
        parameters.setdefault("slurm_gpus_per_node", gpus)
    if partition:
        parameters["slurm_partition"] = partition
    if at_once:
        parameters["slurm_array_parallelism"] = at_once
    try:
        executor = AutoExecutor(folder=folder, cluster="slurm")
    except RuntimeError as error:
        raise InputError("there is no SLURM here (no srun): run this on its login node, or --executor local") from error
    executor.update_parameters(**parameters)
    return Submitted(executor)


def _sbatch_options(texts: Sequence[str]) -> dict[str, Any]:
    """``account=me`` -> what submitit calls it; options that it does not know go to sbatch as they are."""
    from submitit.slurm.slurm import _get_default_parameters

    known, lists = _get_default_parameters(), ("setup", "teardown", "srun_args")
    parameters: dict[str, Any] = {}
    for text in texts:
        key, equals, value = text.partition("=")
        key = key.strip().lstrip("-").replace("-", "_")
        if not key or (equals and not value):
            raise InputError(f"cannot read --slurm {text!r}: write it as key=value, such as account=me")
        read = (int(value) if value.isdigit() else value) if equals else True
        if key in lists:
            parameters.setdefault(f"slurm_{key}", []).append(value)
        elif key in known:
            parameters[f"slurm_{key}"] = read
        else:
            parameters.setdefault("slurm_additional_parameters", {})[key.replace("_", "-")] = read
    return parameters


# --- running all ------------------------------------------------------------------------------------------------------


def run_parts(
    parts: Sequence[Part],
    launcher: Launcher,
    at_once: int | None = None,
    tick: Callable[[int, int], None] = lambda rows, ended: None,
    poll: float = POLL_SECONDS,
) -> list[Outcome]:
    """Run every part, never two on one slot. tick: told the rows and the parts that are done.

    at_once: most parts that run side by side, whatever slots are free.
    """
    waiting, running, outcomes = list(parts), list[tuple[Part, Slot, Running]](), list[Outcome]()
    try:
        while waiting or running:
            startable = list(_startable(waiting, [slot for _, slot, _ in running], at_once))
            if startable:
                with launcher.batch():
                    for part, slot in startable:
                        running.append((part, slot, launcher.start(part, slot)))
                        waiting.remove(part)
            for one in [one for one in running if one[2].done()]:
                running.remove(one)
                outcomes.append(one[2].outcome(one[0]))
            tick(sum(part.done for part in parts), len(outcomes))
            if running:
                time.sleep(poll)
    except BaseException:
        _stop([job for _, _, job in running])
        raise
    return outcomes


def _startable(waiting: Iterable[Part], taken: Iterable[Slot], at_once: int | None) -> Iterator[tuple[Part, Slot]]:
    """Parts with a free slot for each."""
    names = [slot.name for slot in taken]
    for part in waiting:
        if at_once is not None and len(names) >= at_once:
            return
        free = next((slot for slot in part.slots if slot.name not in names), None)
        if free is not None:
            names.append(free.name)
            yield part, free


def _stop(jobs: Sequence[Running]) -> None:
    for job in jobs:
        job.stop()
    limit = time.monotonic() + STOP_SECONDS
    while time.monotonic() < limit and not all(job.done() for job in jobs):
        time.sleep(0.1)


# --- GPUs of this machine ---------------------------------------------------------------------------------------------

_ASK = """
import json
from mpmbench.device import open_device
count = open_device("cuda").count
print(json.dumps([open_device(f"cuda:{i}").facts["name"] for i in range(count)]))
"""


def gpus_here() -> list[tuple[Slot, str]]:
    """A slot for each GPU that this process may use, in nvidia-smi's order unless CUDA_VISIBLE_DEVICES is set, and its
    model; none where there is none. Another process asks: this one is not to hold memory of theirs."""
    given = os.environ.get("CUDA_VISIBLE_DEVICES")
    order = {} if given is not None else {"CUDA_DEVICE_ORDER": "PCI_BUS_ID"}
    asked = subprocess.run([sys.executable, "-c", _ASK], capture_output=True, text=True, env={**os.environ, **order})
    if asked.returncode:
        return []
    models = json.loads(asked.stdout)
    names = list(map(str, range(len(models)))) if given is None else [name.strip() for name in given.split(",")]
    return [
        (Slot(f"gpu{i}", {"CUDA_VISIBLE_DEVICES": name, **order}), model)
        for i, (name, model) in enumerate(zip(names, models, strict=False))
    ]


# --- one journal of many ----------------------------------------------------------------------------------------------


def merge(
    parts: Sequence[Part], cases: Sequence[Any], devices: Sequence[str], caches: Sequence[str], baseline: str = ""
) -> list[Record]:
    """The rows of all parts as a single run would have written them: each once, group by group."""
    place = _places(cases, baseline)
    found: dict[tuple[Any, ...], Record] = {}
    sort: dict[tuple[Any, ...], tuple[int, ...]] = {}
    groups = list(dict.fromkeys(part.group for part in parts))
    for part in parts:
        for record in read_records(part.journal) if part.journal.exists() else []:
            key = (part.group, tuned_key(record), record.cache)
            found.setdefault(key, record)
            sort[key] = (
                groups.index(part.group),
                list(devices).index(record.device.partition(":")[0]),
                list(caches).index(record.cache) if record.cache is not None else 0,
                place[record.cache is not None].get(_anywhere(tuned_key(record)), len(cases)),
            )
    return [found[key] for key in sorted(found, key=lambda key: sort[key])]


def _places(cases: Sequence[Any], baseline: str) -> dict[bool, dict[Any, int]]:
    """Where the row of a case comes, by whether it is timed: then contest by contest, the baseline first."""
    inputs, nowhere = Inputs(), SimpleNamespace(name="", arch="")
    timed: list[Any] = []
    for group in contests(cases, inputs):
        first = baseline_of(group, baseline)
        timed += [first, *(case for case in group if case is not first)]
    return {
        is_timed: {_anywhere(case.resume_key(nowhere, inputs)): i for i, case in enumerate(ordered)}
        for is_timed, ordered in ((False, cases), (True, timed))
    }


def _anywhere(key: tuple[Any, ...]) -> tuple[Any, ...]:
    """A resume key without the device."""
    name, axes, fingerprint, _, *published = key
    return (name, axes, fingerprint, *published)


def describe(folder: Path, parts: Sequence[Part], resume: bool) -> None:
    """Note in the folder what is swept, and refuse to mix it with another sweep."""
    path = folder / "sweep.json"
    content = json.dumps({part.name: list(part.words) for part in parts}, indent=1) + "\n"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        beside = path.with_name("sweep.json.partial")
        beside.write_text(content)
        beside.replace(path)
    elif not resume:
        raise InputError(f"{folder} holds a sweep: go on with --resume, or name another folder with --out")
    elif path.read_text() != content:
        raise InputError(
            f"{folder} holds a sweep of other options or parts ({path}): repeat those, or name another --out"
        )
