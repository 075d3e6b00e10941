"""What the engine's tests share: compile a CUDA text with one kernel named ``kernel`` and run it."""

from __future__ import annotations

from collections.abc import Sequence

from mpmbench.simt import engine, nvrtc

OPTIONS = ("-std=c++17", "-ftz=true", "-lineinfo", "-default-device")


def kernel(
    text: str, mode: str = "run", lane_width: int = 16, arch: str = "sm_70", name: str = "kernel"
) -> engine.Kernel:
    ptx = nvrtc.compile_cuda(text, arch, OPTIONS, name="test.cu")
    return engine.compile_ptx(ptx, mode, lane_width).kernel(name)


def run(
    body: str,
    grid: int | Sequence[int],
    block: int | Sequence[int],
    *args,
    mode: str = "run",
    lane_width: int = 16,
    arch: str = "sm_70",
    **options,
) -> engine.LaunchResult:
    """body: parameters, then the function's text in braces: ``(float* x) { ... }``; or a whole CUDA text."""
    text = body if "__global__" in body else f'extern "C" __global__ void kernel{body}'
    shapes = [(size,) if isinstance(size, int) else size for size in (grid, block)]
    return kernel(text, mode, lane_width, arch).launch(*shapes, args, **options)
