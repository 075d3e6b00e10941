"""``mpmbench sanitize`` from a folder of its own: every seeded defect is found where it stands, its twin is clean.

A kernel of tests/sanitize/*.cu ends in _bad, _good or _note; ``FINDS kind`` marks the lines that findings must name.
"""

from __future__ import annotations

import functools
import json
import re
import shutil
import tempfile
from pathlib import Path

import pytest
from click.testing import CliRunner

from mpmbench import discovery, kernel
from mpmbench.cli import main

SEEDED = Path(__file__).parent / "sanitize"
CHECKS = sorted(path.stem for path in SEEDED.glob("*.cu"))
STOPPED = ("barrier_warp", "mask", "runaway")  # a launch that stops ends the run: each kernel has one of its own
SEVERITY = {"atomic-mix": "WARNING", "schedule": "WARNING", "equal-stores": "INFO"}
FOLLOW = {"schedule", "uninitialised"}  # what a race may bring about besides


def kernels_of(check: str) -> dict[str, dict[str, set[int]]]:
    """Kernel -> kind of finding -> lines that are marked with it."""
    kernels: dict[str, dict[str, set[int]]] = {}
    for number, line in enumerate((SEEDED / f"{check}.cu").read_text().splitlines(), start=1):
        if head := re.search(r"__global__ void (\w+)", line):
            marked = kernels.setdefault(head[1], {})
        if mark := re.search(r"// FINDS (.*)", line):
            for kind in mark[1].split():
                marked.setdefault(kind, set()).add(number)
    return kernels


def sanitize(*args: str):
    return CliRunner().invoke(main, ["sanitize", *args])


@functools.cache
def findings_of(check: str, kernel: str = "") -> tuple[int, str, list[dict]]:
    """Exit code, text and findings of a check's kernels, or of one of them, run in a folder outside of the package."""
    with tempfile.TemporaryDirectory() as folder:
        source, launch, found = (Path(folder) / name for name in (f"{check}.cu", "launch.toml", "found.json"))
        shutil.copy(SEEDED / source.name, source)
        head, *launches = (SEEDED / f"{check}.toml").read_text().split("[[launch]]")
        chosen = [text for text in launches if not kernel or f'kernel = "{kernel}"' in text]
        launch.write_text("[[launch]]".join([head, *chosen]))
        result = sanitize(str(source), "--launch", str(launch), "--json", str(found))
        assert result.exit_code in (0, 4), result.output
        return result.exit_code, result.output, json.loads(found.read_text())["findings"]


def findings(check: str, kernel: str) -> list[dict]:
    _, _, found = findings_of(check, kernel if check in STOPPED else "")
    return [finding for finding in found if finding["kernel"] == kernel]


@pytest.mark.parametrize(
    ("check", "kernel"), [(check, kernel) for check in CHECKS for kernel in kernels_of(check)], ids=lambda name: name
)
def test_seeded_defects_are_found_and_their_twins_are_clean(check: str, kernel: str) -> None:
    expected = kernels_of(check)[kernel]
    found = findings(check, kernel)
    if kernel.endswith("_good"):
        assert not expected
        assert not found
        return
    kinds = {finding["kind"] for finding in found}
    assert set(expected) <= kinds <= set(expected) | FOLLOW
    for finding in found:
        assert finding["severity"] == SEVERITY.get(finding["kind"], "ERROR")
        assert finding["count"] >= 1
        assert finding["threads"] or finding["kind"] == "schedule"
        lines = {place["line"] for place in (finding["line"], finding["other_line"]) if place}
        if finding["kind"] in expected and finding["kind"] != "schedule":
            assert lines
            assert lines <= expected[finding["kind"]]


@pytest.mark.parametrize("check", CHECKS)
def test_every_check_has_three_defects_and_their_twins(check: str) -> None:
    kernels = kernels_of(check)
    bad = [name for name in kernels if name.endswith("_bad")]
    assert len(bad) >= 3
    assert {name.replace("_bad", "_good") for name in bad} <= set(kernels)


@pytest.mark.parametrize(
    ("check", "kernel", "words"),
    [
        ("bounds", "read_8_bad", "ERROR|Invalid __global__ read of size 8 bytes|bounds.cu:12|"
         "thread (0,0,0) in block (0,0,0): |8 bytes before d of 800 bytes"),
        ("bounds", "shared_4_bad", "Invalid __shared__ write of size 4 bytes|bounds.cu:44|thread (63,0,0) in block "
         "(0,0,0): __shared__ 0x100, block has 256 bytes [2 times]"),
        ("bounds", "local_4_bad", "Invalid __local__ write of size 4 bytes|bounds.cu:69|thread has 32 bytes"),
        ("misaligned", "read_16_bad", "Invalid __global__ read of size 16 bytes|no multiple of 16|misaligned.cu:13|"
         "x + 132 of 4096 bytes [96 times]"),
        ("race", "block_8_bad", "Race reported between|Write access at race.cu:16|Read access at race.cu:18|"
         "different warps|8 bytes, __shared__ 0x|in block (0,0,0)"),
        ("race", "warp_4_bad", "Race reported between Write access at race.cu:60|Read access at race.cu:62|"
         "different lanes of a warp|by thread (33,0,0)|by threads (32,0,0)"),
        ("clash", "lanes_8_bad", "Race reported between Write access at clash.cu:17|several lanes of a warp at one "
         "address|__shared__ 0x80"),
        ("clash", "equal_note", "INFO|Race reported between Write access at clash.cu:53|the same value"),
        ("atomic_mix", "read_16_bad", "WARNING|Race reported between|Atomic access at atomic_mix.cu:37|"
         "Read access at atomic_mix.cu:38|16 bytes, __shared__ 0x"),
        ("global_race", "read_4_bad", "Race reported between Read access at global_race.cu:16 by block (0,0,0) and "
         "Write access at global_race.cu:18 by thread (0,0,0) in block (1,0,0)|z + 256 of 8192 bytes"),
        ("uninitialised", "global_4_bad", "Uninitialized __global__ memory read of size 4 bytes|uninitialised.cu:65|"
         "threads (60,0,0), (61,0,0), (62,0,0), (63,0,0) in block (0,0,0): fresh4 + 240 of 512 bytes [8 times]"),
        ("uninitialised", "shared_4_bad", "Uninitialized __shared__ memory read of size 4 bytes|uninitialised.cu:7|"
         "(60,0,0), (61,0,0), (62,0,0), (63,0,0) in block (0,0,0): __shared__ 0xf0"),
        ("uninitialised", "local_8_bad", "Uninitialized __local__ memory read of size 8 bytes|uninitialised.cu:104|"
         "__local__ +0x18, thread has 128 bytes"),
        ("barrier_warp", "half_bad", "Divergent thread(s) in warp|barrier_warp.cu:4|threads (32,0,0), (33,0,0)"),
        ("barrier_block", "return_bad", "Divergent thread(s) in block: warps 0 of block (0,0,0)|barrier_block.cu:5|"
         "warps 1 end without it"),
        ("barrier_block", "else_bad", "Divergent thread(s) in block|barrier_block.cu:32|barrier_block.cu:28"),
        ("mask", "never_bad", "Invalid arguments|member mask|mask.cu:9|threads (32,0,0), (33,0,0)"),
        ("schedule", "last_8_bad", "WARNING|depends on the schedule: 128 of 1024 elements of last_8|last_8[0]"),
        ("runaway", "lock_bad", "a loop spends the instruction budget at runaway.cu:11|launch stopped"),
    ],
)  # fmt: skip
def test_a_finding_names_line_threads_and_place(check: str, kernel: str, words: str) -> None:
    _, text, _ = findings_of(check, kernel if check in STOPPED else "")
    lines = [line for line in text.splitlines() if f" {kernel}: " in line]
    assert any(all(piece in line for piece in words.split("|")) for line in lines), lines


def test_clean_kernels_end_with_zero_and_defects_with_four() -> None:
    assert findings_of("race", "block_4_good")[0] == 0
    assert findings_of("race", "block_4_bad")[0] == 4
    assert findings_of("atomic_mix", "read_4_bad")[0] == 4  # a warning alone
    code, text, _ = findings_of("clash", "equal_note")
    assert code == 0
    assert "0 errors, 0 warnings, 1 notes" in text


# --- what is refused --------------------------------------------------------------------------------------------------

COPY = 'extern "C" __global__ void copy(float* x, int n) { if (threadIdx.x < n) x[threadIdx.x] += 1.f; }\n'
LAUNCH = """arch = "sm_80"

[arrays]
x = { shape = [64], dtype = "float32", fill = "random" }

[[launch]]
kernel = "copy"
grid = [1]
block = [64]
shared = 0
args = ["x", { dtype = "int32", value = 64 }]
"""


def refusal(folder: Path, source: str, launch: str, *options: str) -> str:
    """The one line with which the command line refuses."""
    (folder / "copy.cu").write_text(source)
    (folder / "launch.toml").write_text(launch)
    result = sanitize(str(folder / "copy.cu"), "--launch", str(folder / "launch.toml"), *options)
    assert result.exit_code == 2, result.output
    (line,) = result.output.strip().splitlines()
    return line


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('[arrays]', '[arrays', "not valid TOML"),
        ('arch = "sm_80"', 'archs = "sm_80"', "unknown key 'archs': valid are arch,"),
        ('arch = "sm_80"', 'arch = "sm_12"', "sm_12"),
        ('arch = "sm_80"', "budget = 0", "budget must be a whole number of at least 1"),
        ('arch = "sm_80"', "budget = 10", "2 warps"),
        ('shape = [64]', "shape = [-64]", "arrays: x: shape must be one to 8 whole numbers of at least 1"),
        ('shape = [64]', "shape = [64.5]", "shape must be"),
        ('shape = [64]', "shape = [1000000000000]", "GiB of memory"),
        ('"float32"', '"float31"', "dtype 'float31' is unknown: valid are bool, int8"),
        ('"random"', '"zeros"', "fill 'zeros' is unknown: valid are random, arange, uninitialised"),
        ('"random"', "[1]", "fill must be a number"),
        ('fill = "random"', 'file = "x.npy"', "x: unknown key 'shape': valid are file, compare"),
        ('shape = [64], dtype = "float32", fill = "random"', 'file = "none.npy"', "none.npy: No such file"),
        ('shape = [64], dtype = "float32", fill = "random"', 'file = "copy.cu"', "cannot read"),
        ("[[launch]]", "[[launches]]", "unknown key 'launches'"),
        ('kernel = "copy"', 'kernel = "paste"', "no kernel 'paste'; the module has: copy"),
        ('kernel = "copy"', "kernel = 3", "kernel must be a text"),
        ('kernel = "copy"\n', "", "launch: kernel is missing"),
        ("grid = [1]", "grid = [0]", "grid must be one to 3 whole numbers of at least 1"),
        ("grid = [1]", "grid = [1, 70000]", "too large: at most 65535"),
        ("grid = [1]", "grid = [2147483647, 100]", "more than the budget"),
        ("block = [64]", "block = [64, 64]", "4096 threads"),
        ("shared = 0", "shared = -1", "shared must be a whole number of at least 0"),
        ("shared = 0", "shared = 1000000", "1000000 bytes of shared memory"),
        ('"x", {', '"y", {', "argument 0: unknown array 'y': [arrays] has x"),
        ('"x", {', "1, {", "argument 0: 1 is neither the name of an array nor"),
        (', { dtype = "int32", value = 64 }', "", "copy takes 2 arguments, 1 given"),
        ('"int32", value = 64', '"int64", value = 64', "argument 1 has 8 bytes, the kernel expects 4"),
        ('"int32", value = 64', '"int32", value = 1e9', "is no int32"),
        ('"int32", value = 64', '"int32", value = 4000000000', "does not fit int32"),
        ('"int32", value = 64', '"int32", values = 64', "unknown key 'values': valid are dtype, value"),
    ],
)  # fmt: skip
def test_a_bad_launch_file_is_refused_in_one_line(tmp_path: Path, old: str, new: str, says: str) -> None:
    assert LAUNCH.count(old) == 1
    assert says in refusal(tmp_path, COPY, LAUNCH.replace(old, new))


def test_a_sound_launch_file_reads_arrays_from_files(tmp_path: Path) -> None:
    import numpy as np

    np.save(tmp_path / "x.npy", np.ones((8, 8), np.float32))
    (tmp_path / "copy.cu").write_text(COPY)
    text = LAUNCH.replace('shape = [64], dtype = "float32", fill = "random"', 'file = "x.npy"')
    (tmp_path / "launch.toml").write_text(text)
    result = sanitize(str(tmp_path / "copy.cu"), "--launch", str(tmp_path / "launch.toml"))
    assert result.exit_code == 0, result.output
    (tmp_path / "launch.toml").write_text(text.replace("value = 64", "value = 65").replace("[64]", "[65]"))
    result = sanitize(str(tmp_path / "copy.cu"), "--launch", str(tmp_path / "launch.toml"))
    assert result.exit_code == 4
    assert "0 bytes after x of 256 bytes" in result.output


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (["none.cu", "--launch", "launch.toml"], "launch.toml"),
        (["copy.txt", "--launch", "good.toml"], "copy.txt is no CUDA source"),
        (["none.cu", "--launch", "good.toml"], "none.cu: no such file"),
        (["copy.cu"], "say how to launch it"),
        (["--launch", "good.toml"], "name its FILE.cu"),
        (["copy.cu", "--launch", "good.toml", "-b", "p2g_*"], "no meaning"),
        (["copy.cu", "--launch", "good.toml", "--json", "copy.cu"], "copy.cu is read by the same command"),
        (["-d", "cuda"], "simulated device only"),
        (["-b", "nothing"], "nothing matches"),
    ],
)
def test_bad_usage_is_refused_in_one_line(tmp_path: Path, monkeypatch, args: list[str], says: str) -> None:
    monkeypatch.chdir(tmp_path)
    Path("copy.cu").write_text(COPY)
    Path("good.toml").write_text(LAUNCH)
    result = sanitize(*args)
    assert result.exit_code == 2, result.output
    assert says in result.output
    assert len(result.output.strip().splitlines()) == 1


TENSOR = """asm volatile("wmma.load.a.sync.aligned.row.m16n16k16.global.f16 {%0,%1,%2,%3,%4,%5,%6,%7}, [%8];"
    : "=r"(a), "=r"(b), "=r"(c), "=r"(d), "=r"(e), "=r"(f), "=r"(g), "=r"(h) : "l"(x));"""
REFUSED = {
    "tex": ('float a; asm volatile("{.reg .f32 u; tex.1d.v4.f32.s32 {%0,u,u,u}, [%1, {%2}];}" '
            ': "=f"(a) : "l"(x), "r"(n)); x[0] = a;', "tex.1d"),
    "wmma": ("int a, b, c, d, e, f, g, h; " + TENSOR.replace("\n", " "), "wmma.load"),
    "bulk": ('asm volatile("cp.async.bulk.commit_group;");', "cp.async.bulk"),
    "cluster": ('asm volatile("barrier.cluster.arrive;");', "barrier.cluster.arrive"),
    # What cooperative groups make of grid.sync(): the barrier's place is in a special register that only a driver sets.
    "grid-wide": ('unsigned a; asm volatile("mov.u32 %0, %%envreg2;" : "=r"(a)); x[0] = a;', "%envreg2"),
    "named barrier": ('asm volatile("bar.sync 1, 64;");', "bar.sync"),
    "printf": ('printf("%d", n);', "printf"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_not_supported_is_refused_by_opcode_and_line(tmp_path: Path, name: str) -> None:
    body, opcode = REFUSED[name]
    source = f'extern "C" __global__ void copy(float* x, int n) {{\n    x[threadIdx.x] = n;\n    {body}\n}}\n'
    line = refusal(tmp_path, source, LAUNCH.replace("sm_80", "sm_90"))
    assert opcode in line
    assert "copy.cu:3" in line


# --- shipped strategies -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "args",
    [
        ["-b", "p2g_global_atomic", "-a", "particle_order=deep"],
        ["-b", "p2g_block_atomic", "-b", "g2p_block_gather"],
        ["-b", "scan_*", "-b", "reduce_*"],
    ],
    ids=lambda args: args[1],
)
def test_shipped_kernels_are_clean(tmp_path: Path, args: list[str]) -> None:
    found = tmp_path / "found.json"
    result = sanitize(*args, "--particles", "500", "--size", "3000", "--schedules", "2", "--json", str(found))
    assert result.exit_code == 0, result.output
    told = json.loads(found.read_text())
    assert told["findings"] == []
    assert told["runs"]


def test_a_broken_strategy_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sources = tmp_path / "raw_kernels"
    shutil.copytree(kernel.RAW_KERNELS, sources)
    path = sources / "p2g_block_sync.cu"
    path.write_text(path.read_text().replace("            __syncthreads();\n", ""))
    monkeypatch.setattr(kernel, "RAW_KERNELS", sources)
    monkeypatch.setattr(discovery, "RAW_KERNELS", sources)
    result = sanitize("-b", "p2g_block_sync", "-a", "writing=literal", "--particles", "500", "--schedules", "1")
    assert result.exit_code == 4, result.output
    assert "ERROR   p2g_block_sync: Race reported between" in result.output
