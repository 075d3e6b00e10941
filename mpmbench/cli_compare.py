"""``mpmbench compare REF CMP``: what became faster or slower between two files."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path

import click

from mpmbench.cli import _refuse_targets, _write_whole, console, main, notes
from mpmbench.errors import InputError

REGRESSION = 3
PRESETS = ("default", "permissive", "strict")


@main.command()
@click.argument("ref", type=click.Path(path_type=Path))
@click.argument("cmp", type=click.Path(path_type=Path))
@click.option(
    "-b",
    "--benchmark",
    "benchmarks",
    multiple=True,
    metavar="GLOB",
    help="Only these transfers or strategies, by name or glob.",
)
@click.option(
    "-a",
    "--axis",
    "axes",
    multiple=True,
    metavar="AXIS=VALUES",
    help='Only these rows: -a cache=cold, -a "batching=[1,4]".',
)
@click.option(
    "--preset",
    type=click.Choice(PRESETS),
    default="default",
    show_default=True,
    help="NVBench's thresholds: how clear a gap must be, and how close the same.",
)
@click.option(
    "--allow-different",
    "allow",
    multiple=True,
    metavar="KEY[,KEY]",
    help="Environment keys that may differ, a group (gpu, kernel), or all. They are listed all the same.",
)
@click.option(
    "--fail-on",
    "fail_on",
    multiple=True,
    metavar="FIGURE:PERCENT%",
    help="Exit code 3 if a row is SLOW and slower by more: median:5%, min:5%.",
)
@click.option("--md", "md_path", type=click.Path(path_type=Path), metavar="FILE", help="The same as Markdown.")
@click.option("--json", "json_path", type=click.Path(path_type=Path), metavar="FILE", help="Every row, with why.")
def compare(
    ref: Path,
    cmp: Path,
    benchmarks: Sequence[str],
    axes: Sequence[str],
    preset: str,
    allow: Sequence[str],
    fail_on: Sequence[str],
    md_path: Path | None,
    json_path: Path | None,
) -> None:
    """Rows of CMP against the same rows of REF by NVBench's robust rule: FAST, SLOW, SAME, AMBG or ????.

    Each is a journal (run --json) or an NVBench JSON (run --nvbench, or NVBench's own). Files from different
    environments are refused, with what differs.

    \b
    mpmbench compare before.jsonl after.jsonl --allow-different kernel --fail-on "median:5%"
    mpmbench compare monday.json friday.json --preset strict -a cache=cold
    """  # fmt: skip
    from mpmbench import compare as comparing
    from mpmbench import compare_text
    from mpmbench.nvbench_rows import read_rows

    limits = [comparing.Limit.parse(text) for text in fail_on]
    allowed = [name.strip() for text in allow for name in text.split(",") if name.strip()]
    _refuse_targets([md_path, json_path], [ref, cmp])
    outcome = comparing.compare(read_rows(ref), read_rows(cmp), preset, allowed, benchmarks, axes)
    if outcome.refused:
        for one in outcome.refused:
            told = f"{one.key}: {one.ref} (REF), {one.cmp} (CMP), {compare_text.count(one.rows)}"
            notes.print(told, markup=False, soft_wrap=True)
        keys = ",".join(dict.fromkeys(one.key for one in outcome.refused))
        raise InputError(
            f"the environments of {ref} and {cmp} differ: measure again alike, or add --allow-different {keys}"
        )
    text = compare_text.markdown(outcome, str(ref), str(cmp), limits)
    click.echo(text, nl=False)
    if md_path:
        _write_whole(md_path, text)
    if json_path:
        content = compare_text.to_json(outcome, str(ref), str(cmp), limits)
        _write_whole(json_path, json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False) + "\n")
    for path in filter(None, (md_path, json_path)):
        console.print(f"wrote {path}", markup=False, soft_wrap=True)
    if any(limit.failed(outcome.pairs) for limit in limits):
        sys.exit(REGRESSION)
