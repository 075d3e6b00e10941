"""The check passes what rounds as kernels do, in every order of adding, and refuses what is wrong by far."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from emulation import Emulation
from test_spline import textbook

from mpmbench.awkward import awkward_datasets
from mpmbench.check import C1, C2, C3, C_ADD, allowance, check_g2p, check_p2g
from mpmbench.dataset import Dataset, load_dataset
from mpmbench.errors import InputError
from mpmbench.reference import Nodes, ParticleValues, g2p, grid_divide, p2g
from mpmbench.spline import SPLINES

PAYLOADS = ("pic", "apic")
DTYPES = ("float32", "float64")


def small_recipes() -> dict[str, Dataset]:
    """Every recipe at a size that fits a test, on grids with a step that float32 cannot hold exactly."""
    plain = {"grid_shape": (24, 20, 28), "dx": 1 / 30, "origin": (0.1, -3.0, 0.7)}
    sizes = {"random": 3000, "uniform_cube": 4000, "clustered": 2000, "one_cell": 1500, "lattice": 2000, "sheet": 2000}
    datasets = {name: load_dataset(name, particles=count, **plain) for name, count in sizes.items()}
    return datasets | {"splash": load_dataset("splash", particles=5000)}


RECIPES = small_recipes()


def orders(dataset: Dataset) -> dict[str, np.ndarray]:
    n = dataset.particle_count
    by_cell = np.lexsort(np.floor(dataset.node_units()).T)
    return {
        "given": np.arange(n),
        "reversed": np.arange(n)[::-1],
        "by cell": by_cell,
        "shuffled": np.random.default_rng(3).permutation(n),
        "light first": np.argsort(dataset.mass),
    }


@pytest.mark.parametrize("spline", SPLINES)
@pytest.mark.parametrize("dtype", DTYPES)
def test_honest_rounding_passes_with_room(spline, dtype):
    worst = 0.0
    for dataset in (*awkward_datasets(spline).values(), *RECIPES.values()):
        for payload in PAYLOADS:
            nodes = p2g(dataset, spline, payload, dtype)
            field = grid_divide(nodes.nodes)
            particles = g2p(dataset, field, spline, payload, dtype)
            for name, order in orders(dataset).items():
                unity = name in ("given", "by cell")
                emulation = Emulation(dataset, spline, payload, dtype, unity, order)
                results = [check_p2g(emulation.p2g(), nodes)]
                if name == "given":
                    results.append(check_g2p(emulation.g2p(field), particles))
                for result in results:
                    assert result.passed, f"{dataset.name}, {payload}, {name}: {result}, {result.conserved}"
                    worst = max(worst, result.ratio)
                    if dataset.particle_count:
                        assert "momentum" in result.conserved
    assert 0.01 < worst < 0.5  # neither close to refusing nor of another order of magnitude


def test_identical_particles_round_all_the_same_way_and_pass():
    n = 3000
    dataset = Dataset.from_arrays(
        np.tile([0.513, 0.477, 0.556], (n, 1)),
        np.tile([1.1, -0.3, 0.7], (n, 1)),
        1 / 3000,
        grid_shape=(9, 9, 9),
        dx=0.125,
    )
    reference = p2g(dataset, "cubic", "pic", "float32")
    result = check_p2g(Emulation(dataset, "cubic", "pic", "float32").p2g(), reference)
    assert result.passed
    assert result.ratio > 0.3  # adding up is what the allowance is made of here


@pytest.mark.parametrize("spline", ["quadratic", "cubic"])
def test_either_cell_will_do_for_a_particle_on_a_face(spline):
    """A kernel that rounds xi otherwise may put a particle on a face into the cell below."""
    face = 3 + SPLINES[spline].shift
    xi = np.random.default_rng(0).permuted([[face, 4.2, 5.7], [face, face, 6.1], [face, face, face]] * 10, axis=1)
    dataset = Dataset.from_arrays(0.25 * xi, np.sin(xi), 0.5, grid_shape=(9, 9, 9), dx=0.25)
    nudged = replace(dataset, position=dataset.position * (1 - np.finfo(np.float32).eps))
    for payload in PAYLOADS:
        nodes = p2g(dataset, spline, payload, "float32")
        field = grid_divide(nodes.nodes)
        particles = g2p(dataset, field, spline, payload, "float32")
        emulation = Emulation(nudged, spline, payload, "float32")
        assert (emulation.node < SPLINES[spline].bin_node(dataset.node_units(np.float32))).any(axis=1).all()
        assert check_p2g(emulation.p2g(), nodes).passed
        assert check_g2p(emulation.g2p(field), particles).passed
        # Also where the support is at rest and only the node below it moves.
        beyond = np.zeros((9, 9, 9, 3))
        beyond[3 - SPLINES[spline].left - 1] = 1
        result = emulation.g2p(beyond)
        assert result.velocity.any()
        assert check_g2p(result, g2p(dataset, beyond, spline, payload, "float32")).passed


# Each defect takes a correct float32 result to a wrong one. All must be refused, and stand out tenfold somewhere.


def dropped_particle(emulation: Emulation) -> Nodes:
    emulation.mass = emulation.mass.copy()
    emulation.mass[len(emulation.mass) // 2] = 0
    return emulation.p2g()


def scaled_weight(emulation: Emulation) -> Nodes:
    emulation.w[1][1] *= np.float32(1 + 1e-3)
    return emulation.p2g()


def shifted_node(emulation: Emulation) -> Nodes:
    result = emulation.p2g()
    return Nodes(np.roll(result.mass, 1, axis=0), np.roll(result.momentum, 1, axis=0))


def swapped_axes(emulation: Emulation) -> Nodes:
    result = emulation.p2g()
    return Nodes(result.mass, result.momentum[..., [1, 0, 2]])


def swapped_node_axes(emulation: Emulation) -> Nodes:
    result = emulation.p2g()
    return Nodes(result.mass.swapaxes(0, 1), result.momentum.swapaxes(0, 1))


def mixed_up_masses(emulation: Emulation) -> Nodes:
    emulation.mass = np.roll(emulation.mass, 1)
    return emulation.p2g()


DEFECTS = (dropped_particle, scaled_weight, shifted_node, swapped_axes, swapped_node_axes, mixed_up_masses)


@pytest.mark.parametrize("defect", DEFECTS, ids=lambda defect: defect.__name__)
@pytest.mark.parametrize("spline", SPLINES)
@pytest.mark.parametrize("payload", PAYLOADS)
def test_wrong_nodes_are_refused_tenfold(defect, spline, payload):
    ratios = {}
    for dataset in (awkward_datasets(spline)["size_127"], awkward_datasets(spline)["size_1025"]):
        reference = p2g(dataset, spline, payload, "float32")
        result = check_p2g(defect(Emulation(dataset, spline, payload, "float32")), reference)
        assert not result.passed
        ratios[dataset.name] = result.ratio
    assert max(ratios.values()) >= 10, ratios


@pytest.mark.parametrize("spline", SPLINES)
@pytest.mark.parametrize("payload", PAYLOADS)
def test_wrong_particles_are_refused_tenfold(spline, payload):
    dataset = awkward_datasets(spline)["size_127"]
    field = grid_divide(p2g(dataset, spline, payload, "float32").nodes)
    reference = g2p(dataset, field, spline, payload, "float32")
    right = Emulation(dataset, spline, payload, "float32").g2p(field)
    assert check_g2p(right, reference).passed
    scaled = Emulation(dataset, spline, payload, "float32")
    scaled.w[1][1] *= np.float32(1 + 1e-3)
    wrong = {
        "scaled weight": scaled.g2p(field),
        "unwritten particle": ParticleValues(np.where(np.arange(127)[:, None] == 126, 0, right.velocity), right.affine),
        "mixed-up particles": ParticleValues(right.velocity[::-1], right.affine),
        "swapped axes": ParticleValues(right.velocity[:, [1, 0, 2]], right.affine),
    }
    if payload == "apic":
        assert right.affine is not None
        wrong["transposed affine"] = ParticleValues(right.velocity, right.affine.swapaxes(1, 2))
        wrong["affine of a finer grid"] = ParticleValues(right.velocity, right.affine * 2)
    for name, particles in wrong.items():
        result = check_g2p(particles, reference)
        assert not result.passed, name
        assert result.ratio >= 10, name


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_non_finite_results_are_refused_and_located(value):
    dataset = awkward_datasets()["uneven_grid"]
    reference = p2g(dataset, "cubic", "pic", "float32")
    result = Emulation(dataset, "cubic", "pic", "float32").p2g()
    result.momentum[3, 15, 2, 1] = value
    verdict = check_p2g(result, reference)
    assert not verdict.passed
    assert (verdict.quantity, verdict.worst_node, verdict.worst_error) == ("momentum y", (3, 15, 2), np.inf)
    assert not verdict.conserved["momentum"].passed
    assert verdict.conserved["mass"].passed
    assert str(verdict) == (
        f"FAILED: worst error inf of allowed {verdict.allowed:.3g} in momentum y at (3, 15, 2); not conserved: momentum"
    )


def test_mass_where_no_particle_reaches_is_refused():
    dataset = awkward_datasets()["one"]
    reference = p2g(dataset, "cubic", "pic", "float32")
    result = Emulation(dataset, "cubic", "pic", "float32").p2g()
    result.mass[15, 15, 15] = 1e-30
    verdict = check_p2g(result, reference)
    assert (verdict.passed, verdict.worst_node, verdict.allowed, verdict.ratio) == (False, (15, 15, 15), 0.0, np.inf)


def test_a_small_loss_everywhere_is_refused_by_conservation_alone():
    dataset = load_dataset("uniform_cube", particles=32_000)  # around xi = 64 a node may be off by more than a total
    reference = p2g(dataset, "cubic", "pic", "float32")
    nodes = reference.nodes
    share = 1.5e-5
    verdict = check_p2g(Nodes(nodes.mass * (1 - share), nodes.momentum), reference)
    assert verdict.ratio < 1
    assert not verdict.passed
    assert not verdict.conserved["mass"].passed
    assert verdict.conserved["mass"].drift == pytest.approx(share)
    assert verdict.conserved["momentum"].passed


def test_angular_momentum_counts_the_affine_part():
    for spline in SPLINES:
        dataset = awkward_datasets(spline)["size_127"]
        right = p2g(dataset, spline, "apic", "float32")
        without = p2g(replace(dataset, affine=np.zeros((127, 3, 3))), spline, "apic", "float32")
        assert "angular momentum" not in check_p2g(right.nodes, p2g(dataset, spline, "pic", "float32")).conserved
        verdict = check_p2g(without.nodes, right)
        assert verdict.conserved["momentum"].passed
        if spline == "linear":
            assert "angular momentum" not in verdict.conserved  # not promised
            continue
        total = verdict.conserved["angular momentum"]
        assert total.drift > 10 * total.allowed
        assert check_p2g(right.nodes, right).conserved["angular momentum"].drift < 1e-14
        field = grid_divide(right.nodes)
        particles = g2p(dataset, field, spline, "apic", "float32")
        forgot = ParticleValues(particles.particles.velocity, np.zeros((127, 3, 3)))
        total = check_g2p(forgot, particles).conserved["angular momentum"]
        assert total.drift > 10 * total.allowed


def on_a_node(particles: int = 30) -> Dataset:
    """Random particles, the first one at rest on a node, where weights have no gradient but distances do."""
    drawn = load_dataset("random", particles=particles, grid_shape=(9, 7, 8), dx=0.5)
    position, velocity = drawn.position.copy(), drawn.velocity.copy()
    position[0], velocity[0] = (2.0, 1.5, 1.5), 0
    return replace(drawn, position=position, velocity=velocity)


def slopes(term, xi: np.ndarray) -> np.ndarray:
    """Sum over the axes of |d term / d xi|, by central differences."""
    h = 1e-6
    return sum(np.abs(term(xi + e) - term(xi - e)) for e in h * np.eye(3)) / (2 * h)


@pytest.mark.parametrize("spline", SPLINES)
@pytest.mark.parametrize("particles", [1, 30])
def test_sums_of_p2g_by_brute_force(spline, particles):
    """Exact for PIC; the affine ones bound the exact sums."""
    dataset = on_a_node(particles)
    xi = dataset.node_units()
    pic, apic = (p2g(dataset, spline, payload, "float64").sums for payload in PAYLOADS)
    index = np.stack(np.indices(dataset.grid.shape), axis=-1)
    weighted, gradient, affine_weighted, affine_gradient = (np.zeros((4, *dataset.grid.shape)) for _ in range(4))
    terms = np.zeros(dataset.grid.shape)
    for p in range(particles):

        def weight(x):
            return textbook(spline, x - index).prod(axis=-1)

        def affine_term(x, p=p):
            velocity = dataset.velocity[p] + (index - x) @ dataset.affine[p].T * dataset.grid.dx
            return dataset.mass[p] * weight(x)[..., None] * velocity

        quantity = dataset.mass[p] * np.concatenate([[1], np.abs(dataset.velocity[p])])
        weighted += quantity[:, None, None, None] * weight(xi[p])
        gradient += quantity[:, None, None, None] * slopes(weight, xi[p])
        affine_weighted[1:] += np.moveaxis(np.abs(affine_term(xi[p])), -1, 0)
        affine_gradient[1:] += np.moveaxis(slopes(affine_term, xi[p]), -1, 0)
        terms += (np.abs(xi[p] - index) < SPLINES[spline].nodes / 2).all(axis=-1)
    np.testing.assert_allclose(pic.weighted, weighted, atol=1e-15)
    # Central differences fail at the linear spline's kink, where the first particle is; it has no momentum.
    compared = slice(1 if spline == "linear" else 0, 4)
    np.testing.assert_allclose(pic.gradient[compared], gradient[compared], atol=1e-9)
    assert (pic.terms >= terms).all()
    assert pic.terms.sum() == particles * SPLINES[spline].nodes ** 3
    assert (pic.plain >= pic.weighted).all()
    assert (pic.plain[0] >= dataset.mass.min() * terms).all()
    assert (apic.weighted >= affine_weighted * (1 - 1e-12)).all()
    reached = pic.terms > 0  # the linear spline's cell is fixed, so a kink on its border is no way out
    assert (apic.gradient >= affine_gradient - 1e-9)[:, reached].all()


@pytest.mark.parametrize("spline", SPLINES)
@pytest.mark.parametrize("spread", ["everywhere", "one node"])
def test_sums_of_g2p_by_brute_force(spline, spread):
    dataset, rule = on_a_node(), SPLINES[spline]
    xi, dx = dataset.node_units(), dataset.grid.dx
    field = np.random.default_rng(2).normal(size=(*dataset.grid.shape, 3))
    if spread == "one node":
        field[np.abs(np.stack(np.indices(dataset.grid.shape), axis=-1) - xi[0]).max(axis=-1) > 0] = 0
    sums = g2p(dataset, field, spline, "apic", "float64").sums
    index = np.stack(np.indices(dataset.grid.shape), axis=-1)
    for p in range(1 if spline == "linear" else 0, 30):  # central differences fail at the linear spline's kink

        def weight(x):
            return textbook(spline, x - index).prod(axis=-1)

        def factor(x, p=p):
            if rule.affine_factor is not None:
                return weight(x)[..., None] * (index - x) * rule.affine_factor / dx
            w, slope = textbook(spline, x - index), np.sign(index - x) * (np.abs(index - x) < 1)
            return np.stack([slope[..., a] * np.delete(w, a, axis=-1).prod(axis=-1) for a in range(3)], axis=-1) / dx

        speed = np.abs(field)
        np.testing.assert_allclose(sums.weighted[:3, p], np.einsum("ijk,ijkc", weight(xi[p]), speed), atol=1e-14)
        np.testing.assert_allclose(sums.gradient[:3, p], np.einsum("ijk,ijkc", slopes(weight, xi[p]), speed), atol=1e-8)
        size = np.einsum("ijka,ijkc->ca", np.abs(factor(xi[p])), speed).ravel()
        slope = np.einsum("ijka,ijkc->ca", slopes(factor, xi[p]), speed).ravel()
        assert (sums.weighted[3:, p] >= size * (1 - 1e-12)).all()
        assert (sums.gradient[3:, p] >= slope - 1e-7).all()
        assert (sums.plain[:3, p] >= sums.weighted[:3, p]).all()


def test_allowance_is_the_sums_with_their_constants():
    reference = p2g(on_a_node(), "cubic", "pic", "float32")
    sums, eps, far = reference.sums, np.finfo(np.float32).eps, reference.max_xi
    assert far == pytest.approx(np.abs(on_a_node().node_units()).max(), rel=1e-6)
    expected = (C1 + C_ADD * sums.terms) * sums.weighted + C2 * far * sums.gradient + C3 * far**2 * eps * sums.plain
    np.testing.assert_allclose(allowance(reference), eps * expected, rtol=1e-6, atol=1e-30)


def test_constants_stay_small():
    assert max(C1, C2, C3) <= 16


def test_wrong_shapes_are_errors():
    dataset = awkward_datasets()["uneven_grid"]
    nodes = p2g(dataset, "cubic", "apic", "float32")
    with pytest.raises(InputError, match=r"mass has shape \(21, 13, 10\), want \(13, 21, 10\)"):
        check_p2g(Nodes(nodes.nodes.mass.swapaxes(0, 1), nodes.nodes.momentum), nodes)
    with pytest.raises(InputError, match=r"momentum has shape \(13, 21, 10\), want \(13, 21, 10, 3\)"):
        check_p2g(Nodes(nodes.nodes.mass, nodes.nodes.mass), nodes)
    particles = g2p(dataset, grid_divide(nodes.nodes), "cubic", "apic", "float32")
    with pytest.raises(InputError, match=r"velocity has shape \(3, 500\), want \(500, 3\)"):
        check_g2p(ParticleValues(particles.particles.velocity.T), particles)
    with pytest.raises(InputError, match="payload apic, but the result has no affine"):
        check_g2p(ParticleValues(particles.particles.velocity), particles)


def test_nothing_to_compare_passes():
    dataset = awkward_datasets()["none"]
    nodes = p2g(dataset, "cubic", "apic", "float32")
    verdict = check_p2g(nodes.nodes, nodes)
    assert (verdict.passed, verdict.worst_error, verdict.ratio) == (True, 0.0, 0.0)
    particles = g2p(dataset, grid_divide(nodes.nodes), "cubic", "apic", "float32")
    verdict = check_g2p(particles.particles, particles)
    assert (verdict.passed, verdict.worst_node) == (True, None)
    assert str(verdict) == "passed: nothing to compare"
