"""Registers, shared memory, spills and size of a kernel for any architecture, from NVIDIA's ``ptxas``; no GPU needed.

``ptxas`` comes in the wheel nvidia-cuda-nvcc-cu12. What it says for PTX is what the driver's own assembler of the same
version would load.
"""

from __future__ import annotations

import importlib.util
import json
import re
import subprocess
import tempfile
from dataclasses import asdict, replace
from functools import lru_cache
from pathlib import Path

from mpmbench.device import KernelInfo, cubin
from mpmbench.errors import InputError
from mpmbench.kernel import KernelSource
from mpmbench.simt import cache
from mpmbench.simt.counters import SourceLine
from mpmbench.simt.nvrtc import compile_cuda

CURE = "pip install 'nvidia-cuda-nvcc-cu12==12.9.*'"

ENTRY = re.compile(r"Compiling entry function '(?P<entry>[^']+)'")
FUNCTION = re.compile(r"Function properties for (?P<name>\S+)")
FRAME = re.compile(r"(\d+) bytes stack frame, (\d+) bytes spill stores, (\d+) bytes spill loads")
REGISTERS = re.compile(r"Used (\d+) registers")
STACK = re.compile(r"(\d+) bytes cumulative stack size")
SHARED = re.compile(r"(\d+) bytes smem")


@lru_cache(maxsize=1)
def find_ptxas() -> Path:
    """The program of the installed wheel, or an InputError that says what to install."""
    spec = importlib.util.find_spec("nvidia")
    for root in (spec.submodule_search_locations or ()) if spec else ():
        path = Path(root, "cuda_nvcc", "bin", "ptxas")
        if path.is_file():
            return path
    raise InputError(f"ptxas not found in this Python environment: {CURE}")


@lru_cache(maxsize=1)
def ptxas_version() -> str:
    """Release of the found ``ptxas``, such as "12.9.86"."""
    text = _call([str(find_ptxas()), "--version"]).stdout
    match = re.search(r"V(\d+\.\d+\.\d+)", text)
    return match[1] if match else "unknown"


def kernel_infos(ptx: str, arch: str) -> dict[str, KernelInfo]:
    """Facts of every kernel in ``ptx`` when assembled for ``arch`` ("sm_90"), by entry name; kept on disk.

    Raises InputError where ``ptxas`` is missing or refuses the text.
    """
    key = cache.content_key("facts", _reader(), ptxas_version(), arch, ptx)
    if (stored := cache.load("ptxas", key)) is not None:
        return {entry: KernelInfo(**facts) for entry, facts in json.loads(stored).items()}
    log, code = assemble(ptx, arch)
    counts = cubin.instruction_counts(code, arch)
    infos = {n: replace(info, sass_instructions=counts[n]) for n, info in parse_log(log, arch).items()}
    cache.store("ptxas", key, json.dumps({entry: asdict(info) for entry, info in infos.items()}).encode())
    return infos


def source_infos(source: KernelSource, arch: str) -> dict[str, KernelInfo]:
    """The same for a kernel source: NVRTC to PTX, then ``ptxas``."""
    return kernel_infos(compile_cuda(source.text, arch, source.all_options, f"{source.name}.cu"), arch)


def sass_lines(ptx: str, arch: str, entry: str) -> dict[SourceLine, int]:
    """Machine instructions of kernel ``entry`` by CUDA source line; kept on disk.

    Empty where the PTX has no line information. Raises InputError as ``kernel_infos`` does.
    """
    key = cache.content_key("SASS lines", _reader(), ptxas_version(), arch, entry, ptx)
    if (stored := cache.load("ptxas", key)) is not None:
        return {SourceLine(file, line): count for file, line, count in json.loads(stored)}
    lines = cubin.line_counts(assemble(ptx, arch, "-lineinfo")[1], arch, entry)
    cache.store("ptxas", key, json.dumps([(*line, count) for line, count in lines.items()]).encode())
    return lines


def assemble(ptx: str, arch: str, *options: str) -> tuple[str, bytes]:
    """Run ``ptxas -v`` on PTX text; return its log and the ELF file with the machine code."""
    with tempfile.TemporaryDirectory(prefix="mpmbench-ptxas-") as folder:
        source, target = Path(folder, "kernel.ptx"), Path(folder, "kernel.cubin")
        source.write_text(ptx)
        done = _call([str(find_ptxas()), "-v", "-arch", arch, *options, "-o", str(target), str(source)])
        code = target.read_bytes() if target.exists() else b""
    log = (done.stdout + done.stderr).replace(str(source), "kernel.ptx")
    if done.returncode != 0:
        lines = [line for line in log.splitlines() if "error" in line or "fatal" in line] or log.splitlines()
        raise InputError(f"ptxas refuses the kernel for {arch}: {lines[0].strip() if lines else 'no message'}")
    return log, code


def parse_log(log: str, arch: str) -> dict[str, KernelInfo]:
    """The facts in a log of ``ptxas -v``, by entry name.

    The log gives, kernel by kernel, stack frame and spills and then the registers; functions that were not inlined
    follow with frame and spills of their own. Their spills are charged to every kernel of the text, for the log does
    not say who calls them.
    """
    infos: dict[str, KernelInfo] = {}
    entry = function = None
    frame = spill = function_spill = 0
    for line in log.splitlines():
        if match := ENTRY.search(line):
            entry = match["entry"]
        elif match := FUNCTION.search(line):
            function = match["name"]
        elif match := FRAME.search(line):
            if function == entry:
                frame, spill = int(match[1]), int(match[2]) + int(match[3])
            else:
                function_spill += int(match[2]) + int(match[3])
        elif (match := REGISTERS.search(line)) and entry is not None:
            shared, stack = SHARED.search(line), STACK.search(line)
            infos[entry] = KernelInfo(
                arch=arch,
                registers=int(match[1]),
                shared_bytes=int(shared[1]) if shared else 0,
                local_bytes=int(stack[1]) if stack else frame,
                spill_bytes=spill,
            )
            entry, frame, spill = None, 0, 0
    if function_spill:
        infos = {n: replace(info, spill_bytes=(info.spill_bytes or 0) + function_spill) for n, info in infos.items()}
    return infos


@lru_cache(maxsize=1)
def _reader() -> str:
    """Digest of what reads the log and the machine code: what is kept on disk is stale once either changes."""
    return cache.content_key(Path(__file__).read_bytes(), Path(cubin.__file__).read_bytes())


def _call(command: list[str]) -> subprocess.CompletedProcess[str]:
    try:
        return subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError as error:
        raise InputError(f"cannot run {Path(command[0]).name} ({error.strerror}): {CURE}") from error
