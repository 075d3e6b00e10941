"""What a strategy works with on a device: its buffers, the constants of its kernels, and ways to launch them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mpmbench.device import CompiledKernel, Device, Launch
from mpmbench.errors import InputError, MpmbenchError
from mpmbench.grid import Grid, Triple
from mpmbench.launcher import INT32_LIMIT, THREADS, Launcher
from mpmbench.primitives.scan_lookback import state_length
from mpmbench.variants import ATTRIBUTES, AXES, COMPILER_OPTIONS, RESULTS, Variant

BufferTable = dict[str, tuple[tuple[int, ...], np.dtype]]


@dataclass(frozen=True)
class Step:
    """Launches that are timed and counted together under one name. ``after`` runs when they have finished."""

    name: str
    launches: tuple[Launch, ...]
    after: Callable[[], None] | None = None


def kernel_constants(axes: Mapping[str, Any]) -> dict[str, object]:
    """The ``#define`` block of a kernel, macro name -> value; an axis that a variant lacks gets a neutral one."""
    x, y, z = axes.get("block_shape", (1, 1, 1))
    return {
        "REAL": {"float32": "float", "float64": "double"}[axes["dtype"]],
        "REAL_IS_DOUBLE": axes["dtype"] == "float64",
        "SPLINE": {"linear": 1, "quadratic": 2, "cubic": 3}[axes["spline"]],
        "APIC": axes["payload"] == "apic",
        "SOA": axes["layout"] == "soa",
        "UNITY": axes["weights"] == "unity",
        "LITERAL": axes["writing"] == "literal",
        "INDEXED": axes["particle_order"] == "index",
        "BLOCK_INDEX": axes["cell_index"] == "block",
        "ACTIVE_ONLY": axes.get("blocks") == "active",
        "BLOCK_X": x,
        "BLOCK_Y": y,
        "BLOCK_Z": z,
        "BATCH": axes.get("batching", 1),
    }


def kernel_options(axes: Mapping[str, Any]) -> tuple[str, ...]:
    """NVRTC's options for a strategy's own kernel; none for the default axes."""
    return tuple(option for (axis, value), option in COMPILER_OPTIONS.items() if axes.get(axis) == value)


# For kernels that do not depend on a constant: one text, and so one compilation, for all its values.
NEUTRAL = kernel_constants({name: values[0] for name, values in AXES.items()} | {"block_shape": (1, 1, 1)})


def domain_type(dtype: Any) -> np.dtype:
    """``struct Domain`` of domain.cuh."""
    real = np.dtype(dtype)
    return np.dtype(
        [("shape", "i4", 3), ("blocks", "i4", 3), ("origin", real, 3), ("dx", real), ("inv_dx", real)], align=True
    )


def domain_value(grid: Grid, dtype: Any, block_shape: Triple = (1, 1, 1)) -> Any:
    """The grid as kernels take it, by value."""
    domain = np.zeros((), domain_type(dtype))
    domain["shape"], domain["blocks"], domain["origin"] = grid.shape, grid.blocks(block_shape), grid.origin
    domain["dx"], domain["inv_dx"] = grid.dx, 1 / grid.dx
    return domain[()]


def bin_count(grid: Grid, axes: Mapping[str, Any]) -> int:
    """Bins of a grid; blocks that reach past it are numbered in full."""
    if axes["cell_index"] == "global":
        return grid.node_count
    return int(np.prod(grid.blocks(axes["block_shape"]))) * int(np.prod(axes["block_shape"]))


def maximum_needed(variant: Variant, axes: Mapping[str, Any]) -> str | None:
    """Which per-block maximum the strategy or its active list is made from."""
    for need in ("halo_maximum", "block_maximum"):
        if need in variant.needs:
            return need
    return "block_maximum" if axes.get("blocks") == "active" else None


def buffer_table(variant: Variant, grid: Grid, particles: int, axes: Mapping[str, Any]) -> BufferTable:
    """Name -> shape and dtype of every device buffer of a plan. Nothing is allocated beside it.

    A buffer that a kernel takes but never touches has one element.
    """
    real, integer = np.dtype(axes["dtype"]), np.dtype(np.int32)
    order, attributes = axes["particle_order"], ATTRIBUTES[axes["payload"]]
    n, nodes = max(particles, 1), grid.node_count
    table: BufferTable = {"particles": ((attributes * n, 4), real), "nodes": ((nodes, 4), real)}
    keeps_order = order == "index" or (order == "deep" and variant.transfer == "g2p")
    table["order"] = ((n if keeps_order else 1,), integer)
    if variant.transfer == "g2p":
        table["velocities"] = ((nodes, 4), real)
        table["results"] = ((RESULTS[axes["payload"]] * n, 4), real)
    if order != "given":
        bins = bin_count(grid, axes) + 1
        table["bin_count"] = table["bin_start"] = ((bins,), integer)
        table["tickets"] = ((n, 2), integer)
        table["bin_scan"] = ((state_length(bins),), integer)
    if order == "deep":
        table["sorted_particles"] = table["particles"]
        if variant.transfer == "g2p":
            table["sorted_results"] = table["results"]
    if variant.uses_blocks:
        blocks = int(np.prod(grid.blocks(axes["block_shape"])))
        active = axes["blocks"] == "active"
        table["block_maximum"] = ((blocks if maximum_needed(variant, axes) else 1,), integer)
        table["active_blocks"] = ((blocks if active else 1,), integer)
        if active:
            table["block_slots"] = ((blocks,), integer)
            table["active_count"] = ((1,), integer)
            table["block_scan"] = ((state_length(blocks),), integer)
    return table


@dataclass
class Workspace(Launcher):
    """One variant, its axes and its buffers on one device: what ``Variant.launch`` builds launches from."""

    variant: Variant
    axes: Mapping[str, Any]
    grid: Grid
    particle_count: int
    device: Device
    buffers: dict[str, Any] = field(default_factory=dict, repr=False)  # given ones are kept, the others allocated
    active_count: int | None = None  # blocks in the active list; read back once it is made
    kernels: dict[Any, CompiledKernel] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        self.constants = kernel_constants(self.axes)
        table = buffer_table(self.variant, self.grid, self.particle_count, self.axes)
        for name, (shape, _) in table.items():
            if shape[0] >= INT32_LIMIT:
                raise InputError(f"{self.variant.name}: buffer {name} has {shape[0]} entries, kernels count to 2^31")
        for name, (shape, dtype) in table.items():
            if name not in self.buffers:
                self.buffers[name] = self.device.empty(shape, dtype)
        self.domain = domain_value(self.grid, self.axes["dtype"], self.axes.get("block_shape", (1, 1, 1)))

    # What kernels take as arguments, under the names that they give them.

    @property
    def count(self) -> np.int32:
        """Number of particles."""
        return np.int32(self.particle_count)

    @property
    def particles(self) -> Any:
        """Attributes of the particles, in the order in which the strategy reads them."""
        return self.buffers["sorted_particles" if self.axes["particle_order"] == "deep" else "particles"]

    @property
    def order(self) -> Any:
        """Sorted place -> particle; read only where particle_order is "index"."""
        return self.buffers["order"]

    @property
    def bin_start(self) -> Any:
        """First sorted particle of each bin; one entry more than bins."""
        return self.buffers["bin_start"]

    @property
    def block_maximum(self) -> Any:
        """Largest bin of each block, or of block and halo for a variant that needs "halo_maximum"."""
        return self.buffers["block_maximum"]

    @property
    def active_blocks(self) -> Any:
        """Blocks with particles; read only where blocks is "active"."""
        return self.buffers["active_blocks"]

    @property
    def nodes(self) -> Any:
        """Momentum and mass of each node."""
        return self.buffers["nodes"]

    @property
    def velocities(self) -> Any:
        """Velocity of each node (G2P)."""
        return self.buffers["velocities"]

    @property
    def results(self) -> Any:
        """Where G2P writes: in processing order where the particles were sorted deeply."""
        return self.buffers["sorted_results" if self.axes["particle_order"] == "deep" else "results"]

    # Kernels and launches.

    @property
    def kernel(self) -> CompiledKernel:
        """The strategy's own kernel, compiled for all its axes; only it takes their options of the compiler."""
        return self.compile(self.variant.kernel_path, self.variant.kernel, self.constants, kernel_options(self.axes))

    def helper(self, stem: str, uses: tuple[str, ...] = (), **constants: object) -> CompiledKernel:
        """A shipped preprocessing kernel. ``uses``: the constants it depends on; the others stay neutral."""
        chosen = NEUTRAL | {name: self.constants[name] for name in uses} | constants
        return self.compile(Path(stem), stem, chosen)

    def cover(self, threads: int, *args: Any, kernel: CompiledKernel | None = None) -> tuple[Launch, ...]:
        """One launch of at least ``threads`` threads in one dimension; none for zero threads."""
        return self.thread_blocks(-(-threads // THREADS), THREADS, *args, kernel=kernel)

    def per_block(self, *args: Any) -> tuple[Launch, ...]:
        """One launch of the strategy with a thread block per block of its list, one thread per cell."""
        count = int(np.prod(self.grid.blocks(self.axes["block_shape"])))
        if self.axes["blocks"] == "active":
            if self.active_count is None:
                raise MpmbenchError(f"{self.variant.name}: run the preprocessing steps before asking for the transfer")
            count = self.active_count
        return self.thread_blocks(count, int(np.prod(self.axes["block_shape"])), *args)

    def thread_blocks(
        self, count: int, threads: int, *args: Any, kernel: CompiledKernel | None = None
    ) -> tuple[Launch, ...]:
        """One launch of ``count`` thread blocks of ``threads`` threads; none where count is zero."""
        return self.launch(kernel or self.kernel, count, threads, *args)
