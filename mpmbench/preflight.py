"""What to know of a GPU before its times are believed.

Told from the facts that a record keeps of its GPU, so that any machine can tell it again; needs neither GPU nor NVML.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

MOMENTARY = "_now"  # facts whose names end in this change from moment to moment: two runs need not agree on them


def warnings(facts: Mapping[str, Any]) -> Sequence[tuple[str, str]]:
    """(what is wrong, what to do about it) from the facts of a CUDA device (``Environment.gpu``).

    What is not known raises no warning, but for the lock of the clocks: NVML does not tell of it, and it decides.
    """
    if not facts:
        return []
    if missing := facts.get("nvml_missing"):
        action = "Install it with its driver (`pip install nvidia-ml-py`); `mpmbench doctor` says what is there."
        return [(f"Clocks, heat and other programs on the GPU were not watched ({missing})", action)]
    found = []
    if "clocks_locked" in facts and not facts["clocks_locked"]:
        found.append(_unlocked(facts))
    if why := facts.get("throttle_now"):
        found.append((f"The GPU held its clocks down ({why})", THROTTLED.get(why, COOL)))
    limit, usual = facts.get("power_limit"), facts.get("power_limit_default")
    if limit and usual and limit < usual:
        action = f"Raise it as root: `nvidia-smi --power-limit={usual:.0f}`."
        found.append(("The power limit is lower than the GPU's own", action))
    if facts.get("other_processes_now"):
        found.append(("Other programs computed on the GPU", "End them, or time on a GPU of your own."))
    if facts.get("mig"):
        action = "Compare rows of this run only; for times of the GPU switch it off as root: `nvidia-smi --mig=0`."
        found.append(("MIG is on: clocks and power are shared with other instances", action))
    if facts.get("persistence") is False:
        action = "Switch it on as root: `nvidia-smi --persistence-mode=1`."
        found.append(("Persistence mode is off: the driver may forget its settings between runs", action))
    return found


COOL = "Let it cool down, or lock a clock that it can hold (`--lock-gpu-clocks base`)."
THROTTLED = {
    "power cap": "Raise its power limit, or lock a clock that it can hold (`--lock-gpu-clocks base`).",
    "power brake": "The power supply asks for it: see to the machine.",
}


def _unlocked(facts: Mapping[str, Any]) -> tuple[str, str]:
    if facts.get("clocks_lockable") is False:
        return "This GPU cannot lock its clocks", "Let it warm up, and compare rows of one run only."
    action = "Run as root with `--lock-gpu-clocks base`, or lock them with nvidia-smi and pass over this."
    return "This run did not lock the clocks (NVML does not tell whether anybody else has)", action
