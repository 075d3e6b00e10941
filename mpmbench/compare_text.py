"""A comparison of two files as Markdown, which the terminal prints too, and as JSON."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from tabulate import tabulate

from mpmbench.compare import Limit, Outcome, Pair
from mpmbench.nvbench import ABSENT, EVENTS, WALL
from mpmbench.nvbench_rows import Row
from mpmbench.report.text import seconds_text

WORDS = ("FAST", "SLOW", "SAME", "AMBG", "????")
ADVICE = {
    "AMBG": "AMBG: the times neither differ clearly nor agree: measure both again, longer, with clocks locked",
    "????": "????: a row without a usable time on one side",
}


def markdown(outcome: Outcome, ref: str, cmp: str, limits: Sequence[Limit] = ()) -> str:
    """The whole comparison of the files called ``ref`` and ``cmp``."""
    parts = [f"REF {ref}, CMP {cmp}; NVBench's robust rule, preset {outcome.preset}"]
    if outcome.differences:
        parts.append(f"**Environments differ**\n\n{_differences(outcome)}")
    for kind in (EVENTS, WALL):
        if pairs := [pair for pair in outcome.pairs if pair.ref.kind == kind]:
            parts.append(_pairs(kind, pairs))
    for side, rows in (("REF", outcome.only_ref), ("CMP", outcome.only_cmp)):
        if rows:
            parts.append(f"**Only in {side}** ({len(rows)})\n\n{_lonely(rows)}")
    for side, kinds in zip(("REF", "CMP"), outcome.untimed, strict=True):
        if kinds:
            told = ", ".join(f"{count} {kind}" for kind, count in kinds.items())
            parts.append(f"Not compared, for such rows have no measured time: {told} in {side}")
    parts += summary_lines(outcome, limits)
    return "\n\n".join(parts) + "\n"


def summary_lines(outcome: Outcome, limits: Sequence[Limit] = ()) -> list[str]:
    """Geometric mean, worst row and verdicts per kind of number; what to do; what failed."""
    lines = []
    for one in outcome.summaries:
        verdicts = ", ".join(f"{one.verdicts[word]} {word}" for word in WORDS if word in one.verdicts)
        lines.append(
            f"**{one.kind}**: geometric mean of CMP/REF {one.ratio:.4f} over {count(one.count)};"
            f" worst {one.worst.ratio:.4f}, {_plain(one.worst.cmp.title)}; {verdicts}"
        )
    seen = {pair.judgement.verdict for pair in outcome.pairs}
    lines += [text for word, text in ADVICE.items() if word in seen]
    for limit in limits:
        failed = limit.failed(outcome.pairs)
        unsure = sum(limit.exceeded(pair) for pair in outcome.pairs) - len(failed)
        also = f"; {unsure} more exceed it but are not SLOW, and do not count" if unsure else ""
        lines.append(f"--fail-on {limit}: {count(len(failed))} failed{also}")
        lines += [f"- {_plain(pair.cmp.title)}: {pair.change(limit.figure):.4f}" for pair in failed]
    return lines


def _differences(outcome: Outcome) -> str:
    return _table(
        ("key", "REF", "CMP", "rows", ""),
        [(d.key, d.ref, d.cmp, d.rows, "allowed" if d.allowed else "refused") for d in outcome.differences],
    )


def _pairs(kind: str, pairs: Sequence[Pair]) -> str:
    """One table; axes that all rows share stand above it."""
    texts = [_axes(pair) for pair in pairs]
    names = list(dict.fromkeys(name for axes in texts for name in axes))
    values = {name: {axes.get(name, ABSENT) for axes in texts} for name in names}
    shared = [f"{name}={next(iter(values[name]))}" for name in names if len(values[name]) == 1]
    varying = [name for name in names if len(values[name]) > 1]
    center = "/".join(dict.fromkeys(pair.center for pair in pairs))
    rows = [
        (
            pair.cmp.strategy,
            pair.cmp.dataset,
            *(axes.get(name, ABSENT) for name in varying),
            *(_time(row, pair.center) for row in (pair.ref, pair.cmp)),
            "" if pair.ratio is None else f"{pair.ratio:.4f}",
            pair.judgement.verdict,
            pair.judgement.told,
        )
        for pair, axes in zip(pairs, texts, strict=True)
    ]
    heads = ("strategy", "dataset", *varying, f"REF {center}", f"CMP {center}", "CMP/REF", "verdict", "why")
    common = f"; every row: {_plain(', '.join(shared))}" if shared else ""
    return f"**{kind}**{common}\n\n{_table(heads, rows)}"


def _axes(pair: Pair) -> dict[str, str]:
    """A row that was not timed may not know its cache state: its partner does."""
    cache = pair.ref.cache if pair.cmp.cache == ABSENT else pair.cmp.cache
    return {**dict(pair.cmp.axes), "cache": cache, "device": pair.cmp.device[0]}


def count(rows: int) -> str:
    return f"{rows} row" if rows == 1 else f"{rows} rows"


def _time(row: Row, figure: str) -> str:
    seconds = row.seconds(figure)
    return "" if seconds is None else seconds_text(seconds)


def _lonely(rows: Sequence[Row]) -> str:
    return "\n".join(
        f"- {_plain(row.title)} on {row.device[0]}"
        + (f" (dataset {row.fingerprint[:8]})" if row.fingerprint else "")
        + (f": {_plain(row.without_time)}" if row.without_time else "")
        for row in rows
    )


def _table(heads: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    cells = [[_plain(str(cell)) for cell in row] for row in rows]
    return tabulate(cells, headers=list(heads), tablefmt="github", disable_numparse=True)


def _plain(text: str) -> str:
    """A name from a file must not end a table's cell or line."""
    return " ".join(text.split()).replace("|", "\\|")


# ---- JSON ----------------------------------------------------------------------------------------------------------


def to_json(outcome: Outcome, ref: str, cmp: str, limits: Sequence[Limit] = ()) -> dict[str, Any]:
    """Everything that ``markdown`` says, as plain values; times in seconds."""
    return {
        "ref": ref,
        "cmp": cmp,
        "preset": outcome.preset,
        "differences": [
            {"key": d.key, "ref": d.ref, "cmp": d.cmp, "rows": d.rows, "allowed": d.allowed}
            for d in outcome.differences
        ],
        "rows": [_pair_json(pair) for pair in outcome.pairs],
        "only_ref": [_row_json(row) for row in outcome.only_ref],
        "only_cmp": [_row_json(row) for row in outcome.only_cmp],
        "untimed": dict(zip(("ref", "cmp"), outcome.untimed, strict=True)),
        "summaries": [
            {
                "kind": one.kind,
                "count": one.count,
                "geometric_mean": one.ratio,
                "worst": {"ratio": one.worst.ratio, **_row_json(one.worst.cmp)},
                "verdicts": one.verdicts,
            }
            for one in outcome.summaries
        ],
        "failed": {str(limit): [_row_json(pair.cmp) for pair in limit.failed(outcome.pairs)] for limit in limits},
    }


def _row_json(row: Row) -> dict[str, Any]:
    about: Mapping[str, Any] = {
        name: getattr(row, name)
        for name in ("kind", "transfer", "strategy", "dataset", "fingerprint", "cache", "without_time")
    }
    return {**about, "axes": dict(row.axes), "device": row.device[0]}


def _pair_json(pair: Pair) -> dict[str, Any]:
    figures = ("min", "q1", "median", "q3", "max", "mean")
    seconds = {
        side: {figure: row.seconds(figure) for figure in figures}
        for side, row in (("ref_s", pair.ref), ("cmp_s", pair.cmp))
    }
    verdict = {"verdict": pair.judgement.verdict, "reason": pair.judgement.reason, "why": pair.judgement.told}
    return {**_row_json(pair.cmp), **seconds, "ratio": pair.ratio, **verdict}
