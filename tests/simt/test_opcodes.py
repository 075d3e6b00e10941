"""Every opcode form of the corpus: the engine against the NumPy executor, bit for bit, on special values, under masks
that are empty, full, one lane and random."""

from __future__ import annotations

import numpy as np
import opcode_kernels as opcodes
import pytest

from mpmbench.simt import engine, numpy_exec, ptx

BATCH = 24
SHAPE = ((opcodes.THREADS // opcodes.BLOCK,), (opcodes.BLOCK,))


def run_oracle(text: str, arguments: list[np.ndarray]) -> None:
    module = ptx.parse(text)
    assert numpy_exec.run(module.kernels["kernel"], module, *SHAPE, arguments).findings == ()


def run_engine(text: str, arguments: list[np.ndarray], lane_width: int = 16) -> None:
    module = engine.compile_ptx(text, "run", lane_width)
    assert module.kernel("kernel").launch(*SHAPE, arguments).findings == ()


def lanewise_batches() -> list:
    cases = opcodes.lanewise_cases()
    batches = [cases[at : at + BATCH] for at in range(0, len(cases), BATCH)]
    return [pytest.param(batch, id=f"{batch[0].form} to {batch[-1].form}") for batch in batches]


@pytest.mark.parametrize("style", ["guard", "branch"])
@pytest.mark.parametrize("cases", lanewise_batches())
def test_lanewise_forms(cases, style):
    data = opcodes.inputs(cases, seed=len(cases[0].form))
    text = opcodes.lanewise_kernel(cases, style)
    want, got = (opcodes.launch_arguments(data, seed=1) for _ in range(2))
    run_oracle(text, want)
    run_engine(text, got)
    wrong = []
    for number, case in enumerate(cases):
        for slot in range(len(case.results)):
            pair = got[1][number, slot], want[1][number, slot]
            differ = opcodes.disagreements(case, slot, *pair)
            if differ.any():
                wrong.append(opcodes.describe(case, data[number], slot, *pair, differ))
    assert not wrong, "\n".join(wrong)
