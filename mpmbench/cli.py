"""The command line: ``mpmbench list | run | sweep | check | profile | report | compare | verify | doctor | ...``.

Names and axis syntax follow NVBench. Exit codes: 0 ok, 1 harness error, 2 usage or bad input, 3 regression, 4 wrong
results or findings, 130 interrupted.
"""

from __future__ import annotations

import fnmatch
import json
import os
import signal
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table as RichTable

from mpmbench.cli_reproduce import reproduce
from mpmbench.errors import InputError, MpmbenchError

console = Console(stderr=False, highlight=False)
notes = Console(stderr=True, highlight=False)  # progress and warnings: standard output stays parseable

WRONG_RESULT = 4
INTERRUPTED = 130


class _Group(click.Group):
    """Turns every error that a user can mend into one line and an exit code."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        ctx.meta["given"] = tuple(args)
        return super().parse_args(ctx, args)

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except MpmbenchError as error:
            notes.print(f"mpmbench: {error}", soft_wrap=True, markup=False, style="red")
            ctx.exit(error.exit_code)
        except OSError as error:
            if isinstance(error, BrokenPipeError):
                raise
            where = f"{error.filename}: " if error.filename else ""
            notes.print(f"mpmbench: {where}{(error.strerror or str(error)).lower()}", soft_wrap=True, markup=False)
            ctx.exit(InputError.exit_code)
        except MemoryError:
            notes.print("mpmbench: out of memory: take fewer particles (--particles) or a smaller grid", soft_wrap=True)
            ctx.exit(1)
        except KeyboardInterrupt:
            journal = any(word.split("=")[0] == "--json" for word in ctx.meta["given"])
            kept = journal and ctx.invoked_subcommand == "run"
            more = "; what is in --json FILE is whole, run --resume goes on from there" if kept else ""
            notes.print(f"mpmbench: interrupted{more}", soft_wrap=True)
            ctx.exit(INTERRUPTED)


@click.group(cls=_Group, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(package_name="mpmbench", message="mpmbench %(version)s")
def main() -> None:
    """Which particle-grid transfer strategy is fastest on this GPU, for these particles, at this accuracy, and why?

    Without a GPU the same CUDA kernels run on a simulated device: checked, counted, never timed.
    """


# --- choosing cases ---------------------------------------------------------------------------------------------------


def _selection(command: Callable[..., Any]) -> Callable[..., Any]:
    """The options that choose variants, datasets, axes and the device; shared by run and check."""
    options = [
        click.option("-b", "--benchmark", "patterns", multiple=True, metavar="GLOB",
                     help="Variants, primitives and peers by name or glob. Default: every variant; peers with -d cpu."),
        click.option("--dataset", "datasets", multiple=True, metavar="NAME|FILE",
                     help="Recipe name, or a .npz/.npy file of your own particles. Default: uniform_cube."),
        click.option("-a", "--axis", "axes", multiple=True, metavar="AXIS=VALUES",
                     help='Axis values: -a dtype=float64, -a "batching=[1,2,4]", -a "block_shape=[8x4x4,4x4x4]".'),
        click.option("--particles", type=click.IntRange(min=0), help="Particles of recipe datasets."),
        click.option("--size", type=click.IntRange(min=0, max=2**31 - 1), help="Elements that a primitive works on."),
        click.option("--particles-per-cell", "--ppc", type=click.IntRange(min=1), help="Density where it is exact."),
        click.option("--seed", type=click.IntRange(min=0), help="Seed of recipe datasets."),
        click.option("--grid-shape", metavar="NXxNYxNZ", help="Nodes per axis; a .npy file carries no grid."),
        click.option("--dx", type=float, help="Node spacing [m]."),
        click.option("--origin", type=(float, float, float), metavar="X Y Z", help="Position of node (0, 0, 0) [m]."),
        click.option("-d", "--device", "devices", multiple=True, metavar="DEVICE",
                     help="simulated, cpu, cuda, cuda:N. Default: simulated, and cuda where there is a GPU."),
        click.option("--arch", default=None, metavar="sm_XX", help="Architecture the simulated device compiles for."),
        click.option("--variants", "variant_dirs", multiple=True, type=click.Path(path_type=Path), metavar="DIR",
                     help="A folder with your own kernel (.cu) and module (.py); may be given again."),
        click.option("--quick", is_flag=True, help="At most 20,000 particles of recipe datasets, fewer samples."),
    ]  # fmt: skip
    for option in reversed(options):
        command = option(command)
    return command


def _choose(
    patterns: Sequence[str],
    datasets: Sequence[str],
    axes: Sequence[str],
    particles: int | None,
    size: int | None,
    particles_per_cell: int | None,
    seed: int | None,
    grid_shape: str | None,
    dx: float | None,
    origin: tuple[float, float, float] | None,
    variant_dirs: Sequence[Path],
    quick: bool,
    preset_name: str | None = None,
    devices: Sequence[str] = (),
) -> list[Any]:
    """The cases that the options ask for."""
    from mpmbench import peers, presets, primitives, variants
    from mpmbench.dataset import list_datasets
    from mpmbench.peer_runs import peer_cases
    from mpmbench.primitive_runs import primitive_cases
    from mpmbench.runner import DatasetChoice, cases_of

    limit = particles if particles is not None else QUICK_PARTICLES if quick else None
    size = size if size is not None else QUICK_SIZE if quick else None
    if preset_name is not None:
        if datasets or axes:
            raise InputError("--preset fixes datasets and axes: leave out --dataset and -a, or leave out --preset")
        cases: list[Any] = list(presets.preset(preset_name))
        if patterns:
            everything = [*variants.discover(), *primitives.discover()]
            wanted = {strategy.name for strategy in _match(everything, patterns)}
            cases = [case for case in cases if case.name in wanted]
        return [case.shrunk(particles=limit, size=size) for case in cases]
    shipped = list(variants.discover(variant_dirs))
    if patterns:
        chosen = _match([*shipped, *primitives.discover(variant_dirs), *peers.discover()], patterns)
    else:
        chosen = [*shipped, *peers.by_default(devices)]
    transfers = [strategy for strategy in chosen if isinstance(strategy, variants.Variant)]
    blocks = [strategy for strategy in chosen if isinstance(strategy, primitives.Primitive)]
    others = [strategy for strategy in chosen if isinstance(strategy, peers.Peer)]
    given: dict[str, list[Any]] = {}
    for name, values in map(_parse_axis, axes):
        if name in given:
            raise InputError(f"axis {name!r} is given twice: write {name}=[value,value]")
        given[name] = list(dict.fromkeys(values))
    known = {name for strategy in chosen for name in strategy.axes}
    if unknown := [name for name in given if name not in known]:
        raise InputError(f"unknown axis {unknown[0]!r}: valid are {', '.join(sorted(known))}")
    sizable = {recipe.name for recipe in list_datasets() if "particles" in recipe.parameters}
    choices = [
        DatasetChoice(
            name,
            limit if name in sizable else particles,
            particles_per_cell,
            seed,
            _parse_shape(grid_shape),
            dx,
            origin,
        )
        for name in dict.fromkeys(datasets or ("uniform_cube",))
    ]
    of_transfers = {name: values for name, values in given.items() if any(name in t.axes for t in transfers)}
    return [
        *cases_of(transfers, choices, of_transfers),
        *peer_cases(others, choices, given),
        *primitive_cases(blocks, given, size, seed),
    ]


QUICK_PARTICLES = 20_000
QUICK_SIZE = 65_536  # of primitives


def _parse_shape(text: str | None) -> tuple[int, int, int] | None:
    from mpmbench.presets import parse_value

    shape = parse_value(text) if text is not None else None
    if shape is not None and not isinstance(shape, tuple):
        raise InputError(f"cannot read grid shape {text!r}: write it as three whole numbers, such as 128x128x128")
    return shape


def _match(variants: Iterable[Any], patterns: Sequence[str]) -> list[Any]:
    variants = list(variants)
    chosen = []
    for pattern in patterns:
        found = [v for v in variants if fnmatch.fnmatchcase(v.name, pattern)]
        if not found:
            raise InputError(f"nothing matches {pattern!r}: valid are {', '.join(v.name for v in variants)}")
        chosen += [v for v in found if v not in chosen]
    return chosen


def _parse_axis(text: str) -> tuple[str, list[Any]]:
    """``batching=[1,2]`` -> ("batching", [1, 2])."""
    from mpmbench.presets import parse_value

    name, equals, values = text.partition("=")
    words = [w.strip() for w in values.strip().removeprefix("[").removesuffix("]").split(",")]
    if not equals or not all(words):
        raise InputError(f"cannot read axis {text!r}: write it as name=value or name=[value,value]")
    return name.strip(), [parse_value(word) for word in words]


def _cache_states(axes: Sequence[str]) -> tuple[list[str], list[str]]:
    """The values of the axis ``cache``, which belongs to the timing, and the other axes."""
    found = [(name, values) for name, values in map(_parse_axis, axes) if name == "cache"]
    others = [text for text in axes if _parse_axis(text)[0] != "cache"]
    if len(found) > 1:
        raise InputError("axis 'cache' is given twice: write cache=[value,value]")
    return [str(value) for value in found[0][1]] if found else ["cold"], others


def _timings(caches: Sequence[str], quick: bool, rigorous: bool, baseline: str) -> list[Any]:
    """How measured rows are made, one for each state of the caches."""
    from mpmbench import measure
    from mpmbench.contest import Timing
    from mpmbench.protocol import rounds

    if quick and rigorous:
        raise InputError("--quick and --rigorous exclude each other: leave one of them out")
    rules = rounds.QUICK if quick else rounds.RIGOROUS if rigorous else rounds.Rules()
    sampling = measure.QUICK if quick else measure.Sampling()
    return [Timing(cache, rules, sampling, baseline) for cache in dict.fromkeys(caches)]


def _to_search(cases: list[Any], budget: int, axes: Sequence[str], preset_name: str | None) -> list[Any]:
    """The cases with a search for the axes that -a does not fix."""
    from mpmbench.tuning import to_search

    if preset_name is not None:
        raise InputError("--preset fixes every axis: leave out --tune, or leave out --preset")
    return to_search(cases, budget, {name for name, _ in map(_parse_axis, axes)})


def _that_keep_time(devices: list[Any], named: bool) -> list[Any]:
    """Devices to tune on; those that nobody has named may drop out."""
    from mpmbench.session import keeps_time

    timed = [device for device in devices if keeps_time(device)]
    if not timed or (named and len(timed) < len(devices)):
        raise InputError("--tune needs times: name a GPU to model with --gpu, or a device that keeps time with -d")
    return timed


def _searches(case: Any) -> str:
    return f", tuning: {case.search}" if case.search else ""


def _refuse_unknown_baseline(cases: Sequence[Any], baseline: str) -> None:
    if baseline and not any(case.label.startswith(baseline) for case in cases):
        labels = ", ".join(dict.fromkeys(case.label for case in cases))
        raise InputError(f"no row is called {baseline!r}, the baseline asked for: valid are {labels}")


def _open_devices(names: Sequence[str], arch: str | None, mode: str) -> list[Any]:
    from mpmbench.device import open_device

    if not names:
        names = ["simulated", *(["cuda"] if _gpu_present() else [])]
    options = {"mode": mode} | ({"arch": arch} if arch else {})
    takes = {"simulated": options, "cpu": {"arch": arch} if arch else {}}
    return [open_device(name, **takes.get(name, {})) for name in names]


def _refuse_lock(lock: str, devices: Sequence[str], gpu_names: Sequence[str]) -> None:
    """Clocks are locked of GPUs that are here and take part, and of no others."""
    from mpmbench.device.nvml import parse_lock

    parse_lock(lock)
    if gpu_names or (devices and not any(name.startswith("cuda") for name in devices)):
        raise InputError("--lock-gpu-clocks is for a GPU that is timed: add -d cuda, or leave it out")


@contextmanager
def _locked_clocks(devices: Iterable[Any], lock: str | None) -> Iterator[None]:
    """The clocks of all GPUs among the devices are held while the block runs; without a lock they are left alone."""
    with ExitStack() as stack:
        if lock is not None:
            gpus = [device for device in devices if hasattr(device, "lock_clocks")]
            if not gpus:
                raise InputError("--lock-gpu-clocks: there is no GPU here to be timed: leave it out")
            for device in gpus:
                stack.enter_context(device.lock_clocks(lock))
        yield


def _warn_of_gpus(devices: Iterable[Any]) -> None:
    """Before an hour of work rather than after it."""
    from mpmbench import preflight

    for device in devices:
        for trouble, action in preflight.warnings(getattr(device, "facts", {})):
            notes.print(f"{device.name}: {trouble}. {action}", markup=False, soft_wrap=True)


def _gpu_present() -> bool:
    from mpmbench.device import open_device

    try:
        open_device("cuda")
    except MpmbenchError:
        return False
    return True


# --- commands ---------------------------------------------------------------------------------------------------------


@main.command("list")
@click.option("--variants", "variant_dirs", multiple=True, type=click.Path(path_type=Path), metavar="DIR")
@click.option("--json", "as_json", is_flag=True, help="Machine-readable.")
def list_command(variant_dirs: Sequence[Path], as_json: bool) -> None:
    """Variants and primitives with their axes, datasets, presets and devices. Runs nothing."""
    from mpmbench import peers, presets, primitives
    from mpmbench.api import list_datasets, list_devices
    from mpmbench.variants import discover

    variants = discover(variant_dirs)
    blocks = primitives.discover(variant_dirs)
    if as_json:
        content = {
            "variants": {v.name: {"summary": v.summary, "axes": _axis_values(v)} for v in variants},
            "primitives": {p.name: {"summary": p.summary, "axes": _axis_values(p)} for p in blocks},
            "peers": {
                p.name: {"summary": p.summary, "axes": _axis_values(p), "installed": p.library.installed}
                for p in peers.discover()
            },
            "datasets": {d.name: d.summary for d in list_datasets()},
            "presets": list(presets.PRESETS),
            "devices": {d.name: d.summary for d in list_devices()},
        }
        click.echo(json.dumps(content, indent=2))
        return
    for title, rows in (
        ("Variants", [(v.name, v.summary) for v in variants]),
        ("Primitives", [(p.name, p.summary) for p in blocks]),
        ("Peers, on the device cpu", [(p.name, p.listed) for p in peers.discover()]),
        ("Datasets", [(d.name, d.summary) for d in list_datasets()]),
        ("Presets", [(name, (make.__doc__ or "").split("\n")[0]) for name, make in presets.PRESETS.items()]),
        ("Devices", [(d.name, d.summary) for d in list_devices()]),
    ):
        table = RichTable("name", "what it is", title=title, title_justify="left", box=None, padding=(0, 2, 0, 0))
        for name, summary in rows:
            table.add_row(escape(name), escape(summary))
        console.print(table)
        console.print()
    _print_axes("Axes", [(v.name, v.axes) for v in variants])
    for operation in dict.fromkeys(p.operation.name for p in blocks):
        console.print()
        _print_axes(f"Axes of {operation}", [(p.name, p.axes) for p in blocks if p.operation.name == operation])


def _print_axes(title: str, strategies: Sequence[tuple[str, Any]]) -> None:
    """Each axis with its usual default first, and whose default differs."""
    from mpmbench.runner import format_axis

    heads = ("axis", "values, usual default first", "other default")
    table = RichTable(*heads, title=title, title_justify="left", box=None, padding=(0, 2, 0, 0))
    for name in dict.fromkeys(name for _, axes in strategies for name in axes):
        defaults = {who: format_axis(axes[name][0]) for who, axes in strategies if name in axes}
        usual = Counter(defaults.values()).most_common(1)[0][0]
        values = dict.fromkeys([usual, *(format_axis(value) for _, axes in strategies for value in axes.get(name, ()))])
        others = [f"{who}: {value}" for who, value in defaults.items() if value != usual]
        table.add_row(name, "  ".join(values), ", ".join(others))
    console.print(table)


def _axis_values(variant: Any) -> dict[str, list[Any]]:
    return {name: list(values) for name, values in variant.axes.items()}


@main.command()
@_selection
@click.option("--preset", "preset_name", metavar="NAME", help="A named selection: demo, thesis.")
@click.option("--json", "json_path", type=click.Path(path_type=Path), metavar="FILE", help="Records, one per line.")
@click.option("--html", "html_path", type=click.Path(path_type=Path), metavar="FILE", help="One-file report.")
@click.option("--md", "md_path", type=click.Path(path_type=Path), metavar="FILE", help="Markdown report.")
@click.option("--csv", "csv_path", type=click.Path(path_type=Path), metavar="FILE", help="One flat row per record.")
@click.option(
    "--nvbench", "nvbench_path", type=click.Path(path_type=Path), metavar="FILE", help="For NVBench's tools: JSON."
)
@click.option(
    "--gpu",
    "gpu_names",
    multiple=True,
    metavar="NAME[,NAME]",
    help="Model the time on these GPUs, by name or description file (.toml); none need be there.",
)
@click.option("--rigorous", is_flag=True, help="More and longer rounds: finer differences are told apart.")
@click.option(
    "--tune",
    type=click.IntRange(min=1),
    is_flag=False,
    flag_value=12,
    metavar="[N]",
    help="Each strategy at its best block_shape and batching of N tried (12 if N is left out); -a fixes an axis.",
)
@click.option(
    "--baseline",
    default="",
    metavar="NAME",
    help="Strategy that the others are compared with, as the tables name it. Default: unsorted global atomics.",
)
@click.option(
    "--lock-gpu-clocks",
    "lock",
    metavar="base|max|MHZ|reset",
    help="Hold the SM clock of the GPUs while this runs (as root); reset sets it free first.",
)
@click.option("--shard", metavar="I/N", help="Run part I of N; what is timed together stays together.")
@click.option("--resume", is_flag=True, help="Keep the rows of --json FILE, run only what is missing.")
@click.option("--dry-run", is_flag=True, help="Say what would run, and stop.")
def run(
    preset_name: str | None,
    json_path: Path | None,
    html_path: Path | None,
    md_path: Path | None,
    csv_path: Path | None,
    nvbench_path: Path | None,
    gpu_names: Sequence[str],
    rigorous: bool,
    tune: int | None,
    baseline: str,
    lock: str | None,
    shard: str | None,
    resume: bool,
    dry_run: bool,
    devices: Sequence[str],
    arch: str | None,
    quick: bool,
    **selection: Any,
) -> None:
    """Run variants: check each result, then count it (simulated) or time it (cuda; cpu by wall clock).

    \b
    mpmbench run --quick
    mpmbench run -b "p2g_*" --dataset random -a "batching=[1,4]" --json rows.jsonl --html report.html
    mpmbench run --dataset my_particles.npz -d cuda -a "cache=[cold,step]"
    mpmbench run --gpu h100,a100,rtx4090 --dataset my_particles.npz --html which_one.html
    """
    from mpmbench.session import keeps_time
    from mpmbench.session import shard as part

    caches, selection["axes"] = _cache_states(selection["axes"])
    cases = _choose(**selection, quick=quick, preset_name=preset_name, devices=devices)
    timings = _timings(caches, quick, rigorous, baseline)
    if resume and json_path is None:
        raise InputError("--resume needs --json FILE, the file whose rows it keeps")
    outputs = [json_path, html_path, md_path, csv_path, nvbench_path]
    _refuse_targets(outputs, selection["datasets"])
    if tune is not None:
        cases = _to_search(cases, tune, selection["axes"], preset_name)
    if lock is not None:
        _refuse_lock(lock, devices, gpu_names)
    if gpu_names:
        if shard is not None:
            cases = part(cases, shard, together=False)
        _run_modelled(cases, gpu_names, devices, arch, outputs, resume, dry_run)
        return
    # The thesis measured a GTX 970: its rows are counted on the code that NVRTC makes for that GPU.
    opened = _open_devices(devices, arch or ("sm_52" if preset_name == "thesis" else None), "count")
    if tune is not None:
        opened = _that_keep_time(opened, named=bool(devices))
    _refuse_unknown_baseline(cases, baseline)  # of all parts: only one of them has it
    if shard is not None:
        cases = part(cases, shard, together=any(map(keeps_time, opened)))
    if dry_run:
        for device in opened:
            for case in cases:
                console.print(
                    f"{device.name} {device.arch}  {case.title}{_searches(case)}", markup=False, soft_wrap=True
                )
        console.print(f"{len(cases) * len(opened)} rows")
        return
    _terminate_like_ctrl_c()  # before clocks are locked: the lock has a handler of its own where there is none
    with _locked_clocks(opened, lock):
        _warn_of_gpus(opened)
        records = _run_cases(cases, opened, json_path, "append" if resume else "replace", timings)
    _write_reports(records, html_path, md_path, csv_path, nvbench_path)
    _summarise(records, [p for p in outputs if p])


@main.command()
@_selection
@click.option(
    "--debug", is_flag=True, help="Poisoned shared memory, race checks, shuffled warp order (simulated only)."
)
@click.option("--json", "json_path", type=click.Path(path_type=Path), metavar="FILE", help="Records, one per line.")
def check(
    debug: bool, json_path: Path | None, devices: Sequence[str], arch: str | None, quick: bool, **selection: Any
) -> None:
    """Hold variants to the float64 reference, without counting or timing. Exit code 4 if one fails."""
    cases = _choose(**selection, quick=quick, devices=devices)
    _refuse_targets([json_path], selection["datasets"])
    opened = _open_devices(devices, arch, "debug" if debug else "run")
    records = _run_cases(cases, opened, json_path, "replace")
    for record in records:
        error = f"error/allowed {record.check.ratio:.3f}" if record.check else ""
        if record.check and record.check.worst_node:
            error += f" at {'x'.join(map(str, record.check.worst_node))}"
        reason = record.skipped_because or record.failed_because or ""
        console.print(f"{record.status:9}{record.device:10} {record.variant} {record.dataset.name} {error}{reason}",
                      markup=False, soft_wrap=True)  # fmt: skip
        for finding in record.findings:
            console.print(f"         {finding.message}", markup=False, soft_wrap=True)
    _summarise(records, [json_path] if json_path else [])


@main.command()
@click.argument("records", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--html", "html_path", type=click.Path(path_type=Path), metavar="FILE")
@click.option("--md", "md_path", type=click.Path(path_type=Path), metavar="FILE")
@click.option("--csv", "csv_path", type=click.Path(path_type=Path), metavar="FILE")
@click.option("--nvbench", "nvbench_path", type=click.Path(path_type=Path), metavar="FILE")
def report(
    records: Sequence[Path],
    html_path: Path | None,
    md_path: Path | None,
    csv_path: Path | None,
    nvbench_path: Path | None,
) -> None:
    """Rebuild a report from RECORDS files, on any machine. Prints Markdown if no file is named."""
    from mpmbench.record import read_records
    from mpmbench.report import markdown_text

    rows = [row for path in records for row in read_records(path)]
    if not rows:
        raise InputError(f"no records in {', '.join(map(str, records))}: nothing to report")
    outputs = [html_path, md_path, csv_path, nvbench_path]
    _refuse_targets(outputs, records)
    if any(outputs):
        _write_reports(rows, *outputs)
        for path in filter(None, outputs):
            console.print(f"wrote {path}", markup=False, soft_wrap=True)
    else:
        click.echo(markdown_text(rows))


@main.command()
@click.option("-d", "--device", default=None, metavar="DEVICE", help="Default: cuda where there is a GPU.")
@click.option("--arch", default=None, metavar="sm_XX")
@click.option("--quick", is_flag=True, help="The smallest datasets only.")
def selftest(device: str | None, arch: str | None, quick: bool) -> None:
    """Run every strategy on a device, hold it to the reference and (on a GPU) to the simulated device."""
    from mpmbench.selftest import run_selftest

    name = device or ("cuda" if _gpu_present() else "simulated")
    failed = 0
    rows = run_selftest(name, quick=quick, arch=arch)
    for row in rows:
        failed += not row.passed
        console.print(str(row), markup=False, soft_wrap=True)
    console.print(f"{name}: {len(rows) - failed} passed, {failed} failed")
    if failed:
        sys.exit(WRONG_RESULT)


@main.command()
@click.option("--part", "parts", multiple=True, metavar="NAME", help="table3, table4 or drift; default: all.")
@click.option("-d", "--device", default="simulated", metavar="DEVICE", help="simulated (default), cuda, cuda:N.")
@click.option("--arch", default=None, metavar="sm_XX", help="Architecture the simulated device compiles for.")
@click.option("--quick", is_flag=True, help="A smaller problem beside the printed figures: seconds, not minutes.")
@click.option("--json", "json_path", type=click.Path(path_type=Path), metavar="FILE", help="Every figure and its kind.")
@click.option("--md", "md_path", type=click.Path(path_type=Path), metavar="FILE", help="Markdown tables.")
def verify(
    parts: Sequence[str], device: str, arch: str | None, quick: bool, json_path: Path | None, md_path: Path | None
) -> None:
    """Errors of totals, added exactly, beside the thesis's tables 3 and 4; what weights=unity buys.

    Exit code 4 if a bound does not hold.
    """
    from mpmbench import verify as verification
    from mpmbench.environment import Environment

    _refuse_targets([json_path, md_path])
    opened = _open_devices([device], arch, "run")[0]
    with _progress() as progress:
        outcomes = verification.verify(opened, parts, quick, _step_by_step(progress))
    click.echo(verification.text(outcomes))
    environment = Environment.capture()
    if json_path:
        _write_whole(json_path, json.dumps(verification.to_json(outcomes, opened, environment), indent=2) + "\n")
    if md_path:
        _write_whole(md_path, verification.markdown(outcomes, opened, environment))
    for path in filter(None, (json_path, md_path)):
        console.print(f"wrote {path}", markup=False, soft_wrap=True)
    if verification.problems(outcomes):
        sys.exit(WRONG_RESULT)


@main.command()
@click.option(
    "--write-gpu",
    "gpu_path",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE.toml",
    help="Describe this machine's GPU for --gpu FILE.toml instead; an existing file is left alone.",
)
@click.option("--noise", is_flag=True, help="How often are equals called unequal here? Copies of one transfer, timed.")
@click.option("--noise-seconds", type=click.FloatRange(min=1), metavar="N", help="How long --noise takes; default 30.")
def doctor(gpu_path: Path | None, noise: bool, noise_seconds: float | None) -> None:
    """What is present, what is missing, and what to do about it."""
    from mpmbench.doctor import diagnose

    if noise or noise_seconds is not None:
        _noise(noise_seconds)
        return
    if gpu_path is not None:
        from mpmbench.gpu.write import write_gpu

        gpu = write_gpu(gpu_path)
        unknown = sum(constant.confidence == "low" for constant in gpu.constants.values())
        console.print(f"wrote {gpu_path}: {gpu.summary}", markup=False, soft_wrap=True)
        console.print(f"{unknown} constants are not known for this GPU: those of confidence low", soft_wrap=True)
        return
    marks = {"ok": "[green]ok     [/]", "warn": "[yellow]warn   [/]", "missing": "[red]missing[/]"}
    for item in diagnose():
        console.print(f"{marks[item.status]} {item.name}: ", end="")
        console.print(item.detail, markup=False, soft_wrap=True)
        if item.remedy and item.status != "ok":
            console.print(f"        -> {item.remedy}", markup=False, soft_wrap=True)


def _noise(seconds: float | None) -> None:
    from mpmbench.noise import SECONDS, describe, measure_noise

    (device,) = _open_devices(["cuda" if _gpu_present() else "cpu"], None, "run")
    with _progress() as progress:
        found = measure_noise(device, seconds or SECONDS, _step_by_step(progress))
    for line in describe(found, device):
        console.print(line, markup=False, soft_wrap=True)


@main.command()
def env() -> None:
    """Versions and machine, to paste into a bug report."""
    from dataclasses import asdict

    from mpmbench.environment import Environment

    for name, value in asdict(Environment.capture(argv=[])).items():
        if value not in (None, (), {}):
            click.echo(f"{name}: {value}")


main.add_command(reproduce)


def _run_modelled(
    cases: list[Any],
    gpu_names: Sequence[str],
    devices: Sequence[str],
    arch: str | None,
    outputs: Sequence[Path | None],
    resume: bool,
    dry_run: bool,
) -> None:
    """``run --gpu``: the cases on the simulated device, with the time that named GPUs would take."""
    if any(device != "simulated" for device in devices):
        raise InputError("--gpu models times on the simulated device: leave out -d, or leave out --gpu")
    if arch is not None:
        raise InputError("--gpu compiles for the GPU that it names: leave out --arch")
    gpus = cli_profile.parse_gpus(gpu_names)
    if dry_run:
        for case in cases:
            names = ", ".join(gpu.name for gpu in gpus)
            console.print(f"{names}  {case.title}{_searches(case)}", markup=False, soft_wrap=True)
        console.print(f"{len(cases)} cases on {len(gpus)} GPUs")
        return
    json_path, *reports = outputs
    records = cli_profile.model_cases(cases, gpus, json_path, resume)
    _write_reports(records, *reports)
    _summarise(records, [p for p in outputs if p])


# --- running ----------------------------------------------------------------------------------------------------------


def _run_cases(
    cases: list[Any], devices: list[Any], json_path: Path | None, existing: Any, timings: Sequence[Any] = ()
) -> list[Any]:
    """Records of all cases, each on disk before the next begins. No timings: check only."""
    from mpmbench.record import RecordWriter, read_records
    from mpmbench.runner import refuse_bad_input
    from mpmbench.session import keeps_time, run_session

    _terminate_like_ctrl_c()
    refuse_bad_input(cases)
    total = sum(len(cases) * (max(1, len(timings)) if keeps_time(device) else 1) for device in devices)
    records: list[Any] = []
    writer = RecordWriter(json_path, existing) if json_path else None  # before reading: from here on it is ours alone
    try:
        known = read_records(json_path) if json_path and existing == "append" else []
        with _progress() as progress:
            task = progress.add_task("", total=total)

            def tick(what: str) -> None:
                progress.update(task, description=what)

            for record, new in run_session(cases, devices, timings, known, tick):
                if new and writer:
                    writer.write(record)
                records.append(record)
                progress.advance(task)
                if not progress.console.is_terminal:
                    notes.print(f"[{len(records)}/{total}] {record.device} {record.variant} on {record.dataset.name}: "
                                f"{record.status}", markup=False, soft_wrap=True)  # fmt: skip
    finally:
        if writer:
            writer.close()
    if known and (others := len(known) + (writer.rows if writer else 0) - len(records)):
        notes.print(f"{json_path} holds {others} rows of other selections too: kept, and left out of what follows;"
                    f" mpmbench report {json_path} shows all", markup=False, soft_wrap=True)  # fmt: skip
    return records


def _terminate_like_ctrl_c() -> None:
    """SIGTERM ends a run as Ctrl-C does: the row in flight is lost, the others are on disk. A job manager that has its
    own use for the signal keeps it."""
    if signal.getsignal(signal.SIGTERM) is signal.SIG_DFL:
        signal.signal(signal.SIGTERM, lambda *_: (_ for _ in ()).throw(KeyboardInterrupt()))


def _progress() -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(bar_width=24),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=notes,
        disable=not notes.is_terminal,
    )


def _step_by_step(progress: Progress) -> Callable[[str, int, int], None]:
    """A callback (what, steps done, steps in all) that shows one bar per thing that runs; tenths where nobody looks."""
    tasks: dict[str, Any] = {}

    def tick(what: str, done: int, total: int) -> None:
        if what not in tasks:
            for task in tasks.values():
                progress.update(task, visible=False)
            tasks[what] = progress.add_task(what, total=total)
        progress.update(tasks[what], completed=done)
        if not progress.console.is_terminal and (done == total or done % max(1, total // 10) == 0):
            notes.print(f"[{done}/{total}] {what}", markup=False, soft_wrap=True)

    return tick


def _write_whole(path: Path, text: str) -> None:
    """The whole text or nothing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".partial")
    partial.write_text(text, encoding="utf-8")
    os.replace(partial, path)


_READ_ONLY = (".npz", ".npy", ".toml", ".cu", ".cuh", ".py")


def _refuse_targets(paths: Sequence[Path | None], inputs: Iterable[str | Path] = ()) -> None:
    """Refuse to write into a folder or a device, where nothing can be written, two things into one file, over what is
    read, and over particles or sources."""
    taken = {Path(path).resolve(): "is read by the same command" for path in inputs}
    for path in filter(None, paths):
        if path.is_dir():
            raise InputError(f"{path} is a folder: name a file in it")
        if path.exists() and not path.is_file():
            raise InputError(f"{path} is not an ordinary file: name another one")
        if problem := taken.get(path.resolve()):
            raise InputError(f"{path} {problem}: name another file to write to")
        if path.exists() and path.suffix in _READ_ONLY:
            raise InputError(f"{path} exists and is none that mpmbench writes: name another file to write to")
        _try_to_write(path)
        taken[path.resolve()] = "is written by the same command"


def _try_to_write(path: Path) -> None:
    """Learn before the work, not after it, that a file cannot be written. Creates nothing that stays."""
    folder = next(parent for parent in path.resolve().parents if parent.exists())
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise InputError(f"{path} cannot be written: {folder}: {reason}") from None


def _write_reports(
    records: list[Any], html: Path | None, md: Path | None, csv: Path | None, nvbench: Path | None = None
) -> None:
    from mpmbench.nvbench import write_nvbench
    from mpmbench.report import write_report

    if nvbench:
        write_nvbench(records, nvbench)
    if html or md:
        write_report(records, html=html, markdown=md)
    if csv:
        import pandas as pd

        from mpmbench.record import flatten

        csv.parent.mkdir(parents=True, exist_ok=True)
        partial = csv.with_name(csv.name + ".partial")
        pd.DataFrame([flatten(record) for record in records]).to_csv(partial, index=False)
        os.replace(partial, csv)


def _summarise(records: list[Any], written: Sequence[Path]) -> None:
    """The problems, the report's own answer, the files; exit code 4 where a result is wrong."""
    from mpmbench.report import document
    from mpmbench.tuning import axes_text, wrong

    by_status: dict[str, int] = {}
    for record in records:
        by_status[record.status] = by_status.get(record.status, 0) + 1
    mistuned = [(record, one) for record in records for one in wrong(record)]
    for record, one in mistuned:
        where = f"{record.variant} on {record.dataset.name} {axes_text(one.axes)}"
        notes.print(f"tuning {where}: {one.reason}", markup=False, soft_wrap=True)
    for record in records:
        reason = record.skipped_because or record.failed_because
        if record.status not in ("ok",):
            detail = reason or (f"error {record.check.ratio:.3g} x allowed" if record.check else "")
            notes.print(
                f"{record.status}: {record.variant} on {record.dataset.name}: {detail}", markup=False, soft_wrap=True
            )
    if records:
        answer = document.build(records)
        console.print(answer.verdict, markup=False, soft_wrap=True, style="bold")
        for line in answer.answer:
            console.print(f"  {line}", markup=False, soft_wrap=True)
    counted = ", ".join(f"{count} {status}" for status, count in sorted(by_status.items()))
    console.print(f"{len(records)} rows: {counted}")
    for path in written:
        console.print(f"wrote {path}", markup=False, soft_wrap=True)
    if mistuned or any(record.status in ("wrong", "findings") for record in records):
        sys.exit(WRONG_RESULT)
    if any(record.status == "broken" for record in records):
        sys.exit(1)


# They add their commands, and need what stands above.
from mpmbench import cli_compare, cli_profile, cli_sanitize, cli_sweep  # noqa: E402, F401

if __name__ == "__main__":
    main()
