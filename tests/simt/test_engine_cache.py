"""The disk cache: compiled once, found again, and never a reason to fail."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from engine_programs import kernel

from mpmbench.errors import InputError
from mpmbench.simt import cache, checks, memory_system, native, nvrtc, ptx

TEXT = 'extern "C" __global__ void kernel(int* o) { o[threadIdx.x] = 7 * threadIdx.x; }'


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("MPMBENCH_CACHE_DIR", str(tmp_path))
    return tmp_path


def works() -> bool:
    out = np.zeros(8, np.int32)
    kernel(TEXT).launch((1,), (8,), (out,))
    return out.tolist() == [7 * t for t in range(8)]


def fail(*_args):
    raise AssertionError("compiled again")


def test_a_second_process_neither_compiles_nor_parses(folder, monkeypatch):
    assert works()
    monkeypatch.setattr(native, "compile_text", fail)
    monkeypatch.setattr(ptx, "parse", fail)
    monkeypatch.setattr(nvrtc._Library, "compile", fail)
    assert works()


def test_damaged_entries_are_compiled_again(folder):
    assert works()
    files = [path for path in folder.rglob("*") if path.is_file()]
    assert len(files) >= 2
    for path in files:
        path.write_bytes(path.read_bytes()[:-7])
    assert works()
    for path in files:
        path.write_bytes(b"")
    assert works()


def test_an_entry_with_one_wrong_byte_is_none(folder):
    cache.store("ptx", "ab" * 32, b"some text")
    assert cache.load("ptx", "ab" * 32) == b"some text"
    (path,) = (path for path in folder.rglob("*") if path.is_file())
    whole = path.read_bytes()
    path.write_bytes(whole[:-3] + bytes([whole[-3] ^ 1]) + whole[-2:])
    assert cache.load("ptx", "ab" * 32) is None


def test_a_folder_that_cannot_be_written_is_no_failure(tmp_path, monkeypatch):
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    monkeypatch.setenv("MPMBENCH_CACHE_DIR", str(blocked))
    assert works()
    assert cache.load("ptx", "00" * 32) is None


def test_a_full_disk_is_no_failure(folder, monkeypatch):
    def full(*_args):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(cache.Path, "replace", full)
    assert works()
    assert not [path for path in folder.rglob("*") if path.is_file()]


def test_keys_keep_parts_apart():
    assert cache.content_key("ab", "c") != cache.content_key("a", "bc")
    assert cache.content_key("a") == cache.content_key(b"a")


def test_compile_errors_are_one_line(folder):
    with pytest.raises(InputError, match=r'^test.cu:1: identifier "y" is undefined$'):
        kernel('extern "C" __global__ void kernel() { int x = y; }')
    with pytest.raises(InputError, match="bad compiler option"):
        nvrtc.compile_cuda("", "sm_52", ("--nope",))


def test_the_default_folder_follows_the_user(monkeypatch, tmp_path):
    monkeypatch.delenv("MPMBENCH_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache.cache_folder() == tmp_path / "mpmbench"


def test_compiled_python_is_stale_when_any_file_of_the_folder_changes():
    """Places in a job are compiled into it: a cache that looks at one file's date would write into wrong ones."""
    stamp = cache.source_digest(Path(cache.__file__).parent)
    for function in (memory_system.replay, checks._check):
        assert function._cache._cache_file._source_stamp == stamp
