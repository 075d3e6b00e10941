"""Primitives: the building blocks that transfers stand on, each in several strategies, and how they are found.

An ``Operation`` says what is computed: its inputs, its reference and its least traffic, once for all strategies. A
``Primitive`` is one way to compute it. Each module of this package, and of any folder a user names, holds one
``PRIMITIVE``; its kernel is a ``.cu`` file of the same name. Nothing else lists primitives.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mpmbench.check import CheckResult
from mpmbench.device import CompiledKernel, Device, Launch
from mpmbench.discovery import Axes, Shelf, Values, always_possible, impossible, kernel_path, resolve
from mpmbench.launcher import THREADS, Launcher

Arrays = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Operation:
    """What a group of primitives computes.

    name: one word; it names the report's table.  summary: one line.  unit: what ``size`` counts, in the plural.
    inputs: (axes, size, seed) -> host arrays by name.
    check: (inputs, outputs, axes) -> comparison with the exact or float64 reference.
    floor: (axes, size) -> least global memory traffic [bytes]: each input that is used and each result once.
    default_size: where the user names none.
    """

    name: str
    summary: str
    unit: str
    inputs: Callable[[Axes, int, int], dict[str, np.ndarray]] = field(repr=False)
    check: Callable[[Arrays, Arrays, Axes], CheckResult] = field(repr=False)
    floor: Callable[[Axes, int], int] = field(repr=False)
    default_size: int = 1024 * 1024


@dataclass(frozen=True)
class Built:
    """A primitive ready to run, any number of times.

    launches: the strategy; they are counted and timed.  outputs: device arrays by name, for the operation's check.
    before: what every repeat needs first (clearing sums, ...); neither counted nor timed.
    """

    launches: tuple[Launch, ...]
    outputs: Mapping[str, Any]
    before: tuple[Launch, ...] = ()


@dataclass
class Bench(Launcher):
    """One primitive, its axes and its inputs on one device: what ``Primitive.build`` builds from."""

    primitive: Primitive
    axes: Axes
    size: int
    inputs: Arrays
    device: Device
    kernels: dict[Any, CompiledKernel] = field(default_factory=dict, repr=False)

    def upload(self, host: np.ndarray) -> Any:
        """A copy on the device; of one zero where the array is empty, because a launch wants an address."""
        return self.device.upload(host if host.size else np.zeros((1, *host.shape[1:]), host.dtype))

    def empty(self, shape: int | tuple[int, ...], dtype: Any) -> Any:
        """Uninitialised device array of at least one element."""
        full = (shape,) if isinstance(shape, int) else shape
        return self.device.empty(tuple(max(edge, 1) for edge in full), np.dtype(dtype))

    def kernel(self, **constants: object) -> CompiledKernel:
        """The primitive's own kernel."""
        return self.compile(self.primitive.kernel_path, self.primitive.kernel, constants)

    def helper(self, stem: str, **constants: object) -> CompiledKernel:
        """A shipped kernel by the stem of its file."""
        return self.compile(Path(stem), stem, constants)

    def cover(self, kernel: CompiledKernel, threads: int, *args: Any) -> tuple[Launch, ...]:
        """One launch of at least ``threads`` threads; none for zero threads."""
        return self.launch(kernel, -(-threads // THREADS), THREADS, *args)


@dataclass(frozen=True)
class Primitive:
    """One strategy for one operation.

    name: also the stem of its module and its kernel; it begins with the operation's.  summary: one line.
    kernel: stem of the ``.cu`` file and name of its function; empty for a library's.
    axes: axis -> values it has, the default first.
    build: Bench -> uploaded inputs, outputs and the launches that are the strategy.
    reference: citation.
    requires: axes -> why this combination cannot run, or None.
    devices: kinds of device that it can run on.
    path: its module; set by ``discover``.
    """

    name: str
    operation: Operation
    summary: str
    kernel: str
    axes: Values
    build: Callable[[Bench], Built] = field(repr=False)
    reference: str
    requires: Callable[[Axes], str | None] = field(default=always_possible, repr=False)
    devices: tuple[str, ...] = ("simulated", "cuda")
    path: Path | None = None

    @property
    def kernel_path(self) -> Path:
        """The ``.cu`` file."""
        return kernel_path(self.kernel, self.path)


def known_values(primitive: Primitive) -> dict[str, tuple[Any, ...]]:
    """Axis -> every value that a primitive of the same operation has: more than one may ask of this primitive."""
    shipped = [p for p in discover() if p.operation.name == primitive.operation.name]
    return {
        name: tuple(dict.fromkeys([*values, *(v for p in shipped for v in p.axes.get(name, ()))]))
        for name, values in primitive.axes.items()
    }


def resolve_axes(primitive: Primitive, given: Axes) -> dict[str, Any]:
    """All axes of a primitive: those given, the primitive's defaults for the rest (``discovery.resolve``)."""
    return resolve(primitive, given, known_values(primitive))


def why_impossible(primitive: Primitive, axes: Axes) -> str | None:
    """Why a combination cannot exist, in one line; None where it can."""
    return impossible(primitive, axes, known_values(primitive))


def discover(extra_dirs: Sequence[str | Path] = ()) -> tuple[Primitive, ...]:
    """Every shipped primitive and those of the folders given, by name."""
    return tuple(_SHELF.discover(extra_dirs).values())


def get(name: str, extra_dirs: Sequence[str | Path] = ()) -> Primitive:
    """The primitive of that name, or InputError naming all."""
    return _SHELF.get(name, extra_dirs)


def _problem(primitive: Primitive) -> str | None:
    if not primitive.name.startswith(f"{primitive.operation.name}_"):
        return f"name {primitive.name!r} must begin with its operation, {primitive.operation.name}_"
    if primitive.kernel and not primitive.kernel_path.is_file():
        return f"kernel {primitive.kernel_path} does not exist"
    return None


_SHELF = Shelf("primitive", __name__, "PRIMITIVE", Primitive, _problem)
