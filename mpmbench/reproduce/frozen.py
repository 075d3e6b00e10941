"""What was fixed before a score was known: constants, kernels, datasets, and which rows are scored.

One JSON file per version in ``frozen/``. A version is written once (``freeze``), gets its score once, from the first
run that scores it (``record_score``), and is never changed after that. A run that differs from the newest version in
anything frozen, or whose modelled times have moved since that version was scored, is post-hoc.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from mpmbench.errors import InputError
from mpmbench.gpu import Constant
from mpmbench.reproduce.comparable import Judged
from mpmbench.reproduce.rows import Constants
from mpmbench.reproduce.score import score, score_json

FOLDER = Path(__file__).parent / "frozen"
DECISIONS = Path(__file__).parents[2] / "docs" / "decisions"
SAME = 1e-9  # relative: constants that are computed may differ by roundings from one machine to the next
NOT_FROZEN = "nothing is frozen yet"


@dataclass(frozen=True)
class FrozenRow:
    """What is fixed of one row. modelled_us: at the first scoring; None before."""

    kernel_hash: str
    dataset_fingerprint: str
    published_us: float | None
    comparable: bool
    reason: str
    modelled_us: float | None = None


@dataclass(frozen=True)
class Frozen:
    """One version. date: UTC.  note: the decision that explains it.  score: the first, with its date; None before."""

    version: str
    date: str
    reason: str
    note: str
    gpu: str
    constants: Mapping[str, Constant]
    rows: Mapping[tuple[int, str], FrozenRow]
    score: Mapping[str, Any] | None = None


def versions(folder: Path | None = None) -> list[Frozen]:
    """Every version, oldest first."""
    return [read(path) for path in sorted((folder or FOLDER).glob("v*.json"), key=lambda path: _number(path.stem))]


def newest(folder: Path | None = None) -> Frozen | None:
    found = versions(folder)
    return found[-1] if found else None


def freeze(
    version: str, reason: str, gpu: str, constants: Constants, judged: Sequence[Judged], folder: Path | None = None
) -> tuple[Path, Frozen]:
    """Write a new version. Raises InputError for what ``check_new`` refuses, and for a row that failed."""
    check_new(version, reason, folder)
    if failed := [one.row for one in judged if one.row.failed]:
        raise InputError(f"table {failed[0].table}, {failed[0].row} failed ({failed[0].failed}): mend it, then freeze")
    frozen = Frozen(version, _now(), reason.strip(), note_name(version), gpu, dict(constants), _rows(judged))
    path = (folder or FOLDER) / f"{version}.json"
    _write(path, frozen)
    return path, frozen


def check_new(version: str, reason: str, folder: Path | None = None) -> None:
    """Raises InputError for a version that exists or is out of order, and for a freeze without a reason."""
    if not reason.strip():
        raise InputError("a freeze needs its reason: --reason TEXT")
    if not re.fullmatch(r"v[1-9]\d*", version):
        raise InputError(f"version {version!r} is not of the form v1, v2, ...")
    if (last := newest(folder)) is not None and _number(version) <= _number(last.version):
        raise InputError(
            f"version {version} cannot be written, {last.version} is frozen and versions are never changed: "
            f"take v{_number(last.version) + 1}"
        )


def record_score(judged: Sequence[Judged], differs: Sequence[str], folder: Path | None = None) -> Path:
    """Put the first score into the newest version. Raises InputError if it has one, or this run is post-hoc."""
    frozen = newest(folder)
    if frozen is None:
        raise InputError(f"{NOT_FROZEN}: mpmbench reproduce thesis --freeze v1 --reason TEXT")
    if frozen.score is not None:
        raise InputError(f"{frozen.version} was scored on {frozen.score['date']}: the first score stays")
    if differs:
        raise InputError(f"this run is post-hoc ({differs[0]}): its score is not that of {frozen.version}")
    found = score(judged)
    if found.unmodelled:
        raise InputError(f"{found.unmodelled} comparable rows have no modelled time: mend them, then score")
    path = (folder or FOLDER) / f"{frozen.version}.json"
    _write(path, replace(frozen, rows=_rows(judged, timed=True), score={"date": _now(), **score_json(found)}))
    return path


def differences(frozen: Frozen | None, gpu: str, constants: Constants, judged: Sequence[Judged]) -> list[str]:
    """What this run has other than the frozen version, one line each; empty if it is the frozen one."""
    if frozen is None:
        return [NOT_FROZEN]
    found = [] if gpu == frozen.gpu else [f"GPU {frozen.gpu}, now {gpu}"]
    for name in sorted({*frozen.constants, *constants}):
        before, now = frozen.constants.get(name), constants.get(name)
        if before is None or now is None:
            found.append(f"constant {name} {'is new' if before is None else 'is gone'}")
        elif not math.isclose(before.value, now.value, rel_tol=SAME):
            found.append(f"constant {name} was {before.value:.6g}, now {now.value:.6g}")
    ours = _rows(judged, timed=True)
    for table, row in sorted({*frozen.rows, *ours}):
        where = f"table {table}, {row}"
        then, here = frozen.rows.get((table, row)), ours.get((table, row))
        if then is None or here is None:
            found.append(f"{where}: {'is new' if then is None else 'is gone'}")
            continue
        if then.kernel_hash != here.kernel_hash:
            found.append(f"{where}: other kernel sources")
        if then.dataset_fingerprint != here.dataset_fingerprint:
            found.append(f"{where}: other particles or elements")
        if then.published_us != here.published_us:
            found.append(f"{where}: published time was {then.published_us}, now {here.published_us}")
        if then.comparable != here.comparable:
            words = ("comparable", "not comparable")
            found.append(f"{where}: was {words[not then.comparable]}, now {words[not here.comparable]}")
        if _moved(then.modelled_us, here.modelled_us):
            found.append(
                f"{where}: modelled {then.modelled_us:,.6g} µs when {frozen.version} was scored, "
                f"now {_us(here.modelled_us)}"
            )
    return found


def stamp(frozen: Frozen | None, differs: Sequence[str]) -> dict[str, Any]:
    """For the JSON file: against which version, and whether this run is post-hoc."""
    if frozen is None:
        return {"version": None, "stamp": "not frozen", "differs": []}
    return {"version": frozen.version, "stamp": "post-hoc" if differs else "as frozen", "differs": [*differs]}


def note_name(version: str, folder: Path = DECISIONS) -> str:
    """Path of the decision that explains a freeze: the one that is there, or one with the next free number."""
    for path in folder.glob(f"[0-9][0-9][0-9]-freeze-{version}.md"):
        return f"docs/decisions/{path.name}"
    numbers = [int(path.name[:3]) for path in folder.glob("[0-9][0-9][0-9]-*.md")]
    return f"docs/decisions/{max(numbers, default=0) + 1:03}-freeze-{version}.md"


def _moved(before: float | None, now: float | None) -> bool:
    return before is not None and (now is None or not math.isclose(before, now, rel_tol=1e-6))


def _us(value: float | None) -> str:
    return "none" if value is None else f"{value:,.6g} µs"


def _rows(judged: Sequence[Judged], timed: bool = False) -> dict[tuple[int, str], FrozenRow]:
    return {
        (one.row.table, one.row.row): FrozenRow(
            one.row.kernel_hash,
            one.row.dataset_fingerprint,
            one.row.published_us,
            one.comparable,
            f"{one.status}: {one.reason}" if one.reason else "",
            one.row.modelled_us if timed else None,
        )
        for one in judged
    }


# --- files ------------------------------------------------------------------------------------------------------------


def read(path: Path) -> Frozen:
    """One version. Raises InputError for a file that is none."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        content["constants"] = {name: Constant(**entry) for name, entry in content["constants"].items()}
        content["rows"] = {(r.pop("table"), r.pop("row")): FrozenRow(**r) for r in content["rows"]}
        return Frozen(**content)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"{path} is no frozen version ({type(error).__name__}: {error}): restore it from version control"
        ) from None


def _write(path: Path, frozen: Frozen) -> None:
    """One line per constant and row: a change shows as one line of a diff."""
    content = {name: getattr(frozen, name) for name in ("version", "date", "reason", "note", "gpu", "score")}
    head = [f"  {json.dumps(name)}: {_text(value)}" for name, value in content.items()]
    constants = [f"    {json.dumps(name)}: {_text(vars(value))}" for name, value in frozen.constants.items()]
    rows = [f"    {_text({'table': table, 'row': row, **vars(r)})}" for (table, row), r in frozen.rows.items()]
    parts = [*head, _block("constants", "{}", constants), _block("rows", "[]", rows)]
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.new")
    partial.write_text("{\n" + ",\n".join(parts) + "\n}\n", encoding="utf-8")
    partial.replace(path)


def _block(name: str, brackets: str, lines: Sequence[str]) -> str:
    return f"  {json.dumps(name)}: {brackets[0]}\n" + ",\n".join(lines) + f"\n  {brackets[1]}"


def _text(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False)


def _number(version: str) -> int:
    match = re.fullmatch(r"v(\d+)", version)
    if match is None:
        raise InputError(f"{FOLDER / version}.json: a frozen version is named v1, v2, ...")
    return int(match[1])


def _now() -> str:
    return datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
