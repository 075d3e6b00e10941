"""Our contender: a variant through the public path, with preprocessing outside of the timed span."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from scenes import Scene

from mpmbench.device import Device, open_device, run_all
from mpmbench.plan import Plan, build_plan
from mpmbench.reference import Nodes
from mpmbench.variants import discover, resolve_axes

NAME = "engine"


def open_engine(mode: str = "run") -> Device:
    """The simulated device for the default architecture."""
    return open_device("simulated", mode=mode)


class EngineTransfer:
    """A plan that has run once: buffers filled, kernels compiled, results ready to be checked."""

    def __init__(
        self, device: Device, variant: str, axes: Mapping[str, Any], scene: Scene, nodes: Nodes | None = None
    ) -> None:
        found = next(v for v in discover() if v.name == variant)
        self._device = device
        self.plan: Plan = build_plan(found, scene.dataset, device, resolve_axes(found, axes), nodes=nodes)
        self.plan.run_once(device)
        launches = self.plan.transfer.launches
        clears = tuple(launch for step in self.plan.reset() for launch in step.launches)
        self.run: Callable[[], object] = lambda: run_all(device, launches)
        self.reset: Callable[[], object] = lambda: run_all(device, clears)

    def finish(self) -> None:
        """Bring results into the dataset's order, so that they can be checked."""
        for step in self.plan.finish:
            run_all(self._device, step.launches)

    def outputs(self) -> Any:
        """``Nodes`` or ``ParticleValues``, in the dataset's order."""
        return self.plan.outputs()
