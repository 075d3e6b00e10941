"""The particle states that engine and peers are timed on, as the arrays that native code takes."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mpmbench.dataset import Dataset, load_dataset
from mpmbench.grid import Grid


class PeerMissing(Exception):
    """A peer cannot run here; the message says why, for its row."""


@dataclass(frozen=True, eq=False)
class Scene:
    """One dataset in one memory order.

    attributes: (2n, 4) float32, position and mass of all particles, then velocity and 0.
    to_given: place in ``dataset`` of the particle at each place in ``attributes``, (n,).
    """

    name: str
    dataset: Dataset = field(repr=False)
    attributes: np.ndarray = field(repr=False)
    to_given: np.ndarray = field(repr=False)

    @property
    def grid(self) -> Grid:
        return self.dataset.grid

    @property
    def count(self) -> int:
        return self.dataset.particle_count


def aligned(shape: tuple[int, ...]) -> np.ndarray:
    """float32 zeros that start on a page, so that every arm sees the same alignment."""
    size = int(np.prod(shape))
    raw = np.zeros(size + 1024, dtype=np.float32)
    start = -raw.ctypes.data % 4096 // 4
    return raw[start : start + size].reshape(shape)


def make_scene(dataset: Dataset, *, deep: bool) -> Scene:
    """Arrays of a dataset in its own order, or sorted by cell (x fastest; stable inside a cell)."""
    n = dataset.particle_count
    to_given = np.arange(n)
    if deep:
        cell = np.floor(dataset.node_units(np.float32)).astype(np.int64)
        nx, ny, _ = dataset.grid.shape
        to_given = np.argsort((cell[:, 2] * ny + cell[:, 1]) * nx + cell[:, 0], kind="stable")
    attributes = aligned((2 * n, 4))
    attributes[:n, :3] = dataset.position[to_given]
    attributes[:n, 3] = dataset.mass[to_given]
    attributes[n:, :3] = dataset.velocity[to_given]
    return Scene(f"{dataset.name}, {'sorted' if deep else 'random order'}", dataset, attributes, to_given)


def shuffled(dataset: Dataset, seed: int) -> Dataset:
    """The same particles in random order."""
    place = np.random.default_rng(seed).permutation(dataset.particle_count)
    return Dataset(
        dataset.name, dataset.grid, dataset.position[place], dataset.velocity[place], dataset.affine[place],
        dataset.mass[place], order="random", seed=dataset.seed, recipe=dataset.recipe,
    )  # fmt: skip


def load(name: str, particles: int, *, deep: bool) -> Scene:
    """``uniform_cube`` or ``random``, with particles sorted by cell or shuffled."""
    return make_scene(shuffled(load_dataset(name, particles=particles), seed=7), deep=deep)
