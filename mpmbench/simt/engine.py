"""The public interface: PTX in, launches with outputs, counters and findings out. Knows nothing of MPM.

    module = compile_ptx(ptx, mode="count")
    result = module.kernel("saxpy").launch((blocks, 1, 1), (128, 1, 1), (x, y, np.float32(2), np.int32(n)))

Four modes share one code generator: ``run`` (results only), ``count`` (and exact counters), ``debug`` (checks memory
and barriers, runs warps in a seeded random order) and ``profile`` (counts too, runs the resident warps of a given
machine interleaved, with its caches and DRAM). Debug and profile order warps differently from the other two, so that
atomic adds of floats may round differently.
"""

from __future__ import annotations

import ctypes
import functools
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from mpmbench.errors import InputError
from mpmbench.simt import cache, codegen_count, naming, native, ptx, scheduler
from mpmbench.simt.codegen import MODES, KernelCode, generate
from mpmbench.simt.codegen_memory import SINK_BYTES, SINK_REACH, Site
from mpmbench.simt.counters import INFO, Counters, Finding, SourceLine
from mpmbench.simt.machine import Machine, MemoryCounters
from mpmbench.simt.tally import counters_from, opcodes_from

if TYPE_CHECKING:
    from mpmbench.simt.checks import Written

__all__ = ["DEFAULT_BUDGET", "Kernel", "LaunchResult", "Module", "compile_ptx"]

# Warp instructions that the backward branches of a launch may repeat before it counts as a runaway: minutes of work.
DEFAULT_BUDGET = 10**11

_MAX_THREADS = 1024
_MAX_SHARED = 227 * 1024  # of the largest GPU (Hopper)


@dataclass(frozen=True)
class LaunchResult:
    """counters: in modes ``count`` and ``profile``; findings: defects seen, in any mode.
    notes: findings that are INFO, no defects. memory: in mode ``profile``.

    opcodes: how often warps executed each PTX opcode with each integer literal (None: without), where counters are
    kept.
    """

    counters: Counters | None
    findings: tuple[Finding, ...]
    notes: tuple[Finding, ...] = ()
    memory: MemoryCounters | None = None
    opcodes: Mapping[tuple[str, int | None], int] = field(default_factory=dict)


def compile_ptx(text: str, mode: str = "run", lane_width: int = 16) -> Module:
    """A module whose kernels compile at their first use, or come from the disk cache.

    mode: run, count, debug or profile. lane_width: lanes that compiled code handles at a time (8, 16 or 32); results of
    race-free programs do not depend on it.
    """
    if mode not in MODES:
        raise InputError(f"unknown mode {mode!r}: valid are {', '.join(MODES)}")
    if lane_width not in (8, 16, 32):
        raise InputError(f"lane width {lane_width} is not 8, 16 or 32")
    return Module(text, mode, lane_width)


class Module:
    """A PTX module. Variables in global and constant memory live as long as it does."""

    def __init__(self, text: str, mode: str, lane_width: int) -> None:
        self.text, self.mode, self.lane_width = text, mode, lane_width
        self._kernels: dict[str, Kernel] = {}
        self._variables: dict[str, np.ndarray] = {}

    @functools.cached_property
    def parsed(self) -> ptx.Module:
        return ptx.parse(self.text)

    def kernel(self, name: str) -> Kernel:
        if name not in self._kernels:
            self._kernels[name] = Kernel(self, name)
        return self._kernels[name]

    def variable(self, name: str, size: int, initial: bytes) -> np.ndarray:
        """Memory of a module variable, as bytes."""
        if name not in self._variables:
            memory = _aligned(size)
            memory[:] = np.frombuffer(initial.ljust(size, b"\0"), np.uint8)
            self._variables[name] = memory
        return self._variables[name]


@dataclass(frozen=True)
class _Description:
    """What a launch needs to know of a kernel besides its machine code; stored beside it as JSON."""

    params: list[tuple[str, int, int]]  # name, offset, bytes
    param_bytes: int
    shared_bytes: int
    local_bytes: int
    variables: list[tuple[str, str, int, str]]  # name, space, bytes, initial bytes in hex
    context_bytes: int
    segments: list[tuple[int, int]]
    sites: list[Site]
    counter_words: int
    shared_granule: int
    lines: list[tuple[str, int] | None]
    opcodes: list[str]
    literals: list[int | None]  # last integer literal among the operands of each instruction
    guarded: list[bool]


class Kernel:
    """A compiled kernel function."""

    def __init__(self, module: Module, name: str) -> None:
        self.module, self.name = module, name
        mode, lanes = module.mode, module.lane_width
        key = cache.content_key("kernel", native.machine_identity(), mode, str(lanes), name, module.text)
        stored = cache.load("kernel", key)
        if stored is None:
            stored = _pack(*self._compile())
            cache.store("kernel", key, stored)
        self.facts, machine_code = _unpack(stored)
        if mode in ("count", "profile"):
            _load_support()
        self._code = native.LoadedCode(machine_code)
        self._launch = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_void_p)(self._code.address("launch"))

    def _compile(self) -> tuple[_Description, bytes]:
        parsed = self.module.parsed
        if self.name not in parsed.kernels:
            raise InputError(f"no kernel {self.name!r}; the module has: {', '.join(parsed.kernels) or 'none'}")
        kernel = parsed.kernels[self.name]
        numbers = {name: number for number, name in enumerate(parsed.variables)}
        code = generate(kernel, numbers, self.module.mode, self.module.lane_width)
        return _describe(parsed, kernel, code), native.compile_text(code.text)

    def launch(
        self,
        grid: Sequence[int],
        block: Sequence[int],
        args: Sequence[Any],
        shared_bytes: int = 0,
        seed: int | None = None,
        budget: int | None = None,
        allocations: Sequence[np.ndarray] = (),
        fuzz: bool = False,
        names: Sequence[str] = (),
        written: Written | None = None,
        machine: Machine | None = None,
    ) -> LaunchResult:
        """Run the kernel.

        grid, block: thread blocks and threads per axis (x, y, z). args: C-contiguous NumPy arrays, which are the
        memory itself, NumPy scalars, and structured NumPy scalars passed by value. shared_bytes: dynamic shared
        memory. seed: of the warp order in mode debug. budget: warp instructions that loops may repeat. allocations:
        further arrays that pointers inside structures may point to. fuzz: in mode debug, let lanes that part run in a
        random order too, instead of the lower program counter first. names: of the arguments, for findings. written:
        which memory is known to be uninitialised (debug). machine: what mode profile models.
        """
        job = _Job(self.module, self.facts, _three(grid, "grid"), _three(block, "block"), shared_bytes, self.name)
        job.set_arguments(args)
        job.set("budget", DEFAULT_BUDGET if budget is None else budget)
        checker = None
        if self.module.mode == "debug":
            from mpmbench.simt.checks import Checker

            job.set("split_mask", scheduler.OFTEN_SPLIT if fuzz else scheduler.NEVER_SPLIT)
            checker = Checker(self.facts, job, [*args, *allocations], seed or 0, names, written)
        memory = None
        if self.module.mode == "profile" and job.threads:
            status, memory = self._profile(job, machine, [*args, *allocations])
        else:
            status = self._launch(job.address) if job.threads else 0
        findings = _faults(self.name, self.facts, job, status)
        if checker is not None:
            findings += checker.findings(self.name)
        notes = tuple(finding for finding in findings if finding.severity == INFO)
        defects = tuple(finding for finding in findings if finding.severity != INFO)
        if self.module.mode not in ("count", "profile"):
            return LaunchResult(None, defects, notes)
        counters = counters_from(self.facts, job.counters)
        return LaunchResult(counters, defects, notes, memory, opcodes_from(self.facts, job.counters))

    def _profile(self, job: _Job, machine: Machine | None, arguments: Sequence[Any]) -> tuple[int, MemoryCounters]:
        """Run all thread blocks on a modelled machine."""
        from mpmbench.simt.memory_system import MemorySystem
        from mpmbench.simt.scheduler import ISSUE_UNITS
        from mpmbench.simt.timing import cas_trip_cycles, timing_tables

        if machine is None:
            raise InputError(f"{self.name}: mode profile needs a machine to model")
        kernel = self.module.parsed.kernels[self.name]
        tables = timing_tables(kernel, self.facts.segments, self.facts.sites, machine)
        job.set("segments", tables.segments.ctypes.data)
        job.set("cas_trip", cas_trip_cycles(machine))
        job.set("cas_issue", round(machine.cas_issue_cycles * ISSUE_UNITS))
        blocks = job.get("grid_x") * job.get("grid_y") * job.get("grid_z")
        arrays = [a for a in arguments if isinstance(a, np.ndarray) and a.ndim > 0]
        return MemorySystem(machine, self.facts, tables).run(self._code.address("resume"), job, blocks, arrays)


# --- one launch ---------------------------------------------------------------------------------------------------


def _three(shape: Sequence[int], what: str) -> tuple[int, int, int]:
    sizes = tuple(int(size) for size in shape)
    if not 1 <= len(sizes) <= 3 or min(sizes) < 0:
        raise InputError(f"{what} {tuple(shape)} is not one to three sizes")
    padded = (*sizes, 1, 1)
    return padded[0], padded[1], padded[2]


def _aligned(size: int, align: int = 4096) -> np.ndarray:
    """Zeroed bytes whose address is a multiple of ``align``."""
    raw = np.zeros(size + align, np.uint8)
    start = -raw.ctypes.data % align
    return raw[start : start + size]


@functools.cache
def _sink() -> np.ndarray:
    return _aligned(SINK_BYTES)


class _Job:
    """The memory of one launch."""

    def __init__(
        self,
        module: Module,
        facts: _Description,
        grid: tuple[int, int, int],
        block: tuple[int, int, int],
        dynamic_bytes: int,
        name: str,
    ) -> None:
        self.facts, self.name = facts, name
        self.threads = block[0] * block[1] * block[2]
        if self.threads > _MAX_THREADS:
            raise InputError(f"{name}: {self.threads} threads per block, a GPU takes at most {_MAX_THREADS}")
        self.shared_bytes = facts.shared_bytes + int(dynamic_bytes)
        if self.shared_bytes > _MAX_SHARED:
            raise InputError(f"{name}: {self.shared_bytes} bytes of shared memory, a GPU has at most {_MAX_SHARED}")
        self.warps = -(-self.threads // 32)
        self.fields = _aligned(scheduler.JOB_BYTES).view(np.int64)
        self.address = self.fields.ctypes.data
        self.contexts = _aligned(max(1, self.warps) * facts.context_bytes)
        self.shared = _aligned(self.shared_bytes + 64)
        self.params = _aligned(facts.param_bytes + 64)
        self.local = _aligned(max(1, 32 * self.warps * facts.local_bytes))
        self.counters = np.zeros(max(1, facts.counter_words), np.int64)
        self.order = np.zeros(max(1, self.warps), np.int64)
        self.variables = [
            module.variable(variable, size, bytes.fromhex(initial)) for variable, _, size, initial in facts.variables
        ]
        self.variable_table = np.array([v.ctypes.data for v in self.variables] or [0], np.int64)
        self._keep: list[Any] = []
        for axis, size in zip("xyz", grid, strict=True):
            self.set(f"grid_{axis}", size)
        for axis, size in zip("xyz", block, strict=True):
            self.set(f"block_{axis}", size)
        self.set("contexts", self.contexts.ctypes.data)
        self.set("warps", self.warps)
        self.set("threads", self.threads)
        self.set("shared", self.shared.ctypes.data)
        self.set("shared_bytes", self.shared_bytes)
        self.set("dynamic_bytes", int(dynamic_bytes))
        self.set("params", self.params.ctypes.data)
        self.set("local", self.local.ctypes.data)
        self.set("local_end", self.local.ctypes.data + 32 * self.warps * facts.local_bytes)
        self.set("sink", _sink().ctypes.data + SINK_REACH)
        self.set("variables", self.variable_table.ctypes.data)
        self.set("counters", self.counters.ctypes.data)
        self.set("order", self.order.ctypes.data)
        self._number_threads(block)

    def set(self, field: str, value: int) -> None:
        self.fields[scheduler.JOB[field] // 8] = value

    def get(self, field: str) -> int:
        return int(self.fields[scheduler.JOB[field] // 8])

    def _number_threads(self, block: tuple[int, int, int]) -> None:
        """Thread indices never change from one thread block to the next: they are written once."""
        thread = np.arange(32 * self.warps)
        x, y = max(block[0], 1), max(block[1], 1)
        indices = np.stack([thread % x, thread // x % y, thread // (x * y)]).astype(np.int32)
        for warp in range(self.warps):
            context = self.contexts[warp * self.facts.context_bytes :][: self.facts.context_bytes]
            tid = context[scheduler.CONTEXT_TID : scheduler.CONTEXT_TID + 384].view(np.int32).reshape(3, 32)
            tid[:] = indices[:, 32 * warp : 32 * warp + 32]
            context[scheduler.CONTEXT_WARP : scheduler.CONTEXT_WARP + 4].view(np.int32)[0] = warp

    def set_arguments(self, args: Sequence[Any]) -> None:
        params = self.facts.params
        if len(args) != len(params):
            raise InputError(f"{self.name} takes {len(params)} arguments, {len(args)} given")
        for position, (arg, (_, offset, size)) in enumerate(zip(args, params, strict=True)):
            data = self._argument_bytes(arg, position)
            if len(data) != size:
                raise InputError(f"{self.name}: argument {position} has {len(data)} bytes, the kernel expects {size}")
            self.params[offset : offset + size] = np.frombuffer(data, np.uint8)

    def _argument_bytes(self, arg: Any, position: int) -> bytes:
        if isinstance(arg, np.ndarray) and arg.ndim > 0:
            if not arg.flags.c_contiguous:
                raise InputError(f"{self.name}: argument {position} is not C-contiguous")
            self._keep.append(arg)
            return int(arg.ctypes.data).to_bytes(8, "little")
        if isinstance(arg, np.generic | np.ndarray):
            return arg.tobytes()
        raise InputError(
            f"{self.name}: argument {position} is a {type(arg).__name__}; pass a NumPy array or scalar such as np.int32"
        )


def _faults(name: str, facts: _Description, job: _Job, status: int) -> list[Finding]:
    """What stopped the launch, if anything did."""
    if status == 0:
        return []
    kind, text = {
        scheduler.FAULT_DIVERGENT_BARRIER: (
            "divergent-barrier",
            "Divergent thread(s) in warp: only some lanes of a warp reach the barrier",
        ),
        scheduler.FAULT_BUDGET: ("runaway", "a loop spends the instruction budget"),
        scheduler.FAULT_TRAP: ("trap", "the kernel executes a trap"),
        scheduler.FAULT_MASK: (
            "bad-mask",
            "Invalid arguments: the member mask of a warp operation does not match the lanes that execute it",
        ),
    }[status]
    segment, warp = job.get("stop_segment"), job.get("stop_warp")
    line = line_of(facts, facts.segments[segment][1] - 1)
    context = job.contexts[warp * facts.context_bytes :][: facts.context_bytes].view(np.uint32)
    waiting, live = int(context[scheduler.CONTEXT_SLOTS // 4 + segment]), int(context[scheduler.CONTEXT_LIVE // 4])
    threads = f"{naming.threads_text(job, warp, waiting or live)} in block {naming.block_text(job, job.get('block'))}"
    message = f"{name}: {text} at {naming.line_text(line)} by {threads}; launch stopped"
    return [Finding(kind, name, message, line, threads=threads)]


def line_of(facts: _Description, instruction: int) -> SourceLine | None:
    line = facts.lines[instruction]
    return SourceLine(*line) if line else None


# --- the disk cache's form ----------------------------------------------------------------------------------------


def _describe(module: ptx.Module, kernel: ptx.Kernel, code: KernelCode) -> _Description:
    return _Description(
        params=[(p.name, p.offset, p.size) for p in kernel.params],
        param_bytes=kernel.param_bytes,
        shared_bytes=kernel.shared_bytes,
        local_bytes=kernel.local_bytes,
        variables=[(v.name, v.space, v.size, v.initial.hex()) for v in module.variables.values()],
        context_bytes=code.context_bytes,
        segments=code.segments,
        sites=code.sites,
        counter_words=code.counter_words,
        shared_granule=code.shared_granule,
        lines=code.lines,
        opcodes=[item.opcode for item in kernel.instructions],
        literals=[item.literal for item in kernel.instructions],
        guarded=[item.guard is not None for item in kernel.instructions],
    )


def _pack(facts: _Description, machine_code: bytes) -> bytes:
    text = json.dumps(asdict(facts)).encode()
    return len(text).to_bytes(8, "little") + text + machine_code


def _unpack(stored: bytes) -> tuple[_Description, bytes]:
    size = int.from_bytes(stored[:8], "little")
    fields = json.loads(stored[8 : 8 + size])
    fields["sites"] = [Site(**site) for site in fields["sites"]]
    return _Description(**fields), stored[8 + size :]


@functools.cache
def _load_support() -> native.LoadedCode:
    """Make the counting functions known to kernels that are loaded later."""
    key = cache.content_key("support", native.machine_identity())
    stored = cache.load("kernel", key)
    if stored is None:
        stored = native.compile_text(codegen_count.support_text())
        cache.store("kernel", key, stored)
    code = native.LoadedCode(stored)
    code.export(codegen_count.SUPPORT_FUNCTIONS)
    return code
