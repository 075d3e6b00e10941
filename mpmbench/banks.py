"""Shared-memory banks that the block kernels take, in closed form, for any block shape (thesis appendix C).

A thread owns a cell (x, y, z) of its block and, at one node step, a place of the arena: the same offset from its cell
in all threads. A place holds four numbers, so a bank group is what one place takes: 8 groups for float, and a double
place takes two of them, one after the other. With arena edges A_x, A_y the group of a cell is

    (x + A_x (y + A_y z) + shift) mod 8,

and the offset only adds to ``shift``: it turns the pattern round, and every node step costs the same. Requests of 16
bytes per lane are served eight lanes at a time, so a step costs no more than it must where every eight neighbouring
lanes fall into eight different groups.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mpmbench.grid import Triple
from mpmbench.spline import get_spline

GROUPS = 8  # of four neighbouring 4-byte banks: what one float place takes
WARP = 32
SERVED = 8  # lanes that a 16-byte request serves at once


@dataclass(frozen=True)
class BankPattern:
    """Places of an arena that the warps of a block take in one node step.

    block_shape: cells of a block.  spline: decides the halo.  double: places of 32 bytes instead of 16.
    """

    block_shape: Triple
    spline: str = "cubic"
    double: bool = False

    @property
    def arena(self) -> Triple:
        """Places per axis: the block and its halo."""
        spline = get_spline(self.spline)
        x, y, z = (edge + spline.left + spline.right for edge in self.block_shape)
        return (x, y, z)

    @property
    def warps(self) -> int:
        return -(-int(np.prod(self.block_shape)) // WARP)

    def places(self, warp: int, shift: int = 0) -> np.ndarray:
        """Place of every lane that has a cell, counted from the arena's first; x runs fastest. (lanes,)

        shift: of the node step, its offset's place.
        """
        bx, by, bz = self.block_shape
        ax, ay, _ = self.arena
        cell = np.arange(WARP * warp, min(WARP * (warp + 1), bx * by * bz))
        return cell % bx + ax * (cell // bx % by + ay * (cell // (bx * by))) + shift

    def groups(self, warp: int, shift: int = 0) -> np.ndarray:
        """Bank group of every lane, for each 16-byte piece of its place. (pieces, lanes)"""
        pieces = 2 if self.double else 1
        return (pieces * self.places(warp, shift) + np.arange(pieces)[:, None]) % GROUPS

    def accesses(self, warp: int) -> np.ndarray:
        """How often a warp takes each bank group in one node step: 4 each where they are balanced. (8,)"""
        return np.bincount(self.groups(warp).ravel(), minlength=GROUPS)

    def wavefronts(self, warp: int, shift: int = 0) -> int:
        """Passes over the banks that one access of a warp takes: of each eight lanes the busiest group."""
        total = 0
        for piece in self.groups(warp, shift):
            for first in range(0, len(piece), SERVED):
                total += int(np.bincount(piece[first : first + SERVED]).max())
        return total

    @property
    def step_wavefronts(self) -> int:
        """Of one access by all warps of a block."""
        return sum(self.wavefronts(warp) for warp in range(self.warps))

    @property
    def least_wavefronts(self) -> int:
        """The same without any conflict."""
        pieces = 2 if self.double else 1
        lanes = [len(self.places(warp)) for warp in range(self.warps)]
        return pieces * sum(-(-count // SERVED) for count in lanes)
