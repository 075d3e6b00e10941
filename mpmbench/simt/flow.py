"""Control flow of a parsed kernel: basic blocks, successors and which registers live across their borders."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

from mpmbench.simt.ptx import Instruction, Kernel, Reg

ENDS_BLOCK = frozenset({"bra", "brx", "ret", "exit", "trap"})


@dataclass(frozen=True)
class Block:
    """Instructions ``start .. stop-1`` that always run together, under one mask.

    successors: block numbers; for a guarded branch the taken target(s) first, the fall-through last. The number after
    the last block stands for the end of the kernel.
    live_in/live_out: registers whose value is still needed at entry / exit.
    """

    start: int
    stop: int
    successors: tuple[int, ...]
    live_in: frozenset[Reg]
    live_out: frozenset[Reg]


def basic_blocks(
    kernel: Kernel,
    ends_block: Callable[[Instruction], bool] = lambda _: False,
    starts_block: Callable[[Instruction], bool] = lambda _: False,
) -> list[Block]:
    """Split a kernel into basic blocks, in text order.

    ends_block: further instructions that must be the last of their block (barriers, warp-level operations, or every
    shared access where an executor wants to switch warps there). starts_block: those that must be the first of theirs.
    """
    instructions = kernel.instructions
    count = len(instructions)
    starts = {0} | {at for at in kernel.labels.values() if at < count}
    for index, item in enumerate(instructions):
        if (item.root in ENDS_BLOCK or ends_block(item)) and index + 1 < count:
            starts.add(index + 1)
        if starts_block(item):
            starts.add(index)
    borders = [*sorted(starts), count]
    number = {start: block for block, start in enumerate(borders)}
    spans = list(pairwise(borders))
    successors = [_successors(kernel, number, block, stop) for block, (_, stop) in enumerate(spans)]
    live_in, live_out = _liveness(instructions, spans, successors)
    return [
        Block(start, stop, successors[b], frozenset(live_in[b]), frozenset(live_out[b]))
        for b, (start, stop) in enumerate(spans)
    ]


def _successors(kernel: Kernel, number: dict[int, int], block: int, stop: int) -> tuple[int, ...]:
    last = kernel.instructions[stop - 1]
    targets = tuple(number[kernel.labels[t]] for t in last.targets)
    if last.root in {"ret", "exit", "trap"}:
        return (block + 1,) if last.guard is not None else ()
    if last.root in {"bra", "brx"}:
        return (*targets, block + 1) if last.guard is not None else targets
    return (block + 1,)


def _liveness(instructions, spans, successors):
    reads, kills = [], []
    for start, stop in spans:
        read: set[Reg] = set()
        killed: set[Reg] = set()
        for item in instructions[start:stop]:
            read.update(reg for reg in item.reads() if reg not in killed)
            for reg in item.writes():
                # Lanes that a guard masks out keep the old value: such a write reads as well, and kills nothing.
                if item.guard is not None:
                    if reg not in killed:
                        read.add(reg)
                else:
                    killed.add(reg)
        reads.append(read)
        kills.append(killed)
    live_in: list[set[Reg]] = [set() for _ in spans]
    live_out: list[set[Reg]] = [set() for _ in spans]
    changed = True
    while changed:
        changed = False
        for block in reversed(range(len(spans))):
            out: set[Reg] = set()
            for successor in successors[block]:
                if successor < len(spans):
                    out |= live_in[successor]
            into = reads[block] | (out - kills[block])
            if len(out) != len(live_out[block]) or len(into) != len(live_in[block]):
                live_out[block], live_in[block], changed = out, into, True
    return live_in, live_out
