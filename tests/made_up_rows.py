"""Rows of tables 5-16 as printed, with made-up modelled times: nothing is simulated."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from mpmbench.gpu import Constant
from mpmbench.gpu.modelled import TERMS, ModelledTime
from mpmbench.presets import published_rows
from mpmbench.reproduce.rows import Constants, Row

CONSTANTS = {
    "dram_bandwidth": Constant(175e9, "thesis table 5, SoA", "high"),
    "issue_efficiency": Constant(0.65, "thesis section 6.2", "medium"),
    "block_overhead": Constant(700, "PPT-GPU, Maxwell", "low"),
}
PINNING = ("table", "row", "time_us", "speedup", "erratum")


def modelled(us: float, bound: str = "issue", **terms: float) -> ModelledTime:
    """Of ``us`` microseconds, the other terms at a tenth of it unless given [s]."""
    seconds = 1e-6 * us
    lengths = {term: 0.1 * seconds for term in TERMS} | {bound: seconds} | terms | {"launch": 5e-6}
    return ModelledTime("gtx970", seconds, 0.75 * seconds, 1.33 * seconds, bound, lengths)


def row(table: int = 5, name: str = "AoS", us: float | None = 100, ours: float | None = 100, **more) -> Row:
    """One row by its published and its modelled time [us]."""
    time = None if ours is None else modelled(ours)
    return replace(Row(table, name, 0, us, {}, None, time, {}, "hash", "print", None), **more)


def thesis_rows(factor: Callable[[int, str], float] = lambda table, name: 1.0) -> list[Row]:
    """Every printed row; its modelled time is ``factor(table, row)`` times the printed one."""
    found = []
    for table in range(5, 17):
        for place, printed in enumerate(published_rows(table)):
            us = float(printed["time_us"])
            columns = list(printed)
            figures = {key: printed[key] for key in columns[: columns.index("variant")] if key not in PINNING}
            metrics = {key: 0.9 * float(value) for key, value in figures.items() if value.replace(".", "").isdigit()}
            metrics |= {"dram_bytes": float(figures.get("vram_percent") or 10) * 2.24e9 * us * 1e-6}
            metrics |= {"occupancy_warps": float(figures.get("occupancy_warps") or 16) + 1, "l2_hit_percent": 40.0}
            bound = TERMS[(table + place) % len(TERMS)]
            found.append(
                Row(
                    table, printed["row"], place, us, figures, printed["erratum"] or None,
                    modelled(us * factor(table, printed["row"]), bound), metrics, f"hash-{printed['variant']}",
                    f"print-{printed.get('dataset', table)}",
                )
            )  # fmt: skip
    return found


def retime(rows: Sequence[Row], constants: Constants) -> list[Row]:
    """Times inverse to the first constant: enough to see a score move."""
    name = next(iter(CONSTANTS))
    factor = CONSTANTS[name].value / constants[name].value
    return [
        replace(one, modelled=modelled(factor * 1e6 * one.modelled.seconds, one.modelled.bound))
        if one.modelled
        else one
        for one in rows
    ]
