"""Nsight Compute beside the model. The CSV files here are made by hand after its format: none was measured."""

from __future__ import annotations

import shlex

import pytest
from profiled import modelled_time, profile, record

from mpmbench import ncu
from mpmbench.errors import InputError
from mpmbench.gpu import get_gpu
from mpmbench.report.table import Kind

RAW = """==PROF== Connected to process 7 (/usr/bin/python3.11)
64 rows: 64 ok
==PROF== Disconnected from process 7
"ID","Process ID","Process Name","Host Name","Kernel Name","Context","Stream","Block Size","Grid Size","Device","CC",\
"dram__sectors_read.sum","gpu__time_duration.sum","l1tex__t_sectors_pipe_lsu_mem_global_op_atom.sum",\
"l1tex__t_sectors_pipe_lsu_mem_global_op_red.sum","launch__registers_per_thread","lts__t_sector_hit_rate.pct",\
"smsp__inst_executed.sum","sm__unheard_of.sum"
"","","","","","","","","","","","sector","nsecond","sector","sector","register/thread","%","inst","furlong"
"0","7","python3.11","host","p2g_block_sync(Domain, int)","1","7","(128, 1, 1)","(900, 1, 1)","0","9.0",\
"1,500,000","2,000,000","0","4,500,000","48","50.25","16,000,000","oddities"
"1","7","python3.11","host","p2g_block_sync(Domain, int)","1","7","(128, 1, 1)","(900, 1, 1)","0","9.0",\
"1,500,000","4,000,000","0","4,500,000","48","50.25","16,000,000","1"
"""

_DETAILS_HEAD = (
    '"ID","Process ID","Process Name","Host Name","Kernel Name","Context","Stream","Block Size","Grid Size","Device",'
    '"CC","Section Name","Metric Name","Metric Unit","Metric Value"\n'
)


def details(*rows: tuple[str, str, str], kernel: str = "p2g_block_sync", capability: str = "9.0") -> str:
    """A details page of one launch: metric, unit, value."""
    start = f'"0","7","python3.11","host","{kernel}","1","7","(128, 1, 1)","(900, 1, 1)","0","{capability}"'
    body = [f'{start},"Command line profiler metrics","{name}","{unit}","{value}"' for name, unit, value in rows]
    return _DETAILS_HEAD + "\n".join(body) + "\n"


def read(tmp_path, text: str) -> dict[str, ncu.Measured]:
    path = tmp_path / "ncu.csv"
    path.write_text(text, encoding="utf-8")
    return ncu.read_csv(path)


# ---- reading ---------------------------------------------------------------------------------------------------


def test_raw_page(tmp_path):
    (measured,) = read(tmp_path, RAW).values()
    assert measured.kernel == "p2g_block_sync"
    assert measured.capability == "9.0"
    assert measured.launches == 2
    assert measured.values == {
        "gpu__time_duration.sum": pytest.approx(3e-3),  # median of 2 and 4 ms
        "dram__sectors_read.sum": 1_500_000,
        "l1tex__t_sectors_pipe_lsu_mem_global_op_atom.sum": 0,
        "l1tex__t_sectors_pipe_lsu_mem_global_op_red.sum": 4_500_000,
        "launch__registers_per_thread": 48,
        "lts__t_sector_hit_rate.pct": 50.25,
        "smsp__inst_executed.sum": 16_000_000,
    }


def test_details_page(tmp_path):
    rows = (
        ("gpu__time_duration.sum", "usecond", "2,500.50"),
        ("smsp__inst_executed.sum", "inst", "16,000,000"),
        ("sm__unheard_of.sum", "furlong", "many"),
        ("dram__sectors_write.sum", "sector", "(!) n/a"),
    )
    (measured,) = read(tmp_path, details(*rows)).values()
    assert measured.values == {"gpu__time_duration.sum": pytest.approx(2.5005e-3), "smsp__inst_executed.sum": 16e6}
    assert measured.launches == 1


@pytest.mark.parametrize(
    ("unit", "seconds"), [("nsecond", 3e-9), ("ns", 3e-9), ("us", 3e-6), ("msecond", 3e-3), ("second", 3.0)]
)
def test_units_of_time(tmp_path, unit, seconds):
    (measured,) = read(tmp_path, details(("gpu__time_duration.sum", unit, "3"))).values()
    assert measured.values["gpu__time_duration.sum"] == pytest.approx(seconds)


def test_kernels_stay_apart(tmp_path):
    text = details(("smsp__inst_executed.sum", "inst", "1")) + details(
        ("smsp__inst_executed.sum", "inst", "2"), kernel="p2g_block_pull"
    ).removeprefix(_DETAILS_HEAD)
    assert {name: m.values["smsp__inst_executed.sum"] for name, m in read(tmp_path, text).items()} == {
        "p2g_block_sync": 1, "p2g_block_pull": 2,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", r"ncu\.csv is empty"),
        (" \n\n", r"ncu\.csv is empty"),
        ("a,b\n1,2\n", "is no CSV of Nsight Compute"),
        ("\x00\xff", "is no CSV of Nsight Compute"),
        ("==ERROR== ERR_NVGPUCTRPERM - permission\n", "was not allowed to read the counters"),
        ("==WARNING== No kernels were profiled.\n", "profiled no kernel"),
        (RAW.split('"","",')[0], "has no metric that mpmbench knows"),
        (details(("Memory Throughput", "%", "12")), "has no metric that mpmbench knows"),
        (details(("smsp__inst_executed.sum", "inst", "61,3")), r"cannot read smsp__inst_executed\.sum = '61,3'"),
        (details(("smsp__inst_executed.sum", "inst", "1.600.000")), "run ncu with LC_ALL=C"),
        (details(("smsp__inst_executed.sum", "Ginst", "1")), "is in 'Ginst': run ncu with --print-units base"),
    ],
)
def test_a_bad_file_is_one_clear_line(tmp_path, text, words):
    with pytest.raises(InputError, match=words) as refused:
        read(tmp_path, text)
    assert "\n" not in str(refused.value)


def test_a_missing_file(tmp_path):
    with pytest.raises(InputError, match=r"cannot read .*none\.csv: no such file"):
        ncu.read_csv(tmp_path / "none.csv")


# ---- beside the model ------------------------------------------------------------------------------------------


def made(arch: str = "sm_90"):
    time = modelled_time("h100", "issue", 1.5e-3)
    return record("p2g_block_sync", (profile(time, sectors=(5_000_000, 3_001_000)),), arch=arch)


def test_side_by_side(tmp_path):
    (measured,) = read(tmp_path, RAW).values()
    ours = made()
    table = ncu.compare(ours, ours.modelled["h100"], measured)
    assert [c.kind for c in table.columns[1:5]] == [Kind.SIMULATED, Kind.MODELLED, Kind.PREDICTED, Kind.MEASURED]
    rows = {row.cells[0].value: [cell.value for cell in row.cells[1:]] for row in table.rows}
    assert rows["duration"] == [None, "1.50 ms", None, "3 ms", pytest.approx(0.5)]
    assert rows["warp instructions"] == ["20,000,000", None, None, "16,000,000", pytest.approx(1.25)]
    assert rows["global atomic sectors"] == ["9,000,000", None, None, "4,500,000", pytest.approx(2)]
    assert rows["DRAM sectors read"] == [None, "3,000,000", None, "1,500,000", pytest.approx(2)]
    assert rows["registers / thread"] == [None, None, "40", "48", pytest.approx(40 / 48)]
    assert set(rows) == {
        "duration", "warp instructions", "global atomic sectors", "DRAM sectors read", "registers / thread",
        "L2 hit rate [%]",
    }  # fmt: skip
    assert "H100" in table.title


def test_a_file_of_another_gpu_is_refused(tmp_path):
    (measured,) = read(tmp_path, RAW).values()
    ours = made("sm_80")
    with pytest.raises(InputError, match=r"compute capability 9\.0, but h100 is 8\.0"):
        ncu.compare(ours, ours.modelled["h100"], measured)


def test_nothing_measured_is_no_division():
    empty = ncu.Measured("p2g_block_sync", "", 1, {"dram__sectors_read.sum": 0.0})
    ours = made()
    (row,) = ncu.compare(ours, ours.modelled["h100"], empty).rows
    assert row.cells[-1].value is None


def test_every_counter_is_of_a_kind_with_a_column():
    ours = made()
    everything = {name: 7.0 for counter in ncu.COUNTERS for name in counter.metrics}
    table = ncu.compare(ours, ours.modelled["h100"], ncu.Measured("p2g_block_sync", "9.0", 3, everything))
    assert len(table.rows) == len(ncu.COUNTERS)
    assert all(row.cells[-1].value is not None for row in table.rows)


# ---- the command line ------------------------------------------------------------------------------------------


def test_the_line_measures_what_is_read_back():
    words = shlex.split(ncu.command("p2g_block_sync", ["-b", "p2g_block_sync"], "a b.csv"))
    assert words[:2] == ["LC_ALL=C", "ncu"]
    assert words[words.index("--kernel-name") + 1] == "regex:^p2g_block_sync$"
    metrics = words[words.index("--metrics") + 1].split(",")
    assert len(metrics) == len(set(metrics))
    assert set(metrics) == {name for counter in ncu.COUNTERS for name in counter.metrics}
    assert words[words.index("--log-file") + 1] == "a b.csv"
    assert words[words.index("mpmbench") :] == ["mpmbench", "run", "-b", "p2g_block_sync", "-d", "cuda"]


def test_gpus_before_volta_are_not_measured():
    assert not ncu.supports(get_gpu("gtx970"))
    assert ncu.supports(get_gpu("v100"))
    assert "sm_70 and later; NVIDIA GeForce GTX 970 is sm_52" in ncu.why_unsupported(get_gpu("gtx970"))
