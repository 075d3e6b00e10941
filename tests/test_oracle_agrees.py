"""Every strategy on the plain NumPy executor and on the engine: same results, same counters; and no opcode that either
of them lacks."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mpmbench import variants
from mpmbench.dataset import Dataset
from mpmbench.device.simulated import SimulatedDevice
from mpmbench.plan import build_plan
from mpmbench.reference import Nodes
from mpmbench.simt import codegen, numpy_exec, ptx
from mpmbench.variants import Variant, resolve_axes, why_impossible

SHAPE = (8, 6, 7)
# Float32 and float64, all splines, both payloads, layouts, writings and cell indices, for an old and a new GPU.
AXES: list[tuple[str, dict[str, Any]]] = [
    ("sm_52", {}),
    ("sm_52", {"dtype": "float64", "spline": "quadratic", "payload": "apic", "layout": "aos", "writing": "literal"}),
    ("sm_90", {"spline": "linear", "weights": "plain", "batching": 2, "cell_index": "block", "blocks": "all"}),
    ("sm_90", {"payload": "apic", "spline": "quadratic", "particle_order": "index", "block_shape": (4, 4, 4)}),
]


def dataset() -> Dataset:
    """40 particles, a third of them in one cell: crowded and lonely cells, partly filled warps."""
    rng = np.random.default_rng(11)
    position = rng.uniform(1.05, [5.9, 3.9, 4.9], (40, 3))
    position[:13] = rng.uniform(2.1, 2.9, (13, 3))
    return Dataset.from_arrays(
        position,
        rng.normal(size=(40, 3)),
        mass=rng.uniform(0.5, 2, 40),
        affine=rng.normal(size=(40, 3, 3)),
        grid_shape=SHAPE,
        dx=1.0,
        origin=(0, 0, 0),
    )


def settle(variant: Variant, given: dict[str, Any]) -> dict[str, Any] | None:
    """The axes of ``given`` that the variant has; None where they cannot be combined.

    Where nodes pull, each looks through all cells of a support: cubic supports take the oracle most of a minute.
    """
    if variant.name == "p2g_block_pull":
        given = {"spline": "linear"} | given
    axes = resolve_axes(variant, {name: value for name, value in given.items() if name in variant.axes})
    return None if why_impossible(variant, axes) else axes


def nodes() -> Nodes:
    rng = np.random.default_rng(12)
    return Nodes(rng.uniform(0, 2, SHAPE), rng.normal(size=(*SHAPE, 3)))


class RecordingDevice(SimulatedDevice):
    """Keeps the PTX of what it is asked to compile."""

    def __init__(self, arch: str, mode: str) -> None:
        super().__init__(arch, mode)
        self.texts: dict[str, str] = {}

    def _compile(self, ptx_text: str) -> Any:
        self.texts[str(len(self.texts))] = ptx_text
        return super()._compile(ptx_text)


def run_variant(variant: Variant, device: SimulatedDevice, axes: dict[str, Any]):
    """-> result arrays, and the counters of each step in order."""
    plan = build_plan(variant, dataset(), device, axes, nodes=nodes() if variant.transfer == "g2p" else None)
    before, transfer, after = plan.run_once(device)
    outputs = plan.outputs()
    arrays = [value for value in vars(outputs).values() if value is not None]
    return arrays, {"transfer": transfer.counters} | {
        name: report.counters for name, report in (*before.items(), *after.items())
    }


@pytest.mark.parametrize("arch_and_axes", AXES, ids=lambda pair: f"{pair[0]} {' '.join(map(str, pair[1].values()))}")
@pytest.mark.parametrize("variant", variants.discover(), ids=lambda variant: variant.name)
def test_engine_and_oracle_agree_on_a_strategy(variant, arch_and_axes):
    arch, given = arch_and_axes
    axes = settle(variant, given)
    if axes is None:
        pytest.skip("these axes cannot be combined")
    oracle = RecordingDevice(arch, "oracle")
    want, want_counters = run_variant(variant, oracle, axes)
    got, got_counters = run_variant(variant, SimulatedDevice(arch, "count"), axes)
    tolerance = 2e-5 if axes["dtype"] == "float32" else 1e-12
    for a, b in zip(got, want, strict=True):  # equal up to the order in which atomics add
        np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance)
    assert got_counters == want_counters
    for text in oracle.texts.values():
        module = ptx.parse(text)
        numbers = {name: number for number, name in enumerate(module.variables)}
        for kernel in module.kernels.values():
            numpy_exec.check_supported(kernel, module)
            codegen.generate(kernel, numbers, "run", 16)
