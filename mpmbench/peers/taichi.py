# mypy: ignore-errors
"""Taichi, one thread: vec4 grid in external memory, 1-D weights once per particle, loops unrolled.

The particle loop is serialised, which lets Taichi turn its atomic additions into plain ones: one thread needs no more,
and left parallel P2G is about 25 times slower on one core.
"""

# Taichi reads annotations as objects, so they must not be turned into strings here.
import os
from pathlib import Path
from typing import Any

import numpy as np

from mpmbench.grid import Grid
from mpmbench.peers import Library


class Transfers:
    """Starts Taichi. Kernels compile at the first launch, which no one times."""

    facts = {"fast_math": True, "threads": 1}  # noqa: RUF012

    def __init__(self) -> None:
        os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")  # standard output is ours
        os.environ.setdefault("TI_SKIP_VERSION_CHECK", "ON")  # asks a server for news, from a thread of its own
        import taichi as ti

        ti.init(arch=ti.cpu, cpu_max_num_threads=1, offline_cache=False, fast_math=True, log_level=ti.ERROR)
        self.version = ".".join(str(part) for part in ti.__version__)
        self._ti = ti
        self._p2g, self._g2p = _kernels(ti)

    def _launcher(self, kernel: Any, grid: Grid, count: int, *arrays: np.ndarray):
        origin = self._ti.Vector([float(x) for x in grid.origin])
        arguments = (count, grid.shape[0], grid.shape[1], origin, 1 / grid.dx, *arrays)
        return lambda: kernel(*arguments)

    def p2g(self, grid: Grid, count: int, particles: np.ndarray, nodes: np.ndarray):
        return self._launcher(self._p2g, grid, count, particles, nodes)

    def g2p(self, grid: Grid, count: int, particles: np.ndarray, velocities: np.ndarray, results: np.ndarray):
        return self._launcher(self._g2p, grid, count, particles, velocities, results)


def _kernels(ti: Any):
    """Kernels can be declared only after ti.init chose the backend."""
    vec3 = ti.types.vector(3, ti.f32)
    vec4 = ti.types.vector(4, ti.f32)
    array = ti.types.ndarray(dtype=vec4, ndim=1)

    @ti.func
    def axis_weights(f):
        g = 1.0 - f
        low = g * g * g * (1.0 / 6.0)
        inner = (0.5 * f - 1.0) * f * f + 2.0 / 3.0
        high = f * f * f * (1.0 / 6.0)
        return vec4(low, inner, 1.0 - low - inner - high, high)

    @ti.kernel
    def p2g(count: ti.i32, nx: ti.i32, ny: ti.i32, origin: vec3, inv_dx: ti.f32, particles: array, nodes: array):
        ti.loop_config(serialize=True)
        for p in range(count):
            position = particles[p]
            payload = particles[count + p] * position[3]
            payload[3] = position[3]
            xi = (position[:3] - origin) * inv_dx
            bin = ti.floor(xi, ti.i32)
            f = xi - ti.cast(bin, ti.f32)
            wx = axis_weights(f[0])
            wy = axis_weights(f[1])
            wz = axis_weights(f[2])
            corner = ((bin[2] - 1) * ny + bin[1] - 1) * nx + bin[0] - 1
            for k, j in ti.static(ti.ndrange(4, 4)):
                row = payload * (wz[k] * wy[j])
                node = corner + (k * ny + j) * nx
                for i in ti.static(range(4)):
                    nodes[node + i] += row * wx[i]

    @ti.kernel
    def g2p(
        count: ti.i32, nx: ti.i32, ny: ti.i32, origin: vec3, inv_dx: ti.f32,
        particles: array, nodes: array, results: array,
    ):  # fmt: skip
        ti.loop_config(serialize=True)
        for p in range(count):
            xi = (particles[p][:3] - origin) * inv_dx
            bin = ti.floor(xi, ti.i32)
            f = xi - ti.cast(bin, ti.f32)
            wx = axis_weights(f[0])
            wy = axis_weights(f[1])
            wz = axis_weights(f[2])
            corner = ((bin[2] - 1) * ny + bin[1] - 1) * nx + bin[0] - 1
            total = vec4(0.0)
            for k, j in ti.static(ti.ndrange(4, 4)):
                w = wz[k] * wy[j]
                node = corner + (k * ny + j) * nx
                for i in ti.static(range(4)):
                    total += nodes[node + i] * (w * wx[i])
            total[3] = 0.0
            results[p] = total

    return p2g, g2p


LIBRARY = Library("taichi", "Taichi", "taichi", Transfers, Path(__file__))
