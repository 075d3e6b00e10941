"""Every kernel compiles for every GPU it is meant for, NVRTC and ptxas both; registers, shared memory and spills."""

from __future__ import annotations

import itertools
import os
import random
import warnings
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pairwise import covering_rows, texts_of

from mpmbench import primitives
from mpmbench.dataset import Dataset
from mpmbench.device import CompiledKernel, KernelInfo
from mpmbench.device.ptxas import assemble, kernel_infos, parse_log, source_infos
from mpmbench.errors import InputError
from mpmbench.kernel import KernelSource, load_source
from mpmbench.plan import build_plan
from mpmbench.primitive_runs import build_primitive
from mpmbench.primitives import Primitive
from mpmbench.reference import Nodes
from mpmbench.simt import cache as disk_cache
from mpmbench.simt.nvrtc import compile_cuda
from mpmbench.variants import AXES, SHARED_LIMIT, Variant, discover, resolve_axes, why_impossible
from mpmbench.workspace import kernel_constants, kernel_options

MAIN_ARCHS = ("sm_52", "sm_90")  # the GPU of the thesis and a current one: every axis
ARCHS = ("sm_52", "sm_70", "sm_75", "sm_80", "sm_86", "sm_89", "sm_90", "sm_100", "sm_120")  # default axes
VARIANTS = {variant.name: variant for variant in discover()}
# A primitive for GPUs alone calls a library: it has no kernel of ours.
PRIMITIVES = {p.name: p for p in primitives.discover() if "simulated" in p.devices}

Kernel = tuple[KernelSource, str]  # with the name of its function


class CompileOnlyDevice:
    """Collects the kernels that a plan asks for, and does nothing else."""

    name, arch = "compile-only", "sm_52"

    def __init__(self) -> None:
        self.kernels: dict[str, Kernel] = {}  # by hash and entry

    def upload(self, host: np.ndarray) -> np.ndarray:
        return host

    def empty(self, shape: Any, dtype: Any) -> np.ndarray:
        return np.empty(shape, dtype)

    def compile(self, source: KernelSource, entry: str) -> CompiledKernel:
        self.kernels[f"{source.sha256} {entry}"] = source, entry
        return CompiledKernel(source, entry, None)


def kernels_of_primitive(primitive: Primitive, axes: dict[str, Any]) -> dict[str, Kernel]:
    """The same for a primitive."""
    device = CompileOnlyDevice()
    inputs = primitive.operation.inputs(axes, 5000, 1)
    built = build_primitive(primitive, device, axes, inputs, 5000)  # type: ignore[arg-type]
    assert built.launches
    return device.kernels


@cache
def one_particle() -> Dataset:
    return Dataset.from_arrays(
        np.full((1, 3), 8.4), np.zeros((1, 3)), mass=1.0, affine=None, grid_shape=(16, 16, 16), dx=1.0, origin=(0, 0, 0)
    )


def kernels_of(variant: Variant, axes: dict[str, Any]) -> dict[str, Kernel]:
    """Every kernel of a plan, preprocessing and finishing steps included."""
    device = CompileOnlyDevice()
    nodes = Nodes(np.ones((16, 16, 16)), np.zeros((16, 16, 16, 3))) if variant.transfer == "g2p" else None
    plan = build_plan(variant, one_particle(), device, axes, nodes=nodes)  # type: ignore[arg-type]
    plan.work.active_count = 1
    assert plan.transfer.launches
    return device.kernels


def compiled(kernel: Kernel, arch: str) -> KernelInfo:
    source, entry = kernel
    try:
        return source_infos(source, arch)[entry]
    except InputError as error:
        constants = " ".join(f"{name}={value}" for name, value in source.constants)
        raise InputError(f"{error} [{entry} for {arch}: {constants}]") from error


def compile_all(jobs: Iterable[tuple[Kernel, str]]) -> list[tuple[Kernel, KernelInfo]]:
    """Both compilers leave Python's lock, so two threads use two cores."""
    todo = list(jobs)
    with ThreadPoolExecutor(max_workers=min(2, os.cpu_count() or 1)) as pool:
        infos = pool.map(lambda job: compiled(*job), todo)
        return [(kernel, info) for (kernel, _), info in zip(todo, infos, strict=True)]


def report_spills(results: Iterable[tuple[Kernel, KernelInfo]], record: Callable[[str, object], None]) -> None:
    """Keep the facts with the test's result, and say in pytest's summary which kernels spill."""
    rows = []
    for (source, entry), info in results:
        record(f"{entry} {source.sha256[:12]} {info.arch}",
               f"{info.registers} registers, {info.shared_bytes} B shared, {info.spill_bytes} B spilled")  # fmt: skip
        rows.append((info.spill_bytes or 0, entry, info.arch, source))
    spilling = sorted((row for row in rows if row[0]), key=lambda row: -row[0])
    if spilling:
        size, entry, arch, source = spilling[0]
        constants = " ".join(f"{name}={value}" for name, value in source.constants)
        warnings.warn(
            f"{len(spilling)} of {len(rows)} compilations spill registers, most of all {entry} for {arch}: {size} B "
            f"({constants})",
            stacklevel=2,
        )


@pytest.mark.parametrize("name", VARIANTS)
def test_default_axes_compile_for_every_gpu_and_do_not_spill(name: str, record_property) -> None:
    kernels = kernels_of(VARIANTS[name], resolve_axes(VARIANTS[name], {}))
    results = compile_all((kernel, arch) for kernel in kernels.values() for arch in ARCHS)
    assert len(results) == len(kernels) * len(ARCHS)
    report_spills(results, record_property)
    for (source, entry), info in results:
        assert info.spill_bytes == 0, f"{entry} of {source.name} spills {info.spill_bytes} B for {info.arch}"
        assert info.registers is not None
        assert 0 < info.registers <= 255


@pytest.mark.parametrize("name", PRIMITIVES)
def test_default_axes_of_primitives_compile_for_every_gpu_and_do_not_spill(name: str, record_property) -> None:
    kernels = kernels_of_primitive(PRIMITIVES[name], primitives.resolve_axes(PRIMITIVES[name], {}))
    results = compile_all((kernel, arch) for kernel in kernels.values() for arch in ARCHS)
    report_spills(results, record_property)
    assert all(info.spill_bytes == 0 for _, info in results)


@pytest.mark.parametrize("name", PRIMITIVES)
def test_every_pair_of_axis_values_of_primitives_compiles(name: str, record_property) -> None:
    primitive = PRIMITIVES[name]
    rows = covering_rows([primitive.axes], lambda axes: primitives.why_impossible(primitive, axes) is None, seed=7)
    kernels: dict[str, Kernel] = {}
    for axes in rows:
        kernels |= kernels_of_primitive(primitive, axes)
    # By turns for one architecture and the other: these kernels are many and plain.
    jobs = [(kernel, MAIN_ARCHS[i % 2]) for i, kernel in enumerate(kernels.values())]
    report_spills(compile_all(jobs), record_property)


@pytest.mark.parametrize("name", VARIANTS)
def test_every_pair_of_axis_values_compiles(name: str, record_property) -> None:
    """For the two main architectures, on a seeded covering array, so that any two values meet in some row."""
    variant = VARIANTS[name]
    rows = covering_rows([variant.axes], lambda axes: why_impossible(variant, axes) is None, seed=7)
    kernels: dict[str, Kernel] = {}
    for axes in rows:
        kernels |= kernels_of(variant, axes)
    results = compile_all((kernel, arch) for kernel in kernels.values() for arch in MAIN_ARCHS)
    report_spills(results, record_property)
    assert len(results) >= 2 * len(rows)


@pytest.mark.parametrize("name", [name for name, variant in VARIANTS.items() if variant.uses_blocks])
def test_shared_memory_is_what_the_variant_says(name: str) -> None:
    """The largest block shape that is said to fit does; the next one, said not to, is refused by ptxas as well."""
    variant = VARIANTS[name]
    shapes = [(edge, edge, depth) for edge in (4, 6, 8, 10, 12) for depth in (4, 6, 8) if edge * edge * depth <= 1024]
    shapes.sort(key=lambda shape: (shape[0] + 3) * (shape[1] + 3) * (shape[2] + 3))
    chosen = {shape: resolve_axes(variant, {"dtype": "float64", "block_shape": shape}) for shape in shapes}
    fitting = [shape for shape in shapes if why_impossible(variant, chosen[shape]) is None]
    refused = [shape for shape in shapes if shape not in fitting]
    shared = compiled(own_kernel(variant, chosen[fitting[-1]]), "sm_52").shared_bytes
    assert shared is not None
    assert 0 < shared <= SHARED_LIMIT
    assert "shared memory" in (why_impossible(variant, chosen[refused[0]]) or "")
    with pytest.raises(InputError, match="too much shared data"):
        compiled(own_kernel(variant, chosen[refused[0]]), "sm_52")


def test_only_the_strategys_own_kernel_takes_the_compilers_options() -> None:
    for variant in VARIANTS.values():
        plain = kernels_of(variant, resolve_axes(variant, {}))
        assert not any(source.options for source, _ in plain.values())
        told = kernels_of(variant, resolve_axes(variant, {"math": "fast", "contraction": "none"}))
        assert {entry: source.options for source, entry in told.values() if source.options} == {
            variant.kernel: ("--use_fast_math", "--fmad=false")
        }
        assert len(told.keys() - plain.keys()) == 1, "the hash of one kernel changes"


@pytest.mark.parametrize("name", VARIANTS)
def test_what_the_compilers_options_change(name: str) -> None:
    """Without contraction no fused multiply-add is left, of fast math or not. Fast math finds nothing to do in the
    shipped kernels: no division of floats, no root, no function, and denormals are flushed anyway."""
    variant = VARIANTS[name]
    ptx = {}
    for math, contraction in itertools.product(variant.axes["math"], variant.axes["contraction"]):
        axes = {"math": math, "contraction": contraction, "payload": "apic", "writing": "literal"}
        source, _ = own_kernel(variant, resolve_axes(variant, axes))
        ptx[math, contraction] = compile_cuda(source.text, "sm_52", source.all_options, f"{source.name}.cu")
    assert "fma.rn.ftz.f32" in ptx["ieee", "fma"]
    assert not any(line.lstrip().startswith("fma") for line in ptx["ieee", "none"].splitlines())
    assert ptx["fast", "fma"] == ptx["ieee", "fma"]
    assert ptx["fast", "none"] == ptx["ieee", "none"]


def test_facts_are_those_of_a_sources_own_options() -> None:
    """Two instructions for a product and a sum, and a division of several instructions in place of a call."""
    text = 'extern "C" __global__ void some(float* a) { a[0] = a[1] * a[2] + a[3] / a[4]; }'
    sizes = [
        source_infos(KernelSource("some", text, (), "", options), "sm_90")["some"].sass_instructions or 0
        for options in ((), ("--fmad=false",), ("--use_fast_math",), ("--use_fast_math", "--fmad=false"))
    ]
    assert sizes[0] < sizes[1]
    assert sizes[2] < sizes[0]
    assert sizes[2] < sizes[3] < sizes[1]


def own_kernel(variant: Variant, axes: dict[str, Any]) -> Kernel:
    return load_source(variant.kernel_path, kernel_constants(axes), options=kernel_options(axes)), variant.kernel


@pytest.mark.slow
def test_full_product(tmp_path_factory) -> None:
    """Every combination of the axes that change texts, for the main architectures, in a seeded random order. It takes
    hours: what has compiled is noted in the cache folder, and a run that was stopped goes on where it was."""
    journal = disk_cache.cache_folder() / "compiled-product.txt"
    journal.parent.mkdir(parents=True, exist_ok=True)
    done = set(journal.read_text().split()) if journal.exists() else set()
    everything = [(variant, axes) for variant in VARIANTS.values() for axes in texts_of(variant)]
    random.Random(1).shuffle(everything)
    with pytest.MonkeyPatch.context() as patch, journal.open("a") as notes:
        patch.setattr(disk_cache, "store", lambda *_: None)  # 100,000 texts would fill the disk
        for variant, axes in everything:
            fresh = {key: kernel for key, kernel in kernels_of(variant, axes).items() if key.split()[0] not in done}
            compile_all((kernel, arch) for kernel in fresh.values() for arch in MAIN_ARCHS)
            for key in fresh:
                done.add(key.split()[0])
                notes.write(key.split()[0] + "\n")
            notes.flush()


# ptxas itself

LOG = """\
ptxas info    : 0 bytes gmem
ptxas info    : Compiling entry function 'spilling' for 'sm_52'
ptxas info    : Function properties for spilling
    408 bytes stack frame, 492 bytes spill stores, 490 bytes spill loads
ptxas info    : Used 32 registers, used 1 barriers, 408 bytes cumulative stack size, 328 bytes cmem[0]
ptxas info    : Compiling entry function 'calling' for 'sm_52'
ptxas info    : Function properties for calling
    80 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads
ptxas info    : Used 26 registers, used 1 barriers, 96 bytes cumulative stack size, 256 bytes smem, 328 bytes cmem[0]
ptxas info    : Function properties for _Z6calledf
    16 bytes stack frame, 4 bytes spill stores, 4 bytes spill loads
"""


def test_facts_are_read_from_the_log() -> None:
    infos = parse_log(LOG, "sm_52")
    assert infos["spilling"] == KernelInfo("sm_52", 32, 0, 408, 982 + 8)
    assert infos["calling"] == KernelInfo("sm_52", 26, 256, 96, 8)


def test_facts_of_a_kernel_that_is_known_to_spill() -> None:
    text = """
    extern "C" __global__ void __launch_bounds__(1024, 2) tight(float* a) {
        __shared__ float tile[64];
        float r[80];
        #pragma unroll
        for (int i = 0; i < 80; ++i) r[i] = a[i * 1024 + threadIdx.x];
        tile[threadIdx.x % 64] = r[3];
        __syncthreads();
        #pragma unroll
        for (int i = 0; i < 80; ++i) a[(79 - i) * 1024 + threadIdx.x] = r[i] * r[(i * 7) % 80] + tile[i % 64];
    }"""
    info = kernel_infos(compile_cuda(text, "sm_52"), "sm_52")["tight"]
    assert (info.registers, info.shared_bytes) == (32, 256)
    assert (info.spill_bytes or 0) > 0
    assert (info.local_bytes or 0) > 0


def test_ptxas_refuses_in_one_line() -> None:
    with pytest.raises(InputError, match=r"ptxas refuses the kernel for sm_90: .*error") as refusal:
        assemble(".version 8.0\n.target sm_90\n.address_size 64\n.entry broken() { nonsense; }", "sm_90")
    assert "\n" not in str(refusal.value)


def test_ptxas_missing_is_one_clear_error(monkeypatch: pytest.MonkeyPatch) -> None:
    from mpmbench.device import ptxas

    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    ptxas.find_ptxas.cache_clear()
    try:
        with pytest.raises(InputError, match="nvidia-cuda-nvcc-cu12"):
            ptxas.find_ptxas()
    finally:
        ptxas.find_ptxas.cache_clear()


def test_facts_come_from_the_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from mpmbench.device import ptxas

    monkeypatch.setenv("MPMBENCH_CACHE_DIR", str(tmp_path))
    ptx = compile_cuda('extern "C" __global__ void nothing() {}', "sm_90")
    first = kernel_infos(ptx, "sm_90")
    monkeypatch.setattr(ptxas, "assemble", lambda *_: pytest.fail("assembled again"))
    assert kernel_infos(ptx, "sm_90") == first
    assert first["nothing"].sass_instructions


def test_axes_are_all_covered() -> None:
    """The covering arrays above reach every value of every axis that some variant has."""
    for variant in VARIANTS.values():
        rows = covering_rows([variant.axes], lambda axes: why_impossible(variant, axes) is None, seed=7)  # noqa: B023
        for name, values in variant.axes.items():
            assert {row[name] for row in rows} == set(values), (variant.name, name)
    assert set(AXES) == {name for variant in VARIANTS.values() for name in variant.axes}
