"""A modelled time: what the performance model says of launches on a named GPU, with everything that it rests on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

# Units of a GPU that can bind a kernel; the time of each, if it were the only limit, is a term of the model.
TERMS = ("issue", "shared", "l1", "l2", "dram", "activations", "atomics", "latency")
TERM_WORDS = {
    "issue": "instruction issue",
    "shared": "shared memory and load/store pipe",
    "l1": "L1 / texture path",
    "l2": "L2 bandwidth",
    "dram": "DRAM bandwidth",
    "activations": "DRAM row activations (scattered access)",
    "atomics": "global atomics",
    "latency": "latency that too few warps hide",
}


@dataclass(frozen=True)
class ModelledTime:
    """Predicted time of one or several launches.

    gpu: name of its description.  seconds: launch overhead plus the largest term.  low, high: [s], range of the
    prediction.  bound: the term that wins (for several launches: the one with most time).  terms: each of TERMS [s],
    and "launch".  calibrated: whether the rates of the GPU that bind here are known; reason says what is not.
    """

    gpu: str
    seconds: float
    low: float
    high: float
    bound: str
    terms: Mapping[str, float] = field(default_factory=dict)
    calibrated: bool = True
    reason: str = ""
