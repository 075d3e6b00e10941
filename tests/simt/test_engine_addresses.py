"""Address forms are sound: equal unknowns mean that addresses differ by the constants' difference, in every lane."""

from __future__ import annotations

import random
from dataclasses import replace
from itertools import combinations

import pytest

from mpmbench.simt.address_forms import AddressForms
from mpmbench.simt.ptx import Address, Imm, Instruction, Reg

NARROW = [Reg(f"%r{n}", "b32") for n in range(2)]
WIDE = [Reg(f"%rd{n}", "b64") for n in range(2)]


def near_an_edge(rng: random.Random) -> int:
    """A 32-bit number that a small sum or multiple may carry over the end of the signed or the unsigned range."""
    edge = rng.choice([0, 1 << 31, 1 << 32]) // rng.choice([1, 1, 2, 4, 16])
    return (edge + rng.randint(-20, 20)) & 0xFFFFFFFF


def signed(value: int, bits: int) -> int:
    value &= (1 << bits) - 1
    return value - (1 << bits) if value >> (bits - 1) else value


def random_program(rng: random.Random, length: int) -> list[Instruction]:
    """Straight-line code. Mostly every result has a register of its own, sometimes an old one is written again."""
    program: list[Instruction] = []
    narrow, wide = list(NARROW), list(WIDE)

    def target(known: list[Reg], inputs: list[Reg], prefix: str, kind: str) -> Reg:
        if len(known) > len(inputs) and rng.random() < 0.15:
            return rng.choice(known[len(inputs) :])
        return Reg(f"{prefix}{len(known)}", kind)

    for _ in range(length):
        (a, b), (x, y) = rng.choices(narrow[-5:], k=2), rng.choices(wide[-6:], k=2)
        d, z = target(narrow, NARROW, "%r", "b32"), target(wide, WIDE, "%rd", "b64")
        small, power = Imm(rng.choice([0, 1, 2, 3, 4, 5, 8, 9, 12, 16, -1, -4, -8])), Imm(rng.choice([1, 2, 3, 4]))
        factor = Imm(rng.choice([1, 2, 4, 8, 12, 16, -4]))
        choices = [
            *[Instruction("add.s32", (d,), (a, small))] * 4,
            *[Instruction(f"mul.wide.{rng.choice('su')}32", (z,), (a, Imm(4)))] * 3,
            Instruction("add.s32", (d,), (a, b)),
            Instruction("sub.s32", (d,), (a, b)),
            Instruction("shl.b32", (d,), (a, power)),
            Instruction("mul.lo.s32", (d,), (a, factor)),
            Instruction("mad.lo.s32", (d,), (a, factor, b)),
            Instruction("or.b32", (d,), (a, Imm(rng.choice([1, 2, 3, 4, 8])))),
            Instruction("mov.u32", (d,), (rng.choice([a, small]),)),
            Instruction("add.s64", (z,), (x, rng.choice([y, small]))),
            Instruction("shl.b64", (z,), (x, power)),
            Instruction("or.b64", (z,), (x, Imm(rng.choice([1, 4, 8])))),
            Instruction("mul.wide.s32", (z,), (a, factor)),
            Instruction("mul.wide.u32", (z,), (a, Imm(abs(factor.value)))),
            Instruction("mad.wide.s32", (z,), (a, factor, x)),
            Instruction("cvt.s64.s32", (z,), (a,)),
            Instruction("cvt.u64.u32", (z,), (a,)),
        ]
        chosen = rng.choice(choices)
        (dst,) = chosen.dsts
        known = wide if dst.type == "b64" else narrow
        if dst in known and rng.random() < 0.3:
            chosen = replace(chosen, guard=Reg("%p0", "pred"))
        elif dst not in known:
            known.append(dst)
        program.append(chosen)
        if rng.random() < 0.5:
            address = Address(rng.choice(wide[-8:]), rng.choice([0, 4, 8, -4]))
            program.append(Instruction("ld.global.f32", (Reg("%f0", "f32"),), (address,)))
    return program


def run(program: list[Instruction], values: dict[Reg, int], guard: bool) -> dict[int, int]:
    """Addresses of the memory instructions, by index."""
    values = dict(values)
    addresses = {}

    def read(operand, bits: int) -> int:
        return (operand.value if isinstance(operand, Imm) else values[operand]) & ((1 << bits) - 1)

    for index, item in enumerate(program):
        if item.root == "ld":
            address = item.srcs[0]
            addresses[index] = read(address.base, 64) + address.offset
            continue
        if item.guard is not None and not guard:
            continue
        root, kinds = item.root, item.modifiers
        bits = int(kinds[-1][1:])
        if root == "cvt":
            source = read(item.srcs[0], 32)
            result = signed(source, 32) if kinds[-1] == "s32" else source
        elif "wide" in kinds:
            a, b = (read(s, 32) for s in item.srcs[:2])
            if kinds[-1] == "s32":
                a, b = signed(a, 32), signed(b, 32)
            result = a * b + (read(item.srcs[2], 64) if root == "mad" else 0)
        else:
            a, *rest = (read(s, bits) for s in item.srcs)
            result = {
                "add": lambda a, b: a + b,
                "sub": lambda a, b: a - b,
                "shl": lambda a, b: a << b,
                "mul": lambda a, b: a * b,
                "mad": lambda a, b, c: a * b + c,
                "or": lambda a, b: a | b,
                "mov": lambda a: a,
            }[root](a, *rest)
        (dst,) = item.dsts
        values[dst] = result & ((1 << (64 if dst.type == "b64" else 32)) - 1)
    return addresses


@pytest.mark.parametrize("seed", range(8))
def test_equal_unknowns_mean_a_constant_distance(seed):
    rng = random.Random(seed)
    related = 0
    for _ in range(100):
        program = random_program(rng, 25)
        cut = rng.randrange(len(program))  # registers of the first part reach the block through their definitions
        for start in (0, cut):
            forms = AddressForms(program).of_block(program[start:], start)
            pairs = [(i, j) for i, j in combinations(forms, 2) if forms[i].terms == forms[j].terms]
            related += len(pairs)
            for trial in range(9):
                values = {reg: near_an_edge(rng) if trial % 3 else rng.getrandbits(32) for reg in NARROW}
                values |= {reg: rng.getrandbits(64) for reg in WIDE}
                addresses = run(program, values, guard=bool(trial % 3))
                for i, j in pairs:
                    expected = forms[i].constant - forms[j].constant
                    assert (addresses[i] - addresses[j] - expected) % 2**64 == 0, (program, i, j)
    assert related > 200


def test_the_patterns_that_compilers_print_are_recognised():
    """Node 4n + 9 next to node 4n + 8 in 32-bit arithmetic, an or for an add, and constants in the address."""
    n, four, nine, eight = (Reg(f"%r{number}", "b32") for number in range(4))
    wide9, wide8, base, near, far = (Reg(f"%rd{number}", "b64") for number in range(5))
    word = Reg("%f0", "f32")
    program = [
        Instruction("shl.b32", (four,), (n, Imm(2))),
        Instruction("add.s32", (nine,), (four, Imm(9))),
        Instruction("add.s32", (eight,), (four, Imm(8))),
        Instruction("mul.wide.s32", (wide9,), (nine, Imm(4))),
        Instruction("mul.wide.s32", (wide8,), (eight, Imm(4))),
        Instruction("add.s64", (near,), (base, wide9)),
        Instruction("add.s64", (far,), (base, wide8)),
        Instruction("ld.global.f32", (word,), (Address(near, 0),)),
        Instruction("ld.global.f32", (word,), (Address(far, 8),)),
    ]
    forms = AddressForms(program).of_block(program, 0)
    assert forms[7].terms == forms[8].terms
    assert forms[8].constant - forms[7].constant == 4
