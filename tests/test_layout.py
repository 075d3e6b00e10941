"""A variant is one kernel file and one module: pairing, names, what a docstring must say, physics in one place."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

import mpmbench
from mpmbench import primitives
from mpmbench.kernel import RAW_KERNELS
from mpmbench.variants import AXES, discover, resolve_axes, why_impossible

VARIANTS = discover()
NAMES = [variant.name for variant in VARIANTS]
KERNELS = {path.stem: path.read_text() for path in sorted(RAW_KERNELS.glob("*.cu"))}
ENTRY = re.compile(r'extern "C" __global__ void (?:__launch_bounds__\([^)]*\) )?(\w+)\(')

# <transfer>_<where the sums or values are kept>_<how>, in words.
GRAMMAR = re.compile(r"(p2g|g2p)_[a-z]+_[a-z]+(_[a-z]+)?")


def test_strategies_of_the_thesis_are_there() -> None:
    thesis = {
        "p2g_global_atomic", "p2g_global_node", "p2g_block_pull", "p2g_block_atomic", "p2g_block_sync",
        "g2p_global_gather", "g2p_block_gather",
    }  # fmt: skip
    assert thesis <= set(NAMES)


@pytest.mark.parametrize("variant", VARIANTS, ids=NAMES)
def test_module_and_kernel_share_their_name(variant) -> None:
    assert variant.path.stem == variant.name == variant.kernel == variant.kernel_path.stem
    assert GRAMMAR.fullmatch(variant.name)
    assert variant.transfer == variant.name[:3]


@pytest.mark.parametrize("variant", VARIANTS, ids=NAMES)
def test_docstring_says_idea_use_and_source(variant) -> None:
    text = ast.get_docstring(ast.parse(variant.path.read_text()))
    for part in ("Idea: ", "Wins when: ", "Loses when: ", "Source: "):
        assert re.search(rf"^{part}", text, re.M), f"{variant.name}: docstring lacks '{part}'"
    assert variant.reference
    assert "\n" not in variant.summary
    assert len(variant.summary) <= 70


@pytest.mark.parametrize("stem", KERNELS)
def test_kernel_file_holds_one_kernel_of_its_name(stem: str) -> None:
    assert ENTRY.findall(KERNELS[stem]) == [stem]
    assert KERNELS[stem].startswith("// "), f"{stem}.cu: the head says what each thread owns"


@pytest.mark.parametrize("stem", [name for name in NAMES if name in KERNELS])
def test_kernel_head_has_idea_ownership_and_constants(stem: str) -> None:
    head = re.match(r"(//.*\n)+", KERNELS[stem])[0]
    assert "// Idea: " in head
    assert re.search(r"thread (block )?owns", head)
    assert "// Constants: " in head


def test_every_kernel_has_a_user() -> None:
    """A ``.cu`` file is a strategy or a step of some; nothing lies about unused."""
    modules = [path.read_text() for path in Path(mpmbench.__file__).parent.rglob("*.py")]
    named = {stem for text in modules for stem in re.findall(r'(?:helper|load_source|Path)\(\s*"(\w+)"', text)}
    assert set(KERNELS) <= named | set(NAMES) | {primitive.kernel for primitive in primitives.discover()}


def test_physics_is_written_down_once() -> None:
    """Strategies call the common headers: no polynomial, cell rule or affine term of their own."""
    physics = re.compile(r"1\.5|0\.75|2\.0 / 3\.0|1\.0 / 6\.0|inv_dx|floor_to_int|affine_row")
    for name in NAMES:
        assert not physics.search(KERNELS[name]), name
    headers = [path.name for path in RAW_KERNELS.glob("*.cuh") if "1.0 / 6.0" in path.read_text()]
    assert headers == ["spline.cuh"]


def test_kernels_know_nothing_of_the_simulator() -> None:
    for path in RAW_KERNELS.iterdir():
        assert "simulat" not in path.read_text().lower(), path.name


@pytest.mark.parametrize("variant", VARIANTS, ids=NAMES)
def test_axes_are_known_and_defaults_possible(variant) -> None:
    for axis, values in variant.axes.items():
        assert set(values) <= set(AXES[axis])
    assert why_impossible(variant, resolve_axes(variant, {})) is None


def test_listing_variants_waits_for_no_compiler() -> None:
    code = (
        "import sys; from mpmbench.variants import discover; discover();"
        "print(sorted({'llvmlite', 'numba', 'cupy'} & set(sys.modules)))"
    )
    listed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert listed.stdout.strip() == "[]"
