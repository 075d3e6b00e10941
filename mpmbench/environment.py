"""Where a number comes from: versions, machine, commit, command line. Every record carries one."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

# The distribution is named after the CUDA major version; the first one installed is the compiler in use.
NVRTC_DISTRIBUTIONS = ("nvidia-cuda-nvrtc-cu12", "nvidia-cuda-nvrtc")


@dataclass(frozen=True)
class Environment:
    """What could change a result. ``None`` means: not present here."""

    mpmbench: str
    git_commit: str | None  # of the checkout that the package was imported from
    git_dirty: bool | None  # with changes not committed
    python: str
    numpy: str | None
    numba: str | None
    llvmlite: str | None
    nvrtc: str | None
    cpu: str
    cores: int
    os: str
    date: str  # UTC, ISO 8601, to the second
    argv: tuple[str, ...]
    seed: int | None = None
    gpu: Mapping[str, Any] = field(default_factory=dict)  # name, driver, clocks, ...; empty without a GPU

    @classmethod
    def capture(
        cls,
        argv: Sequence[str] | None = None,
        seed: int | None = None,
        gpu: Mapping[str, Any] | None = None,
    ) -> Environment:
        """Describe this process. ``gpu`` holds what the CUDA device knows about itself."""
        words = list(sys.argv if argv is None else argv)
        if words:  # where the program lies says nothing about the result
            words[0] = Path(words[0]).name
        commit, dirty = _git_state(Path(__file__).resolve().parent.parent)
        return cls(
            mpmbench=_version("mpmbench") or "unknown",
            git_commit=commit,
            git_dirty=dirty,
            python=platform.python_version(),
            numpy=_version("numpy"),
            numba=_version("numba"),
            llvmlite=_version("llvmlite"),
            nvrtc=next((v for v in map(_version, NVRTC_DISTRIBUTIONS) if v), None),
            cpu=_cpu_model(),
            cores=_usable_cores(),
            os=platform.platform(terse=True),
            date=datetime.now(UTC).isoformat(timespec="seconds"),
            argv=tuple(words),
            seed=seed,
            gpu=dict(gpu or {}),
        )


@cache
def _version(distribution: str) -> str | None:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return None


@cache
def _git_state(root: Path) -> tuple[str | None, bool | None]:
    """Commit and whether files differ from it; (None, None) where ``root`` is no checkout of its own.

    Asked once per process: a run belongs to the code it imported, not to edits made while it goes on.
    """
    if not (root / ".git").exists():
        return None, None
    try:
        commit = _git(root, "rev-parse", "HEAD")
        dirty = bool(_git(root, "status", "--porcelain", "--untracked-files=no"))
    except (OSError, subprocess.SubprocessError):
        return None, None
    return commit, dirty


def _git(root: Path, *words: str) -> str:
    # Plumbing locks off: a status must not disturb another git process in the same checkout.
    run = subprocess.run(
        ["git", "--no-optional-locks", "-C", str(root), *words],
        capture_output=True, text=True, timeout=20, check=True,
    )  # fmt: skip
    return run.stdout.strip()


@cache
def _cpu_model() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text(errors="replace").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def _usable_cores() -> int:
    """Cores this process may run on; a container often grants fewer than the machine has."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:
        return os.cpu_count() or 1


def machine_bytes() -> int:
    """Memory of this machine that is free to take [bytes]."""
    with open("/proc/meminfo") as file:
        return 1024 * next(int(line.split()[1]) for line in file if line.startswith("MemAvailable"))
