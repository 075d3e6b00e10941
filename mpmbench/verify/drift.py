"""What ``weights=unity`` buys: momentum of free APIC bodies over two thousand steps, with plain weights and with it.

Two bodies without forces, a translating block for momentum and a rotating one for angular momentum, advanced by the
kernels themselves: P2G, divide, G2P, x += dt v. In exact arithmetic both are kept for ever. The rotating block is dust:
it grows as it turns, and its velocity field stays linear, which APIC reproduces.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mpmbench.dataset import Dataset
from mpmbench.device import Device
from mpmbench.report.table import Column, Kind, Quantity, Table
from mpmbench.verify.outcome import Outcome, Tick, label, make_table, own_kind
from mpmbench.verify.round_trip import ALLOWED, RoundTrip
from mpmbench.verify.totals import Totals

STEPS, QUICK_STEPS = 2000, 100
DX = 1 / 64  # [m], a power of two: xi is exact
SEED = 20191

# float64 shows that what float32 loses is rounding; the quadratic weights that unity has little to mend there.
RUNS = (
    ("float32", "cubic", "plain"),
    ("float32", "cubic", "unity"),
    ("float32", "quadratic", "plain"),
    ("float32", "quadratic", "unity"),
    ("float64", "cubic", "plain"),
)


@dataclass(frozen=True)
class Scene:
    """A body that moves freely. centre: where its mass is at the start [m].  duration: of all steps [s]."""

    name: str
    dataset: Dataset
    centre: np.ndarray
    duration: float


@dataclass(frozen=True)
class Drift:
    """Error of the totals over the particles after ``steps``.

    momentum: largest component, of the momentum (translating) or of sum m |v| (rotating).
    angular: of the angular momentum about the body's first centre, which has none when it translates; there None.
    angular_node: the same about node (0, 0, 0), an arm's length away.
    """

    scene: str
    dtype: str
    spline: str
    weights: str
    steps: int
    momentum: float
    angular: float | None
    angular_node: float | None

    @property
    def allowed(self) -> float:
        return ALLOWED[self.weights] * float(np.finfo(self.dtype).eps) * self.steps


def translating() -> Scene:
    """8 cells along each edge, 8 particles per cell, 93 cells along x at 1 m/s."""
    return _block("translating", (3, 4.3, 4.6), (8, 8, 8), (112, 16, 16), np.zeros((3, 3)), (1.0, 0.0, 0.0), 93 * DX)


def rotating() -> Scene:
    """10 x 10 x 8 cells, 8 particles per cell, about z at 1 rad/s for 1 s."""
    spin = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    return _block("rotating", (11, 11, 4), (10, 10, 8), (32, 32, 16), spin, (0.0, 0.0, 0.0), 1.0)


def _block(
    name: str,
    low: tuple[float, float, float],
    edge: tuple[int, int, int],
    grid_shape: tuple[int, int, int],
    affine: np.ndarray,
    drift: tuple[float, float, float],
    duration: float,
) -> Scene:
    """Two particles per cell and axis, shaken; velocity is drift + affine (x - centre)."""
    place = np.stack(np.meshgrid(*(np.arange(2 * e) for e in edge), indexing="ij"), axis=-1).reshape(-1, 3)
    shaken = 0.25 + 0.5 * np.random.default_rng(SEED).random(place.shape)
    position = DX * (np.array(low) + (place + shaken) / 2)
    centre = DX * (np.array(low) + np.array(edge) / 2)
    dataset = Dataset.from_arrays(
        position,
        np.array(drift) + (position - centre) @ affine.T,
        1.0,
        np.broadcast_to(affine, (len(place), 3, 3)),
        grid_shape=grid_shape,
        dx=DX,
        name=name,
    )
    return Scene(name, dataset, centre, duration)


def run(device: Device, quick: bool, tick: Tick) -> Outcome:
    begin = time.perf_counter()
    steps = QUICK_STEPS if quick else STEPS
    drifts = [
        advance(scene, device, dtype, spline, weights, steps, tick)
        for scene in (translating(), rotating())
        for dtype, spline, weights in RUNS
    ]
    return Outcome(
        "drift",
        "Drift of free APIC bodies: weights=plain against weights=unity",
        f"{steps:,} steps of P2G, divide, G2P and x += dt v without forces. Totals over the particles, added exactly.",
        (_table(drifts, own_kind(device)),),
        tuple(problems_of(drifts)),
        time.perf_counter() - begin,
    )


def advance(scene: Scene, device: Device, dtype: str, spline: str, weights: str, steps: int, tick: Tick) -> Drift:
    """Run one scene for ``steps`` of its own number; the duration is cut alike."""
    axes = {"dtype": dtype, "spline": spline, "weights": weights, "payload": "apic"}
    pair = RoundTrip(scene.dataset, device, "p2g_global_atomic", "g2p_global_gather", axes)
    start = pair.particle_totals()
    for step in range(1, steps + 1):
        pair.scatter()
        pair.gather()
        pair.advect(scene.duration / STEPS)
        tick(f"{scene.name} {dtype} {spline} {weights}: steps", step, steps)
    end = pair.particle_totals()
    lost = end.momentum - start.momentum
    speed = float((scene.dataset.mass * np.linalg.norm(scene.dataset.velocity, axis=1)).sum())
    turns = scene.name == "rotating"
    size = float(np.linalg.norm(_about(start, scene.centre)))
    return Drift(
        scene.name, dtype, spline, weights, steps,
        momentum=float(np.abs(lost).max()) / speed,
        angular=_largest(_about(end, scene.centre) - _about(start, scene.centre)) / size if turns else None,
        angular_node=_largest(end.angular - start.angular) / size if turns else None,
    )  # fmt: skip


def problems_of(drifts: Sequence[Drift]) -> list[str]:
    """Bounds that do not hold, one line each. About the far node there is none: see docs/splines.md."""
    found = []
    for drift in drifts:
        for quantity in ("momentum", "angular"):
            error = getattr(drift, quantity)
            if error is not None and not error <= drift.allowed:
                found.append(
                    f"{drift.scene} {drift.dtype} {drift.spline} weights={drift.weights}: {quantity} off by "
                    f"{error:.2e} after {drift.steps} steps, allowed {drift.allowed:.2e}"
                )
    return found


def _about(totals: Totals, centre: np.ndarray) -> np.ndarray:
    """Angular momentum about ``centre``, given as a distance from node (0, 0, 0) [m]."""
    return totals.angular - np.cross(centre, totals.momentum)


def _largest(vector: np.ndarray) -> float:
    return float(np.abs(vector).max())


def _table(drifts: Sequence[Drift], kind: Kind) -> Table:
    columns = (
        label("body"),
        label("dtype"),
        label("spline"),
        label("weights"),
        Column("steps", Kind.NAME, Quantity.COUNT),
        Column("momentum", kind),
        Column("angular momentum, own centre", kind),
        Column("angular momentum, node (0, 0, 0)", kind),
        Column("allowed", Kind.PREDICTED),
    )
    rows = [
        (d.scene, d.dtype, d.spline, d.weights, d.steps, d.momentum, d.angular, d.angular_node, d.allowed)
        for d in drifts
    ]
    notes = ("Momentum relative to sum m |v|, angular momentum to its own size at the start. Allowed for momentum and "
             "for angular momentum about the body's own centre.",)  # fmt: skip
    return make_table("Drift of the totals", columns, rows, notes)
