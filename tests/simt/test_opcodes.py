"""Every opcode form of the corpus: the engine against the NumPy executor, bit for bit, on special values, under masks
that are empty, full, one lane and random."""

from __future__ import annotations

import corpus_kernels as corpus
import numpy as np
import opcode_kernels as opcodes
import pytest

from mpmbench.simt import codegen, engine, numpy_exec, ptx

BATCH = 24
SHAPE = ((opcodes.THREADS // opcodes.BLOCK,), (opcodes.BLOCK,))


def run_oracle(text: str, arguments: list[np.ndarray]) -> None:
    module = ptx.parse(text)
    assert numpy_exec.run(module.kernels["kernel"], module, *SHAPE, arguments).findings == ()


def run_engine(text: str, arguments: list[np.ndarray], lane_width: int = 16) -> None:
    module = engine.compile_ptx(text, "run", lane_width)
    assert module.kernel("kernel").launch(*SHAPE, arguments).findings == ()


def batches(forms: tuple[str, ...]) -> list:
    parts = [forms[at : at + BATCH] for at in range(0, len(forms), BATCH)]
    return [pytest.param(part, id=f"{part[0]} to {part[-1]}") for part in parts]


def lanewise_batches() -> list:
    cases = opcodes.lanewise_cases()
    batches = [cases[at : at + BATCH] for at in range(0, len(cases), BATCH)]
    return [pytest.param(batch, id=f"{batch[0].form} to {batch[-1].form}") for batch in batches]


@pytest.mark.parametrize(("style", "lane_width"), [("guard", 16), ("branch", 8), ("literal", 32)])
@pytest.mark.parametrize("cases", lanewise_batches())
def test_lanewise_forms(cases, style, lane_width):
    if style == "literal":
        cases = tuple(case for case in cases if len(case.sources) > 1 and set(case.sources) != {"pred"})
    data = opcodes.inputs(cases, seed=len(style))
    text = opcodes.lanewise_kernel(cases, style, data)
    want, got = (opcodes.launch_arguments(data, seed=1) for _ in range(2))
    run_oracle(text, want)
    run_engine(text, got, lane_width)
    wrong = []
    for number, case in enumerate(cases):
        for slot in range(len(case.results)):
            pair = got[1][number, slot], want[1][number, slot]
            differ = opcodes.disagreements(case, slot, *pair)
            if differ.any():
                wrong.append(opcodes.describe(case, data[number], slot, *pair, differ))
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("forms", batches((*opcodes.memory_forms("ld"), *opcodes.memory_forms("st"))))
def test_loads_and_stores(forms):
    rng = np.random.default_rng(len(forms[0]))
    data = rng.integers(0, 1 << 64, (len(forms), opcodes.SLOTS, opcodes.THREADS), dtype=np.uint64)
    text = opcodes.memory_kernel(forms)
    want, got = (opcodes.launch_arguments(data, 2, opcodes.PLANES) for _ in range(2))
    run_oracle(text, want)
    run_engine(text, got)
    wrong = [form for form, a, b in zip(forms, got[1], want[1], strict=True) if not np.array_equal(a, b)]
    assert not wrong
    assert all(plane.any() for plane in want[1])


@pytest.mark.parametrize("forms", batches(opcodes.atomic_forms()))
def test_atomics(forms):
    text = opcodes.atomic_kernel(forms)
    want, got = (opcodes.atomic_arguments(forms, 3) for _ in range(2))
    start = want[3].copy()
    run_oracle(text, want)
    run_engine(text, got)
    shape = (opcodes.THREADS // opcodes.BLOCK, len(forms), -1)
    count = opcodes.THREADS // opcodes.BLOCK * len(forms) * opcodes.CELLS * opcodes.CELL_BYTES // 8
    cells = [array[:count].reshape(shape) for array in (got[3], want[3], start)]
    for number, form in enumerate(forms):
        assert opcodes.same_values(form, got[1][number], want[1][number]), form
        assert opcodes.same_values(form, cells[0][:, number], cells[1][:, number]), form
        assert not np.array_equal(cells[1][:, number], cells[2][:, number]), f"{form} changed nothing"


def test_operations_across_lanes():
    forms = opcodes.warp_forms()
    data = np.random.default_rng(8).integers(0, 1 << 64, (len(forms), opcodes.SLOTS, opcodes.THREADS), dtype=np.uint64)
    text = opcodes.warp_kernel(forms)
    want = opcodes.launch_arguments(data, 4, opcodes.PLANES)
    run_oracle(text, want)
    executing = np.repeat(want[2], 32)
    for width in (8, 16, 32):
        got = opcodes.launch_arguments(data, 4, opcodes.PLANES)
        run_engine(text, got, width)
        for number, form in enumerate(forms):
            known = np.ones(opcodes.THREADS, dtype=bool)
            if form.startswith("shfl"):
                source = want[1][number, 2]
                known = (executing >> (source & 31).astype(np.uint32) & 1).astype(bool)
                known |= ~(executing >> (np.arange(opcodes.THREADS) % 32).astype(np.uint32) & 1).astype(bool)
            for plane in range(3):
                usable = known | (plane > 0)
                np.testing.assert_array_equal(
                    got[1][number, plane][usable], want[1][number, plane][usable], err_msg=f"{form} {plane} {width}"
                )


# --- whole kernels ----------------------------------------------------------------------------------------------------


def corpus_kernels() -> list:
    """Every kernel of the corpus for the newest architecture; the lane width goes round. structures have a test of
    their own with the oracle."""
    names = [
        (stem, name)
        for stem in corpus.FILES
        for name in corpus.module(stem, "sm_90").kernels
        if "structures" not in name
    ]
    return [pytest.param(stem, name, (16, 8, 32)[n % 3], id=name) for n, (stem, name) in enumerate(names)]


@pytest.mark.parametrize(("stem", "name", "lane_width"), corpus_kernels())
def test_kernels_of_the_corpus(stem, name, lane_width):
    """Results and, where no approximate function decides a branch, counters."""
    module, approximate = corpus.module(stem, "sm_90"), name.startswith("approx")
    # NaNs differ in sign and payload, which integer operations on float bits can see.
    tame = approximate or name == "float32_plain"
    want, got = corpus.arguments(128, tame=tame), corpus.arguments(128, tame=tame)
    result = numpy_exec.run(module.kernels[name], module, (2,), (64,), want, 4096)
    compiled = engine.compile_ptx(corpus.ptx_text(stem, "sm_90"), "count", lane_width)
    launched = compiled.kernel(name).launch((2,), (64,), got, 4096)
    assert launched.findings == result.findings == ()
    for a, b in zip(got[3:], want[3:], strict=True):
        if approximate and a.dtype.kind == "f":
            np.testing.assert_allclose(a, b, rtol=1e-5 if a.dtype == np.float32 else 1e-12)
        else:
            np.testing.assert_array_equal(a, b)
    if name != "approx_svd":
        assert launched.counters == result.counters


def test_every_form_is_known_to_both_executors():
    """The opcode set is closed: each form in the corpus on three architectures, and in every kernel that ships."""
    known: set[str] = set()
    for arch in corpus.ARCHS:
        for stem in corpus.FILES:
            module = corpus.module(stem, arch)
            numbers = {name: number for number, name in enumerate(module.variables)}
            for kernel in module.kernels.values():
                numpy_exec.check_supported(kernel, module)
                codegen.generate(kernel, numbers, "run", 16)
                known.update(corpus.form(item) for item in kernel.instructions)
    print(f"{len(known)} forms in the corpus")
    assert len(known) > 500
    assert known == set(corpus.forms())
