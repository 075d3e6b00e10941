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
    if not isinstance(dataset, Dataset):
        raise InputError(
            f"{name}: want a Dataset, from load_dataset or Dataset.from_arrays, not {type(dataset).__name__}"
        )
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
        nodes = _checked_nodes(nodes, dataset, axes["dtype"])
    plan = planning.build_plan(variant, dataset, device, axes, nodes=nodes)
    plan.run_once(device)
    return plan.outputs()


def _checked_nodes(nodes: Any, dataset: Dataset, dtype: str) -> Nodes:
    """Mass and momentum as arrays of the kernels' number type; whatever is wrong is an InputError."""
    if not isinstance(nodes, Nodes):
        raise InputError(f"nodes: want Nodes(mass, momentum), not {type(nodes).__name__}")
    arrays = []
    for label, given, want in (
        ("mass", nodes.mass, dataset.grid.shape),
        ("momentum", nodes.momentum, (*dataset.grid.shape, 3)),
    ):
        array = np.asarray(given)
        if array.shape != want:
            raise InputError(f"nodes: {label} has shape {array.shape}, want {want}")
        if array.dtype.kind not in "fiu":
            raise InputError(f"nodes: {label} has dtype {array.dtype}, want real numbers")
        with np.errstate(over="ignore"):
            array = array.astype(dtype)
        if not np.isfinite(array).all():
            where = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0][:3])
            raise InputError(f"nodes: {label} of node {where} is not finite in {dtype}")
        arrays.append(array)
    mass, momentum = arrays
    if mass.size and mass.min() < 0:
        where = tuple(int(i) for i in np.unravel_index(int(np.argmin(mass)), mass.shape))
        raise InputError(f"nodes: mass of node {where} is {mass.min():g} kg; no mass may be negative")
    return Nodes(mass=mass, momentum=momentum)


def list_variants(folders: Sequence[str] = ()) -> list[Variant]:
    """Every strategy, with ``name`` and a one-line ``summary``."""
    return list(discover(folders))


def list_datasets() -> list[Recipe]:
    """Every dataset recipe, with ``name`` and a one-line ``summary``."""
    return _list_datasets()


def list_devices() -> list[DeviceSummary]:
    """What runs on this CPU and, where there is one, each GPU; else one line that says why there is none."""
    devices = [
        DeviceSummary("simulated", "runs the CUDA kernels on this CPU: results, counters, findings; no times", True),
        DeviceSummary("cpu", "runs them on one core as fast as it can: wall clock, in tables of their own", True),
    ]
    try:
        open_device("cuda")
    except MpmbenchError as error:
        devices.append(DeviceSummary("cuda", f"not here: {error}", False))
    else:
        from mpmbench.device.cuda import list_gpus

        devices += [DeviceSummary(name, summary, True) for name, summary in list_gpus()]
    return devices
