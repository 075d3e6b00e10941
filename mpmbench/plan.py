"""A plan: one variant on one dataset and device, as steps that can run any number of times.

Buffers are allocated once. Preprocessing steps run in order, then the transfer, then the steps that bring results into
the dataset's order. Only the length of the active list comes back to the host in between.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mpmbench import preprocess
from mpmbench.dataset import Dataset
from mpmbench.device import Device, LaunchReport, run_all
from mpmbench.errors import InputError
from mpmbench.reference import Nodes, ParticleValues
from mpmbench.spline import get_spline
from mpmbench.variants import ATTRIBUTES, RESULTS, Variant, get, resolve_axes, why_impossible
from mpmbench.workspace import Step, Workspace, buffer_table

# The other half of a simulation's step where a strategy is timed as a part of one: the plainest there is.
PARTNERS = {"p2g": "g2p_global_gather", "g2p": "p2g_global_atomic"}


@dataclass(frozen=True)
class RestOfStep:
    """What else a simulation's step runs, on the same particles and nodes.

    before: untimed, so that the transfer finds the caches as the step leaves them.  step: all steps of one simulation
    step in order, by name; ``transfer`` is the name of the strategy's own.
    """

    before: tuple[Step, ...]
    step: tuple[Step, ...]
    transfer: str


@dataclass(frozen=True)
class Plan:
    """Launches of one variant over fixed buffers.

    steps: preprocessing, ``grid_clear`` or ``grid_divide`` last.  finish: after the transfer.
    device_bytes: of all buffers together.
    """

    work: Workspace
    steps: tuple[Step, ...]
    finish: tuple[Step, ...]
    device_bytes: int

    @property
    def transfer(self) -> Step:
        """The launches that are the strategy. With an active list they are known once ``steps`` have run."""
        return Step("transfer", self.work.variant.launch(self.work))

    def reset(self) -> tuple[Step, ...]:
        """What to run before each repeat of the transfer: sums start from zero, G2P overwrites its results."""
        return tuple(step for step in self.steps if step.name == "grid_clear")

    def run_once(self, device: Device) -> tuple[dict[str, LaunchReport], LaunchReport, dict[str, LaunchReport]]:
        """Run everything once: reports of the preprocessing steps, of the transfer, and of the steps after it."""
        before = run_steps(device, self.steps)
        transfer = run_steps(device, [self.transfer])["transfer"]
        return before, transfer, run_steps(device, self.finish)

    def outputs(self) -> Nodes | ParticleValues:
        """The result on the host, in the plan's dtype and the dataset's order."""
        work = self.work
        if work.variant.transfer == "p2g":
            nodes = work.grid.to_host_order(np.asarray(work.device.download(work.nodes)))
            return Nodes(mass=nodes[..., 3], momentum=nodes[..., :3])
        apic, n = work.axes["payload"] == "apic", work.particle_count
        flat = np.asarray(work.device.download(work.buffers["results"]))
        results = _by_particle(flat, RESULTS[work.axes["payload"]], n, work.axes["layout"])
        return ParticleValues(results[:, 0, :3], results[:, 1:, :3] if apic else None)


def build_plan(
    variant: Variant, dataset: Dataset, device: Device, axes: Mapping[str, Any], nodes: Nodes | None = None
) -> Plan:
    """Allocate, upload and compile.

    axes: as ``resolve_axes`` returns them.  nodes: mass and momentum that a G2P starts from; its first step divides
    them on the device. Raises InputError for a combination that cannot exist and for a particle outside the grid.
    """
    if reason := why_impossible(variant, axes):
        raise InputError(f"{variant.name}: {reason}")
    dataset.check_support(axes["spline"], np.dtype(axes["dtype"]))
    grid = dataset.grid
    if variant.transfer == "g2p" and nodes is None:
        raise InputError(f"{variant.name} gathers from nodes: give their mass and momentum")
    uploads = {"particles": device.upload(_attributes(dataset, axes))}
    if variant.transfer == "g2p" and nodes is not None:
        together = np.concatenate([np.asarray(nodes.momentum), np.asarray(nodes.mass)[..., None]], axis=-1)
        uploads["nodes"] = device.upload(grid.to_device_order(together.astype(axes["dtype"])))
    work = Workspace(variant, axes, grid, dataset.particle_count, device, uploads)
    return Plan(work, preprocess.steps(work), preprocess.finish(work), predict_bytes(variant, dataset, axes))


def rest_of_step(plan: Plan, device: Device) -> RestOfStep:
    """The step around a plan that has run: clear, P2G, divide, G2P, of which the plan is one."""
    work = plan.work
    partner = get(PARTNERS[work.variant.transfer])
    axes = resolve_axes(partner, {name: value for name, value in work.axes.items() if name in partner.axes})
    table = buffer_table(partner, work.grid, work.particle_count, axes)
    own = buffer_table(work.variant, work.grid, work.particle_count, work.axes)
    # The caches must see one set of particles and nodes, as in a simulation, not a copy of its own for each half.
    shared = {name: work.buffers[name] for name, layout in table.items() if own.get(name) == layout}
    other = Workspace(partner, axes, work.grid, work.particle_count, device, shared)
    mine, others = plan.transfer, Step(partner.name, partner.launch(other))
    mine = Step(work.variant.name, mine.launches)
    if work.variant.transfer == "p2g":
        clear, divide = preprocess.grid_clear(work), preprocess.grid_divide(other)
        return RestOfStep((divide, others, clear), (clear, mine, divide, others), mine.name)
    clear, divide = preprocess.grid_clear(other), preprocess.grid_divide(work)
    return RestOfStep((clear, others, divide), (clear, others, divide, mine), mine.name)


def predict_bytes(variant: Variant, dataset: Dataset, axes: Mapping[str, Any]) -> int:
    """Device memory that a plan takes [bytes], known before anything is allocated."""
    table = buffer_table(variant, dataset.grid, dataset.particle_count, axes)
    return sum(int(np.prod(shape)) * dtype.itemsize for shape, dtype in table.values())


def floor_bytes(variant: Variant, dataset: Dataset, axes: Mapping[str, Any]) -> int:
    """Global memory traffic that no strategy can go below [bytes]: each particle and each touched node once."""
    return variant.floor(axes, dataset.particle_count, touched_nodes(dataset, axes["spline"], axes["dtype"]))


def touched_nodes(dataset: Dataset, spline_name: str, dtype: Any) -> int:
    """Nodes in the support of at least one particle."""
    spline = get_spline(spline_name)
    occupied = np.zeros(dataset.grid.shape, bool)
    occupied[tuple(spline.bin_node(dataset.node_units(np.dtype(dtype))).T)] = True
    for axis in range(3):
        reached = np.zeros_like(occupied)
        size = occupied.shape[axis]
        for offset in range(-spline.left, spline.right + 1):
            source = [slice(None)] * 3
            target = [slice(None)] * 3
            source[axis] = slice(max(0, -offset), size - max(0, offset))
            target[axis] = slice(max(0, offset), size + min(0, offset))
            reached[tuple(target)] |= occupied[tuple(source)]
        occupied = reached
    return int(occupied.sum())


def run_steps(device: Device, steps: Sequence[Step]) -> dict[str, LaunchReport]:
    """Run steps once, in order; what their launches tell, by name."""
    reports = {}
    for step in steps:
        reports[step.name] = run_all(device, step.launches)
        if step.after is not None:
            step.after()
    return reports


def _attributes(dataset: Dataset, axes: Mapping[str, Any]) -> np.ndarray:
    """The particle buffer of particles.cuh, (attributes * n, 4); never empty."""
    n, count = dataset.particle_count, ATTRIBUTES[axes["payload"]]
    attributes = np.zeros((max(n, 1), count, 4), axes["dtype"])
    attributes[:n, 0, :3], attributes[:n, 0, 3] = dataset.position, dataset.mass
    attributes[:n, 1, :3] = dataset.velocity
    if count > 2:
        attributes[:n, 2:, :3] = dataset.affine
    if axes["layout"] == "soa":
        attributes = np.ascontiguousarray(attributes.transpose(1, 0, 2))
    return attributes.reshape(-1, 4)


def _by_particle(flat: np.ndarray, count: int, n: int, layout: str) -> np.ndarray:
    """(count * n, 4) as kernels write it -> (n, count, 4)."""
    if layout == "soa":
        return flat.reshape(count, -1, 4).transpose(1, 0, 2)[:n]
    return flat.reshape(-1, count, 4)[:n]
