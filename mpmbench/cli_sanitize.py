"""``mpmbench sanitize``: shipped strategies, or a kernel of your own, in the engine's debug mode."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from mpmbench.cli import (
    WRONG_RESULT,
    _choose,
    _progress,
    _refuse_targets,
    _selection,
    _write_whole,
    console,
    main,
    notes,
)
from mpmbench.errors import InputError


@main.command()
@click.argument("file", required=False, type=click.Path(path_type=Path))
@click.option(
    "--launch",
    "launch_path",
    type=click.Path(path_type=Path),
    metavar="TOML",
    help="Arrays and launches of FILE: see docs/sanitizer.md.",
)
@click.option(
    "--schedules",
    type=click.IntRange(min=1),
    default=3,
    show_default=True,
    help="Orders of warps and lanes to try; the first takes lanes as they come.",
)
@click.option(
    "--budget",
    type=click.IntRange(min=1),
    default=None,
    help="Warp instructions that the loops of one launch may repeat before it is stopped.",
)
@_selection
@click.option("--json", "json_path", type=click.Path(path_type=Path), metavar="FILE", help="Findings, as JSON.")
def sanitize(
    file: Path | None,
    launch_path: Path | None,
    schedules: int,
    budget: int | None,
    json_path: Path | None,
    devices: Sequence[str],
    arch: str | None,
    quick: bool,
    **selection: Any,
) -> None:  # fmt: skip
    """Find races, bad addresses, uninitialised reads and misused barriers, on the simulated device.

    Without FILE: the strategies and primitives that the options choose, all of them by default. With FILE.cu: your
    own kernel, as --launch says. Exit code 4 for any error or warning.

    \b
    mpmbench sanitize --quick
    mpmbench sanitize -b "p2g_block_*" --dataset random --particles 100000
    mpmbench sanitize mine.cu --launch launch.toml --json findings.json
    """
    from mpmbench import sanitize as sanitizer

    if any(device != "simulated" for device in devices):
        raise InputError("sanitize runs on the simulated device only: leave out -d")
    limits = {} if budget is None else {"budget": budget}
    arch = arch or "sm_90"
    if file is None:
        if launch_path is not None:
            raise InputError("--launch tells how to launch a kernel of your own: name its FILE.cu")
        _refuse_targets([json_path], selection["datasets"])
        selection["patterns"] = selection["patterns"] or ("*",)
        cases = _choose(**selection, quick=quick)
        with _progress() as progress:
            task = progress.add_task("", total=len(cases))

            def tick(title: str) -> None:
                progress.update(task, description=title, advance=1)
                if not progress.console.is_terminal:
                    notes.print(title, markup=False, soft_wrap=True)

            result = sanitizer.sanitize_cases(cases, arch, schedules, tick=tick, **limits)
    else:
        from mpmbench.launch_file import read_launch_file

        if launch_path is None:
            raise InputError(f"{file}: say how to launch it: --launch launch.toml (docs/sanitizer.md)")
        chosen = {name: value for name, value in selection.items() if value not in (None, ())}
        if chosen or quick:
            raise InputError("options that choose strategies and datasets have no meaning for a FILE of your own")
        _refuse_targets([json_path], [file, launch_path])
        result = sanitizer.sanitize_file(file, read_launch_file(launch_path), arch, schedules, **limits)
    console.print(result.text(), markup=False, soft_wrap=True)
    if json_path:
        _write_whole(json_path, json.dumps(result.to_json(), indent=2) + "\n")
        console.print(f"wrote {json_path}", markup=False, soft_wrap=True)
    if not result.clean:
        sys.exit(WRONG_RESULT)
