"""``mpmbench profile``: what binds each strategy on a named GPU, by the model; or what Nsight Compute says of it."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from rich.table import Table as RichTable

from mpmbench.cli import (
    _choose,
    _progress,
    _refuse_targets,
    _selection,
    _step_by_step,
    _summarise,
    _write_reports,
    console,
    main,
)
from mpmbench.errors import InputError
from mpmbench.gpu import Gpu, get_gpu, list_gpus

if TYPE_CHECKING:
    from mpmbench.record import Record
    from mpmbench.runner import Case


def parse_gpus(names: Sequence[str]) -> list[Gpu]:
    """``("h100,a100", "my.toml")`` -> descriptions, each once. Raises InputError naming the valid ones."""
    words = [word.strip() for text in names for word in text.split(",") if word.strip()]
    return [get_gpu(word) for word in dict.fromkeys(words)]


@main.command()
@_selection
@click.option(
    "--gpu",
    "gpu_names",
    multiple=True,
    metavar="NAME[,NAME]",
    help="GPUs to model, by name or description file (.toml).",
)
@click.option("--preset", "preset_name", metavar="NAME", help="A named selection: demo, thesis.")
@click.option("--json", "json_path", type=click.Path(path_type=Path), metavar="FILE", help="Records, one per line.")
@click.option("--html", "html_path", type=click.Path(path_type=Path), metavar="FILE", help="One-file report.")
@click.option("--md", "md_path", type=click.Path(path_type=Path), metavar="FILE", help="Markdown report.")
@click.option("--ncu", "print_ncu", is_flag=True, help="Print the Nsight Compute line per strategy; run nothing.")
@click.option(
    "--ncu-csv",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Show the CSV that such a line left beside the model.",
)
def profile(
    gpu_names: Sequence[str],
    preset_name: str | None,
    json_path: Path | None,
    html_path: Path | None,
    md_path: Path | None,
    print_ncu: bool,
    ncu_csv: Path | None,
    devices: Sequence[str],
    arch: str | None,
    quick: bool,
    **selection: Any,
) -> None:
    """Model the time of each strategy on named GPUs: what binds it there, and what would help.

    \b
    mpmbench profile -b "p2g_*" --gpu gtx970 --html profile.html
    mpmbench profile -b p2g_block_sync --gpu h100,a100
    mpmbench profile -b p2g_block_sync --ncu
    """  # fmt: skip
    if any(device != "simulated" for device in devices):
        raise InputError("profile runs on the simulated device: leave out -d, name the GPU to model with --gpu")
    if arch is not None:
        raise InputError("profile compiles for the GPU that --gpu names: leave out --arch")
    gpus = parse_gpus(gpu_names)
    cases = _choose(**selection, quick=quick, preset_name=preset_name)
    if print_ncu:
        _print_ncu(cases, gpus, selection["variant_dirs"])
        return
    if not gpus:
        raise InputError(
            f"profile needs --gpu NAME: valid are {', '.join(g.name for g in list_gpus())}, or a .toml file"
        )
    outputs = [json_path, html_path, md_path]
    _refuse_targets(outputs, [*selection["datasets"], *([ncu_csv] if ncu_csv else [])])
    measured = _read_ncu(ncu_csv, cases, gpus) if ncu_csv else {}
    records = model_cases(cases, gpus, json_path, resume=False)
    _write_reports(records, html_path, md_path, None)
    _print_profiles(records)
    for record in records:
        for kernel in set(record.hashes) & set(measured):
            _print_beside_ncu(record, measured[kernel], gpus[0])
    sys.stdout.flush()
    _summarise(records, [path for path in outputs if path])


def model_cases(cases: Sequence[Any], gpus: Sequence[Gpu], json_path: Path | None, resume: bool) -> list[Record]:
    """Run, check and model cases, those with a search at their best; each record is in --json FILE before the next case
    begins."""
    from mpmbench.profile import profile_cases
    from mpmbench.record import RecordWriter, read_records
    from mpmbench.tuning import model_tuned

    writer = RecordWriter(json_path, "append" if resume else "replace") if json_path else None
    try:
        known = read_records(json_path) if resume and json_path else []
        with _progress() as progress:
            keep = writer.write if writer else lambda record: None
            model = model_tuned if any(case.search for case in cases) else profile_cases
            return model(cases, gpus, _step_by_step(progress), keep, known)
    finally:
        if writer:
            writer.close()


def _print_profiles(records: Sequence[Record]) -> None:
    """Per strategy: time with its range, bound, occupancy; then what would help."""
    from mpmbench.report import modelled, profile

    for g in modelled.gpu_groups(records):
        console.print(g.title, markup=False, soft_wrap=True, style="bold")
        for record in g.runs:
            card = profile.card(g, record, detailed=False)
            badge = f"; uncalibrated: {card.badge}" if card.badge else ""
            console.print(f"  {card.title}: {card.headline}{badge}", markup=False, soft_wrap=True)
            console.print(f"    {card.sentence}", markup=False, soft_wrap=True)


# --- Nsight Compute ---------------------------------------------------------------------------------------------------


def _print_ncu(cases: Sequence[Any], gpus: Sequence[Gpu], variant_dirs: Sequence[Path]) -> None:
    """One shell line per case, and which of the GPUs it cannot measure."""
    from mpmbench import ncu

    unsupported = [gpu for gpu in gpus if not ncu.supports(gpu)]
    if gpus and len(unsupported) == len(gpus):
        raise InputError("; ".join(map(ncu.why_unsupported, unsupported)))
    for gpu in unsupported:
        click.echo(f"# {ncu.why_unsupported(gpu)}")
    for i, case in enumerate(_transfers(cases)):
        log = f"{case.name}.csv" if len(cases) == 1 else f"{case.name}-{i + 1}.csv"
        click.echo(ncu.command(case.variant.kernel, _run_arguments(case, variant_dirs), log))


def _transfers(cases: Sequence[Any]) -> list[Case]:
    from mpmbench.runner import Case

    if others := [case.name for case in cases if not isinstance(case, Case)]:
        raise InputError(f"Nsight Compute lines are for transfers, which are one kernel: leave out {others[0]}")
    return list(cases)


def _run_arguments(case: Case, variant_dirs: Sequence[Path]) -> list[str]:
    """What ``mpmbench run`` takes to repeat this case."""
    from mpmbench.runner import format_axis
    from mpmbench.variants import resolve_axes

    choice, defaults = case.dataset, resolve_axes(case.variant, {})
    options = {
        "--particles": choice.particles,
        "--particles-per-cell": choice.particles_per_cell,
        "--seed": choice.seed,
        "--grid-shape": choice.grid_shape and format_axis(choice.grid_shape),
        "--dx": choice.dx,
    }
    words = ["-b", case.name, "--dataset", choice.name]
    words += [word for name, value in options.items() if value is not None for word in (name, str(value))]
    words += ["--origin", *map(str, choice.origin)] if choice.origin is not None else []
    changed = [f"{name}={format_axis(value)}" for name, value in case.axes.items() if defaults.get(name) != value]
    words += [word for text in changed for word in ("-a", text)]
    return words + [word for folder in variant_dirs for word in ("--variants", str(folder))]


def _read_ncu(path: Path, cases: Sequence[Any], gpus: Sequence[Gpu]) -> dict[str, Any]:
    """Kernels of the file that the selection runs, before anything is simulated for them."""
    from mpmbench import ncu

    if len(gpus) > 1:
        raise InputError("--ncu-csv is of one GPU: name it alone with --gpu")
    if not ncu.supports(gpus[0]):
        raise InputError(f"{ncu.why_unsupported(gpus[0])}: the file cannot be of it")
    measured = ncu.read_csv(path)
    kernels = [case.variant.kernel for case in _transfers(cases)]
    wanted = {name: found for name, found in measured.items() if name in kernels}
    if not wanted:
        raise InputError(f"{path} has the kernels {', '.join(measured)}: choose one of them with -b")
    for name in wanted:
        if (times := kernels.count(name)) > 1:
            raise InputError(f"{name} runs {times} times in this selection: choose one case with -a and --dataset")
    return wanted


def _print_beside_ncu(record: Record, measured: Any, gpu: Gpu) -> None:
    from mpmbench import ncu
    from mpmbench.report.text import format_value

    if gpu.name not in (record.modelled or {}):
        return
    assert record.modelled is not None
    table = ncu.compare(record, record.modelled[gpu.name], measured)
    shown = RichTable(title=table.title, title_justify="left", box=None, padding=(0, 2, 0, 0))
    for i, column in enumerate(table.columns):
        shown.add_column(column.title, justify="left" if i == 0 else "right")
    for row in table.rows:
        shown.add_row(
            *(format_value(c.value, column.quantity) for c, column in zip(row.cells, table.columns, strict=True))
        )
    console.print(shown)
    for note in table.notes:
        console.print(note, markup=False, soft_wrap=True)
