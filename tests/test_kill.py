"""A run that is killed, at whatever moment, goes on where it was: the rows are those of a run that was left alone.

Every run here is a fork of this process, which has imported everything and compiled every kernel: 50 runs and as many
resumed ones take seconds.
"""

from __future__ import annotations

import os
import random
import signal
import time
import warnings
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner

from mpmbench import record as record_module
from mpmbench.cli import main
from mpmbench.device.cpu import CpuDevice
from mpmbench.protocol import rounds
from mpmbench.record import RecordWriter, from_json, read_records, to_json
from mpmbench.runner import resume_key

MOMENTS = 25  # of each selection
SEED = 20190603

PROBLEM = ["--particles", "60", "--grid-shape", "12x12x12", "--quick", "-b", "p2g_global_*", "-b", "g2p_global_gather"]
SELECTIONS = {
    "counted": ["--dataset", "random", "--dataset", "uniform_cube", "-d", "simulated", *PROBLEM],
    "timed": ["--dataset", "random", "-d", "cpu", "-a", "cache=hot", *PROBLEM],
}

BRIEF = rounds.Rules(passes=2, min_rounds=2, max_rounds=2, time_limit=0.1, warmup_seconds=0.0, warmup_limit=0.0)


def start(words: list[str]) -> int:
    """The command line in a process of its own; what it prints is lost. Returns its number."""
    number = os.fork()
    if number:
        return number
    code = 70
    try:
        silence = os.open(os.devnull, os.O_WRONLY)
        os.dup2(silence, 1)
        os.dup2(silence, 2)
        signal.signal(signal.SIGINT, signal.default_int_handler)  # a test run in the background is born without
        code = main(words, standalone_mode=False) or 0
    except SystemExit as error:
        code = int(error.code or 0)
    finally:
        os._exit(code)


def end(number: int) -> int:
    """Waits for it; its exit code, or minus the signal that ended it."""
    return os.waitstatus_to_exitcode(os.waitpid(number, 0)[1])


def invoke(*words: object) -> str:
    """What the command line prints, in this process."""
    result = CliRunner().invoke(main, [str(word) for word in words])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == 0, result.output
    return result.output


def rows_of(path: Path) -> Counter:
    return Counter((*resume_key(record), record.cache) for record in read_records(path))


def lines_of(path: Path) -> list[bytes]:
    """The complete ones: each has to be a record."""
    lines = path.read_bytes().split(b"\n")[:-1] if path.exists() else []
    for line in lines:
        from_json(line.decode())
    return lines


def content(record):
    """What does not depend on when and where it ran."""
    return replace(record, environment=None, host_seconds=0.0)


@pytest.fixture(scope="module", params=list(SELECTIONS))
def whole(request, tmp_path_factory):
    """A selection, the journal of a run of it that was left alone, and how long that took [s]."""
    patch = pytest.MonkeyPatch()
    patch.setattr(rounds, "QUICK", BRIEF)
    words, path = SELECTIONS[request.param], tmp_path_factory.mktemp("whole") / "rows.jsonl"
    invoke("run", *words, "--json", path)  # compiles
    begin = time.monotonic()
    assert end(start(["run", *words, "--json", str(path)])) == 0
    yield words, path, time.monotonic() - begin
    patch.undo()


def hold_to_whole(words: list[str], path: Path, expected: Path) -> None:
    """Resume and compare."""
    before = lines_of(path)
    assert end(start(["run", *words, "--json", str(path), "--resume"])) == 0
    after = path.read_bytes().split(b"\n")
    assert after[-1] == b""
    assert after[: len(before)] == before  # no row is made again, none is lost
    assert rows_of(path) == rows_of(expected)
    assert max(rows_of(path).values()) == 1
    if "simulated" in words:
        assert list(map(content, read_records(path))) == list(map(content, read_records(expected)))


def test_killed_at_random_moments(whole, tmp_path):
    words, expected, seconds = whole
    moments = random.Random(SEED)
    kept = []
    for number in range(MOMENTS):
        path = tmp_path / f"{number}.jsonl"
        process = start(["run", *words, "--json", str(path)])
        time.sleep(moments.uniform(0, 1.1 * seconds))
        os.kill(process, signal.SIGKILL)
        assert end(process) in (0, -signal.SIGKILL)
        kept.append(len(lines_of(path)))
        hold_to_whole(words, path, expected)
    assert len(set(kept)) > 2, kept  # the moments were spread over the run


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_and_sigterm_leave_a_whole_file(whole, tmp_path, how):
    words, expected, seconds = whole
    path = tmp_path / "rows.jsonl"
    process = start(["run", *words, "--json", str(path)])
    while not lines_of(path):  # from then on the handlers are there
        time.sleep(seconds / 50)
    os.kill(process, how)
    assert end(process) in ((130,) if len(lines_of(path)) < len(lines_of(expected)) else (0, 130))
    assert path.read_bytes().endswith(b"\n")
    hold_to_whole(words, path, expected)


def test_killed_between_any_two_rows(whole, tmp_path, monkeypatch):
    """Also between rows of one contest, which come together at its end."""
    words, expected, _ = whole
    write = RecordWriter.write
    for rows in range(1, len(lines_of(expected))):
        path = tmp_path / f"{rows}.jsonl"

        def kill(writer, record, rows=rows):
            write(writer, record)
            if writer.rows == rows:
                os.kill(os.getpid(), signal.SIGKILL)

        with monkeypatch.context() as patch:
            patch.setattr(RecordWriter, "write", kill)
            assert end(start(["run", *words, "--json", str(path)])) == -signal.SIGKILL
        assert len(lines_of(path)) == rows
        hold_to_whole(words, path, expected)


# --- the file ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def records(tmp_path_factory):
    path = tmp_path_factory.mktemp("records") / "rows.jsonl"
    invoke("run", *SELECTIONS["counted"], "--json", path)
    return read_records(path)


def test_torn_at_every_byte(tmp_path, records):
    short = replace(
        records[1], transfer_counters=None, preprocess={}, finish={}, line_texts={}, check=None, failed_because="x"
    )
    first, second = (to_json(record).encode() + b"\n" for record in (short, short))
    path = tmp_path / "rows.jsonl"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for length in range(len(second) + 1):
            path.write_bytes(first + second[:length])
            RecordWriter(path, "append").close()
            whole = length >= len(second) - 1  # without its newline a row is whole
            assert path.read_bytes() == (first + second if whole else first), length


def test_interrupted_in_the_middle_of_a_row(tmp_path, records, monkeypatch):
    path = tmp_path / "rows.jsonl"
    write = os.pwrite

    def half(fd, data, offset):
        write(fd, data[: len(data) // 2], offset)
        raise KeyboardInterrupt

    with RecordWriter(path) as writer:
        writer.write(records[0])
        with monkeypatch.context() as patch:
            patch.setattr(record_module.os, "pwrite", half)
            with pytest.raises(KeyboardInterrupt):
                writer.write(records[1])
    assert path.read_text() == to_json(records[0]) + "\n"


@pytest.mark.parametrize("existing", ["append", "replace"])
def test_a_file_has_one_writer(tmp_path, records, existing):
    path = tmp_path / "rows.jsonl"
    words = ["run", *SELECTIONS["counted"], "--json", str(path)]
    resume = ["--resume"] if existing == "append" else []
    with RecordWriter(path, existing) as writer:
        for number, record in enumerate(records[:2], start=1):
            result = CliRunner().invoke(main, [*words, *resume])
            assert result.exit_code == 2
            (line,) = result.output.strip().splitlines()
            assert "is being written by another process" in line
            writer.write(record)
            read_records(path)  # to read it is no reason to let go of it
            assert len(lines_of(path)) == number
    assert end(start([*words, *resume])) == 0


# --- what is missing --------------------------------------------------------------------------------------------------


def test_rows_of_another_gpu_are_not_taken_for_this_one(tmp_path, monkeypatch):
    path = tmp_path / "rows.jsonl"
    monkeypatch.setattr(rounds, "QUICK", BRIEF)
    for name in ("A", "B", "A"):
        monkeypatch.setattr(CpuDevice, "facts", {"name": name}, raising=False)
        out = invoke("run", *SELECTIONS["timed"], "--json", path, "--resume")
        assert ("holds 3 rows of other selections" in out) == (len(lines_of(path)) > 3)
    assert Counter(r.environment.gpu["name"] for r in read_records(path)) == {"A": 3, "B": 3}


def test_rows_of_another_selection_stay_and_are_not_reported(tmp_path):
    path, page = tmp_path / "rows.jsonl", tmp_path / "page.md"
    counted = SELECTIONS["counted"][:2] + SELECTIONS["counted"][4:]
    invoke("run", *counted, "--json", path)
    before = path.read_bytes()
    out = invoke("run", "--dataset", "uniform_cube", *counted[2:], "--json", path, "--resume", "--md", page)
    assert path.read_bytes().startswith(before)
    assert len(lines_of(path)) == 6
    assert "holds 3 rows of other selections too" in out
    assert "random" not in page.read_text()


def test_what_is_asked_for_twice_is_one_row(tmp_path):
    path = tmp_path / "rows.jsonl"
    twice = ["--dataset", "random", "-a", "layout=[soa,soa]"]
    invoke("run", *SELECTIONS["counted"], *twice, "--json", path)
    assert max(rows_of(path).values()) == 1


def test_a_baseline_may_be_in_another_shard(tmp_path):
    for part in ("1/2", "2/2"):
        invoke("run", *SELECTIONS["timed"], "--baseline", "p2g_global_node", "--shard", part, "--dry-run")


def test_shards_of_modelled_runs():
    words = ["run", *SELECTIONS["counted"], "--gpu", "h100", "--dry-run"]
    words = [word for word in words if word not in ("-d", "simulated")]
    assert "6 cases" in invoke(*words)
    assert "3 cases" in invoke(*words, "--shard", "2/2")
