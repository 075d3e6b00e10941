"""CUDA C++ -> PTX with the NVRTC library of the ``nvidia-cuda-nvrtc`` wheel. Needs neither a GPU nor a driver."""

from __future__ import annotations

import ctypes
import functools
import importlib.util
import os
import re
from collections.abc import Sequence
from pathlib import Path

from mpmbench.errors import InputError
from mpmbench.simt import cache

_COMPILATION_ERROR = 6  # NVRTC_ERROR_COMPILATION
_INVALID_OPTION = 5  # NVRTC_ERROR_INVALID_OPTION

# "name.cu(12): error: text" and "name.cu(12): catastrophic error: text"
_MESSAGE = re.compile(r"^(?P<file>[^\n()]+)\((?P<line>\d+)\): (?:catastrophic )?error:? (?P<text>.*)$", re.M)


def compile_cuda(text: str, arch: str, options: Sequence[str] = (), name: str = "kernel.cu") -> str:
    """Compile one self-contained CUDA C++ text to PTX, or fetch it from the disk cache.

    arch: ``sm_52`` or ``compute_52``; skipped where options name an architecture. name: file name for messages and
    line information. A compile error is an InputError of one line: the first error with its file and line.
    """
    library = _library()
    arguments = list(options)
    if not any(option.startswith(("--gpu-architecture", "-arch")) for option in arguments):
        arguments.insert(0, f"--gpu-architecture={arch.replace('sm_', 'compute_')}")
    key = cache.content_key("ptx, relative files", library.identity, name, text, *arguments)
    if (stored := cache.load("ptx", key)) is not None:
        return stored.decode()
    # NVRTC puts the working directory before relative file names: the same text must give the same PTX anywhere.
    ptx = library.compile(text, name, arguments).replace(f'"{os.getcwd().rstrip("/")}/', '"')
    cache.store("ptx", key, ptx.encode())
    return ptx


def nvrtc_version() -> str:
    """Version of the NVRTC library, such as ``12.9``."""
    major, minor = ctypes.c_int(), ctypes.c_int()
    _library().handle().nvrtcVersion(ctypes.byref(major), ctypes.byref(minor))
    return f"{major.value}.{minor.value}"


def supported_archs() -> list[str]:
    """What the NVRTC library compiles for, such as ``["sm_50", "sm_52", ...]``."""
    nvrtc, count = _library().handle(), ctypes.c_int()
    nvrtc.nvrtcGetNumSupportedArchs(ctypes.byref(count))
    numbers = (ctypes.c_int * count.value)()
    nvrtc.nvrtcGetSupportedArchs(numbers)
    return [f"sm_{number}" for number in numbers]


class _Library:
    """The shared library. It is opened at the first compile only: a warm cache never needs it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        facts = path.stat()
        self.identity = f"{path.name} {facts.st_size} {facts.st_mtime_ns}"

    @functools.cache  # noqa: B019
    def handle(self) -> ctypes.CDLL:
        try:
            return ctypes.CDLL(str(self.path))
        except OSError as problem:
            raise InputError(f"cannot load the CUDA compiler {self.path}: {problem}") from problem

    def compile(self, text: str, name: str, options: Sequence[str]) -> str:
        nvrtc = self.handle()
        program = ctypes.c_void_p()
        created = nvrtc.nvrtcCreateProgram(ctypes.byref(program), text.encode(), name.encode(), 0, None, None)
        if created != 0:
            raise InputError(f"{name}: NVRTC cannot start (error {created})")
        try:
            arguments = (ctypes.c_char_p * len(options))(*(option.encode() for option in options))
            status = nvrtc.nvrtcCompileProgram(program, len(options), arguments)
            if status != 0:
                log = _read(nvrtc.nvrtcGetProgramLogSize, nvrtc.nvrtcGetProgramLog, program)
                raise InputError(_first_error(name, status, log))
            return _read(nvrtc.nvrtcGetPTXSize, nvrtc.nvrtcGetPTX, program)
        finally:
            nvrtc.nvrtcDestroyProgram(ctypes.byref(program))


def _read(size_of, read, program: ctypes.c_void_p) -> str:
    size = ctypes.c_size_t()
    size_of(program, ctypes.byref(size))
    buffer = ctypes.create_string_buffer(size.value)
    read(program, buffer)
    return buffer.value.decode(errors="replace")


def _first_error(name: str, status: int, log: str) -> str:
    if found := _MESSAGE.search(log):
        return f"{found['file']}:{found['line']}: {found['text'].strip()}"
    first = next((line.strip() for line in log.splitlines() if line.strip()), "no message")
    kind = {_COMPILATION_ERROR: "does not compile", _INVALID_OPTION: "bad compiler option"}.get(
        status, f"NVRTC error {status}"
    )
    return f"{name}: {kind}: {first}"


@functools.cache
def _library() -> _Library:
    for package in ("nvidia.cuda_nvrtc", "nvidia.cu13"):
        try:
            spec = importlib.util.find_spec(package)
        except ModuleNotFoundError:
            continue
        for folder in spec.submodule_search_locations or () if spec else ():
            for path in sorted(Path(folder).glob("lib/libnvrtc.so.*")):
                if "alt" not in path.name and "builtins" not in path.name:
                    return _Library(path)
    raise InputError(
        "no CUDA compiler found: install nvidia-cuda-nvrtc-cu12 (pip install 'nvidia-cuda-nvrtc-cu12==12.9.*')"
    )
