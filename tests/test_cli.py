"""The command line as a user meets it: what it prints, what it leaves behind, how it refuses."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from mpmbench import runner
from mpmbench.cli import main
from mpmbench.record import read_records

SMALL = ["--dataset", "random", "--particles", "500", "-d", "simulated"]


def invoke(*words, code=0):
    result = CliRunner().invoke(main, [str(word) for word in words])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == code, result.output
    return result.output


def refusal(*words):
    """The one line of a refused command: exit code 2, nothing else printed."""
    lines = invoke(*words, code=2).strip().splitlines()
    assert len(lines) == 1, lines
    assert lines[0].startswith("mpmbench: ")
    return lines[0]


def test_list_names_everything():
    text = invoke("list")
    for name in ("p2g_block_sync", "g2p_global_gather", "uniform_cube", "thesis", "simulated", "batching"):
        assert name in text
    content = json.loads(invoke("list", "--json"))
    assert content["variants"]["p2g_block_sync"]["axes"]["batching"] == [1, 2, 4, 8]


def test_run_leaves_records_and_reports(tmp_path):
    files = [tmp_path / name for name in ("rows.jsonl", "report.html", "report.md", "rows.csv")]
    invoke("run", *SMALL, "-b", "p2g_block_sync", "-a", "batching=[1,2]", "--json", files[0], "--html", files[1],
           "--md", files[2], "--csv", files[3])  # fmt: skip
    records = read_records(files[0])
    assert [r.axes["batching"] for r in records] == [1, 2]
    assert all(r.status == "ok" and r.transfer_counters.total.bar > 0 for r in records)
    assert "<html" in files[1].read_text()
    assert "p2g_block_sync" in files[2].read_text()
    assert len(files[3].read_text().splitlines()) == 3


def test_report_is_rebuilt_from_records(tmp_path):
    rows = tmp_path / "rows.jsonl"
    invoke("run", *SMALL, "-b", "g2p_global_gather", "--json", rows)
    assert "g2p_global_gather" in invoke("report", rows)
    invoke("report", rows, "--html", tmp_path / "again.html")
    assert (tmp_path / "again.html").stat().st_size < 1 << 20


def test_resume_runs_only_what_is_missing(tmp_path):
    rows = tmp_path / "rows.jsonl"
    invoke("run", *SMALL, "-b", "p2g_global_atomic", "--json", rows)
    before = rows.read_bytes()
    invoke("run", *SMALL, "-b", "p2g_global_*", "--json", rows, "--resume")
    assert rows.read_bytes().startswith(before)
    assert [r.variant for r in read_records(rows)] == ["p2g_global_atomic", "p2g_global_node"]


def test_own_particles(tmp_path):
    path = tmp_path / "mine.npz"
    position = np.random.default_rng(3).uniform(0.2, 0.6, (60, 3))
    np.savez(path, position=position, velocity=position, mass=1.0, grid_shape=(16, 16, 16), dx=1 / 16)
    invoke("run", "--dataset", path, "-b", "p2g_*", "-d", "simulated", "--json", tmp_path / "rows.jsonl")
    assert {r.dataset.n for r in read_records(tmp_path / "rows.jsonl")} == {60}


def test_npy_needs_a_grid(tmp_path):
    path = tmp_path / "mine.npy"
    np.save(path, np.random.default_rng(3).uniform(0.2, 0.6, (50, 7)))
    assert "grid" in refusal("run", "--dataset", path, "-d", "simulated")
    assert "three whole numbers" in refusal("run", "--dataset", path, "--grid-shape", "16", "-d", "simulated")
    invoke("run", "--dataset", path, "--grid-shape", "16x16x16", "--dx", 1 / 16, "-b", "g2p_*", "-d", "simulated")


def test_dry_run_runs_nothing(tmp_path):
    out = invoke("run", "--preset", "thesis", "-d", "simulated", "--dry-run", "--json", tmp_path / "rows.jsonl")
    assert "54 rows" in out
    assert not (tmp_path / "rows.jsonl").exists()


def test_impossible_combination_is_a_row_with_a_reason(tmp_path):
    rows = tmp_path / "rows.jsonl"
    invoke("run", *SMALL, "-b", "p2g_block_*", "-a", "block_shape=32x32x32", "--json", rows)
    assert {r.status for r in read_records(rows)} == {"skipped"}
    assert all("32x32x32 needs 32768 threads" in r.skipped_because for r in read_records(rows))


def test_what_the_machine_cannot_check_is_a_row_with_a_reason(tmp_path, monkeypatch):
    rows = tmp_path / "rows.jsonl"
    monkeypatch.setattr(runner, "machine_bytes", lambda: 10_000_000)  # the device alone would fit
    words = ("-d", "simulated", "--dataset", "random", "--particles", "100", "--grid-shape", "48x48x48")
    invoke("run", *words, "-b", "p2g_global_atomic", "--json", rows)
    (record,) = read_records(rows)
    assert record.device_bytes_predicted < 10_000_000
    assert "run and check need 0.03 GiB of memory" in record.skipped_because


def test_check_debug_reports_agreement():
    out = invoke("check", *SMALL, "-b", "p2g_block_sync", "--debug")
    assert "1 rows: 1 ok" in out


def test_env_and_doctor():
    assert "numpy" in invoke("env")
    assert "NVRTC" in invoke("doctor")


# --- refusals ---------------------------------------------------------------------------------------------------------


def test_unknown_names_list_the_valid_ones():
    assert "p2g_block_sync" in refusal("run", "-b", "p2g_nothing", "-d", "simulated")
    assert "uniform_cube" in refusal("run", "--dataset", "nothing", "-d", "simulated")
    assert "batching" in refusal("run", "-a", "nothing=1", "-d", "simulated")
    assert "1, 2, 4, 8" in refusal("run", "-b", "p2g_block_sync", "-a", "batching=3", "-d", "simulated")
    assert "thesis" in refusal("run", "--preset", "nothing", "-d", "simulated")
    assert "simulated" in refusal("run", "-d", "nothing")
    assert "name=value" in refusal("run", "-a", "batching", "-d", "simulated")


@pytest.mark.skipif(os.path.exists("/proc/driver/nvidia"), reason="there is a GPU here")
def test_no_gpu():
    assert "simulated" in refusal("run", "-d", "cuda", "-b", "p2g_global_atomic")


def test_missing_and_malformed_files(tmp_path):
    assert "missing.npz" in refusal("run", "--dataset", tmp_path / "missing.npz", "-d", "simulated")
    bad = tmp_path / "bad.npz"
    bad.write_bytes(b"not a zip file")
    assert "bad.npz" in refusal("run", "--dataset", bad, "-d", "simulated")
    assert "missing.jsonl" in refusal("report", tmp_path / "missing.jsonl")
    (tmp_path / "bad.jsonl").write_text("{}\n{}\n")
    assert "bad.jsonl" in refusal("report", tmp_path / "bad.jsonl")


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"position": np.full((4, 3), np.nan)}, "particle 0"),
        ({"position": np.full((4, 3), 7.0)}, "outside"),
        ({"position": np.full((4, 3), 0.06)}, "cubic support"),  # in the grid, but not with all its nodes
        ({"velocity": np.full((4, 3), 1e300)}, "momentum"),
        ({"velocity": np.zeros((3, 3))}, "(4, 3)"),
        ({"velocity": np.array([["a"] * 3] * 4)}, "velocity"),
        ({"mass": -1.0}, "mass"),
        ({"dx": 0.0}, "dx"),
    ],
)
def test_bad_particles(tmp_path, change, expected):
    good = {
        "position": np.full((4, 3), 0.5),
        "velocity": np.zeros((4, 3)),
        "mass": 1.0,
        "grid_shape": (8, 8, 8),
        "dx": 1 / 8,
    }
    path = tmp_path / "particles.npz"
    np.savez(path, **good | change)
    line = refusal("run", "--dataset", path, "-d", "simulated", "--json", tmp_path / "rows.jsonl")
    assert expected in line
    assert not (tmp_path / "rows.jsonl").exists()


def test_nothing_is_overwritten_by_a_refused_run(tmp_path):
    rows = tmp_path / "rows.jsonl"
    rows.write_text("keep me")
    refusal("run", "--dataset", "nothing", "-d", "simulated", "--json", rows)
    assert rows.read_text() == "keep me"


def test_folder_in_place_of_a_file(tmp_path):
    assert "folder" in refusal("run", *SMALL, "--html", tmp_path)


def test_no_output_may_hit_an_input_a_device_or_another_output(tmp_path):
    rows, page = tmp_path / "rows.jsonl", tmp_path / "page.html"
    particles = tmp_path / "mine.npz"
    position = np.full((4, 3), 0.5)
    np.savez(particles, position=position, velocity=position, mass=1.0, grid_shape=(8, 8, 8), dx=1 / 8)
    before = particles.read_bytes()
    line = refusal("run", "--dataset", particles, "-d", "simulated", "--json", particles)
    assert "is read by the same command" in line
    assert particles.read_bytes() == before
    assert "is written by the same" in refusal("run", *SMALL, "--json", rows, "--html", rows)
    assert "not an ordinary file" in refusal("run", *SMALL, "--html", "/dev/null")
    invoke("run", *SMALL, "-b", "p2g_global_atomic", "--json", rows, "--html", page)
    before = rows.read_bytes()
    assert "is read by the same command" in refusal("report", rows, "--html", rows)
    assert rows.read_bytes() == before


def test_full_disk(tmp_path, monkeypatch):
    """A row that does not fit is one line of error; the rows before it stay."""
    rows = tmp_path / "rows.jsonl"
    invoke("run", *SMALL, "-b", "p2g_global_atomic", "--json", rows)
    before = rows.read_bytes()

    def no_space(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "pwrite", no_space)
    out = invoke("run", *SMALL, "-b", "p2g_global_*", "--json", rows, "--resume", code=2)
    assert "no space left on device" in out.strip().splitlines()[-1]
    assert rows.read_bytes() == before


@pytest.mark.parametrize("command", ["run", "check"])
def test_a_wrong_result_is_exit_code_4(tmp_path, command):
    shipped = Path(runner.__file__).parent
    for folder, suffix in (("variants", ".py"), ("raw_kernels", ".cu")):
        text = (shipped / folder / f"p2g_global_atomic{suffix}").read_text().replace("p2g_global_atomic", "p2g_wrong")
        (tmp_path / f"p2g_wrong{suffix}").write_text(text.replace("source.mass", "(source.mass * real(1.001))"))
    out = invoke(command, *SMALL, "--variants", tmp_path, "-b", "p2g_wrong", "--json", tmp_path / "r.jsonl", code=4)
    assert "1 rows: 1 wrong" in out


@pytest.mark.parametrize("option", ["--json", "--html", "--md", "--csv"])
def test_outputs_replace_no_particles_and_no_sources(tmp_path, option):
    for name in ("mine.npz", "mine.py", "mine.cu"):
        path = tmp_path / name
        path.write_text("mine")
        assert "name another file to write to" in refusal("run", *SMALL, option, str(path))
        assert path.read_text() == "mine"


def test_an_output_that_cannot_be_written_is_refused_before_the_run():
    said = refusal("run", *SMALL, "--html", "/proc/none/report.html")
    assert said.startswith("mpmbench: /proc/none/report.html cannot be written: /proc: ")


# --- interruption -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_interrupted_run_keeps_finished_rows(tmp_path, how):
    rows = tmp_path / "rows.jsonl"
    words = ["run", *SMALL, "-b", "p2g_global_atomic", "-a", "spline=[linear,quadratic,cubic]", "-a",
             "layout=[soa,aos]", "-a", "weights=[unity,plain]"]  # fmt: skip
    command = [sys.executable, "-m", "mpmbench", *words, "--json", str(rows)]
    # Where the tests themselves run in the background, their children would be born deaf to Ctrl-C.
    process = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    deadline = time.monotonic() + 120
    while not (rows.exists() and rows.read_bytes().count(b"\n") >= 2):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.05)
    process.send_signal(how)
    _, errors = process.communicate(timeout=60)
    assert process.returncode in (130, -how)
    assert "Traceback" not in errors
    kept = rows.read_bytes().count(b"\n")
    assert 2 <= kept < 12
    invoke(*words, "--json", rows, "--resume")
    records = read_records(rows)
    assert len(records) == 12
    assert len({(r.variant, *sorted(map(str, r.axes.items()))) for r in records}) == 12
