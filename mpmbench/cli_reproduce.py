"""``mpmbench reproduce thesis``: model every row of the thesis's tables, score it, freeze what the score rests on."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path

import click

from mpmbench.errors import InputError

GPU = "gtx970"  # that the thesis measured


@click.group()
def reproduce() -> None:
    """Published tables beside the model's figures, scored."""


@reproduce.command()
@click.option("--json", "json_path", type=click.Path(path_type=Path), metavar="FILE", help="Score and rows.")
@click.option("--html", "html_path", type=click.Path(path_type=Path), metavar="FILE", help="One page, misses first.")
@click.option("--freeze", metavar="VERSION", help="Fix constants, kernels, datasets and scored rows as v1, v2, ...")
@click.option("--reason", default="", metavar="TEXT", help="Why: needed by --freeze.")
@click.option("--calibrate", is_flag=True, help="Set the calibrated constants anew from their three cells.")
@click.option("--record-score", is_flag=True, help="Put this score, its first, into the newest frozen version.")
@click.option(
    "--verify",
    "verify_paths",
    multiple=True,
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Errors for tables 3 and 4: what mpmbench verify --json wrote; may be given again.",
)
@click.option("--jobs", type=click.IntRange(min=1), default=2, show_default=True, help="Rows counted side by side.")
@click.option("--cache/--no-cache", default=True, show_default=True, help="Keep and use the counters of earlier runs.")
def thesis(
    json_path: Path | None,
    html_path: Path | None,
    freeze: str | None,
    reason: str,
    calibrate: bool,
    record_score: bool,
    verify_paths: Sequence[Path],
    jobs: int,
    cache: bool,
) -> None:
    """Tables 3-18 of the 2019 thesis: modelled times for its GTX 970 beside the published ones.

    A miss is a result: the exit code is 0 whatever the score, and 1 if a row has no modelled time.

    \b
    mpmbench reproduce thesis --json score.json --html thesis.html
    mpmbench reproduce thesis --freeze v1 --reason "before the first score"
    """  # fmt: skip
    from mpmbench import cli
    from mpmbench.gpu import get_gpu
    from mpmbench.reproduce import frozen, page, rows, sensitivity, targets
    from mpmbench.reproduce.comparable import judge
    from mpmbench.reproduce.score import score, to_json
    from mpmbench.reproduce.verified import verified_parts

    if reason and freeze is None:
        raise InputError("--reason goes with --freeze VERSION")
    if freeze is not None and (record_score or json_path or html_path):
        raise InputError("--freeze comes before a score: leave out --record-score, --json and --html, and run again")
    if freeze is not None:
        frozen.check_new(freeze, reason)
    cli._refuse_targets([json_path, html_path], verify_paths)
    verified = verified_parts(verify_paths)  # before the work, not after
    gpu = get_gpu(GPU)
    constants = rows.model_constants(gpu)
    with cli._progress() as progress:
        found = rows.thesis_rows(gpu, constants, cli._step_by_step(progress), jobs=jobs, cache=cache)
    if calibrate:
        path = rows.write_calibration(found, gpu)
        _say(f"wrote {path}: run again to use it")
        return
    judged = judge(found)
    if freeze is not None:
        path, version = frozen.freeze(freeze, reason, gpu.name, constants, judged)
        _say(f"froze {len(version.constants)} constants and {len(judged)} rows as {freeze}: {path}")
        _say(f"{version.note} says what changed, why, and the score before: write it, then run without --freeze")
        return
    total = score(judged)
    differs = frozen.differences(frozen.newest(), gpu.name, constants, judged)
    recorded = frozen.record_score(judged, differs) if record_score else None
    outcome = page.Reproduction(
        gpu=gpu,
        constants=constants,
        judged=judged,
        score=total,
        targets=targets.targets(judged, total, gpu),
        moved=sensitivity.sensitivity(found, constants, rows.retime),
        differs=differs,
        history=frozen.versions(),
        verified=verified,
    )
    for line in page.summary(outcome):
        _say(line)
    if json_path:
        content = to_json(judged) | {"frozen": frozen.stamp(frozen.newest(), differs)}
        cli._write_whole(json_path, json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False) + "\n")
    if html_path:
        cli._write_whole(html_path, page.html(outcome))
    for written in filter(None, (json_path, html_path, recorded)):
        _say(f"wrote {written}")
    if any(one.row.modelled is None for one in judged):
        sys.exit(1)


def _say(line: str) -> None:
    from mpmbench.cli import console

    console.print(line, markup=False, soft_wrap=True)
