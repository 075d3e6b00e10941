"""GPU descriptions: one TOML file each, every constant with its source and how sure it is.

``MEANINGS`` says what each constant means and in which unit. Cycles are SM clock cycles; an instruction rate counts
machine instructions that one SM starts per cycle, in whole warps.
"""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mpmbench.errors import InputError

CONFIDENCES = ("high", "medium", "low")
MAY_BE_ZERO = (
    "shared_reserved_bytes_per_block",
    "l1_holds_plain_loads",
    "barrier_latency",
    "block_start_cycles",
    "launch_overhead",
)

MEANINGS: dict[str, str] = {
    "sm_count": "streaming multiprocessors (SMs) of the GPU",
    "clock_mhz": "clock of the SMs under load [MHz]",
    "schedulers_per_sm": "warp schedulers, each of which starts at most one instruction per cycle",
    "warps_per_sm": "most warps that one SM holds",
    "blocks_per_sm": "most thread blocks that one SM holds",
    "registers_per_sm": "32-bit registers of one SM",
    "shared_bytes_per_sm": "most shared memory of one SM [bytes]",
    "shared_bytes_per_block": "most shared memory of one thread block, static and dynamic [bytes]",
    "shared_granularity_bytes": "unit in which shared memory is given out [bytes]",
    "shared_reserved_bytes_per_block": "shared memory that the system takes for each thread block [bytes]",
    "l1_bytes": "one L1 (texture) cache, with the shared memory that is carved out of it on sm_70 and later [bytes]",
    "l1_per_sm": "L1 caches of one SM, each for its share of the warps",
    "l1_holds_plain_loads": "1: every global load may hit L1; 0: only those of the read-only path (ld.global.nc)",
    "l1_bytes_per_clk": "what all L1 caches of one SM deliver [bytes per cycle]",
    "l2_bytes": "the L2 cache [bytes]",
    "l2_slices": "parts of L2 that work side by side",
    "l2_bandwidth": "reads that hit L2, whole GPU [bytes/s]",
    "memory_bytes": "device memory [bytes]",
    "dram_bandwidth": "nominal DRAM bandwidth: bus width times data rate [bytes/s]",
    "dram_bandwidth_achieved": "most that a streaming kernel reaches [bytes/s]",
    "dram_channels": "independent DRAM channels",
    "dram_banks": "banks of one channel",
    "dram_row_bytes": "row (page) of one bank: what one activation opens [bytes]",
    "alu_latency": "from an fp32 or integer instruction to one that needs its result [cycles]",
    "shared_latency": "the same for a shared-memory load without bank conflicts [cycles]",
    "l1_latency": "the same for a global load that hits L1 [cycles]",
    "l2_latency": "the same for a global load that hits L2 [cycles]",
    "dram_latency": "the same for a global load that goes to idle DRAM [cycles]",
    "barrier_latency": "from the last warp's arrival at a block barrier to the next instruction [cycles]",
    "block_start_cycles": "from the end of a thread block to the first instruction of its successor [cycles]",
    "launch_overhead": "time of an empty kernel launch as timers on the device see it [s]",
    "rate_fp32": "fp32 add, multiply, fused multiply-add [warp instructions per cycle and SM]",
    "rate_fp64": "the same in fp64 [warp instructions per cycle and SM]",
    "rate_int_add": "32-bit integer add and subtract [warp instructions per cycle and SM]",
    "rate_int_mul": "machine instructions that integer products consist of [warp instructions per cycle and SM]",
    "rate_logic": "bitwise and, or, xor [warp instructions per cycle and SM]",
    "rate_shift": "32-bit shifts [warp instructions per cycle and SM]",
    "rate_compare": "comparison, minimum, maximum [warp instructions per cycle and SM]",
    "rate_convert": "conversion between 32-bit types [warp instructions per cycle and SM]",
    "rate_special": "reciprocal, square root, sine, exponential [warp instructions per cycle and SM]",
    "rate_load_store": "load, store and atomic instructions [warp instructions per cycle and SM]",
    "issue_efficiency": "share of the issue slots that busy kernels use",
    "atomic_word_rate": "fp32 additions by atomics to different words in L2, whole GPU [lanes/s]",
    "row_activation_rate": "DRAM row activations, whole GPU [1/s]",
}

# What no document states for every GPU; without the last three, what they bind is calibrated or stays uncalibrated.
OPTIONAL = ("l2_slices", "dram_bandwidth_achieved", "atomic_word_rate", "row_activation_rate")
REQUIRED = tuple(name for name in MEANINGS if name not in OPTIONAL)


@dataclass(frozen=True)
class Constant:
    """One number about a GPU. confidence: high (read in the source), medium, low (derived or guessed)."""

    value: float
    source: str
    confidence: str


@dataclass(frozen=True)
class Gpu:
    """A GPU as its description gives it. name: what ``--gpu`` takes.  title: what the vendor calls it."""

    name: str
    title: str
    arch: str  # "sm_90"
    constants: dict[str, Constant] = field(repr=False)

    def __getitem__(self, constant: str) -> float:
        """The value of a constant; KeyError if the description has none."""
        return self.constants[constant].value

    def get(self, constant: str) -> float | None:
        """The value of a constant, None if the description has none."""
        return self[constant] if constant in self.constants else None

    @property
    def summary(self) -> str:
        """One line: what it is and the sizes that matter most."""
        return (
            f"{self.title}: {self.arch}, {self['sm_count']:g} SMs at {self['clock_mhz']:g} MHz, "
            f"{self['dram_bandwidth'] / 1e9:g} GB/s, L2 {self['l2_bytes'] / 2**20:.3g} MiB"
        )


CALIBRATED = Path(__file__).parent / "calibrated"  # constants set from published times, by GPU


def list_gpus() -> list[Gpu]:
    """Every GPU that ships with a description, by name."""
    return [read_gpu(path) for path in sorted(Path(__file__).parent.glob("*.toml"))]


def get_gpu(name_or_path: str | Path) -> Gpu:
    """A shipped description by name, or a user's own TOML file. Raises InputError naming the valid ones."""
    known = {gpu.name: gpu for gpu in list_gpus()}
    if str(name_or_path) in known:
        return known[str(name_or_path)]
    path = Path(name_or_path)
    if path.suffix == ".toml":
        return read_gpu(path)
    raise InputError(f"unknown GPU {str(name_or_path)!r}: valid are {', '.join(known)}, or a path to a .toml file")


def read_gpu(path: Path) -> Gpu:
    """Read one description. Raises InputError for a missing or malformed file."""
    try:
        with path.open("rb") as file:
            content = tomllib.load(file)
        constants = {name: _constant(name, entry) for name, entry in content["constants"].items()}
        gpu = Gpu(path.stem, str(content["name"]), str(content["arch"]), constants)
    except OSError as error:
        raise InputError(f"cannot read GPU description {path}: {(error.strerror or str(error)).lower()}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(
            f"{path} is no GPU description ({_why(error)}): take {Path(__file__).with_name('h100.toml')} as a pattern"
        ) from None
    calibrated = CALIBRATED / path.name
    if path.parent == Path(__file__).parent and calibrated.is_file():
        with calibrated.open("rb") as file:
            constants |= {name: _constant(name, entry) for name, entry in tomllib.load(file)["constants"].items()}
    if missing := [name for name in REQUIRED if name not in constants]:
        raise InputError(f"{path}: constant {missing[0]!r} is missing ({MEANINGS[missing[0]]})")
    if unknown := [name for name in constants if name not in MEANINGS]:
        raise InputError(f"{path}: unknown constant {unknown[0]!r}: valid are {', '.join(MEANINGS)}")
    return gpu


def _why(error: Exception) -> str:
    return f"it lacks {error}" if isinstance(error, KeyError) else str(error)


def _constant(name: str, entry: Any) -> Constant:
    if not isinstance(entry, dict) or not {"value", "source", "confidence"} <= set(entry):
        raise ValueError(f"constant {name!r} must be {{ value = ..., source = ..., confidence = ... }}")
    value = entry["value"]
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"the value of constant {name!r} is no number: {value!r}")
    constant = Constant(float(value), str(entry["source"]), str(entry["confidence"]))
    if not math.isfinite(constant.value) or constant.value < 0 or (constant.value == 0 and name not in MAY_BE_ZERO):
        raise ValueError(f"constant {name!r} is {value}: want a number above zero")
    if constant.confidence not in CONFIDENCES:
        raise ValueError(f"confidence {constant.confidence!r} of {name!r} is none of {', '.join(CONFIDENCES)}")
    if not constant.source:
        raise ValueError(f"constant {name!r} is without a source")
    return constant
