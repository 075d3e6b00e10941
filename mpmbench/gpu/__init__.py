"""GPU descriptions: one TOML file each, every constant with its source and how sure it is.

Units: bytes, bytes/s, MHz. ``dram_bandwidth`` is nominal, ``dram_bandwidth_achieved`` what a read benchmark reached.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mpmbench.errors import InputError

CONFIDENCES = ("high", "medium", "low")
REQUIRED = (
    "sm_count",
    "clock_mhz",
    "warps_per_sm",
    "blocks_per_sm",
    "registers_per_sm",
    "shared_bytes_per_sm",
    "shared_bytes_per_block",
    "shared_granularity_bytes",
    "shared_reserved_bytes_per_block",
    "memory_bytes",
    "l2_bytes",
    "dram_bandwidth",
)


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

    @property
    def summary(self) -> str:
        """One line: what it is and the sizes that matter most."""
        return (
            f"{self.title}: {self.arch}, {self['sm_count']:g} SMs at {self['clock_mhz']:g} MHz, "
            f"{self['dram_bandwidth'] / 1e9:g} GB/s, L2 {self['l2_bytes'] / 2**20:.3g} MiB"
        )


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
        constants = {name: _constant(entry) for name, entry in content["constants"].items()}
        gpu = Gpu(path.stem, str(content["name"]), str(content["arch"]), constants)
    except OSError as error:
        raise InputError(f"cannot read GPU description {path}: {(error.strerror or str(error)).lower()}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(
            f"{path} is no GPU description ({type(error).__name__}: {error}): take mpmbench/gpu/h100.toml as a pattern"
        ) from None
    if missing := [name for name in REQUIRED if name not in constants]:
        raise InputError(f"{path}: constant {missing[0]!r} is missing")
    return gpu


def _constant(entry: Any) -> Constant:
    constant = Constant(float(entry["value"]), str(entry["source"]), str(entry["confidence"]))
    if constant.confidence not in CONFIDENCES:
        raise ValueError(f"confidence {constant.confidence!r} is none of {', '.join(CONFIDENCES)}")
    if not constant.source:
        raise ValueError("a constant without a source")
    return constant
