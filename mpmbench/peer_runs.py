"""One peer through the whole flow, in the place of our plainest strategy: same buffers, same steps around it.

Everything but the transfer itself is ours: the particles are sorted, sums cleared and momentum divided by the same
launches as for our own strategies. So rows differ by the transfer alone, and a peer's total has a sort in it too.
"""

from __future__ import annotations

import hashlib
import itertools
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from mpmbench import plan as planning
from mpmbench import variants
from mpmbench.contest import BASELINES, Contender
from mpmbench.device import CompiledKernel, Device, Launch, LaunchReport
from mpmbench.environment import Environment
from mpmbench.errors import InputError
from mpmbench.kernel import KernelSource
from mpmbench.peers import Peer, PeerMissing, open_library, resolve_axes, why_impossible
from mpmbench.record import Check, Record
from mpmbench.runner import (
    Case,
    DatasetChoice,
    Inputs,
    Model,
    about_case,
    check_outputs,
    format_axis,
    label_of,
    why_not_here,
)
from mpmbench.workspace import Step


@dataclass(frozen=True)
class PeerCase:
    """One peer on one dataset with one choice of axes."""

    peer: Peer
    dataset: DatasetChoice
    axes: Mapping[str, Any]

    search = None  # a peer has no axes to search

    @property
    def name(self) -> str:
        return self.peer.name

    @property
    def ours(self) -> Case:
        """The same with our plainest strategy, whose transfer this one replaces."""
        variant = variants.get(BASELINES[self.peer.transfer])
        # "soa" and "global": how peers read particles, and the order of cells in which they like them.
        return Case(variant, self.dataset, _complete(variant, {**self.axes, "layout": "soa", "cell_index": "global"}))

    def shrunk(self, particles: int | None = None, size: int | None = None) -> PeerCase:
        """This case with so many particles, where its dataset has a choice."""
        return replace(self, dataset=self.ours.shrunk(particles, size).dataset)

    @property
    def label(self) -> str:
        """The peer and what differs from its defaults: unique among the cases of a contest."""
        return label_of(self.name, self.axes, resolve_axes(self.peer, {}))

    @property
    def title(self) -> str:
        """For progress lines."""
        return f"{self.label} on {self.dataset.name}"

    def contest_key(self, inputs: Inputs) -> tuple[Any, ...]:
        """That of our own cases which answer the same question."""
        return self.ours.contest_key(inputs)

    @property
    def is_plain(self) -> bool:
        """Never the baseline where one of ours is there."""
        return False

    def device_bytes(self, inputs: Inputs) -> int:
        """Memory that it takes while it is timed."""
        return 0 if why_impossible(self.peer, self.axes) else self.ours.device_bytes(inputs)

    def run(self, device: Device, inputs: Inputs, environment: Environment, model: Model | None = None) -> Record:
        """Run and check. What goes wrong becomes the record's reason, not an exception."""
        made = self.prepare(device, inputs, environment)
        if isinstance(made, Record):
            return made
        return Record(**made.about, host_seconds=time.perf_counter() - made.begin)

    def prepare(
        self, device: Device, inputs: Inputs, environment: Environment, cache: str = "cold"
    ) -> Record | Contender:
        """Build, run and check, so that it can be timed; a Record where it has come to an end before."""
        begin, ours, inputs_of = time.perf_counter(), self.ours, inputs.select(self.dataset)
        about = about_case(ours, device, inputs, environment) | {
            "variant": self.name,
            "variant_summary": self.peer.summary,
            "axes": dict(self.axes),
            "default_axes": resolve_axes(self.peer, {}),
        }
        if device.name != "cpu":
            return Record(**about, skipped_because="runs on the device cpu only: -d cpu")
        if reason := why_impossible(self.peer, self.axes) or why_not_here(ours, device, inputs, about):
            return Record(**about, skipped_because=reason)
        try:
            library = open_library(self.peer.library)
        except PeerMissing as error:
            return Record(**about, skipped_because=str(error))
        try:
            plan = planning.build_plan(
                ours.variant,
                inputs_of,
                device,
                ours.axes,
                inputs.rounded_nodes(ours.axes) if self.peer.transfer == "g2p" else None,
            )
            transfer = self._transfer(library, plan)
            planning.run_steps(device, (*plan.steps, transfer, *plan.finish))
            check = check_outputs(plan.outputs(), self.peer.transfer, inputs, ours.axes)
            about |= {
                "check": Check.of(check),
                "hashes": {self.name: _source(self.peer).sha256},
                "kernel_info": {
                    self.name: {"library": f"{self.peer.library.title} {library.version}", **library.facts}
                },
            }
            rest = planning.rest_of_step(plan, device) if cache == "step" and check.passed else None
            if rest:
                mine = Step(rest.transfer, transfer.launches)
                rest = replace(rest, step=tuple(mine if step.name == mine.name else step for step in rest.step))
                planning.run_steps(device, rest.before)  # compiles and loads
        except InputError as error:
            return Record(**about, failed_because=str(error), host_seconds=time.perf_counter() - begin)
        if not check.passed:
            return Record(**about, host_seconds=time.perf_counter() - begin)
        return Contender(
            label=self.label,
            about=about,
            steps=plan.steps,
            transfer=transfer,
            finish=plan.finish,
            reset=plan.reset(),
            outputs=plan.outputs,
            rest=rest,
            begin=begin,
        )

    def _transfer(self, library: Any, plan: planning.Plan) -> Step:
        work = plan.work
        if not work.particle_count:
            return Step("transfer", ())
        place = (work.grid, work.particle_count, work.particles)
        if self.peer.transfer == "p2g":
            call = library.p2g(*place, work.nodes)
        else:
            call = library.g2p(*place, work.velocities, work.results)
        kernel = CompiledKernel(_source(self.peer), self.name, _Call(self.peer, call))
        return Step("transfer", (Launch(self.name, kernel, (1, 1, 1), (1, 1, 1), ()),))

    def resume_key(self, device: Device, inputs: Inputs) -> tuple[Any, ...]:
        """Equal to ``runner.resume_key`` of the Record that this case would repeat."""
        axes = tuple(sorted((key, format_axis(value)) for key, value in self.axes.items()))
        return (self.name, axes, inputs.select(self.dataset).fingerprint, (device.name, device.arch), None, None)


def peer_cases(
    peers: Iterable[Peer], datasets: Sequence[DatasetChoice], axes: Mapping[str, Sequence[Any]]
) -> list[PeerCase]:
    """The product of datasets, peers and axis values, particles both as they are and sorted unless the axes say which.

    A peer ignores an axis that it does not have.
    """
    cases = []
    for dataset, peer in itertools.product(datasets, peers):
        chosen = {"particle_order": peer.axes["particle_order"]} | {k: v for k, v in axes.items() if k in peer.axes}
        for values in itertools.product(*chosen.values()):
            cases.append(PeerCase(peer, dataset, resolve_axes(peer, dict(zip(chosen, values, strict=True)))))
    return cases


@dataclass(frozen=True)
class _Call:
    """Stands for a compiled kernel where ``CpuDevice.launch`` looks for one: peers are timed on the path of ours."""

    peer: Peer
    call: Callable[[], object]

    def launch(self, grid: Any, block: Any, args: Any, shared_bytes: int = 0) -> LaunchReport:
        try:
            self.call()
        except Exception as error:  # of a library that is not ours: a row with a reason
            text = " ".join(str(error).split())[:200]
            raise InputError(f"{self.peer.library.title} failed: {type(error).__name__}: {text}") from error
        return LaunchReport()


def _complete(variant: variants.Variant, wanted: Mapping[str, Any]) -> dict[str, Any]:
    return variants.resolve_axes(variant, {name: value for name, value in wanted.items() if name in variant.axes})


def _source(peer: Peer) -> KernelSource:
    """The text of the library's transfers, for its hash in the record."""
    text = peer.path.read_text(encoding="utf-8")
    return KernelSource(peer.name, text, (), hashlib.sha256(text.encode()).hexdigest())
