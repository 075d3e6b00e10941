"""Measured rows that nobody measured: samples with seeded noise, paired and compared as a contest's are."""

from __future__ import annotations

import dataclasses
import statistics
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mpmbench.environment import Environment
from mpmbench.grid import Grid
from mpmbench.protocol.verdict import CONFIDENCE, Verdict, compare, correct, median_interval
from mpmbench.record import (
    Check,
    Comparison,
    DatasetSummary,
    Measurement,
    Record,
    Repeat,
    StepCost,
    Tried,
    Tuning,
)

ENVIRONMENT = Environment(
    mpmbench="0.1.0", git_commit="c0ffee", git_dirty=False, python="3.11.0", numpy="2.0", numba="0.68", llvmlite="0.50",
    nvrtc="12.9", cpu="A CPU of 64 cores", cores=2, os="Linux", date="2026-01-01T00:00:00+00:00",
    argv=("mpmbench", "run", "-b", "p2g_*", "--dataset", "random", "--json", "rows.jsonl", "--quick"), seed=1,
)  # fmt: skip
GPU = {"name": "Test GPU", "driver": "580.1"}
PLAIN_AXES = {"dtype": "float32", "spline": "quadratic", "payload": "apic", "layout": "soa", "particle_order": "given"}


def dataset(name: str = "random", n: int = 1_000_000, per_cell: int | None = 4) -> DatasetSummary:
    recipe = {"order": "random"} | ({} if per_cell is None else {"particles_per_cell": per_cell})
    statistics_ = {"occupied_cells": n // (per_cell or 2), "mean_per_occupied_cell": float(per_cell or 2)}
    return DatasetSummary(
        name, recipe, 1, n, Grid((128, 128, 128), 1 / 128), f"{name}-{n}-{per_cell}".ljust(64, "0"), statistics_
    )


def row(variant: str = "p2g_global_atomic", gpu: Mapping[str, Any] | None = None, **changes: Any) -> Record:
    """A checked run on a GPU that has no time yet."""
    axes = dict(PLAIN_AXES)
    defaults = dict(axes)
    if "block" in variant:
        axes |= {"particle_order": "deep", "block_shape": (8, 4, 4), "batching": 1}
        defaults = dict(axes)
    axes |= changes.pop("axes", {})
    environment = dataclasses.replace(ENVIRONMENT, gpu=dict(GPU if gpu is None else gpu))
    made = Record(
        variant=variant, transfer="g2p" if variant.startswith("g2p") else "p2g", dataset=dataset(), axes=axes,
        default_axes=defaults, device="cuda:0", arch="sm_90", environment=environment,
        variant_summary="what it does", check=Check(True, 1e-7, 1e-6, (1, 2, 3)), device_bytes_predicted=1 << 28,
    )  # fmt: skip
    return dataclasses.replace(made, **changes)


def on_cpu(variant: str, **changes: Any) -> Record:
    made = row(variant, gpu={}, **changes)
    return dataclasses.replace(made, device="cpu", arch="x86_64")


def steady(seconds: float, mode: str = "cold", samples: int = 40, noise: float = 0.003, seed: int = 0) -> Measurement:
    """Times of a step on its own [s]."""
    random = np.random.default_rng((seed, round(1e9 * seconds)))
    return Measurement(tuple((seconds * (1 + random.exponential(noise, samples))).tolist()), mode, 12, "precision")


def contest(
    rows: Sequence[tuple[Record, float]],
    name: str = "contest-1",
    seed: int = 1,
    samples: int = 240,
    mode: str = "cold",
    noise: float | Sequence[float] = 0.004,
    outliers: float = 0.01,
    drift: float = 0.01,
    copy: float = 1.0,
    confidence: float = CONFIDENCE,
    sort: float = 2e-3,
    stopped_by: str = "verdict",
    discarded: Mapping[str, int] | None = None,
    megahertz: Sequence[float] = (),
) -> list[Record]:
    """Rows timed in the same rounds; the first is the baseline.

    rows: with what each takes in calm [s].  noise: of all rows, or of each.  copy: time of the baseline's second copy
    over its own.  sort: what preprocessing takes [s] where the particles are not in the order given.
    megahertz: clock of each row.
    """
    random = np.random.default_rng(seed)
    level = np.exp(np.cumsum(random.normal(0, drift / np.sqrt(samples), samples)))
    noises = [noise] * len(rows) if isinstance(noise, float) else list(noise)

    def times(seconds: float, scale: float) -> list[float]:
        slow = np.where(random.random(samples) < outliers, random.uniform(1.2, 3.0, samples), 1.0)
        return (seconds * level * (1 + random.exponential(scale, samples)) * slow).tolist()

    taken = [times(seconds, scale) for (_, seconds), scale in zip(rows, noises, strict=True)]
    again = times(rows[0][1] * copy, noises[0])
    floor = median_interval([a / b for a, b in zip(taken[0], again, strict=True)], confidence)
    paired = correct([compare(taken[0], other, floor, confidence) for other in taken[1:]], confidence)
    lone = compare(taken[0], taken[0], floor, confidence)
    fastest = min(taken, key=statistics.median)
    leads = [
        other is fastest or compare(fastest, other, floor, confidence).verdict is not Verdict.SLOW for other in taken
    ]
    found = []
    for i, ((record, _), mine) in enumerate(zip(rows, taken, strict=True)):
        one = paired[i - 1] if i else None
        clocks = (1e6 * megahertz[i],) * samples if megahertz else ()
        verdict = str(one.verdict) if one else str(Verdict.SAME)
        if megahertz and abs(megahertz[i] / megahertz[0] - 1) > 0.01:
            verdict = str(Verdict.UNUSABLE)
        comparison = Comparison(
            contest=name, baseline=rows[0][0].variant, is_baseline=i == 0, verdict=verdict,
            speedup=(one.speedup.median, one.speedup.low, one.speedup.high) if one else None, leads=leads[i],
            noise=(floor.median, floor.low, floor.high), margin=(one or (paired or [lone])[0]).margin,
            p_value=one.p_value if one else 1.0, confidence=confidence, rounds=samples // 4, seed=seed,
        )  # fmt: skip
        steps = {"grid_clear": StepCost(None, steady(9e-5, mode))}
        if record.axes["particle_order"] != "given":
            steps |= {"bin": StepCost(None, steady(sort / 2, mode)), "reorder": StepCost(None, steady(sort / 2, mode))}
        time = Measurement(tuple(mine), mode, 25, stopped_by, clocks, dict(discarded or {}))
        found.append(dataclasses.replace(record, transfer_measurement=time, comparison=comparison, preprocess=steps))
    return found


def search(record: Record, best: float, gpu: str | None = "Test GPU", kind: str = "measured (events)") -> Record:
    """The same row with a search behind it: four blocks, three batchings, one of which is refused."""
    tried = [
        Tried({"block_shape": block, "batching": batching}, best * (1 + 0.11 * i + 0.07 * k))
        for i, block in enumerate(((8, 4, 4), (4, 4, 4), (8, 8, 4), (16, 4, 4)))
        for k, batching in enumerate((2, 1, 4))
    ]
    tried[-1] = Tried(tried[-1].axes, None, "needs 61 KiB of shared memory, 48 are there")
    tuning = Tuning(("block_shape", "batching"), 12, 40, kind, gpu, tuple(tried))
    return dataclasses.replace(record, axes={**record.axes, **tried[0].axes}, tuning=tuning)


def everyday(data: DatasetSummary | None = None, seed: int = 1, **options: Any) -> list[Record]:
    """Six strategies, one of them clearly ahead."""
    data = data or dataset()
    sync = search(row("p2g_block_sync", dataset=data, repeat=Repeat(12_345, 8_388_608, 2.3e-7)), 1.36e-3)
    rows = [
        (row(dataset=data, repeat=Repeat(1_204_551, 8_388_608, 4.1e-7)), 1.93e-3),
        (row(axes={"particle_order": "deep"}, dataset=data), 1.61e-3),
        (sync, 1.36e-3),
        (row("p2g_block_atomic", dataset=data), 1.50e-3),
        (row("p2g_warp_reduce", dataset=data, repeat=Repeat(0, 8_388_608, 0.0)), 1.925e-3),
        (row("p2g_node_gather", dataset=data), 4.4e-3),
    ]
    scale = data.n / 1_000_000
    return contest([(r, s * scale) for r, s in rows], f"{data.fingerprint}-{seed}", seed, **options)
