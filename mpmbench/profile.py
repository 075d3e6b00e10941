"""Cases on named GPUs: one simulation per architecture, its caches and DRAM counted, its time modelled."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from mpmbench.errors import InputError
from mpmbench.gpu import Gpu
from mpmbench.record import Record


def profile_cases(cases: Sequence[Any], gpus: Sequence[Gpu], progress: Callable[[str, int, int], None]) -> list[Record]:
    """Records with ``modelled`` filled for each GPU. progress: told what runs, the cases done and the cases in all."""
    raise InputError("profile is not implemented")
