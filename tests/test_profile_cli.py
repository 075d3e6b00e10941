"""``mpmbench profile`` from the outside, with made-up profiles in the place of the engine's."""

from __future__ import annotations

import dataclasses
import shlex

import pytest
from click.testing import CliRunner
from profiled import modelled_time, profile, record, strategies
from test_profile_ncu import RAW, details

from mpmbench import profile as engine
from mpmbench.cli import main
from mpmbench.cli_profile import parse_gpus
from mpmbench.record import read_records


def invoke(*arguments: str):
    return CliRunner().invoke(main, ["profile", *map(str, arguments)])


@pytest.fixture
def modelled(monkeypatch):
    """What the engine side is asked for, and the records that it gives."""
    asked: dict = {"records": strategies()}

    def made_up(cases, gpus, progress, keep, known):
        asked.update(cases=cases, gpus=gpus)
        progress("p2g_block_sync", 1, 1)
        for made in asked["records"]:
            keep(made)
        return asked["records"]

    monkeypatch.setattr(engine, "profile_cases", made_up)
    return asked


def test_one_line_and_one_sentence_per_strategy(modelled):
    ran = invoke("-b", "p2g_*", "--gpu", "gtx970", "--particles", 100)
    assert ran.exit_code == 0, ran.output
    lines = ran.stdout.splitlines()
    at = next(i for i, line in enumerate(lines) if line.startswith("  p2g_block_sync"))
    assert lines[at] == (
        "  p2g_block_sync: 3.05 ms (2.29 to 3.81 ms) modelled on NVIDIA GeForce GTX 970; bound: issue; "
        "44 of 64 warps per SM, limited by shared memory"
    )
    assert lines[at + 1].startswith("    Bound by instruction issue, 100 % of the time or, within the model's range")
    assert [gpu.name for gpu in modelled["gpus"]] == ["gtx970"]
    assert {case.name for case in modelled["cases"]} >= {"p2g_block_sync", "p2g_global_atomic"}


def test_files(modelled, tmp_path):
    json_path, html, md = (tmp_path / name for name in ("r.jsonl", "r.html", "r.md"))
    ran = invoke("--gpu", "gtx970", "--json", json_path, "--html", html, "--md", md)
    assert ran.exit_code == 0, ran.output
    assert read_records(json_path) == modelled["records"]
    assert "What would it do on my GPU?" in html.read_text()
    assert "## Profile: P2G on uniform" in md.read_text().replace("\\", "")


def test_several_gpus_in_either_form(modelled):
    assert invoke("--gpu", "h100,a100", "--gpu", "gtx970,h100").exit_code == 0
    assert [gpu.name for gpu in modelled["gpus"]] == ["h100", "a100", "gtx970"]
    assert parse_gpus([]) == []


def test_a_wrong_result_is_exit_code_4(modelled):
    good = modelled["records"][0]
    wrong = dataclasses.replace(good, modelled=None, check=dataclasses.replace(good.check, passed=False))
    modelled["records"] = [wrong]
    assert invoke("--gpu", "gtx970").exit_code == 4


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "profile needs --gpu NAME: valid are a100, gtx970"),
        (["--gpu", "gtx971"], "unknown GPU 'gtx971': valid are a100, gtx970"),
        (["--gpu", "gtx970", "-d", "cuda"], "leave out -d"),
        (["--gpu", "gtx970", "--arch", "sm_90"], "leave out --arch"),
        (["--gpu", "gtx970", "-b", "nothing"], "nothing matches 'nothing'"),
        (["--gpu", "gtx970", "--ncu"], "Nsight Compute measures sm_70 and later; NVIDIA GeForce GTX 970 is sm_52"),
        (["--ncu", "-b", "scan_shuffle"], "are for transfers, which are one kernel: leave out scan_shuffle"),
    ],
)
def test_bad_usage_is_one_line(modelled, arguments, words):
    ran = invoke(*arguments)
    assert ran.exit_code == 2, ran.output
    assert words in ran.output
    assert "Traceback" not in ran.output
    assert "cases" not in modelled


# ---- Nsight Compute --------------------------------------------------------------------------------------------


def test_ncu_prints_a_line_that_repeats_the_case_and_runs_nothing(modelled):
    ran = invoke(
        "--ncu", "-b", "p2g_block_sync", "--dataset", "random", "--particles", 5000, "--seed", 3, "-a", "batching=4",
        "-a", "block_shape=4x4x4", "--gpu", "h100,gtx970",
    )  # fmt: skip
    assert ran.exit_code == 0, ran.output
    note, line = ran.stdout.splitlines()
    assert note == "# Nsight Compute measures sm_70 and later; NVIDIA GeForce GTX 970 is sm_52"
    words = shlex.split(line)
    assert words[words.index("--kernel-name") + 1] == "regex:^p2g_block_sync$"
    assert words[words.index("--log-file") + 1] == "p2g_block_sync.csv"
    again = words[words.index("mpmbench") + 2 :]
    assert again == [
        "-b", "p2g_block_sync", "--dataset", "random", "--particles", "5000", "--seed", "3",
        "-a", "block_shape=4x4x4", "-a", "batching=4", "-d", "cuda",
    ]  # fmt: skip
    assert "cases" not in modelled
    dry = CliRunner().invoke(main, ["run", *again[:-2], "-d", "simulated", "--dry-run"])
    assert dry.exit_code == 0, dry.output
    assert "block_shape=4x4x4" in dry.output


def test_each_case_has_a_log_of_its_own(modelled):
    ran = invoke("--ncu", "-b", "p2g_block_sync", "-a", "batching=[1,2]")
    logs = [shlex.split(line)[shlex.split(line).index("--log-file") + 1] for line in ran.stdout.splitlines()]
    assert logs == ["p2g_block_sync-1.csv", "p2g_block_sync-2.csv"]


@pytest.fixture
def measured(tmp_path):
    path = tmp_path / "ncu.csv"
    path.write_text(RAW)
    return path


def test_ncu_csv_beside_the_model(modelled, measured):
    time = modelled_time("h100", "issue", 1.5e-3)
    modelled["records"] = [record("p2g_block_sync", (profile(time),), arch="sm_90")]
    ran = invoke("-b", "p2g_block_sync", "--gpu", "h100", "--ncu-csv", measured)
    assert ran.exit_code == 0, ran.output
    assert "p2g_block_sync on NVIDIA H100 PCIe: model and Nsight Compute" in ran.stdout
    row = next(line for line in ran.stdout.splitlines() if line.startswith("warp instructions"))
    assert row.split() == ["warp", "instructions", "20,000,000", "16,000,000", "1.25×"]
    assert "Simulated instructions are PTX" in ran.stdout


@pytest.mark.parametrize(
    ("text", "arguments", "words"),
    [
        (RAW, ["-b", "p2g_block_pull", "--gpu", "h100"], "has the kernels p2g_block_sync: choose one of them with -b"),
        (RAW, ["-b", "p2g_block_sync", "--gpu", "h100,a100"], "--ncu-csv is of one GPU"),
        (RAW, ["-b", "p2g_block_sync", "--gpu", "gtx970"], "GTX 970 is sm_52: the file cannot be of it"),
        (RAW, ["-b", "p2g_block_sync", "-a", "batching=[1,2]", "--gpu", "h100"], "runs 2 times in this selection"),
        ("", ["-b", "p2g_block_sync", "--gpu", "h100"], "is empty"),
        (details(("x", "", "1")), ["-b", "p2g_block_sync", "--gpu", "h100"], "no metric that mpmbench knows"),
    ],
)
def test_a_file_that_does_not_fit_stops_before_the_simulation(modelled, measured, text, arguments, words):
    measured.write_text(text)
    ran = invoke(*arguments, "--ncu-csv", measured)
    assert ran.exit_code == 2, ran.output
    assert words in ran.output
    assert "cases" not in modelled


def test_the_file_is_not_written_over(modelled, measured):
    ran = invoke("-b", "p2g_block_sync", "--gpu", "h100", "--ncu-csv", measured, "--md", measured)
    assert ran.exit_code == 2
    assert measured.read_text() == RAW
