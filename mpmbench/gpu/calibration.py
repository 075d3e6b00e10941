"""The three numbers of the GTX 970 that no document gives, each from one published cell of the thesis and no more.

What the counts of a cell say divided by its printed time, less the launch overhead. Everything else is prediction.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from mpmbench.errors import InputError
from mpmbench.gpu.model import SECTOR_BYTES

# What is calibrated -> (table, row) of the cell that it is calibrated on.
CELLS: Mapping[str, tuple[int, str]] = {
    "dram_bandwidth_achieved": (5, "SoA"),
    "row_activation_rate": (9, "Random"),
    "atomic_word_rate": (14, "global sorted"),
}


@dataclass(frozen=True)
class Cell:
    """Counts of one published row beside its printed time [s]."""

    seconds: float
    dram_sectors: int
    dram_activations: int
    atomic_lanes: int


def calibrate(cells: Mapping[tuple[int, str], Cell], launch_overhead: float) -> dict[str, float]:
    """Constants from exactly the cells of CELLS; more or fewer are an InputError. launch_overhead: [s]."""
    if set(cells) != set(CELLS.values()):
        raise InputError(f"calibration takes exactly the cells {', '.join(map(str, CELLS.values()))}")

    def rate(name: str, amount: str, unit: int = 1) -> float:
        cell = cells[CELLS[name]]
        return unit * getattr(cell, amount) / (cell.seconds - launch_overhead)

    return {
        "dram_bandwidth_achieved": rate("dram_bandwidth_achieved", "dram_sectors", SECTOR_BYTES),
        "row_activation_rate": rate("row_activation_rate", "dram_activations"),
        "atomic_word_rate": rate("atomic_word_rate", "atomic_lanes"),
    }


def to_toml(constants: Mapping[str, float]) -> str:
    """The file that stands in ``gpu/calibrated/``."""
    lines = [
        "# Written by mpmbench reproduce thesis --calibrate: three constants, each from one printed time.",
        "[constants]",
    ]
    for name, value in constants.items():
        table, row = CELLS[name]
        source = f"calibrated: the thesis, table {table}, {row}"
        lines.append(f'{name} = {{ value = {value:.6g}, source = "{source}", confidence = "medium" }}')
    return "\n".join(lines) + "\n"
