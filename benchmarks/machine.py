"""The machine a CPU timing belongs to, and whether it was busy with something else."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from mpmbench.environment import Environment

# What decides how wide and how fast vector code can be; the full flag list says no more to a reader.
VECTOR_FEATURES = ("sse4_2", "avx", "avx2", "fma", "avx512f", "avx512bw", "avx512vl", "avx512dq", "asimd", "sve")


def describe(core: int) -> dict[str, Any]:
    """CPU model, features, caches, memory page policy, versions, and the load before anything was run."""
    environment = Environment.capture()
    cpu = _cpuinfo()
    # Virtual machines like to hide the model's name; family and model number still tell it.
    identity = f"{environment.cpu} (family {cpu.get('cpu family', '?')}, model {cpu.get('model', '?')})"
    flags = set(cpu.get("flags", cpu.get("Features", "")).split())
    return {
        "cpu": identity,
        "vector_features": [f for f in VECTOR_FEATURES if f in flags],
        "caches": _caches(core),
        "cores": os.cpu_count(),
        "pinned_core": core,
        "huge_pages": _read("/sys/kernel/mm/transparent_hugepage/enabled"),
        "load_average_before": round(os.getloadavg()[0], 2),
        "os": environment.os,
        "date": environment.date,
        "git_commit": environment.git_commit,
        "git_dirty": environment.git_dirty,
        "python": environment.python,
        "numpy": environment.numpy,
        "numba": environment.numba,
        "llvmlite": environment.llvmlite,
        "nvrtc": environment.nvrtc,
    }


def load_warning(load: float) -> str | None:
    """A line to print when other work ran before the measurement began, else None."""
    if load < 0.5:
        return None
    return (
        f"load average was {load:.2f} before the first sample: other work shares this machine, "
        "so times are high and intervals wide; ratios suffer less. Repeat on an idle machine."
    )


def markdown(machine: dict[str, Any]) -> str:
    """One paragraph for a report."""
    caches = ", ".join(machine["caches"]) or "unknown"
    return (
        f"Machine: {machine['cpu']}, {machine['cores']} cores, pinned to one; {' '.join(machine['vector_features'])}; "
        f"caches {caches}; huge pages {machine['huge_pages'] or 'unknown'}; {machine['os']}. "
        f"Python {machine['python']}, NumPy {machine['numpy']}, numba {machine['numba']}, "
        f"llvmlite {machine['llvmlite']}, NVRTC {machine['nvrtc']}. {machine['date']}."
    )


def _cpuinfo() -> dict[str, str]:
    """The first processor's block of /proc/cpuinfo."""
    block = _read("/proc/cpuinfo").split("\n\n")[0]
    pairs = (line.split(":", 1) for line in block.splitlines() if ":" in line)
    return {key.strip(): value.strip() for key, value in pairs}


def _caches(core: int) -> list[str]:
    found = []
    for index in sorted(Path(f"/sys/devices/system/cpu/cpu{core}/cache").glob("index*")):
        kind = _read(index / "type")
        if kind != "Instruction":
            found.append(f"L{_read(index / 'level')} {_read(index / 'size')}")
    return found


def _read(path: str | Path) -> str:
    try:
        return Path(path).read_text(errors="replace").strip()
    except OSError:
        return ""
