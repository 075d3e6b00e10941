"""Machine instructions counted in the files of ptxas, in total and by source line."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from mpmbench.device import cubin, ptxas
from mpmbench.device.ptxas import assemble, kernel_infos, sass_lines
from mpmbench.simt.counters import SourceLine
from mpmbench.simt.nvrtc import compile_cuda

ARCHS = ("sm_52", "sm_61", "sm_70", "sm_80", "sm_90", "sm_120")

# Volta and later: 16 bytes each, opcode in the twelve lowest bits.
LOAD, EXIT, BRANCH, NOP = 0x7381, 0x794D, 0xFFFFFFF000007947, 0x7918
# Maxwell: control word, three instructions; opcode in the twelve highest bits.
CONTROL, ADD, EXIT_52, BRANCH_52, NOP_52 = 0, 0x5C10 << 48, 0xE300 << 48, 0xE2400FFFFF07000F, 0x50B0 << 48


def words(*values: int) -> bytes:
    return struct.pack(f"<{len(values)}Q", *values)


def test_padding_and_control_words_do_not_count() -> None:
    code = words(LOAD, 1, NOP, 2, BRANCH, 3, EXIT, 4, BRANCH, 5, NOP, 6, NOP, 7)
    assert cubin._instructions(code, "sm_90") == [0, 32, 48]
    code = words(CONTROL, ADD, NOP_52, EXIT_52, CONTROL, BRANCH_52, NOP_52, NOP_52)
    assert cubin._instructions(code, "sm_52") == [8, 24]


SOURCE = """\
__device__ __forceinline__ float twice(float x) {
    return x * 2.0f;
}
extern "C" __global__ void one(float* a) {
    a[threadIdx.x] = 1.0f;
}
extern "C" __global__ void many(float* a) {
    float x = a[threadIdx.x];
    #pragma unroll
    for (int i = 0; i < 100; ++i)
        x = x * x + 3.0f;
    a[threadIdx.x] = twice(x);
}
"""


@pytest.mark.parametrize("arch", ARCHS)
def test_every_instruction_belongs_to_a_line(arch: str) -> None:
    ptx = compile_cuda(SOURCE, arch, ("-lineinfo",), "two.cu")
    infos = kernel_infos(ptx, arch)
    assert infos["one"].sass_instructions is not None
    assert infos["many"].sass_instructions is not None
    assert 4 <= infos["one"].sass_instructions <= 15
    assert 105 <= infos["many"].sass_instructions <= 120
    lines = sass_lines(ptx, arch, "many")
    assert sum(lines.values()) == infos["many"].sass_instructions
    assert lines[SourceLine("two.cu", 11)] == 100  # one fused multiply-add each
    assert lines[SourceLine("two.cu", 2)] == 1  # an inlined function counts by its own line
    assert set(sass_lines(ptx, arch, "one")) <= {SourceLine("two.cu", line) for line in (4, 5, 6)}


def test_without_line_information_there_are_no_lines() -> None:
    assert sass_lines(compile_cuda(SOURCE, "sm_90"), "sm_90", "many") == {}


def test_routines_that_a_kernel_calls_count_as_its_own() -> None:
    text = 'extern "C" __global__ void root(double* a) {{ a[threadIdx.x] = {}; }}'
    plain, root = (
        cubin.instruction_counts(assemble(compile_cuda(text.format(term), "sm_90"), "sm_90")[1], "sm_90")["root"]
        for term in ("a[0] + 1.0", "sqrt(a[0])")
    )
    assert root > plain + 20


def test_lines_come_from_the_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MPMBENCH_CACHE_DIR", str(tmp_path))
    ptx = compile_cuda(SOURCE, "sm_90", ("-lineinfo",), "two.cu")
    first = sass_lines(ptx, "sm_90", "many")
    monkeypatch.setattr(ptxas, "assemble", lambda *_: pytest.fail("assembled again"))
    assert sass_lines(ptx, "sm_90", "many") == first
    assert all(isinstance(line, SourceLine) for line in sass_lines(ptx, "sm_90", "many"))
