"""Named selections of cases: ``demo`` for a first look, ``thesis`` for every row of the thesis's tables 5-16."""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from mpmbench import primitives
from mpmbench.dataset import DATASETS_FOLDER
from mpmbench.errors import InputError
from mpmbench.primitive_runs import PrimitiveCase
from mpmbench.runner import Case, DatasetChoice
from mpmbench.variants import Variant, discover, resolve_axes

PRIMITIVE_TABLES = range(5, 11)
TRANSFER_TABLES = range(11, 17)

# The columns of a published table that pin what a row executes; the ones left of them are the source's own.
_DATASET_COLUMNS = ("dataset", "particles", "particles_per_cell")
_AXIS_COLUMNS = ("particle_order", "block_shape", "batching", "blocks", "weights", "writing")


def published_rows(table: int) -> list[dict[str, str]]:
    """The rows of one thesis table as printed, with the columns that pin them."""
    path = DATASETS_FOLDER / "published" / f"thesis_table_{table}.csv"
    with Path(path).open(newline="") as file:
        return list(csv.DictReader(file))


def thesis() -> list[Case | PrimitiveCase]:
    """Every row of tables 5-16 at full size: primitives, then transfers, dataset by dataset."""
    variants = {v.name: v for v in discover()}
    cases = [
        _transfer_case(place, row, variants)
        for table in TRANSFER_TABLES
        for place, row in enumerate(published_rows(table))
    ]
    # Stable: within a dataset the rows keep the order of the tables.
    cases.sort(key=lambda case: (case.dataset.name, case.dataset.particles_per_cell or 0))
    known = {p.name: p for p in primitives.discover()}
    return [
        *(
            _primitive_case(place, row, known)
            for table in PRIMITIVE_TABLES
            for place, row in enumerate(published_rows(table))
        ),
        *cases,
    ]


def _primitive_case(place: int, row: dict[str, str], known: dict[str, primitives.Primitive]) -> PrimitiveCase:
    """A row of tables 5-10: the columns right of ``size`` are axes."""
    columns = list(row)
    axes = columns[columns.index("size") + 1 :]
    primitive = known[row["variant"]]
    given = {name: row[name] for name in axes if row[name]}
    published = _published(place, row, ("variant", "size", *axes))
    return PrimitiveCase(primitive, int(row["size"]), primitives.resolve_axes(primitive, given), preset_row=published)


def _transfer_case(place: int, row: dict[str, str], variants: dict[str, Variant]) -> Case:
    variant = variants[row["variant"]]
    given: dict[str, Any] = {"dtype": "float32", "spline": "cubic", "payload": "pic", "layout": "soa"}
    for name in _AXIS_COLUMNS:
        if row[name]:
            given[name] = parse_value(row[name])
    choice = DatasetChoice(
        row["dataset"],
        particles=int(row["particles"]),
        particles_per_cell=int(row["particles_per_cell"]) if row["particles_per_cell"] else None,
    )
    published = _published(place, row, ("variant", *_DATASET_COLUMNS, *_AXIS_COLUMNS))
    return Case(variant, choice, resolve_axes(variant, given), published)


def _published(place: int, row: dict[str, str], pinning: Sequence[str]) -> dict[str, Any]:
    """Printed figures go into the record as the source gives them; the pinning columns are in dataset and axes."""
    printed = {k: v for k, v in row.items() if k not in pinning}
    preset_row: dict[str, Any] = {
        "source": "thesis",
        "table": int(printed.pop("table")),
        "row": printed.pop("row"),
        "place": place,  # of the row in its table; cases run dataset by dataset
        "published_us": float(printed.pop("time_us")),
        "published_speedup": float(printed["speedup"]) if printed.get("speedup") else None,
        "erratum": printed.pop("erratum") or None,
    }
    printed.pop("speedup", None)
    return preset_row | {"published": printed}


def demo() -> list[Case]:
    """Every strategy on the thesis's two datasets and on a real particle state, with sorted rows for the global ones
    and batched rows for those whose point batching is."""
    cases = []
    for choice in (
        DatasetChoice("random", particles=DEMO_PARTICLES),
        DatasetChoice("uniform_cube", particles=DEMO_PARTICLES),
        DatasetChoice("splash"),
    ):
        for variant in discover():
            defaults = resolve_axes(variant, {})
            cases.append(Case(variant, choice, defaults))
            if defaults.get("particle_order") == "given":
                cases.append(Case(variant, choice, resolve_axes(variant, {"particle_order": "deep"})))
            elif variant.name in ("p2g_block_atomic", "p2g_block_sync"):
                cases.append(Case(variant, choice, resolve_axes(variant, {"batching": 4})))
    return cases


DEMO_PARTICLES = 1_000_188

PRESETS: dict[str, Callable[[], Sequence[Case | PrimitiveCase]]] = {"demo": demo, "thesis": thesis}


def preset(name: str) -> list[Case | PrimitiveCase]:
    """The cases of a preset by name."""
    if name not in PRESETS:
        raise InputError(f"unknown preset {name!r}: valid are {', '.join(PRESETS)}")
    return list(PRESETS[name]())


def parse_value(text: str) -> Any:
    """``4`` -> 4, ``8x4x4`` -> (8, 4, 4), other words as they are."""
    if text.isdigit():
        return int(text)
    parts = text.split("x")
    if len(parts) == 3 and all(part.isdigit() for part in parts):
        return tuple(map(int, parts))
    return text
