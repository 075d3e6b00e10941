"""Which rows are scored. The list stands beside the published tables, with a reason for every row that is not."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from mpmbench.dataset import DATASETS_FOLDER
from mpmbench.errors import InputError
from mpmbench.reproduce.rows import Row

PATH = DATASETS_FOLDER / "published" / "comparable.toml"
CALIBRATED, NOT_COMPARABLE = "calibrated", "not comparable"


@dataclass(frozen=True)
class Excluded:
    """Why a row is shown and not scored. status: CALIBRATED or NOT_COMPARABLE."""

    status: str
    reason: str


@dataclass(frozen=True)
class Judged:
    """A row with the verdict on it. status: "comparable", CALIBRATED or NOT_COMPARABLE."""

    row: Row
    status: str
    reason: str  # "" for a comparable row

    @property
    def comparable(self) -> bool:
        return self.status == "comparable"

    @property
    def ratio(self) -> float | None:
        """Modelled over published time."""
        if self.row.modelled_us is None or not self.row.published_us:
            return None
        return self.row.modelled_us / self.row.published_us


@cache
def excluded_rows(path: Path = PATH) -> Mapping[tuple[int, str], Excluded]:
    """The rows that are not scored, by table and printed name."""
    with path.open("rb") as file:
        content = tomllib.load(file)
    found: dict[tuple[int, str], Excluded] = {}
    for entry in content["row"]:
        status = entry["status"]
        if status not in (CALIBRATED, NOT_COMPARABLE) or not entry["reason"]:
            raise InputError(f"{path}: row {entry} needs a status ({CALIBRATED}, {NOT_COMPARABLE}) and a reason")
        found[entry["table"], entry["row"]] = Excluded(status, entry["reason"])
    return found


def judge(rows: Sequence[Row], path: Path = PATH) -> list[Judged]:
    """Every row with the verdict on it, in the order given."""
    excluded = excluded_rows(path)
    judged = []
    for row in rows:
        if found := excluded.get((row.table, row.row)):
            judged.append(Judged(row, found.status, found.reason))
        elif row.published_us is None:
            judged.append(Judged(row, NOT_COMPARABLE, "no time is printed"))
        else:
            judged.append(Judged(row, "comparable", ""))
    return judged
