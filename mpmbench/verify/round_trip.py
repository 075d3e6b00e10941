"""Particles to nodes and back, over and over, with every buffer staying on the device.

In SoA the attributes that a round trip changes, velocity and the rows of C, follow the positions in one piece, laid out
as G2P writes its results: G2P writes where the next P2G reads, and nothing is copied.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from mpmbench import preprocess
from mpmbench.dataset import Dataset
from mpmbench.device import Device, Launch, run_all
from mpmbench.plan import build_plan
from mpmbench.spline import get_spline
from mpmbench.variants import ATTRIBUTES, get, resolve_axes
from mpmbench.verify.totals import Totals, node_totals, particle_totals

# What a trip may do to a total, in eps of its sum of magnitudes. The constants 1/6 and 2/3 of the cubic weights both
# round up in float32: plain weights sum to 1 + 0.35 eps on average, on each of three axes and for every particle alike.
# With unity the average is 1 + 0.01 eps, and what remains are roundings of either sign (tests/test_spline.py).
ALLOWED = {"plain": 1.5, "unity": 0.25}


class RoundTrip:
    """One dataset on one device; ``scatter`` and ``gather`` are the halves of a trip.

    p2g, g2p: names of variants.  axes: for both, as far as they have them; layout is SoA. Where particles are sorted,
    they are sorted once: positions must then stay as they are.
    """

    def __init__(self, dataset: Dataset, device: Device, p2g: str, g2p: str, axes: Mapping[str, Any]) -> None:
        scatter, gather = get(p2g), get(g2p)
        self.device, self.grid = device, dataset.grid
        plan = build_plan(scatter, dataset, device, resolve_axes(scatter, {**axes, "layout": "soa"}))
        for step in plan.steps:
            run_all(device, step.launches)
            if step.after is not None:
                step.after()
        self.work = work = plan.work
        n = work.particle_count
        moved = work.particles[n:]
        shared = {name: buffer for name, buffer in work.buffers.items()} | {"results": moved, "sorted_results": moved}
        own = resolve_axes(gather, {name: value for name, value in work.axes.items() if name in gather.axes})
        back = replace(work, variant=gather, axes=own, buffers=shared)
        self._scatter: tuple[Launch, ...] = (*preprocess.grid_clear(work).launches, *plan.transfer.launches)
        self._gather: tuple[Launch, ...] = (*preprocess.grid_divide(back).launches, *gather.launch(back))
        self._advect = work.helper("advect", ("REAL", "REAL_IS_DOUBLE", "APIC", "SOA"))

    def scatter(self) -> None:
        """Mass and momentum of the particles to the nodes."""
        run_all(self.device, self._scatter)

    def gather(self) -> None:
        """Velocities of the nodes, and from them new velocities (and C) of the particles."""
        run_all(self.device, self._gather)

    def advect(self, dt: float) -> None:
        """Move the particles by dt [s]."""
        work = self.work
        step = np.dtype(work.axes["dtype"]).type(dt)
        run_all(self.device, work.cover(work.particle_count, work.count, step, work.particles, kernel=self._advect))

    def nodes(self) -> np.ndarray:
        """(nodes, 4) momentum and mass as the last ``scatter`` left them."""
        return np.asarray(self.device.download(self.work.nodes))

    def particles(self) -> np.ndarray:
        """(attributes, n, 4) as kernels hold them now."""
        flat = np.asarray(self.device.download(self.work.particles))
        return flat.reshape(ATTRIBUTES[self.work.axes["payload"]], -1, 4)

    def node_totals(self) -> Totals:
        return node_totals(self.nodes(), self.grid)

    def particle_totals(self) -> Totals:
        return particle_totals(self.particles(), self.grid, get_spline(self.work.axes["spline"]).affine_factor)
