"""Small datasets on which transfers go wrong: none, one, crowded, on faces, at the edge, odd sizes, uneven grids."""

from __future__ import annotations

import numpy as np

from mpmbench.dataset import Dataset
from mpmbench.grid import Triple
from mpmbench.recipes import Uniform
from mpmbench.spline import Spline, get_spline

# Coarser than float32 near the domain's edge, so that the highest legal position stays legal in float32.
EDGE = 2.0**-12


def awkward_datasets(spline: str | Spline = "cubic") -> dict[str, Dataset]:
    """Datasets by name; only "domain_edge" depends on the spline, whose support it takes to the last node."""
    spline = get_spline(spline)
    uniform = Uniform(seed=1)

    def inside(stream: str, count: int, shape: Triple = (16, 16, 16)) -> np.ndarray:
        """Uniform xi in nodes [1, n-2), clear of the upper end."""
        return 1 + (np.array(shape) - 3 - EDGE) * uniform(stream, count, 3)

    corners = np.array(list(np.ndindex(2, 2, 2)), dtype=np.float64)
    nodes_per_axis = np.array([12, 9, 10])
    low = spline.left + spline.shift
    high = nodes_per_axis - spline.right + spline.shift - EDGE
    faces = np.floor(inside("faces", 150))
    faces[:50] += [0.5, 0.25, 0.0]
    faces[50:100] += [0.0, 0.5, 0.75]
    borders = np.stack([uniform("borders", 96)] * 3, axis=1)
    borders = np.array([4.0, 8.0, 12.0])[(3 * uniform("block", 96, 3)).astype(int)] + EDGE * np.sign(borders - 0.5)
    borders[:32] = np.round(borders[:32])
    placed: dict[str, tuple[np.ndarray, Triple]] = {
        "none": (np.zeros((0, 3)), (16, 16, 16)),
        "one": (np.array([[7.25, 6.5, 5.875]]), (16, 16, 16)),
        "two_in_one_cell": (np.array([[7.25, 6.5, 5.875], [7.75, 6.125, 5.0]]), (16, 16, 16)),
        "all_in_one_cell": (6 + (1 - EDGE) * uniform("crowd", 200, 3), (16, 16, 16)),
        "cell_faces": (faces, (16, 16, 16)),
        "half_cells": (np.floor(inside("half", 100)) + 0.5, (16, 16, 16)),
        "on_nodes": (np.floor(inside("nodes", 100)), (16, 16, 16)),
        "block_borders": (borders, (20, 20, 20)),
        "domain_edge": (low + corners * (high - low), tuple(nodes_per_axis.tolist())),
        "uneven_grid": (inside("uneven", 500, (13, 21, 10)), (13, 21, 10)),
        "smallest_grid": (inside("smallest", 20, (4, 4, 4)), (4, 4, 4)),
    }
    for count in (31, 33, 127, 1025):
        placed[f"size_{count}"] = (inside(f"size {count}", count), (16, 16, 16))
    datasets = {name: _dataset(name, xi, shape, uniform) for name, (xi, shape) in placed.items()}
    # A step and an origin that no binary number holds: the dtype decides on which side of a face a particle lies.
    dx, origin = 0.37, (-2.5, 0.1, 7.7)
    shifted = _dataset("shifted_origin", inside("shifted", 300), (16, 16, 16), uniform, dx, origin)
    on_rounded = 3 + np.floor(10 * uniform("rounded", 300, 3)) / 2
    rounded = _dataset("faces_after_rounding", on_rounded, (16, 16, 16), uniform, dx, origin)
    # Twelve decades: what a heavy particle loses to rounding may not hide what is lost of a light one elsewhere.
    masses = _dataset(
        "huge_mass_ratio", inside("ratio", 300), (16, 16, 16), uniform, mass=10.0 ** (12 * uniform("decades", 300) - 8)
    )
    datasets |= {"shifted_origin": shifted, "faces_after_rounding": rounded, "huge_mass_ratio": masses}
    return datasets


def _dataset(
    name: str,
    xi: np.ndarray,
    shape: Triple,
    uniform: Uniform,
    dx: float = 0.25,
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
    mass: np.ndarray | None = None,
) -> Dataset:
    """Particles at xi (n, 3); velocity in [-1, 1], affine in [-1, 1] / (4 dx), mass, if not given, in [0.5, 1.5]."""
    n = len(xi)
    return Dataset.from_arrays(
        np.array(origin) + dx * xi,
        2 * uniform(f"{name} velocity", n, 3) - 1,
        0.5 + uniform(f"{name} mass", n) if mass is None else mass,
        (2 * uniform(f"{name} affine", n, 3, 3) - 1) / (4 * dx),
        grid_shape=shape,
        dx=dx,
        origin=origin,
        name=name,
    )
