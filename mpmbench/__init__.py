"""mpmbench: which particle-grid transfer strategy is fastest on this GPU, for these particles, and why?

    import mpmbench as mb

    particles = mb.load_dataset("uniform_cube", particles=100_000, particles_per_cell=4, seed=1)
    nodes = mb.p2g("p2g_block_sync", particles, device="simulated", batching=4)
    back = mb.g2p("g2p_block_gather", particles, nodes)

Node 0 sits at ``origin``; lengths in m, masses in kg, velocities in m/s.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mpmbench.dataset import Dataset, load_dataset
from mpmbench.errors import InputError, MpmbenchError
from mpmbench.grid import Grid

if TYPE_CHECKING:
    from mpmbench.api import g2p, list_datasets, list_devices, list_variants, p2g
    from mpmbench.gpu import list_gpus
    from mpmbench.record import load_records

__all__ = [
    "Dataset",
    "Grid",
    "InputError",
    "MpmbenchError",
    "g2p",
    "list_datasets",
    "list_devices",
    "list_gpus",
    "list_variants",
    "load_dataset",
    "load_records",
    "p2g",
]

_LAZY = {name: "mpmbench.api" for name in ("p2g", "g2p", "list_variants", "list_datasets", "list_devices")}
_LAZY |= {"load_records": "mpmbench.record", "list_gpus": "mpmbench.gpu"}


def __getattr__(name: str) -> Any:
    # The engine's compilers take a moment to import: datasets and records should not wait for them.
    if name in _LAZY:
        from importlib import import_module

        return getattr(import_module(_LAZY[name]), name)
    raise AttributeError(f"module 'mpmbench' has no attribute {name!r}")
