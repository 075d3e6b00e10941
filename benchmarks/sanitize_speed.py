"""How long one transfer launch takes in the engine's debug mode, beside the same launch without checks.

    python benchmarks/sanitize_speed.py [--particles N]

Compile time is excluded: each launch runs once before it is timed. Processor seconds, so that other work on the machine
does not count.
"""

from __future__ import annotations

import argparse
import time

from mpmbench.dataset import load_dataset
from mpmbench.device import open_device, run_all
from mpmbench.plan import build_plan
from mpmbench.variants import get, resolve_axes

ROWS = (
    ("p2g_global_atomic", "deep", "uniform_cube"),
    ("p2g_global_atomic", "given", "random"),
    ("p2g_block_atomic", "deep", "uniform_cube"),
    ("p2g_block_sync", "deep", "uniform_cube"),
)


def seconds(mode: str, name: str, order: str, dataset: str, particles: int) -> float:
    """Processor time of the transfer's launches [s]; all preprocessing runs in the same mode before."""
    device, variant = open_device("simulated", mode=mode), get(name)
    axes = resolve_axes(variant, {"particle_order": order})
    plan = build_plan(variant, load_dataset(dataset, particles), device, axes)
    plan.run_once(device)
    begin = time.process_time()
    findings = run_all(device, plan.transfer.launches).findings
    assert not findings, findings
    return time.process_time() - begin


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--particles", type=int, default=1_000_000)
    particles = parser.parse_args().particles
    print("| transfer | particles | plain [s] | checked [s] |\n|---|---|---|---|")
    for name, order, dataset in ROWS:
        plain, checked = (seconds(mode, name, order, dataset, particles) for mode in ("run", "debug"))
        print(f"| `{name}`, `{order}` | {dataset} | {plain:.2f} | {checked:.2f} |", flush=True)


if __name__ == "__main__":
    main()
