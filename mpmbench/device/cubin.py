"""Machine instructions (SASS) in the ELF file that ``ptxas`` writes: how many a kernel has, and from which lines.

Maxwell and Pascal (sm_5x, sm_6x) pack three instructions of 8 bytes behind 8 bytes of control; Volta and later take
16 bytes for each. The code of a kernel is section ``.text.<entry>``, in which ptxas puts the routines for division and
square roots that the kernel calls as well.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

from mpmbench.simt.counters import SourceLine

_SECTION = struct.Struct("<IIQQQQIIQQ")  # Elf64_Shdr: name, type, flags, addr, offset, size, link, info, align, entsize
_TEXT = ".text."

# DWARF 2, line number program: https://dwarfstd.org/doc/dwarf-2.0.0.pdf, section 6.2.
_COPY, _ADVANCE_PC, _ADVANCE_LINE, _SET_FILE, _CONST_ADD_PC, _FIXED_ADVANCE_PC = 1, 2, 3, 4, 8, 9
_END_SEQUENCE, _SET_ADDRESS = 1, 2


def instruction_counts(cubin: bytes, arch: str) -> dict[str, int]:
    """Machine instructions of each kernel (and each function that was not inlined), by entry name.

    Neither NOPs nor the branch to itself that ends every section count.
    """
    elf = _Elf(cubin)
    return {
        name.removeprefix(_TEXT): len(_instructions(elf.bytes_of(index), arch))
        for index, name in enumerate(elf.names)
        if name.startswith(_TEXT)
    }


def line_counts(cubin: bytes, arch: str, entry: str) -> dict[SourceLine, int]:
    """Machine instructions of kernel ``entry`` by CUDA source line, the innermost one where functions were inlined.

    Needs line information (``-lineinfo`` of NVRTC and of ptxas): empty without. Instructions before the first line
    that the table names belong to no line.
    """
    elf = _Elf(cubin)
    if ".debug_line" not in elf.names:
        return {}
    text = elf.names.index(_TEXT + entry)
    rows = sorted(elf.line_rows(text), key=lambda row: row[0])
    counts: Counter[SourceLine] = Counter()
    position = -1
    for address in _instructions(elf.bytes_of(text), arch):
        while position + 1 < len(rows) and rows[position + 1][0] <= address:
            position += 1
        if position >= 0:
            counts[rows[position][1]] += 1
    return dict(counts)


def _instructions(code: bytes, arch: str) -> list[int]:
    """Offsets of the instructions of a section, without NOPs and without the last branch."""
    words = struct.unpack(f"<{len(code) // 8}Q", code)
    if _is_maxwell(arch):
        found = [(8 * i, words[i] >> 52) for i in range(len(words)) if i % 4]
        nop, branch = 0x50B, 0xE24  # of the opcode, the twelve highest bits
    else:
        found = [(8 * i, words[i] & 0xFFF) for i in range(0, len(words), 2)]
        nop, branch = 0x918, 0x947  # the twelve lowest bits
    kept = [(offset, opcode) for offset, opcode in found if opcode != nop]
    if kept and kept[-1][1] == branch:
        kept.pop()
    return [offset for offset, _ in kept]


def _is_maxwell(arch: str) -> bool:
    return int(arch.removeprefix("sm_").rstrip("af")) < 70


@dataclass(frozen=True)
class _Unit:
    """Where one line number program lies in .debug_line, and what its header says."""

    start: int
    end: int
    line_base: int
    line_range: int
    opcode_base: int
    operands: bytes  # how many, of each standard opcode
    instruction: int  # shortest, bytes
    files: list[str]


class _Elf:
    """The few things that are asked of a little-endian ELF64 file."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        (offset,) = struct.unpack_from("<Q", data, 40)
        count, names = struct.unpack_from("<HH", data, 60)
        self.sections = [_SECTION.unpack_from(data, offset + i * _SECTION.size) for i in range(count)]
        strings = self.sections[names][4]
        self.names = [_string(data, strings + section[0])[0] for section in self.sections]

    def bytes_of(self, index: int) -> bytes:
        section = self.sections[index]
        return self.data[section[4] : section[4] + section[5]]

    def line_rows(self, text: int) -> Iterator[tuple[int, SourceLine]]:
        """(offset in the section of index ``text``, source line) wherever the line table starts a new row there."""
        table = self.bytes_of(self.names.index(".debug_line"))
        sections = self._relocated(".debug_line")
        position = 0
        while position < len(table):
            unit = _unit(table, position)
            for section, address, file, line in _rows(table, unit, sections):
                if section == text:
                    yield address, SourceLine(unit.files[file - 1], line)
            position = unit.end

    def _relocated(self, name: str) -> dict[int, int]:
        """Offset in section ``name`` -> index of the section that the relocation there points into."""
        symbols = self.bytes_of(self.names.index(".symtab"))
        found = {}
        for prefix, size in ((".rel", 16), (".rela", 24)):
            if prefix + name in self.names:
                entries = self.bytes_of(self.names.index(prefix + name))
                for at in range(0, len(entries), size):
                    offset, info = struct.unpack_from("<QQ", entries, at)
                    (found[offset],) = struct.unpack_from("<H", symbols, 24 * (info >> 32) + 6)
        return found


def _unit(table: bytes, start: int) -> _Unit:
    length, _version, header = struct.unpack_from("<IHI", table, start)
    instruction, _is_statement, line_base, line_range, opcode_base = struct.unpack_from("<BBbBB", table, start + 10)
    at = start + 15 + opcode_base - 1
    operands = table[start + 15 : at]
    folders: list[str] = [""]
    files: list[str] = []
    while table[at]:
        name, at = _string(table, at)
        folders.append(name)
    at += 1
    while table[at]:
        name, at = _string(table, at)
        folder, at = _unsigned(table, at)
        for _ in range(2):  # time and size
            _, at = _unsigned(table, at)
        files.append(f"{folders[folder]}/{name}" if folders[folder] else name)
    return _Unit(
        start + 10 + header, start + 4 + length, line_base, line_range, opcode_base, operands, instruction, files
    )  # fmt: skip


def _rows(table: bytes, unit: _Unit, sections: dict[int, int]) -> Iterator[tuple[int, int, int, int]]:
    """Run the line number program: (section, address, file, line) of each row."""
    at, section, address, file, line = unit.start, 0, 0, 1, 1
    while at < unit.end:
        opcode = table[at]
        at += 1
        if opcode >= unit.opcode_base:
            opcode -= unit.opcode_base
            address += opcode // unit.line_range * unit.instruction
            line += unit.line_base + opcode % unit.line_range
            yield section, address, file, line
        elif opcode == 0:
            size, at = _unsigned(table, at)
            if table[at] == _SET_ADDRESS:
                section, (address,) = sections.get(at + 1, 0), struct.unpack_from("<Q", table, at + 1)
            elif table[at] == _END_SEQUENCE:
                section, address, file, line = 0, 0, 1, 1
            at += size  # NVIDIA's own codes, for the callers of inlined functions, are passed over
        elif opcode == _COPY:
            yield section, address, file, line
        elif opcode == _ADVANCE_PC:
            value, at = _unsigned(table, at)
            address += value * unit.instruction
        elif opcode == _ADVANCE_LINE:
            value, at = _signed(table, at)
            line += value
        elif opcode == _SET_FILE:
            file, at = _unsigned(table, at)
        elif opcode == _CONST_ADD_PC:
            address += (255 - unit.opcode_base) // unit.line_range * unit.instruction
        elif opcode == _FIXED_ADVANCE_PC:
            address += struct.unpack_from("<H", table, at)[0]
            at += 2
        else:
            for _ in range(unit.operands[opcode - 1]):
                _, at = _unsigned(table, at)


def _string(data: bytes, at: int) -> tuple[str, int]:
    end = data.index(b"\0", at)
    return data[at:end].decode(), end + 1


def _unsigned(data: bytes, at: int) -> tuple[int, int]:
    """LEB128."""
    value = shift = 0
    while True:
        byte = data[at]
        value |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return value, at


def _signed(data: bytes, at: int) -> tuple[int, int]:
    start = at
    value, at = _unsigned(data, at)
    return (value - (1 << 7 * (at - start)) if data[at - 1] & 0x40 else value), at
