"""Datasets: particles on a grid, from a recipe in ``datasets/``, from a user's file or from arrays.

``load_dataset`` turns a name or a path into a ``Dataset``; ``Dataset.from_arrays`` is the door for a user's own
particles. Everything a user can get wrong is one ``InputError`` line.
"""

from __future__ import annotations

import hashlib
import math
import textwrap
import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from mpmbench import density, particle_file, recipes
from mpmbench.environment import machine_bytes
from mpmbench.errors import InputError
from mpmbench.grid import Grid
from mpmbench.launcher import INT32_LIMIT
from mpmbench.spline import Spline, get_spline

# A link to the top-level folder in a checkout, a plain folder in a wheel.
DATASETS_FOLDER = Path(__file__).parent / "datasets"

# Four float64 arrays and what it takes to draw them and to look at their density: measured on 4 million particles.
RECIPE_BYTES_PER_PARTICLE = 290


@dataclass(frozen=True, eq=False)
class Dataset:
    """Particles on a grid; arrays are read-only.

    name: of the recipe or file.  recipe: its parameters, enough to make it again.  seed: of the recipe, None for data.
    position (n, 3) [m], velocity (n, 3) [m/s], affine (n, 3, 3) C [1/s] (payload APIC), mass (n,) [kg]; float64.
    order: how neighbours in memory lie in space, in words.
    """

    name: str
    grid: Grid
    position: np.ndarray = field(repr=False)
    velocity: np.ndarray = field(repr=False)
    affine: np.ndarray = field(repr=False)
    mass: np.ndarray = field(repr=False)
    order: str = "given"
    seed: int | None = None
    recipe: dict[str, Any] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        for array in (self.position, self.velocity, self.affine, self.mass):
            array.setflags(write=False)

    @classmethod
    def from_arrays(
        cls,
        position: Any,
        velocity: Any,
        mass: Any,
        affine: Any = None,
        *,
        grid_shape: Sequence[int],
        dx: float,
        origin: Sequence[float] = (0.0, 0.0, 0.0),
        name: str = "arrays",
        order: str = "given",
    ) -> Dataset:
        """A dataset of a user's own particles, copied and checked.

        position, velocity (n, 3) [m], [m/s]; mass (n,) or one number for all [kg]; affine (n, 3, 3) [1/s] or None for
        zeros; grid_shape: nodes per axis; dx [m]; origin of node (0, 0, 0) [m].
        """
        grid = make_grid(grid_shape, dx, origin, where=name)
        where = f"dataset {name!r}"
        position = _array(position, "position", where)
        if position.ndim != 2 or position.shape[1] != 3:
            raise InputError(f"{where}: position has shape {position.shape}, want (n, 3)")
        n = len(position)
        velocity = _array(velocity, "velocity", where)
        mass = _array(mass, "mass", where)
        if mass.ndim == 0:
            mass = np.full(n, float(mass))
        affine = np.zeros((n, 3, 3)) if affine is None else _array(affine, "affine", where)
        for array, label, shape in (
            (velocity, "velocity", (n, 3)),
            (mass, "mass", (n,)),
            (affine, "affine", (n, 3, 3)),
        ):
            if array.shape != shape:
                raise InputError(f"{where}: {label} has shape {array.shape}, want {shape} as position has {n} rows")
        for array, label in ((position, "position"), (velocity, "velocity"), (mass, "mass"), (affine, "affine")):
            finite = np.isfinite(array).all(axis=tuple(range(1, array.ndim)))
            if not finite.all():
                p = int(np.argmin(finite))
                raise InputError(f"{where}: {label} of particle {p} is not finite: {array[p].tolist()}")
        if n and mass.min() <= 0:
            p = int(np.argmax(mass <= 0))
            raise InputError(f"{where}: mass of particle {p} is {mass[p]:g} kg; every mass must be positive")
        dataset = cls(name, grid, position, velocity, affine, mass, order=order)
        dataset.check_support("linear", np.float64)
        return dataset

    @property
    def particle_count(self) -> int:
        return len(self.position)

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 (hex) of the four arrays and the grid: equal fingerprints mean bit-equal datasets."""
        digest = hashlib.sha256(repr((self.grid.shape, float(self.grid.dx), self.grid.origin)).encode())
        for array in (self.position, self.velocity, self.affine, self.mass):
            digest.update(np.ascontiguousarray(array, dtype="<f8").data)
        return digest.hexdigest()

    @cached_property
    def statistics(self) -> dict[str, Any]:
        """Density and order of the particles, by name; see ``density.statistics``."""
        return density.statistics(self.node_units(), self.grid)

    @property
    def particles_per_cell(self) -> float:
        """Mean over the cells that hold particles."""
        return self.statistics["mean_per_occupied_cell"]

    def node_units(self, dtype: Any = np.float64) -> np.ndarray:
        """(n, 3) xi = (x - origin) / dx as kernels compute it: inputs and each operation rounded to ``dtype``."""
        real = np.dtype(dtype).type
        origin = np.array(self.grid.origin, dtype=real)
        with np.errstate(over="ignore", invalid="ignore"):  # what does not fit is not finite, so outside any grid
            return (self.position.astype(real) - origin) * real(1 / self.grid.dx)

    def check_support(self, spline: str | Spline, dtype: Any = np.float32) -> None:
        """Raise InputError naming the first particle whose support leaves the grid in ``dtype`` arithmetic.

        So does a particle whose mass or momentum ``dtype`` cannot hold.
        """
        spline = get_spline(spline)
        with np.errstate(invalid="ignore"):
            node = spline.bin_node(self.node_units(dtype))
        last = np.array(self.grid.shape) - 1
        outside = ((node < spline.left) | (node > last - spline.right)).any(axis=1)
        if outside.any():
            p = int(np.argmax(outside))
            origin, dx = np.array(self.grid.origin), self.grid.dx
            low = origin + dx * (spline.left + spline.shift)
            high = origin + dx * (last + 1 - spline.right + spline.shift)
            raise InputError(
                f"dataset {self.name!r}: particle {p} at {_triple(self.position[p])} m is outside the box "
                f"{_triple(low)} <= x < {_triple(high)} m in which {spline.name} support stays on the grid "
                f"{self.grid.shape}: move it or enlarge the grid"
            )
        self._check_range(np.dtype(dtype))

    def _check_range(self, dtype: np.dtype) -> None:
        """Raise InputError where ``dtype`` cannot hold a mass, or all mass or momentum if they met at one node."""
        least, most = float(np.finfo(dtype).tiny), float(np.finfo(dtype).max)
        advice = f"rescale the units{' or take dtype=float64' if dtype.itemsize < 8 else ''}"
        if self.particle_count and self.mass.min() < least:
            p = int(np.argmin(self.mass))
            raise InputError(
                f"dataset {self.name!r}: mass of particle {p} is {self.mass[p]:g} kg, "
                f"less than the smallest normal number of {dtype}, {least:.3g}: {advice}"
            )
        with np.errstate(over="ignore", invalid="ignore"):
            # Within a support, a node is at most two spacings away.
            speed = np.abs(self.velocity).max(axis=1) + 2 * self.grid.dx * np.abs(self.affine).sum(axis=2).max(axis=1)
            momentum = np.maximum(self.mass, 1) * speed  # at least the speed: that must fit too
            for amounts, what in ((self.mass, "mass"), (momentum, "momentum")):
                if not amounts.sum() <= most:
                    p = int(np.argmax(amounts))
                    raise InputError(
                        f"dataset {self.name!r}: the {what} of all particles is more than {dtype} can hold, "
                        f"{most:.3g}; most is in particle {p}: {advice}"
                    )


def make_grid(shape: Any, dx: Any, origin: Any, where: str) -> Grid:
    """A checked Grid; ``where`` names the dataset in the error."""
    try:
        nodes = tuple(int(n) for n in shape)
        whole = all(float(n) == m for n, m in zip(shape, nodes, strict=True))
    except (TypeError, ValueError, OverflowError):
        nodes, whole = (), False
    if len(nodes) != 3 or not whole or min(nodes) < 1:
        raise InputError(f"dataset {where!r}: grid shape {_short(shape)} must be three positive whole numbers of nodes")
    if math.prod(nodes) >= INT32_LIMIT:
        raise InputError(
            f"dataset {where!r}: grid shape {nodes} has 2^31 nodes or more, kernels number them in 31 bits"
        )
    try:
        spacing = float(dx)
    except (TypeError, ValueError):
        raise InputError(f"dataset {where!r}: dx is {_short(dx)}; it must be one number [m]") from None
    if not (np.isfinite(spacing) and spacing > 0 and math.isfinite(1 / spacing)):
        raise InputError(f"dataset {where!r}: dx is {spacing:g} m; it must be positive and finite, and so must 1 / dx")
    try:
        corner = tuple(float(c) for c in origin)
    except (TypeError, ValueError):
        corner = ()
    if len(corner) != 3 or not np.isfinite(corner).all():
        raise InputError(f"dataset {where!r}: origin {_short(origin)} must be three finite numbers [m]")
    return Grid((nodes[0], nodes[1], nodes[2]), spacing, (corner[0], corner[1], corner[2]))


@dataclass(frozen=True)
class Recipe:
    """A recipe file of ``datasets/``: its name, one line about it, and its parameters."""

    name: str
    summary: str
    parameters: dict[str, Any] = field(repr=False)


def list_datasets() -> list[Recipe]:
    """Every recipe that ships with mpmbench, by name."""
    return [_read_recipe(path) for path in sorted(DATASETS_FOLDER.glob("*.toml"))]


def load_dataset(
    name_or_path: str | Path,
    particles: int | None = None,
    particles_per_cell: int | None = None,
    seed: int | None = None,
    *,
    grid_shape: Sequence[int] | None = None,
    dx: float | None = None,
    origin: Sequence[float] | None = None,
) -> Dataset:
    """The dataset of a recipe ("uniform_cube"), or of a user's ``.npz`` or ``.npy`` file.

    What is left out takes the recipe's or file's own value; a parameter that the recipe does not have is an InputError.
    """
    given = {
        "particles": particles,
        "particles_per_cell": particles_per_cell,
        "seed": seed,
        "grid_shape": grid_shape,
        "dx": dx,
        "origin": origin,
    }
    given = {key: value for key, value in given.items() if value is not None}
    name = str(name_or_path)
    recipe = next((r for r in list_datasets() if r.name == name), None)
    if recipe is not None:
        parameters = recipe.parameters
        if unknown := given.keys() - parameters.keys():
            raise InputError(f"dataset {name!r} has no parameter {min(unknown)!r}: it has {', '.join(parameters)}")
    elif Path(name).suffix in particle_file.SUFFIXES:
        if unknown := given.keys() & {"seed", "particles_per_cell"}:
            raise InputError(f"file {name!r} has no parameter {min(unknown)!r}: it is data, not a recipe")
        parameters = {"kind": "file", "file": name, "order": "given"}
    else:
        names = ", ".join(r.name for r in list_datasets())
        raise InputError(f"unknown dataset {name!r}: valid are {names}, or a path to a .npz or .npy file")
    parameters = parameters | given
    for key, least in (("particles", 0), ("particles_per_cell", 1), ("seed", 0)):
        value = parameters.get(key, least)
        if not isinstance(value, int | np.integer) or isinstance(value, bool) or value < least:
            raise InputError(f"dataset {name!r}: {key} is {value!r}; it must be a whole number of at least {least}")
    if parameters["kind"] == "file":
        return _from_file(name, parameters)
    need, free = RECIPE_BYTES_PER_PARTICLE * parameters["particles"], machine_bytes()
    if need > free:
        raise InputError(
            f"dataset {name!r}: {parameters['particles']} particles need {need / 2**30:.3g} GiB of memory, "
            f"{free / 2**30:.3g} are free: take fewer"
        )
    return _generate(name, parameters)


def _read_recipe(path: Path) -> Recipe:
    with path.open("rb") as file:
        parameters = tomllib.load(file)
    return Recipe(path.stem, parameters.pop("summary"), parameters)


def _generate(name: str, recipe: dict[str, Any]) -> Dataset:
    """Positions from the recipe's generator; velocity, affine and mass alike for all.

    Velocity is uniform in [-1, 1] m/s (thesis tables 11-16). Affine entries are uniform in [-1, 1] / (4 dx), so that
    over a support they change the velocity by about as much as its size. Masses differ by up to a factor of three,
    about one kilogram in all, so that a mixed-up particle shows.
    """
    grid = make_grid(recipe["grid_shape"], recipe["dx"], recipe["origin"], where=name)
    recipe = recipe | {"grid_shape": list(grid.shape), "dx": grid.dx, "origin": list(grid.origin)}
    uniform = recipes.Uniform(int(recipe["seed"]))
    n = recipe["particles"]
    xi = recipes.GENERATORS[recipe["kind"]](grid, recipe, uniform)
    position = np.array(grid.origin) + grid.dx * xi
    velocity = 2 * uniform("velocity", n, 3) - 1
    affine = (2 * uniform("affine", n, 3, 3) - 1) / (4 * grid.dx)
    mass = (0.5 + uniform("mass", n)) / max(n, 1)
    dataset = Dataset(
        name,
        grid,
        position,
        velocity,
        affine,
        mass,
        order=recipe["order"],
        seed=int(recipe["seed"]),
        recipe=recipe,
    )
    if "moved_steps" not in recipe:
        return dataset
    from mpmbench.motion import after_steps  # which takes and makes datasets

    return replace(after_steps(dataset, recipe["moved_steps"], dataset.seed or 0), order=recipe["order"])


def _from_file(name: str, recipe: dict[str, Any]) -> Dataset:
    """The particles of a file, or as many of them, evenly spaced, as the recipe asks for.

    padding: empty layers of nodes that the recipe adds on every side of the file's grid.
    """
    path = Path(recipe["file"])
    shipped = name != recipe["file"]
    arrays = particle_file.read(DATASETS_FOLDER / path if shipped else path)
    arrays |= {key: recipe[key] for key in ("grid_shape", "dx", "origin") if key in recipe}
    for key, meaning in (("grid_shape", "nodes per axis"), ("dx", "the spacing [m]")):
        if key not in arrays:
            raise InputError(f"file {name!r} has no {key!r}: add {meaning} to the .npz, or give {key}=...")
    shape, dx, origin = np.asarray(arrays.pop("grid_shape")), arrays.pop("dx"), arrays.pop("origin", (0.0, 0.0, 0.0))
    grid = make_grid(np.broadcast_to(shape, 3) if shape.ndim == 0 else shape, dx, origin, where=name)
    padding = recipe.get("padding", 0)
    available = len(arrays["position"]) if np.ndim(arrays["position"]) else 0
    count = recipe.get("particles", available)
    if count > available:
        raise InputError(f"dataset {name!r} has {available} particles, not {count}: ask for at most as many")
    chosen = np.arange(count) * available // max(count, 1)
    whole = Dataset.from_arrays(
        **arrays,
        grid_shape=[n + 2 * padding for n in grid.shape],
        dx=grid.dx,
        origin=[corner - padding * grid.dx for corner in grid.origin],
        name=name if shipped else path.name,
        order=recipe["order"],
    )
    return replace(
        whole,
        position=whole.position[chosen],
        velocity=whole.velocity[chosen],
        affine=whole.affine[chosen],
        mass=whole.mass[chosen],
        recipe=recipe | {"particles": count},
    )


def _array(value: Any, label: str, where: str) -> np.ndarray:
    """A float64 C-ordered copy of what a user gave."""
    try:
        array = np.asarray(value)
    except ValueError:
        raise InputError(f"{where}: {label} has rows of different lengths") from None
    if array.dtype.kind not in "fiu":
        raise InputError(f"{where}: {label} has dtype {array.dtype}, want real numbers")
    return np.array(array, dtype=np.float64, order="C")


def _short(value: Any) -> str:
    """What a user gave, on one line of bounded length."""
    value = value.tolist() if isinstance(value, np.ndarray) and value.size <= 9 else value
    return textwrap.shorten(repr(value), 60, placeholder=" ...")


def _triple(values: Iterable[float]) -> str:
    return "(" + ", ".join(f"{float(value):.9g}" for value in values) + ")"
