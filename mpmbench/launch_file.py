"""``launch.toml``: arrays and launches of a user's own kernel, read and checked. docs/sanitizer.md is its reference."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mpmbench.discovery import THREAD_LIMIT
from mpmbench.environment import machine_bytes
from mpmbench.errors import InputError

DTYPES = (
    "bool", "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64", "float32", "float64",
)  # fmt: skip
FILLS = ("random", "arange", "uninitialised")
COMPARES = ("auto", "exact", "none")
RANDOM_BELOW = 128  # of integers

_GRID_LIMITS = (2**31 - 1, 65535, 65535)
_BLOCK_LIMITS = (THREAD_LIMIT, THREAD_LIMIT, 64)


@dataclass(frozen=True)
class ArraySpec:
    """An array that lives through all launches.

    fill: a number, or one of FILLS. content: read from a file. compare: how results of two schedules are compared:
    "auto" allows for rounding where the kernels add floats atomically.
    """

    name: str
    shape: tuple[int, ...]
    dtype: np.dtype
    fill: float | int | str = 0
    content: np.ndarray | None = field(default=None, repr=False, compare=False)
    compare: str = "auto"

    def values(self, seed: int = 0) -> np.ndarray | None:
        """What the array holds before the first launch; None for "uninitialised"."""
        if self.content is not None:
            return self.content
        if self.fill == "uninitialised":
            return None
        if self.fill == "arange":
            return np.arange(np.prod(self.shape)).astype(self.dtype).reshape(self.shape)
        if self.fill == "random":
            generator = np.random.default_rng([seed, *self.name.encode()])
            if self.dtype.kind == "f":
                return generator.random(self.shape, self.dtype)
            return generator.integers(0, 2 if self.dtype.kind == "b" else RANDOM_BELOW, self.shape).astype(self.dtype)
        return np.full(self.shape, self.fill, self.dtype)


@dataclass(frozen=True)
class LaunchSpec:
    """One launch. args: names of arrays, or NumPy scalars. shared: dynamic shared memory per thread block [bytes]."""

    kernel: str
    grid: tuple[int, int, int]
    block: tuple[int, int, int]
    args: tuple[str | np.generic, ...]
    shared: int = 0


@dataclass(frozen=True)
class LaunchFile:
    """arch: None for the command line's. defines: macros. budget: warp instructions that loops may repeat, or None."""

    arrays: Mapping[str, ArraySpec]
    launches: tuple[LaunchSpec, ...]
    arch: str | None = None
    defines: Mapping[str, Any] = field(default_factory=dict)
    include: tuple[Path, ...] = ()
    budget: int | None = None


def read_launch_file(path: Path) -> LaunchFile:
    """Read and check; the first problem is an InputError of one line that names file and key."""
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as problem:
        raise InputError(f"cannot read {path}: {(problem.strerror or str(problem)).lower()}") from problem
    except UnicodeDecodeError as problem:
        raise InputError(f"cannot read {path}: {problem}") from problem
    except tomllib.TOMLDecodeError as problem:
        raise InputError(f"{path}: not valid TOML: {problem}") from problem
    top = _Table(document, str(path), path.parent)
    top.allow("arch", "budget", "defines", "include", "arrays", "launch")
    arrays = {name: _array(top.sub("arrays").sub(name), name) for name in top.get("arrays", dict, {})}
    need = sum(int(np.prod(a.shape, dtype=object)) * a.dtype.itemsize for a in arrays.values())
    if need > (here := machine_bytes()):
        raise InputError(f"{path}: arrays need {need / 2**30:.2f} GiB of memory, {here / 2**30:.2f} are free")
    listed = document.get("launch")
    tables = listed if isinstance(listed, list) else [listed]
    if not listed or not all(isinstance(entry, dict) for entry in tables):
        raise InputError(f"{path}: no launch: add a [[launch]] table with kernel, grid, block and args")
    launches = []
    for number, entry in enumerate(tables, start=1):
        where = f"{path}: launch" if len(tables) == 1 else f"{path}: launch {number}"
        launches.append(_launch(_Table(entry, where, path.parent), arrays))
    include = top.get("include", list, [])
    if not all(isinstance(folder, str) for folder in include):
        raise InputError(f"{path}: include must be a list of folders")
    return LaunchFile(
        arrays,
        tuple(launches),
        top.get("arch", str, None),
        top.get("defines", dict, {}),
        tuple(path.parent / folder for folder in include),
        top.count("budget", None, least=1),
    )


_KIND_NAMES = {"str": "text", "list": "list", "dict": "table"}


class _Table:
    """A TOML table that knows where it stands."""

    def __init__(self, content: dict[str, Any], where: str, folder: Path) -> None:
        self.content, self.where, self.folder = content, where, folder

    def allow(self, *keys: str) -> None:
        if unknown := [key for key in self.content if key not in keys]:
            raise InputError(f"{self.where}: unknown key {unknown[0]!r}: valid are {', '.join(keys)}")

    def get(self, key: str, kind: type, default: Any = ...) -> Any:
        value = self.content.get(key, default)
        if value is ...:
            raise InputError(f"{self.where}: {key} is missing")
        if key in self.content and not isinstance(value, kind):
            raise InputError(f"{self.where}: {key} must be a {_KIND_NAMES[kind.__name__]}, not {value!r}")
        return value

    def sub(self, key: str) -> _Table:
        return _Table(self.get(key, dict), f"{self.where}: {key}", self.folder)

    def one_of(self, key: str, choices: tuple[str, ...], default: Any = ...) -> str:
        value = self.get(key, str, default)
        if value not in choices:
            raise InputError(f"{self.where}: {key} {value!r} is unknown: valid are {', '.join(choices)}")
        return value

    def count(self, key: str, default: Any, least: int = 0) -> Any:
        value = self.content.get(key, default)
        if key in self.content and (not _is_whole(value) or value < least):
            raise InputError(f"{self.where}: {key} must be a whole number of at least {least}, not {value!r}")
        return value

    def sizes(self, key: str, limits: tuple[int, ...]) -> tuple[int, ...]:
        """One to ``len(limits)`` positive whole numbers."""
        value = self.content.get(key, ...)
        if value is ...:
            raise InputError(f"{self.where}: {key} is missing")
        listed = value if isinstance(value, list) else [value]
        if not 1 <= len(listed) <= len(limits) or not all(_is_whole(size) and size >= 1 for size in listed):
            raise InputError(
                f"{self.where}: {key} must be one to {len(limits)} whole numbers of at least 1, not {value!r}"
            )
        for size, limit in zip(listed, limits, strict=False):
            if size > limit:
                raise InputError(f"{self.where}: {key} {value!r} is too large: at most {limit} there")
        return tuple(listed)


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _array(table: _Table, name: str) -> ArraySpec:
    table.allow("shape", "dtype", "fill", "file", "compare")
    compare = table.one_of("compare", COMPARES, "auto")
    if "file" in table.content:
        table.allow("file", "compare")
        content = _load(table, table.folder / table.get("file", str))
        return ArraySpec(name, content.shape, content.dtype, content=content, compare=compare)
    shape = table.sizes("shape", (2**40,) * 8)
    dtype = np.dtype(table.one_of("dtype", DTYPES))
    fill = table.content.get("fill", 0)
    if isinstance(fill, str):
        table.one_of("fill", FILLS)
    else:
        _scalar(table, "fill", fill, dtype)
    return ArraySpec(name, shape, dtype, fill, compare=compare)


def _load(table: _Table, path: Path) -> np.ndarray:
    try:
        content = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as problem:
        reason = getattr(problem, "strerror", None) or str(problem)
        raise InputError(f"{table.where}: cannot read {path}: {reason}") from problem
    if not isinstance(content, np.ndarray) or content.dtype.name not in DTYPES or content.size == 0:
        raise InputError(f"{table.where}: {path} must hold one array that is not empty, of {', '.join(DTYPES)}")
    return np.ascontiguousarray(content.reshape(content.shape or (1,)))


def _scalar(table: _Table, key: str, value: Any, dtype: np.dtype) -> np.generic:
    """A number as this type holds it; a fraction or a number out of range is refused."""
    if not isinstance(value, int | float | bool):
        raise InputError(f"{table.where}: {key} must be a number, not {value!r}")
    if dtype.kind in "iu" and isinstance(value, int):
        limits = np.iinfo(dtype)
        if not limits.min <= value <= limits.max:
            raise InputError(f"{table.where}: {key} {value} does not fit {dtype}")
    elif dtype.kind in "iu" or (dtype.kind == "b" and value not in (0, 1)):
        raise InputError(f"{table.where}: {key} {value!r} is no {dtype}")
    return dtype.type(value)


def _launch(table: _Table, arrays: Mapping[str, ArraySpec]) -> LaunchSpec:
    table.allow("kernel", "grid", "block", "shared", "args")
    args: list[str | np.generic] = []
    for position, entry in enumerate(table.get("args", list, [])):
        where = f"{table.where}: argument {position}"
        if isinstance(entry, str):
            if entry not in arrays:
                known = ", ".join(arrays) or "none"
                raise InputError(f"{where}: unknown array {entry!r}: [arrays] has {known}")
            args.append(entry)
        elif isinstance(entry, dict):
            scalar = _Table(entry, where, table.folder)
            scalar.allow("dtype", "value")
            if "value" not in entry:
                raise InputError(f"{where}: value is missing")
            args.append(_scalar(scalar, "value", entry["value"], np.dtype(scalar.one_of("dtype", DTYPES))))
        else:
            raise InputError(f"{where}: {entry!r} is neither the name of an array nor {{ dtype = ..., value = ... }}")
    block = table.sizes("block", _BLOCK_LIMITS)
    if (threads := int(np.prod(block))) > THREAD_LIMIT:
        raise InputError(f"{table.where}: block has {threads} threads, a thread block has at most {THREAD_LIMIT}")
    grid = table.sizes("grid", _GRID_LIMITS)
    return LaunchSpec(table.get("kernel", str), _three(grid), _three(block), tuple(args), table.count("shared", 0))


def _three(sizes: tuple[int, ...]) -> tuple[int, int, int]:
    x, y, z, *_ = (*sizes, 1, 1)
    return x, y, z
