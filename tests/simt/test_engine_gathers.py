"""Pieces of code with many loads: each lane loads for itself, to the same results, counters and findings."""

from __future__ import annotations

import numpy as np
import pytest
from engine_programs import OPTIONS, run

from mpmbench.simt import codegen_memory, nvrtc, ptx
from mpmbench.simt.codegen import generate
from mpmbench.simt.codegen_memory import MOST_GATHERS


def straight(loads: int, pairs: bool = False) -> str:
    """A kernel whose one long piece of code holds this many loads from shared memory, of 8 bytes or of 16."""
    term = "a = fma(a, pairs[t + {0}].x, pairs[t + {0}].y);" if pairs else "a = fma(a, s[5 * t + {0}], 1.0);"
    terms = "".join(term.format(7 * number) for number in range(loads))
    return f"""extern "C" __global__ void kernel(double* o) {{
        __shared__ __align__(16) double s[6000];
        const double2* pairs = reinterpret_cast<double2*>(s);
        int t = threadIdx.x; s[t] = o[t]; __syncthreads();
        double a = 0; {terms} o[t] = a; }}"""


def llvm_text(loads: int, mode: str, pairs: bool = False) -> str:
    text = nvrtc.compile_cuda(straight(loads, pairs), "sm_70", OPTIONS)
    return generate(ptx.parse(text).kernels["kernel"], {}, mode, 16).text


@pytest.mark.parametrize("mode", ["run", "count", "profile"])
def test_a_piece_of_code_has_few_gathers_however_long_it_is(mode: str) -> None:
    """LLVM makes a branch per lane of each gather, and needs a time for them that grows with more than their number."""
    few, more, many = (llvm_text(loads, mode).count("@llvm.masked.gather") for loads in (50, MOST_GATHERS, 400))
    assert 50 < few < more, "below the limit they are what they always were"
    assert more <= MOST_GATHERS + 2, "a declaration, and the load that fills the array"
    assert many <= 2
    sizes = [len(llvm_text(loads, mode).splitlines()) for loads in (200, 400, 800)]
    assert sizes[2] - sizes[1] <= 2.1 * (sizes[1] - sizes[0]), "text grows with the number of loads"


def test_a_load_of_two_doubles_is_two_gathers() -> None:
    few, many = (
        llvm_text(loads, "run", pairs=True).count("call <16 x double> @llvm.masked.gather") for loads in (32, 33)
    )
    assert (few, many) == (MOST_GATHERS, 0)


PROGRAM = """
__constant__ int shifts[4] = {3, 1, 2, 5};
extern "C" __global__ void kernel(const float* f, const double2* d, const int* at, float* o, int n) {
    __shared__ double s[96];
    float own[4] = {1, 2, 3, 4};
    int i = blockIdx.x * blockDim.x + threadIdx.x;
    s[threadIdx.x] = i < n ? d[i].y : -1; own[i & 3] = i;
    __syncthreads();
    if (i < n) {
        float r = f[at[i]] + own[i / 2 & 3] + shifts[i & 3];
        double2 p = d[i];
        if (p.x > 0) r += f[i + 1];
        o[i] = r + (float)(p.x * p.y + s[threadIdx.x * 5 % 70]) + f[100000 * (i > n) + i];
    }
}"""


@pytest.mark.parametrize("width", [8, 16, 32])
@pytest.mark.parametrize("mode", ["run", "count", "debug"])
def test_lanes_that_load_for_themselves_change_nothing(tmp_path, monkeypatch, mode: str, width: int) -> None:
    """Memory of every space, pairs, lanes that are off, guards, partial warps: bit for bit what gathers give."""
    rng = np.random.default_rng(3)
    n, blocks, threads = 150, 3, 70
    f = np.concatenate([rng.normal(size=n + 1), np.full(70, np.nan)]).astype(np.float32)
    d, at = rng.normal(size=(n, 2)), rng.integers(0, n, n).astype(np.int32)
    out = np.empty(blocks * threads, np.float32)  # one array: sectors depend on where it lies
    arguments = (f, d, at, out, np.int32(n))
    seen = []
    for most in (10**9, -1):
        monkeypatch.setenv("MPMBENCH_CACHE_DIR", str(tmp_path / str(most)))
        monkeypatch.setattr(codegen_memory, "MOST_GATHERS", most)
        out[:] = -5
        result = run(PROGRAM, blocks, threads, *arguments, mode=mode, lane_width=width)
        seen.append((out.copy(), result))
    (gathered, first), (loaded, second) = seen
    assert np.isfinite(gathered).all()
    np.testing.assert_array_equal(gathered.view(np.uint32), loaded.view(np.uint32))
    assert (first.counters, first.opcodes) == (second.counters, second.opcodes)
    assert first.findings == second.findings == ()


def test_a_load_out_of_bounds_is_found_as_before(tmp_path, monkeypatch) -> None:
    x, y, findings = np.ones(40, np.float32), np.zeros(64, np.float32), []
    for most in (10**9, -1):
        monkeypatch.setenv("MPMBENCH_CACHE_DIR", str(tmp_path / str(most)))
        monkeypatch.setattr(codegen_memory, "MOST_GATHERS", most)
        y[:] = 0
        body = "(const float* x, float* y) { y[threadIdx.x] = x[threadIdx.x]; }"
        findings.append([str(one) for one in run(body, 1, 64, x, y, mode="debug").findings])
        assert (y[:40] == 1).all()
    assert findings[0] == findings[1] != []
