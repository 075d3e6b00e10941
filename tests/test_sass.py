"""Estimated machine instructions against what ptxas writes."""

from __future__ import annotations

import math

import pytest
from test_compile import VARIANTS, own_kernel

from mpmbench.device.ptxas import kernel_infos
from mpmbench.gpu import MEANINGS
from mpmbench.gpu.sass import CAS_TRIP, CLASSES, instruction_weight, is_shared_float_add, weight
from mpmbench.kernel import COMPILE_OPTIONS
from mpmbench.simt.nvrtc import compile_cuda
from mpmbench.simt.ptx import parse
from mpmbench.variants import resolve_axes, why_impossible

ARCHS = ("sm_52", "sm_70", "sm_80", "sm_90")
BAND = (0.75, 1.3)  # estimated over written instructions, each kernel
# On Maxwell ptxas finds that most 64-bit address sums of its 256 unrolled reductions are constants apart.
WIDER = {("p2g_global_atomic", "hoisted", "sm_52"): 1.45}


def estimated_over_written(name: str, writing: str, arch: str) -> float | None:
    variant = VARIANTS[name]
    axes = resolve_axes(variant, {"writing": writing})
    if writing not in variant.axes["writing"] or why_impossible(variant, axes):
        return None
    source, entry = own_kernel(variant, axes)
    ptx = compile_cuda(source.text, arch, COMPILE_OPTIONS, f"{source.name}.cu")
    written = kernel_infos(ptx, arch)[entry].sass_instructions
    assert written
    instructions = parse(ptx).kernels[entry].instructions
    trips = sum(CAS_TRIP.values()) * sum(is_shared_float_add(i.opcode) for i in instructions)
    return (sum(instruction_weight(i, arch)[1] for i in instructions) + trips) / written


@pytest.mark.parametrize("arch", ARCHS)
def test_the_estimate_for_every_transfer_kernel(arch: str, record_property) -> None:
    found = {
        (name, writing, arch): ratio
        for name in VARIANTS
        for writing in ("hoisted", "literal")
        if (ratio := estimated_over_written(name, writing, arch)) is not None
    }
    assert len(found) >= len(VARIANTS)
    for key, ratio in found.items():
        record_property(" ".join(key), f"{ratio:.2f}")
        assert BAND[0] <= ratio <= WIDER.get(key, BAND[1]), key
    mean = math.exp(sum(map(math.log, found.values())) / len(found))
    assert 0.95 <= mean <= 1.05, (arch, mean)


@pytest.mark.parametrize(
    ("opcode", "literal", "maxwell", "hopper"),
    [
        ("add.s32", None, ("int_add", 1), ("int_add", 1)),
        ("mul.lo.s32", None, ("int_mul", 3), ("int_mul", 1)),  # XMAD
        ("mul.lo.s32", 12, ("int_mul", 2), ("int_mul", 1)),
        ("mul.wide.s32", 4, ("shift", 2), ("int_mul", 1)),
        ("add.s64", 16, ("int_add", 0), ("int_add", 0)),  # the offset of a load
        ("mul.f64", None, ("fp64", 1), ("fp64", 1)),
        ("abs.ftz.f32", None, ("fp32", 0), ("fp32", 0)),
        ("fma.rn.ftz.f32", None, ("fp32", 1), ("fp32", 1)),
        ("max.ftz.f32", None, ("compare", 1), ("compare", 1)),
        ("setp.lt.s64", None, ("compare", 2), ("compare", 2)),
        ("rsqrt.approx.ftz.f32", None, ("special", 1), ("special", 1)),
        ("ex2.approx.ftz.f32", None, ("special", 2), ("special", 1)),
        ("cvt.rmi.ftz.s32.f32", None, ("convert", 1), ("convert", 1)),
        ("cvt.u32.u64", None, ("shift", 0), ("shift", 0)),
        ("ld.global.nc.v4.f32", None, ("load_store", 1), ("load_store", 1)),
        ("atom.global.add.f32", None, ("load_store", 1), ("load_store", 1)),
        ("atom.shared.add.u32", None, ("load_store", 1), ("load_store", 1)),
        ("bar.sync", 0, ("control", 1), ("control", 1)),
        ("shl.b32", 3, ("shift", 1), ("shift", 1)),
        ("and.b64", None, ("logic", 2), ("logic", 2)),
        ("cvta.to.global.u64", None, ("move", 0), ("move", 0)),
    ],
)
def test_weights(opcode, literal, maxwell, hopper):
    assert weight(opcode, "sm_52", literal) == maxwell
    assert weight(opcode, "sm_90", literal) == hopper


def test_division_is_a_sequence_and_a_shared_float_sum_is_a_loop():
    for arch in ARCHS:
        assert weight("div.rn.ftz.f32", arch)[1] > 5 > weight("div.approx.ftz.f32", arch)[1]
        assert weight("div.rn.f64", arch)[1] > weight("div.rn.f32", arch)[1]
        assert weight("atom.shared.add.f32", arch)[0] == "control"
    assert is_shared_float_add("atom.shared.add.f64")
    assert not is_shared_float_add("atom.shared.add.u32")
    assert not is_shared_float_add("atom.global.add.f32")


def test_every_class_that_a_unit_executes_has_a_rate():
    rates = {name.removeprefix("rate_") for name in MEANINGS if name.startswith("rate_")}
    assert set(CLASSES) - {"control", "move"} == rates
    assert set(CAS_TRIP) <= set(CLASSES)
