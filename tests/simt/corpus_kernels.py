"""The opcode corpus: compiled, parsed, and launched on standard inputs."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np

from mpmbench.simt import nvrtc, ptx

FOLDER = Path(__file__).parent / "corpus"
FILES = sorted(path.stem for path in FOLDER.glob("*.cu"))
ARCHS = ("sm_52", "sm_75", "sm_90")
OPTIONS = ("-std=c++17", "-ftz=true", "-lineinfo", "-default-device")
ROOM = 32  # output values of each kind per thread, as in corpus.cuh


def source(stem: str) -> str:
    header = (FOLDER / "corpus.cuh").read_text()
    return (FOLDER / f"{stem}.cu").read_text().replace('#include "corpus.cuh"', f'{header}#line 3 "{stem}.cu"')


@functools.cache
def ptx_text(stem: str, arch: str, options: tuple[str, ...] = OPTIONS) -> str:
    return nvrtc.compile_cuda(source(stem), arch, options, name=f"{stem}.cu")


@functools.cache
def module(stem: str, arch: str) -> ptx.Module:
    return ptx.parse(ptx_text(stem, arch))


def form(item: ptx.Instruction) -> str:
    """The form of an instruction: its opcode, and for moves and accesses that take several shapes the shape."""
    shape = ""
    if item.root == "mov" and (len(item.dsts) > 1 or any(isinstance(s, ptx.Vector) for s in item.srcs)):
        shape = " unpack" if len(item.dsts) > 1 else " pack"
    if item.root == "setp" and len(item.dsts) == 2:
        shape = " pair"
    return item.opcode + shape


@functools.cache
def forms() -> dict[str, ptx.Instruction]:
    """Every form of instruction in the corpus, with an example."""
    found: dict[str, ptx.Instruction] = {}
    for arch in ARCHS:
        for stem in FILES:
            for kernel in module(stem, arch).kernels.values():
                for item in kernel.instructions:
                    found.setdefault(form(item), item)
    return found


SPECIAL_F32 = np.array(
    [0x00000000, 0x80000000, 0x3F800000, 0xBF800000, 0x7F800000, 0xFF800000, 0x7FC00000, 0xFFC00001, 0x7F800001]
    + [0x00000001, 0x80000001, 0x007FFFFF, 0x807FFFFF, 0x00800000, 0x80800000, 0x7F7FFFFF, 0xFF7FFFFF, 0x3F000000]
    + [0x3F7FFFFF, 0x3F800001, 0x4F000000, 0xCF000000, 0x4EFFFFFF, 0x4F800000, 0x5F000000, 0xDF000000, 0x40200000]
    + [0xC0200000, 0x40600000, 0x4B000001, 0x34000000, 0x42FF0000, 0xC3000000, 0x1E3CE508, 0x5D5E0B6B],
    dtype=np.uint32,
)
SPECIAL_F64 = np.array(
    [0, 1 << 63, 0x3FF << 52, 0xBFF << 52, 0x7FF << 52, 0xFFF << 52, 0x7FF8 << 48, 0xFFF8000000000001]
    + [0x7FF0000000000001, 1, (1 << 63) + 1, (1 << 52) - 1, 1 << 52, 0x7FEFFFFFFFFFFFFF, 0xFFEFFFFFFFFFFFFF]
    + [0x3FE << 52, 0x3FEFFFFFFFFFFFFF, 0x3FF0000000000001, 0x41DFFFFFFFC00000, 0x41E << 52, 0xC1E << 52]
    + [0x41EFFFFFFFE00000, 0x43E << 52, 0xC3E << 52, 0x43F << 52, 0x47EFFFFFE0000000, 0x47EFFFFFF0000000]
    + [0x380 << 52, 0x36A << 52, 0x3690000000000001, 0x4004 << 48, 0xC004 << 48, 0x3CA << 52, 0x1E6 << 52],
    dtype=np.uint64,
)
SPECIAL_INTEGERS = np.array(
    [0, 1, 2, 3, 7, 8, 15, 16, 24, 31, 32, 33, 63, 64, 65, 127, 128, 255, 256, 0x7FFF, 0x8000, 0xFFFF, 0x7FFFFFFF]
    + [0x80000000, 0xFFFFFFFF, 0xFFFFFFFE, 0x100000000, 0x7FFFFFFFFFFFFFFF, 1 << 63, (1 << 64) - 1, (1 << 64) - 31]
    + [0xFFFFFFFF00000000, 0x8000000080000000, 0x5555555555555555, 0x0123456789ABCDEF],
    dtype=np.uint64,
)


def floats(rng: np.random.Generator, count: int, dtype: np.dtype, tame: bool) -> np.ndarray:
    """Random floats over many magnitudes; unless ``tame``, a third are special values and a sixth any bit pattern."""
    spread = 3 if tame else 20
    values = (rng.normal(size=count) * 2.0 ** rng.integers(-spread, spread, count)).astype(dtype)
    if tame:
        return values
    special = (SPECIAL_F32 if dtype == np.float32 else SPECIAL_F64).view(dtype)
    bits = rng.integers(0, 1 << 8 * dtype.itemsize, count, dtype=f"u{dtype.itemsize}").view(dtype)
    kind = rng.integers(0, 6, count)
    return np.where(kind < 2, rng.choice(special, count), np.where(kind == 2, bits, values)).astype(dtype)


def integers(rng: np.random.Generator, count: int) -> np.ndarray:
    """uint64: a third special values, a third small, a third any bit pattern."""
    kind = rng.integers(0, 3, count)
    any_bits = rng.integers(0, 1 << 64, count, dtype=np.uint64)
    small = rng.integers(0, 1 << 16, count).astype(np.uint64)
    return np.where(kind == 0, rng.choice(SPECIAL_INTEGERS, count), np.where(kind == 1, small, any_bits))


def arguments(threads: int, seed: int = 0, tame: bool = False) -> list[np.ndarray]:
    """The six arrays of a corpus kernel for ``threads`` threads: three inputs, three zeroed outputs."""
    rng = np.random.default_rng(seed)
    return [
        aligned(floats(rng, 4 * threads + 64, np.dtype("f4"), tame)),
        aligned(floats(rng, 4 * threads + 64, np.dtype("f8"), tame)),
        aligned(integers(rng, 4 * threads + 64)),
        aligned(np.zeros(threads * ROOM + 4096, np.float32)),
        aligned(np.zeros(threads * ROOM + 4096, np.float64)),
        aligned(np.zeros(threads * ROOM + 4096, np.uint64)),
    ]


def aligned(values: np.ndarray, to: int = 256) -> np.ndarray:
    """A copy that starts at a multiple of ``to`` bytes, so that sector counts do not depend on the allocator."""
    room = np.zeros(values.nbytes + to, dtype=np.uint8)
    start = -room.ctypes.data % to
    copy = room[start : start + values.nbytes].view(values.dtype).reshape(values.shape)
    copy[...] = values
    return copy
