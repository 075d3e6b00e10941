"""NVIDIA Warp on the CPU: vec4 grid, 1-D weights once per particle, release mode, no backward pass.

Warp runs CPU kernels on one thread, where its atomic_add is a plain addition, and compiles with Clang for this CPU.
"""

from __future__ import annotations

import numpy as np
from scenes import PeerMissing, Scene

NAME = "Warp"

try:
    import warp as wp
except ImportError:  # the optional extra `peers`
    wp = None

if wp is not None:
    wp.config.log_level = wp.LOG_ERROR
    wp.config.mode = "release"
    wp.config.enable_backward = False

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


class Peer:
    """Compiles its module at construction, outside of any timed span."""

    name = NAME

    def __init__(self) -> None:
        if wp is None:
            raise PeerMissing("warp-lang is not installed (extra `peers`)")
        wp.init()
        wp.load_module(device="cpu")
        self.version = wp.__version__

    def _launcher(self, kernel, scene: Scene, arrays: tuple[np.ndarray, ...]):
        grid = scene.grid
        # On the CPU these are views of the NumPy memory, not copies.
        wrapped = [wp.array(array, dtype=wp.vec4, device="cpu", copy=False) for array in arrays]
        origin = wp.vec3(*grid.origin)
        inputs = [scene.count, grid.shape[0], grid.shape[1], origin, 1 / grid.dx, *wrapped]
        command = wp.launch(kernel, dim=scene.count, inputs=inputs, device="cpu", record_cmd=True)
        return command.launch

    def p2g(self, scene: Scene, nodes: np.ndarray):
        """A call that adds all particles into ``nodes`` (nodes, 4)."""
        return self._launcher(p2g, scene, (scene.attributes, nodes))

    def g2p(self, scene: Scene, nodes: np.ndarray, results: np.ndarray):
        """A call that gathers ``nodes`` (nodes, 4) into ``results`` (n, 4)."""
        return self._launcher(g2p, scene, (scene.attributes, nodes, results))
