"""The search for each strategy's best axes: what it tries, what it chooses, and what its row keeps of it."""

from __future__ import annotations

import itertools
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from fake_cupy import FakeGpu, fake_cupy, on_the_engine
from profiled import modelled_time, profile, record

from mpmbench import measure, tuning, variants
from mpmbench import profile as engine
from mpmbench.cli import main
from mpmbench.errors import InputError
from mpmbench.gpu import get_gpu
from mpmbench.protocol import rounds
from mpmbench.record import Check, Comparison, Measurement, Record, Tried, from_json, read_records, to_json
from mpmbench.report.modelled import gpu_groups
from mpmbench.runner import Case, DatasetChoice
from mpmbench.variants import resolve_axes, why_impossible


def case(name: str = "p2g_block_sync", dataset: str = "one_cell", **axes: Any) -> Case:
    variant = variants.get(name)
    return Case(variant, DatasetChoice(dataset, particles=60), resolve_axes(variant, axes))


def searched(budget: int = 12, fixed: tuple[str, ...] = (), **about: Any) -> tuple[Case, tuning.Search]:
    (found,) = tuning.to_search([case(**about)], budget, fixed)
    assert found.search is not None
    return found, found.search


def rows(search: tuning.Search, *seconds: float | None) -> list[Record]:
    """A modelled row for each configuration; None: a wrong result."""
    found = []
    for axes, time in zip(search.configurations, seconds, strict=True):
        profiles = () if time is None else (profile(modelled_time("gtx970", "issue", time)),)
        check = Check(time is not None, 3e-6, 1e-6)
        found.append(record("p2g_block_sync", profiles, axes=axes, default_axes=case().axes, check=check))
    return found


# --- what is tried ----------------------------------------------------------------------------------------------------


def test_the_default_comes_first_and_the_budget_is_held() -> None:
    for budget in (1, 5, 12):
        found, search = searched(budget)
        assert search.configurations[0] == found.axes
        assert len(search.configurations) == budget
        assert (search.free, search.budget, search.possible) == (("block_shape", "batching"), budget, 36)


def test_all_are_tried_where_the_budget_has_room() -> None:
    _, search = searched(100)
    tried = {tuple(axes.items()) for axes in search.configurations}
    assert len(tried) == len(search.configurations) == search.possible == 36


def test_a_spread_uses_all_values_about_equally() -> None:
    _, search = searched(12)
    for name, most in (("batching", 3), ("block_shape", 2)):
        times = Counter(axes[name] for axes in search.configurations)
        assert max(times.values()) == most
        assert max(times.values()) - min(times.values()) <= 1
    assert len({axes["block_shape"] for axes in search.configurations}) == 9


def test_the_same_search_every_time() -> None:
    assert searched(9)[1] == searched(9)[1]
    assert searched(5)[1].configurations == searched(9)[1].configurations[:5], "more budget only adds"


def test_fixed_axes_stay() -> None:
    found, search = searched(12, ("batching",), batching=4)
    assert search.free == ("block_shape",)
    assert {axes["batching"] for axes in search.configurations} == {4}
    assert len(search.configurations) == search.possible == 9
    assert found.axes["batching"] == 4


def test_what_cannot_exist_is_no_try() -> None:
    _, search = searched(12, name="p2g_block_pull", payload="apic", dtype="float64")
    variant = variants.get("p2g_block_pull")
    assert search.possible == len(search.configurations) > 1
    assert not any(why_impossible(variant, axes) for axes in search.configurations)
    assert (8, 4, 4) not in {axes["block_shape"] for axes in search.configurations}, "the default does not fit"


def test_where_nothing_can_exist_the_row_says_why() -> None:
    big = {"block_shape": (16, 16, 8), "name": "p2g_block_sync"}
    _, search = searched(12, ("block_shape",), **big)
    assert (search.possible, len(search.configurations)) == (0, 1)


@pytest.mark.parametrize(
    ("name", "axes", "free"),
    [
        ("p2g_global_atomic", {}, ()),
        ("p2g_global_atomic", {"particle_order": "deep"}, ()),
        ("p2g_global_atomic", {"particle_order": "deep", "cell_index": "block"}, ("block_shape",)),
        ("p2g_global_atomic", {"cell_index": "block"}, ()),
        ("g2p_global_gather", {}, ("batching",)),
        ("g2p_block_gather", {}, ("block_shape", "batching")),
    ],
)
def test_axes_that_change_nothing_are_not_searched(name: str, axes: dict[str, Any], free: tuple[str, ...]) -> None:
    assert tuning.free_axes(variants.get(name), case(name, **axes).axes, ()) == free


def test_nothing_to_search_is_an_error() -> None:
    with pytest.raises(InputError, match="nothing to search"):
        tuning.to_search([case("p2g_global_atomic")], 12, ())
    with pytest.raises(InputError, match="nothing to search"):
        tuning.to_search([case()], 12, ("batching", "block_shape"))


# --- what is chosen ---------------------------------------------------------------------------------------------------


def test_the_fastest_wins_and_the_losers_follow_by_time() -> None:
    _, search = searched(4)
    best, found = tuning.choose(search, rows(search, 4e-3, 3e-3, 1e-3, 2e-3), "modelled", "gtx970")
    assert best == 2
    assert [one.seconds for one in found.tried] == pytest.approx([1e-3, 2e-3, 3e-3, 4e-3])
    assert found.tried[0].axes == {name: search.configurations[2][name] for name in search.free}
    assert (found.kind, found.gpu, found.budget, found.possible) == ("modelled", "gtx970", 4, 36)


def test_ties_go_to_the_default() -> None:
    _, search = searched(3)
    best, found = tuning.choose(search, rows(search, 2e-3, 2e-3, 1.995e-3), "modelled", "gtx970")
    assert best == 0, "a quarter of a percent is no difference"
    assert found.tried[0].axes["block_shape"] == (8, 4, 4)
    assert found.tried[1].seconds == pytest.approx(1.995e-3)


def test_a_wrong_result_is_recorded_and_never_chosen() -> None:
    _, search = searched(3)
    for wrong_ones in itertools.product((True, False), repeat=3):
        times = [None if bad else time for bad, time in zip(wrong_ones, (3e-3, 2e-3, 1e-3), strict=True)]
        best, found = tuning.choose(search, rows(search, *times), "modelled", "gtx970")
        good = [place for place in range(3) if not wrong_ones[place]]
        assert best == (good[-1] if good else 0)
        reasons = [one.reason for one in found.tried if one.seconds is None]
        assert reasons == ["wrong: error 3 x allowed"] * sum(wrong_ones)
        assert all(one.seconds is None for one in found.tried[len(good) :]), "failures come last"


def test_a_failure_is_recorded_and_never_chosen() -> None:
    _, search = searched(2)
    slow, broken = rows(search, 3e-3, 1e-3)
    best, found = tuning.choose(search, [slow, replace(broken, failed_because="it broke")], "modelled", "gtx970")
    assert best == 0
    assert (found.tried[1].seconds, found.tried[1].reason) == (None, "broken: it broke")
    assert not tuning.wrong(replace(slow, tuning=found))


def test_a_record_with_a_search_survives_json() -> None:
    _, search = searched(3)
    records = rows(search, 2e-3, 1e-3, None)
    best, found = tuning.choose(search, records, "modelled", "gtx970")
    whole = replace(records[best], tuning=found)
    assert from_json(to_json(whole)) == whole
    assert [one.seconds for one in tuning.wrong(whole)] == [None]


def measured(axes: Any, seconds: float, speedup: float | None, margin: float) -> Record:
    """A row of a contest whose baseline is the default."""
    interval = None if speedup is None else (speedup, speedup - 0.5, speedup + 0.5)
    compared = Comparison(
        "c", "p2g_block_sync", speedup is None, "AMBG", interval, True, (1, 0.9, 1.1), margin, 1, 0.99, 8, 1
    )
    plain = record("p2g_block_sync", axes=axes, default_axes=case().axes, preprocess={}, transfer_counters=None)
    time = Measurement((seconds,), "cold", 1, "round limit")
    return replace(plain, device="cuda:0", transfer_measurement=time, comparison=compared)


@pytest.mark.parametrize(("margin", "place"), [(0.05, 1), (0.2, 0)])
def test_in_rounds_a_difference_is_one_that_two_copies_of_the_baseline_do_not_show(margin: float, place: int) -> None:
    _, search = searched(2)
    first, second = search.configurations
    found = [measured(first, 1.1e-3, None, margin), measured(second, 1.0e-3, 1.1, margin)]
    assert tuning.choose(search, found, "measured (events)")[0] == place


def test_rounds_pair_what_drifts() -> None:
    _, search = searched(2)
    first, second = search.configurations
    found = [measured(first, 1.0e-3, None, 0.01), measured(second, 1.2e-3, 1.1, 0.01)]
    assert tuning.choose(search, found, "measured (events)")[0] == 1, "pass by pass it was faster"


# --- named GPUs -------------------------------------------------------------------------------------------------------


def quiet(what: str, done: int, total: int) -> None:
    pass


@pytest.fixture
def made_up(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, Any]]:
    """Times from a rule in the place of the engine: gtx970 likes batching 4, a100 small blocks. Holds what ran."""
    ran: list[tuple[str, Any]] = []

    def run(one: Case, model: Any, inputs: Any, environment: Any) -> Record:
        gpu = model.gpu.name
        ran.append((gpu, one.axes))
        time = abs(one.axes.get("batching", 1) - 4) + 1 if gpu == "gtx970" else one.axes["block_shape"][0]
        made = record(one.name, (profile(modelled_time(gpu, "issue", 1e-3 * time)),), axes=one.axes)
        summary = tuning.Inputs().select(one.dataset)
        dataset = replace(made.dataset, fingerprint=summary.fingerprint)
        return replace(made, arch=model.gpu.arch, dataset=dataset)

    monkeypatch.setattr(engine, "run_modelled", run)
    return ran


def test_every_gpu_has_its_own_winner(made_up: list[Any]) -> None:
    cases, gpus = tuning.to_search([case()], 6, ()), [get_gpu("gtx970"), get_gpu("a100")]
    told: list[tuple[str, int, int]] = []
    found = tuning.model_tuned(cases, gpus, lambda *words: told.append(words))
    assert [list(one.modelled or ()) for one in found] == [["gtx970"], ["a100"]]
    assert [one.tuning.gpu for one in found if one.tuning] == ["gtx970", "a100"]
    assert found[0].axes["batching"] == 4
    assert found[1].axes["block_shape"] == (3, 5, 2)
    assert len(made_up) == 2 * 6, "each configuration once, the winner not again"
    assert told[2][0].startswith("gtx970: tuning p2g_block_sync 3/6")
    assert [done for _, done, _ in told] == list(range(13))
    assert {total for *_, total in told} == {12}


def test_a_report_shows_every_gpu_with_what_was_tuned_for_it(made_up: list[Any]) -> None:
    gpus = [get_gpu(name) for name in ("h100", "h200")]
    found = tuning.model_tuned(tuning.to_search([case()], 2, ()), gpus, quiet)
    assert found[0].arch == found[1].arch
    assert found[0].axes == found[1].axes
    assert [group.gpu for group in gpu_groups(found)] == ["h100", "h200"]


def test_known_searches_are_not_repeated(made_up: list[Any]) -> None:
    gpus = [get_gpu("gtx970"), get_gpu("a100")]
    known = tuning.model_tuned(tuning.to_search([case()], 3, ()), gpus, quiet)
    made_up.clear()
    kept: list[Record] = []
    again = tuning.model_tuned(tuning.to_search([case()], 3, ()), gpus, quiet, kept.append, known)
    assert (again, kept, made_up) == (known, [], [])
    for budget, fixed, axes in ((4, (), {}), (3, ("batching",), {}), (3, (), {"layout": "aos"})):
        tuning.model_tuned(tuning.to_search([case(**axes)], budget, fixed), gpus[:1], quiet, kept.append, known)
        assert len(kept) == 1, "another search is another row"
        kept.clear()


def test_a_modelled_search_end_to_end(tmp_path: Path) -> None:
    path = tmp_path / "rows.jsonl"
    words = ["run", "--gpu", "gtx970", "-b", "p2g_block_sync", "--dataset", "one_cell", "--particles", "60", "--tune",
             "2", "-a", "block_shape=4x4x4", "--json", str(path), "--md", str(tmp_path / "report.md")]  # fmt: skip
    result = CliRunner().invoke(main, words)
    assert result.exit_code == 0, result.output
    (found,) = read_records(path)
    assert found.tuning is not None
    assert found.modelled is not None
    assert {one.axes["batching"] for one in found.tuning.tried} == {1, 2}
    assert found.tuning.tried[0].axes["batching"] == found.axes["batching"]
    assert found.tuning.tried[0].seconds == found.modelled["gtx970"].time.seconds
    before = path.read_bytes()
    assert CliRunner().invoke(main, [*words, "--resume"]).exit_code == 0
    assert path.read_bytes() == before


# --- devices that keep time -------------------------------------------------------------------------------------------

QUICK_RUN = ["run", "-d", "cuda", "--quick", "--dataset", "one_cell", "--particles", "60", "--tune", "2"]
BOTH = ["-b", "p2g_block_sync", "-b", "p2g_global_atomic"]


class Times(dict):
    """Seconds by kernel; for p2g_block_sync by the threads of the thread block that has just run."""

    threads = 0

    def get(self, name: str, default: Any = None) -> Any:
        return super().get(f"{name} {self.threads}", super().get(name, default))


@pytest.fixture(scope="module")
def run() -> Any:
    """Compiles each kernel once for all tests."""
    return on_the_engine()


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch, run: Any) -> FakeGpu:
    """A GPU on which a block of 4x4x4 (64 threads) is the faster one."""
    times = Times({"p2g_block_sync 64": 0.002, "p2g_block_sync 128": 0.004})

    def execute(ptx: str, name: str, grid: Any, block: Any, arguments: Any, shared_bytes: int) -> None:
        run(ptx, name, grid, block, arguments, shared_bytes)
        times.threads = block[0] * block[1] * block[2]
        if (name, times.threads) in spoiled:
            arguments[-1][...] = 0

    spoiled: set[tuple[str, int]] = set()
    machine = FakeGpu(capability="90", execute=execute, seconds=times)
    machine.spoiled = spoiled  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "cupy", fake_cupy(machine))
    monkeypatch.setattr(measure, "QUICK", measure.Sampling(min_samples=2, max_samples=2, warmup_limit=0))
    monkeypatch.setattr(rounds, "QUICK", rounds.Rules(min_rounds=2, max_rounds=2, warmup_limit=0))
    return machine


def invoke(path: Path, *words: str, code: int = 0) -> tuple[str, dict[str, Record]]:
    result = CliRunner().invoke(main, [*QUICK_RUN, *words, "--json", str(path)])
    assert result.exit_code == code, result.output
    return result.output, {one.variant: one for one in read_records(path)} if path.exists() else {}


def test_the_contest_is_between_the_winners(gpu: FakeGpu, tmp_path: Path) -> None:
    _, found = invoke(tmp_path / "rows.jsonl", *BOTH)
    sync = found["p2g_block_sync"]
    assert sync.axes["block_shape"] == (4, 4, 4)
    assert sync.transfer_measurement is not None
    assert sync.transfer_measurement.median == pytest.approx(0.002)
    assert sync.tuning is not None
    assert (sync.tuning.kind, sync.tuning.gpu) == ("measured (events)", None)
    assert [one.axes for one in sync.tuning.tried] == [
        {"block_shape": (4, 4, 4), "batching": 2}, {"block_shape": (8, 4, 4), "batching": 1},
    ]  # fmt: skip
    assert [one.seconds for one in sync.tuning.tried] == pytest.approx([0.002, 0.004])
    plain = found["p2g_global_atomic"]
    assert plain.comparison is not None
    assert plain.comparison.is_baseline
    assert plain.tuning is not None
    assert [one.axes for one in plain.tuning.tried] == [{}], "nothing is free: the only one there is"


def test_a_baseline_that_is_asked_for_is_tuned_too(gpu: FakeGpu, tmp_path: Path) -> None:
    _, found = invoke(tmp_path / "rows.jsonl", *BOTH, "--baseline", "p2g_block_sync")
    compared = found["p2g_global_atomic"].comparison
    assert compared is not None
    assert compared.baseline == "p2g_block_sync block_shape=4x4x4 batching=2"


def test_equal_times_leave_the_default(gpu: FakeGpu, tmp_path: Path) -> None:
    gpu.seconds["p2g_block_sync 64"] = 0.004
    _, found = invoke(tmp_path / "rows.jsonl", "-b", "p2g_block_sync")
    assert found["p2g_block_sync"].axes["block_shape"] == (8, 4, 4)


def test_a_wrong_configuration_is_told_and_loses(gpu: FakeGpu, tmp_path: Path) -> None:
    gpu.spoiled.add(("p2g_block_sync", 64))  # type: ignore[attr-defined]
    output, found = invoke(tmp_path / "rows.jsonl", "-b", "p2g_block_sync", code=4)
    sync = found["p2g_block_sync"]
    assert (sync.status, sync.axes["block_shape"]) == ("ok", (8, 4, 4))
    assert sync.tuning is not None
    assert sync.tuning.tried[1].reason.startswith("wrong: error")
    assert "tuning p2g_block_sync on one_cell block_shape=4x4x4 batching=2: wrong: error" in output


def test_resume_keeps_what_was_tuned(gpu: FakeGpu, tmp_path: Path) -> None:
    path, words = tmp_path / "rows.jsonl", [*BOTH, "--baseline", "p2g_block_sync"]
    invoke(path, *words)
    whole = path.read_bytes()
    gpu.calls.clear()
    invoke(path, *words, "--resume")
    assert path.read_bytes() == whole
    assert not gpu.details("kernel")
    (left,) = [line for line in whole.splitlines(keepends=True) if b'"variant":"p2g_block_sync"' in line]
    path.write_bytes(left)
    # The search of the row that is there is not repeated: it would find something else now.
    gpu.seconds["p2g_block_sync 64"] = 0.009
    invoke(path, *words, "--resume")
    assert path.read_bytes().startswith(left)
    kept, new = read_records(path)
    assert (kept.variant, new.variant) == ("p2g_block_sync", "p2g_global_atomic")
    assert new.comparison is not None
    assert new.comparison.baseline == "p2g_block_sync block_shape=4x4x4 batching=2"
    invoke(path, *BOTH, "--resume", "-a", "batching=2")
    assert [one.variant for one in read_records(path)] == ["p2g_block_sync", "p2g_global_atomic", "p2g_block_sync"]


# --- the command line -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--tune", "-d", "simulated"], "--tune needs times: name a GPU to model with --gpu, or a device that keeps"),
        (["--tune", "-d", "simulated", "-d", "cpu"], "--tune needs times"),
        (["--tune", "--preset", "demo", "-d", "cpu"], "--preset fixes every axis: leave out --tune"),
        (["--tune", "-b", "scan_shuffle", "-d", "cpu"], "--tune has nothing to search"),
        (["--tune", "0", "-d", "cpu"], "0 is not in the range x>=1"),
    ],
)
def test_bad_usage_is_one_line(words: list[str], message: str) -> None:
    result = CliRunner().invoke(main, ["run", *words])
    assert result.exit_code == 2, result.output
    assert message in result.output
    assert "Traceback" not in result.output


def test_a_dry_run_says_how_many(tmp_path: Path) -> None:
    words = ["run", "-b", "p2g_block_sync", "-b", "p2g_global_atomic", "--dry-run"]
    result = CliRunner().invoke(main, [*words, "-d", "cpu", "--tune"])
    assert "p2g_block_sync on uniform_cube, tuning: 12 of 36 configurations of block_shape, batching" in result.output
    assert "p2g_global_atomic on uniform_cube, tuning: 1 of 1 configurations" in result.output
    result = CliRunner().invoke(main, [*words, "--gpu", "h100", "--tune", "50", "-a", "batching=4"])
    assert "p2g_block_sync batching=4 on uniform_cube, tuning: 9 of 9 configurations of block_shape" in result.output


def test_tried_holds_the_searched_axes_alone() -> None:
    _, search = searched(1)
    _, found = tuning.choose(search, rows(search, 1e-3), "modelled", "gtx970")
    assert found.tried == (Tried({"block_shape": (8, 4, 4), "batching": 1}, 1e-3),)
