"""Transfer strategies: what a Variant is, the axes they share, and how they are found.

Each module of this package, and of any folder a user names, holds one ``VARIANT``; its kernel is a ``.cu`` file of the
same name. Nothing else lists variants: tests, tables and the command line read ``discover()``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mpmbench.discovery import (
    SHARED_LIMIT,
    THREAD_LIMIT,
    Axes,
    Shelf,
    always_possible,
    impossible,
    kernel_path,
    resolve,
)

if TYPE_CHECKING:
    from mpmbench.device import Launch
    from mpmbench.workspace import Workspace

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
    "math": ("ieee", "fast"),
    "contraction": ("fma", "none"),
}

# The axes of every kernel that gives each particle a thread, in any order; the first value is the default.
GLOBAL_AXES: dict[str, tuple[Any, ...]] = {
    name: AXES[name]
    for name in (
        "dtype", "spline", "payload", "layout", "weights", "writing", "particle_order", "cell_index", "block_shape",
        "math", "contraction",
    )
}  # fmt: skip
# The axes of kernels that give each block a thread block: particles must be sorted.
BLOCK_AXES: dict[str, tuple[Any, ...]] = {**AXES, "particle_order": ("deep", "index")}

# Values that are options of NVRTC, not constants of a kernel's text. The compiler takes the later of two that disagree,
# so that a kernel of fast math has no contraction where that is asked for.
COMPILER_OPTIONS: dict[tuple[str, Any], str] = {
    ("math", "fast"): "--use_fast_math",
    ("contraction", "none"): "--fmad=false",
}

PREPROCESSING = ("bins", "block_maximum", "halo_maximum")
ATTRIBUTES = {"pic": 2, "apic": 5}  # four-component attributes per particle
RESULTS = {"pic": 1, "apic": 4}  # of G2P, per particle


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
    requires: Callable[[Axes], str | None] = field(default=always_possible, repr=False)
    path: Path | None = None

    @property
    def kernel_path(self) -> Path:
        """The ``.cu`` file."""
        return kernel_path(self.kernel, self.path)

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


# --- axes and discovery -----------------------------------------------------------------------------------------------


def resolve_axes(variant: Variant, given: Axes) -> dict[str, Any]:
    """All axes of a variant: those given, the variant's defaults for the rest (``discovery.resolve``)."""
    return resolve(variant, given, AXES)


def why_impossible(variant: Variant, axes: Axes) -> str | None:
    """Why a combination cannot exist, in one line; None where it can."""
    return impossible(variant, axes, AXES)


def discover(extra_dirs: Sequence[str | Path] = ()) -> tuple[Variant, ...]:
    """Every shipped variant and those of the folders given, by name. Raises InputError for a module that has none."""
    return tuple(_SHELF.discover(extra_dirs).values())


def get(name: str, extra_dirs: Sequence[str | Path] = ()) -> Variant:
    """The variant of that name, or InputError naming all."""
    return _SHELF.get(name, extra_dirs)


def _problem(variant: Variant) -> str | None:
    if variant.transfer not in ("p2g", "g2p"):
        return f"transfer is {variant.transfer!r}; it must be 'p2g' or 'g2p'"
    if unknown := [need for need in variant.needs if need not in PREPROCESSING]:
        return f"needs {unknown[0]!r}; valid are {', '.join(PREPROCESSING)}"
    if not variant.kernel_path.is_file():
        return f"kernel {variant.kernel_path} does not exist"
    return None


_SHELF = Shelf("variant", __name__, "VARIANT", Variant, _problem)
