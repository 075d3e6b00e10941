"""Every strategy under pytest-benchmark.

    pytest tests/bench --benchmark-enable -o addopts=""

On a GPU the figures are event times: the timer is a clock that only events advance, so ``pedantic`` is the one mode
that works (auto-calibration would wait for a clock that stands still). Without a GPU the figure is the wall clock of
the simulated device on this CPU, in a group of its own that says so; what the kernel costs is in ``extra_info``.
"""

from __future__ import annotations

from dataclasses import asdict

import pytest

from mpmbench.device import open_device, run_all
from mpmbench.environment import Environment
from mpmbench.errors import InputError
from mpmbench.measure import DeviceClock
from mpmbench.plan import build_plan
from mpmbench.runner import Case, DatasetChoice, Inputs, check_outputs, run_case
from mpmbench.variants import discover, resolve_axes

DATASETS = [DatasetChoice("random", particles=20_000), DatasetChoice("uniform_cube", particles=20_000)]


def _cuda():
    try:
        return open_device("cuda")
    except InputError as error:
        pytest.skip(str(error))


@pytest.mark.parametrize("choice", DATASETS, ids=lambda choice: choice.name)
@pytest.mark.parametrize("variant", discover(), ids=lambda variant: variant.name)
@pytest.mark.benchmark(group="simulated device: wall clock of the engine on this CPU, not a GPU time")
def test_simulated(benchmark, variant, choice):
    device = open_device("simulated", mode="count")
    inputs = Inputs()
    case = Case(variant, choice, resolve_axes(variant, {}))
    record = run_case(case, device, inputs, Environment.capture(argv=[]))
    assert record.status == "ok"
    benchmark.extra_info |= {f"simulated_{k}": v for k, v in asdict(record.transfer_counters.total).items()}
    plan = _plan(case, device, inputs)
    plan.run_once(device)
    benchmark.pedantic(lambda: run_all(device, plan.transfer.launches), rounds=1, warmup_rounds=0)


@pytest.fixture
def device_clock():
    return DeviceClock(_cuda())


@pytest.mark.gpu
@pytest.mark.parametrize("choice", DATASETS, ids=lambda choice: choice.name)
@pytest.mark.parametrize("variant", discover(), ids=lambda variant: variant.name)
def test_cuda(request, device_clock, variant, choice):
    # The clock must be the benchmark's timer before the fixture is built, so the fixture is asked for here.
    request.node.add_marker(pytest.mark.benchmark(timer=device_clock, group="cuda: event time"))
    benchmark = request.getfixturevalue("benchmark")
    inputs = Inputs()
    case = Case(variant, choice, resolve_axes(variant, {}))
    plan = _plan(case, device_clock.device, inputs)
    plan.run_once(device_clock.device)
    assert check_outputs(plan.outputs(), variant.transfer, inputs, case.axes).passed
    benchmark.pedantic(
        lambda: device_clock.run(plan.transfer),
        setup=lambda: [run_all(device_clock.device, step.launches) for step in plan.reset()] and None,
        rounds=20,
        iterations=1,
        warmup_rounds=3,
    )


def _plan(case, device, inputs):
    dataset = inputs.select(case.dataset)
    nodes = inputs.rounded_nodes(case.axes) if case.variant.transfer == "g2p" else None
    return build_plan(case.variant, dataset, device, case.axes, nodes=nodes)
