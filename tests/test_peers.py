"""Peers on the cpu device: in our rounds, held to our reference; a wrong, missing or broken one gets a reason."""

from __future__ import annotations

import ctypes
import gc
import itertools
import json
import os
import subprocess
import sys
import weakref
from ctypes.util import find_library
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from mpmbench import contest, peer_runs, peers
from mpmbench.cli import main
from mpmbench.contest import Timing, baseline_of, contests, run_contest
from mpmbench.device import open_device
from mpmbench.device.cpu import CpuDevice
from mpmbench.environment import Environment
from mpmbench.measure import Sampling
from mpmbench.peer_runs import PeerCase, peer_cases
from mpmbench.peers import Library, Peer, PeerMissing, open_library
from mpmbench.protocol.rounds import Rules
from mpmbench.record import Record, from_json, read_records, to_json
from mpmbench.runner import Case, DatasetChoice, Inputs, refuse_bad_input, resume_key
from mpmbench.session import run_session
from mpmbench.spline import get_spline
from mpmbench.variants import get, resolve_axes

ENVIRONMENT = Environment.capture(argv=[])
BOX = DatasetChoice("random", particles=200, grid_shape=(12, 11, 13), dx=0.3, origin=(0.5, -1.0, 2.0))
TIMING = Timing(
    "hot",
    Rules(min_rounds=2, max_rounds=2, warmup_seconds=0, warmup_limit=0),
    Sampling(min_samples=2, max_samples=2, warmup_seconds=0, warmup_limit=0),
)


class Slow:
    """A peer in NumPy, right and of no speed."""

    version, facts = "1.2", {"fast_math": False}

    def _supports(self, grid: Any, count: int, particles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Node and weight of every particle in its support, (64, n)."""
        xi = (particles[:count, :3] - np.float32(grid.origin)) * np.float32(1 / grid.dx)
        bin_node = np.floor(xi).astype(int)
        weights = get_spline("cubic").weights(xi, bin_node)
        nx, ny, _ = grid.shape
        nodes, shares = [], []
        for k, j, i in itertools.product(range(4), repeat=3):
            x, y, z = (bin_node + np.array([i, j, k]) - 1).T
            nodes.append((z * ny + y) * nx + x)
            shares.append(weights[i, :, 0] * weights[j, :, 1] * weights[k, :, 2])
        return np.stack(nodes), np.stack(shares).astype(np.float32)

    def p2g(self, grid: Any, count: int, particles: np.ndarray, nodes: np.ndarray) -> Any:
        def run() -> None:
            node, weight = self._supports(grid, count, particles)
            mass = particles[:count, 3:]
            payload = np.concatenate([mass * particles[count : 2 * count, :3], mass], axis=1)
            np.add.at(nodes, node, weight[..., None] * payload)

        return run

    def g2p(self, grid: Any, count: int, particles: np.ndarray, velocities: np.ndarray, results: np.ndarray) -> Any:
        def run() -> None:
            node, weight = self._supports(grid, count, particles)
            results[:count] = (weight[..., None] * velocities[node]).sum(axis=0)

        return run


class Wrong(Slow):
    """Adds a thousandth too much."""

    def p2g(self, grid: Any, count: int, particles: np.ndarray, nodes: np.ndarray) -> Any:
        right = super().p2g(grid, count, particles, nodes)

        def run() -> None:
            right()
            nodes[:] *= np.float32(1.001)

        return run


class Crashing(Slow):
    def p2g(self, *arguments: Any) -> Any:
        def run() -> None:
            raise RuntimeError("unsupported\ninstruction")

        return run


def refuses() -> Any:
    raise OSError("libcuda.so: no such file")


def library(kind: Any = Slow, name: str = "slow", distribution: str = "") -> Library:
    return Library(name, name.title(), distribution, kind, Path(__file__))


def case(kind: Any = Slow, transfer: str = "p2g", dataset: DatasetChoice = BOX, **axes: Any) -> PeerCase:
    peer = Peer(library(kind), transfer)
    return PeerCase(peer, dataset, peers.resolve_axes(peer, axes))


def ours(variant: str, **axes: Any) -> Case:
    found = get(variant)
    return Case(found, BOX, resolve_axes(found, axes))


@pytest.fixture(scope="module")
def cpu() -> Any:
    return open_device("cpu", arch="sm_52")


def run(one: PeerCase, device: Any) -> Record:
    return one.run(device, Inputs(), ENVIRONMENT)


# --- the libraries ----------------------------------------------------------------------------------------------------


@pytest.fixture(params=peers.discover(), ids=lambda peer: peer.name)
def peer(request: pytest.FixtureRequest) -> Peer:
    """Each shipped peer whose library runs here."""
    try:
        open_library(request.param.library)
    except PeerMissing as reason:
        pytest.skip(str(reason))
    return request.param


@pytest.mark.parametrize("order", ["given", "deep"])
def test_libraries_agree_with_the_reference(peer: Peer, order: str, cpu: Any) -> None:
    record = run(PeerCase(peer, BOX, peers.resolve_axes(peer, {"particle_order": order})), cpu)
    assert record.status == "ok", record
    assert record.check is not None
    assert 0 < record.check.ratio <= 1


def test_libraries_take_no_particles_at_all(peer: Peer, cpu: Any) -> None:
    one = PeerCase(peer, replace(BOX, particles=0), peers.resolve_axes(peer, {}))
    assert run(one, cpu).status == "ok"


def test_libraries_keep_their_arrays_alive(peer: Peer) -> None:
    dataset = BOX.load()
    n, transfers = dataset.particle_count, open_library(peer.library)
    particles, nodes = np.zeros((2 * n, 4), np.float32), np.ones((dataset.grid.node_count, 4), np.float32)
    particles[:n, :3], particles[:n, 3] = dataset.position, dataset.mass
    results = np.zeros((n, 4), np.float32)
    arrays = (particles, nodes) if peer.transfer == "p2g" else (particles, nodes, results)
    last, held = arrays[-1], weakref.ref(arrays[-1])
    call = getattr(transfers, peer.transfer)(dataset.grid, n, *arrays)
    before = last.sum()
    del arrays, particles, nodes, results, last
    gc.collect()
    call()
    changed = held()
    assert changed is not None
    assert changed.sum() > before


def test_every_peer_is_found_and_none_is_imported() -> None:
    assert [peer.name for peer in peers.discover()] == [
        "peer_taichi_p2g", "peer_taichi_g2p", "peer_warp_p2g", "peer_warp_g2p",
    ]  # fmt: skip
    code = (
        "import sys; from mpmbench.peers import by_default, discover; discover(); by_default(['cpu']);"
        "print(sorted({'warp', 'taichi'} & set(sys.modules)))"
    )
    listed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert listed.stdout.strip() == "[]"


def test_libraries_say_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    class Loud(Slow):
        def __init__(self) -> None:
            print("hello")
            os.write(2, b"no GPU\n")

    open_library(library(Loud, "loud"))
    print("afterwards", file=sys.stderr)
    written = capfd.readouterr()
    assert (written.out, written.err) == ("", "afterwards\n")


def test_libraries_leave_the_arithmetic_as_it_was() -> None:
    """Taichi sets these two bits of MXCSR; whatever ran after it lost its denormals."""

    class Flushing(Slow):
        def __init__(self) -> None:
            libm, state = ctypes.CDLL(find_library("m")), ctypes.create_string_buffer(64)
            libm.fegetenv(state)
            control = int.from_bytes(state.raw[28:32], "little") | 0x8040
            libm.fesetenv(ctypes.create_string_buffer(state.raw[:28] + control.to_bytes(4, "little"), 64))
            assert half_of_a_denormal() == 0

    def half_of_a_denormal() -> float:
        return float((np.array([1e-39], np.float32) * np.float32(0.5))[0])

    open_library(library(Flushing, "flushing"))
    assert half_of_a_denormal() > 0


# --- rows -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("transfer", ["p2g", "g2p"])
@pytest.mark.parametrize("order", ["given", "deep"])
def test_a_row_says_what_ran(transfer: str, order: str, cpu: Any) -> None:
    one = case(transfer=transfer, particle_order=order)
    record = run(one, cpu)
    assert record.status == "ok"
    assert (record.variant, record.transfer, record.device) == (f"peer_slow_{transfer}", transfer, "cpu")
    assert record.axes == {"dtype": "float32", "spline": "cubic", "payload": "pic", "particle_order": order}
    assert record.kernel_info == {record.variant: {"library": "Slow 1.2", "fast_math": False}}
    assert list(record.hashes) == [record.variant]
    assert resume_key(from_json(to_json(record))) == one.resume_key(cpu, Inputs())


@pytest.mark.parametrize("order", ["given", "deep"])
@pytest.mark.parametrize(("transfer", "plain"), [("p2g", "p2g_global_atomic"), ("g2p", "g2p_global_gather")])
def test_all_but_the_transfer_is_ours(transfer: str, plain: str, order: str, cpu: Any) -> None:
    inputs = Inputs()
    theirs = case(transfer=transfer, particle_order=order).prepare(cpu, inputs, ENVIRONMENT, "step")
    mine = ours(plain, particle_order=order).prepare(cpu, inputs, ENVIRONMENT, "step")
    assert not isinstance(theirs, Record)
    assert not isinstance(mine, Record)
    for steps in ("steps", "finish", "reset"):
        assert [step.name for step in getattr(theirs, steps)] == [step.name for step in getattr(mine, steps)]
    assert [step.name for step in theirs.rest.step] == [step.name for step in mine.rest.step]
    (whole,) = [step for step in theirs.rest.step if step.name == theirs.rest.transfer]
    assert whole.launches == theirs.transfer.launches
    assert all(step.launches != theirs.transfer.launches for step in theirs.rest.before)


def test_an_arm_runs_the_transfer_alone_and_clears_before_it(cpu: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    made = case(particle_order="deep").prepare(cpu, Inputs(), ENVIRONMENT)
    assert not isinstance(made, Record)
    said: list[str] = []
    launch = CpuDevice.launch
    monkeypatch.setattr(CpuDevice, "launch", lambda self, one: (said.append(one.name), launch(self, one))[1])
    arm = made.arm(cpu)
    arm.run()
    assert said == ["peer_slow_p2g"]
    first = made.outputs().mass
    arm.prepare()
    assert said[1:] == ["grid_clear"]
    assert made.outputs().mass.sum() == 0
    arm.run()
    assert first.sum() == pytest.approx(2 * made.outputs().mass.sum())  # the first run added to that of the check


@pytest.mark.parametrize(
    ("kind", "status", "says"),
    [
        (Wrong, "wrong", None),
        (Crashing, "broken", "Slow failed: RuntimeError: unsupported instruction"),
        (refuses, "skipped", "Slow does not start (OSError: libcuda.so: no such file): pip install 'mpmbench[peers]'"),
    ],
)
def test_no_time_without_a_right_result(kind: Any, status: str, says: str | None, cpu: Any) -> None:
    made = case(kind).prepare(cpu, Inputs(), ENVIRONMENT)
    assert isinstance(made, Record)
    assert made.status == status
    assert (made.skipped_because or made.failed_because) == says


def test_a_missing_library_says_how_to_get_it(cpu: Any) -> None:
    peer = Peer(library(distribution="no-such-distribution"), "p2g")
    record = run(PeerCase(peer, BOX, peers.resolve_axes(peer, {})), cpu)
    assert record.skipped_because == "Slow is not installed: pip install 'mpmbench[peers]'"


@pytest.mark.parametrize(
    ("axis", "value"), [("dtype", "float64"), ("spline", "linear"), ("payload", "apic"), ("particle_order", "index")]
)
def test_what_it_is_not_written_for_is_skipped(axis: str, value: str, cpu: Any) -> None:
    record = run(case(**{axis: value}), cpu)
    assert record.skipped_because
    assert f"{axis}={value} does not exist for peer_slow_p2g" in record.skipped_because


def test_other_devices_are_refused() -> None:
    assert run(case(), open_device("simulated")).skipped_because == "runs on the device cpu only: -d cpu"


def test_bad_particles_are_refused_before_anything_runs() -> None:
    with pytest.raises(contest.InputError, match="unknown dataset 'no_such_dataset'"):
        refuse_bad_input([case(dataset=DatasetChoice("no_such_dataset"))])


# --- in the rounds of ours --------------------------------------------------------------------------------------------


def test_peers_answer_the_same_question_as_ours(cpu: Any) -> None:
    theirs, sorted_ones = case(), case(particle_order="deep")
    elsewhere = case(dataset=replace(BOX, particles=100))
    atomic, gather = ours("p2g_global_atomic", layout="aos"), ours("g2p_global_gather")
    cases = [theirs, atomic, gather, sorted_ones, case(transfer="g2p"), elsewhere]
    groups = contests(cases, Inputs())
    assert [[one.name for one in group] for group in groups] == [
        ["peer_slow_p2g", "p2g_global_atomic", "peer_slow_p2g"],
        ["g2p_global_gather", "peer_slow_g2p"],
        ["peer_slow_p2g"],
    ]
    assert baseline_of(groups[0]) is atomic
    assert len({one.label for one in groups[0]}) == 3
    assert theirs.device_bytes(Inputs()) > 0
    assert theirs.shrunk(particles=50).dataset.particles == 50


def test_rows_of_one_contest_share_its_rounds(cpu: Any) -> None:
    cases = [ours("p2g_global_atomic"), case(), case(particle_order="deep"), case(Wrong, particle_order="deep")]
    cases[-1] = replace(cases[-1], peer=Peer(library(Wrong, "other"), "p2g"))
    records = {
        record.variant + record.axes["particle_order"]: record for record, _ in run_session(cases, [cpu], [TIMING])
    }
    assert records["peer_other_p2gdeep"].status == "wrong"
    right = [records[name] for name in ("p2g_global_atomicgiven", "peer_slow_p2ggiven", "peer_slow_p2gdeep")]
    comparisons = [record.comparison for record in right]
    assert len({comparison.contest for comparison in comparisons if comparison}) == 1
    assert {comparison.baseline for comparison in comparisons if comparison} == {"p2g_global_atomic"}
    assert [len(record.transfer_measurement.samples) for record in right if record.transfer_measurement] == [8] * 3
    assert "sort_deep" in right[2].preprocess
    assert right[2].preprocess["sort_deep"].measurement
    assert right[1].repeat is not None
    assert right[1].repeat.of == 4 * 12 * 11 * 13
    assert right[1].repeat.differing == 0


def test_a_step_of_a_peer_is_timed_around_it(cpu: Any) -> None:
    (record,) = run_contest([case(transfer="g2p")], cpu, Inputs(), ENVIRONMENT, replace(TIMING, cache="step"))
    assert record.status == "ok", record.failed_because
    assert list(record.rest_of_step) == ["grid_clear", "p2g_global_atomic", "grid_divide"]


def test_a_library_starts_on_the_core_that_it_is_timed_on(cpu: Any) -> None:
    """Threads keep the cores of the thread that started them."""
    cores: list[set[int]] = []

    class Watching(Slow):
        def __init__(self) -> None:
            cores.append(os.sched_getaffinity(0))

    before = os.sched_getaffinity(0)
    list(run_session([case(Watching)], [cpu], [TIMING]))
    assert cores == [{max(before)}]
    assert os.sched_getaffinity(0) == before


# --- the command line -------------------------------------------------------------------------------------------------


@pytest.fixture
def shelf(monkeypatch: pytest.MonkeyPatch) -> None:
    """One library that is there and one that is not."""
    found = [
        Peer(made, transfer)
        for made in (library(), library(name="gone", distribution="no-such-distribution"))
        for transfer in ("p2g", "g2p")
    ]
    monkeypatch.setattr(peers, "discover", lambda: tuple(found))


def invoke(*words: Any) -> str:
    result = CliRunner().invoke(main, [str(word) for word in words])
    assert result.exit_code == 0, result.output
    return result.output


def titles(*words: Any) -> list[str]:
    lines = invoke("run", "--dry-run", "--dataset", "random", *words).splitlines()
    return [line.partition("  ")[2].removesuffix(" on random") for line in lines if line.count("  ")]


def test_list_shows_peers_and_how_to_get_them(shelf: None) -> None:
    text = invoke("list")
    assert "peer_slow_g2p" in text
    assert text.count("not installed") == 2
    content = json.loads(invoke("list", "--json"))["peers"]
    assert content["peer_slow_p2g"]["axes"]["particle_order"] == ["given", "deep"]
    assert [content[name]["installed"] for name in ("peer_slow_p2g", "peer_gone_p2g")] == [True, False]


def test_the_cpu_device_has_installed_peers_by_default(shelf: None) -> None:
    both = ["", " particle_order=deep"]
    assert [t for t in titles("-d", "cpu") if t.startswith("peer")] == [
        *(f"peer_slow_p2g{order}" for order in both),
        *(f"peer_slow_g2p{order}" for order in both),
    ]
    for devices in (("-d", "simulated"), ("-d", "simulated", "-d", "cpu")):
        assert not any(title.startswith("peer") for title in titles(*devices))


def test_peers_are_chosen_by_name(shelf: None) -> None:
    assert titles("-d", "cpu", "-b", "p2g_block_sync") == ["p2g_block_sync"]
    chosen = titles("-d", "cpu", "-b", "p2g_block_sync", "-b", "peer_*_p2g", "-a", "particle_order=deep")
    assert chosen == [
        "p2g_block_sync", "peer_slow_p2g particle_order=deep", "peer_gone_p2g particle_order=deep",
    ]  # fmt: skip
    assert len(peer_cases([Peer(library(), "p2g")], [BOX, BOX], {"batching": [1, 2]})) == 4


def test_a_run_leaves_rows_that_resume(shelf: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mpmbench.cli._timings", lambda *options: [TIMING])
    path = tmp_path / "rows.jsonl"
    words = ("run", "-d", "cpu", "--dataset", "random", "--particles", "200", "-b", "p2g_global_atomic",
             "-b", "peer_*_p2g", "--json", path)  # fmt: skip
    invoke(*words, "--html", tmp_path / "report.html", "--md", tmp_path / "report.md")
    names = [(record.variant, record.status) for record in read_records(path)]
    assert sorted(names) == [
        ("p2g_global_atomic", "ok"),
        *[("peer_gone_p2g", "skipped")] * 2,
        *[("peer_slow_p2g", "ok")] * 2,
    ]
    assert "peer_slow_p2g" in (tmp_path / "report.md").read_text()
    monkeypatch.setattr(peer_runs.PeerCase, "prepare", None)
    invoke(*words, "--resume")
    assert len(read_records(path)) == 5
