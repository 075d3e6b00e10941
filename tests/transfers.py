"""Run one variant on one dataset through the public check: what the tests of variants and of mutants have in common."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from mpmbench.check import CheckResult, check_g2p, check_p2g
from mpmbench.dataset import Dataset
from mpmbench.device import Device, LaunchReport
from mpmbench.plan import Plan, build_plan
from mpmbench.reference import Nodes, g2p, grid_divide, p2g
from mpmbench.simt.counters import Finding
from mpmbench.variants import Variant, resolve_axes

SEED = 1905


@lru_cache(maxsize=8)  # one object per dataset: references are remembered by identity
def crowded(n: int = 240, shape: tuple[int, int, int] = (13, 10, 11)) -> Dataset:
    """Odd-sized grid; a third of the particles anywhere, the rest crowded into a few cells on block borders."""
    rng = np.random.default_rng(SEED)
    anywhere = 1 + rng.random((n // 3, 3)) * (np.array(shape) - 3.001)
    crowds = np.array([[3, 3, 3], [4, 4, 4], [7, 3, 8], [2, 7, 7], [10, 7, 8]])
    crowd = crowds[rng.integers(0, len(crowds), n - n // 3)] + 0.99 * rng.random((n - n // 3, 3))
    return _dataset(np.concatenate([anywhere, crowd])[rng.permutation(n)], shape, rng)


@lru_cache(maxsize=8)
def filled(per_cell: int, cells: tuple[int, int, int] = (8, 4, 4)) -> Dataset:
    """Exactly ``per_cell`` particles in each cell of one box of cells, whatever the spline: it starts on a block."""
    rng = np.random.default_rng(SEED)
    corner = np.stack(np.meshgrid(*(np.arange(c) for c in cells), indexing="ij"), axis=-1).reshape(-1, 3)
    # Fractions from 0.5 to 1: floor(xi) and floor(xi - 1/2) are the same cell.
    xi = 8 + np.repeat(corner, per_cell, axis=0) + 0.5 + 0.49 * rng.random((per_cell * len(corner), 3))
    return _dataset(rng.permutation(xi), (24, 20, 20), rng)


def _dataset(xi: np.ndarray, shape: tuple[int, int, int], rng: np.random.Generator) -> Dataset:
    n, dx, origin = len(xi), 0.125, (-0.5, 0.25, 1.0)
    return Dataset.from_arrays(
        np.array(origin) + dx * xi, rng.uniform(-1, 1, (n, 3)), rng.uniform(1, 2, n), rng.uniform(-2, 2, (n, 3, 3)),
        grid_shape=shape, dx=dx, origin=origin,
    )  # fmt: skip


# References are asked for again and again by variants that differ in nothing they depend on.
@lru_cache(maxsize=64)
def reference_nodes(dataset: Dataset, spline: str, payload: str, dtype: str) -> Any:
    return p2g(dataset, spline, payload, dtype)


@lru_cache(maxsize=64)
def reference_particles(dataset: Dataset, spline: str, payload: str, dtype: str) -> Any:
    velocity = grid_divide(start_nodes(dataset, spline, payload, dtype))
    return g2p(dataset, velocity, spline, payload, dtype)


def start_nodes(dataset: Dataset, spline: str, payload: str, dtype: str) -> Nodes:
    """What a G2P starts from: the reference P2G."""
    return reference_nodes(dataset, spline, payload, dtype).nodes


def make_plan(variant: Variant, dataset: Dataset, device: Device, **axes: Any) -> Plan:
    resolved = resolve_axes(variant, axes)
    key = (dataset, resolved["spline"], resolved["payload"], resolved["dtype"])
    nodes = start_nodes(*key) if variant.transfer == "g2p" else None
    return build_plan(variant, dataset, device, resolved, nodes)


def transfer(
    variant: Variant, dataset: Dataset, device: Device, **axes: Any
) -> tuple[CheckResult, LaunchReport, tuple[Finding, ...]]:
    """The verdict on one run, the report of the transfer itself, and findings of all its steps."""
    plan = make_plan(variant, dataset, device, **axes)
    before, report, after = plan.run_once(device)
    findings = tuple(f for r in (*before.values(), report, *after.values()) for f in r.findings)
    chosen = plan.work.axes
    key = (dataset, chosen["spline"], chosen["payload"], chosen["dtype"])
    outputs: Any = plan.outputs()
    if variant.transfer == "p2g":
        return check_p2g(outputs, reference_nodes(*key)), report, findings
    return check_g2p(outputs, reference_particles(*key)), report, findings
