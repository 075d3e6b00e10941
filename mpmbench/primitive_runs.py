"""One primitive through the whole flow: inputs -> build -> run -> check -> count or measure -> Record."""

from __future__ import annotations

import hashlib
import itertools
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from mpmbench.contest import Contender
from mpmbench.device import Device, LaunchReport, run_all
from mpmbench.environment import Environment
from mpmbench.errors import InputError
from mpmbench.launcher import INT32_LIMIT
from mpmbench.primitives import Arrays, Bench, Built, Primitive, resolve_axes, why_impossible
from mpmbench.record import Check, DatasetSummary, Record
from mpmbench.runner import Inputs, Model, format_axis, free_bytes, kernel_facts, label_of
from mpmbench.workspace import Step

SEED = 1


@dataclass(frozen=True)
class PrimitiveCase:
    """One primitive on one size with one choice of axes. ``preset_row``: the published row it repeats, if any."""

    primitive: Primitive
    size: int
    axes: Mapping[str, Any]
    seed: int = SEED
    preset_row: Mapping[str, Any] | None = None

    search = None  # axes are searched for transfers alone

    @property
    def name(self) -> str:
        return self.primitive.name

    def shrunk(self, particles: int | None = None, size: int | None = None) -> PrimitiveCase:
        """This case at another size: no repetition of a published row."""
        return self if size is None else replace(self, size=size, preset_row=None)

    @property
    def label(self) -> str:
        """The primitive and what differs from its defaults: unique among the cases of a contest."""
        return label_of(self.name, self.axes, resolve_axes(self.primitive, {}))

    @property
    def title(self) -> str:
        """For progress lines."""
        return f"{self.label} on {self.size}"

    def contest_key(self, inputs: Inputs) -> tuple[Any, ...]:
        """Cases of equal key answer the same question."""
        return (self.primitive.operation.name, self.size, self.fingerprint)

    @property
    def is_plain(self) -> bool:
        """Primitives have no baseline of their own: the first one that is asked for is it."""
        return False

    def device_bytes(self, inputs: Inputs) -> int:
        """Least device memory that it takes."""
        return self.primitive.operation.floor(self.axes, self.size)

    @cached_property
    def fingerprint(self) -> str:
        """sha256 of its input; of nothing where the combination cannot exist."""
        reason = why_impossible(self.primitive, self.axes)
        return _fingerprint({} if reason else self.primitive.operation.inputs(self.axes, self.size, self.seed))

    def run(self, device: Device, inputs: Inputs, environment: Environment, model: Model | None = None) -> Record:
        """Run, check and count. What goes wrong becomes the record's reason, not an exception.

        model: as for ``run_case``.
        """
        ran = self._checked(device, environment)
        if isinstance(ran, Record):
            return ran
        about, _, report, begin = ran
        if report.counters is not None:
            about |= {"transfer_counters": report.counters}
        if model is not None and about["check"].passed:
            about["modelled"] = model({}, report, {})
        return Record(**about, host_seconds=time.perf_counter() - begin)

    def prepare(
        self, device: Device, inputs: Inputs, environment: Environment, cache: str = "cold"
    ) -> Record | Contender:
        """Build, run and check, so that it can be timed; a Record where it has come to an end before."""
        ran = self._checked(device, environment)
        if isinstance(ran, Record):
            return ran
        about, built, _, begin = ran
        if not about["check"].passed:
            return Record(**about, host_seconds=time.perf_counter() - begin)
        return Contender(
            label=self.label,
            about=about,
            steps=(),
            transfer=Step("transfer", built.launches),
            finish=(),
            reset=(Step("before", built.before),) if built.before else (),
            outputs=lambda: {name: np.asarray(device.download(array)) for name, array in built.outputs.items()},
            rest=None,
            begin=begin,
        )

    def _checked(
        self, device: Device, environment: Environment
    ) -> Record | tuple[dict[str, Any], Built, LaunchReport, float]:
        """What a record says of one run, the launches, their report, and when it began; a Record where it did not
        run."""
        primitive, operation, axes, size = self.primitive, self.primitive.operation, self.axes, self.size
        if not 0 <= size < INT32_LIMIT:
            raise InputError(f"size {size} is out of range: kernels count {operation.unit} from 0 to 2^31 - 1")
        begin = time.perf_counter()
        reason = why_impossible(primitive, axes)
        if device.name.partition(":")[0] not in primitive.devices:
            reason = f"runs on {' and '.join(primitive.devices)} only"
        inputs = {} if reason else operation.inputs(axes, size, self.seed)
        about: dict[str, Any] = {
            "variant": primitive.name,
            "variant_summary": primitive.summary,
            "transfer": operation.name,
            "dataset": DatasetSummary.of_array(f"{size} {operation.unit}", size, self.seed, _fingerprint(inputs)),
            "axes": dict(axes),
            "default_axes": resolve_axes(primitive, {}),
            "device": device.name,
            "arch": device.arch,
            "environment": replace(environment, gpu=getattr(device, "facts", {})),
            "preset_row": self.preset_row,
        }
        if reason:
            return Record(**about, skipped_because=reason)
        about["floor_bytes"] = operation.floor(axes, size)
        if (least := about["floor_bytes"]) > (free := free_bytes(device)):
            return Record(
                **about, skipped_because=f"needs {least / 2**30:.2f} GiB, {device.name} has {free / 2**30:.2f} free"
            )
        try:
            built = build_primitive(primitive, device, axes, inputs, size)
            findings = [*run_all(device, built.before).findings]
            report = run_all(device, built.launches)
            outputs = {name: np.asarray(device.download(array)) for name, array in built.outputs.items()}
            check = operation.check(inputs, outputs, axes)
            about |= kernel_facts(device, built.launches, report.counters)
        except InputError as error:
            return Record(**about, failed_because=str(error), host_seconds=time.perf_counter() - begin)
        about |= {"check": Check.of(check), "findings": (*findings, *report.findings)}
        return about, built, report, begin

    def resume_key(self, device: Device, inputs: Inputs | None = None) -> tuple[Any, ...]:
        """Equal to ``runner.resume_key`` of the Record that this case would repeat."""
        axes = tuple(sorted((key, format_axis(value)) for key, value in self.axes.items()))
        row = self.preset_row or {}
        where = (device.name, device.arch)
        return (self.primitive.name, axes, self.fingerprint, where, row.get("table"), row.get("row"))


def primitive_cases(
    primitives: Iterable[Primitive], axes: Mapping[str, Sequence[Any]], size: int | None, seed: int | None
) -> list[PrimitiveCase]:
    """The product of primitives and the axis values asked for; a primitive ignores an axis that it does not have."""
    cases = []
    for primitive in primitives:
        names = [name for name in axes if name in primitive.axes]
        for values in itertools.product(*(axes[name] for name in names)):
            chosen = resolve_axes(primitive, dict(zip(names, values, strict=True)))
            count = primitive.operation.default_size if size is None else size
            cases.append(PrimitiveCase(primitive, count, chosen, SEED if seed is None else seed))
    return cases


def build_primitive(primitive: Primitive, device: Device, axes: Mapping[str, Any], inputs: Arrays, size: int) -> Built:
    """Upload and compile; ``axes`` as ``resolve_axes`` returns them."""
    return primitive.build(Bench(primitive, axes, size, inputs, device))


def _fingerprint(inputs: Arrays) -> str:
    digest = hashlib.sha256()
    for name, array in sorted(inputs.items()):
        digest.update(f"{name} {array.dtype} {array.shape}\n".encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()
