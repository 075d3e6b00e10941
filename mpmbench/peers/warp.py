# mypy: ignore-errors
"""NVIDIA Warp: vec4 grid, 1-D weights once per particle, release mode, no backward pass.

Warp runs CPU kernels on the calling thread, where its atomic_add is a plain addition, and compiles with Clang for this
processor.
"""

# Warp reads annotations as objects, so they must not be turned into strings here.
from pathlib import Path
from typing import Any

import numpy as np

from mpmbench.grid import Grid
from mpmbench.peers import Library


class Transfers:
    """Starts Warp and compiles, outside of any timed span."""

    facts = {"fast_math": False, "threads": 1}  # noqa: RUF012

    def __init__(self) -> None:
        import warp as wp

        wp.config.log_level = wp.LOG_ERROR
        wp.config.mode = "release"
        wp.config.enable_backward = False
        wp.init()
        self.version = wp.__version__
        self._wp = wp
        self._p2g, self._g2p = _kernels(wp)
        wp.load_module(module=__name__, device="cpu")

    def _launcher(self, kernel: Any, grid: Grid, count: int, *arrays: np.ndarray):
        wp = self._wp
        # On the CPU these are views of the NumPy memory, not copies.
        wrapped = [wp.array(array, dtype=wp.vec4, device="cpu", copy=False) for array in arrays]
        inputs = [count, grid.shape[0], grid.shape[1], wp.vec3(*grid.origin), 1 / grid.dx, *wrapped]
        return wp.launch(kernel, dim=count, inputs=inputs, device="cpu", record_cmd=True).launch

    def p2g(self, grid: Grid, count: int, particles: np.ndarray, nodes: np.ndarray):
        return self._launcher(self._p2g, grid, count, particles, nodes)

    def g2p(self, grid: Grid, count: int, particles: np.ndarray, velocities: np.ndarray, results: np.ndarray):
        return self._launcher(self._g2p, grid, count, particles, velocities, results)


def _kernels(wp: Any):
    @wp.func
    def axis_weights(f: wp.float32) -> wp.vec4:
        g = 1.0 - f
        low = g * g * g * (1.0 / 6.0)
        inner = (0.5 * f - 1.0) * f * f + 2.0 / 3.0
        high = f * f * f * (1.0 / 6.0)
        return wp.vec4(low, inner, 1.0 - low - inner - high, high)

    @wp.kernel(grid_stride=False)
    def p2g(
        count: int, nx: int, ny: int, origin: wp.vec3, inv_dx: float,
        particles: wp.array(dtype=wp.vec4), nodes: wp.array(dtype=wp.vec4),
    ):  # fmt: skip
        p = wp.tid()
        position = particles[p]
        velocity = particles[count + p]
        mass = position[3]
        payload = wp.vec4(velocity[0] * mass, velocity[1] * mass, velocity[2] * mass, mass)
        x = (position[0] - origin[0]) * inv_dx
        y = (position[1] - origin[1]) * inv_dx
        z = (position[2] - origin[2]) * inv_dx
        bx = int(wp.floor(x))
        by = int(wp.floor(y))
        bz = int(wp.floor(z))
        wx = axis_weights(x - float(bx))
        wy = axis_weights(y - float(by))
        wz = axis_weights(z - float(bz))
        corner = ((bz - 1) * ny + by - 1) * nx + bx - 1
        for k in range(4):
            for j in range(4):
                row = payload * (wz[k] * wy[j])
                node = corner + (k * ny + j) * nx
                for i in range(4):
                    wp.atomic_add(nodes, node + i, row * wx[i])

    @wp.kernel(grid_stride=False)
    def g2p(
        count: int, nx: int, ny: int, origin: wp.vec3, inv_dx: float,
        particles: wp.array(dtype=wp.vec4), nodes: wp.array(dtype=wp.vec4), results: wp.array(dtype=wp.vec4),
    ):  # fmt: skip
        p = wp.tid()
        position = particles[p]
        x = (position[0] - origin[0]) * inv_dx
        y = (position[1] - origin[1]) * inv_dx
        z = (position[2] - origin[2]) * inv_dx
        bx = int(wp.floor(x))
        by = int(wp.floor(y))
        bz = int(wp.floor(z))
        wx = axis_weights(x - float(bx))
        wy = axis_weights(y - float(by))
        wz = axis_weights(z - float(bz))
        corner = ((bz - 1) * ny + by - 1) * nx + bx - 1
        sum = wp.vec4(0.0, 0.0, 0.0, 0.0)
        for k in range(4):
            for j in range(4):
                w = wz[k] * wy[j]
                node = corner + (k * ny + j) * nx
                for i in range(4):
                    sum += nodes[node + i] * (w * wx[i])
        results[p] = wp.vec4(sum[0], sum[1], sum[2], 0.0)

    return p2g, g2p


LIBRARY = Library("warp", "NVIDIA Warp", "warp-lang", Transfers, Path(__file__))
