"""Random programs without races: the engine against the NumPy executor, for every lane width and mode, counters too."""

from __future__ import annotations

import corpus_kernels as corpus
import numpy as np
import pytest
import random_programs as programs

from mpmbench.simt import engine, numpy_exec, nvrtc, ptx
from mpmbench.simt.counters import Counters

BLOCKS = 3


def arguments(block: int, seed: int) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    threads = BLOCKS * block
    return [
        corpus.aligned(rng.integers(0, 1 << 32, 2 * threads, dtype=np.uint32)),
        corpus.aligned(rng.normal(size=2 * threads + 32).astype(np.float32)),
        corpus.aligned(np.zeros(threads * programs.SLOTS, np.uint32)),
        corpus.aligned(np.zeros(threads * programs.SLOTS, np.float32)),
        corpus.aligned(np.zeros(16, np.uint32)),
    ]


def assert_same(got: list[np.ndarray], want: list[np.ndarray], where: str) -> None:
    """Equal bits; any NaN equals any NaN."""
    for a, b in zip(got, want, strict=True):
        same = a.view(np.uint32) == b.view(np.uint32)
        if a.dtype == np.float32:
            same |= np.isnan(a) & np.isnan(b)
        assert same.all(), f"{where}: thread {np.flatnonzero(~same)[0] // programs.SLOTS} and {(~same).sum()} values"


def check(text: str, block: int, seed: int, variants: list[tuple[str, int]]) -> None:
    """Run PTX by the oracle and by the engine in several (mode, lane width); the first of them counts."""
    module = ptx.parse(text)
    want = arguments(block, seed)
    result = numpy_exec.run(module.kernels["kernel"], module, (BLOCKS,), (block,), want)
    assert result.findings == ()
    for mode, width in variants:
        got = arguments(block, seed)
        launched = engine.compile_ptx(text, mode, width).kernel("kernel").launch((BLOCKS,), (block,), got)
        assert launched.findings == (), f"{mode} {width}: {launched.findings}"
        assert_same(got, want, f"seed {seed}, {mode}, {width} lanes")
        if mode == "count":
            assert launched.counters is not None
            assert_counters(launched.counters, result.counters)


def assert_counters(got: Counters, want: Counters) -> None:
    assert got.total == want.total
    assert got.lines == want.lines


WIDTHS = (16, 8, 32)


def variants(seed: int) -> list[tuple[str, int]]:
    """Counting in one lane width, running in another; the seeds go through all pairs and both ways to run."""
    return [("count", WIDTHS[seed % 3]), (("run", "debug")[seed % 2], WIDTHS[(seed + 1) % 3])]


# In the last five lanes reach a barrier or a shuffle while others are still on their way to it.
@pytest.mark.parametrize("seed", [*range(15), 57, 63, 68, 94, 118])
def test_structured_programs(seed):
    program = programs.cuda_program(seed)
    text = nvrtc.compile_cuda(program.text, ("sm_52", "sm_75", "sm_90")[seed % 3], corpus.OPTIONS, name="kernel.cu")
    check(text, program.block, seed, variants(seed))


@pytest.mark.parametrize("seed", range(36))
def test_branches_to_anywhere(seed):
    program = programs.ptx_program(seed)
    check(program.text, program.block, seed, variants(seed))
