"""Shared-memory banks from addresses alone, as the hardware's documentation has them; no code of the engine."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable

import numpy as np

from mpmbench.primitives import Bench, Primitive, resolve_axes

BANKS, WORD, WARP = 32, 4, 32  # banks, bytes of a word, lanes


def wavefronts(addresses: Iterable[int | None], width: int = WORD) -> int:
    """Wavefronts of one request: byte address per lane (None where it is idle), ``width`` bytes each.

    Lanes are served in groups that together take 128 bytes; a group needs as many wavefronts as the busiest bank has
    distinct words.
    """
    lanes = list(addresses)
    size = WARP * WORD // width
    total = 0
    for first in range(0, len(lanes), size):
        words = defaultdict(set)
        for address in lanes[first : first + size]:
            if address is not None:
                for word in range(address // WORD, (address + width) // WORD):
                    words[word % BANKS].add(word)
        total += max(map(len, words.values()), default=0)
    return total


def of_threads(addresses: Iterable[int | None], width: int = WORD) -> tuple[int, int]:
    """Requests and wavefronts of one access by a thread block: byte address of each thread, ``width`` bytes each."""
    every = list(addresses)
    warps = [every[first : first + WARP] for first in range(0, len(every), WARP)]
    active = [warp for warp in warps if any(address is not None for address in warp)]
    return len(active), sum(wavefronts(warp, width) for warp in active)


def run_on(device, primitive: Primitive, values: np.ndarray, **axes):
    """Outputs and counters of a primitive on these values."""
    from mpmbench.device import run_all

    inputs = {"values": values}
    bench = Bench(primitive, resolve_axes(primitive, axes), len(values), inputs, device)
    built = primitive.build(bench)
    report = run_all(device, (*built.before, *built.launches))
    assert not report.findings
    return {name: device.download(array) for name, array in built.outputs.items()}, report.counters
