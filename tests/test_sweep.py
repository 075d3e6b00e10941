"""Sweeps: parts on slots, what a failed part leaves, one journal of many, and what a cluster is told."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest
from click.testing import CliRunner
from submitit import AutoExecutor
from submitit.slurm.slurm import SlurmExecutor

from mpmbench import cli_sweep, sweep
from mpmbench.cli import main
from mpmbench.cli import run as run_command
from mpmbench.protocol import rounds
from mpmbench.record import RecordWriter, read_records
from mpmbench.runner import resume_key
from mpmbench.sweep import Outcome, Part, Slot, Submitted, run_parts

PROBLEM = ["--particles", "60", "--grid-shape", "12x12x12", "--quick", "-b", "p2g_global_*", "-b", "g2p_global_gather",
           "--dataset", "random", "--dataset", "uniform_cube"]  # fmt: skip
COUNTED = [*PROBLEM, "-d", "simulated"]
MODEL = "NVIDIA H100"
BRIEF = rounds.Rules(passes=2, min_rounds=2, max_rounds=2, time_limit=0.1, warmup_seconds=0.0, warmup_limit=0.0)


def invoke(*words: object, code: int = 0) -> str:
    result = CliRunner().invoke(main, [str(word) for word in words])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == code, result.output
    return result.output


def refusal(*words: object) -> str:
    lines = invoke(*words, code=2).strip().splitlines()
    assert len(lines) == 1, lines
    return lines[0]


def keys(path: Path) -> list:
    return [resume_key(record) for record in read_records(path)]


def content(path: Path) -> list:
    return [dataclasses.replace(r, environment=None, host_seconds=0.0) for r in read_records(path)]


@pytest.fixture(scope="module")
def single(tmp_path_factory) -> Path:
    """The journal of one run of everything."""
    path = tmp_path_factory.mktemp("single") / "rows.jsonl"
    invoke("run", *COUNTED, "--json", path)
    return path


@pytest.fixture
def in_process(monkeypatch):
    """Parts run here, one after another, by submitit's debug executor. Returns what they are called with."""
    called: list[tuple[tuple[str, ...], dict]] = []

    def work(words, environment):
        called.append((words, dict(environment)))
        return sweep.Command(words, {})

    monkeypatch.setattr(
        sweep, "local_launcher", lambda folder: Submitted(AutoExecutor(folder=folder, cluster="debug"), work)
    )
    return called


@pytest.fixture
def gpus(monkeypatch, single):
    """A machine with GPUs of the models in the list that this returns; each row takes the place of a timed one."""
    models = [MODEL, MODEL, "NVIDIA A100"]

    def here():
        return [(Slot(f"gpu{i}", {"CUDA_VISIBLE_DEVICES": str(i)}), model) for i, model in enumerate(models)]

    def work(words, environment):
        number = int(environment["CUDA_VISIBLE_DEVICES"])
        return lambda: time_rows(list(words), number, models[number], read_records(single))

    monkeypatch.setattr(sweep, "gpus_here", here)
    monkeypatch.setattr(
        sweep, "local_launcher", lambda folder: Submitted(AutoExecutor(folder=folder, cluster="debug"), work)
    )
    return models


def time_rows(words: list[str], number: int, model: str, records: list) -> int:
    """Stands for ``mpmbench run -d cuda``: the rows of the part, as that GPU would leave them."""
    assert words[words.index("--device") + 1] == "cuda"
    part, _, parts = words[words.index("--shard") + 1].partition("/")
    path = Path(words[words.index("--json") + 1])
    known = {record.variant for record in read_records(path)} if path.exists() else set()
    with RecordWriter(path, "append") as writer:
        variants = list(dict.fromkeys(record.variant for record in records))
        contests = [[v for v in variants if v.startswith("p2g")], [v for v in variants if v.startswith("g2p")]]
        mine = [v for contest in (contests * 2)[int(part) - 1 :: int(parts)] for v in contest]
        for record in records:
            if record.variant in mine and record.variant not in known:
                gpu = {"name": model, "uuid": str(number)}
                environment = dataclasses.replace(record.environment, gpu=gpu)
                writer.write(
                    dataclasses.replace(
                        record,
                        device="cuda:0",
                        arch="sm_90",
                        environment=environment,
                        cache="cold",
                        transfer_counters=None,
                        preprocess={},
                        finish={},
                        line_texts={},
                        check=None,
                        failed_because="no clock in this test",
                    )
                )
    return 1


# --- the real thing ---------------------------------------------------------------------------------------------------


def test_submitit_s_local_executor(tmp_path, single):
    out = tmp_path / "swept"
    told = invoke("sweep", "--out", out, *COUNTED, "--shards", 2, "--workers", 2)
    assert content(out / "rows.jsonl") == content(single)  # each row once, in a single run's order
    assert "[6/6] rows" in told
    assert "<html" in (out / "report.html").read_text()
    assert "p2g_global_node" in (out / "report.md").read_text()
    assert list((out / "shards" / "logs").glob("*_result.pkl"))  # submitit was there
    for record in read_records(out / "rows.jsonl"):
        assert record.environment.argv[:2] == ("mpmbench", "run")


def test_plain_processes_where_submitit_is_missing(tmp_path, single, monkeypatch):
    monkeypatch.setitem(sys.modules, "submitit", None)
    out = tmp_path / "swept"
    assert "pip install 'mpmbench[slurm]'" in refusal("sweep", "--out", out, *COUNTED, "--executor", "slurm")
    invoke("sweep", "--out", out, *COUNTED, "--shards", 3, "--workers", 2)
    assert content(out / "rows.jsonl") == content(single)
    assert (out / "shards" / "logs" / "2of3.err").read_text().count("ok") == 2


def test_sigterm_stops_all_parts_and_resume_goes_on(tmp_path, single):
    out = tmp_path / "swept"
    words = ["sweep", "--out", str(out), *COUNTED, "--shards", "2", "--workers", "2"]
    process = subprocess.Popen(
        [sys.executable, "-m", "mpmbench", *words],
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_IGN),  # as in the background of a script
    )
    while len(list((out / "shards" / "logs").glob("*_log.out"))) < 2:
        assert process.poll() is None
        time.sleep(0.02)
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "Traceback" not in errors
    assert "the same command with --resume goes on" in errors
    assert sum(len(path.read_bytes().splitlines()) for path in (out / "shards").glob("*.jsonl")) < 6
    invoke(*words, "--resume")  # refused if a part still wrote
    assert content(out / "rows.jsonl") == content(single)


# --- parts and slots --------------------------------------------------------------------------------------------------


def test_parts_carry_every_option_of_run():
    given = ["-b", "p2g_*", "--dataset", "a", "--dataset", "b", "-a", "cache=[hot,cold]", "--particles", "0",
             "--origin", "0", "-1", "2.5", "--quick", "--dx", "0.5"]  # fmt: skip
    options = cli_sweep.shared_options(run_command)
    context = run_command.make_context("run", list(given))
    words = cli_sweep.words_of(options, context.params)
    again = run_command.make_context("run", list(words))
    assert again.params == context.params
    left_out = {option.name for option in run_command.params} - {option.name for option in options}
    assert left_out >= {"json_path", "html_path", "md_path", "csv_path", "gpu_names", "shard", "resume", "dry_run"}
    assert not left_out & {"patterns", "variant_dirs", "rigorous", "baseline", "preset_name", "seed", "arch"}


def test_resume_runs_what_is_missing(tmp_path, single, in_process):
    out = tmp_path / "swept"
    invoke("sweep", "--out", out, *COUNTED, "--shards", 2)
    journal = out / "shards" / "2of2.jsonl"
    lines = journal.read_bytes().splitlines(keepends=True)
    journal.write_bytes(lines[0] + lines[1][:-9])
    assert "--resume" in refusal("sweep", "--out", out, *COUNTED, "--shards", 2)
    assert "other options" in refusal("sweep", "--out", out, *COUNTED, "--shards", 3, "--resume")
    with pytest.warns(UserWarning, match="torn"):
        told = invoke("sweep", "--out", out, *COUNTED, "--shards", 2, "--resume", "--workers", 1)
    assert "[6/6] rows" in told
    assert journal.read_bytes().startswith(lines[0])
    assert content(out / "rows.jsonl") == content(single)


def test_a_failed_part_is_told_and_the_others_rows_stay(tmp_path, single, monkeypatch):
    def work(words, environment):
        return sweep.Command(words if "1/2" not in words else (*words, "--baseline", "nothing"), environment)

    out = tmp_path / "swept"
    words = ["sweep", "--out", out, *COUNTED, "--shards", 2, "--workers", 1]
    with monkeypatch.context() as patch:
        patch.setattr(sweep.Submitted, "start", lambda self, part, slot: sweep._Job(
            self.executor.submit(work(part.words, slot.environment))))  # fmt: skip
        told = invoke(*words, code=2)
    assert "part 1of2 ended with exit code 2 after 0 of 3 rows:" in told
    assert "no row is called 'nothing'" in told
    assert "submitit" not in told
    assert Counter(keys(out / "rows.jsonl")) == Counter(keys(out / "shards" / "2of2.jsonl"))
    assert len(keys(out / "rows.jsonl")) == 3
    invoke(*words, "--resume")
    assert content(out / "rows.jsonl") == content(single)


def test_a_killed_part_is_a_failed_one(tmp_path):
    part = Part("1of1", (), (Slot("worker0"),), tmp_path / "rows.jsonl", 1)
    executor = AutoExecutor(folder=tmp_path, cluster="local")
    launcher = Submitted(executor, lambda words, environment: lambda: os.kill(os.getpid(), signal.SIGKILL))
    (outcome,) = run_parts([part], launcher, poll=0.05)
    assert (outcome.code, outcome.failed) == (None, True)


def test_a_wrong_row_is_no_failed_part(tmp_path):
    part = Part("1of1", (), (), tmp_path / "rows.jsonl", 1)
    part.journal.write_text("row\n")
    assert not Outcome(part, 4, "").failed
    assert not Outcome(part, 1, "").failed
    assert Outcome(part, 2, "").failed
    assert Outcome(dataclasses.replace(part, rows=2), 0, "").failed


@dataclasses.dataclass
class Clocked:
    """A launcher whose parts end after so many looks; notes who was running together."""

    looks: int = 3
    running: dict = dataclasses.field(default_factory=dict)
    together: list = dataclasses.field(default_factory=list)
    stopped: list = dataclasses.field(default_factory=list)

    def batch(self):
        import contextlib

        return contextlib.nullcontext()

    def start(self, part, slot):
        assert slot not in self.running.values(), "two parts on one slot"
        self.running[part.name] = slot
        self.together.append(sorted(self.running))
        launcher, left = self, [self.looks]

        class Running:
            def done(self):
                left[0] -= 1
                if left[0] <= 0:
                    launcher.running.pop(part.name, None)
                return left[0] <= 0

            def outcome(self, part):
                return Outcome(part, 0, "")

            def stop(self):
                left[0] = 0
                launcher.stopped.append(part.name)

        return Running()


def parts_on(tmp_path, *slots: tuple[Slot, ...]) -> list[Part]:
    return [Part(f"p{i}", (), where, tmp_path / f"{i}.jsonl", 0) for i, where in enumerate(slots)]


def test_never_two_parts_on_one_gpu(tmp_path):
    a, b = Slot("gpu0"), Slot("gpu1")
    launcher = Clocked()
    outcomes = run_parts(parts_on(tmp_path, (a,), (a,), (b,), (a, b)), launcher, poll=0)
    assert len(outcomes) == 4
    assert max(map(len, launcher.together)) == 2
    assert ["p0", "p2"] in launcher.together


def test_one_gpu_at_a_time(tmp_path):
    launcher = Clocked()
    run_parts(parts_on(tmp_path, (Slot("gpu0"),), (Slot("gpu1"),)), launcher, at_once=1, poll=0)
    assert launcher.together == [["p0"], ["p1"]]


def test_an_interruption_stops_what_runs(tmp_path):
    def tick(rows, ended):
        raise KeyboardInterrupt

    launcher = Clocked(looks=9)
    with pytest.raises(KeyboardInterrupt):
        run_parts(parts_on(tmp_path, (Slot("gpu0"),), (Slot("gpu1"),)), launcher, tick=tick, poll=0)
    assert launcher.stopped == ["p0", "p1"]


# --- GPUs -------------------------------------------------------------------------------------------------------------


def test_every_gpu_runs_every_case(tmp_path, gpus):
    out = tmp_path / "swept"
    told = invoke("sweep", "--out", out, *PROBLEM, "--gpus", "0,2", code=1)  # rows without a time are broken rows
    assert "with exit code" not in told  # and no failed part
    rows = read_records(out / "rows.jsonl")
    assert [r.environment.gpu["name"] for r in rows] == [MODEL] * 6 + ["NVIDIA A100"] * 6
    assert keys(out / "rows.jsonl")[:6] == keys(out / "rows.jsonl")[6:]
    first = [(r.variant, r.dataset.name) for r in rows[:3]]  # contest by contest, the baseline first
    assert first == [("p2g_global_atomic", "random"), ("p2g_global_node", "random"), ("g2p_global_gather", "random")]
    assert (out / "shards" / "gpu2.jsonl").exists()


def test_gpus_of_one_model_share_the_cases_out(tmp_path, gpus):
    out = tmp_path / "swept"
    told = invoke("sweep", "--out", out, *PROBLEM, "--gpus", "0,1", "--split", code=1)
    assert "with exit code" not in told  # parts made as many rows as were expected: contests were not torn apart
    assert Counter(keys(out / "rows.jsonl")).most_common(1)[0][1] == 1
    assert len(keys(out / "rows.jsonl")) == 6
    assert {r.environment.gpu["uuid"] for r in read_records(out / "rows.jsonl")} == {"0", "1"}
    assert "gpu2 is NVIDIA A100" in refusal("sweep", "--out", out, *PROBLEM, "--split", "--resume")


def test_gpus_are_named_as_they_are_here(tmp_path, gpus, monkeypatch):
    words = ["sweep", "--out", tmp_path / "swept", *PROBLEM]
    assert "3 parts, 18 rows" in invoke(*words, "--dry-run")
    assert "gpu1-2of2" in invoke(*words, "--dry-run", "--shards", 2)
    assert "takes all, none, or some of 0,1,2" in refusal(*words, "--gpus", "3")
    assert "twice" in refusal(*words, "--gpus", "1,1")
    assert "--gpus is for -d cuda" in refusal(*words, "--gpus", "1", "-d", "simulated")
    assert "write -d cuda" in refusal(*words, "-d", "cuda:1")
    assert "one process at a time" in refusal(*words, "--workers", "2")
    assert "swept apart" in refusal(*words, "-d", "cuda", "-d", "simulated")
    monkeypatch.setattr(sweep, "gpus_here", list)
    assert "no GPU" in refusal(*words, "--gpus", "0")
    assert "6 rows" in invoke(*words, "--dry-run")  # simulated


def test_visible_devices_are_kept(monkeypatch):
    """GPU 1 of a process that was given cards 4 and 6 is card 6."""
    asked = []

    def ask(command, **how):
        asked.append(how["env"])
        return subprocess.CompletedProcess(command, 0, json.dumps(["A", "B"]), "")

    monkeypatch.setattr(sweep.subprocess, "run", ask)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "4,6")
    assert [(slot.environment["CUDA_VISIBLE_DEVICES"], name) for slot, name in sweep.gpus_here()] == [
        ("4", "A"), ("6", "B")]  # fmt: skip
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES")
    slots = [slot for slot, _ in sweep.gpus_here()]
    assert slots[1].environment == {"CUDA_VISIBLE_DEVICES": "1", "CUDA_DEVICE_ORDER": "PCI_BUS_ID"}
    assert asked[1]["CUDA_DEVICE_ORDER"] == "PCI_BUS_ID"


def test_wall_clock_has_no_neighbours(tmp_path):
    words = ["sweep", "--out", tmp_path / "swept", *PROBLEM, "-d", "cpu", "-a", "cache=[hot,cold]", "--dry-run"]
    assert "neighbours disturb" in refusal(*words, "--workers", "2")
    told = invoke(*words, "--shards", "2")
    assert "2 parts, 12 rows" in told
    assert told.count("on worker0:") == 2


def test_searched_rows_are_merged_in_order(tmp_path, in_process, monkeypatch):
    monkeypatch.setattr(rounds, "QUICK", BRIEF)
    brief = ["--particles", "60", "--grid-shape", "12x12x12", "--quick", "-b", "p2g_global_atomic",
             "-b", "p2g_block_sync",
             "-a", "batching=1", "-a", "cache=hot", "-d", "cpu", "--tune", "2"]  # fmt: skip
    out = tmp_path / "swept"
    invoke("sweep", "--out", out, *brief)
    rows = read_records(out / "rows.jsonl")
    assert [row.variant for row in rows] == ["p2g_global_atomic", "p2g_block_sync"]
    assert rows[1].tuning.budget == 2
    assert "--tune needs times" in refusal("sweep", "--out", out, *PROBLEM, "-d", "simulated", "--tune", "2")


# --- SLURM ------------------------------------------------------------------------------------------------------------


@pytest.fixture
def cluster(monkeypatch):
    """A login node: srun is there, nothing is sent."""
    monkeypatch.setattr(SlurmExecutor, "affinity", classmethod(lambda cls: 2))


def script(launcher: Submitted, jobs: int = 4) -> list[str]:
    executor = launcher.executor._executor
    executor.parameters["map_count"] = jobs  # as submitit does for a batch
    return executor._make_submission_file_text("command", "0").splitlines()


def test_what_slurm_is_told(tmp_path, cluster):
    options = ("account=me", "constraint=h100", "exclusive", "mem=16GB", "setup=module load cuda", "reservation=r1")
    lines = script(sweep.slurm_launcher(tmp_path, 1, 90, "gpu", 3, options))
    for wanted in ("--partition=gpu", "--time=90", "--gpus-per-node=1", "--array=0-3%3", "--account=me", "--exclusive",
                   "--constraint=h100", "--mem=16GB", "--reservation=r1", "--job-name=mpmbench"):  # fmt: skip
        assert f"#SBATCH {wanted}" in lines, wanted
    assert "module load cuda" in lines


def test_a_gpu_is_asked_for_once_and_only_where_it_is_needed(tmp_path, cluster):
    text = "\n".join(script(sweep.slurm_launcher(tmp_path, 1, 90, None, None, ("gres=gpu:a100:1",))))
    assert "--gres=gpu:a100:1" in text
    assert "gpus" not in text
    assert not any("#SBATCH --gpu" in line for line in script(sweep.slurm_launcher(tmp_path, 0, 90, None, None)))


def test_slurm_refusals(tmp_path, cluster, monkeypatch):
    words = ["sweep", "--out", tmp_path / "swept", *PROBLEM, "--executor", "slurm"]
    assert "leave out --gpus" in refusal(*words, "--gpus", "0")
    assert "write it as key=value" in refusal(*words, "--slurm", "account=")
    monkeypatch.setattr(SlurmExecutor, "affinity", classmethod(lambda cls: -1))
    assert "no SLURM here" in refusal(*words)
    assert not (tmp_path / "swept" / "sweep.json").exists()


def test_slurm_jobs_have_a_gpu_each_and_share_the_cases_out(tmp_path, cluster):
    told = invoke("sweep", "--out", tmp_path / "swept", *PROBLEM, "--executor", "slurm", "--shards", 2, "--dry-run")
    assert "2 parts, 6 rows" in told
    assert "--device cuda" in told


def test_a_job_whose_time_is_up_is_queued_again(tmp_path):
    command = sweep.Command(("run",), {})
    assert command.checkpoint().function == command
