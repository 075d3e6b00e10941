"""Engine against native CPU code: is a JIT-compiled CUDA kernel as fast as code written for this processor?

    python benchmarks/engine_vs_cpu.py [--quick]

The ``cpu`` device, one pinned thread, under the protocol of every timed device (docs/measuring.md). Every arm is
checked against the float64 reference before it is timed. Kind of number: measured (wall, CPU). Leaves
reports/bench/engine_vs_cpu.md and .json.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import machine
import numpy as np
import peers_gcc

from mpmbench.contest import Contender
from mpmbench.device.cpu import CpuDevice
from mpmbench.environment import Environment
from mpmbench.peer_runs import PeerCase
from mpmbench.peers import Library, Peer, PeerMissing, open_library, taichi, warp
from mpmbench.plan import floor_bytes
from mpmbench.protocol.clocks import clock_of
from mpmbench.protocol.rounds import Contest, Rules, run_rounds
from mpmbench.protocol.verdict import Interval, median_interval
from mpmbench.runner import Case, DatasetChoice, Inputs
from mpmbench.variants import get, resolve_axes

REPORTS = Path(__file__).resolve().parent.parent / "reports" / "bench"
PARTICLES, QUICK_PARTICLES = 1_000_188, 100_000
VISITS = 64  # nodes in a cubic support
PEERS: tuple[Library, ...] = (warp.LIBRARY, taichi.LIBRARY, peers_gcc.LIBRARY)
AIMED_AT = warp.LIBRARY.title  # the peer that targets are ratios to, and the baseline of the rounds
AXES = {"dtype": "float32", "spline": "cubic", "payload": "pic"}
# Nothing is done to the caches: an arm finds what clearing its sums left there, as in a simulation.
CACHE = "step"
CONFIDENCE = 0.95
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


CUBE, BOX = "uniform_cube_shuffled", "random"  # recipes without any order
ROWS = (
    Row("P2G sorted, uniform_cube", "p2g", CUBE, True, "p2g_global_atomic", 1.5),
    Row("P2G sorted, uniform_cube: block_sync (peers as above)", "p2g", CUBE, True, "p2g_block_sync", 3.75),
    Row("P2G random order, uniform_cube", "p2g", CUBE, False, "p2g_global_atomic", 1.0),
    Row("G2P sorted, uniform_cube", "g2p", CUBE, True, "g2p_global_gather", 0.7),
    Row("G2P random order, uniform_cube", "g2p", CUBE, False, "g2p_global_gather", 1.0),
    Row("P2G sorted, random box", "p2g", BOX, True, "p2g_global_atomic", 1.5),
    Row("P2G random order, random box", "p2g", BOX, False, "p2g_global_atomic", 1.0),
    Row("G2P sorted, random box", "g2p", BOX, True, "g2p_global_gather", 0.7),
    Row("G2P random order, random box", "g2p", BOX, False, "g2p_global_gather", 1.0),
)


@dataclass
class Result:
    """What a row came to. seconds: by arm, one per pass. excluded: arm -> why it has no time."""

    row: Row
    particles: int
    seconds: dict[str, list[float]] = field(default_factory=dict)
    ratios: dict[str, Interval] = field(default_factory=dict)  # engine over peer
    noise: Interval | None = None  # the baseline over itself
    floor_seconds: float = 0.0  # compulsory bytes at this machine's copy rate
    discarded: dict[str, int] = field(default_factory=dict)  # passes run again, by reason
    stopped_by: str = ""
    excluded: dict[str, str] = field(default_factory=dict)

    def visit_ns(self, arm: str) -> float | None:
        """Median ns per node visit."""
        if arm not in self.seconds:
            return None
        return float(np.median(self.seconds[arm])) * 1e9 / (self.particles * VISITS)

    @property
    def verdict(self) -> str:
        against = self.ratios.get(AIMED_AT)
        if against is None:
            return "not measured"
        word = "met" if against.median <= self.row.target else "missed"
        return word + (" (within noise)" if against.low <= self.row.target <= against.high else "")


class Bench:
    """Peers, engine and everything that several rows share."""

    def __init__(self, particles: int, rules: Rules, seed: int) -> None:
        self.particles, self.rules, self.seed = particles, rules, seed
        self.device, self.inputs, self.environment = CpuDevice(), Inputs(), Environment.capture()
        self.versions: dict[str, str] = {}
        self.missing: dict[str, str] = {}
        for library in PEERS:
            try:
                self.versions[library.title] = open_library(library).version
            except PeerMissing as reason:
                self.missing[library.title] = str(reason)
        self.copy_rate = _copy_rate()

    def run_group(self, rows: list[Row]) -> list[Result]:
        """Check, then time all arms of rows that share a group."""
        row = rows[0]
        choice = DatasetChoice(row.dataset, self.particles)
        axes = AXES | {"particle_order": "deep" if row.deep else "given"}
        cases: dict[str, Any] = {
            library.title: PeerCase(Peer(library, row.transfer), choice, axes)
            for library in PEERS
            if library.title not in self.missing
        }
        for each in rows:
            variant = get(each.variant)
            cases[each.variant] = Case(variant, choice, resolve_axes(variant, axes | {"writing": "hoisted"}))
        contenders: dict[str, Contender] = {}
        excluded: dict[str, str] = {}
        for name, case in cases.items():
            made = case.prepare(self.device, self.inputs, self.environment)
            if isinstance(made, Contender):
                contenders[name] = made
            else:  # a wrong answer has no time
                reason = made.skipped_because or made.failed_because
                excluded[name] = reason or f"FAILED: error {made.check.ratio:.3g} x allowed"
        contest = None
        if contenders:
            arms = [contender.arm(self.device) for contender in contenders.values()]
            contest = run_rounds(arms, clock_of(self.device, CACHE), self.rules, self.seed)
        labels = {name: contender.label for name, contender in contenders.items()}
        return [self._result(each, cases[each.variant], contest, labels, excluded) for each in rows]

    def _result(
        self, row: Row, case: Case, contest: Contest | None, labels: dict[str, str], excluded: dict[str, str]
    ) -> Result:
        dataset = self.inputs.select(case.dataset)
        result = Result(row, dataset.particle_count)
        shown = {row.variant: "engine"} | {title: title for title in self.versions}
        result.excluded = self.missing | {name: why for name, why in excluded.items() if name in shown}
        result.floor_seconds = floor_bytes(case.variant, dataset, case.axes) / self.copy_rate
        if contest is None:
            return result
        for name, arm in shown.items():
            label = labels.get(name)
            if label in contest.spoiled:
                result.excluded[name] = contest.spoiled[label]
            elif label is not None:
                result.seconds[arm] = contest.seconds[label]
        if engine := result.seconds.get("engine"):
            result.ratios = {
                title: median_interval([a / b for a, b in zip(engine, result.seconds[title], strict=True)], CONFIDENCE)
                for title in self.versions
                if title in result.seconds
            }
        if first := contest.seconds.get(contest.baseline):
            result.noise = median_interval([a / b for a, b in zip(first, contest.again, strict=True)], CONFIDENCE)
        result.discarded, result.stopped_by = contest.discarded, contest.stopped_by
        return result


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
    names = ("engine", *(library.title for library in PEERS))
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


def ratio_table(results: list[Result]) -> list[str]:
    """Engine over peer, the aim and whether it is met."""
    names = [library.title for library in PEERS]
    lines = [
        f"| case | {' | '.join(f'engine / {name}' for name in names)} | aim: / Warp | verdict | same code twice |",
        "|---" * (len(names) + 4) + "|",
    ]
    for result in results:
        cells = [_interval_text(result.ratios.get(name)) for name in names]
        lines.append(
            f"| {result.row.label} | {' | '.join(cells)} | <= {result.row.target:g} | {result.verdict} "
            f"| {_interval_text(result.noise)} |"
        )
    return lines


def _interval_text(interval: Interval | None) -> str:
    return "-" if interval is None else f"{interval.median:.2f} [{interval.low:.2f}, {interval.high:.2f}]"


def markdown(results: list[Result], bench: Bench, about: Mapping[str, Any]) -> str:
    versions = ", ".join(f"{title} {version}" for title, version in bench.versions.items())
    rules = bench.rules
    lines = [
        "# Engine against native CPU code",
        "",
        f"Kind: {KIND}. One process, one pinned thread, at most {rules.max_rounds} rounds of "
        f"{rules.passes} passes, hoisted, float32, PIC, cubic, {bench.particles:,} particles, 128^3 nodes. Only the "
        "transfer launch is timed, not binning and sorting, which are the same for all arms. Every arm passed the "
        "float64 check.",
        "",
        machine.markdown(about["machine"]),
        "",
        f"Peers: {versions or 'none'}.",
        "",
        "## ns per node visit, median of the passes",
        "",
        *times_table(results),
        "",
        "Floor: each particle and touched node moved once, at this machine's single-thread copy rate of "
        f"{bench.copy_rate / 1e9:.1f} GB/s; 64 node visits per particle.",
        "",
        f"## Ratios, median of the paired passes with {CONFIDENCE:.0%} interval; below 1 the engine is faster",
        "",
        *ratio_table(results),
        "",
    ]
    lines += [f"- {note}" for note in notes(results, about)]
    return "\n".join(lines).rstrip() + "\n"


def notes(results: list[Result], about: Mapping[str, Any]) -> list[str]:
    found = []
    if warning := machine.load_warning(about["machine"]["load_average_before"]):
        found.append(f"Warning: {warning}")
    for result in results:
        again = ", ".join(f"{count} passes run again: {reason}" for reason, count in result.discarded.items())
        found += [f"{result.row.label}: {again}"] * bool(again)
    excluded = {(name, reason) for result in results for name, reason in result.excluded.items()}
    found += [f"{name}: no time, {reason}" for name, reason in sorted(excluded)]
    return found


def as_json(results: list[Result], bench: Bench, about: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "kind": KIND,
        **about,
        "peers": bench.versions,
        "rules": asdict(bench.rules),
        "copy_rate": bench.copy_rate,
        "rows": [
            asdict(result.row)
            | {
                "particles": result.particles,
                "visit_ns": {name: result.visit_ns(name) for name in result.seconds},
                "ratio_engine_over": {name: asdict(ratio) for name, ratio in result.ratios.items()},
                "same_code_twice": asdict(result.noise) if result.noise else None,
                "verdict": result.verdict,
                "floor_seconds": result.floor_seconds,
                "discarded": result.discarded,
                "stopped_by": result.stopped_by,
                "excluded": result.excluded,
                "seconds": result.seconds,
            }
            for result in results
        ],
    }


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="2 rounds, 100k particles: does it run?")
    parser.add_argument("--particles", type=int, help=f"default {PARTICLES}")
    parser.add_argument("--rounds", type=int, help="most rounds of a row, default 8")
    parser.add_argument("--only", default="", help="only rows whose label contains this text")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=REPORTS, help="folder of the report")
    given = parser.parse_args(arguments)
    load_before = os.getloadavg()[0]
    core = max(os.sched_getaffinity(0))
    about = {"machine": machine.describe(core), "seed": given.seed, "quick": given.quick}
    if warning := machine.load_warning(load_before):
        print(f"warning: {warning}", file=sys.stderr)

    most = given.rounds or (2 if given.quick else 8)
    rules = Rules(min_rounds=min(4, most), max_rounds=most, precision=0.005)
    particles = given.particles or (QUICK_PARTICLES if given.quick else PARTICLES)
    with CpuDevice().undisturbed():
        bench, results = run_rows(particles, rules, given.seed, given.only)
    text = markdown(results, bench, about)
    given.out.mkdir(parents=True, exist_ok=True)
    (given.out / "engine_vs_cpu.md").write_text(text)
    (given.out / "engine_vs_cpu.json").write_text(json.dumps(as_json(results, bench, about), indent=1) + "\n")
    print(text)
    return 0


def run_rows(particles: int, rules: Rules, seed: int, only: str) -> tuple[Bench, list[Result]]:
    """All rows whose label contains ``only``. The peers start here, so that their threads stay on the pinned core."""
    bench = Bench(particles, rules, seed)
    groups: dict[Any, list[Row]] = {}
    for row in ROWS:
        if only in row.label:
            groups.setdefault(row.group, []).append(row)
    measured: dict[Row, Result] = {}
    for number, rows in enumerate(groups.values(), start=1):
        print(f"[{number}/{len(groups)}] {', '.join(row.label for row in rows)}", file=sys.stderr, flush=True)
        measured |= {result.row: result for result in bench.run_group(rows)}
    return bench, [measured[row] for row in ROWS if row in measured]


if __name__ == "__main__":
    sys.exit(main())
