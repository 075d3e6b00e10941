"""Transfer strategies: what a Variant is, the axes they share, and how they are found.

Each module of this package, and of any folder a user names, holds one ``VARIANT``; its kernel is a ``.cu`` file of the
same name. Nothing else lists variants: tests, tables and the command line read ``discover()``.
"""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import pkgutil
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

from mpmbench.errors import InputError
from mpmbench.kernel import RAW_KERNELS

if TYPE_CHECKING:
    from mpmbench.device import Launch
    from mpmbench.workspace import Workspace

Axes = Mapping[str, Any]

# Every axis and every value that any variant may have. block_shape takes any three positive numbers.
AXES: dict[str, tuple[Any, ...]] = {
    "dtype": ("float32", "float64"),
    "spline": ("cubic", "quadratic", "linear"),
    "payload": ("pic", "apic"),
    "layout": ("soa", "aos"),
    "weights": ("unity", "plain"),
    "writing": ("hoisted", "literal"),
    "particle_order": ("given", "index", "deep"),
    "cell_index": ("global", "block"),
    "block_shape": ((8, 4, 4), (4, 4, 4), (8, 8, 4), (4, 4, 2), (3, 5, 2)),
    "batching": (1, 2, 4, 8),
    "blocks": ("active", "all"),
}

# The axes of every kernel that gives each particle a thread, in any order; the first value is the default.
GLOBAL_AXES: dict[str, tuple[Any, ...]] = {
    name: AXES[name]
    for name in (
        "dtype", "spline", "payload", "layout", "weights", "writing", "particle_order", "cell_index", "block_shape",
    )
}  # fmt: skip
# The axes of kernels that give each block a thread block: particles must be sorted.
BLOCK_AXES: dict[str, tuple[Any, ...]] = {**AXES, "particle_order": ("deep", "index")}

PREPROCESSING = ("bins", "block_maximum", "halo_maximum")
ATTRIBUTES = {"pic": 2, "apic": 5}  # four-component attributes per particle
RESULTS = {"pic": 1, "apic": 4}  # of G2P, per particle
SHARED_LIMIT = 48 * 1024  # bytes of shared memory that a thread block gets without opting in
THREAD_LIMIT = 1024  # threads of a thread block


def _always_possible(axes: Axes) -> str | None:
    return None


@dataclass(frozen=True)
class Variant:
    """One transfer strategy.

    name: also the stem of its module and its kernel.  summary: one line.  transfer: "p2g" or "g2p".
    kernel: stem of the ``.cu`` file and name of its function.
    needs: of PREPROCESSING, whatever the axes; sorting and the active list follow from the axes.
    axes: axis -> values it has, the default first.
    launch: Workspace -> the launches that are the strategy.
    floor: (axes, particles, touched nodes) -> least global memory traffic [bytes]: each read or written once.
    reference: citation.
    requires: axes -> why this combination cannot run, or None.
    path: its module; set by ``discover``.
    """

    name: str
    summary: str
    transfer: str
    kernel: str
    needs: tuple[str, ...]
    axes: Mapping[str, tuple[Any, ...]]
    launch: Callable[[Workspace], tuple[Launch, ...]] = field(repr=False)
    floor: Callable[[Axes, int, int], int] = field(repr=False)
    reference: str
    requires: Callable[[Axes], str | None] = field(default=_always_possible, repr=False)
    path: Path | None = None

    @property
    def kernel_path(self) -> Path:
        """The ``.cu`` file: shipped kernels have a folder of their own, a user's lies beside the module."""
        shipped = self.path is None or self.path.parent == Path(__file__).parent
        return (RAW_KERNELS if shipped else self.path.parent) / f"{self.kernel}.cu"  # type: ignore[union-attr]

    @property
    def uses_blocks(self) -> bool:
        return "blocks" in self.axes


def real_bytes(axes: Axes) -> int:
    """Size of one number [bytes]."""
    return np.dtype(axes["dtype"]).itemsize


def arena_places(axes: Axes) -> int:
    """Places of an arena: a block and its halo, one layer per cell that a support reaches further."""
    reach = {"linear": 1, "quadratic": 2, "cubic": 3}[axes["spline"]]
    x, y, z = axes["block_shape"]
    return (x + reach) * (y + reach) * (z + reach)


def p2g_floor(axes: Axes, particles: int, nodes: int) -> int:
    """Bytes a P2G cannot avoid: every attribute of each particle read once, each touched node written once."""
    return 4 * real_bytes(axes) * (particles * ATTRIBUTES[axes["payload"]] + nodes)


def g2p_floor(axes: Axes, particles: int, nodes: int) -> int:
    """Bytes a G2P cannot avoid: each position and touched node read once, each result written once."""
    return 4 * real_bytes(axes) * (particles * (1 + RESULTS[axes["payload"]]) + nodes)


def fits(axes: Axes, shared_bytes: int) -> str | None:
    """Why a block of this shape cannot be one thread block with this much static shared memory, or None."""
    shape = "x".join(map(str, axes["block_shape"]))
    threads = int(np.prod(axes["block_shape"]))
    if threads > THREAD_LIMIT:
        return f"block_shape {shape} needs {threads} threads, a thread block has at most {THREAD_LIMIT}"
    if shared_bytes > SHARED_LIMIT:
        return f"needs {shared_bytes} bytes of shared memory of {SHARED_LIMIT}: take a smaller block_shape or batching"
    return None


def arena_fits(axes: Axes) -> str | None:
    """``fits`` for kernels whose shared memory is one arena of nodes."""
    return fits(axes, 4 * real_bytes(axes) * arena_places(axes))


# --- axes -------------------------------------------------------------------------------------------------------------


def resolve_axes(variant: Variant, given: Mapping[str, Any]) -> dict[str, Any]:
    """All axes of a variant: those given, the variant's defaults for the rest.

    Values may be written as on the command line (``"4"``, ``"8x4x4"``). Raises InputError for an axis that the variant
    does not have and for a value that the axis does not have; a value that only this variant cannot take is a matter
    of ``why_impossible``.
    """
    for name in given:
        if name not in variant.axes:
            raise InputError(f"{variant.name} has no axis {name!r}: valid are {', '.join(variant.axes)}")
    return {
        name: _axis_value(name, given[name]) if name in given else values[0] for name, values in variant.axes.items()
    }


def why_impossible(variant: Variant, axes: Mapping[str, Any]) -> str | None:
    """Why a combination cannot exist, in one line; None where it can."""
    try:
        axes = resolve_axes(variant, axes)
    except InputError as error:
        return str(error)
    for name, value in axes.items():
        allowed = variant.axes[name]
        if name != "block_shape" and value not in allowed:
            return f"{name}={value} does not exist for {variant.name}: valid are {', '.join(map(str, allowed))}"
    return variant.requires(axes)


def _axis_value(name: str, value: Any) -> Any:
    if name not in AXES:
        return value  # an axis of a user's own: its module knows the values
    if name == "block_shape":
        return _block_shape(value)
    text = np.dtype(value).name if name == "dtype" and not isinstance(value, str) else str(value)
    for known in AXES[name]:
        if str(known) == text:
            return known
    raise InputError(f"axis {name} has no value {value!r}: valid are {', '.join(map(str, AXES[name]))}")


def _block_shape(value: Any) -> tuple[int, int, int]:
    parts = re.split(r"[x,]", value.strip("() ")) if isinstance(value, str) else value
    try:
        shape = tuple(int(part) for part in parts)
        whole = all(float(part) == edge for part, edge in zip(parts, shape, strict=True))
    except (TypeError, ValueError):
        shape, whole = (), False
    if len(shape) != 3 or not whole or min(shape) < 1:
        raise InputError(f"block_shape {value!r} must be three positive whole numbers of cells, such as 8x4x4")
    return (shape[0], shape[1], shape[2])


# --- discovery --------------------------------------------------------------------------------------------------------


def discover(extra_dirs: Sequence[str | Path] = ()) -> tuple[Variant, ...]:
    """Every shipped variant and those of the folders given, by name. Raises InputError for a module that has none."""
    found = {variant.name: variant for variant in _shipped()}
    for folder in map(Path, extra_dirs):
        if not folder.is_dir():
            raise InputError(f"variant folder {folder} does not exist")
        modules = [path for path in sorted(folder.glob("*.py")) if not path.name.startswith("_")]
        if not modules:
            raise InputError(f"variant folder {folder} has no Python module")
        for path in modules:
            variant = _variant_of(_load_file(path), path)
            other = found.get(variant.name)
            if other is not None and other.path != variant.path:
                raise InputError(f"{path}: variant name {variant.name!r} is taken by {other.path}")
            found[variant.name] = variant
    return tuple(found[name] for name in sorted(found))


def get(name: str, extra_dirs: Sequence[str | Path] = ()) -> Variant:
    """The variant of that name, or InputError naming all."""
    variants = discover(extra_dirs)
    for variant in variants:
        if variant.name == name:
            return variant
    raise InputError(f"unknown variant {name!r}: valid are {', '.join(v.name for v in variants)}")


@lru_cache(maxsize=1)
def _shipped() -> tuple[Variant, ...]:
    folder = Path(__file__).parent
    modules = [info.name for info in pkgutil.iter_modules([str(folder)])]
    return tuple(_variant_of(importlib.import_module(f"{__name__}.{m}"), folder / f"{m}.py") for m in sorted(modules))


def _load_file(path: Path) -> ModuleType:
    name = f"mpmbench_variant_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses of the module look themselves up here
    # A user's folder is not ours to fill with bytecode.
    write, sys.dont_write_bytecode = sys.dont_write_bytecode, True
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise InputError(f"cannot load variant module {path}: {type(error).__name__}: {error}") from error
    finally:
        sys.dont_write_bytecode = write
    return module


def _variant_of(module: ModuleType, path: Path) -> Variant:
    variant = getattr(module, "VARIANT", None)
    if not isinstance(variant, Variant):
        raise InputError(f"{path} has no VARIANT = Variant(...)")
    variant = replace(variant, path=path.resolve())
    if variant.transfer not in ("p2g", "g2p"):
        raise InputError(f"{path}: transfer is {variant.transfer!r}; it must be 'p2g' or 'g2p'")
    if unknown := [need for need in variant.needs if need not in PREPROCESSING]:
        raise InputError(f"{path}: needs {unknown[0]!r}; valid are {', '.join(PREPROCESSING)}")
    if not variant.kernel_path.is_file():
        raise InputError(f"{path}: kernel {variant.kernel_path} does not exist")
    if not inspect.getdoc(module):
        raise InputError(f"{path} has no docstring: say what the idea is, when it wins and when it loses")
    return variant
