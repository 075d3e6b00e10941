"""What strategies of every kind share: one module each that is found, never listed, and axes that users may set.

A package of strategies holds one module per strategy; a module names its strategy in one constant, and the kernel is a
``.cu`` file of the same name. Users add folders of their own.
"""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import pkgutil
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any, Protocol, TypeVar

import numpy as np

from mpmbench.errors import InputError
from mpmbench.kernel import RAW_KERNELS

Axes = Mapping[str, Any]
Values = Mapping[str, tuple[Any, ...]]  # axis -> values it has, the default first

SHARED_LIMIT = 48 * 1024  # bytes of shared memory that a thread block gets without opting in
THREAD_LIMIT = 1024  # threads of a thread block


class Strategy(Protocol):
    """What discovery needs of a strategy."""

    @property
    def name(self) -> str: ...

    @property
    def axes(self) -> Values: ...

    @property
    def requires(self) -> Callable[[Axes], str | None]: ...

    @property
    def path(self) -> Path | None: ...


Found = TypeVar("Found", bound=Strategy)


def always_possible(axes: Axes) -> str | None:
    return None


# --- modules ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Shelf:
    """Where strategies of one kind are found.

    noun: in messages.  package: whose modules hold them.  constant: its name in a module.  kind: its class.
    inspect: (strategy) -> what is wrong with it, or None.
    """

    noun: str
    package: str
    constant: str
    kind: type
    inspect: Callable[[Any], str | None]

    def discover(self, extra_dirs: Sequence[str | Path] = ()) -> dict[str, Any]:
        """Every shipped strategy and those of the folders given, by name. InputError for a module that has none.

        A folder may hold strategies of several kinds: modules with another kind's constant are passed over.
        """
        found = {strategy.name: strategy for strategy in self._shipped()}
        folders = [extra_dirs] if isinstance(extra_dirs, str | Path) else extra_dirs  # one folder may come alone
        for folder in map(Path, folders):
            for path, module in _modules_of(folder):
                if not hasattr(module, self.constant) and any(hasattr(module, other) for other in CONSTANTS):
                    continue
                strategy = self._strategy_of(module, path)
                other = found.get(strategy.name)
                if other is not None and other.path != strategy.path:
                    raise InputError(f"{path}: {self.noun} name {strategy.name!r} is taken by {other.path}")
                found[strategy.name] = strategy
        return {name: found[name] for name in sorted(found)}

    def get(self, name: str, extra_dirs: Sequence[str | Path] = ()) -> Any:
        """The strategy of that name, or InputError naming all."""
        found = self.discover(extra_dirs)
        if name not in found:
            raise InputError(f"unknown {self.noun} {name!r}: valid are {', '.join(found)}")
        return found[name]

    def _shipped(self) -> tuple[Any, ...]:
        if self.package not in _SHIPPED:
            folder = Path(str(importlib.import_module(self.package).__file__)).parent
            stems = sorted(info.name for info in pkgutil.iter_modules([str(folder)]) if info.name[0] != "_")
            _SHIPPED[self.package] = tuple(
                self._strategy_of(importlib.import_module(f"{self.package}.{stem}"), folder / f"{stem}.py")
                for stem in stems
            )
        return _SHIPPED[self.package]

    def _strategy_of(self, module: ModuleType, path: Path) -> Any:
        strategy = getattr(module, self.constant, None)
        if not isinstance(strategy, self.kind):
            raise InputError(f"{path} has no {self.constant} = {self.kind.__name__}(...)")
        strategy = replace(strategy, path=path.resolve())  # type: ignore[type-var]
        if problem := self.inspect(strategy):
            raise InputError(f"{path}: {problem}")
        if not inspect.getdoc(module):
            raise InputError(f"{path} has no docstring: say what the idea is, when it wins and when it loses")
        return strategy


CONSTANTS = ("VARIANT", "PRIMITIVE")
_SHIPPED: dict[str, tuple[Any, ...]] = {}


def kernel_path(stem: str, module: Path | None) -> Path:
    """The ``.cu`` file of a strategy: shipped kernels have a folder of their own, a user's lies beside the module."""
    shipped = module is None or module.parent.parent == Path(__file__).resolve().parent
    return (RAW_KERNELS if shipped else module.parent) / f"{stem}.cu"  # type: ignore[union-attr]


def _modules_of(folder: Path) -> list[tuple[Path, ModuleType]]:
    if not folder.is_dir():
        raise InputError(f"variant folder {folder} does not exist")
    paths = [path for path in sorted(folder.glob("*.py")) if not path.name.startswith("_")]
    if not paths:
        raise InputError(f"variant folder {folder} has no Python module")
    return [(path, _load_file(path)) for path in paths]


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
    except (Exception, SystemExit) as error:
        raise InputError(f"cannot load variant module {path}: {type(error).__name__}: {error}") from error
    finally:
        sys.dont_write_bytecode = write
    return module


# --- axes -------------------------------------------------------------------------------------------------------------


def resolve(strategy: Strategy, given: Axes, known: Values) -> dict[str, Any]:
    """All axes of a strategy: those given, the strategy's defaults for the rest.

    known: axis -> every value that any strategy of this kind may have. Values may be written as on the command line
    (``"4"``, ``"8x4x4"``). Raises InputError for an axis that the strategy does not have and for a value that the
    axis does not have; a value that only this strategy cannot take is a matter of ``impossible``.
    """
    for name in given:
        if name not in strategy.axes:
            raise InputError(f"{strategy.name} has no axis {name!r}: valid are {', '.join(strategy.axes)}")
    return {
        name: axis_value(name, given[name], known) if name in given else values[0]
        for name, values in strategy.axes.items()
    }


def impossible(strategy: Strategy, axes: Axes, known: Values) -> str | None:
    """Why a combination cannot exist, in one line; None where it can."""
    try:
        axes = resolve(strategy, axes, known)
    except InputError as error:
        return str(error)
    for name, value in axes.items():
        allowed = strategy.axes[name]
        if name != "block_shape" and value not in allowed:
            return f"{name}={value} does not exist for {strategy.name}: valid are {', '.join(map(str, allowed))}"
    return strategy.requires(axes)


def axis_value(name: str, value: Any, known: Values) -> Any:
    """The value of an axis as its strategies know it. An axis that nobody knows is a user's own: as it is."""
    if name == "block_shape":
        return block_shape(value)
    if name not in known:
        return value
    text = np.dtype(value).name if name == "dtype" and not isinstance(value, str) else str(value)
    for one in known[name]:
        if str(one) == text:
            return one
    raise InputError(f"axis {name} has no value {value!r}: valid are {', '.join(map(str, known[name]))}")


def block_shape(value: Any) -> tuple[int, int, int]:
    """Three positive whole numbers of cells, from ``8x4x4`` or a sequence."""
    parts = re.split(r"[x,]", value.strip("() ")) if isinstance(value, str) else value
    try:
        shape = tuple(int(part) for part in parts)
        whole = all(float(part) == edge for part, edge in zip(parts, shape, strict=True))
    except (TypeError, ValueError):
        shape, whole = (), False
    if len(shape) != 3 or not whole or min(shape) < 1:
        raise InputError(f"block_shape {value!r} must be three positive whole numbers of cells, such as 8x4x4")
    return (shape[0], shape[1], shape[2])
