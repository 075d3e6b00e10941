"""Contests: who is compared with whom, what a wrong or missing row does to the others, and what records say of it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

from mpmbench import contest
from mpmbench.contest import Timing, baseline_of, contests, run_contest
from mpmbench.device import Launch, open_device
from mpmbench.device.cpu import CpuDevice
from mpmbench.environment import Environment
from mpmbench.errors import InputError
from mpmbench.measure import Sampling
from mpmbench.primitive_runs import primitive_cases
from mpmbench.primitives import get as get_primitive
from mpmbench.protocol.rounds import Arm, Rules, Sample
from mpmbench.record import Record, from_json, to_json
from mpmbench.runner import Case, DatasetChoice, Inputs, cases_of, resume_key
from mpmbench.session import run_session, shard
from mpmbench.variants import get, resolve_axes

ENVIRONMENT = Environment.capture(argv=[])
BOX = DatasetChoice("random", particles=200, grid_shape=(12, 12, 12))
SHORT = Sampling(min_samples=2, max_samples=2, warmup_seconds=0, warmup_limit=0)
RULES = Rules(min_rounds=5, max_rounds=5, warmup_seconds=0, warmup_limit=0)
TIMING = Timing(rules=RULES, sampling=SHORT)


def case(variant: str, dataset: DatasetChoice = BOX, **axes: Any) -> Case:
    found = get(variant)
    return Case(found, dataset, resolve_axes(found, axes))


ATOMIC, SORTED = case("p2g_global_atomic"), case("p2g_global_atomic", particle_order="deep")
SYNC = case("p2g_block_sync")


@dataclass
class Scripted:
    """Runs arms for real and reports what a script says they took [s], by the beginning of their label."""

    seconds: dict[str, float]
    default: float = 1e-3
    sampled: list[str] = field(default_factory=list)

    def sample(self, arm: Arm) -> Sample:
        arm.prepare()
        arm.run()
        self.sampled.append(arm.name)
        name = arm.name.removesuffix(" again")
        return Sample(self.seconds.get(name, self.default), 1.5e9)

    def now(self) -> float:
        return 0.0

    def pause(self, seconds: float) -> None:
        pass

    def trouble(self) -> str:
        return ""


@pytest.fixture(scope="module")
def cpu() -> Any:
    return open_device("cpu", arch="sm_52")


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Scripted:
    scripted = Scripted({"p2g_global_atomic": 4e-3, "p2g_global_atomic particle_order=deep": 2e-3})
    monkeypatch.setattr(contest, "clock_of", lambda device, cache: scripted)
    return scripted


def run(cases: list[Any], device: Any, timing: Timing = TIMING, **options: Any) -> list[Record]:
    return list(run_contest(cases, device, Inputs(), ENVIRONMENT, timing, **options))


# --- who is compared with whom ----------------------------------------------------------------------------------------


def test_cases_of_one_question_are_together() -> None:
    other = replace(BOX, particles=100)
    elsewhere, otherwise = case("p2g_block_sync", other), case("p2g_block_sync", spline="linear")
    batched = case("p2g_block_sync", batching=2)
    cases = [ATOMIC, case("g2p_global_gather"), SYNC, elsewhere, otherwise, SORTED, batched]
    found = contests(cases, Inputs())
    assert [[c.label for c in group] for group in found] == [
        ["p2g_global_atomic", "p2g_block_sync", "p2g_global_atomic particle_order=deep", "p2g_block_sync batching=2"],
        ["g2p_global_gather"],
        ["p2g_block_sync"],
        ["p2g_block_sync"],
    ]


def test_primitives_of_one_input_are_together() -> None:
    cases = primitive_cases([get_primitive("scan_lookback"), get_primitive("scan_sequential")], {}, 1000, 1)
    assert len(contests(cases, Inputs())) == 1
    assert len(contests([*cases, *primitive_cases([get_primitive("scan_lookback")], {}, 999, 1)], Inputs())) == 2


def test_the_baseline_is_the_plainest_wherever_it_stands() -> None:
    plain_weights = case("p2g_global_atomic", weights="plain")
    assert baseline_of([SYNC, SORTED, plain_weights, ATOMIC]) is ATOMIC
    assert baseline_of([SYNC, SORTED]) is SYNC, "without a plain one the first"


def test_the_baseline_can_be_named() -> None:
    assert baseline_of([ATOMIC, SORTED, SYNC], "p2g_block_sync") is SYNC
    assert baseline_of([SORTED, ATOMIC, SYNC], "p2g_global_atomic") is ATOMIC, "the whole label comes first"
    assert baseline_of([SORTED, SYNC], "p2g_global_atomic") is SORTED
    assert baseline_of([ATOMIC, SORTED, SYNC], "p2g_global_atomic particle_order=deep") is SORTED


# --- what records say -------------------------------------------------------------------------------------------------


def test_rows_of_a_contest_are_paired(cpu: Any, clock: Scripted) -> None:
    records = run([SYNC, ATOMIC, SORTED], cpu)
    assert [r.variant for r in records] == ["p2g_global_atomic", "p2g_block_sync", "p2g_global_atomic"]
    base, sync, deep = records
    for record in records:
        assert record.status == "ok"
        assert record.cache == "cold"
        assert record.transfer_measurement is not None
        assert len(record.transfer_measurement.samples) == 20
        assert record.transfer_measurement.hertz == (1.5e9,) * 20
        assert record.transfer_measurement.stopped_by == "verdict"
        assert record.comparison is not None
        assert from_json(to_json(record)) == record
    assert len({r.comparison.contest for r in records if r.comparison}) == 1
    assert base.comparison is not None
    assert base.comparison.is_baseline
    assert base.comparison.speedup is None
    assert sync.comparison is not None
    assert (sync.comparison.baseline, sync.comparison.verdict) == ("p2g_global_atomic", "FAST")
    assert sync.comparison.speedup == pytest.approx((4, 4, 4))
    assert deep.comparison is not None
    assert deep.comparison.speedup == pytest.approx((2, 2, 2))
    assert [bool(r.comparison and r.comparison.leads) for r in records] == [False, True, False]


def test_steps_around_the_transfer_are_timed_too(cpu: Any, clock: Scripted) -> None:
    (record,) = run([SORTED], cpu)
    assert list(record.preprocess) == ["binning", "scan", "sort_deep", "grid_clear"]
    assert all(cost.measurement and len(cost.measurement.samples) == 2 for cost in record.preprocess.values())


def test_a_wrong_strategy_is_a_row_without_time_and_the_others_go_on(
    cpu: Any, clock: Scripted, monkeypatch: pytest.MonkeyPatch
) -> None:
    launch = CpuDevice.launch

    def spoilt(self: Any, one: Launch) -> Any:
        report = launch(self, one)
        if one.name == "p2g_block_sync":
            one.args[-1][...] *= 0.9
        return report

    monkeypatch.setattr(CpuDevice, "launch", spoilt)
    records = run([ATOMIC, SYNC, SORTED], cpu)
    by_name = {r.variant: r for r in records}
    assert by_name["p2g_block_sync"].status == "wrong"
    assert by_name["p2g_block_sync"].transfer_measurement is None
    assert records[0].variant == "p2g_block_sync", "it is known first"
    assert [r.status for r in records[1:]] == ["ok", "ok"]
    assert not any(name.startswith("p2g_block_sync") for name in clock.sampled), "a wrong strategy is never sampled"


def test_a_wrong_baseline_hands_its_place_on(cpu: Any, clock: Scripted, monkeypatch: pytest.MonkeyPatch) -> None:
    launch = CpuDevice.launch

    def spoilt(self: Any, one: Launch) -> Any:
        report = launch(self, one)
        if one.name == "p2g_global_atomic":
            one.args[-1][...] *= 0.9
        return report

    monkeypatch.setattr(CpuDevice, "launch", spoilt)
    wrong, sync = run([ATOMIC, SYNC], cpu)
    assert (wrong.status, wrong.cache) == ("wrong", "cold")
    assert sync.comparison is not None
    assert sync.comparison.baseline == "p2g_block_sync"


def test_what_cannot_exist_is_a_skipped_row(cpu: Any, clock: Scripted) -> None:
    records = run([ATOMIC, case("p2g_global_node", writing="hoisted")], cpu)
    assert [(r.status, r.cache) for r in records] == [("skipped", "cold"), ("ok", "cold")]


def test_a_strategy_that_lost_all_samples_says_throttled(cpu: Any, clock: Scripted) -> None:
    sample = clock.sample

    def throttled(arm: Arm) -> Sample:
        taken = sample(arm)
        return taken._replace(discard="slow clock") if arm.name.startswith("p2g_block_sync") else taken

    clock.sample = throttled  # type: ignore[method-assign]
    base, sync = run([ATOMIC, SYNC], cpu)
    assert base.status == "ok"
    assert sync.status == "broken"
    assert "THROTTLED" in (sync.failed_because or "")
    assert sync.comparison is None


# --- memory -----------------------------------------------------------------------------------------------------------


def test_what_does_not_fit_together_is_timed_in_batches(
    cpu: Any, clock: Scripted, monkeypatch: pytest.MonkeyPatch
) -> None:
    cases = [ATOMIC, SORTED, SYNC, case("p2g_block_sync", batching=2)]
    inputs = Inputs()
    two = ATOMIC.device_bytes(inputs) + max(c.device_bytes(inputs) for c in cases[1:])
    monkeypatch.setattr(CpuDevice, "free_bytes", (two + 10) / contest.FILLED, raising=False)
    records = run(cases, cpu)
    assert [r.status for r in records] == ["ok"] * 4
    names = [r.comparison.contest for r in records if r.comparison]
    assert len(set(names)) == 3, "the baseline and one other at a time"
    assert all(r.comparison and r.comparison.baseline == "p2g_global_atomic" for r in records)
    assert [r.variant for r in records].count("p2g_global_atomic") == 2, "the baseline has one row"


# --- resume -----------------------------------------------------------------------------------------------------------


def test_known_rows_are_not_made_again_but_the_baseline_is_timed_beside_missing_ones(cpu: Any, clock: Scripted) -> None:
    records = run([ATOMIC, SORTED, SYNC], cpu, known=[ATOMIC, SORTED])
    assert [r.variant for r in records] == ["p2g_block_sync"]
    assert records[0].comparison is not None
    assert records[0].comparison.baseline == "p2g_global_atomic"
    assert set(clock.sampled) == {"p2g_global_atomic", "p2g_global_atomic again", "p2g_block_sync"}


def test_nothing_missing_runs_nothing(cpu: Any, clock: Scripted) -> None:
    assert run([ATOMIC, SYNC], cpu, known=[ATOMIC, SYNC]) == []
    assert clock.sampled == []


def test_a_session_keeps_rows_by_cache_state(cpu: Any, clock: Scripted) -> None:
    cold, hot = TIMING, replace(TIMING, cache="hot")
    first = [record for record, new in run_session([ATOMIC, SYNC], [cpu], [cold]) if new]
    again = list(run_session([ATOMIC, SYNC], [cpu], [cold, hot], known=first))
    assert [(r.cache, new) for r, new in again] == [("cold", False)] * 2 + [("hot", True)] * 2
    assert {(resume_key(r), r.cache) for r, _ in again} == {
        (c.resume_key(cpu, Inputs()), cache) for c in (ATOMIC, SYNC) for cache in ("cold", "hot")
    }


def test_a_session_without_timings_only_checks(cpu: Any, clock: Scripted) -> None:
    ((record, new),) = run_session([ATOMIC], [cpu])
    assert new
    assert record.status == "ok"
    assert record.transfer_measurement is None


# --- shards -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("together", [True, False])
@pytest.mark.parametrize("parts", [1, 2, 3, 7])
def test_shards_hold_every_case_once(parts: int, together: bool) -> None:
    cases = cases_of([get("p2g_block_sync"), get("g2p_global_gather")], [BOX, replace(BOX, particles=9)],
                     {"spline": ["cubic", "linear"]})  # fmt: skip
    found = [c for part in range(parts) for c in shard(cases, f"{part + 1}/{parts}", together)]
    assert sorted(map(id, found)) == sorted(map(id, cases))


def test_what_is_timed_together_stays_in_one_shard() -> None:
    parts = [shard([ATOMIC, case("g2p_global_gather"), SYNC], f"{i}/2", True) for i in (1, 2)]
    assert [[c.name for c in part] for part in parts] == [
        ["p2g_global_atomic", "p2g_block_sync"],
        ["g2p_global_gather"],
    ]


@pytest.mark.parametrize("text", ["0/2", "3/2", "1", "a/b", "1/0", "-1/2", ""])
def test_a_shard_that_does_not_exist_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="i/n"):
        shard([ATOMIC], text, True)


# --- cache states -----------------------------------------------------------------------------------------------------


def logged(cpu: Any, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    said: list[str] = []
    launch: Callable[[Any, Launch], Any] = CpuDevice.launch

    def say(self: Any, one: Launch) -> Any:
        said.append(one.name)
        return launch(self, one)

    monkeypatch.setattr(CpuDevice, "launch", say)
    return said


@pytest.mark.parametrize("variant", ["p2g_global_atomic", "p2g_block_sync", "g2p_global_gather", "g2p_block_gather"])
@pytest.mark.parametrize("order", ["index", "deep"])
def test_a_step_runs_whole_around_each_sample(
    cpu: Any, monkeypatch: pytest.MonkeyPatch, variant: str, order: str
) -> None:
    made = case(variant, particle_order=order).prepare(cpu, Inputs(), ENVIRONMENT, "step")
    assert not isinstance(made, Record)
    said = logged(cpu, monkeypatch)
    arm = made.arm(cpu)
    arm.prepare()
    arm.run()
    if variant.startswith("p2g"):
        assert said == ["grid_divide", "g2p_global_gather", "grid_clear", variant]
    else:
        assert said == ["grid_clear", "p2g_global_atomic", "grid_divide", variant]
    result = made.outputs()
    again = case(variant, particle_order=order).prepare(cpu, Inputs(), ENVIRONMENT)
    assert not isinstance(again, Record)
    for ours, expected in zip(contest._arrays(result), contest._arrays(again.outputs()), strict=True):
        np.testing.assert_allclose(ours, expected, rtol=1e-4, atol=1e-5 * np.abs(expected).max())


def test_the_rest_of_a_step_is_in_the_record(cpu: Any, clock: Scripted) -> None:
    (p2g,) = run([SORTED], cpu, replace(TIMING, cache="step"))
    assert list(p2g.rest_of_step) == ["grid_clear", "grid_divide", "g2p_global_gather"]
    (g2p,) = run([case("g2p_block_gather")], cpu, replace(TIMING, cache="step"))
    assert list(g2p.rest_of_step) == ["grid_clear", "p2g_global_atomic", "grid_divide"]
    assert g2p.cache == "step"


def test_particles_and_nodes_of_a_step_are_one_copy(cpu: Any) -> None:
    made = SORTED.prepare(cpu, Inputs(), ENVIRONMENT, "step")
    assert not isinstance(made, Record)
    transfer, gather = made.transfer.launches[0], made.rest.step[-1].launches[0]
    assert any(a is b for a in transfer.args for b in gather.args if isinstance(a, np.ndarray) and a.size > 200)


def test_an_unknown_cache_state_is_refused() -> None:
    with pytest.raises(InputError, match="cold, hot, step"):
        Timing(cache="warm")


# --- run to run -------------------------------------------------------------------------------------------------------


def test_two_runs_are_compared_bit_by_bit(cpu: Any, clock: Scripted, monkeypatch: pytest.MonkeyPatch) -> None:
    (record,) = run([ATOMIC], cpu)
    assert record.repeat is not None
    assert (record.repeat.differing, record.repeat.of, record.repeat.largest) == (0, 4 * 12**3, 0.0)
    launch, calls = CpuDevice.launch, [0]

    def wavering(self: Any, one: Launch) -> Any:
        report = launch(self, one)
        if one.name == "p2g_global_atomic":
            calls[0] += 1
            if calls[0] % 2:
                array = one.args[-1]
                place = np.unravel_index(np.argmax(np.abs(array)), array.shape)
                array[place] = np.nextafter(array[place], np.float32(math.inf))
        return report

    monkeypatch.setattr(CpuDevice, "launch", wavering)
    (record,) = run([ATOMIC], cpu)
    assert record.repeat is not None
    assert record.repeat.differing == 1
    assert 0 < record.repeat.largest < 2e-7
