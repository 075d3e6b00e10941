"""Rows of tables 5-16: what is printed, and what the performance model says of the same launches."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from mpmbench.errors import MpmbenchError
from mpmbench.gpu import Constant, Gpu
from mpmbench.gpu.modelled import ModelledTime

Constants = Mapping[str, Constant]  # of the model, by name
Progress = Callable[[str, int, int], None]  # (what runs, steps done, steps in all)


@dataclass(frozen=True)
class Row:
    """One printed row and its counterpart.

    row, place: the printed name, and where in its table it stands.  published: the other printed figures, as printed
    (vram_percent, sm_percent, l2_percent, l2_hit_percent, top_stall, occupancy_warps, ...).  metrics: the counted and
    modelled counterparts under the same names, and dram_bytes.  kernel_hash: of the sources of all its launches.
    failed: why there is no modelled time.  state: what ``retime`` needs; opaque.
    """

    table: int
    row: str
    place: int
    published_us: float | None
    published: Mapping[str, str]
    erratum: str | None
    modelled: ModelledTime | None
    metrics: Mapping[str, float]
    kernel_hash: str
    dataset_fingerprint: str
    failed: str | None = None
    state: Any = field(default=None, repr=False, compare=False)

    @property
    def modelled_us(self) -> float | None:
        return None if self.modelled is None else 1e6 * self.modelled.seconds


def model_constants(gpu: Gpu) -> Constants:
    """Every constant that a modelled time on this GPU rests on, with its source."""
    raise MpmbenchError("the performance model is not part of this version")


def thesis_rows(
    gpu: Gpu, constants: Constants, progress: Progress | None = None, jobs: int = 2, cache: bool = True
) -> list[Row]:
    """Count and model every row of tables 5-16, in printed order."""
    raise MpmbenchError("the performance model is not part of this version")


def retime(rows: Sequence[Row], constants: Constants) -> list[Row]:
    """The same counters under other constants."""
    raise MpmbenchError("the performance model is not part of this version")
