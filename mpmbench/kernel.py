"""Kernel sources: a ``.cu`` file and its constants become one self-contained text.

Headers are inlined, because a compile cache that hashes only the text it was handed would run an old binary after a
header changed. ``#line`` marks keep messages and counters on the file and line a person edits. Compile-time choices
are one generated block of ``#define`` lines in front.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from mpmbench.errors import InputError

RAW_KERNELS = Path(__file__).parent / "raw_kernels"

# One list for every device. CuPy always flushes denormals, so all kernels do. Fast math and contraction are NVRTC's
# defaults here: a source that wants them otherwise has options of its own.
COMPILE_OPTIONS: tuple[str, ...] = ("-std=c++17", "-ftz=true", "-lineinfo", "-default-device")

_INCLUDE = re.compile(r'^\s*#\s*include\s+"([^"]+)"')
_PRAGMA_ONCE = re.compile(r"^\s*#\s*pragma\s+once\b")


@dataclass(frozen=True)
class KernelSource:
    """One self-contained CUDA C++ text.

    name: stem of the file.  text: what the compiler is given.  constants: the generated ``#define`` block as pairs.
    sha256: hex digest of the text, and of the options if there are any; records carry it.
    options: of NVRTC, beside those that all kernels have.
    """

    name: str
    text: str = field(repr=False)
    constants: tuple[tuple[str, str], ...]
    sha256: str
    options: tuple[str, ...] = ()

    @property
    def all_options(self) -> tuple[str, ...]:
        """What NVRTC is told, the architecture aside."""
        return (*COMPILE_OPTIONS, *self.options)


def compile_options(arch: str) -> tuple[str, ...]:
    """NVRTC's options for a target such as ``sm_52``, of a source that has none of its own."""
    return (f"--gpu-architecture={arch.replace('sm_', 'compute_')}", *COMPILE_OPTIONS)


def load_source(
    stem_or_path: str | Path,
    constants: Mapping[str, object],
    include_dirs: Sequence[Path] = (),
    options: tuple[str, ...] = (),
) -> KernelSource:
    """Read a kernel and inline its headers.

    stem_or_path: ``"p2g_block_sync"`` for a shipped kernel, or the path of any ``.cu`` file.
    constants: macro name -> value (bool becomes 0 or 1). include_dirs are searched after the including file's own
    folder and before the shipped headers. options: of NVRTC, for this source. Raises InputError for a missing file.
    """
    path = Path(stem_or_path)
    if path.suffix != ".cu":
        path = RAW_KERNELS / f"{stem_or_path}.cu"
    defines = tuple((name, _macro_value(value)) for name, value in constants.items())
    lines = [f"#define {name} {value}" for name, value in defines]
    _inline(path, (*include_dirs, RAW_KERNELS), lines, seen=set(), asked_by=None)
    text = "\n".join(lines) + "\n"
    # Without options a hash is that of the text alone: results of before there were any keep theirs.
    digest = hashlib.sha256("\0".join((text, *options)).encode()).hexdigest()
    return KernelSource(path.stem, text, defines, digest, options)


def parameter_names(text: str, entry: str) -> tuple[str, ...]:
    """What a kernel's text calls its parameters, in order; empty where its head is not found."""
    plain = re.sub(r"//[^\n]*|/\*.*?\*/", " ", text, flags=re.S)
    for head in re.finditer(rf"\b{re.escape(entry)}\s*\(", plain):
        depth, start, parts = 1, head.end(), []
        for at in range(head.end(), len(plain)):
            letter = plain[at]
            depth += (letter in "(<[") - (letter in ")>]")
            if (letter == "," and depth == 1) or depth == 0:
                parts.append(plain[start:at])
                start = at + 1
            if depth == 0:
                break
        if "__global__" in plain[: head.start()].rpartition(";")[2]:
            names = [re.findall(r"\w+", part.partition("[")[0]) for part in parts]
            return tuple(words[-1] if words else "" for words in names)
    return ()


def _macro_value(value: object) -> str:
    return str(int(value)) if isinstance(value, bool) else str(value)


def _inline(path: Path, folders: Sequence[Path], lines: list[str], seen: set[Path], asked_by: str | None) -> None:
    """Append the text of a file to lines, each header at its first mention only."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        where = f" (included by {asked_by})" if asked_by else ""
        raise InputError(f"cannot read kernel source {path}{where}: {error}") from error
    seen.add(path.resolve())
    # The bare name, not the path: the text and its hash must not depend on where the package is installed.
    lines.append(f'#line 1 "{path.name}"')
    for number, line in enumerate(text.splitlines(), start=1):
        include = _INCLUDE.match(line)
        if include is None:
            lines.append("" if _PRAGMA_ONCE.match(line) else line)
            continue
        header = _find(include[1], (path.parent, *folders), f"{path.name}:{number}")
        if header.resolve() not in seen:
            _inline(header, folders, lines, seen, f"{path.name}:{number}")
        lines.append(f'#line {number + 1} "{path.name}"')


def _find(name: str, folders: Sequence[Path], asked_by: str) -> Path:
    for folder in folders:
        if (folder / name).is_file():
            return folder / name
    searched = ", ".join(str(folder) for folder in dict.fromkeys(folders))
    raise InputError(f'{asked_by}: #include "{name}" not found; looked in {searched}')
