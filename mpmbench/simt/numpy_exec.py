"""A plain interpreter of parsed PTX: one instruction is one NumPy expression on the 32 lanes of a warp.

Slow and simple on purpose: it defines what the engine must compute and count. Its order is fixed: thread blocks one
after the other, x fastest; in a block each warp in turn runs to its next barrier; in a warp the lanes with the lowest
program counter run first and join others that wait at the same instruction; atomics of one instruction go in the order
of lanes. Operations that name lanes (``shfl.sync`` and the like) wait for the lanes they name, as from Volta on.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from mpmbench.errors import InputError
from mpmbench.simt import numpy_memory as memory
from mpmbench.simt.counters import Counters, Finding, SourceLine, Tally
from mpmbench.simt.numpy_memory import FaultError, Memory
from mpmbench.simt.numpy_ops import DTYPES, Array, Modifiers, canonical, flush, lane_op
from mpmbench.simt.ptx import (
    Address,
    Imm,
    Instruction,
    Kernel,
    Module,
    NotReg,
    Operand,
    Reg,
    Special,
    Symbol,
    Vector,
)

WARP = 32
LANES = np.arange(WARP)
UNKNOWN_LINE = SourceLine("?", 0)

_IGNORED_BY_MEMORY = frozenset({"volatile", "weak", "relaxed", "acquire", "release", "acq_rel", "seq_cst", "mmio"})
_IGNORED_BY_MEMORY |= {"cta", "cluster", "gpu", "sys", "nc", "ca", "cg", "cs", "cv", "lu", "wb", "wt", "unified"}
_IGNORED_BY_MEMORY |= {f"L1::{hint}" for hint in ("evict_normal", "evict_unchanged", "evict_first", "evict_last")}
_IGNORED_BY_MEMORY |= {"L1::no_allocate", "L2::64B", "L2::128B", "L2::256B"}
_SPACES = {"global": "global", "shared": "shared", "local": "local", "const": "const", "param": "param"}
_SPACES |= {"shared::cta": "shared", "param::entry": "param"}
_NO_EFFECT = frozenset({"membar", "fence", "nanosleep", "prefetch", "prefetchu", "call", "pmevent", "brkpt", "discard"})
_COLLECTIVE = frozenset({"shfl", "vote", "match", "redux", "elect"})


@dataclass(frozen=True)
class Result:
    counters: Counters
    findings: tuple[Finding, ...] = ()
    notes: tuple[Finding, ...] = ()


def run(
    kernel: Kernel,
    module: Module,
    grid: Sequence[int],
    block: Sequence[int],
    args: Sequence[object],
    shared_bytes: int = 0,
    seed: int | None = None,
    budget: int | None = None,
    variables: dict[str, Array] | None = None,
    memory_arrays: Sequence[Array] = (),
) -> Result:
    """Run a launch on the host arrays in ``args``, which change in place.

    grid, block: up to three sizes each. shared_bytes: dynamic shared memory. seed: run the warps of a thread block in
    random instead of ascending order. budget: warp instructions after which the launch is ended as a runaway.
    variables: storage of module variables from ``module_variables``, fresh if None. memory_arrays: arrays that only
    addresses inside structures or other arrays lead to.
    """
    launch = _Launch(kernel, module, args, _dim3(block), shared_bytes, variables, memory_arrays)
    return launch.run(_dim3(grid), np.random.default_rng(seed) if seed is not None else None, budget)


def check_supported(kernel: Kernel, module: Module) -> None:
    """Raise InputError for the first instruction that this executor does not know."""
    decoder = _Decoder(kernel, memory.module_variables(module), 0)
    for item in kernel.instructions:
        decoder.step(item)


def _dim3(sizes: Sequence[int]) -> tuple[int, int, int]:
    x, y, z = (*sizes, 1, 1, 1)[:3]
    return int(x), int(y), int(z)


# --- state ------------------------------------------------------------------------------------------------------------


@dataclass
class _Warp:
    """Registers are raw bits, arrays of 32 that are replaced, never written to."""

    block: _Block
    number: int
    live: Array  # lanes that have not left the kernel
    thread: tuple[Array, Array, Array]  # threadIdx
    registers: list[Array]
    local_start: Array  # address of each lane's local memory
    splits: dict[int, Array] = field(default_factory=dict)  # program counter -> lanes waiting there
    parked: set[int] = field(default_factory=set)  # those that wait for other lanes at a warp-level operation
    waited: int = 0  # mask of lanes that others have waited for and that have not come yet
    barrier: _Arrival | None = None


@dataclass
class _Arrival:
    """A warp waiting at a block barrier. threads: how many it waits for (0: all). values: votes of ``bar.red``."""

    number: int
    threads: int
    resume: int
    mask: Array
    values: Array | None = None
    answer: Callable[[_Warp, Array, Array], None] | None = None
    waits: bool = True


@dataclass
class _Block:
    launch: _Launch
    index: tuple[int, int, int]
    grid: tuple[int, int, int]
    shared_start: int
    warps: list[_Warp] = field(default_factory=list)


@dataclass
class _Step:
    """A decoded instruction. kind: plain, branch, exit, trap, barrier or collective (waits for named lanes)."""

    item: Instruction
    kind: str
    guard: int | None  # register number
    apply: Callable[..., object]
    tally: Tally = field(default_factory=Tally)


class _Launch:
    def __init__(self, kernel, module, args, block, shared_bytes, variables, memory_arrays) -> None:
        self.kernel, self.block_shape = kernel, block
        self.threads = block[0] * block[1] * block[2]
        if not 1 <= self.threads <= 1024:
            raise InputError(f"kernel {kernel.name}: {self.threads} threads per thread block; valid are 1 to 1024")
        if len(args) != len(kernel.params):
            raise InputError(f"kernel {kernel.name} takes {len(kernel.params)} arguments, {len(args)} given")
        self.variables = memory.module_variables(module) if variables is None else variables
        self.params = np.zeros(max(kernel.param_bytes, 1) + 16, dtype=np.uint8)
        for number, (param, argument) in enumerate(zip(kernel.params, args, strict=True)):
            raw = memory.argument_bytes(argument, param.size, f"{number} of kernel {kernel.name}")
            self.params[param.offset : param.offset + param.size] = np.frombuffer(raw, dtype=np.uint8)
        self.warp_count = -(-self.threads // WARP)
        self.dynamic_shared, self.all_shared = shared_bytes, kernel.shared_bytes + shared_bytes
        self.shared = _aligned(self.all_shared)
        self.local = _aligned(self.warp_count * WARP * kernel.local_bytes)
        self.memory = Memory(
            [("global", a) for a in (*args, *memory_arrays) if isinstance(a, np.ndarray)]
            + [(module.variables[name].space, data) for name, data in self.variables.items()]
            + [("shared", self.shared), ("local", self.local), ("param", self.params)]
        )
        decoder = _Decoder(kernel, self.variables, self.params.ctypes.data)
        self.steps = [decoder.step(item) for item in kernel.instructions]
        self.slots = decoder.slots
        self.issued = 0
        self.findings: dict[tuple[str, str, SourceLine | None], int] = {}

    def run(self, grid, rng, budget) -> Result:
        self.budget = budget
        try:
            for z in range(grid[2]):
                for y in range(grid[1]):
                    for x in range(grid[0]):
                        self._run_block((x, y, z), grid, rng)
        except _Stopped:
            pass
        return Result(self._counters(), self._findings())

    def find(self, kind: str, message: str, item: Instruction) -> None:
        key = (kind, f"{message} at {item.where()}", item.line)
        self.findings[key] = self.findings.get(key, 0) + 1

    def _findings(self) -> tuple[Finding, ...]:
        return tuple(
            Finding(kind, self.kernel.name, message, line, None, count)
            for (kind, message, line), count in self.findings.items()
        )

    def _counters(self) -> Counters:
        counters = Counters()
        for step in self.steps:
            if step.tally.warp_inst:
                line = step.item.line or UNKNOWN_LINE
                counters.lines[line] = counters.lines.get(line, Tally()) + step.tally
                counters.total = counters.total + step.tally
        return counters

    def _run_block(self, index, grid, rng) -> None:
        self.shared[:] = 0xFF
        self.local[:] = 0xFF
        block = _Block(self, index, grid, self.shared.ctypes.data)
        block.warps = [self._new_warp(block, number) for number in range(self.warp_count)]
        running = list(block.warps)
        while running:
            order = rng.permutation(len(running)) if rng is not None else range(len(running))
            for position in order:
                _run_warp(running[position], self)
            _release_barriers(block, self)
            running = [warp for warp in block.warps if warp.splits and warp.barrier is None]

    def _new_warp(self, block: _Block, number: int) -> _Warp:
        linear = number * WARP + LANES
        live = linear < self.threads
        width, height, _ = self.block_shape
        thread = (linear % width, linear // width % height, linear // (width * height))
        registers = [np.zeros(WARP, dtype=DTYPES[_raw(reg.type)]) for reg in self.slots]
        local_start = (self.local.ctypes.data + linear * self.kernel.local_bytes).astype(np.uint64)
        threads = tuple(axis.astype(np.uint32) for axis in thread)
        return _Warp(block, number, live, threads, registers, local_start, {0: live})


class _Stopped(Exception):
    """The launch has ended early; the finding that says why is recorded."""


def _aligned(size: int) -> Array:
    """``size`` bytes that start at a multiple of 256."""
    room = np.zeros(size + 256, dtype=np.uint8)
    start = -room.ctypes.data % 256
    return room[start : start + size]


def _raw(kind: str) -> str:
    """The unsigned type of a register's width."""
    return kind if kind == "pred" else f"b{8 * DTYPES[kind].itemsize}"


# --- control flow -----------------------------------------------------------------------------------------------------


def _run_warp(warp: _Warp, launch: _Launch) -> None:
    """Run until every lane has left or waits at a block barrier."""
    while warp.splits and warp.barrier is None:
        ready = warp.splits.keys() - warp.parked
        forced = not ready
        if forced:
            ready = set(warp.parked)
        pc = min(ready)
        warp.parked.discard(pc)
        _run_split(warp, launch, pc, warp.splits.pop(pc), forced)


def _run_split(warp: _Warp, launch: _Launch, pc: int, mask: Array, forced: bool) -> None:
    """Run ``mask`` from ``pc`` until it branches, meets other lanes, waits or leaves."""
    count = int(np.count_nonzero(mask))
    limit = min((at for at in warp.splits if at > pc), default=len(launch.steps))
    full = count == WARP
    while pc < len(launch.steps):
        if pc == limit:  # others wait here
            return _join(warp, pc, mask)
        step = launch.steps[pc]
        if step.guard is None:
            active, everyone = mask, full
        else:
            held = warp.registers[step.guard]
            active = mask & (~held if step.item.negated else held)
            everyone = False
        kind = step.kind
        if kind in ("collective", "barrier") and not forced and _must_wait(warp, step, mask, active):
            warp.splits[pc] = mask
            warp.parked.add(pc)
            return None
        launch.issued += 1
        if launch.budget is not None and launch.issued > launch.budget:
            launch.find("runaway", f"more than {launch.budget} warp instructions", step.item)
            raise _Stopped
        step.tally.warp_inst += 1
        step.tally.lane_inst += count
        if kind == "plain":
            try:
                step.apply(warp, None if everyone else active)
            except FaultError as fault:
                launch.find(fault.kind, str(fault), step.item)
                raise _Stopped from fault
            pc += 1
            continue
        if kind == "collective":
            _check_members(warp, launch, step, active)
            step.apply(warp, active)
            forced = False
            pc += 1
            continue
        if kind == "branch":
            return _branch(warp, launch, step, pc, mask, active)
        if kind == "exit":
            warp.live = warp.live & ~active
            if (mask & ~active).any():
                mask = mask & ~active
                count, full = int(np.count_nonzero(mask)), False
                pc += 1
                continue
            return None
        if kind == "trap":
            if active.any():
                launch.find("trap", "the kernel ended itself (trap or a failed assertion)", step.item)
                raise _Stopped
            pc += 1
            continue
        if (mask != warp.live).any() or warp.waited & ~_bits(mask):
            # Some never come, or left while others waited here.
            launch.find("divergent-barrier", "a barrier reached by only some lanes of a warp", step.item)
            raise _Stopped
        warp.waited = 0
        step.tally.bar += 1
        arrival = step.apply(warp, active)
        assert isinstance(arrival, _Arrival)
        arrival.resume, arrival.mask = pc + 1, mask
        warp.splits[pc + 1] = mask
        warp.barrier = arrival
        return None
    warp.live = warp.live & ~mask
    return None


def _join(warp: _Warp, pc: int, mask: Array) -> None:
    warp.splits[pc] = warp.splits[pc] | mask if pc in warp.splits else mask
    warp.parked.discard(pc)


def _branch(warp: _Warp, launch: _Launch, step: _Step, pc: int, mask: Array, active: Array) -> None:
    taken = step.apply(warp, active)
    assert isinstance(taken, list)  # (label position, lanes)
    ways = [(at, lanes) for at, lanes in (*taken, (pc + 1, mask & ~active)) if lanes.any()]
    if step.guard is not None or step.item.root == "brx":
        step.tally.branch += 1
        step.tally.div_branch += len(ways) > 1
    for at, lanes in ways:
        if at >= len(launch.steps):
            warp.live = warp.live & ~lanes
        else:
            _join(warp, at, lanes)


def _bits(lanes: Array) -> int:
    """Lanes as a 32-bit mask."""
    return int(np.packbits(lanes, bitorder="little").view("<u4")[0])


def _must_wait(warp: _Warp, step: _Step, mask: Array, active: Array) -> bool:
    """Whether lanes that the operation names are alive but not here yet."""
    missing = _named(warp, step, active) & _bits(warp.live) & ~_bits(mask if step.kind == "barrier" else active)
    warp.waited |= missing
    return missing != 0


def _named(warp: _Warp, step: _Step, active: Array) -> int:
    """All lanes that the executing lanes name, as a mask; a block barrier names everyone."""
    if step.kind == "barrier":
        return 0xFFFFFFFF
    return int(np.bitwise_or.reduce(_members(warp, step, active)[active], initial=0))


def _members(warp: _Warp, step: _Step, active: Array) -> Array:
    """The lanes each lane names, (32,) masks; the active ones for the forms without ``.sync``."""
    operand = getattr(step.apply, "members", None)
    if operand is None:
        return np.full(WARP, _bits(active), dtype=np.uint32)
    return operand(warp)


def _check_members(warp: _Warp, launch: _Launch, step: _Step, active: Array) -> None:
    here, named = _bits(active), _named(warp, step, active)
    members = _members(warp, step, active)
    if any(not int(members[lane]) >> lane & 1 for lane in np.flatnonzero(active).tolist()):
        launch.find("bad-mask", f"{step.item.opcode} run by a lane that its mask does not name", step.item)
    elif named & ~here & (_bits(warp.live) | warp.waited):
        launch.find("bad-mask", f"{step.item.opcode} names lanes that never arrive", step.item)
    warp.waited &= ~here


def _release_barriers(block: _Block, launch: _Launch) -> None:
    """Let go the warps whose barrier is complete: all threads that still run have arrived, or as many as it asked."""
    waiting = [warp for warp in block.warps if warp.barrier is not None]
    if not waiting:
        return
    released = False
    for number in sorted({warp.barrier.number for warp in waiting if warp.barrier}):
        here = [warp for warp in waiting if warp.barrier and warp.barrier.number == number]
        wanted = max(warp.barrier.threads for warp in here if warp.barrier)
        alive = [warp for warp in block.warps if warp.live.any()]
        complete = len(here) * WARP >= wanted if wanted else len(here) == len(alive)
        if complete:
            _answer(here)
            released = True
            for warp in here:
                warp.barrier = None
    if not released:
        first = min(waiting, key=lambda warp: warp.number)
        assert first.barrier is not None
        item = launch.steps[first.barrier.resume - 1].item
        launch.find("divergent-barrier", "warps of a thread block wait at different barriers", item)
        raise _Stopped


def _answer(warps: list[_Warp]) -> None:
    """Combine the votes of a ``bar.red`` and hand every lane the result."""
    arrivals = [warp.barrier for warp in warps]
    votes = [a.values[a.mask] for a in arrivals if a is not None and a.values is not None]
    if not votes:
        return
    all_votes = np.concatenate(votes)
    for warp, arrival in zip(warps, arrivals, strict=True):
        if arrival is not None and arrival.answer is not None:
            arrival.answer(warp, arrival.mask, all_votes)


# --- decoding ---------------------------------------------------------------------------------------------------------


class _Decoder:
    """Turns instructions into steps. Readers are functions of a warp that give arrays of 32."""

    def __init__(self, kernel: Kernel, variables: dict[str, Array], params_start: int) -> None:
        self.kernel, self.variables, self.params_start = kernel, variables, params_start
        self.slots: list[Reg] = []
        self.slot_of: dict[str, int] = {}
        self.position = {id(item): number for number, item in enumerate(kernel.instructions)}

    def slot(self, reg: Reg) -> int:
        number = self.slot_of.setdefault(reg.name, len(self.slots))
        if number == len(self.slots):
            self.slots.append(reg)
        return number

    def step(self, item: Instruction) -> _Step:
        guard = self.slot(item.guard) if item.guard is not None else None
        kind, apply = self._meaning(item)
        return _Step(item, kind, guard, apply)

    def _meaning(self, item: Instruction) -> tuple[str, Callable[..., object]]:
        root, modifiers = item.root, set(item.modifiers)
        if root in ("bra", "brx"):
            return "branch", self._branch(item)
        if root in ("ret", "exit"):
            return "exit", _nothing
        if root == "trap":
            return "trap", _nothing
        if root in ("bar", "barrier"):
            if "warp" in modifiers:
                return "collective", self._warp_barrier(item)
            return "barrier", self._barrier(item)
        if root in _NO_EFFECT:
            return "plain", _nothing
        if root in _COLLECTIVE:
            return "collective", self._collective(item)
        builders = {"ld": self._load, "ldu": self._load, "st": self._store, "atom": self._atomic, "red": self._atomic}
        builders |= {"cvta": self._cvta, "isspacep": self._isspacep, "activemask": self._activemask}
        if root in builders:
            return "plain", builders[root](item)
        if root == "mov" and (len(item.dsts) > 1 or any(isinstance(s, Vector) for s in item.srcs)):
            return "plain", self._pack(item)
        return "plain", self._lanewise(item)

    # --- operands ---

    def reader(self, operand: Operand, kind: str) -> Callable[[_Warp], Array]:
        """Read an operand as ``kind``. A wider register gives its low bits, a narrower one is zero-extended."""
        dtype = DTYPES[kind]
        match operand:
            case NotReg(reg):
                inner = self.reader(reg, kind)
                return lambda warp: ~inner(warp)
            case Reg():
                return self._register_reader(operand, dtype)
            case Imm(value, float_bits):
                constant = _immediate(value, float_bits, dtype)
            case Symbol(name, _, offset):
                start = self.variables[name].ctypes.data if name in self.variables else 0
                constant = np.full(WARP, start + offset, dtype=np.uint64).astype(f"u{dtype.itemsize}").view(dtype)
            case Special(name):
                special = _special(name, self)
                return lambda warp: special(warp).astype(dtype)
            case _:
                raise TypeError(operand)
        return lambda warp: constant

    def _register_reader(self, reg: Reg, dtype: np.dtype) -> Callable[[_Warp], Array]:
        number = self.slot(reg)
        have = DTYPES[_raw(reg.type)]
        if have == dtype:
            return lambda warp: warp.registers[number]
        if have.itemsize == dtype.itemsize:
            return lambda warp: warp.registers[number].view(dtype)
        unsigned = np.dtype(f"u{dtype.itemsize}")
        return lambda warp: warp.registers[number].astype(unsigned).view(dtype)

    def writer(self, reg: Reg | None) -> Callable[[_Warp, Array | None, Array], None]:
        """Write values to the active lanes (None: all). A wider register takes signed values sign-extended."""
        if reg is None:
            return lambda warp, active, values: None
        number = self.slot(reg)
        raw = DTYPES[_raw(reg.type)]

        def write(warp: _Warp, active: Array | None, values: Array) -> None:
            if values.dtype != raw:
                if values.dtype.itemsize != raw.itemsize:
                    kind = "i" if values.dtype.kind == "i" else "u"
                    values = values.view(f"{kind}{values.dtype.itemsize}").astype(f"{kind}{raw.itemsize}")
                values = values.view(raw)
            if active is not None:
                values = np.where(active, values, warp.registers[number])
            warp.registers[number] = values

        return write

    def address(self, operand: Operand, space: str) -> Callable[[_Warp], Array]:
        """Host addresses, (32,) uint64. space: "" for generic."""
        assert isinstance(operand, Address)
        base = operand.base
        if isinstance(base, Reg):
            read, low = self.reader(base, "u64"), DTYPES[_raw(base.type)].itemsize * 8
        else:
            read, low = self.reader(base, "u64"), 64
        offset = np.uint64(operand.offset & (2**64 - 1))
        keep = np.uint64((1 << low) - 1)
        start = self._window(space)
        return lambda warp: ((read(warp) + offset) & keep) + start(warp)

    def _window(self, space: str) -> Callable[[_Warp], np.uint64 | Array]:
        """Where a state space starts in the generic space."""
        if space == "shared":
            return lambda warp: np.uint64(warp.block.shared_start)
        if space == "local":
            return lambda warp: warp.local_start
        start = np.uint64(self.params_start if space == "param" else 0)
        return lambda warp: start

    # --- arithmetic ---

    def _lanewise(self, item: Instruction) -> Callable[..., object]:
        op = lane_op(item)
        if len(item.srcs) > len(op.sources) or len(item.dsts) != len(op.results):
            raise Modifiers(item).refusal()
        readers = [self.reader(s, kind) for s, kind in zip(item.srcs, op.sources, strict=False)]
        writers = [self.writer(d) for d in item.dsts]
        compute = op.apply
        if len(writers) == 1:
            write = writers[0]

            def apply(warp: _Warp, active: Array | None) -> None:
                result = compute(*[read(warp) for read in readers])
                write(warp, active, result[0] if isinstance(result, tuple) else result)

            return apply

        def apply_many(warp: _Warp, active: Array | None) -> None:
            results = compute(*[read(warp) for read in readers])
            for write, result in zip(writers, results, strict=True):
                write(warp, active, result)

        return apply_many

    def _pack(self, item: Instruction) -> Callable[..., object]:
        """``mov.b64 d, {a, b}`` and ``mov.b64 {a, b}, s``."""
        m = Modifiers(item)
        kind = m.type("b16", "b32", "b64")
        m.done()
        parts: tuple[Reg | Imm | None, ...]
        source = item.srcs[0]
        parts = source.items if isinstance(source, Vector) else item.dsts
        width = DTYPES[kind].itemsize // len(parts)
        part = f"b{8 * width}"
        if isinstance(source, Vector):
            readers = [self.reader(p, part) for p in source.items if p is not None]
            write = self.writer(item.dsts[0])

            def pack(warp: _Warp, active: Array | None) -> None:
                columns = np.stack([read(warp) for read in readers], axis=1)
                write(warp, active, np.ascontiguousarray(columns).view(DTYPES[kind])[:, 0])

            return pack
        read = self.reader(source, kind)
        writers = [self.writer(d) for d in item.dsts]

        def unpack(warp: _Warp, active: Array | None) -> None:
            columns = np.ascontiguousarray(read(warp)).view(DTYPES[part]).reshape(WARP, -1)
            for position, write in enumerate(writers):
                write(warp, active, np.ascontiguousarray(columns[:, position]))

        return unpack

    # --- memory ---

    def _access(self, item: Instruction) -> tuple[str, int, str]:
        """-> space ("" generic), elements per lane, element type of a load or store."""
        m = Modifiers(item)
        m.rest = [name for name in m.rest if name not in _IGNORED_BY_MEMORY]
        space = _SPACES.get(m.choice(_SPACES, ""), "")
        count = int(m.choice(("v2", "v4"), "v1")[1:])
        kind = m.type()
        if kind in ("pred", "b128"):
            raise m.refusal()
        m.done()
        return space, count, kind

    def _load(self, item: Instruction) -> Callable[..., object]:
        space, count, kind = self._access(item)
        address, dtype = self.address(item.srcs[0], space), DTYPES[kind]
        writers = [self.writer(d) for d in item.dsts]
        size = dtype.itemsize * count
        tally = self._tally_of(item)

        def apply(warp: _Warp, active: Array | None) -> None:
            lanes = np.ones(WARP, dtype=bool) if active is None else active
            pieces = warp.block.launch.memory.locate(address(warp), lanes, size, space)
            memory.count_load(tally(warp), pieces, size, is_generic=not space)
            values = memory.load(pieces, dtype, count)
            for position, write in enumerate(writers):
                write(warp, active, np.ascontiguousarray(values[:, position]))

        return apply

    def _store(self, item: Instruction) -> Callable[..., object]:
        space, count, kind = self._access(item)
        address, dtype = self.address(item.srcs[0], space), DTYPES[kind]
        readers = self._elements(item.srcs[1], kind)
        size = dtype.itemsize * count
        tally = self._tally_of(item)

        def apply(warp: _Warp, active: Array | None) -> None:
            lanes = np.ones(WARP, dtype=bool) if active is None else active
            pieces = warp.block.launch.memory.locate(address(warp), lanes, size, space)
            memory.count_store(tally(warp), pieces, size)
            memory.store(pieces, np.stack([read(warp) for read in readers], axis=1))

        return apply

    def _elements(self, operand: Operand, kind: str) -> list[Callable[[_Warp], Array]]:
        items = operand.items if isinstance(operand, Vector) else (operand,)
        return [self.reader(i, kind) for i in items if i is not None]

    def _tally_of(self, item: Instruction) -> Callable[[_Warp], Tally]:
        """The step's own tally; the step exists only after its meaning, so it is looked up when it runs."""
        number = self.position[id(item)]
        return lambda warp: warp.block.launch.steps[number].tally

    def _atomic(self, item: Instruction) -> Callable[..., object]:
        m = Modifiers(item)
        m.rest = [name for name in m.rest if name not in _IGNORED_BY_MEMORY]
        space = _SPACES.get(m.choice(_SPACES, ""), "")
        if space not in ("", "global", "shared"):
            raise m.refusal()
        count = int(m.choice(("v2", "v4"), "v1")[1:])
        operation = m.choice(_ATOMICS)
        kind = m.type(*_ATOMICS[operation][0])
        m.done()
        change = _ATOMICS[operation][1]
        if (operation == "cas") != (len(item.srcs) == 3) or (operation == "cas" and item.root == "red"):
            raise m.refusal()
        dtype = DTYPES[kind]
        address = self.address(item.srcs[0], space)
        operands = [self._elements(s, kind) for s in item.srcs[1:]]
        writers = [self.writer(d) for d in item.dsts]
        size = dtype.itemsize * count
        tally = self._tally_of(item)

        def apply(warp: _Warp, active: Array | None) -> None:
            lanes = np.ones(WARP, dtype=bool) if active is None else active
            pieces = warp.block.launch.memory.locate(address(warp), lanes, size, space)
            if any(piece.space not in ("global", "shared") for piece in pieces):
                raise FaultError("out-of-bounds", f"{item.opcode} of memory that is neither global nor shared")
            memory.count_atomic(tally(warp), pieces, dtype.itemsize)
            values = [np.stack([read(warp) for read in elements], axis=1) for elements in operands]

            def new(old: Array, chosen: Array, where: str) -> Array:
                with np.errstate(all="ignore"):
                    return change(where, old, *[v[chosen] for v in values])

            before = memory.atomic(pieces, dtype, count, new)
            for position, write in enumerate(writers):
                write(warp, active, np.ascontiguousarray(before[:, position]))

        return apply

    def _cvta(self, item: Instruction) -> Callable[..., object]:
        m = Modifiers(item)
        to = m.flag("to")
        space = _SPACES[m.choice(_SPACES)]
        m.type("u64")
        m.done()
        read, write, start = self.reader(item.srcs[0], "u64"), self.writer(item.dsts[0]), self._window(space)

        def apply(warp: _Warp, active: Array | None) -> None:
            address = read(warp)
            write(warp, active, address - start(warp) if to else address + start(warp))

        return apply

    def _isspacep(self, item: Instruction) -> Callable[..., object]:
        m = Modifiers(item)
        space = _SPACES[m.choice(_SPACES)]
        m.done()
        read, write = self.reader(item.srcs[0], "u64"), self.writer(item.dsts[0])

        def apply(warp: _Warp, active: Array | None) -> None:
            table = warp.block.launch.memory
            which = np.searchsorted(table.starts, read(warp), side="right") - 1
            inside = (which >= 0) & (read(warp) < table.stops[which])
            names = np.array(table.spaces)[which]
            # Every address outside the windows of shared, local, const and parameter memory is a global one.
            here = (names == space) & inside
            write(warp, active, here | ~inside if space == "global" else here)

        return apply

    # --- branches and barriers ---

    def _branch(self, item: Instruction) -> Callable[..., object]:
        targets = [self.kernel.labels[t] for t in item.targets]
        if item.root == "bra":
            return lambda warp, active: [(targets[0], active)]
        index = self.reader(item.srcs[0], "u32")

        def choose(warp: _Warp, active: Array) -> list[tuple[int, Array]]:
            chosen = index(warp)
            if (chosen[active] >= len(targets)).any():
                raise InputError(f"PTX: branch index beyond its table at {item.where()}")
            where = np.array(targets)[np.minimum(chosen, len(targets) - 1)]
            return [(at, active & (where == at)) for at in sorted(set(targets))]

        return choose

    def _barrier(self, item: Instruction) -> Callable[..., object]:
        m = Modifiers(item)
        m.rest = [name for name in m.rest if name not in ("cta", "aligned")]
        action = m.choice(("sync", "arrive", "red"))
        combine = m.choice(("popc", "and", "or"), "") if action == "red" else ""
        if combine:
            m.type("u32" if combine == "popc" else "pred")
        m.done()
        if action == "arrive":
            raise m.refusal()
        srcs = item.srcs[:-1] if combine else item.srcs
        numbers = [self.reader(s, "u32") for s in srcs]
        vote = self.reader(item.srcs[-1], "pred") if combine else None
        write = self.writer(item.dsts[0]) if combine else None

        def answer(warp: _Warp, mask: Array, votes: Array) -> None:
            assert write is not None
            if combine == "popc":
                write(warp, mask, np.full(WARP, np.count_nonzero(votes), dtype=np.uint32))
            else:
                write(warp, mask, np.full(WARP, votes.all() if combine == "and" else votes.any()))

        def apply(warp: _Warp, active: Array) -> _Arrival:
            lane = int(np.flatnonzero(active)[0]) if active.any() else 0
            given = [int(read(warp)[lane]) for read in numbers]
            values = vote(warp) if vote is not None else None
            threads = given[1] if len(given) > 1 else 0
            return _Arrival(given[0], threads, 0, active, values, answer if combine else None)

        return apply

    def _warp_barrier(self, item: Instruction) -> Callable[..., object]:
        members = self.reader(item.srcs[0], "u32")
        tally = self._tally_of(item)

        def apply(warp: _Warp, active: Array) -> None:
            tally(warp).bar_warp += 1

        apply.members = members  # type: ignore[attr-defined]
        return apply

    # --- operations across lanes ---

    def _activemask(self, item: Instruction) -> Callable[..., object]:
        write = self.writer(item.dsts[0])

        def apply(warp: _Warp, active: Array | None) -> None:
            lanes = np.ones(WARP, dtype=bool) if active is None else active
            write(warp, active, np.full(WARP, _bits(lanes), dtype=np.uint32))

        return apply

    def _collective(self, item: Instruction) -> Callable[..., object]:
        m = Modifiers(item)
        sync = m.flag("sync")
        build = {"shfl": self._shfl, "vote": self._vote, "match": self._match, "redux": self._redux}.get(item.root)
        if build is None or (not sync and item.root in ("match", "redux")):
            raise m.refusal()
        members = self.reader(item.srcs[-1], "u32") if sync else None
        srcs = item.srcs[:-1] if sync else item.srcs
        compute = build(m, srcs)
        m.done()
        writers = [self.writer(d) for d in item.dsts]

        def apply(warp: _Warp, active: Array) -> None:
            named = members(warp) if members is not None else np.full(WARP, _bits(active), dtype=np.uint32)
            # group[i, j]: lane i's operation includes lane j
            group = (named[:, None] >> LANES.astype(np.uint32) & 1).astype(bool) & active
            for write, values in zip(writers, compute(warp, group), strict=False):
                write(warp, active, values)

        if members is not None:
            apply.members = members  # type: ignore[attr-defined]
        return apply

    def _shfl(self, m: Modifiers, srcs: tuple[Operand, ...]) -> Callable[[_Warp, Array], tuple[Array, ...]]:
        """A source lane outside the segment gives the lane's own value; one that is switched off, its last value."""
        mode = m.choice(("up", "down", "bfly", "idx"))
        m.type("b32")
        value, by, clamp = (self.reader(s, "u32") for s in srcs)

        def compute(warp: _Warp, group: Array) -> tuple[Array, ...]:
            a, b, c = value(warp), by(warp).astype(np.int64) & 31, clamp(warp).astype(np.int64)
            segment, limit = c >> 8 & 31, c & 31
            highest = (LANES & segment) | (limit & ~segment)
            if mode == "up":
                source = LANES - b
                inside = source >= highest
            else:
                source = {"down": LANES + b, "bfly": LANES ^ b, "idx": (LANES & segment) | (b & ~segment)}[mode]
                inside = source <= highest
            return a[np.where(inside, source, LANES)], inside

        return compute

    def _vote(self, m: Modifiers, srcs: tuple[Operand, ...]) -> Callable[[_Warp, Array], tuple[Array, ...]]:
        mode = m.choice(("all", "any", "uni", "ballot"))
        m.type("b32" if mode == "ballot" else "pred")
        predicate = self.reader(srcs[0], "pred")

        def compute(warp: _Warp, group: Array) -> tuple[Array, ...]:
            yes, no = group & predicate(warp), group & ~predicate(warp)
            if mode == "ballot":
                return (np.array([_bits(row) for row in yes], dtype=np.uint32),)
            if mode == "any":
                return (yes.any(axis=1),)
            return (~no.any(axis=1) if mode == "all" else ~no.any(axis=1) | ~yes.any(axis=1),)

        return compute

    def _match(self, m: Modifiers, srcs: tuple[Operand, ...]) -> Callable[[_Warp, Array], tuple[Array, ...]]:
        mode = m.choice(("any", "all"))
        value = self.reader(srcs[0], m.type("b32", "b64"))

        def compute(warp: _Warp, group: Array) -> tuple[Array, ...]:
            a = value(warp)
            same = group & (a[:, None] == a)
            if mode == "any":
                return (np.array([_bits(row) for row in same], dtype=np.uint32),)
            agreed = (same == group).all(axis=1)
            named = np.array([_bits(row) for row in group], dtype=np.uint32)
            return np.where(agreed, named, np.uint32(0)), agreed

        return compute

    def _redux(self, m: Modifiers, srcs: tuple[Operand, ...]) -> Callable[[_Warp, Array], tuple[Array, ...]]:
        reduce = _REDUCTIONS[m.choice(_REDUCTIONS)]
        kind = m.type("u32", "s32", "b32")
        value = self.reader(srcs[0], kind)

        def compute(warp: _Warp, group: Array) -> tuple[Array, ...]:
            a = value(warp)
            return (np.array([reduce(a[row]) if row.any() else 0 for row in group], dtype=a.dtype),)

        return compute


def _nothing(warp: _Warp, active: Array | None) -> None:
    """No effect on results: fences, prefetches, waits."""


def _immediate(value: int, float_bits: int, dtype: np.dtype) -> Array:
    if dtype == np.bool_:
        return np.full(WARP, bool(value))
    if float_bits == 64 and dtype == np.float32:
        return np.full(WARP, np.uint64(value).view(np.float64), dtype=np.float32)
    bits = value & ((1 << 8 * dtype.itemsize) - 1)
    return np.full(WARP, bits, dtype=f"u{dtype.itemsize}").view(dtype)


def _special(name: str, decoder: _Decoder) -> Callable[[_Warp], Array]:
    """A special register as (32,) unsigned integers. Clocks count the warp instructions of the launch."""
    head, _, axis = name.partition(".")
    number = "xyz".find(axis) if axis else 0

    def constant(value: int) -> Array:
        return np.full(WARP, value, dtype=np.uint64)

    ones = np.uint64(1) << LANES.astype(np.uint64)
    lane_masks = {
        "%lanemask_eq": ones,
        "%lanemask_lt": ones - np.uint64(1),
        "%lanemask_le": (ones << np.uint64(1)) - np.uint64(1),
        "%lanemask_gt": ~((ones << np.uint64(1)) - np.uint64(1)) & np.uint64(0xFFFFFFFF),
        "%lanemask_ge": ~(ones - np.uint64(1)) & np.uint64(0xFFFFFFFF),
    }
    if head in lane_masks:
        mask = lane_masks[head]
        return lambda warp: mask
    lane_numbers = LANES.astype(np.uint64)
    readers: dict[str, Callable[[_Warp], Array]] = {
        "%tid": lambda warp: warp.thread[number],
        "%ntid": lambda warp: constant(warp.block.launch.block_shape[number]),
        "%ctaid": lambda warp: constant(warp.block.index[number]),
        "%nctaid": lambda warp: constant(warp.block.grid[number]),
        "%laneid": lambda warp: lane_numbers,
        "%warpid": lambda warp: constant(warp.number),
        "%nwarpid": lambda warp: constant(warp.block.launch.warp_count),
        "%smid": lambda warp: constant(0),
        "%nsmid": lambda warp: constant(1),
        "%gridid": lambda warp: constant(0),
        "%dynamic_smem_size": lambda warp: constant(warp.block.launch.dynamic_shared),
        "%total_smem_size": lambda warp: constant(warp.block.launch.all_shared),
    }
    for clock in ("%clock", "%clock64", "%globaltimer", "%globaltimer_lo"):
        readers[clock] = lambda warp: constant(warp.block.launch.issued)
    for upper in ("%clock_hi", "%globaltimer_hi"):
        readers[upper] = lambda warp: constant(warp.block.launch.issued >> 32)
    if head not in readers:
        raise InputError(f"PTX: special register {name} is not supported by the simulator")
    return readers[head]


_REDUCTIONS: dict[str, Callable[[Array], np.generic]] = {
    "add": lambda a: a.sum(dtype=a.dtype),
    "min": np.min,
    "max": np.max,
    "and": np.bitwise_and.reduce,
    "or": np.bitwise_or.reduce,
    "xor": np.bitwise_xor.reduce,
}


def _atomic_add(space: str, old: Array, b: Array) -> Array:
    """f32 sums in global memory flush subnormals, those in shared memory do not (PTX ISA, ``atom``)."""
    if old.dtype.kind != "f":
        return old + b
    if old.dtype == np.float32 and space == "global":
        return canonical(flush(flush(old) + flush(b)))
    return canonical(old + b)


def _atomic_cas(space: str, old: Array, b: Array, c: Array) -> Array:
    return np.where(old == b, c, old)


def _atomic_inc(space: str, old: Array, b: Array) -> Array:
    return np.where(old >= b, np.zeros_like(old), old + 1)


def _atomic_dec(space: str, old: Array, b: Array) -> Array:
    return np.where((old == 0) | (old > b), b, old - 1)


_WORDS = ("u32", "s32", "u64", "s64")
_FIELDS = ("b32", "b64")
_ATOMICS: dict[str, tuple[tuple[str, ...], Callable[..., Array]]] = {
    "add": ((*_WORDS, "f32", "f64"), _atomic_add),
    "min": (_WORDS, lambda space, old, b: np.minimum(old, b)),
    "max": (_WORDS, lambda space, old, b: np.maximum(old, b)),
    "and": (_FIELDS, lambda space, old, b: old & b),
    "or": (_FIELDS, lambda space, old, b: old | b),
    "xor": (_FIELDS, lambda space, old, b: old ^ b),
    "exch": (_FIELDS, lambda space, old, b: b),
    "cas": (("b16", *_FIELDS), _atomic_cas),
    "inc": (("u32",), _atomic_inc),
    "dec": (("u32",), _atomic_dec),
}
