"""Records survive the trip through a file, a crash and a full disk, and cannot hold a dishonest number."""

from __future__ import annotations

import dataclasses
import errno
import json
import math
import os
import re

import numpy as np
import pytest

from mpmbench import record as record_module
from mpmbench.environment import Environment
from mpmbench.errors import InputError
from mpmbench.grid import Grid
from mpmbench.record import (
    SCHEMA,
    Check,
    DatasetSummary,
    Measurement,
    Record,
    RecordWriter,
    StepCost,
    from_json,
    line_texts,
    load_records,
    read_records,
    to_json,
    total_cost,
)
from mpmbench.simt.counters import Counters, Finding, SourceLine, Tally
from mpmbench.simt.nvrtc import compile_cuda


@pytest.fixture(scope="module")
def environment() -> Environment:
    return Environment.capture(argv=["/somewhere/mpmbench", "run", "--quick"], seed=7)


@pytest.fixture
def simulated(environment: Environment) -> Record:
    line = SourceLine("p2g.cu", 12)
    counters = Counters(
        Tally(warp_inst=100, lane_inst=3000, gld_sectors=5, gatom_sectors=7), {line: Tally(warp_inst=100)}
    )
    return Record(
        variant="p2g_global_atomic",
        transfer="p2g",
        dataset=DatasetSummary(
            'röhre "odd"\n', {"kind": "random", "box": [1, 2]}, 3, 1000, Grid((8, 9, 10), 0.1), "f" * 64, {"mean": 4.0}
        ),
        axes={"spline": "cubic", "block_shape": (8, 4, 4), "batching": 4},
        default_axes={"spline": "cubic", "block_shape": (8, 4, 4), "batching": 1},
        device="simulated",
        arch="sm_52",
        environment=environment,
        check=Check(True, 1e-7, 1e-6, (1, 2, 3), {"mass": 1e-9}),
        preprocess={"scan": StepCost(counters), "grid_clear": StepCost(counters)},
        transfer_counters=counters,
        line_texts={line: "atomicAdd(&node, w);"},
        kernel_info={"p2g": {"arch": "sm_52", "registers": 40}},
        hashes={"p2g": "a" * 64},
        floor_bytes=16_000,
        device_bytes_predicted=1 << 33,
        host_seconds=0.25,
    )  # fmt: skip


@pytest.fixture
def measured(simulated: Record) -> Record:
    time = Measurement((3e-3, 1e-3, 2e-3), "cold", 3, "precision")
    return dataclasses.replace(
        simulated, device="cuda:0", preprocess={"scan": StepCost(None, time)}, transfer_counters=None,
        transfer_measurement=time, line_texts={},
    )  # fmt: skip


def test_round_trip_is_exact(tmp_path, simulated, measured):
    skipped = dataclasses.replace(
        simulated, preprocess={}, transfer_counters=None, check=None, skipped_because="no room"
    )
    finding = Finding("race", "p2g", "two warps write s[3]", SourceLine("a.cu", 1), None, 4)
    wrong = dataclasses.replace(simulated, check=Check(False, math.nan, 0.0), findings=(finding,))
    written = [simulated, measured, skipped, dataclasses.replace(wrong, check=Check(False, math.inf, 0.0))]
    with RecordWriter(tmp_path / "new" / "r.jsonl") as writer:
        for record in written:
            writer.write(record)
    assert read_records(tmp_path / "new" / "r.jsonl") == written
    assert math.isnan(from_json(to_json(wrong)).check.worst_error)  # NaN equals nothing, hence apart
    for line in (tmp_path / "new" / "r.jsonl").read_text().splitlines():
        json.loads(line, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))


def test_each_row_is_on_disk_before_the_next(tmp_path, simulated, monkeypatch):
    synced = []
    monkeypatch.setattr(record_module.os, "fsync", lambda fd: synced.append(os.fstat(fd).st_size))
    with RecordWriter(tmp_path / "r.jsonl") as writer:
        for rows in (1, 2):
            writer.write(simulated)
            assert len(read_records(tmp_path / "r.jsonl")) == rows  # read while the file is open
    assert synced == [os.path.getsize(tmp_path / "r.jsonl") // 2, os.path.getsize(tmp_path / "r.jsonl")]


@pytest.mark.parametrize("keep", [1, 40, -2])
def test_a_torn_last_row_is_dropped_with_a_warning(tmp_path, simulated, keep):
    path = tmp_path / "r.jsonl"
    row = to_json(simulated).encode() + b"\n"
    path.write_bytes(row + row[:keep])
    with pytest.warns(UserWarning, match=r"r\.jsonl:2: dropped a torn last row"):
        assert read_records(path) == [simulated]
    with pytest.warns(UserWarning, match="torn"), RecordWriter(path, existing="append") as writer:
        writer.write(simulated)
    assert read_records(path) == [simulated, simulated]


def test_nothing_of_a_torn_row_is_left_behind_a_shorter_one(tmp_path, simulated):
    path = tmp_path / "r.jsonl"
    path.write_text(to_json(simulated)[:-1])
    short = dataclasses.replace(
        simulated, transfer_counters=None, preprocess={}, line_texts={}, check=None, failed_because="x"
    )
    with pytest.warns(UserWarning, match="torn"), RecordWriter(path, existing="append") as writer:
        writer.write(short)
    assert path.read_text() == to_json(short) + "\n"


def test_a_row_without_its_newline_is_kept_and_appended_to(tmp_path, simulated):
    path = tmp_path / "r.jsonl"
    path.write_text(to_json(simulated))
    with RecordWriter(path, existing="append") as writer:
        writer.write(simulated)
    assert read_records(path) == [simulated, simulated]


def test_a_full_disk_is_one_clear_line_and_earlier_rows_stay(tmp_path, simulated, monkeypatch):
    path = tmp_path / "r.jsonl"
    writer = RecordWriter(path)
    writer.write(simulated)
    real = os.pwrite

    def fill_up(fd: int, data: bytes, offset: int) -> int:
        if offset > len(to_json(simulated).encode()) + 200:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return real(fd, data[:100], offset)  # a short write comes first, as on a real disk

    monkeypatch.setattr(record_module.os, "pwrite", fill_up)
    with pytest.raises(InputError, match=r"row 2 .*no space left on device; earlier rows are intact") as error:
        writer.write(simulated)
    assert "\n" not in str(error.value)
    monkeypatch.undo()
    assert path.read_text() == to_json(simulated) + "\n"
    writer.write(simulated)  # room was made
    writer.close()
    assert read_records(path) == [simulated, simulated]


def test_an_existing_file_is_safe(tmp_path, simulated):
    path = tmp_path / "r.jsonl"
    with RecordWriter(path) as writer:
        writer.write(simulated)
    with pytest.raises(InputError, match="exists"):
        RecordWriter(path)
    RecordWriter(path, existing="replace").close()  # no row came: nothing was replaced
    assert read_records(path) == [simulated]
    with RecordWriter(path, existing="replace") as writer:
        writer.write(simulated)
    assert read_records(path) == [simulated]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "cannot read records"),
        ('{"schema": 99}\n', "schema 99 is not known, this mpmbench reads schema 1 and 2"),
        ('{"a": 1}\n', ":1: not a record"),
        ("[]\n", ":1: not a record"),
        ("garbage\n", ":1: not a record"),
        ("notes without a last newline", ":1: not a record"),
        ("\xff\n", ":1: not a record"),
        (f'{{"schema": {SCHEMA}}}\n', ":1: not a record"),
    ],
)
def test_what_is_no_record_file_is_one_clear_line(tmp_path, text, message):
    path = tmp_path / "r.jsonl"
    if text is not None:
        path.write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError, match=message) as error:
        read_records(path)
    assert "\n" not in str(error.value)
    assert str(path) in str(error.value)


def test_an_unwritable_place_is_known_before_any_work(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot write records"):
        RecordWriter(tmp_path / "file" / "r.jsonl")


def test_a_text_of_something_else_is_not_taken_for_a_torn_row(tmp_path):
    path = tmp_path / "notes.txt"
    path.write_text("notes")
    with pytest.raises(InputError, match="not a record"):
        RecordWriter(path, existing="append")
    assert path.read_text() == "notes"


def test_a_full_disk_leaves_the_file_that_was_to_be_replaced(tmp_path, simulated, monkeypatch):
    path = tmp_path / "r.jsonl"
    with RecordWriter(path) as writer:
        writer.write(simulated)

    def fill_up(fd: int, data: bytes, offset: int) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with RecordWriter(path, existing="replace") as writer:
        with monkeypatch.context() as patch:
            patch.setattr(record_module.os, "pwrite", fill_up)
            with pytest.raises(InputError, match="earlier rows are intact"):
                writer.write(simulated)
        assert read_records(path) == [simulated]
        assert list(tmp_path.iterdir()) == [path]
        writer.write(simulated)  # room was made
        writer.write(simulated)
    assert read_records(path) == [simulated, simulated]


def test_dishonest_records_cannot_be_made(simulated, measured):
    time = measured.transfer_measurement
    with pytest.raises(ValueError, match="has no time"):
        dataclasses.replace(simulated, transfer_measurement=time)
    with pytest.raises(ValueError, match="has no time"):
        dataclasses.replace(simulated, preprocess={"scan": StepCost(None, time)})
    with pytest.raises(ValueError, match="needs a passed check"):
        dataclasses.replace(measured, check=Check(False, 2.0, 1.0))
    with pytest.raises(ValueError, match="needs a passed check"):
        dataclasses.replace(measured, check=None, transfer_measurement=None)  # its steps were timed
    with pytest.raises(ValueError, match="counters come from the simulated device"):
        dataclasses.replace(measured, transfer_counters=simulated.transfer_counters)
    with pytest.raises(ValueError, match="skipped"):
        dataclasses.replace(simulated, skipped_because="cannot exist")
    with pytest.raises(ValueError, match="sample"):
        Measurement((), "cold", 0, "never began")
    with pytest.raises(ValueError, match="sample"):
        Measurement((math.nan,), "cold", 0, "precision")


def test_status(simulated):
    finding = Finding("race", "p2g", "two warps write s[3]")
    replace = dataclasses.replace
    assert simulated.status == "ok"
    assert replace(simulated, check=None).status == "unchecked"
    assert replace(simulated, check=Check(False, 2.0, 1.0)).status == "wrong"
    assert replace(simulated, findings=(finding,)).status == "findings"
    assert replace(simulated, failed_because="bad opcode").status == "broken"


def test_derived_numbers(simulated, measured):
    time = measured.transfer_measurement
    assert time.median == 2e-3
    assert time.quartiles == pytest.approx((1.5e-3, 2.5e-3))
    assert time.noise == pytest.approx(0.5)
    assert simulated.node_visits == 64_000
    assert simulated.check.ratio == pytest.approx(0.1)
    assert Check(True, 0.0, 0.0).ratio == 0
    assert Check(False, 1.0, 0.0).ratio == math.inf
    assert total_cost(simulated.preprocess.values()).counters.total.warp_inst == 200
    assert total_cost([StepCost(None, time), StepCost(None, time)]).measurement.median == pytest.approx(4e-3)
    assert total_cost([StepCost(None, time), StepCost()]).measurement is None  # a missing part: no total
    assert total_cost([]) == StepCost()


def test_line_texts_follow_line_marks():
    source = '#define N 4\n#line 1 "k.cu"\nint a;\n  int b;\n#line 7 "common.cuh"\nint c;\n#line 5 "k.cu"\nint d;'
    wanted = [SourceLine("k.cu", 2), SourceLine("common.cuh", 7), SourceLine("k.cu", 5), SourceLine("k.cu", 99)]
    assert line_texts(source, wanted) == {wanted[0]: "int b;", wanted[1]: "int c;", wanted[2]: "int d;"}


def test_a_compiled_kernel_names_its_lines_as_the_source_does(tmp_path, monkeypatch):
    """Wherever it is compiled: a record must not depend on the working directory."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPMBENCH_CACHE_DIR", str(tmp_path))
    text = '#line 1 "header.cuh"\n__device__ int twice(int x) { return 2 * x; }\n#line 1 "k.cu"\n'
    text += 'extern "C" __global__ void k(int* a) {\n  a[threadIdx.x] = twice(a[threadIdx.x]);\n}\n'
    ptx = compile_cuda(text, "sm_52", ("-lineinfo",), name="k.cu")
    files = set(re.findall(r'\.file\s+\d+\s+"([^"]*)"', ptx))
    assert files
    assert files <= {"k.cu", "header.cuh"}
    line = SourceLine("k.cu", 2)
    assert line_texts(text, [line]) == {line: "a[threadIdx.x] = twice(a[threadIdx.x]);"}


def test_summaries_take_numpy_values(simulated):
    class Result:
        passed, worst_error, allowed = np.bool_(True), np.float32(0.5), np.float64(1)
        worst_node, conserved = np.array([1, 2, 3]), {"mass": np.float64(1e-9)}

    check = Check.of(Result)
    assert check == Check(True, 0.5, 1.0, (1, 2, 3), {"mass": 1e-9})

    class Dataset:
        name, recipe, seed, position, grid = "d", {"k": 1}, 0, np.zeros((5, 3)), Grid((4, 4, 4), 1.0)
        fingerprint, statistics = "0", {"mean": np.float64("nan"), "histogram": np.arange(3)}

    summary = DatasetSummary.of(Dataset)
    assert summary.n == 5
    assert summary.statistics["histogram"] == [0, 1, 2]
    back = from_json(to_json(dataclasses.replace(simulated, check=check, dataset=summary)))
    assert math.isnan(back.dataset.statistics["mean"])
    assert back.dataset.statistics["histogram"] == [0, 1, 2]


def test_environment(environment):
    assert environment.argv == ("mpmbench", "run", "--quick")
    assert environment.seed == 7
    assert environment.cores >= 1
    assert environment.numpy == np.__version__
    assert environment.gpu == {}
    assert Environment.capture(gpu={"name": "GTX 970"}).gpu == {"name": "GTX 970"}


def test_data_frame(tmp_path, simulated, measured):
    for name, record in (("a.jsonl", simulated), ("b.jsonl", measured)):
        with RecordWriter(tmp_path / name) as writer:
            writer.write(record)
    frame = load_records([tmp_path / "a.jsonl", tmp_path / "b.jsonl"])
    assert list(frame.device) == ["simulated", "cuda:0"]
    assert frame.transfer_sectors[0] == 12
    assert frame.preprocess_warp_inst[0] == 200
    assert frame.step_scan_lane_inst[0] == 3000
    assert frame.transfer_median_s[1] == 2e-3
    assert math.isnan(frame.transfer_median_s[0])  # no time on the simulated device
    assert frame.axis_block_shape[0] == "8x4x4"
    assert frame.environment_seed[0] == 7
    assert len(load_records(tmp_path / "a.jsonl")) == 1
