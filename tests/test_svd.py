"""Polar SVD and polar decomposition, held to maxima over sets of hard matrices, against float64."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import re

import numpy as np
import pytest
from matrix_sets import COUNT, LARGE, SETS, matrices

from mpmbench import device as devices
from mpmbench.device import Launch
from mpmbench.device.ptxas import kernel_infos
from mpmbench.environment import Environment
from mpmbench.kernel import COMPILE_OPTIONS, KernelSource, load_source
from mpmbench.operations.decomposition import (
    WRONG,
    Reference,
    judge,
    polar_errors,
    real_constants,
    reference,
    svd_errors,
)
from mpmbench.primitive_runs import PrimitiveCase
from mpmbench.primitives import get
from mpmbench.runner import Inputs
from mpmbench.simt.nvrtc import compile_cuda

DTYPES = ("float32", "float64")
OUTPUTS = {"svd_polar": (9, 3, 9), "polar_decompose": (9, 6)}  # entries of each
FINITE_SETS = [name for name in SETS if not name.startswith("U15")]

# What each set's worst matrix may miss, relative to its largest singular value. Nothing is exempt, not the graded one.
ACCEPTED = {
    "float32": {"reconstruction": 2e-6, "singular values": 1e-6, "stretch": 2e-6, "orthogonality": 2e-6,
                "determinant": 2e-6, WRONG: 0},
    "float64": {"reconstruction": 1e-13, "singular values": 1e-13, "stretch": 1e-13, "orthogonality": 1e-13,
                "determinant": 1e-13, WRONG: 0},
}  # fmt: skip

# A result of size 1e-39 is a denormal float, and rounding it is not the kernel's choice. In spacings of denormals:
ROUNDING = {"svd_polar": {"singular values": 0.5}, "polar_decompose": {"stretch": 1.5, "reconstruction": 1.5}}


@pytest.fixture(scope="module")
def device():
    return devices.open_device("simulated", arch="sm_52", mode="run")


def planar(a: np.ndarray) -> np.ndarray:
    """(n, 3, 3) to the device's (9, n)."""
    return np.ascontiguousarray(a.reshape(-1, 9).T)


def source_of(name: str, dtype: str, *edits: tuple[str, str]) -> KernelSource:
    """A kernel's source; edits replace texts (regular expressions) that occur exactly once."""
    source = load_source(name, real_constants(dtype))
    text = source.text
    for old, new in edits:
        text, times = re.subn(old, lambda match, new=new: match.expand(new), text, flags=re.S)
        assert times == 1, f"{old!r} occurs {times} times"
    return dataclasses.replace(source, text=text, sha256=hashlib.sha256(text.encode()).hexdigest())


def decompose(device, name: str, f: np.ndarray, *edits: tuple[str, str]) -> list[np.ndarray]:
    """The outputs of a kernel for matrices (9, n)."""
    kernel = device.compile(source_of(name, f.dtype.name, *edits), name)
    count = f.shape[1]
    outputs = [device.empty((entries, count), f.dtype) for entries in OUTPUTS[name]]
    args = (np.int32(count), device.upload(f), *outputs)
    report = device.launch(Launch(name, kernel, (-(-count // 128), 1, 1), (128, 1, 1), args))
    assert not report.findings
    return [device.download(output) for output in outputs]


@functools.lru_cache(maxsize=2)
def exact_set(name: str, dtype: str, count: int) -> tuple[np.ndarray, Reference]:
    f = planar(matrices(name, np.dtype(dtype), count))
    return f, reference(f)


def errors_of(kernel: str, exact: Reference, outputs: list[np.ndarray]) -> dict[str, np.ndarray]:
    return svd_errors(exact, *outputs) if kernel == "svd_polar" else polar_errors(exact, *outputs)


def errors_on(device, kernel: str, name: str, dtype: str, *edits: tuple[str, str], count: int = COUNT):
    f, exact = exact_set(name, dtype, count)
    return errors_of(kernel, exact, decompose(device, kernel, f, *edits))


# --- accuracy ---------------------------------------------------------------------------------------------------------


def test_means_of_the_thesis(device) -> None:
    """Section 6.1: one million random matrices, no sign error, mean error of singular values and determinants."""
    f, exact = exact_set("U1 uniform", "float32", LARGE)
    u, s, v = (a.astype(float) for a in decompose(device, "svd_polar", f))
    values = exact.values * np.exp2(exact.exponent)
    assert np.abs(s - values).mean() <= 4.9e-7
    clear = np.abs(values[2]) > 1e-6
    assert (np.sign(s) == np.sign(values))[:, clear].all()
    for rotation, mean in ((u, 3.6e-7), (v, 3.3e-7)):
        assert np.abs(np.linalg.det(rotation.T.reshape(-1, 3, 3)) - 1).mean() <= mean


@pytest.mark.parametrize("kernel", OUTPUTS)
@pytest.mark.parametrize(("name", "dtype"), [(name, dtype) for name in FINITE_SETS for dtype in DTYPES])
def test_maxima(device, kernel: str, name: str, dtype: str) -> None:
    count = LARGE if (name, dtype) == ("U1 uniform", "float32") else COUNT
    spacing = exact_set(name, dtype, count)[1].spacing
    for quantity, error in errors_on(device, kernel, name, dtype, count=count).items():
        excess = error - ROUNDING[kernel].get(quantity, 0) * spacing
        assert excess.max() <= ACCEPTED[dtype][quantity], f"{quantity} of matrix {excess.argmax()}"


@pytest.mark.parametrize("dtype", DTYPES)
def test_only_the_smallest_value_is_negative_and_only_where_the_determinant_is(device, dtype: str) -> None:
    for name, negative in (("U13 inverted", True), ("U8 double values", False), ("U5 rotations", False)):
        _, s, _ = decompose(device, "svd_polar", exact_set(name, dtype, COUNT)[0])
        assert (s[:2] > 0).all()
        assert ((s[2] < 0) == negative).all()


@pytest.mark.parametrize("kernel", OUTPUTS)
@pytest.mark.parametrize("dtype", DTYPES)
def test_powers_of_two_change_nothing(device, kernel: str, dtype: str) -> None:
    """Bit by bit, from the smallest normal numbers to the largest: scaling is exact."""
    f = planar(matrices("U1 uniform", np.dtype(dtype), 1000))
    f[:, np.abs(f).min(axis=0) < 1e-2] = 0.5  # so that no entry becomes a denormal
    *rotations, s = values_last(kernel, decompose(device, kernel, f))
    limits = np.finfo(dtype)
    for power in (limits.minexp + 8, limits.minexp + 40, -40, 1, 77, limits.maxexp - 3):
        *shifted, shifted_s = values_last(kernel, decompose(device, kernel, np.ldexp(f, power)))
        for a, b in zip(rotations, shifted, strict=True):
            np.testing.assert_array_equal(a, b)
        # Values may be denormals, which round.
        np.testing.assert_array_equal(np.ldexp(s, power), shifted_s)


def values_last(kernel: str, outputs: list[np.ndarray]) -> list[np.ndarray]:
    return [outputs[0], outputs[2], outputs[1]] if kernel == "svd_polar" else outputs


@pytest.mark.parametrize("kernel", OUTPUTS)
def test_hardware_may_round_reciprocals_and_roots_less_well(device, kernel: str) -> None:
    """Two units in the last place, in both directions: what CUDA promises of its float approximations."""
    less_accurate = [
        (r"= rsqrtf\(a\)", "= 1.00000024f * rsqrtf(a)"),
        (r"= rsqrt\(size \* size", "= 1.00000024f * rsqrt(size * size"),
        (r"= rsqrt\(c_square\)", "= 0.99999976f * rsqrt(c_square)"),
        (r"= __fdividef\(1\.0f, a\)", "= 0.99999976f * __fdividef(1.0f, a)"),
    ]
    for name in ("U1 uniform", "U6 scaled rotations", "U12 graded"):
        for quantity, error in errors_on(device, kernel, name, "float32", *less_accurate).items():
            assert error.max() <= ACCEPTED["float32"][quantity], f"{name}: {quantity}"


# --- numbers at the ends of the type ----------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("kernel", OUTPUTS)
def test_what_is_not_finite_is_flagged_and_its_neighbours_are_not(device, kernel: str, dtype: str) -> None:
    bad = planar(matrices("U15 not finite", np.dtype(dtype)))
    assert all(np.isnan(a).all() for a in decompose(device, kernel, bad))
    # Each entry on its own, between finite matrices of the same warp.
    f = np.ones((9, 60), dtype)
    for entry in range(9):
        f[entry, 6 * entry : 6 * entry + 6 : 2] = np.nan, np.inf, -np.inf
    for a in decompose(device, kernel, f):
        flagged = np.isnan(a)
        assert (flagged == ~np.isfinite(f).all(axis=0)).all()


@pytest.mark.parametrize("dtype", DTYPES)
def test_ends_of_the_type(device, dtype: str) -> None:
    limits = np.finfo(dtype)
    diagonal = np.array([0, -0.0, limits.smallest_subnormal, 3 * limits.smallest_subnormal, limits.tiny, limits.max])
    f = planar(diagonal[:, None, None] * np.eye(3)).astype(dtype)
    for u, s, v in (decompose(device, "svd_polar", f), decompose(device, "svd_polar", -f)):
        for rotation in (u, v):
            assert (np.abs(np.abs(rotation.reshape(3, 3, -1)).sum(axis=0) - 1) <= 4 * limits.eps).all()
        np.testing.assert_array_max_ulp(np.abs(s[:, :-1]), np.abs(np.tile(diagonal[:-1].astype(dtype), (3, 1))), 4)
        assert (np.abs(s[:, -1].astype(float)) >= (1 - 8 * limits.eps) * float(limits.max)).all()
    # Beyond the type: a singular value of three times the largest number.
    u, s, v = decompose(device, "svd_polar", np.full((9, 1), limits.max, dtype))
    assert np.isinf(s[0, 0])
    assert all(np.isfinite(a).all() for a in (u, s[1:], v))


# --- broken on purpose ------------------------------------------------------------------------------------------------

COLUMNS_ONLY_SORTED = (r"= jacobi_angle\(difference, real\(2\) \* dot\(a, b\)\)", "= {1, 0, 0}")
FOUR_SWEEPS = (r"SWEEPS = REAL_IS_DOUBLE \? 4 : 3", "SWEEPS = 4")
# McAdams et al.: (2 (pp - qq), pq) for half the angle where that is small, pi/8 where not.
APPROXIMATE = (
    r"const JacobiAngle angle = jacobi_angle\(pp - qq, real\(2\) \* pq\);.*?pq = 0;(.*?)return \{real\(1\) \+ angle.c,",
    r"""
    const real ch = 2 * (pp - qq), w = rsqrt(ch * ch + pq * pq);
    const bool small = real(5.8284271) * pq * pq < ch * ch;
    const Angle h = small ? Angle{w * ch, w * pq} : Angle{real(0.92387953), real(0.38268343)};
    const Angle angle = {h.c * h.c - h.s * h.s, 2 * h.c * h.s};
    const real old_pp = pp, old_qq = qq, old_pq = pq, cc = angle.c * angle.c, cs = angle.c * angle.s;
    const real ss = angle.s * angle.s;
    pp = cc * old_pp + 2 * cs * old_pq + ss * old_qq;
    qq = ss * old_pp - 2 * cs * old_pq + cc * old_qq;
    pq = (cc - ss) * old_pq + cs * (old_qq - old_pp);\1return h; return {angle.c,""",
)


@pytest.mark.parametrize(
    ("edits", "name", "quantity", "least"),
    [
        ([(r"SWEEPS = REAL_IS_DOUBLE \? 4 : 3", "SWEEPS = 2")], "U1 uniform", "reconstruction", 1e-4),
        ([APPROXIMATE, FOUR_SWEEPS, COLUMNS_ONLY_SORTED], "U1 uniform", "reconstruction", 1e-4),
        ([COLUMNS_ONLY_SORTED, FOUR_SWEEPS], "U12 graded", "reconstruction", 1e-5),
        ([(r"const int k = exponent - BIAS - 2;", "const int k = 0;")], "U14 extreme scales", "reconstruction", 1e-2),
        ([(r"const bool lifted = exponent < LIFT / 2;", "const bool lifted = false;")],
         "U14 extreme scales", "reconstruction", 1e-2),
        ([(r"const bool swap = difference < real\(0\);", "const bool swap = false;")],
         "U1 uniform", "singular values", 0.1),
        ([(r"const real middle = min\(b\.y, a\.x\);", "const real middle = b.y;")], "U5 rotations", WRONG, np.inf),
        ([(r"copysign\(size, a\) \* inverse", "size * inverse")], "U1 uniform", "reconstruction", 0.1),
        ([(r"u = rotation_matrix\(scale\.mark\(qu\)\)", "u = rotation_matrix(scale.mark(qu)); u.z = scaled(u.z, -1)")],
         "U1 uniform", "determinant", 1),
    ],
    ids=["two sweeps", "approximate angles", "no sweep on columns", "not scaled", "denormals flushed", "not sorted",
         "rounding not sorted", "angles halved", "reflection"],
)  # fmt: skip
def test_maxima_notice(device, edits, name: str, quantity: str, least: float) -> None:
    _, exact = exact_set(name, "float32", COUNT)
    errors = errors_on(device, "svd_polar", name, "float32", *edits)
    assert errors[quantity].max() >= least
    assert not judge(errors, exact, "float32").passed


def test_a_mean_does_not_notice(device) -> None:
    """Four sweeps with approximate angles, wrong by 1e-3 and more, meet the thesis's mean: hence maxima."""
    f, exact = exact_set("U1 uniform", "float32", COUNT)
    u, s, v = decompose(device, "svd_polar", f, APPROXIMATE, FOUR_SWEEPS, COLUMNS_ONLY_SORTED)
    assert np.abs(exact.scaled(s) - exact.values).mean() <= 4.9e-7
    assert svd_errors(exact, u, s, v)["reconstruction"].max() >= 1e-3


def test_wrong_results_are_refused(device) -> None:
    """One defect in one matrix of many."""
    f, exact = exact_set("U13 inverted", "float32", COUNT)
    u, s, v = decompose(device, "svd_polar", f)
    r, stretch = decompose(device, "polar_decompose", f)
    assert judge(svd_errors(exact, u, s, v), exact, "float32").passed
    assert judge(polar_errors(exact, r, stretch), exact, "float32").passed
    last = COUNT - 1

    def refuse(quantity: str, **changed: np.ndarray) -> None:
        result = {"u": u, "s": s, "v": v, "r": r, "stretch": stretch} | changed
        errors = (
            polar_errors(exact, result["r"], result["stretch"])
            if {"r", "stretch"} & set(changed)
            else svd_errors(exact, result["u"], result["s"], result["v"])
        )
        check = judge(errors, exact, "float32")
        assert not check.passed
        assert check.quantity == quantity
        assert check.worst_node == (last,)

    def change(a: np.ndarray, rows, value) -> np.ndarray:
        a = a.copy()
        a[rows, last] = value
        return a

    columns = [0, 3, 6], [1, 4, 7]
    both = {name: change(a, [*columns[0], *columns[1]], a[[*columns[1], *columns[0]], last]) for name, a in
            (("u", u), ("v", v))}  # fmt: skip
    refuse(WRONG, s=change(s, [0, 1], s[[1, 0], last]), **both)
    refuse("singular values", s=change(s, 2, -s[2, last]))
    refuse("reconstruction", v=change(v, slice(None), u[:, last]))
    refuse("orthogonality", u=change(u, 0, u[0, last] + 0.5))
    refuse("reconstruction", u=change(u, 4, np.nan))
    refuse("reconstruction", r=change(r, slice(None), np.eye(3).ravel()))
    # A reflection as R, with S positive definite: the usual polar decomposition, not the one promised.
    full = np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2]])
    values, vectors = np.linalg.eigh(stretch[full, last].astype(float))
    mirror = vectors @ np.diag(np.sign(values)) @ vectors.T
    positive = (vectors @ np.diag(np.abs(values)) @ vectors.T)[[0, 1, 2, 0, 1, 2], [0, 1, 2, 1, 2, 0]]
    reflection = (r[:, last].reshape(3, 3) @ mirror).ravel()
    refuse("determinant", r=change(r, slice(None), reflection), stretch=change(stretch, slice(None), positive))


# --- the kernels as kernels -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kernel", OUTPUTS)
@pytest.mark.parametrize(("dtype", "registers"), [("float32", 40), ("float64", 72)])
@pytest.mark.parametrize("arch", ["sm_52", "sm_90"])
def test_a_matrix_lives_in_registers_and_no_lane_loops(kernel: str, dtype: str, registers: int, arch: str) -> None:
    ptx = compile_cuda(source_of(kernel, dtype).text, arch, COMPILE_OPTIONS)
    info = kernel_infos(ptx, arch)[kernel]
    assert (info.local_bytes, info.spill_bytes, info.shared_bytes) == (0, 0, 0)
    assert info.registers <= registers
    lines = ptx.splitlines()
    labels = {line[:-1]: number for number, line in enumerate(lines) if re.match(r"\$\S+:$", line)}
    jumps = [(number, match[1]) for number, line in enumerate(lines) if (match := re.search(r"\bbra.*(\$\S+);", line))]
    assert jumps
    assert all(labels[target] > number for number, target in jumps)


@pytest.mark.parametrize("kernel", OUTPUTS)
def test_other_modes(device, kernel: str) -> None:
    """The debug mode has nothing to object and gives the same bits. The oracle rounds roots in its own way."""
    f = np.concatenate([planar(matrices(name, np.float32, 24)) for name in SETS], axis=1)[:, :-3]
    modes = {mode: devices.open_device("simulated", arch="sm_52", mode=mode) for mode in ("debug", "oracle")}
    for a, b in zip(decompose(device, kernel, f), decompose(modes["debug"], kernel, f), strict=True):
        np.testing.assert_array_equal(a, b)
    exact, outputs = reference(f), decompose(modes["oracle"], kernel, f)
    assert judge(errors_of(kernel, exact, outputs), exact, "float32").passed


@pytest.mark.parametrize("kernel", OUTPUTS)
@pytest.mark.parametrize("dtype", DTYPES)
def test_primitives_move_each_number_once_and_lanes_stay_together(kernel: str, dtype: str) -> None:
    counting = devices.open_device("simulated", arch="sm_52", mode="count")
    primitive = get(kernel)
    environment = Environment.capture()
    for size in (0, 1, 1000, 4096):
        record = PrimitiveCase(primitive, size, {"dtype": dtype}, 1).run(counting, Inputs(), environment)
        assert record.check.passed
        assert not record.findings
    total = record.transfer_counters.total
    reals = 9 + sum(OUTPUTS[kernel])
    assert total.div_branch == 0
    assert 32 * total.sectors == record.floor_bytes == 4096 * reals * np.dtype(dtype).itemsize
