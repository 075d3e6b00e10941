"""What this machine has, what it lacks and what to do about it. Looking never fails and changes nothing."""

from __future__ import annotations

import importlib
import os
import platform
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import metadata
from typing import Any, Literal

from mpmbench.errors import MpmbenchError

Status = Literal["ok", "warn", "missing"]

GIB = 2**30
WANTED_DISK = GIB  # caches and records of a full run
WANTED_MEMORY = 8 * GIB  # the thesis preset at full size
OLDEST_ARCH = "sm_52"  # of the thesis, GTX 970
LOCKABLE_ARCH = (7, 0)  # nvmlDeviceSetGpuLockedClocks: Volta and later
CUPY = ("cupy-cuda12x", "cupy-cuda13x")
INSTALL_CUPY = "pip install 'mpmbench[cuda12x]' (CUDA 12 driver) or 'mpmbench[cuda13x]' (CUDA 13 driver)"
NO_GPU = "none needed for counters and checks; times need a machine with an NVIDIA GPU"


@dataclass(frozen=True)
class Check:
    """One thing looked at. remedy: what to do, one line; "" where nothing is to be done."""

    name: str
    status: Status
    detail: str
    remedy: str = ""


def diagnose() -> list[Check]:
    """Look at everything that a run may need, the simulated device first, then the GPU."""
    checks: list[Check] = []
    for name, look in LOOKS:
        try:
            checks += look()
        except MpmbenchError as error:
            checks.append(Check(name, "missing", _one_line(error), "see the message"))
        except Exception as error:  # a doctor that dies of a finding helps nobody
            checks.append(
                Check(name, "warn", f"cannot be looked at: {type(error).__name__}: {_one_line(error)}", "report this")
            )
    return checks


# The simulated device


def python() -> list[Check]:
    version, machine = platform.python_version(), f"{platform.system()} {platform.machine()}"
    detail = f"{platform.python_implementation()} {version} on {machine}"
    if not detail.startswith("CPython") or machine != "Linux x86_64":
        return [Check("Python", "warn", detail, "tested with CPython on Linux x86-64 only: expect surprises elsewhere")]
    return [Check("Python", "ok", detail)]


def packages() -> list[Check]:
    """The installed versions of what the engine is built on, against the versions it is tested with."""
    pins = required_versions()
    checks = []
    for name in ("numpy", "numba", "llvmlite"):
        wanted = pins.get(name, "")
        cure = f"pip install '{name}{wanted}'"
        try:
            version = metadata.version(name)
        except metadata.PackageNotFoundError:
            checks.append(Check(name, "missing", f"not installed, wanted {wanted or 'any'}", cure))
            continue
        if satisfies(version, wanted):
            checks.append(Check(name, "ok", f"{version} (tested with {wanted or 'any'})"))
        else:
            checks.append(Check(name, "warn", f"{version}, tested with {wanted}", cure))
    return checks


def nvrtc() -> list[Check]:
    from mpmbench.simt.nvrtc import nvrtc_version, supported_archs

    cure = "pip install 'nvidia-cuda-nvrtc-cu12==12.9.*'"
    try:
        version, archs = nvrtc_version(), supported_archs()
    except MpmbenchError as error:
        return [Check("NVRTC", "missing", _one_line(error), cure)]
    detail = f"{version}, compiles for {archs[0]} to {archs[-1]}"
    if OLDEST_ARCH not in archs:
        return [Check("NVRTC", "warn", f"{detail}: not for {OLDEST_ARCH}, the GPU of the thesis", cure)]
    return [Check("NVRTC", "ok", detail)]


def ptxas() -> list[Check]:
    from mpmbench.device.ptxas import CURE, find_ptxas, ptxas_version

    try:
        find_ptxas()
        return [Check("ptxas", "ok", ptxas_version())]
    except MpmbenchError:
        return [Check("ptxas", "missing", "not found: no register and spill counts", CURE)]


def cpu() -> list[Check]:
    import llvmlite.binding as llvm

    features = llvm.get_host_cpu_features()
    detail = f"{llvm.get_host_cpu_name()}, {len(os.sched_getaffinity(0))} cores"
    if features.get("avx512f"):
        return [Check("CPU", "ok", f"{detail}, AVX-512")]
    if features.get("avx2"):
        return [Check("CPU", "ok", f"{detail}, AVX2: about half the speed of AVX-512")]
    return [Check("CPU", "warn", f"{detail}, neither AVX-512 nor AVX2", "expect long runs, or use another machine")]


def memory() -> list[Check]:
    with open("/proc/meminfo") as file:
        free = 1024 * next(int(line.split()[1]) for line in file if line.startswith("MemAvailable"))
    detail = f"{free / GIB:.1f} GiB free"
    if free < WANTED_MEMORY:
        cure = "fine for quick runs; free some memory before `--preset thesis`"
        return [Check("memory", "warn", f"{detail}, the thesis preset wants {WANTED_MEMORY // GIB}", cure)]
    return [Check("memory", "ok", detail)]


def cache_and_disk() -> list[Check]:
    from mpmbench.simt.cache import cache_folder

    folder = cache_folder()
    cure = "set MPMBENCH_CACHE_DIR to a folder that you can write"
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    free = shutil.disk_usage(existing).free
    disk = Check("disk", "ok", f"{free / GIB:.1f} GiB free")
    if free < WANTED_DISK:
        disk = Check("disk", "warn", f"{disk.detail} for the kernel cache", f"free 1 GiB, or {cure}")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        detail = f"{folder} cannot be written ({error.strerror}): every run compiles anew"
        return [Check("kernel cache", "warn", detail, cure), disk]
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    return [Check("kernel cache", "ok", f"{folder}, {size / 2**20:.0f} MiB"), disk]


# The GPU


def cupy() -> list[Check]:
    found = [f"{name} {metadata.version(name)}" for name in CUPY if _installed(name)]
    if not found:
        return [Check("CuPy", "missing", "not installed: no device 'cuda'", INSTALL_CUPY)]
    if len(found) > 1:
        return [Check("CuPy", "warn", " and ".join(found), f"keep one of them: pip uninstall {CUPY[0]}")]
    try:
        importlib.import_module("cupy")
    except Exception as error:
        return [Check("CuPy", "warn", f"{found[0]} does not import: {_one_line(error)}", INSTALL_CUPY)]
    name, version = found[0].split()
    wanted = required_versions().get(name, "")
    if not satisfies(version, wanted):
        return [Check("CuPy", "warn", f"{found[0]}, tested with {wanted}", f"pip install '{name}{wanted}'")]
    return [Check("CuPy", "ok", found[0])]


def headers() -> list[Check]:
    """CuPy compiles nothing without the CUDA runtime's headers, and its wheel does not bring them."""
    if not any(map(_installed, CUPY)):
        return []
    pathfinder = importlib.import_module("cuda.pathfinder")
    folder = pathfinder.find_nvidia_header_directory("cudart")
    if folder is None:
        return [Check("CUDA headers", "missing", "CuPy cannot compile kernels without them", INSTALL_CUPY)]
    return [Check("CUDA headers", "ok", str(folder))]


def gpu() -> list[Check]:
    """What CuPy sees: a GPU that kernels can be launched on."""
    from mpmbench.device.cuda import list_gpus

    if not any(map(_installed, CUPY)):
        return [Check("GPU", "missing", "cannot be asked for without CuPy", INSTALL_CUPY)]
    try:
        return [Check(name, "ok", summary) for name, summary in list_gpus()]
    except MpmbenchError as error:
        return [Check("GPU", "missing", _one_line(error).split(": run on")[0], NO_GPU)]


def driver() -> list[Check]:
    """What the driver's management library says: version, clocks, compute mode, other programs on the GPU."""
    if not _installed("nvidia-ml-py"):
        return [Check("nvidia-ml-py", "missing", "not installed: clocks are not watched", "pip install nvidia-ml-py")]
    nvml = importlib.import_module("pynvml")
    version = f"nvidia-ml-py {metadata.version('nvidia-ml-py')}"
    try:
        nvml.nvmlInit()
    except nvml.NVMLError as error:
        return [Check("driver", "missing", f"{version} finds none: {_one_line(error)}", NO_GPU)]
    try:
        checks = [Check("driver", "ok", f"{_text(nvml.nvmlSystemGetDriverVersion())} ({version})")]
        for index in range(nvml.nvmlDeviceGetCount()):
            handle = nvml.nvmlDeviceGetHandleByIndex(index)
            label = f"NVML {index} ({_text(nvml.nvmlDeviceGetName(handle))})"
            for name, look in (("clocks", _clocks), ("compute mode", _compute_mode), ("neighbours", _neighbours)):
                with _refusals(checks, f"{label}: {name}", nvml):
                    checks.append(look(f"{label}: {name}", nvml, handle))
        return checks
    finally:
        nvml.nvmlShutdown()


def _clocks(name: str, nvml: Any, handle: Any) -> Check:
    now = nvml.nvmlDeviceGetClockInfo(handle, nvml.NVML_CLOCK_SM)
    highest = nvml.nvmlDeviceGetMaxClockInfo(handle, nvml.NVML_CLOCK_SM)
    detail = f"SM at {now} of {highest} MHz"
    if tuple(nvml.nvmlDeviceGetCudaComputeCapability(handle)) < LOCKABLE_ARCH:
        cure = "warm the GPU up before long comparisons; compare only runs of one session"
        return Check(name, "warn", f"{detail}; this GPU cannot lock its clocks", cure)
    if os.geteuid() != 0:
        cure = f"for steady times ask an administrator: nvidia-smi --lock-gpu-clocks={highest}"
        return Check(name, "warn", f"{detail}; only root may lock them", cure)
    return Check(name, "ok", f"{detail}; may be locked: nvidia-smi --lock-gpu-clocks={highest}")


def _compute_mode(name: str, nvml: Any, handle: Any) -> Check:
    mode = nvml.nvmlDeviceGetComputeMode(handle)
    if mode == nvml.NVML_COMPUTEMODE_PROHIBITED:
        return Check(name, "missing", "prohibited: no program may use it", "nvidia-smi --compute-mode=0, as root")
    exclusive = mode == nvml.NVML_COMPUTEMODE_EXCLUSIVE_PROCESS
    return Check(name, "ok", "exclusive process" if exclusive else "shared (default)")


def _neighbours(name: str, nvml: Any, handle: Any) -> Check:
    others = [p.pid for p in nvml.nvmlDeviceGetComputeRunningProcesses(handle) if p.pid != os.getpid()]
    if others:
        return Check(name, "warn", f"{len(others)} other programs compute on this GPU", "time on a GPU of your own")
    return Check(name, "ok", "no other program computes on this GPU")


@contextmanager
def _refusals(checks: list[Check], name: str, nvml: Any) -> Iterator[None]:
    """A question that a GPU or a container does not answer is a line, not the end."""
    try:
        yield
    except nvml.NVMLError as error:
        checks.append(Check(name, "warn", f"not told: {_one_line(error)}", "look at it with nvidia-smi"))


# Versions


def required_versions() -> dict[str, str]:
    """What this package asks for: distribution -> version specifiers, such as "==0.68.*"."""
    try:
        requirements = metadata.requires("mpmbench") or []
    except metadata.PackageNotFoundError:
        return {}
    found = (re.match(r"([A-Za-z0-9._-]+)\s*([^;\s]*)", line) for line in requirements)
    return {match[1]: match[2] for match in found if match}


def satisfies(version: str, specifiers: str) -> bool:
    """Whether a version meets specifiers of the two forms used here: ``>=X`` and ``==X.*`` (or ``==X``)."""
    for specifier in filter(None, specifiers.split(",")):
        operator, wanted = specifier[:2], specifier[2:].removesuffix(".*")
        have, want = _numbers(version), _numbers(wanted)
        if operator == ">=" and have < want:
            return False
        if operator == "==" and have[: len(want)] != want:
            return False
    return True


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r"\d+", version))


def _installed(distribution: str) -> bool:
    try:
        metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return False
    return True


def _text(value: str | bytes) -> str:
    return value.decode() if isinstance(value, bytes) else value


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())[:200]


LOOKS: tuple[tuple[str, Callable[[], list[Check]]], ...] = (
    ("Python", python),
    ("packages", packages),
    ("NVRTC", nvrtc),
    ("ptxas", ptxas),
    ("CPU", cpu),
    ("memory", memory),
    ("kernel cache", cache_and_disk),
    ("CuPy", cupy),
    ("CUDA headers", headers),
    ("GPU", gpu),
    ("driver", driver),
)
