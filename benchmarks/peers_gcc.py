"""g++ -O3 -march=native of the plain loop in transfer.cpp: what a compiled language gives without any tricks."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from mpmbench.grid import Grid
from mpmbench.peers import Library, PeerMissing

FLAGS = ("-O3", "-march=native")
SOURCE = Path(__file__).with_name("transfer.cpp")


class _Domain(ctypes.Structure):
    _fields_ = (
        ("nx", ctypes.c_int), ("ny", ctypes.c_int),
        ("ox", ctypes.c_float), ("oy", ctypes.c_float), ("oz", ctypes.c_float), ("inv_dx", ctypes.c_float),
    )  # fmt: skip


class Transfers:
    """Compiles once; PeerMissing where there is no g++ or it fails."""

    facts: ClassVar[Mapping[str, Any]] = {"fast_math": False, "threads": 1}

    def __init__(self) -> None:
        compiler = shutil.which("g++")
        if compiler is None:
            raise PeerMissing("no g++ on PATH")
        version = subprocess.run([compiler, "-dumpfullversion"], capture_output=True, text=True)
        self.version = f"{version.stdout.strip()} {' '.join(FLAGS)}"
        with tempfile.TemporaryDirectory(prefix="mpmbench-") as folder:
            library = Path(folder) / "transfer.so"
            build = subprocess.run(
                [compiler, *FLAGS, "-shared", "-fPIC", "-o", str(library), str(SOURCE)], capture_output=True, text=True
            )
            if build.returncode:
                message = (build.stderr.strip().splitlines() or ["no message"])[0]
                raise PeerMissing(f"g++ refused transfer.cpp: {message}")
            # The loader keeps the mapping, so the file may go.
            self._library = ctypes.CDLL(str(library))

    def _launcher(self, function: str, grid: Grid, count: int, *arrays: np.ndarray) -> Callable[[], object]:
        domain = _Domain(grid.shape[0], grid.shape[1], *grid.origin, 1 / grid.dx)
        pointers = [ctypes.c_void_p(array.ctypes.data) for array in arrays]
        call = getattr(self._library, function)
        call.restype = None

        def launch(_keep_alive: tuple[np.ndarray, ...] = arrays) -> None:
            # A ctypes pointer does not hold its array.
            call(domain, ctypes.c_int(count), *pointers)

        return launch

    def p2g(self, grid: Grid, count: int, particles: np.ndarray, nodes: np.ndarray) -> Callable[[], object]:
        return self._launcher("p2g", grid, count, particles, nodes)

    def g2p(
        self, grid: Grid, count: int, particles: np.ndarray, velocities: np.ndarray, results: np.ndarray
    ) -> Callable[[], object]:
        return self._launcher("g2p", grid, count, particles, velocities, results)


LIBRARY = Library("gcc", "g++", "", Transfers, SOURCE)
