"""One self-contained text per kernel: headers inlined once, lines named, everything in the hash."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest

from mpmbench.errors import InputError
from mpmbench.kernel import COMPILE_OPTIONS, compile_options, load_source
from mpmbench.simt.nvrtc import compile_cuda
from mpmbench.workspace import NEUTRAL


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "a.cu").write_text('#include "b.cuh"\n#include "c.cuh"\nA\n')
    (tmp_path / "b.cuh").write_text('#pragma once\n#include "c.cuh"\nB\n')
    (tmp_path / "c.cuh").write_text("#pragma once\nC\n")
    return tmp_path


def test_headers_are_inlined_once_with_their_lines(folder: Path) -> None:
    source = load_source(folder / "a.cu", {"N": 3, "FLAG": True, "REAL": "float"})
    assert source.name == "a"
    assert source.constants == (("N", "3"), ("FLAG", "1"), ("REAL", "float"))
    assert source.text.splitlines() == [
        "#define N 3", "#define FLAG 1", "#define REAL float",
        '#line 1 "a.cu"',
        '#line 1 "b.cuh"', "",
        '#line 1 "c.cuh"', "", "C",
        '#line 3 "b.cuh"', "B",
        '#line 2 "a.cu"',
        '#line 3 "a.cu"', "A",
    ]  # fmt: skip


def test_hash_covers_constants_and_headers_but_not_the_place(folder: Path, tmp_path_factory) -> None:
    first = load_source(folder / "a.cu", {"N": 3}).sha256
    assert load_source(folder / "a.cu", {"N": 4}).sha256 != first
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    for path in folder.iterdir():
        (elsewhere / path.name).write_text(path.read_text())
    assert load_source(elsewhere / "a.cu", {"N": 3}).sha256 == first
    (folder / "c.cuh").write_text("CHANGED\n")
    assert load_source(folder / "a.cu", {"N": 3}).sha256 != first


def test_hash_covers_options_and_is_that_of_the_text_without_any(folder: Path) -> None:
    plain = load_source(folder / "a.cu", {"N": 3})
    assert plain.sha256 == hashlib.sha256(plain.text.encode()).hexdigest()
    sources = [plain, *(load_source(folder / "a.cu", {"N": 3}, options=o) for o in (("-x",), ("-y",), ("-x", "-y")))]
    assert len({source.sha256 for source in sources}) == 4
    assert {source.text for source in sources} == {plain.text}
    assert sources[3].all_options == (*COMPILE_OPTIONS, "-x", "-y")


def test_a_users_kernel_finds_its_own_and_the_shipped_headers(tmp_path: Path) -> None:
    (tmp_path / "own.cuh").write_text("// own\n")
    (tmp_path / "k.cu").write_text('#include "own.cuh"\n#include "real.cuh"\n')
    text = load_source(tmp_path / "k.cu", {}).text
    assert "// own" in text
    assert "using real = REAL" in text


def test_what_is_missing_is_named_with_its_line(folder: Path) -> None:
    with pytest.raises(InputError, match=r"cannot read kernel source .*nothing\.cu"):
        load_source("nothing", {})
    (folder / "b.cuh").write_text('\n#include "gone.cuh"\n')
    with pytest.raises(InputError, match=r'b\.cuh:2: #include "gone\.cuh" not found'):
        load_source(folder / "a.cu", {})


def test_compile_errors_name_the_header_and_its_line(tmp_path: Path) -> None:
    (tmp_path / "bad.cuh").write_text("\n\nint f() { return nowhere; }\n")
    (tmp_path / "k.cu").write_text('// head\n#include "bad.cuh"\n')
    source = load_source(tmp_path / "k.cu", NEUTRAL)
    with pytest.raises(InputError, match=r"bad\.cuh:3: .*nowhere"):
        compile_cuda(source.text, "sm_52", compile_options("sm_52"))
