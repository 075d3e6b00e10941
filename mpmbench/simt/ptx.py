"""PTX text -> instructions with typed operands. Structure only: what an opcode *does* is the executors' business.

Every ``.func`` is inlined into the kernels that call it (its registers, labels and local arrays renamed per call), so
an executor sees one flat list of instructions per kernel, with no calls, no returns but the kernel's own, and the
parameters of functions turned into plain moves. Recursion is refused.

Format: PTX ISA 8.8, as NVRTC 12.9 prints it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

from mpmbench.errors import InputError
from mpmbench.simt.counters import SourceLine

# --- operands ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Reg:
    """A virtual register. ``type`` is the declared one: pred, b16, b32, b64, f32, f64 (u/s forms become b)."""

    name: str
    type: str


@dataclass(frozen=True, slots=True)
class Imm:
    """A literal. ``float_bits`` is 32 or 64 where ``value`` is the bit pattern of a float literal, else 0."""

    value: int
    float_bits: int = 0


@dataclass(frozen=True, slots=True)
class Special:
    """A read-only special register such as ``%tid.x`` or ``%laneid``."""

    name: str


@dataclass(frozen=True, slots=True)
class Symbol:
    """The address of a variable plus a constant. space: shared, local, global, const or param.

    ``offset`` counts from the start of the kernel's frame in that space (shared, local, param) or from the start of
    the module variable ``name`` (global, const).
    """

    name: str
    space: str
    offset: int = 0


@dataclass(frozen=True, slots=True)
class Address:
    """``[base + offset]``; base is a register, a symbol or a literal."""

    base: Reg | Symbol | Imm
    offset: int = 0


@dataclass(frozen=True, slots=True)
class Vector:
    """``{a, b, ...}`` of v2/v4 accesses and of packing moves. An element None is the discarded ``_``."""

    items: tuple[Reg | Imm | None, ...]


@dataclass(frozen=True, slots=True)
class NotReg:
    """A predicate operand read inverted: ``!%p``."""

    reg: Reg


Operand = Reg | Imm | Special | Symbol | Address | Vector | NotReg

CARRY = Reg("%carry", "pred")


@dataclass(frozen=True, slots=True)
class Instruction:
    """One PTX instruction.

    opcode: the text as printed, ``ld.global.v4.f32``; ``root`` and ``modifiers`` are its parts.
    dsts: what it writes: registers (None for ``_``) in order; ``setp p|q`` and ``shfl d|p`` have two, a vector load
    has one per element. srcs: the other operands in order. The carry flag of ``add.cc``, ``addc`` and the like is an
    ordinary predicate register, CARRY: last of dsts where it is written, last of srcs where it is read.
    guard/negated: ``@p`` / ``@!p``.  targets: labels of branches.
    """

    opcode: str
    dsts: tuple[Reg | None, ...] = ()
    srcs: tuple[Operand, ...] = ()
    guard: Reg | None = None
    negated: bool = False
    targets: tuple[str, ...] = ()
    line: SourceLine | None = None

    @property
    def root(self) -> str:
        return self.opcode.partition(".")[0]

    @property
    def modifiers(self) -> tuple[str, ...]:
        return tuple(self.opcode.split(".")[1:])

    @property
    def literal(self) -> int | None:
        """The last integer literal among the operands."""
        found = [operand.value for operand in self.srcs if isinstance(operand, Imm) and not operand.float_bits]
        return found[-1] if found else None

    def reads(self) -> Iterator[Reg]:
        """Registers read, guard included. A guarded write keeps the old value of dead lanes: see flow.py."""
        if self.guard is not None:
            yield self.guard
        for operand in self.srcs:
            yield from _registers(operand)

    def writes(self) -> Iterator[Reg]:
        return (reg for reg in self.dsts if reg is not None)

    def where(self) -> str:
        return f"{self.line.file}:{self.line.line}" if self.line else "unknown line"


def _registers(operand: Operand) -> Iterator[Reg]:
    match operand:
        case Reg():
            yield operand
        case NotReg(reg):
            yield reg
        case Address(Reg() as base, _):
            yield base
        case Vector(items):
            yield from (item for item in items if isinstance(item, Reg))


# --- kernels and modules ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Parameter:
    """A kernel parameter at ``offset`` bytes into the parameter block."""

    name: str
    offset: int
    size: int


@dataclass(frozen=True, slots=True)
class Variable:
    """A module-scope ``.global`` or ``.const`` variable; ``initial`` is its bytes, zero-filled where not given."""

    name: str
    space: str
    size: int
    align: int
    initial: bytes


@dataclass
class Kernel:
    """A kernel with everything inlined. ``labels`` maps a label to the index of the instruction it stands before."""

    name: str
    params: tuple[Parameter, ...] = ()
    param_bytes: int = 0
    shared_bytes: int = 0  # static; dynamic shared memory starts here, aligned to 16
    local_bytes: int = 0  # per thread
    instructions: list[Instruction] = field(default_factory=list)
    labels: dict[str, int] = field(default_factory=dict)


@dataclass
class Module:
    kernels: dict[str, Kernel]
    variables: dict[str, Variable]
    target: str  # "sm_52"


def parse(ptx: str) -> Module:
    """Parse a PTX module. Raises InputError with the offending text for anything it does not understand."""
    return _Parser(ptx).module()


# --- statements -------------------------------------------------------------------------------------------------------

_LOC = re.compile(r"\.loc\s+(\d+)\s+(\d+)\s+\d+")
_FILE = re.compile(r'\.file\s+(\d+)\s+"([^"]*)"')
_COMMENT = re.compile(r"//[^\n]*|/\*.*?\*/", re.S)


_ONE_LINE = (".loc ", ".loc\t", ".file", ".version", ".target", ".address_size", ".section")


def _statements(text: str) -> Iterator[str]:
    """Split into statements: ``...;``, ``{``, ``}``, ``label:`` and one-line ``.loc``/``.file`` directives."""
    pending = ""
    in_initialiser = False
    for raw in text.split("\n"):
        line = raw.strip()
        if not line:
            continue
        if not pending and line.startswith(_ONE_LINE):
            yield line.replace("\t", " ")
            continue
        while line:
            if pending == "" and (label := re.match(r"([\w$]+):(?!:)\s*", line)):
                yield label.group(0).strip()
                line = line[label.end() :]
                continue
            cut = re.search(r"[;{}]", line)
            if cut is None:
                pending = f"{pending} {line}".strip()
                break
            head, mark, line = line[: cut.start()], cut.group(), line[cut.end() :].lstrip()
            pending = f"{pending} {head}".strip()
            # Braces belong to the statement in `ld {a, b}` and in `x[2] = {1, 2}`; else they open or close a scope.
            opens_scope = not pending or re.match(r"\.(visible|weak|entry|func|extern|section)", pending)
            if mark == "{" and ("=" in pending or not opens_scope):
                in_initialiser, pending = True, pending + " {"
            elif mark == "}" and in_initialiser:
                in_initialiser, pending = False, pending + "}"
            elif mark == ";":
                yield pending + ";"
                pending = ""
            else:
                if pending:
                    yield pending
                yield mark
                pending = ""
    if pending:
        yield pending


def _split_commas(text: str) -> list[str]:
    parts, depth, start = [], 0, 0
    for position, char in enumerate(text):
        if char in "{[(":
            depth += 1
        elif char in "}])":
            depth -= 1
        elif char == "," and depth == 0:
            parts.append(text[start:position].strip())
            start = position + 1
    tail = text[start:].strip()
    return [*parts, tail] if tail else parts


_BYTES = {"b8": 1, "u8": 1, "s8": 1, "b16": 2, "u16": 2, "s16": 2, "f16": 2, "pred": 1}
_BYTES |= {f"{kind}{bits}": bits // 8 for kind in "busf" for bits in (32, 64)}
_REG_TYPE = {"u16": "b16", "s16": "b16", "u32": "b32", "s32": "b32", "u64": "b64", "s64": "b64"}

_DECLARATION = re.compile(
    r"(?:\.(?:visible|weak|extern|common)\s+)*\.(global|const|shared|local|param)\s+(?:\.align\s+(\d+)\s+)?"
    r"(?:\.ptr\s*(?:\.\w+\s+)*(?:\.align\s+\d+\s+)?)?\.(\w+)\s+(?:\.ptr\s*(?:\.(?:global|shared|const)\s+)?(?:\.align\s+\d+\s+)?)?"
    r"([\w$%]+)\s*((?:\[\d*\])*)\s*(?:=\s*(.*))?$",
    re.S,
)
_HEADER = re.compile(
    r"(?:\.(?:visible|weak|extern)\s+)*\.(entry|func)\s+(?:\((?P<ret>.*?)\)\s*)?(?P<name>[\w$]+)\s*(?:\((?P<params>.*?)\))?"
    r"\s*(?P<rest>(?:\.\w+.*)?)$",
    re.S,
)
_NO_DESTINATION = frozenset({"st", "red", "bra", "brx", "ret", "exit", "trap", "bar", "barrier", "membar", "fence"})
_NO_DESTINATION |= {"call", "nanosleep", "prefetch", "prefetchu", "griddepcontrol", "brkpt", "pmevent"}


@dataclass
class _Function:
    """A parsed ``.entry`` or ``.func`` body, before inlining."""

    name: str
    is_kernel: bool
    returns: list[str]
    params: list[Parameter]
    param_bytes: int
    body: list[Instruction | str] = field(default_factory=list)  # a string is a label
    symbols: dict[str, Symbol] = field(default_factory=dict)
    shared_bytes: int = 0
    local_bytes: int = 0
    branch_tables: dict[str, tuple[str, ...]] = field(default_factory=dict)


def _align(offset: int, to: int) -> int:
    return -(-offset // to) * to


class _Parser:
    def __init__(self, ptx: str) -> None:
        self.statements = _statements(_COMMENT.sub("", ptx))
        self.files = {int(number): name for number, name in _FILE.findall(ptx)}
        self.variables: dict[str, Variable] = {}
        self.extern_shared: set[str] = set()
        self.module_shared: dict[str, tuple[int, int]] = {}
        self.functions: dict[str, _Function] = {}
        self.target = "sm_52"

    def module(self) -> Module:
        for statement in self.statements:
            if statement.startswith(".target"):
                self.target = statement.split()[1].rstrip(",")
            elif statement.startswith((".version", ".address_size", ".file", ".loc ")):
                continue
            elif statement.startswith(".section"):
                self._skip_scope()
            elif statement.startswith(
                (".entry", ".func", ".visible .entry", ".visible .func", ".weak", ".extern .func")
            ):
                self._function(statement)
            elif statement in {";", "{", "}"}:
                continue
            else:
                self._module_variable(statement)
        kernels = {f.name: _inline(f, self) for f in self.functions.values() if f.is_kernel}
        return Module(kernels, self.variables, self.target)

    def _skip_scope(self) -> None:
        depth = 0
        for statement in self.statements:
            depth += (statement == "{") - (statement == "}")
            if statement == "}" and depth == 0:
                return

    def _module_variable(self, statement: str) -> None:
        space, align, size, name, initial, is_open = _declaration(statement)
        if space == "shared":
            if is_open:
                self.extern_shared.add(name)
            else:
                self.module_shared[name] = (align, size)
        else:
            self.variables[name] = Variable(name, space, size, align, initial.ljust(size, b"\0"))

    def _function(self, header: str) -> None:
        found = _HEADER.match(header.rstrip(";").strip())
        if not found:
            raise InputError(f"PTX: cannot read function header {header!r}")
        if header.endswith(";"):
            return  # a forward declaration
        name = found["name"]
        params: list[Parameter] = []
        offset = 0
        function = _Function(name, found[1] == "entry", [], params, 0)
        for text in _split_commas(found["params"] or ""):
            _, align, size, param, _, _ = _declaration(text)
            offset = _align(offset, align)
            params.append(Parameter(param, offset, size))
            function.symbols[param] = Symbol(param, "param", offset)
            offset += size
        function.param_bytes = offset
        for text in _split_commas(found["ret"] or ""):
            _, _, _, ret, _, _ = _declaration(text)
            function.returns.append(ret)
            function.symbols[ret] = Symbol(ret, "param")
        for statement in self.statements:
            if statement == "{":
                break
            if statement == ";":
                return  # a forward declaration whose semicolon stands on a line of its own
        self.functions[name] = function
        self._body(function)

    def _body(self, function: _Function) -> None:
        depth, scopes_seen, line = 1, 0, None
        scopes: list[dict[str, Reg]] = [{}]
        families: dict[str, str] = {}  # "%f" -> "f32", from `.reg .f32 %f<9>`
        table_label: str | None = None

        def register(name: str) -> Reg:
            for scope in reversed(scopes):
                if name in scope:
                    return scope[name]
            family = re.match(r"%[A-Za-z_$]+", name)
            if family and family.group() in families:
                return scopes[0].setdefault(name, Reg(name, families[family.group()]))
            where = f"{line.file}:{line.line}" if line else function.name
            raise InputError(f"PTX: register {name} at {where} is not declared, and no special one that is supported")

        for statement in self.statements:
            if statement == "{":
                depth, scopes_seen = depth + 1, scopes_seen + 1
                scopes.append({})
            elif statement == "}":
                depth -= 1
                scopes.pop()
                if depth == 0:
                    return
            elif statement.startswith(".loc "):
                found = _LOC.match(statement)
                if found and int(found[2]) > 0:  # line 0 is compiler-made code: it stays with the line before
                    line = SourceLine(self.files.get(int(found[1]), "?"), int(found[2]))
            elif statement.endswith(":"):
                table_label = statement[:-1]
                function.body.append(table_label)
            elif statement.startswith(".branchtargets"):
                assert table_label is not None
                function.branch_tables[table_label] = tuple(_split_commas(statement[14:].rstrip(";")))
            elif statement.startswith(".reg"):
                _, kind, names = statement.rstrip(";").split(None, 2)
                kind = _REG_TYPE.get(kind[1:], kind[1:])
                for name in _split_commas(names):
                    if "<" in name:
                        families[name.partition("<")[0]] = kind
                    else:
                        unique = name if depth == 1 else f"{name}.{scopes_seen}"
                        scopes[-1][name] = Reg(unique, kind)
            elif statement.startswith((".shared", ".local", ".param")):
                self._local_declaration(function, statement)
            elif statement.startswith((".pragma", ".callprototype", ".maxntid", ".minnctapersm", ".reqntid")):
                continue
            elif statement != ";":
                function.body.append(self._instruction(function, statement.rstrip(";").strip(), register, line))

    def _local_declaration(self, function: _Function, statement: str) -> None:
        space, align, size, name, _, _ = _declaration(statement.rstrip(";"))
        if space == "shared":
            offset = _align(function.shared_bytes, align)
            function.shared_bytes = offset + size
            function.symbols[name] = Symbol(name, "shared", offset)
        elif space == "local":
            offset = _align(function.local_bytes, max(align, 16))
            function.local_bytes = offset + size
            function.symbols[name] = Symbol(name, "local", offset)
        else:  # the argument variables of a call
            function.symbols[name] = Symbol(name, "param")

    def _symbol(self, function: _Function, name: str) -> Symbol:
        if name in function.symbols:
            return function.symbols[name]
        if name in self.variables:
            return Symbol(name, self.variables[name].space)
        # Where these lie is known only when a kernel and all it calls are together: see _place_shared.
        if name in self.module_shared:
            return Symbol(name, MODULE_SHARED)
        if name in self.extern_shared:
            return Symbol(name, DYNAMIC_SHARED)
        if name in self.functions:
            raise InputError(f"PTX: the address of function {name} is taken in {function.name}; that is not supported")
        raise InputError(f"PTX: unknown symbol {name} in {function.name}")

    def _instruction(self, function, text, register, line) -> Instruction:
        guard, negated = None, False
        if text.startswith("@"):
            guard_text, text = text[1:].split(None, 1)
            negated = guard_text.startswith("!")
            guard = register(guard_text.lstrip("!"))
        opcode, _, rest = text.partition(" ") if "\t" not in text else text.replace("\t", " ").partition(" ")
        opcode, rest = opcode.strip(), rest.strip()
        root = opcode.partition(".")[0]
        parts = _split_commas(rest)
        if root in {"bra", "brx"}:
            targets = tuple(parts[-1:]) if root == "bra" else (parts[1],)
            index = (register(parts[0]),) if root == "brx" else ()
            return Instruction(opcode, (), index, guard, negated, targets, line)
        if root == "call":
            return self._call(opcode, parts, guard, negated, line)

        def operand(part: str) -> Operand:
            if part.startswith("["):
                return self._address(function, part[1:-1], register)
            if part.startswith("{"):
                items = (None if p == "_" else operand(p) for p in _split_commas(part[1:-1]))
                return Vector(tuple(items))  # type: ignore[arg-type]
            if part.startswith("!%"):
                return NotReg(register(part[1:]))
            if part.startswith("%"):
                known = part in _SPECIAL or part.partition(".")[0] in _SPECIAL
                return Special(part) if known else register(part)
            if re.match(r"0[fFdD][0-9a-fA-F]+$", part):
                return Imm(int(part[2:], 16), 32 if part[1] in "fF" else 64)
            if re.match(r"-?(0[xX][0-9a-fA-F]+|\d+)U?$", part):
                return Imm(int(part.rstrip("U"), 0))
            if part in {"WARP_SZ"}:
                return Imm(32)
            symbol, _, offset = part.partition("+")
            found = self._symbol(function, symbol)
            return replace(found, offset=found.offset + int(offset)) if offset else found

        dsts: tuple[Reg | None, ...] = ()
        modifiers = opcode.split(".")[1:]
        if (root not in _NO_DESTINATION or (root in {"bar", "barrier"} and "red" in modifiers)) and parts:
            head, parts = parts[0], parts[1:]
            names = _split_commas(head[1:-1]) if head.startswith("{") else head.split("|")
            dsts = tuple(None if name == "_" else register(name) for name in names)
        srcs: tuple[Operand, ...] = tuple(map(operand, parts))
        if root in {"addc", "subc", "madc"}:
            srcs = (*srcs, CARRY)
        if "cc" in modifiers:
            dsts = (*dsts, CARRY)
        return Instruction(opcode, dsts, srcs, guard, negated, (), line)

    def _address(self, function: _Function, text: str, register) -> Address:
        base, offset = text.strip(), 0
        if found := re.match(r"(.+?)\s*\+\s*(-?\d+)$", base):
            base, offset = found[1], int(found[2])
        if base.startswith("%"):
            return Address(register(base), offset)
        if re.match(r"-?\d", base):
            return Address(Imm(int(base, 0)), offset)
        return Address(self._symbol(function, base), offset)

    def _call(self, opcode, parts, guard, negated, line) -> Instruction:
        """``call (ret), name, (args)`` -> targets (name,), srcs: symbols of ret, then args; len(dsts): of ret."""
        returns = _split_commas(parts.pop(0)[1:-1]) if parts[0].startswith("(") else []
        name = parts[0]
        args = _split_commas(parts[1][1:-1]) if len(parts) > 1 else []
        if name.startswith("%"):
            raise InputError(f"PTX: indirect calls are not supported ({opcode} {name} at {line})")
        names = tuple(Symbol(n, "param") for n in (*returns, *args))
        return Instruction(opcode, (None,) * len(returns), names, guard, negated, (name,), line)


_SPECIAL = frozenset(
    {"%tid", "%ntid", "%ctaid", "%nctaid", "%laneid", "%warpid", "%nwarpid", "%smid", "%nsmid", "%gridid"}
)
_SPECIAL |= {f"%lanemask_{kind}" for kind in ("eq", "le", "lt", "ge", "gt")}
_SPECIAL |= {"%clock", "%clock64", "%clock_hi", "%globaltimer", "%globaltimer_lo", "%globaltimer_hi"}
_SPECIAL |= {"%dynamic_smem_size", "%total_smem_size"}


def _declaration(text: str) -> tuple[str, int, int, str, bytes, bool]:
    """-> space, alignment, bytes, name, initial bytes, whether the size was left open (``x[]``)."""
    found = _DECLARATION.match(text.rstrip(";").strip())
    if not found:
        raise InputError(f"PTX: cannot read declaration {text!r}")
    space, align, kind, name, dims, initial = found.groups()
    if kind not in _BYTES:
        raise InputError(f"PTX: type .{kind} of {name} is not supported")
    element = _BYTES[kind]
    count, is_open = 1, False
    for dim in re.findall(r"\[(\d*)\]", dims):
        is_open |= dim == ""
        count *= int(dim or 0)
    data = b""
    for value in _split_commas((initial or "").strip(" {}")):
        if value.startswith(("0f", "0F", "0d", "0D")):
            number = int(value[2:], 16)
        elif re.match(r"-?(0x)?[0-9a-fA-F]+$", value):
            number = int(value, 0)
        else:
            raise InputError(f"PTX: initial value {value!r} of {name} is not supported (addresses are not)")
        data += (number & ((1 << 8 * element) - 1)).to_bytes(element, "little")
    return space, int(align or element), element * count, name, data, is_open


# --- inlining ---------------------------------------------------------------------------------------------------------


# Spaces of shared variables until they have a place: those of the module, and dynamic shared memory.
MODULE_SHARED, DYNAMIC_SHARED = "module-shared", "dynamic-shared"


def _inline(kernel: _Function, parser: _Parser) -> Kernel:
    return _Inliner(kernel, parser.functions, parser.module_shared).kernel()


class _Inliner:
    """Flattens a call tree. Each call gets a number; names of the callee carry it, so nothing is shared by accident."""

    def __init__(
        self, root: _Function, functions: dict[str, _Function], module_shared: dict[str, tuple[int, int]]
    ) -> None:
        self.root, self.functions, self.module_shared = root, functions, module_shared
        self.out: list[Instruction] = []
        self.labels: dict[str, int] = {}
        self.calls = 0
        self.argument_bits: dict[str, int] = {}  # width of what was last stored to an argument's pseudo-register
        self.call_line: SourceLine | None = None  # stands in for the lines of library functions, which have none
        self.shared_bytes, self.local_bytes = root.shared_bytes, root.local_bytes
        self.shared_of: dict[str, int] = {root.name: 0}  # a function's own static shared variables exist once

    def kernel(self) -> Kernel:
        self._emit(self.root, "", {}, None, (self.root.name,))
        self._check_arguments()
        root = self.root
        instructions, dynamic = self._place_shared()
        return Kernel(
            root.name,
            tuple(root.params),
            root.param_bytes,
            dynamic,
            _align(self.local_bytes, 16),
            instructions,
            self.labels,
        )

    def _place_shared(self) -> tuple[list[Instruction], int]:
        """Give module variables in shared memory one place each, whoever uses them, and dynamic memory the rest.

        -> the instructions and where dynamic shared memory starts.
        """
        places: dict[str, int] = {}
        for item in self.out:
            for operand in item.srcs:
                symbol = operand.base if isinstance(operand, Address) else operand
                if isinstance(symbol, Symbol) and symbol.space == MODULE_SHARED and symbol.name not in places:
                    align, size = self.module_shared[symbol.name]
                    places[symbol.name] = _align(self.shared_bytes, align)
                    self.shared_bytes = places[symbol.name] + size
        dynamic = _align(self.shared_bytes, 16)

        def place(operand: Operand) -> Operand:
            match operand:
                case Symbol(name, space, offset) if space in (MODULE_SHARED, DYNAMIC_SHARED):
                    return Symbol(name, "shared", offset + (places[name] if space == MODULE_SHARED else dynamic))
                case Address(Symbol() as base, offset):
                    placed = place(base)
                    assert isinstance(placed, Symbol)
                    return Address(placed, offset)
            return operand

        return [replace(item, srcs=tuple(map(place, item.srcs))) for item in self.out], dynamic

    def _check_arguments(self) -> None:
        """An argument must be read with the width it was written with: the pseudo-registers are not memory."""
        written = {reg for item in self.out for reg in item.writes()}
        for item in self.out:
            for reg in item.reads():
                if "+" in reg.name and reg not in written:
                    raise InputError(f"PTX: {item.where()} reads part of a function argument; that is not supported")

    def _emit(
        self, function: _Function, tag: str, params: dict[str, str], after: str | None, chain: tuple[str, ...]
    ) -> None:
        """Append ``function``. tag: suffix of its names; params: its parameter -> the caller's argument variable;
        after: label that its returns branch to (None in the kernel itself)."""
        shared_base = self.shared_of.get(function.name)
        if shared_base is None:
            shared_base = self.shared_of[function.name] = _align(self.shared_bytes, 16)
            self.shared_bytes = shared_base + function.shared_bytes
        local_base = 0
        if function is not self.root:
            local_base = _align(self.local_bytes, 16)
            self.local_bytes = local_base + function.local_bytes
        bases = {"shared": shared_base, "local": local_base}

        def rename(operand):
            match operand:
                case Reg(name, kind):
                    return Reg(name + tag, kind) if tag else operand
                case NotReg(reg):
                    return NotReg(rename(reg))
                case Symbol(name, space, offset) if space in bases:
                    return Symbol(name, space, offset + bases[space])
                case Address(base, offset):
                    return Address(rename(base), offset)
                case Vector(items):
                    return Vector(tuple(rename(i) if i is not None else None for i in items))
            return operand

        for item in function.body:
            if isinstance(item, str):
                self.labels[item + tag] = len(self.out)
                continue
            item = item if item.line is not None or not chain[1:] else replace(item, line=self.call_line)
            guard = rename(item.guard) if item.guard is not None else None
            line = item.line
            if item.root == "call":
                self._call(item, guard, tag, line, chain, params)
            elif item.root == "ret" and after is not None:
                self.out.append(Instruction("bra.uni", (), (), guard, item.negated, (after,), line))
            elif item.root in {"ld", "st"} and "param" in item.modifiers and self._is_argument(item, function):
                self._argument_move(item, rename, tag, params, guard)
            else:
                targets = item.targets
                if item.root == "brx":
                    targets = function.branch_tables[targets[0]]
                self.out.append(
                    replace(
                        item,
                        dsts=tuple(rename(d) if d is not None else None for d in item.dsts),
                        srcs=tuple(map(rename, item.srcs)),
                        guard=guard,
                        targets=tuple(t + tag for t in targets),
                    )
                )

    def _is_argument(self, item: Instruction, function: _Function) -> bool:
        address = next(s for s in item.srcs if isinstance(s, Address))
        if not isinstance(address.base, Symbol):
            return False
        is_kernel_parameter = function is self.root and any(p.name == address.base.name for p in function.params)
        return not is_kernel_parameter

    def _argument_move(self, item: Instruction, rename, tag: str, params: dict[str, str], guard: Reg | None) -> None:
        """``st.param [arg+8], %r`` / ``ld.param %r, [arg+8]`` -> moves to and from the pseudo-register ``arg+8``.

        It is as wide as what was last stored; a narrower read (a bool passed as 32 bits) takes its low bits.
        """
        address = next(s for s in item.srcs if isinstance(s, Address))
        assert isinstance(address.base, Symbol)
        kind = item.modifiers[-1]
        width = _BYTES[kind]
        variable = params.get(address.base.name, address.base.name + tag)
        bits = max(8 * width, 16)
        values: tuple[Operand | None, ...] = item.dsts if item.root == "ld" else item.srcs[1:]
        if len(values) == 1 and isinstance(values[0], Vector):
            values = values[0].items
        for position, value in enumerate(values):
            name = f"{variable}+{address.offset + position * width}"
            if value is None:
                continue
            if item.root == "st":
                self.argument_bits[name] = bits
                opcode, dst, src = f"mov.b{bits}", Reg(name, f"b{bits}"), rename(value)
            else:
                have = self.argument_bits.get(name, bits)
                opcode, dst, src = f"mov.b{bits}", rename(value), Reg(name, f"b{have}")
                if 8 * width < have:
                    sign = "s" if kind[0] == "s" else "u"
                    opcode = f"cvt.{sign}{_BYTES[dst.type] * 8}.{sign}{8 * width}"
            self.out.append(Instruction(opcode, (dst,), (src,), guard, item.negated, (), item.line))

    def _call(self, item, guard, tag, line, chain, params) -> None:
        name = item.targets[0]
        callee = self.functions.get(name)
        if callee is None:
            raise InputError(f"PTX: call of {name!r} at {item.where()}, which has no body (such as printf)")
        if name in chain:
            raise InputError(f"PTX: recursive call of {name!r} at {item.where()} is not supported")
        self.calls += 1
        inner = f"@{self.calls}"
        after = f"$after{inner}"
        count = len(item.dsts)
        passed = [params.get(s.name, s.name + tag) for s in item.srcs]
        bound = dict(zip(callee.returns, passed[:count], strict=True))
        bound |= dict(zip((p.name for p in callee.params), passed[count:], strict=True))
        self.out.append(Instruction("call", (), (), guard, item.negated, (), line))  # counted, does nothing
        if guard is not None:
            self.out.append(Instruction("bra", (), (), guard, not item.negated, (after,), line))
        self.call_line = line
        self._emit(callee, inner, bound, after, (*chain, name))
        self.labels[after] = len(self.out)
