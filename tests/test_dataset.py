"""Recipes make what they say, bit for bit; users' particles are checked and every mistake is one clear line."""

from __future__ import annotations

import tracemalloc
import zipfile

import numpy as np
import pytest

from mpmbench import dataset as dataset_module
from mpmbench.awkward import awkward_datasets
from mpmbench.dataset import Dataset, list_datasets, load_dataset
from mpmbench.errors import InputError
from mpmbench.recipes import Uniform, rotation
from mpmbench.spline import SPLINES

NAMES = [recipe.name for recipe in list_datasets()]
SMALL = {"particles": 3000}


def cells_of(dataset, dtype=np.float64):
    return np.floor(dataset.node_units(dtype)).astype(int)


def counts_of(dataset, dtype=np.float64):
    return np.unique(cells_of(dataset, dtype), axis=0, return_counts=True)[1]


# --- recipes ----------------------------------------------------------------------------------------------------------


def test_every_recipe_is_listed_with_a_summary():
    assert NAMES == [
        "clustered", "lattice", "one_cell", "random", "random_moved", "sheet", "splash", "uniform_cube",
        "uniform_cube_shuffled",
    ]  # fmt: skip
    assert all(recipe.summary and "\n" not in recipe.summary for recipe in list_datasets())


# Only +, -, *, / and floor of PCG64's raw output are in these, so they hold on every machine. (The order of
# uniform_cube also takes sine and cosine of 30 degrees and one cube root, none of which comes near a site's border.)
FINGERPRINTS = {
    ("random", 1000): "62a7053c75c071c9175d58e2e1b610c2857058e99c1840d23c95db9fa7585266",
    ("random_moved", 1000): "7b4248c11e577562835f7cb2d497c2090149bcee5085de154d7fc294356e87ed",
    ("uniform_cube", 1000): "bd18c66f5171c3add867f95bcc1961d79ed139cb2485491bb428e42eec588dbe",
    ("uniform_cube_shuffled", 1000): "7b211bd29ad3c522b3ac412806275a0310bfc66e5a11d932f87c8fa91b121abc",
    ("lattice", 1000): "f8bd93c6aed16118ff5268409df9e8f145c70827ffc33b8beac1ba3df0b9553b",
    ("one_cell", 1000): "21f05fc273b85f7741df79be5585391a892d9de804fec083ba2047de11882632",
    ("sheet", 1000): "9aeaf33e7b3f1fef3151367ddfdb7062f8208cd7c76e6e4086e86cd66381f4b9",
    ("splash", 65536): "1aa11efa1dc132b59a943a32f28e1a3afc2fee4a2c524f134835d07d25695516",
}


@pytest.mark.parametrize(("name", "particles"), FINGERPRINTS)
def test_fingerprints_are_pinned(name, particles):
    assert load_dataset(name, particles=particles).fingerprint == FINGERPRINTS[name, particles]


def test_the_published_dataset_is_pinned_at_full_size():
    dataset = load_dataset("uniform_cube")
    assert dataset.particle_count == 1_000_188 == 4 * 63**3
    assert dataset.fingerprint == "5632a708305f29711a57d48d041f5da3b659b7574ae0199ff5c2cd6baefe0a24"
    for dtype in (np.float32, np.float64):
        cell = cells_of(dataset, dtype)
        assert (np.bincount(np.ravel_multi_index(tuple(cell.T), dataset.grid.shape)).max()) == 4
        assert (cell.min(axis=0).tolist(), cell.max(axis=0).tolist()) == ([32] * 3, [94] * 3)
    assert dataset.particles_per_cell == 4
    # Neither sorted nor shuffled: neighbours in memory are mostly in touching cells, but seldom in the same.
    assert 0.1 < dataset.statistics["same_cell_fraction"] < 0.5
    assert dataset.statistics["near_cell_fraction"] > 0.8


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("particles", [0, 1, 31, 1000])
def test_any_number_of_particles_and_every_spline(name, particles):
    dataset = load_dataset(name, particles=particles)
    assert dataset.position.shape == dataset.velocity.shape == (particles, 3)
    assert dataset.affine.shape == (particles, 3, 3)
    assert dataset.mass.shape == (particles,)
    assert dataset.recipe["particles"] == particles
    for spline in SPLINES:
        for dtype in (np.float32, np.float64):
            dataset.check_support(spline, dtype)


@pytest.mark.parametrize("name", [name for name in NAMES if name != "splash"])
def test_any_grid_and_any_seed(name):
    grid = {"grid_shape": (13, 21, 34), "dx": 0.3, "origin": (-1, 0.1, 1000)}
    first, again, other = (load_dataset(name, particles=500, seed=seed, **grid) for seed in (5, 5, 6))
    assert first.grid.shape == (13, 21, 34)
    assert first.fingerprint == again.fingerprint != other.fingerprint
    assert (first.seed, other.seed) == (5, 6)
    for spline in SPLINES:
        first.check_support(spline, np.float32)
    assert first.recipe["origin"] == [-1, 0.1, 1000]


@pytest.mark.parametrize("per_cell", [1, 2, 4, 8])
@pytest.mark.parametrize("name", ["uniform_cube", "uniform_cube_shuffled"])
def test_uniform_cube_has_exactly_k_per_cell(name, per_cell):
    dataset = load_dataset(name, particles=5 * per_cell * 49 + 3, particles_per_cell=per_cell)
    for dtype in (np.float32, np.float64):
        full, last = divmod(dataset.particle_count, per_cell)
        expected = [per_cell] * full + ([last] if last else [])
        assert sorted(counts_of(dataset, dtype), reverse=True) == expected
    cells = np.unique(cells_of(dataset), axis=0)
    layers = np.bincount(cells[:, 2])[cells[:, 2].min() :]
    assert len(set(layers[:-1])) == 1  # only the top layer is partial
    assert layers[-1] <= layers[0]


def test_shuffled_cube_has_the_positions_of_the_cube_in_another_order():
    cube, shuffled = (load_dataset(name, **SMALL) for name in ("uniform_cube", "uniform_cube_shuffled"))
    assert not np.array_equal(cube.position, shuffled.position)
    np.testing.assert_array_equal(*(d.position[np.lexsort(d.position.T)] for d in (cube, shuffled)))
    assert shuffled.statistics["mean_jump_cells"] > 3 * cube.statistics["mean_jump_cells"]


def test_cube_on_a_flat_grid_grows_sideways_and_says_when_it_is_full():
    grid = {"grid_shape": (40, 40, 6), "particles_per_cell": 2}
    dataset = load_dataset("uniform_cube", particles=2 * 3 * 20 * 20, **grid)
    assert np.ptp(cells_of(dataset), axis=0).tolist() == [19, 19, 2]
    assert load_dataset("uniform_cube", particles=2 * 37 * 37 * 3, **grid).particle_count == 8214
    with pytest.raises(InputError, match=r"8215 particles at 2 per cell need 4108 cells, .* has room for 4107"):
        load_dataset("uniform_cube", particles=8215, **grid)


def test_random_fills_its_box_evenly():
    dataset = load_dataset("random", particles=50_000, grid_shape=(24, 12, 36))
    xi = dataset.node_units()
    assert (xi.min(axis=0) >= 1).all()
    assert (xi.max(axis=0) < np.array([22, 10, 34])).all()
    np.testing.assert_allclose(xi.mean(axis=0), [11.5, 5.5, 17.5], atol=0.15)
    np.testing.assert_allclose(xi.std(axis=0), np.array([21, 9, 33]) / np.sqrt(12), rtol=0.02)
    assert np.abs(dataset.velocity).max() <= 1
    np.testing.assert_allclose(dataset.mass.sum(), 1, rtol=0.02)


def test_one_cell_lattice_and_sheet_are_what_they_say():
    assert len(counts_of(load_dataset("one_cell"))) == 1
    lattice = load_dataset("lattice", particles=8 * 50)
    np.testing.assert_array_equal(np.unique(lattice.node_units() % 1), [0.25, 0.75])
    assert lattice.statistics["same_cell_fraction"] == pytest.approx(7 / 8, abs=0.01)
    with pytest.raises(InputError, match="cube number of particles per cell"):
        load_dataset("lattice", particles_per_cell=4)
    sheet = load_dataset("sheet", particles=8 * 3 * 21 * 21, grid_shape=(24, 24, 30))
    assert (counts_of(sheet) == 8).all()
    columns = np.unique(np.unique(cells_of(sheet), axis=0)[:, :2], axis=0, return_counts=True)[1]
    assert (columns == 3).all()  # three sheets, one cell thick each


def test_clusters_follow_a_power_law():
    dataset = load_dataset("clustered", particles=100_000)
    histogram = dataset.statistics["histogram"]
    assert dataset.statistics["max_per_cell"] > 50 * dataset.particles_per_cell
    assert sorted(histogram.values(), reverse=True) == list(histogram.values())  # ever fewer ever fuller cells


def test_splash_is_embedded_with_an_empty_layer():
    dataset = load_dataset("splash")
    assert dataset.grid.shape == (66, 66, 66)
    assert dataset.grid.dx == 1 / 64
    assert dataset.grid.origin == (-1 / 64,) * 3
    assert dataset.seed is None
    part = load_dataset("splash", particles=1000)
    assert len(np.unique(part.position, axis=0)) == 1000
    with pytest.raises(InputError, match="'splash' has 65536 particles, not 70000"):
        load_dataset("splash", particles=70_000)


def test_numbers_come_from_named_streams():
    uniform = Uniform(3)
    np.testing.assert_array_equal(uniform("a", 4), uniform("a", 2, 2).ravel())
    assert not np.array_equal(uniform("a", 4), uniform("b", 4))
    assert 0 <= uniform("a", 1000).min() < 0.01 < 0.99 < uniform("a", 1000).max() < 1
    np.testing.assert_allclose(rotation([0, 0, 2], 90) @ [1, 0, 0], [0, 1, 0], atol=1e-15)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"name_or_path": "uniform_cub"}, "unknown dataset 'uniform_cub': valid are clustered, lattice, one_cell, "),
        ({"name_or_path": "random", "particles_per_cell": 2}, "'random' has no parameter 'particles_per_cell'"),
        ({"name_or_path": "splash", "seed": 2}, "'splash' has no parameter 'seed'"),
        ({"name_or_path": "random", "particles": -1}, "particles is -1; it must be a whole number of at least 0"),
        ({"name_or_path": "random", "particles": 1e6}, "particles is 1000000.0; it must be a whole number"),
        ({"name_or_path": "uniform_cube", "particles_per_cell": 0}, "particles_per_cell is 0; .* at least 1"),
        ({"name_or_path": "random", "seed": -3}, "seed is -3; it must be a whole number of at least 0"),
        ({"name_or_path": "random", "grid_shape": (8, 3, 8)}, "too small for a recipe: give at least 4 nodes"),
        ({"name_or_path": "random", "grid_shape": (8, 8)}, "must be three positive whole numbers"),
        ({"name_or_path": "random", "dx": 0}, "dx is 0 m; it must be positive and finite"),
    ],
)
def test_bad_recipe_requests(given, message):
    with pytest.raises(InputError, match=message) as error:
        load_dataset(**given)
    assert "\n" not in str(error.value)


# --- a user's own particles -------------------------------------------------------------------------------------------


def arrays(n=5):
    rng = np.random.default_rng(0)
    return {
        "position": rng.uniform(2, 6, (n, 3)),
        "velocity": rng.uniform(-1, 1, (n, 3)),
        "mass": rng.uniform(1, 2, n),
        "affine": rng.uniform(-1, 1, (n, 3, 3)),
        "grid_shape": (9, 10, 11),
        "dx": 1.0,
    }


def spoiled(name, index, value):
    given = arrays()
    given[name] = given[name].copy()
    given[name][index] = value
    return given


def test_from_arrays_copies_and_freezes():
    given = arrays()
    dataset = Dataset.from_arrays(**given)
    before = dataset.fingerprint
    given["position"][0] = 5.0
    assert dataset.fingerprint == before
    with pytest.raises(ValueError, match="read-only"):
        dataset.velocity[0] = 1
    plain = Dataset.from_arrays(**(arrays() | {"mass": np.float32(0.5), "affine": None, "position": [[3, 4, 5]] * 5}))
    assert plain.mass.tolist() == [0.5] * 5
    assert not plain.affine.any()
    assert plain.position.dtype == np.float64


def test_fingerprint_sees_every_array_and_the_grid():
    variations = [
        {},
        *(spoiled(name, 0, 2.5) for name in ("position", "velocity", "mass", "affine")),
        {"dx": 1.01},
        {"grid_shape": (10, 9, 11)},
        {"origin": (0, 0, 0.1)},
    ]
    prints = {Dataset.from_arrays(**(arrays() | variation)).fingerprint for variation in variations}
    assert len(prints) == len(variations)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"position": np.zeros((5, 2))}, r"position has shape \(5, 2\), want \(n, 3\)"),
        ({"velocity": np.zeros((4, 3))}, r"velocity has shape \(4, 3\), want \(5, 3\) as position has 5 rows"),
        ({"mass": np.ones((5, 1))}, r"mass has shape \(5, 1\), want \(5,\)"),
        ({"affine": np.zeros((5, 9))}, r"affine has shape \(5, 9\), want \(5, 3, 3\)"),
        ({"velocity": np.zeros((5, 3), complex)}, "velocity has dtype complex128, want real numbers"),
        ({"mass": ["heavy"] * 5}, "mass has dtype <U5, want real numbers"),
        (spoiled("position", (3, 1), np.nan), r"position of particle 3 is not finite: \["),
        (spoiled("affine", (2, 1, 0), np.inf), "affine of particle 2 is not finite"),
        (spoiled("mass", 4, np.nan), "mass of particle 4 is not finite"),
        (spoiled("mass", 1, 0), "mass of particle 1 is 0 kg; every mass must be positive"),
        ({"mass": -1}, "mass of particle 0 is -1 kg"),
        ({"grid_shape": (9, 10)}, "must be three positive whole numbers"),
        ({"grid_shape": (9, 10, 11.5)}, "must be three positive whole numbers"),
        ({"grid_shape": "big"}, "grid shape 'big'"),
        ({"grid_shape": (9, 10, np.inf)}, "must be three positive whole numbers"),
        ({"grid_shape": np.ones((3, 3))}, "must be three positive whole numbers"),
        ({"grid_shape": (2**62,) * 3}, r"2\^31 nodes or more"),
        ({"dx": np.ones(3)}, "must be one number"),
        ({"dx": 1e-310}, "so must 1 / dx"),
        ({"origin": 0.0}, "three finite numbers"),
        ({"dx": -1}, "dx is -1 m; it must be positive and finite"),
        ({"dx": np.nan}, "dx is nan m"),
        ({"origin": (0, 0, np.inf)}, "three finite numbers"),
        (
            spoiled("position", 2, 9.5),
            r"particle 2 at \(9.5, 9.5, 9.5\) m is outside the box \(0, 0, 0\) <= x < \(8, 9, 10",
        ),
    ],
)
def test_bad_arrays_are_named(given, message):
    with pytest.raises(InputError, match=message) as error:
        Dataset.from_arrays(**(arrays() | given))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("spline", "low", "high"), [("linear", 0.0, 8.0), ("quadratic", 0.5, 7.5), ("cubic", 1.0, 7.0)]
)
def test_support_box_per_spline(spline, low, high):
    def place(x):
        given = arrays() | {"grid_shape": (9, 9, 9)}
        given["position"] = np.full((5, 3), 4.0)
        given["position"][3, 1] = x
        return Dataset.from_arrays(**given)

    for inside in (low, np.nextafter(np.float32(high), np.float32(0))):
        place(inside).check_support(spline, np.float32)
    outside = [high] if spline == "linear" else [np.nextafter(low, 0), high]
    for x in outside:
        with pytest.raises(InputError, match="particle 3 at") as error:
            place(x).check_support(spline, np.float64)
        if spline != "linear":
            assert f"<= x < ({high:g}, {high:g}, {high:g}) m in which {spline} support stays on the grid" in str(
                error.value
            )


def test_support_is_judged_in_the_dtype_of_the_kernel():
    given = arrays() | {"grid_shape": (9, 9, 9)}
    given["position"][0] = np.nextafter(7.0, 0)  # rounds to 7 in float32
    dataset = Dataset.from_arrays(**given)
    dataset.check_support("cubic", np.float64)
    with pytest.raises(InputError, match="particle 0"):
        dataset.check_support("cubic", np.float32)


@pytest.mark.parametrize(
    ("label", "value", "message"),
    [
        ("velocity", 1e39, "momentum of all particles .* float32 .* particle 2"),
        ("affine", 1e39, "momentum of all particles"),
        ("mass", 1e39, "mass of all particles .* particle 2"),
        ("mass", 1e-39, "mass of particle 2 is 1e-39 kg, less than"),
    ],
)
def test_what_a_number_type_cannot_hold_is_refused(label, value, message):
    given = arrays()
    given[label] = given[label].copy()
    given[label][2] = value
    dataset = Dataset.from_arrays(**given)
    dataset.check_support("linear", np.float64)
    with pytest.raises(InputError, match=message):
        dataset.check_support("linear", np.float32)


def test_statistics_need_no_memory_for_empty_cells():
    given = arrays() | {"grid_shape": (1200, 1200, 1200)}  # 14 GB if every cell had a count
    tracemalloc.start()
    statistics = Dataset.from_arrays(**given).statistics
    assert tracemalloc.get_traced_memory()[1] < 1e6
    tracemalloc.stop()
    assert sum(statistics["histogram"].values()) == statistics["occupied_cells"]


# --- files ------------------------------------------------------------------------------------------------------------


def test_npz_round_trip(tmp_path):
    path = tmp_path / "mine.npz"
    given = arrays() | {"origin": (0.5, 0, 0), "colour": np.arange(5)}
    np.savez(path, **given)
    dataset = load_dataset(path)
    assert dataset.name == "mine.npz"
    np.testing.assert_array_equal(dataset.position, given["position"])
    np.testing.assert_array_equal(dataset.affine, given["affine"])
    assert dataset.grid == dataset_module.Grid((9, 10, 11), 1.0, (0.5, 0.0, 0.0))
    assert load_dataset(str(path), particles=2, dx=1.25).position.tolist() == given["position"][[0, 2]].tolist()
    with pytest.raises(InputError, match="has no parameter 'seed': it is data"):
        load_dataset(path, seed=1)


def test_npz_with_a_cubic_grid_and_one_mass(tmp_path):
    path = tmp_path / "mine.npz"
    given = arrays() | {"grid": np.int32(12), "mass": 0.25}
    del given["grid_shape"], given["affine"]
    np.savez(path, **given)
    dataset = load_dataset(path)
    assert dataset.grid.shape == (12, 12, 12)
    assert dataset.mass.tolist() == [0.25] * 5
    assert not dataset.affine.any()


def test_npy_has_seven_columns_and_takes_its_grid_from_the_call(tmp_path):
    path, given = tmp_path / "mine.npy", arrays()
    np.save(path, np.column_stack([given["position"], given["velocity"], given["mass"]]).astype(np.float32))
    dataset = load_dataset(path, grid_shape=(9, 10, 11), dx=1)
    np.testing.assert_array_equal(dataset.mass, given["mass"].astype(np.float32))
    with pytest.raises(InputError, match=r"has no 'grid_shape': add nodes per axis to the .npz, or give grid_shape="):
        load_dataset(path)
    np.save(path, given["position"])
    with pytest.raises(InputError, match=r"has shape \(5, 3\), want \(n, 7\): columns x, y, z, vx, vy, vz, mass"):
        load_dataset(path)


def test_bad_files(tmp_path):
    def refused(path, message):
        with pytest.raises(InputError, match=message) as error:
            load_dataset(path)
        assert "\n" not in str(error.value)

    refused(tmp_path / "none.npz", "no such file: .*none.npz")
    for name, content in (("text.npz", b"x,y,z\n1,2,3\n"), ("empty.npy", b""), ("cut.npy", b"\x93NUMPY\x01\x00v\x00{")):
        (tmp_path / name).write_bytes(content)
        refused(tmp_path / name, f"{name}' is not a readable .np. of plain numbers")
    close = {name: value for name, value in arrays(10).items() if name != "affine"}
    np.savez(tmp_path / "close.npz", affin=np.zeros((10, 3, 3)), **close)
    refused(tmp_path / "close.npz", "has an array 'affin': rename it to 'affine'")
    np.savez(tmp_path / "whole.npz", **arrays(1000))
    whole = (tmp_path / "whole.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(whole[: len(whole) // 2])
    refused(tmp_path / "cut.npz", "is not a readable .npz")
    (tmp_path / "flipped.npz").write_bytes(whole[:3000] + bytes([whole[3000] ^ 255]) + whole[3001:])
    refused(tmp_path / "flipped.npz", "is not a readable .npz")
    with zipfile.ZipFile(tmp_path / "zip.npz", "w") as archive:
        archive.writestr("readme.txt", "nothing here")
    refused(tmp_path / "zip.npz", "lacks position, velocity, mass")
    np.save(tmp_path / "objects.npy", np.array([{}, 1], dtype=object), allow_pickle=True)
    refused(tmp_path / "objects.npy", "is not a readable .npy of plain numbers")
    with (tmp_path / "giant.npy").open("wb") as file:  # only the head of far more rows than any memory holds
        np.lib.format.write_array_header_1_0(file, {"descr": "<f8", "fortran_order": False, "shape": (10**14, 7)})
    refused(tmp_path / "giant.npy", "is not a readable .npy")
    (tmp_path / "text.npz").write_text("x,y,z")
    refused(tmp_path / "text.npz", "something else")
    (tmp_path / "folder.npz").mkdir()
    refused(tmp_path / "folder.npz", "is not a readable .npz")
    given = arrays()
    del given["velocity"], given["mass"]
    np.savez(tmp_path / "half.npz", **given)
    refused(tmp_path / "half.npz", "lacks velocity, mass: want arrays position, velocity, mass and optionally affine, ")
    np.savez(tmp_path / "nan.npz", **spoiled("velocity", (4, 0), np.nan))
    refused(tmp_path / "nan.npz", "dataset 'nan.npz': velocity of particle 4 is not finite")
    np.savez(tmp_path / "flat.npz", **(arrays() | {"position": np.float64(3)}))
    refused(tmp_path / "flat.npz", r"position has shape \(\), want \(n, 3\)")
    np.savez(tmp_path / "vector_dx.npz", **(arrays() | {"dx": [1.0, 1.0, 1.0]}))
    refused(tmp_path / "vector_dx.npz", "dx")


# --- statistics and awkward datasets ----------------------------------------------------------------------------------


def test_statistics_of_a_handful_of_particles():
    xi = np.array([[1.5, 1, 1], [1.7, 1, 1], [2.5, 1, 1], [4.5, 1, 1], [9.5, 5, 1], [1.6, 1, 1]])
    dataset = Dataset.from_arrays(0.5 * xi, 0 * xi, 1, grid_shape=(12, 12, 12), dx=0.5)
    statistics = dataset.statistics
    jumps = [0.2, 0.8, 2, np.hypot(5, 4), np.hypot(7.9, 4)]
    assert statistics.pop("mean_jump_cells") == pytest.approx(np.mean(jumps))
    assert statistics.pop("mean_per_occupied_cell") == pytest.approx(6 / 4)
    assert statistics == {
        "occupied_cells": 4,
        "occupied_blocks_8x4x4": 2,
        "max_per_cell": 3,
        "same_cell_fraction": 0.2,
        "near_cell_fraction": 0.4,
        "histogram": {"1": 3, "2": 0, "3-4": 1},
    }


def test_statistics_of_no_particle_are_zero():
    assert awkward_datasets()["none"].statistics == {
        "occupied_cells": 0,
        "occupied_blocks_8x4x4": 0,
        "mean_per_occupied_cell": 0.0,
        "max_per_cell": 0,
        "same_cell_fraction": 0.0,
        "near_cell_fraction": 0.0,
        "mean_jump_cells": 0.0,
        "histogram": {},
    }


@pytest.mark.parametrize("spline", SPLINES)
def test_awkward_datasets_are_legal_and_awkward(spline):
    datasets = awkward_datasets(spline)
    for dataset in datasets.values():
        for dtype in (np.float32, np.float64):
            dataset.check_support(spline, dtype)
    for name, dataset in datasets.items():
        if name != "domain_edge":
            for other in SPLINES:
                dataset.check_support(other, np.float32)
    assert {name: d.particle_count for name, d in datasets.items() if name.startswith("size_")} == {
        "size_31": 31, "size_33": 33, "size_127": 127, "size_1025": 1025,
    }  # fmt: skip
    assert len(counts_of(datasets["all_in_one_cell"])) == len(counts_of(datasets["two_in_one_cell"])) == 1
    assert not (datasets["on_nodes"].node_units(np.float32) % 1).any()
    borders = cells_of(datasets["block_borders"], np.float32)
    assert {3, 4, 7, 8, 11, 12} == set(np.unique(borders))
    shifted = datasets["shifted_origin"]
    assert (shifted.grid.dx, shifted.grid.origin) != (1.0, (0.0, 0.0, 0.0))
    mass = datasets["huge_mass_ratio"].mass
    assert mass.max() / mass.min() > 1e11
    edge, rule = datasets["domain_edge"], SPLINES[spline]
    node = rule.bin_node(edge.node_units(np.float32))
    assert (node.min(axis=0) - rule.left).tolist() == [0, 0, 0]
    assert (node.max(axis=0) + rule.right).tolist() == [n - 1 for n in edge.grid.shape]
