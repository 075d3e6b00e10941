"""The banks that block kernels take in a node step: a table and a picture per block shape among the records."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from mpmbench.banks import BankPattern
from mpmbench.record import Record
from mpmbench.report.plots import INK, RULE, SERIES, WIDTH, inline
from mpmbench.report.table import Cell, Column, Kind, Quantity, Row, Table, axis_text

MOST_ROWS = 24  # of an arena in a picture
ROW_HEIGHT = 0.2  # [inch]

EXPLANATION = (
    "Which of the 8 groups of banks each lane of a block's first warp takes at one node step. Another node step turns "
    "the pattern round and costs the same. Predicted from block shape and spline alone."
)


@dataclass(frozen=True)
class BankPicture:
    """Rows of an arena in memory order: bank group of every place, places of the first warp filled."""

    title: str
    axis: str
    pattern: BankPattern


def patterns(records: Sequence[Record]) -> list[BankPattern]:
    """Of the block kernels that ran, each once."""
    found = [
        BankPattern(r.axes["block_shape"], r.axes["spline"], r.axes["dtype"] == "float64")
        for r in records
        if "blocks" in r.axes and r.status == "ok"
    ]
    return list(dict.fromkeys(found))


def name_of(pattern: BankPattern) -> str:
    number = "float64" if pattern.double else "float32"
    return f"block {axis_text(pattern.block_shape)}, {pattern.spline}, {number}"


def picture(pattern: BankPattern) -> BankPicture:
    return BankPicture(
        f"Banks of {name_of(pattern)}",
        f"{pattern.wavefronts(0)} wavefronts per access of the first warp",
        pattern,
    )


def table(found: Sequence[BankPattern]) -> Table:
    """What an access of a whole block costs, and at the least."""
    columns = (
        Column("block shape", Kind.NAME, Quantity.CODE),
        Column("spline", Kind.NAME),
        Column("dtype", Kind.NAME),
        Column("arena", Kind.PREDICTED, Quantity.TEXT, explain="places per axis: the block and its halo"),
        Column(
            "accesses per bank group", Kind.PREDICTED, Quantity.TEXT, explain="of the first warp, groups 0 to 7"
        ),
        Column(
            "wavefronts / node step", Kind.PREDICTED, Quantity.COUNT, "less",
            "passes over the banks for one access by all warps of a block, eight lanes of 16 bytes at a time",
        ),
        Column("without conflicts", Kind.PREDICTED, Quantity.COUNT, explain="the least it could be"),
    )  # fmt: skip
    rows = []
    for pattern in found:
        values = (
            axis_text(pattern.block_shape), pattern.spline, "float64" if pattern.double else "float32",
            axis_text(pattern.arena), " ".join(map(str, pattern.accesses(0))), pattern.step_wavefronts,
            pattern.least_wavefronts,
        )  # fmt: skip
        rows.append(Row(tuple(Cell(value, column.kind) for value, column in zip(values, columns, strict=True))))
    return Table("", columns, tuple(rows))


def draw(chart: BankPicture) -> str:
    """The picture as SVG, as tables 17 and 18 of the thesis have it."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    pattern = chart.pattern
    width = pattern.arena[0]
    taken = set(pattern.places(0).tolist())
    rows = min(max(taken) // width + 1, MOST_ROWS)
    figure = Figure((WIDTH, ROW_HEIGHT * rows + 0.05))
    axes = figure.add_axes((0.01, 0.01, 0.98, 0.98))
    pieces = 2 if pattern.double else 1
    for row in range(rows):
        for x in range(width):
            place = row * width + x
            full = place in taken
            axes.add_patch(Rectangle((x, row), 1, 1, facecolor="none", edgecolor=RULE, linewidth=0.6))
            if full:
                axes.add_patch(Rectangle((x, row), 1, 1, facecolor=SERIES[0], linewidth=0, alpha=0.3))
            axes.text(
                x + 0.5, row + 0.5, str(pieces * place % 8), ha="center", va="center", fontsize=8,
                color=INK, fontweight="bold" if full else "normal",
            )  # fmt: skip
    axes.set_xlim(0, width)
    axes.set_ylim(rows, 0)
    axes.axis("off")
    return inline(figure, f"{chart.title}: {chart.axis}")
