"""Write a GPU description for this machine: what the driver knows, and the rest from the most similar shipped GPU."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mpmbench.device.cuda import CudaDevice
from mpmbench.errors import InputError
from mpmbench.gpu import MEANINGS, Constant, Gpu, list_gpus

DRIVER = "CUDA driver of this machine"
WARP = 32


def write_gpu(path: Path, device: str = "cuda") -> Gpu:
    """Describe a GPU of this machine in a new TOML file and return what it holds.

    Raises InputError where there is no GPU and where the file exists: it may hold constants that somebody measured.
    """
    if path.suffix != ".toml":
        raise InputError(f"{path}: a GPU description is a .toml file")
    if path.exists():
        raise InputError(f"{path} exists and is not overwritten: remove it, or name another file")
    opened = CudaDevice(device)
    gpu = describe(path.stem, opened.arch, opened.properties)
    try:
        with path.open("x") as file:
            file.write(as_toml(gpu))
    except OSError as error:
        raise InputError(f"cannot write {path}: {(error.strerror or str(error)).lower()}") from None
    return gpu


def describe(name: str, arch: str, properties: Mapping[str, Any]) -> Gpu:
    """A description from the driver's answers (``cudaDeviceProp``), completed from a shipped one."""
    known = _known(properties)
    similar = most_similar(arch, known["sm_count"])
    constants = {constant: Constant(value, DRIVER, "high") for constant, value in known.items()}
    for constant in MEANINGS:
        if constant not in known and constant in similar.constants:
            constants[constant] = _taken(constant, similar, known, arch)
    title = properties["name"]
    title = title.decode() if isinstance(title, bytes) else str(title)
    return Gpu(name, title, arch, {constant: constants[constant] for constant in MEANINGS if constant in constants})


def most_similar(arch: str, sm_count: float) -> Gpu:
    """The shipped GPU of an architecture with the nearest number of SMs; failing that, of the newest one before."""
    shipped = list_gpus()
    own = _number(arch)
    older = [gpu for gpu in shipped if _number(gpu.arch) <= own] or shipped
    nearest = min(abs(own - _number(gpu.arch)) for gpu in older)
    same = [gpu for gpu in older if abs(own - _number(gpu.arch)) == nearest]
    return min(same, key=lambda gpu: abs(gpu["sm_count"] - sm_count))


def as_toml(gpu: Gpu) -> str:
    """The text of a description, each constant under the line that says what it means."""
    lines = [f"name = {_quoted(gpu.title)}", f"arch = {_quoted(gpu.arch)}", "", "[constants]"]
    for name, constant in gpu.constants.items():
        value = int(constant.value) if float(constant.value).is_integer() else constant.value
        lines.append(f"# {MEANINGS[name]}")
        lines.append(
            f"{name} = {{ value = {value}, source = {_quoted(constant.source)}, "
            f"confidence = {_quoted(constant.confidence)} }}"
        )
    return "\n".join(lines) + "\n"


def _known(properties: Mapping[str, Any]) -> dict[str, float]:
    kilohertz, bits = properties["memoryClockRate"], properties["memoryBusWidth"]
    found = {
        "sm_count": properties["multiProcessorCount"],
        "clock_mhz": properties["clockRate"] / 1000,
        "warps_per_sm": properties["maxThreadsPerMultiProcessor"] // WARP,
        "blocks_per_sm": properties["maxBlocksPerMultiProcessor"],
        "registers_per_sm": properties["regsPerMultiprocessor"],
        "shared_bytes_per_sm": properties["sharedMemPerMultiprocessor"],
        "shared_bytes_per_block": properties["sharedMemPerBlockOptin"],
        "shared_reserved_bytes_per_block": properties["reservedSharedMemPerBlock"],
        "l2_bytes": properties["l2CacheSize"],
        "memory_bytes": properties["totalGlobalMem"],
        "dram_bandwidth": 2 * kilohertz * 1000 * bits / 8,  # two transfers per clock
    }
    # Newer drivers no longer tell clocks: zero there means unknown.
    zero_is_an_answer = {"shared_reserved_bytes_per_block"}
    return {name: float(value) for name, value in found.items() if value or name in zero_is_an_answer}


def _taken(constant: str, similar: Gpu, known: Mapping[str, float], arch: str) -> Constant:
    value, source = similar[constant], f"taken from {similar.title}"
    if constant == "dram_bandwidth_achieved" and "dram_bandwidth" in known:
        value *= known["dram_bandwidth"] / similar["dram_bandwidth"]
        source += ", times the ratio of the nominal bandwidths"
    if similar.arch != arch:
        source += f", of another architecture ({similar.arch})"
    return Constant(value, f"{source}; not measured on this GPU", "low")


def _number(arch: str) -> int:
    return int(arch.removeprefix("sm_").rstrip("af"))


def _quoted(text: str) -> str:
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'
