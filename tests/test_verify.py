"""Verification: totals are exact, round trips are the reference's, bounds are judged, figures keep their kind."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from transfers import crowded

from mpmbench import device as devices
from mpmbench import verify
from mpmbench.cli import main
from mpmbench.dataset import Dataset
from mpmbench.presets import published_rows
from mpmbench.reference import g2p, grid_divide, p2g
from mpmbench.report.table import Kind
from mpmbench.verify import drift, table_3, table_4
from mpmbench.verify.round_trip import RoundTrip
from mpmbench.verify.totals import exact_sum, node_totals, pairwise_sum, particle_totals, sequential_sum

GLOBAL = ("p2g_global_atomic", "g2p_global_gather")
BLOCK = ("p2g_block_sync", "g2p_block_gather")
LITERAL = {"writing": "literal"}  # compiles fastest


@pytest.fixture(scope="module")
def device():
    return devices.open_device("simulated", arch="sm_52", mode="run")


# --- totals -----------------------------------------------------------------------------------------------------------


def test_sums_differ_by_how_they_round() -> None:
    assert exact_sum(np.array([1e16, 1.0, -1e16, 1.0])) == 2
    ones = np.full(4001, 1, np.float32)
    ones[0] = 2**24
    assert sequential_sum(ones) == 2**24, "one float32 accumulator stops counting there"
    assert 2**24 + 3500 < pairwise_sum(ones) < exact_sum(ones) == 2**24 + 4000
    assert sequential_sum(ones[:0]) == 0


def test_particle_totals_by_their_definition() -> None:
    dataset = crowded()
    attributes = np.zeros((5, dataset.particle_count, 4))
    attributes[0, :, :3], attributes[0, :, 3] = dataset.position, dataset.mass
    attributes[1, :, :3] = dataset.velocity
    attributes[2:, :, :3] = dataset.affine.swapaxes(0, 1)
    found = particle_totals(attributes, dataset.grid, 3.0)
    arm, m = dataset.position - np.array(dataset.grid.origin), dataset.mass
    c = dataset.affine
    spin = np.stack([c[:, 2, 1] - c[:, 1, 2], c[:, 0, 2] - c[:, 2, 0], c[:, 1, 0] - c[:, 0, 1]], axis=1)
    angular = m @ np.cross(arm, dataset.velocity) + dataset.grid.dx**2 / 3 * (m @ spin)
    assert found.mass == pytest.approx(m.sum(), rel=1e-14)
    np.testing.assert_allclose(found.momentum, m @ dataset.velocity, rtol=1e-12)
    np.testing.assert_allclose(found.angular, angular, rtol=1e-12)
    pic = particle_totals(attributes[:2], dataset.grid, 3.0)
    np.testing.assert_allclose(pic.angular, m @ np.cross(arm, dataset.velocity), rtol=1e-12)


def test_totals_of_nodes_are_those_of_particles(device) -> None:
    """An APIC scatter in float64 keeps all seven; a node's place in the array is its place in space."""
    pair = RoundTrip(crowded(), device, *GLOBAL, LITERAL | {"dtype": "float64", "payload": "apic"})
    before = pair.particle_totals()
    pair.scatter()
    after = pair.node_totals()
    assert after.mass == pytest.approx(before.mass, rel=1e-14)
    size = np.abs(before.momentum).max()
    np.testing.assert_allclose(after.momentum, before.momentum, atol=1e-13 * size)
    np.testing.assert_allclose(after.angular, before.angular, atol=1e-13 * np.abs(before.angular).max())
    lonely = np.zeros((pair.grid.node_count, 4))
    lonely[(2 * 10 + 4) * 13 + 5] = (0, 1, 0, 1)  # node (5, 4, 2), momentum along y
    np.testing.assert_allclose(node_totals(lonely, pair.grid).angular, 0.125 * np.array([-2, 0, 5]))


# --- round trips ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("payload", ["pic", "apic"])
@pytest.mark.parametrize("names", [GLOBAL, BLOCK], ids=["global", "block"])
def test_two_trips_are_those_of_the_reference(device, names, payload: str) -> None:
    more = {"block_shape": (4, 4, 4), "batching": 4} if names is BLOCK else {}
    order = "deep" if names is BLOCK else "given"
    axes = {"dtype": "float64", "payload": payload, "particle_order": order, **LITERAL}
    pair = RoundTrip(crowded(), device, *names, axes | more)
    dataset = dataset_of(pair)
    for _ in range(2):
        pair.scatter()
        pair.gather()
        velocity = grid_divide(p2g(dataset, "cubic", payload, "float64").nodes)
        values = g2p(dataset, velocity, "cubic", payload, "float64").value
        dataset = replace(dataset, velocity=values[:3].T.copy())
        if payload == "apic":
            dataset = replace(dataset, affine=values[3:].T.reshape(-1, 3, 3).copy())
    now = pair.particles()
    np.testing.assert_allclose(now[1, :, :3], dataset.velocity, atol=1e-12)
    np.testing.assert_array_equal(now[0, :, :3], dataset.position, "positions are fixed")
    if payload == "apic":
        np.testing.assert_allclose(now[2:, :, :3].swapaxes(0, 1), dataset.affine, atol=1e-10)


def dataset_of(pair: RoundTrip) -> Dataset:
    """What the device holds, in the order in which it holds it."""
    attributes = pair.particles()
    affine = attributes[2:, :, :3].swapaxes(0, 1) if len(attributes) > 2 else None
    return Dataset.from_arrays(
        attributes[0, :, :3], attributes[1, :, :3], attributes[0, :, 3], affine,
        grid_shape=pair.grid.shape, dx=pair.grid.dx, origin=pair.grid.origin,
    )  # fmt: skip


def test_advection_moves_positions_and_nothing_else(device) -> None:
    pair = RoundTrip(crowded(), device, *GLOBAL, LITERAL | {"dtype": "float64", "payload": "apic"})
    before = pair.particles()
    pair.advect(0.25)
    after = pair.particles()
    np.testing.assert_allclose(after[0, :, :3], before[0, :, :3] + 0.25 * before[1, :, :3], rtol=1e-15)
    np.testing.assert_array_equal(after[0, :, 3], before[0, :, 3], "mass")
    np.testing.assert_array_equal(after[1:], before[1:])


# --- table 4 ----------------------------------------------------------------------------------------------------------


def test_table_4_tells_the_transfer_from_the_sum(device, monkeypatch) -> None:
    monkeypatch.setattr(table_4, "RUNS", (("pic", "plain", 250),))
    monkeypatch.setattr(table_4, "QUICK_PARTICLES", 5000)
    monkeypatch.setattr(table_4, "QUICK_GRID_SHAPE", (16, 16, 16))
    ticks = []
    outcome = table_4.run(device, True, lambda *tick: ticks.append(tick))
    assert outcome.problems == ()
    assert ticks == [("pic plain: round trips", trip, 5) for trip in range(1, 6)]
    sums, history = outcome.tables
    assert [[c.value for c in row.cells[:3]] for row in sums.rows] == [
        [row["row"], float(row["abs_error"]), float(row["rel_error"])] for row in published_rows(4)
    ]
    assert sums.columns[1].kind is Kind.PUBLISHED
    mass = {column.title: cell.value for column, cell in zip(sums.columns, sums.rows[0].cells, strict=True)}
    assert 0 < mass["rel. error, exact sum"] < 2e-7
    assert mass["abs. error, exact sum"] == pytest.approx(5000 * mass["rel. error, exact sum"], rel=1e-6)
    assert mass["rel., float32 one by one"] > 3 * mass["rel. error, exact sum"]
    assert [row.cells[2].value for row in history.rows] == [1, 5]


def test_the_particles_of_table_4_are_a_million_of_a_kilogram() -> None:
    assert (table_4.PARTICLES, table_4.GRID_SHAPE, table_4.RUNS[0]) == (10**6, (128, 128, 128), ("pic", "plain", 1000))
    dataset = table_4.particles(quick=True)
    assert math.isclose(dataset.mass.sum(), dataset.particle_count)
    assert not np.allclose(dataset.velocity, dataset.velocity[0])


def test_bounds_of_table_4_are_judged() -> None:
    eps = float(np.finfo(np.float32).eps)
    held = table_4.Drift("apic", "unity", 100, 0.2 * eps, 20 * eps, 20 * eps)
    assert table_4.problems_of([held]) == []
    for broken in (replace(held, mass=0.3 * eps), replace(held, momentum=30 * eps), replace(held, angular=math.nan)):
        assert len(table_4.problems_of([broken])) == 1
    assert table_4.problems_of([replace(held, weights="plain", mass=eps)]) == []


# --- drift ------------------------------------------------------------------------------------------------------------


def test_unity_keeps_momentum_that_plain_weights_lose(device) -> None:
    found = {}
    for scene in (drift.translating(), drift.rotating()):
        for weights in ("plain", "unity"):
            found[scene.name, weights] = drift.advance(scene, device, "float32", "cubic", weights, 40, lambda *_: None)
    assert drift.problems_of(list(found.values())) == []
    assert found["translating", "plain"].momentum > 10 * found["translating", "unity"].momentum
    plain, unity = found["rotating", "plain"], found["rotating", "unity"]
    assert plain.angular is not None
    assert unity.angular is not None
    assert plain.angular > 8 * unity.angular
    # As fast as the sum of the weights is off: 0.35 eps on each axis and in each step.
    assert plain.angular == pytest.approx(40 * 3 * 0.35 * np.finfo(np.float32).eps, rel=0.15)


def test_bounds_of_the_drift_are_judged() -> None:
    eps = float(np.finfo(np.float64).eps)
    held = drift.Drift("rotating", "float64", "cubic", "plain", 10, 14 * eps, 14 * eps, 99 * eps)
    assert held.allowed == pytest.approx(15 * eps)
    assert drift.problems_of([held]) == []
    for broken in (replace(held, momentum=16 * eps), replace(held, angular=math.inf), replace(held, weights="unity")):
        assert drift.problems_of([broken])


# --- table 3 ----------------------------------------------------------------------------------------------------------


def test_vectors_fill_the_unit_ball() -> None:
    """A mean length of 3/4 is what the printed errors say: absolute over relative error is the total."""
    printed = published_rows(3)[4]
    assert float(printed["abs_error"]) / float(printed["rel_error"]) / 1024**2 == pytest.approx(0.75, abs=0.002)
    length = table_3.mapped(table_3.random_elements("float4", 40_000))
    assert length.mean() == pytest.approx(0.75, abs=0.005)
    assert length.max() <= 1 + 1e-6


def test_bounds_of_table_3_are_judged(device) -> None:
    for row, element, operator in table_3.MAPS:
        error = table_3.map_error(device, row, element, operator, 3000)
        assert table_3.problems_of([error], 3000) == []
        assert table_3.problems_of([replace(error, largest=1e-6)], 3000)
    for row, element, operator in table_3.REDUCTIONS:
        error = table_3.reduction_error(device, row, element, operator, 3000)
        assert table_3.problems_of([error], 3000) == []
        assert table_3.problems_of([replace(error, relative=math.nan)], 3000)


# --- command line -----------------------------------------------------------------------------------------------------


def invoke(*words: object, code: int = 0) -> str:
    result = CliRunner().invoke(main, ["verify", *(str(word) for word in words)])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == code, result.output
    return result.output


def test_figures_keep_their_kind_in_every_form(tmp_path) -> None:
    files = [tmp_path / "out" / name for name in ("verify.json", "verify.md")]
    text = invoke("--quick", "--part", "table3", "--json", files[0], "--md", files[1])
    assert "every bound holds" in text
    assert "2.71e-04" in text or "0.000271" in text
    content = json.loads(files[0].read_text())
    assert [part["name"] for part in content["parts"]] == ["table3"]
    table = content["parts"][0]["tables"][0]
    assert len({column["title"] for column in table["columns"]}) == len(table["columns"])
    kinds = {column["title"]: column["kind"] for column in table["columns"]}
    assert set(kinds.values()) == {"name", "published", "simulated"}
    assert len(table["rows"]) == 7
    assert "212.813" in files[1].read_text()
    assert "(published)" in files[1].read_text()


def test_a_bound_that_does_not_hold_ends_with_its_own_exit_code(monkeypatch) -> None:
    monkeypatch.setattr(table_3, "problems_of", lambda errors, count: ["map off by 1, allowed 0"])
    assert "NOT HELD: map off by 1, allowed 0" in invoke("--quick", "--part", "table3", code=4)


def test_what_cannot_be_asked_for_is_refused(tmp_path) -> None:
    assert "unknown part 'table5': valid are table3, table4, drift" in invoke("--part", "table5", code=2)
    assert "is a folder" in invoke("--quick", "--json", tmp_path, code=2)
    assert set(verify.PARTS) == {"table3", "table4", "drift"}
