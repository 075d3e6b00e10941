"""``mpmbench sweep``: what ``mpmbench run`` runs, in parts: one process per GPU, some without a GPU, or SLURM jobs."""

from __future__ import annotations

import inspect
import os
import shlex
import signal
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from mpmbench import cli
from mpmbench.cli import main, run
from mpmbench.errors import InputError

if TYPE_CHECKING:
    from mpmbench.sweep import Outcome, Part, Slot

HARNESS_ERROR = 1

# A sweep has its own of these; and of every file that ``run`` writes.
_OWN = ("gpu_names", "shard", "resume", "dry_run")


def shared_options(command: click.Command) -> list[click.Option]:
    """The options of ``run`` that each part is given: those that choose cases and how they are run."""
    options = [option for option in command.params if isinstance(option, click.Option)]
    writes = [option for option in options if isinstance(option.type, click.Path) and not option.multiple]
    return [option for option in options if option not in writes and option.name not in _OWN]


def words_of(options: Iterable[click.Option], given: Mapping[str, Any]) -> list[str]:
    """The command line that gives these values."""
    words: list[str] = []
    for option in options:
        value, flag = given[str(option.name)], max(option.opts, key=len)
        if value is None or value is False or value == () or value == "":
            continue
        if option.is_flag:
            words.append(flag)
            continue
        for one in value if option.multiple else (value,):
            words += [flag, *map(str, one if option.nargs > 1 else (one,))]
    return words


@main.command(params=[*shared_options(run)])
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    required=True,
    metavar="DIR",
    help="Folder for rows.jsonl, report.html, report.md and what the parts leave.",
)
@click.option(
    "--executor",
    type=click.Choice(["local", "slurm"]),
    default="local",
    show_default=True,
    help="Processes of this machine, or jobs of a SLURM cluster.",
)
@click.option(
    "--gpus",
    metavar="0,1|all|none",
    help="GPUs of this machine, one process each. Default: all, or none with -d simulated or cpu.",
)
@click.option(
    "--each/--split",
    default=True,
    show_default=True,
    help="Every GPU runs every case, for a winner per GPU; or GPUs of one model share the cases out.",
)
@click.option("--serial-gpus", is_flag=True, help="One GPU at a time: neighbours share power and heat.")
@click.option(
    "--shards",
    type=click.IntRange(min=1),
    metavar="N",
    help="Parts that the cases are cut into. Default: 1; with --split or without GPUs, one per process.",
)
@click.option(
    "--workers",
    type=click.IntRange(min=1),
    metavar="N",
    help="Processes at a time without a GPU, or SLURM jobs at a time.",
)
@click.option("--partition", metavar="NAME", help="SLURM partition.")
@click.option(
    "--time",
    "minutes",
    type=click.IntRange(min=1),
    default=240,
    show_default=True,
    metavar="MINUTES",
    help="Of a SLURM job; then it is queued again and goes on, up to three times.",
)
@click.option(
    "--slurm",
    "slurm_options",
    multiple=True,
    metavar="KEY=VALUE",
    help="Further sbatch options: --slurm account=me --slurm gres=gpu:a100:1",
)
@click.option("--resume", is_flag=True, help="Go on with the sweep in --out DIR: run only what is missing.")
@click.option("--dry-run", is_flag=True, help="Say which parts would run, and stop.")
def sweep(
    out: Path,
    executor: str,
    gpus: str | None,
    each: bool,
    serial_gpus: bool,
    shards: int | None,
    workers: int | None,
    partition: str | None,
    minutes: int,
    slurm_options: Sequence[str],
    resume: bool,
    dry_run: bool,
    **given: Any,
) -> None:
    """Run what `run` runs in parts, side by side, and merge their rows into one report.

    \b
    mpmbench sweep --out swept --dataset my_particles.npz              # every GPU here runs every case
    mpmbench sweep --out swept --preset thesis --gpus 0,1,2,3 --split  # four GPUs of one model share the cases
    mpmbench sweep --out swept --preset demo -d simulated --workers 8
    mpmbench sweep --out swept --preset thesis --executor slurm --shards 16 --partition gpu --slurm account=me
    """  # fmt: skip
    from mpmbench import sweep as sweeping
    from mpmbench.runner import refuse_bad_input

    caches, axes = cli._cache_states(given["axes"])
    caches = [timing.cache for timing in cli._timings(caches, given["quick"], given["rigorous"], given["baseline"])]
    chosen = {name: given[name] for name in inspect.signature(cli._choose).parameters if name in given}
    cases = cli._choose(**chosen | {"axes": axes, "preset_name": given["preset_name"]})
    if given["tune"] is not None:
        cases = cli._to_search(cases, given["tune"], axes, given["preset_name"])
    cli._refuse_unknown_baseline(cases, given["baseline"])
    slots, models = _slots(executor, gpus, tuple(given["devices"]), workers, shards, len(cases))
    on_gpus = bool(models) or (executor == "slurm" and _wants_gpu(given["devices"]))
    devices = tuple(given["devices"]) or (("cuda",) if on_gpus else ("simulated",))
    if given["tune"] is not None and "simulated" in devices:
        raise InputError("--tune needs times: sweep GPUs, or -d cpu")
    if not each and len(set(models.values())) > 1:
        differing = ", ".join(f"{name} is {model}" for name, model in models.items())
        raise InputError(f"--split is for GPUs of one model ({differing}): use --each, or name equal ones with --gpus")
    words = ["run", *words_of(shared_options(run), given | {"devices": devices})]
    parts = _parts(out, words, cases, devices, len(caches), slots, bool(models) and each, shards)
    if dry_run:
        for part in parts:
            where = "/".join(slot.name for slot in part.slots) if len(part.slots) < len(parts) else "any"
            cli.console.print(f"{part.name}  {part.rows} rows on {where}: mpmbench {shlex.join(part.words)}",
                              markup=False, soft_wrap=True)  # fmt: skip
        cli.console.print(f"{len(parts)} parts, {sum(part.rows for part in parts)} rows")
        return
    refuse_bad_input(cases)
    folder = out / "shards" / "logs"
    if executor == "slurm":
        launcher = sweeping.slurm_launcher(folder, int(on_gpus), minutes, partition, workers, slurm_options)
    else:
        launcher = sweeping.local_launcher(folder)
    sweeping.describe(out, parts, resume)
    cli._terminate_like_ctrl_c()
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # in the background of a script: parts would be deaf as well
        signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with _following(parts) as tick:
            outcomes = sweeping.run_parts(parts, launcher, 1 if serial_gpus else None, tick)
    except KeyboardInterrupt:
        cli.notes.print(f"mpmbench: interrupted; rows so far are in {out / 'shards'}: the same command with --resume"
                        " goes on from there", markup=False, soft_wrap=True)  # fmt: skip
        sys.exit(cli.INTERRUPTED)
    _finish(out, outcomes, sweeping.merge(parts, cases, [d.partition(":")[0] for d in devices], caches,
                                          given["baseline"]))  # fmt: skip


def _wants_gpu(devices: Sequence[str]) -> bool:
    return all(name.partition(":")[0] == "cuda" for name in devices)


def _slots(
    executor: str, gpus: str | None, devices: tuple[str, ...], workers: int | None, shards: int | None, cases: int
) -> tuple[list[Slot], dict[str, str]]:
    """Where parts may run, and the model of each GPU among them."""
    from mpmbench.sweep import Slot, gpus_here

    if numbered := [name for name in devices if name.startswith("cuda:")]:
        raise InputError(f"a sweep names its GPUs with --gpus: write -d cuda, not -d {numbered[0]}")
    if "cuda" in devices and not _wants_gpu(devices):
        raise InputError("GPUs and other devices are swept apart: give -d cuda alone, or leave it out")
    if executor == "slurm":
        if gpus not in (None, "none"):
            raise InputError("SLURM gives each part a GPU of its own: leave out --gpus; --slurm constraint=NAME or "
                             "--slurm gres=gpu:NAME:1 chooses the model")  # fmt: skip
        return [Slot(f"job{i}") for i in range(shards or workers or 1)], {}
    if gpus not in (None, "none") and not _wants_gpu(devices):
        raise InputError(f"--gpus is for -d cuda: leave it out with -d {devices[0]}, or leave out -d")
    if gpus != "none" and _wants_gpu(devices):
        found = gpus_here()
        if found and workers is not None:
            raise InputError("--workers is for sweeps without a GPU: a GPU has one process at a time")
        if found:
            taken = _named(gpus or "all", found)
            return [slot for slot, _ in taken], {slot.name: model for slot, model in taken}
        if gpus is not None or devices:
            raise InputError("no GPU that CuPy can use here: see mpmbench doctor, or sweep -d simulated")
    if "cuda" in devices:
        raise InputError("-d cuda needs a GPU: leave out --gpus none")
    if "cpu" in devices:
        if (workers or 1) > 1:
            raise InputError("-d cpu is timed, and neighbours disturb it: leave out --workers, parts run one by one")
        workers = 1
    return [Slot(f"worker{i}") for i in range(workers or min(len(os.sched_getaffinity(0)), cases) or 1)], {}


def _named(text: str, found: Sequence[tuple[Slot, str]]) -> list[tuple[Slot, str]]:
    """The GPUs that ``0,2`` or ``all`` means."""
    if text == "all":
        return list(found)
    numbers = [word.strip() for word in text.split(",")]
    if len(set(numbers)) < len(numbers):
        raise InputError(f"--gpus {text} names a GPU twice: a GPU has one process at a time")
    here = {str(i): one for i, one in enumerate(found)}
    if wrong := [number for number in numbers if number not in here]:
        raise InputError(f"no GPU {wrong[0]!r}: --gpus takes all, none, or some of {','.join(here)}")
    return [here[number] for number in numbers]


def _parts(
    out: Path,
    words: Sequence[str],
    cases: Sequence[Any],
    devices: Sequence[str],
    caches: int,
    slots: Sequence[Slot],
    each: bool,
    shards: int | None,
) -> list[Part]:
    """Every shard of the cases on every GPU, or on whichever slot is free; shards without a case are left out."""
    from mpmbench.session import shard
    from mpmbench.sweep import Part

    timed = sum(name.partition(":")[0] != "simulated" for name in devices)
    per_case = timed * caches + len(devices) - timed
    count = shards or (1 if each else len(slots))
    parts = []
    for group in slots if each else [None]:
        for i in range(1, count + 1):
            piece = shard(cases, f"{i}/{count}", together=timed > 0)
            name = "-".join(([group.name] if group else []) + ([f"{i}of{count}"] if count > 1 or not group else []))
            journal = out / "shards" / f"{name}.jsonl"
            # Always resumed: a journal that is not there yet has nothing to keep.
            command = (*words, "--shard", f"{i}/{count}", "--json", str(journal), "--resume")
            if piece:
                where = (group,) if group else tuple(slots)
                parts.append(Part(name, command, where, journal, per_case * len(piece), group.name if group else ""))
    return parts


class _following:
    """Progress of all parts, read from their journals: a bar, or lines where nobody looks."""

    def __init__(self, parts: Sequence[Part]) -> None:
        self.rows, self.parts = sum(part.rows for part in parts), len(parts)
        self.first = self.last = sum(part.done for part in parts)
        self.begin = time.monotonic()
        self.progress = cli._progress()

    def __enter__(self) -> Callable[[int, int], None]:
        self.progress.start()
        self.task = self.progress.add_task("", total=self.rows, completed=self.first)
        return self.tick

    def __exit__(self, *_: object) -> None:
        self.progress.stop()

    def tick(self, rows: int, ended: int) -> None:
        told = f"{ended} of {self.parts} parts ended"
        self.progress.update(self.task, completed=rows, description=told)
        if rows != self.last and not self.progress.console.is_terminal:
            cli.notes.print(f"[{rows}/{self.rows}] rows, {told}{self._left(rows)}", markup=False, soft_wrap=True)
        self.last = rows

    def _left(self, rows: int) -> str:
        if not self.first < rows < self.rows:
            return ""
        seconds = (time.monotonic() - self.begin) / (rows - self.first) * (self.rows - rows)
        return f", about {seconds:.0f} s left" if seconds < 120 else f", about {seconds / 60:.0f} min left"


def _finish(out: Path, outcomes: Sequence[Outcome], records: list[Any]) -> None:
    """Merged rows, reports, what failed and why; exit codes as ``run`` has them."""
    from mpmbench.record import to_json

    failed = [outcome for outcome in outcomes if outcome.failed]
    rows, page, text = out / "rows.jsonl", out / "report.html", out / "report.md"
    if records:
        cli._write_whole(rows, "".join(to_json(record) + "\n" for record in records))
        cli._write_reports(records, page, text, None)
    for outcome in failed:
        part, ended = outcome.part, "was killed" if outcome.code is None else f"ended with exit code {outcome.code}"
        cli.notes.print(f"part {part.name} {ended} after {part.done} of {part.rows} rows:", markup=False,
                        soft_wrap=True, style="red")  # fmt: skip
        for line in outcome.last_lines:
            cli.notes.print(f"  {line}", markup=False, soft_wrap=True)
    if failed:
        cli.notes.print("the rows of the other parts are kept: mend the cause, then the same command with --resume")
    if records:
        try:
            cli._summarise(records, [rows, page, text])
        except SystemExit as end:
            if not failed or end.code == cli.WRONG_RESULT:
                raise
    if failed:
        sys.exit(InputError.exit_code if all(one.code == InputError.exit_code for one in failed) else HARNESS_ERROR)
