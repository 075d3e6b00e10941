"""pytest-benchmark as a front end: on a GPU its figures must be the device's event times and nothing else."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

BENCH = Path(__file__).parent / "bench" / "test_transfers.py"

# Stands in for the GPU: the simulated device computes, a script says what each transfer took.
CONFTEST = """
import itertools
import pytest
import test_transfers
from mpmbench.device.simulated import SimulatedDevice

class Scripted(SimulatedDevice):
    name = "cuda:0"
    now = 0.0
    times = itertools.cycle([0.003, 0.001, 0.002])
    def flush_cache(self): self.now += 5.0
    hold_expired = False
    def hold(self): self.now += 1.0
    def release(self): pass
    def record(self): return self.now
    def elapsed(self, start, end):
        return next(self.times)

test_transfers._cuda = lambda: Scripted(mode="run")
"""


@pytest.mark.parametrize("name", ["p2g_global_atomic", "g2p_block_gather"])
def test_event_times_reach_the_benchmark_file(tmp_path, name) -> None:
    (tmp_path / "test_transfers.py").write_text(BENCH.read_text())
    (tmp_path / "conftest.py").write_text(CONFTEST)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--benchmark-json=out.json",
               "-k", f"test_cuda and {name} and uniform_cube", "test_transfers.py"]  # fmt: skip
    # pytest-benchmark stands aside inside a worker of pytest-xdist, which this child would take itself for.
    env = {key: value for key, value in os.environ.items() if not key.startswith("PYTEST_XDIST")}
    process = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True, timeout=120)
    assert process.returncode == 0, process.stdout + process.stderr
    (benchmark,) = json.loads((tmp_path / "out.json").read_text())["benchmarks"]
    assert benchmark["group"] == "cuda: event time"
    stats = benchmark["stats"]
    assert stats["rounds"] == 20
    assert stats["min"] == pytest.approx(0.001)
    assert stats["median"] == pytest.approx(0.002)
    assert stats["max"] == pytest.approx(0.003)
