"""Engine against native CPU code: is a JIT-compiled CUDA kernel as fast as code written for this processor?

    python benchmarks/engine_vs_cpu.py [--quick]

One process, one pinned thread, interleaved rounds. Every arm is checked against the float64 reference before it is
timed. Kind of number: measured (wall, CPU). Leaves reports/bench/engine_vs_cpu.md and .json.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import machine
import numpy as np
import peers_gcc
import peers_taichi
import peers_warp
import rounds
from engine_arm import EngineTransfer, open_engine
from rounds import Arm, Interval
from scenes import PeerMissing, Scene, aligned, load

from mpmbench import reference
from mpmbench.check import CheckResult, check_g2p, check_p2g
from mpmbench.plan import floor_bytes
from mpmbench.reference import Nodes, ParticleValues
from mpmbench.variants import discover, resolve_axes

REPORTS = Path(__file__).resolve().parent.parent / "reports" / "bench"
PARTICLES, QUICK_PARTICLES = 1_000_188, 100_000
VISITS = 64  # nodes in a cubic support
PEERS = (peers_warp.Peer, peers_taichi.Peer, peers_gcc.Peer)
AXES = {"dtype": "float32", "spline": "cubic", "payload": "pic", "writing": "hoisted"}
KIND = "measured (wall, CPU)"


@dataclass(frozen=True)
class Row:
    """One row of the table. Rows of equal (transfer, dataset, deep) share their rounds and the peers' samples.

    target: largest ratio to Warp that meets the aim.
    """

    label: str
    transfer: str
    dataset: str
    deep: bool
    variant: str
    target: float

    @property
    def group(self) -> tuple[str, str, bool]:
        return self.dataset, self.transfer, self.deep


ROWS = (
    Row("P2G sorted, uniform_cube", "p2g", "uniform_cube", True, "p2g_global_atomic", 1.5),
    Row("P2G sorted, uniform_cube: block_sync (peers as above)", "p2g", "uniform_cube", True, "p2g_block_sync", 3.75),
    Row("P2G random order, uniform_cube", "p2g", "uniform_cube", False, "p2g_global_atomic", 1.0),
    Row("G2P sorted, uniform_cube", "g2p", "uniform_cube", True, "g2p_global_gather", 0.7),
    Row("G2P random order, uniform_cube", "g2p", "uniform_cube", False, "g2p_global_gather", 1.0),
    Row("P2G sorted, random box", "p2g", "random", True, "p2g_global_atomic", 1.5),
    Row("P2G random order, random box", "p2g", "random", False, "p2g_global_atomic", 1.0),
    Row("G2P sorted, random box", "g2p", "random", True, "g2p_global_gather", 0.7),
    Row("G2P random order, random box", "g2p", "random", False, "g2p_global_gather", 1.0),
)


@dataclass
class Result:
    """What a row came to. seconds: by arm, one per round. excluded: arm -> why it has no time."""

    row: Row
    particles: int
    seconds: dict[str, list[float]] = field(default_factory=dict)
    ratios: dict[str, Interval] = field(default_factory=dict)  # engine over peer
    processor_ratios: dict[str, Interval] = field(default_factory=dict)  # the same in time on the core
    noise: Interval | None = None  # a peer over itself
    floor_seconds: float = 0.0  # compulsory bytes at this machine's copy rate
    disturbed: int = 0
    kept_disturbed: int = 0
    excluded: dict[str, str] = field(default_factory=dict)

    def visit_ns(self, arm: str) -> float | None:
        """Median ns per node visit."""
        if arm not in self.seconds:
            return None
        return float(np.median(self.seconds[arm])) * 1e9 / (self.particles * VISITS)

    @property
    def verdict(self) -> str:
        against = self.ratios.get(peers_warp.NAME)
        if against is None:
            return "not measured"
        word = "met" if against.median <= self.row.target else "missed"
        return word + (" (within noise)" if against.low <= self.row.target <= against.high else "")


class Bench:
    """Peers, engine and everything that several rows share."""

    def __init__(self, particles: int, rounds_sorted: int, rounds_random: int, seed: int) -> None:
        self.particles, self.rounds, self.seed = particles, (rounds_random, rounds_sorted), seed
        self.peers: dict[str, Any] = {}
        self.missing: dict[str, str] = {}
        for peer in PEERS:
            try:
                self.peers[peer.name] = peer()
            except PeerMissing as reason:
                self.missing[peer.name] = str(reason)
        self.device = open_engine()
        self.copy_rate = _copy_rate()
        self._references: dict[tuple[str, str], Any] = {}

    def run_group(self, rows: list[Row]) -> list[Result]:
        """Check, then time all arms of rows that share a group."""
        dataset, transfer, deep = rows[0].group
        scene = load(dataset, self.particles, deep=deep)
        make = self._p2g_arms if transfer == "p2g" else self._g2p_arms
        arms, excluded = make(scene, rows)
        again = next((arm for arm in arms if arm.name in self.peers), None)
        if again is not None:  # the same code twice: how far apart can equals be here?
            arms.append(Arm("again", again.run, again.reset))
        sampled = rounds.run_rounds(arms, self.rounds[deep], self.seed) if arms else rounds.Rounds({}, {})
        return [self._result(row, scene, sampled, excluded, again) for row in rows]

    def _result(
        self, row: Row, scene: Scene, sampled: rounds.Rounds, excluded: dict[str, str], again: Arm | None
    ) -> Result:
        seconds = sampled.seconds
        result = Result(row, scene.count, disturbed=sampled.disturbed, kept_disturbed=sampled.kept_disturbed)
        result.excluded = self.missing | {k: v for k, v in excluded.items() if k in (row.variant, *self.peers)}
        names = [name for name in self.peers if name in seconds]
        result.seconds = {name: seconds[name].tolist() for name in names}
        if row.variant in seconds:
            result.seconds["engine"] = seconds[row.variant].tolist()
            result.ratios = _ratios(seconds, row.variant, names)
            result.processor_ratios = _ratios(sampled.processor_seconds, row.variant, names)
        if again is not None:
            result.noise = rounds.paired_ratio(seconds["again"], seconds[again.name])
        variant = next(v for v in discover() if v.name == row.variant)
        bytes_needed = floor_bytes(variant, scene.dataset, resolve_axes(variant, AXES))
        result.floor_seconds = bytes_needed / self.copy_rate
        return result

    def _p2g_arms(self, scene: Scene, rows: list[Row]) -> tuple[list[Arm], dict[str, str]]:
        answer = self._reference("p2g", scene, lambda: reference.p2g(scene.dataset, "cubic", "pic", "float32"))
        nodes = aligned((scene.grid.node_count, 4))

        def clear() -> None:
            nodes[:] = 0

        def outcome() -> CheckResult:
            host = scene.grid.to_host_order(nodes)
            return check_p2g(Nodes(mass=host[..., 3], momentum=host[..., :3]), answer)

        arms: list[Arm] = []
        excluded: dict[str, str] = {}
        for name, peer in self.peers.items():
            arm = Arm(name, peer.p2g(scene, nodes), clear)
            _keep_if_right(arm, outcome, arms, excluded)
        for row in rows:
            transfer = EngineTransfer(self.device, row.variant, _axes(row), scene)

            def engine_outcome(transfer: EngineTransfer = transfer) -> CheckResult:
                return check_p2g(transfer.outputs(), answer)

            arm = Arm(row.variant, transfer.run, transfer.reset)
            _keep_if_right(arm, engine_outcome, arms, excluded)
        return arms, excluded

    def _g2p_arms(self, scene: Scene, rows: list[Row]) -> tuple[list[Arm], dict[str, str]]:
        # Unit node masses, so that dividing momentum by mass on the device gives the peers' velocities exactly.
        shape = scene.grid.shape
        velocity = np.random.default_rng(self.seed).uniform(-1, 1, (*shape, 3)).astype(np.float32)
        given = Nodes(mass=np.ones(shape, np.float32), momentum=velocity)
        answer = self._reference(
            "g2p", scene, lambda: reference.g2p(scene.dataset, velocity, "cubic", "pic", "float32")
        )
        nodes, results = aligned((scene.grid.node_count, 4)), aligned((scene.count, 4))
        nodes[:, :3] = scene.grid.to_device_order(velocity)
        place = np.empty_like(scene.to_given)
        place[scene.to_given] = np.arange(scene.count)

        def outcome() -> CheckResult:
            return check_g2p(ParticleValues(results[place, :3]), answer)

        def clear() -> None:
            results[:] = 0

        arms: list[Arm] = []
        excluded: dict[str, str] = {}
        for name, peer in self.peers.items():
            arm = Arm(name, peer.g2p(scene, nodes, results), clear)
            _keep_if_right(arm, outcome, arms, excluded)
        for row in rows:
            transfer = EngineTransfer(self.device, row.variant, _axes(row), scene, given)
            arm = Arm(row.variant, transfer.run, transfer.reset)

            def engine_outcome(transfer: EngineTransfer = transfer) -> CheckResult:
                transfer.finish()
                return check_g2p(transfer.outputs(), answer)

            _keep_if_right(arm, engine_outcome, arms, excluded)
        return arms, excluded

    def _reference(self, transfer: str, scene: Scene, make: Callable[[], Any]) -> Any:
        """Both memory orders hold the same particles, so they share a reference."""
        key = (transfer, scene.dataset.name)
        if key not in self._references:
            self._references[key] = make()
        return self._references[key]


def _ratios(seconds: Mapping[str, np.ndarray], over: str, names: list[str]) -> dict[str, Interval]:
    return {name: rounds.paired_ratio(seconds[over], seconds[name]) for name in names}


def _axes(row: Row) -> dict[str, Any]:
    return AXES | {"particle_order": "deep" if row.deep else "given"}


def _keep_if_right(arm: Arm, outcome: Callable[[], CheckResult], arms: list[Arm], excluded: dict[str, str]) -> None:
    """Run an arm once and keep it only if its result passes: a wrong answer has no time."""
    arm.reset()
    arm.run()
    check = outcome()
    if check.passed:
        arms.append(arm)
    else:
        excluded[arm.name] = str(check)


def _copy_rate() -> float:
    """Bytes moved per second (read plus written) by a copy too large for any cache of one core."""
    source, target = np.ones(1 << 25), np.empty(1 << 25)
    best = np.inf
    for _ in range(4):
        begin = time.perf_counter()
        np.copyto(target, source)
        best = min(best, time.perf_counter() - begin)
    return 2 * source.nbytes / best


# --- report -----------------------------------------------------------------------------------------------------------


def times_table(results: list[Result]) -> list[str]:
    """Median ns per node visit of every arm."""
    names = ("engine", *(peer.name for peer in PEERS))
    lines = [
        f"| case | {' | '.join(names)} | floor (bytes) |",
        "|---" * (len(names) + 2) + "|",
    ]
    for result in results:
        cells = []
        for name in names:
            value = result.visit_ns(name)
            cells.append(f"{value:.2f}" if value is not None else "-")
        floor = result.floor_seconds * 1e9 / (result.particles * VISITS)
        lines.append(f"| {result.row.label} | {' | '.join(cells)} | {floor:.2f} |")
    return lines


def processor_table(results: list[Result]) -> list[str]:
    """Ratios of time on the core: what is left of a measurement on a machine that was never calm."""
    names = [peer.name for peer in PEERS]
    lines = [f"| case | {' | '.join(f'engine / {name}' for name in names)} |", "|---" * (len(names) + 1) + "|"]
    for result in results:
        cells = [str(result.processor_ratios.get(name, "-")) for name in names]
        lines.append(f"| {result.row.label} | {' | '.join(cells)} |")
    return lines


def ratio_table(results: list[Result]) -> list[str]:
    """Engine over peer, the aim and whether it is met."""
    names = [peer.name for peer in PEERS]
    lines = [
        f"| case | {' | '.join(f'engine / {name}' for name in names)} | aim: / Warp | verdict | same code twice |",
        "|---" * (len(names) + 4) + "|",
    ]
    for result in results:
        cells = [str(result.ratios.get(name, "-")) for name in names]
        noise = result.noise or "-"
        lines.append(
            f"| {result.row.label} | {' | '.join(cells)} | <= {result.row.target:g} | {result.verdict} | {noise} |"
        )
    return lines


def markdown(results: list[Result], bench: Bench, about: Mapping[str, Any]) -> str:
    versions = ", ".join(f"{name} {peer.version}" for name, peer in bench.peers.items())
    lines = [
        "# Engine against native CPU code",
        "",
        f"Kind: {KIND}. One process, one pinned thread, {bench.rounds[1]} interleaved rounds "
        f"({bench.rounds[0]} for random order), hoisted, float32, PIC, cubic, {bench.particles:,} particles, "
        "128^3 nodes. Only the transfer launch is timed, not binning and sorting. Every arm passed the float64 check.",
        "",
        machine.markdown(about["machine"]),
        "",
        f"Peers: {versions or 'none'}.",
        "",
        "## ns per node visit, median of the rounds",
        "",
        *times_table(results),
        "",
        "Floor: each particle and touched node moved once, at this machine's single-thread copy rate of "
        f"{bench.copy_rate / 1e9:.1f} GB/s; 64 node visits per particle.",
        "",
        "## Ratios, median of the paired rounds with 95 % bootstrap interval; below 1 the engine is faster",
        "",
        *ratio_table(results),
        "",
    ]
    if any(result.kept_disturbed for result in results):
        lines += ["## The same in processor time: disturbed rounds had to be kept", "", *processor_table(results), ""]
    lines += [f"- {note}" for note in notes(results, about)]
    return "\n".join(lines).rstrip() + "\n"


def notes(results: list[Result], about: Mapping[str, Any]) -> list[str]:
    found = []
    if warning := machine.load_warning(about["machine"]["load_average_before"]):
        found.append(f"Warning: {warning}")
    again = sum(result.disturbed for result in results)
    kept = sum(result.kept_disturbed for result in results)
    if again:
        found.append(f"{again} rounds were run again because another process took the core; {kept} such were kept.")
    excluded = {(name, reason) for result in results for name, reason in result.excluded.items()}
    found += [f"{name}: no time, {reason}" for name, reason in sorted(excluded)]
    return found


def as_json(results: list[Result], bench: Bench, about: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "kind": KIND,
        **about,
        "peers": {name: peer.version for name, peer in bench.peers.items()},
        "copy_rate": bench.copy_rate,
        "rows": [
            asdict(result.row)
            | {
                "particles": result.particles,
                "visit_ns": {name: result.visit_ns(name) for name in result.seconds},
                "ratio_engine_over": {name: asdict(ratio) for name, ratio in result.ratios.items()},
                "processor_time_ratio": {name: asdict(ratio) for name, ratio in result.processor_ratios.items()},
                "same_code_twice": asdict(result.noise) if result.noise else None,
                "verdict": result.verdict,
                "floor_seconds": result.floor_seconds,
                "disturbed": result.disturbed,
                "kept_disturbed": result.kept_disturbed,
                "excluded": result.excluded,
                "seconds": result.seconds,
            }
            for result in results
        ],
    }


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="3 rounds, 100k particles: does it run?")
    parser.add_argument("--particles", type=int, help=f"default {PARTICLES}")
    parser.add_argument("--rounds", type=int, help="rounds of sorted rows, default 9; random order gets 7/3 of it")
    parser.add_argument("--only", default="", help="only rows whose label contains this text")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=REPORTS, help="folder of the report")
    given = parser.parse_args(arguments)
    load_before = os.getloadavg()[0]
    core = rounds.pin_to_one_core()
    about = {"machine": machine.describe(core), "seed": given.seed, "quick": given.quick}
    if warning := machine.load_warning(load_before):
        print(f"warning: {warning}", file=sys.stderr)

    sorted_rounds = given.rounds or (3 if given.quick else 9)
    random_rounds = -(-sorted_rounds * 7 // 3)
    particles = given.particles or (QUICK_PARTICLES if given.quick else PARTICLES)
    bench = Bench(particles, sorted_rounds, random_rounds, given.seed)
    groups: dict[Any, list[Row]] = {}
    for row in ROWS:
        if given.only in row.label:
            groups.setdefault(row.group, []).append(row)
    measured: dict[Row, Result] = {}
    for number, rows in enumerate(groups.values(), start=1):
        print(f"[{number}/{len(groups)}] {', '.join(row.label for row in rows)}", file=sys.stderr, flush=True)
        measured |= {result.row: result for result in bench.run_group(rows)}
    results = [measured[row] for row in ROWS if row in measured]
    text = markdown(results, bench, about)
    given.out.mkdir(parents=True, exist_ok=True)
    (given.out / "engine_vs_cpu.md").write_text(text)
    (given.out / "engine_vs_cpu.json").write_text(json.dumps(as_json(results, bench, about), indent=1) + "\n")
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
