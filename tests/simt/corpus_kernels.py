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


def _hexadecimal(text: str, dtype: type) -> np.ndarray:
    return np.array([int(word, 16) for word in text.split()], dtype=dtype)


# Zeros, ones, infinities, NaNs (quiet, negative, signalling), subnormal and extreme numbers, the borders of the integer
# types, halves, and squares that over- or underflow.
SPECIAL_F32 = _hexadecimal(
    """
    00000000 80000000 3F800000 BF800000 7F800000 FF800000 7FC00000 FFC00001 7F800001 00000001 80000001
    007FFFFF 807FFFFF 00800000 80800000 7F7FFFFF FF7FFFFF 3F000000 3F7FFFFF 3F800001 4F000000 CF000000
    4EFFFFFF 4F800000 5F000000 DF000000 40200000 C0200000 40600000 4B000001 34000000 42FF0000 C3000000
    1E3CE508 5D5E0B6B
    """,
    np.uint32,
)
SPECIAL_F64 = _hexadecimal(
    """
    0000000000000000 8000000000000000 3FF0000000000000 BFF0000000000000 7FF0000000000000 FFF0000000000000
    7FF8000000000000 FFF8000000000001 7FF0000000000001 0000000000000001 8000000000000001 000FFFFFFFFFFFFF
    0010000000000000 7FEFFFFFFFFFFFFF FFEFFFFFFFFFFFFF 3FE0000000000000 3FEFFFFFFFFFFFFF 3FF0000000000001
    41DFFFFFFFC00000 41E0000000000000 C1E0000000000000 41EFFFFFFFE00000 43E0000000000000 C3E0000000000000
    43F0000000000000 47EFFFFFE0000000 47EFFFFFF0000000 3800000000000000 36A0000000000000 3690000000000001
    4004000000000000 C004000000000000 3CA0000000000000 1E60000000000000
    """,
    np.uint64,
)
SPECIAL_INTEGERS = _hexadecimal(
    """
    0 1 2 3 7 8 F 10 18 1F 20 21 3F 40 41 7F 80 FF 100 7FFF 8000 FFFF 7FFFFFFF 80000000 FFFFFFFF FFFFFFFE
    100000000 7FFFFFFFFFFFFFFF 8000000000000000 FFFFFFFFFFFFFFFF FFFFFFFFFFFFFFE1 FFFFFFFF00000000
    8000000080000000 5555555555555555 123456789ABCDEF
    """,
    np.uint64,
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
