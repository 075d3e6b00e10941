"""What this machine has, what it lacks and what to do about it. Looking never fails and changes nothing."""

from __future__ import annotations

import importlib
import os
import platform
import re
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Literal

from mpmbench.device.nvml import Nvml
from mpmbench.errors import MpmbenchError

Status = Literal["ok", "warn", "missing"]

GIB = 2**30
WANTED_DISK = GIB  # caches and records of a full run
WANTED_MEMORY = 8 * GIB  # the thesis preset at full size
OLDEST_ARCH = "sm_52"  # of the thesis, GTX 970
DRIVER_PARAMETERS = Path("/proc/driver/nvidia/params")
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
    """What the driver's management library says: version, and of each GPU what times depend on."""
    if not _installed("nvidia-ml-py"):
        return [Check("nvidia-ml-py", "missing", "not installed: clocks are not watched", "pip install nvidia-ml-py")]
    gpus, reason = Nvml.all()
    version = f"nvidia-ml-py {metadata.version('nvidia-ml-py')}"
    if reason:
        return [Check("driver", "missing", f"{version} finds none: {reason}", NO_GPU)]
    checks = [Check("driver", "ok", f"{gpus[0].driver if gpus else 'no GPU'} ({version})")]
    for index, one in enumerate(gpus):
        for name, look in GPU_LOOKS:
            label = f"NVML {index} ({one.name}): {name}"
            checks.append(
                look(label, one) or Check(label, "warn", f"not told: {one.refusal}", "look at it with nvidia-smi")
            )
    return checks


def _clocks(name: str, one: Nvml) -> Check | None:
    now, highest = one.sm_clock, one.sm_clock_max
    if now is None or highest is None:
        return None
    detail = f"SM at {now} of {highest} MHz"
    if one.lockable is False:
        cure = "warm the GPU up before long comparisons; compare only runs of one session"
        return Check(name, "warn", f"{detail}; this GPU cannot lock its clocks", cure)
    if os.geteuid() != 0:
        cure = f"for steady times ask an administrator: nvidia-smi --lock-gpu-clocks={highest}"
        return Check(name, "warn", f"{detail}; only root may lock them", cure)
    return Check(name, "ok", f"{detail}; may be locked: mpmbench run --lock-gpu-clocks base")


def _throttle(name: str, one: Nvml) -> Check | None:
    why = one.throttle_reasons()
    if why is None:
        return None
    if why:
        return Check(name, "warn", f"held down: {why}", "let the GPU cool down, or raise its power limit")
    return Check(name, "ok", "nothing holds the clocks down")


def _compute_mode(name: str, one: Nvml) -> Check | None:
    mode = one.compute_mode
    if mode == "prohibited":
        return Check(name, "missing", "prohibited: no program may use it", "nvidia-smi --compute-mode=0, as root")
    if mode is None:
        return None
    return Check(name, "ok", mode if mode.startswith("exclusive") else "shared (default)")


def _neighbours(name: str, one: Nvml) -> Check | None:
    if one.process_ids is None:
        return None
    others = [number for number in one.process_ids if number != os.getpid()]
    if others:
        return Check(name, "warn", f"{len(others)} other programs compute on this GPU", "time on a GPU of your own")
    return Check(name, "ok", "no other program computes on this GPU")


def _persistence(name: str, one: Nvml) -> Check | None:
    on = one.persistence
    if on is False:
        return Check(name, "warn", "off: settings may be lost between runs", "nvidia-smi --persistence-mode=1, as root")
    return None if on is None else Check(name, "ok", "on")


GPU_LOOKS: tuple[tuple[str, Callable[[str, Nvml], Check | None]], ...] = (
    ("clocks", _clocks),
    ("throttling", _throttle),
    ("compute mode", _compute_mode),
    ("neighbours", _neighbours),
    ("persistence", _persistence),
)


def counters() -> list[Check]:
    """Whether the driver lets programs read hardware counters, which Nsight Compute needs and times do not."""
    try:
        text = DRIVER_PARAMETERS.read_text()
    except OSError:
        return []  # no driver, or a container that hides it
    found = re.search(r"^RmProfilingAdminOnly:\s*(\d+)", text, re.MULTILINE)
    if found is None:
        return [Check("counters", "warn", "the driver does not tell who may read them", "try: ncu --query-metrics")]
    if found[1] == "0":
        return [Check("counters", "ok", "every user may read them")]
    if os.geteuid() == 0:
        return [Check("counters", "ok", "root may read them")]
    cure = "run ncu as root, or as root set the module option nvidia NVreg_RestrictProfilingToAdminUsers=0 and reboot"
    return [Check("counters", "warn", "only root may read them (RmProfilingAdminOnly)", cure)]


def ncu() -> list[Check]:
    """Nsight Compute, for counters beside the model's. Asked for only where there is a driver."""
    if not DRIVER_PARAMETERS.exists():
        return []
    found = shutil.which("ncu")
    if found is None:
        cure = "install Nsight Compute and put its folder on PATH, or do without --ncu-csv"
        return [Check("ncu", "missing", "not on PATH: no hardware counters", cure)]
    return [Check("ncu", "ok", found)]


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
    ("counters", counters),
    ("ncu", ncu),
)
