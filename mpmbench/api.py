"""The Python API: one call per question. Everything the command line does goes through the same functions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mpmbench import plan as planning
from mpmbench.dataset import Dataset, Recipe
from mpmbench.dataset import list_datasets as _list_datasets
from mpmbench.device import open_device
from mpmbench.errors import InputError, MpmbenchError
from mpmbench.reference import Nodes, ParticleValues
from mpmbench.variants import Variant, discover, get, resolve_axes, why_impossible


@dataclass(frozen=True)
class DeviceSummary:
    """A device that can be opened here, or why it cannot."""

    name: str
    summary: str
    available: bool


def p2g(
    variant: str, dataset: Dataset, *, device: str = "simulated", arch: str | None = None,
    variants: Sequence[str] = (), **axes: Any,
) -> Nodes:  # fmt: skip
    """Particles to grid: mass [kg] and momentum [kg m/s] of every node.

    variant: name of a P2G strategy.  arch: what the simulated device compiles for, e.g. "sm_52".
    variants: folders with strategies of your own.  axes: dtype, spline, payload, ... ; what is left out takes the
    variant's default. Raises InputError for an unknown variant, axis or value and for a combination that cannot exist.
    """
    return _transfer("p2g", variant, dataset, None, device, arch, variants, axes)


def g2p(
    variant: str, dataset: Dataset, nodes: Nodes, *, device: str = "simulated", arch: str | None = None,
    variants: Sequence[str] = (), **axes: Any,
) -> ParticleValues:  # fmt: skip
    """Grid to particles: velocity (n, 3) [m/s] and, for payload "apic", affine C (n, 3, 3) [1/s], in dataset order.

    nodes: mass and momentum, as ``p2g`` returns them; momentum is divided by mass first (empty nodes are at rest).
    """
    return _transfer("g2p", variant, dataset, nodes, device, arch, variants, axes)


def _transfer(
    transfer: str, name: str, dataset: Dataset, nodes: Nodes | None, device_name: str, arch: str | None,
    variants: Sequence[str], given: Mapping[str, Any],
) -> Any:  # fmt: skip
    variant = get(name, variants)
    if variant.transfer != transfer:
        raise InputError(f"{name} is a {variant.transfer} variant: call mpmbench.{variant.transfer}")
    axes = resolve_axes(variant, given)
    if reason := why_impossible(variant, axes):
        raise InputError(f"{name}: {reason}")
    dataset.check_support(axes["spline"], np.dtype(axes["dtype"]))
    options = {"arch": arch} if arch else {}
    device = open_device(device_name, **options)
    if nodes is not None:
        shape = dataset.grid.shape
        if nodes.mass.shape != shape or nodes.momentum.shape != (*shape, 3):
            raise InputError(
                f"nodes have shapes {nodes.mass.shape} and {nodes.momentum.shape}, want {shape} and {(*shape, 3)}"
            )
    plan = planning.build_plan(variant, dataset, device, axes, nodes=nodes)
    plan.run_once(device)
    return plan.outputs()


def list_variants(folders: Sequence[str] = ()) -> list[Variant]:
    """Every strategy, with ``name`` and a one-line ``summary``."""
    return list(discover(folders))


def list_datasets() -> list[Recipe]:
    """Every dataset recipe, with ``name`` and a one-line ``summary``."""
    return _list_datasets()


def list_devices() -> list[DeviceSummary]:
    """The simulated device and, where there is one, each GPU; else one line that says why there is none."""
    devices = [
        DeviceSummary("simulated", "runs the CUDA kernels on this CPU: results, counters, findings; no times", True)
    ]
    try:
        open_device("cuda")
    except MpmbenchError as error:
        devices.append(DeviceSummary("cuda", f"not here: {error}", False))
    else:
        from mpmbench.device.cuda import list_gpus

        devices += [DeviceSummary(name, summary, True) for name, summary in list_gpus()]
    return devices
