"""Scan in one pass: each thread block looks back at what the segments before it have published.

Idea: a thread block scans its segment by shuffles, publishes its sum, and adds up the sums before it until it meets a
segment that knows its whole prefix; then it publishes its own. Segments are handed out by ticket, so that no thread
block waits for one that has not started.

Wins when: the input is long: each value is read once and written once, half the traffic of levels.
Loses when: the input is one segment: the ticket and the cleared states are for nothing.

Source: Merrill and Garland, Single-pass parallel prefix scan with decoupled look-back, NVIDIA technical report
NVR-2016-002, 2016. The preprocessing of the transfers uses this form.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mpmbench.device import Launch
from mpmbench.launcher import THREADS, Launcher
from mpmbench.operations.scan import NEUTRAL, SCAN
from mpmbench.primitives import Bench, Built, Primitive

GROUP = 256  # threads of a thread block
RUNS = 4  # of 128 values per warp
SEGMENT = GROUP * RUNS * 4


def state_length(count: int) -> int:
    """32-bit places that a scan of ``count`` values needs for its ticket and the states of its segments."""
    return 2 + 2 * max(1, -(-count // SEGMENT))


def lookback(
    launcher: Launcher, count: int, values: Any, scanned: Any, state: Any, flags: bool = False
) -> tuple[Launch, ...]:
    """Launches that scan device arrays. ``flags``: scan value > 0 instead of the value.

    values, scanned: 32-bit integers.  state: ``state_length(count)`` of them, cleared by the first launch.
    """
    length = state_length(count)
    clear = launcher.compile(Path("clear_counts"), "clear_counts", {})
    constants = NEUTRAL | {"GROUP": GROUP, "RUNS": RUNS, "FLAGS": flags}
    kernel = launcher.compile(Path("scan_lookback"), "scan_lookback", constants)
    return (
        *launcher.launch(clear, -(-length // THREADS), THREADS, np.int32(length), state),
        *launcher.launch(kernel, -(-count // SEGMENT), GROUP, np.int32(count), values, scanned, state),
    )


def build(bench: Bench) -> Built:
    scanned, state = bench.empty(bench.size, np.int32), bench.empty(state_length(bench.size), np.int32)
    launches = lookback(bench, bench.size, bench.upload(bench.inputs["values"]), scanned, state)
    return Built(launches, {"scanned": scanned})


PRIMITIVE = Primitive(
    name="scan_lookback",
    operation=SCAN,
    summary="one pass: warp shuffles, then decoupled look-back",
    kernel="scan_lookback",
    axes={},
    build=build,
    reference="Merrill and Garland 2016",
)
