"""A user's own strategy, from a folder of their own: one kernel, one module, no edit anywhere."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
from click.testing import CliRunner

from mpmbench.cli import main
from mpmbench.record import read_records

ROOT = Path(__file__).parent.parent

KERNEL = """\
// Idea: a thread per particle walks its support backwards.
// A thread owns one particle. Constants: those of the headers.
#include "transfer.cuh"

extern "C" __global__ void p2g_backwards(
    const Domain domain, const int particle_count, const real4* __restrict__ particles, const int* __restrict__ order,
    real4* __restrict__ nodes) {
    const int s = blockIdx.x * blockDim.x + threadIdx.x;
    if (s >= particle_count) return;
    Cell bin;
    const Source source = load_particle(domain, particles, particle_count, stored_at(order, s), bin);
    Weights weights;
    weights.set(source.f);
    real4* lowest = nodes + node_index(domain, bin.x - LEFT, bin.y - LEFT, bin.z - LEFT);
#pragma unroll NODE_UNROLL
    for (int n = SUPPORT - 1; n >= 0; --n) {
        const Offset o = support_offset(n);
        const real4 value = contribution(source, weights.scaled(source.mass, o), o);
        atomic_add(lowest + node_index(domain, o.x, o.y, o.z), value);
    }
}
"""

MODULE = '''\
"""P2G with a thread per particle that walks its support backwards.

Idea: the order of nodes does not matter. Wins when: never. Loses when: always. Source: none.
"""

from mpmbench.variants import GLOBAL_AXES, Variant, p2g_floor

VARIANT = Variant(
    name="p2g_backwards",
    summary="thread per particle, backwards",
    transfer="p2g",
    kernel="p2g_backwards",
    needs=(),
    axes=GLOBAL_AXES,
    launch=lambda work: work.cover(
        work.particle_count, work.domain, work.count, work.particles, work.order, work.nodes
    ),
    floor=p2g_floor,
    reference="none",
)
'''


def tree() -> str:
    """State of every file of the checkout, ignored ones too, but for caches that any test run may leave."""
    command = ["git", "status", "--porcelain", "--ignored", "--untracked-files=all"]
    text = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return "\n".join(
        line for line in text.splitlines() if not any(c in line for c in ("cache", ".benchmarks", ".venv"))
    )


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "p2g_backwards.cu").write_text(KERNEL)
    (tmp_path / "p2g_backwards.py").write_text(MODULE)
    return tmp_path


def run(*words) -> str:
    result = CliRunner().invoke(main, [str(word) for word in words])
    assert result.exit_code in (0, 4), result.output
    return result.output


SMALL = ("--dataset", "random", "--particles", "400", "-d", "simulated")


def test_own_variant_stands_in_the_same_tables(folder) -> None:
    before = tree()
    rows, report = folder / "rows.jsonl", folder / "report.md"
    words = ("run", "--variants", folder, "-b", "p2g_backwards", "-b", "p2g_global_atomic", *SMALL)
    run(*words, "--json", rows, "--md", report)
    assert {r.variant: r.status for r in read_records(rows)} == {"p2g_backwards": "ok", "p2g_global_atomic": "ok"}
    assert "p2g_backwards" in report.read_text()
    assert "p2g_backwards" in run("list", "--variants", folder)
    assert tree() == before
    assert {path.suffix for path in folder.iterdir()} == {".cu", ".py", ".jsonl", ".md"}


def test_own_variant_is_checked_by_the_same_reference(folder) -> None:
    kernel = folder / "p2g_backwards.cu"
    kernel.write_text(kernel.read_text().replace("n = SUPPORT - 1", "n = SUPPORT - 2"))
    rows = folder / "rows.jsonl"
    run("run", "--variants", folder, "-b", "p2g_backwards", *SMALL, "--json", rows)
    (record,) = read_records(rows)
    assert record.status == "wrong"
    assert record.transfer_counters is None
    assert not record.preprocess


def test_broken_kernel_is_one_row_with_the_compilers_words(folder) -> None:
    kernel = folder / "p2g_backwards.cu"
    kernel.write_text(kernel.read_text().replace("Weights weights;", "Weight weights;"))
    result = CliRunner().invoke(
        main, ["run", "--variants", str(folder), "-b", "p2g_backwards", *SMALL, "--json", str(folder / "rows.jsonl")]
    )
    assert result.exit_code == 1
    assert "p2g_backwards.cu" in result.output
    assert "Traceback" not in result.output


def test_a_bug_in_the_module_costs_its_row_and_names_its_line(folder) -> None:
    module = folder / "p2g_backwards.py"
    module.write_text(module.read_text().replace("work.order,", "work.ordr,"))
    rows = folder / "rows.jsonl"
    words = ["run", "--variants", str(folder), "-b", "p2g_*s", "-b", "p2g_global_atomic", *SMALL, "--json", str(rows)]
    result = CliRunner().invoke(main, words)
    assert result.exit_code == 1
    found = {r.variant: r for r in read_records(rows)}
    assert found["p2g_global_atomic"].status == "ok"
    assert "p2g_backwards.py:" in found["p2g_backwards"].failed_because
    assert "'ordr'" in found["p2g_backwards"].failed_because
