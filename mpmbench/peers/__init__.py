"""Other people's CPU code that runs the same transfers, timed in the rounds of ours on the ``cpu`` device.

Each module of this package holds one ``LIBRARY``; a ``Peer`` is one transfer of one library, named
``peer_<library>_<transfer>``. Importing this package imports no library: ``open_library`` does.
"""

from __future__ import annotations

import ctypes
import importlib
import os
import pkgutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from ctypes.util import find_library
from dataclasses import dataclass, field
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from mpmbench import discovery, variants
from mpmbench.errors import InputError
from mpmbench.grid import Grid

INSTALL = "pip install 'mpmbench[peers]'"

# What the peers are written for. The first value is the default, as for variants.
AXES: dict[str, tuple[Any, ...]] = {
    "dtype": ("float32",),
    "spline": ("cubic",),
    "payload": ("pic",),
    "particle_order": ("given", "deep"),
}


class PeerMissing(InputError):
    """A library cannot run here; the message says why and what to do."""


class Transfers(Protocol):
    """A library's transfers, compiled for this processor.

    version: of the library.  facts: how it compiles, for the record.  Both methods return a call that runs the transfer
    on these arrays, as often as it is called, and keeps them alive: particles (2n, 4), position [m] and mass [kg] of
    all n, then velocity [m/s] and 0; nodes and velocities (nodes, 4), x fastest, momentum and mass, or velocity;
    results (n, 4), velocity and 0. All are float32. P2G adds to ``nodes``; G2P overwrites ``results``.
    """

    version: str
    facts: Mapping[str, Any]

    def p2g(self, grid: Grid, count: int, particles: np.ndarray, nodes: np.ndarray) -> Callable[[], object]: ...

    def g2p(
        self, grid: Grid, count: int, particles: np.ndarray, velocities: np.ndarray, results: np.ndarray
    ) -> Callable[[], object]: ...


@dataclass(frozen=True)
class Library:
    """name: in the names of its peers.  title: as people write it.  distribution: on PyPI, "" for none.
    open: starts the library and compiles; raises PeerMissing where that cannot be.  path: text of its transfers."""

    name: str
    title: str
    distribution: str
    open: Callable[[], Transfers] = field(repr=False)
    path: Path

    @property
    def installed(self) -> bool:
        """Whether it is there, without importing it."""
        if not self.distribution:
            return True
        try:
            metadata.version(self.distribution)
        except metadata.PackageNotFoundError:
            return False
        return True


@dataclass(frozen=True)
class Peer:
    """One transfer ("p2g" or "g2p") of a library. It has what ``discovery`` needs of a strategy."""

    library: Library
    transfer: str

    @property
    def name(self) -> str:
        return f"peer_{self.library.name}_{self.transfer}"

    @property
    def summary(self) -> str:
        return f"{self.transfer.upper()} of {self.library.title} on one CPU thread"

    @property
    def listed(self) -> str:
        """The summary, and whether anything is missing for it."""
        return self.summary + ("" if self.library.installed else " (not installed: extra peers)")

    @property
    def axes(self) -> Mapping[str, tuple[Any, ...]]:
        return AXES

    @property
    def requires(self) -> Callable[[Mapping[str, Any]], str | None]:
        return discovery.always_possible

    @property
    def path(self) -> Path:
        return self.library.path


@cache
def open_library(library: Library) -> Transfers:
    """The library's transfers, opened once per process. PeerMissing where it is not there or does not start."""
    if not library.installed:
        raise PeerMissing(f"{library.title} is not installed: {INSTALL}")
    try:
        with _silenced(), _same_arithmetic():
            return library.open()
    except PeerMissing:
        raise
    except Exception as error:  # a broken installation of somebody else's library is a row with a reason
        text = " ".join(str(error).split())[:200]
        raise PeerMissing(f"{library.title} does not start ({type(error).__name__}: {text}): {INSTALL}") from error


@contextmanager
def _silenced() -> Iterator[None]:
    """Libraries greet on standard output, and one warns from C++ that there is no GPU: our output is for rows."""
    kept = os.dup(2)
    with open(os.devnull, "w") as nowhere, redirect_stdout(nowhere):
        os.dup2(nowhere.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)


@contextmanager
def _same_arithmetic() -> Iterator[None]:
    """Taichi leaves the thread that starts it flushing denormals to zero: whatever runs next would round otherwise."""
    libm = ctypes.CDLL(find_library("m"))
    kept = ctypes.create_string_buffer(64)  # fenv_t, with room to spare
    libm.fegetenv(kept)
    try:
        yield
    finally:
        libm.fesetenv(kept)


def discover() -> tuple[Peer, ...]:
    """Every shipped peer, by name."""
    names = sorted(module.name for module in pkgutil.iter_modules(__path__))
    libraries = [importlib.import_module(f"{__name__}.{name}").LIBRARY for name in names]
    return tuple(Peer(library, transfer) for library in libraries for transfer in ("p2g", "g2p"))


def by_default(devices: Sequence[str]) -> tuple[Peer, ...]:
    """The peers that a run takes without being asked: those that are installed, where ``cpu`` is the only device."""
    if set(devices) != {"cpu"}:
        return ()
    return tuple(peer for peer in discover() if peer.library.installed)


def resolve_axes(peer: Peer, given: Mapping[str, Any]) -> dict[str, Any]:
    """All axes of a peer: those given, the defaults for the rest (``discovery.resolve``)."""
    return discovery.resolve(peer, given, variants.AXES)


def why_impossible(peer: Peer, axes: Mapping[str, Any]) -> str | None:
    """Why a combination cannot exist, in one line; None where it can."""
    return discovery.impossible(peer, axes, variants.AXES)
