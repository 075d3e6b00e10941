"""Two files, row by row: NVBench's verdicts, honest matching, no silently different environment."""

from __future__ import annotations

import dataclasses
import json
import math
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from mpmbench import compare as comparing
from mpmbench.cli import main
from mpmbench.compare import Limit, compare, match
from mpmbench.errors import InputError
from mpmbench.nvbench import EVENTS, WALL, write_nvbench
from mpmbench.nvbench_rows import rows_of_records
from mpmbench.record import RecordWriter
from mpmbench.robust_rule import PRESETS
from tests.timed_rows import ENVIRONMENT, GPU, other_axes, samples, simulated, timed, untimed, wall

pytest.importorskip("cuda.bench.scripts.nvbench_compare_robust")


def outcome(ref, cmp, **options):
    return compare(rows_of_records(ref, "ref.jsonl"), rows_of_records(cmp, "cmp.jsonl"), **options)


def verdicts(ref, cmp, **options):
    return [pair.judgement.verdict for pair in outcome(ref, cmp, **options).pairs]


def journal(path, *records):
    with RecordWriter(path) as writer:
        for record in records:
            writer.write(record)
    return path


def invoke(*words, code=0):
    result = CliRunner().invoke(main, ["compare", *map(str, words)])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == code, result.output
    return result.output


def refusal(*words):
    [line] = invoke(*words, code=2).strip().splitlines()
    assert line.startswith("mpmbench: ")
    return line


@pytest.fixture
def files(tmp_path):
    """A journal, and one whose sync strategy takes 5 % longer."""
    before = [timed(times=samples(1)), timed("p2g_block_sync", times=samples(2)), timed("g2p_block_gather")]
    after = [timed(times=samples(3)), timed("p2g_block_sync", times=samples(4, 1.05e-3)), timed("g2p_block_gather")]
    return journal(tmp_path / "ref.jsonl", *before), journal(tmp_path / "cmp.jsonl", *after)


# ---- the rule ------------------------------------------------------------------------------------------------------

CASES = [
    (samples(1), samples(2)),
    (samples(1), samples(2, 1.05e-3)),
    (samples(1), samples(2, 0.95e-3)),
    (samples(1), samples(2, 1.01e-3)),
    (samples(1, noise=0.004), samples(2, noise=0.004)),
    (samples(1, noise=0.05), samples(2, 1.02e-3, noise=0.05)),
    (samples(1, count=4), samples(2, count=4)),
    ((0.0,) * 10, samples(2)),
]


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("hertz", [(1.5e9, 1.5e9), (1.5e9, 1.42e9), (None, None), (1.5e9, None)])
def test_verdicts_are_those_of_the_tool(tmp_path, preset, hertz):
    """The same rows through the program and through us: journal, and file on disk."""
    sides = [
        [timed(f"p2g_{i}", times=case[side], hertz=hertz[side]) for i, case in enumerate(CASES)] for side in (0, 1)
    ]
    for name, records in zip(("ref", "cmp"), sides, strict=True):
        write_nvbench(records, tmp_path / f"{name}.json")
    program = Path(sys.executable).with_name("nvbench-compare-robust")
    words = [program, "--no-color", "--display", "explain", "--preset", preset]
    text = subprocess.run([*words, tmp_path / "ref.json", tmp_path / "cmp.json"], capture_output=True, text=True).stdout
    expected = [line.split()[-2] for line in text.splitlines() if line.startswith("| ") and "p2g_" in line]
    assert len(expected) == len(CASES)
    assert verdicts(*sides, preset=preset) == expected
    invoke(tmp_path / "ref.json", tmp_path / "cmp.json", "--preset", preset, "--json", tmp_path / "out.json")
    assert [row["verdict"] for row in json.loads((tmp_path / "out.json").read_text())["rows"]] == expected


def test_presets_are_the_tools_own():
    from cuda.bench.scripts import nvbench_compare_robust as theirs

    from mpmbench import cli_compare

    assert set(theirs.COMPARISON_THRESHOLD_PRESETS) == set(PRESETS) == set(cli_compare.PRESETS)


def test_five_percent_and_nothing():
    assert verdicts([timed(times=samples(1))], [timed(times=samples(2))]) == ["SAME"]
    assert verdicts([timed(times=samples(1))], [timed(times=samples(2, 1.05e-3))]) == ["SLOW"]
    assert verdicts([timed(times=samples(1))], [timed(times=samples(2, 0.95e-3))]) == ["FAST"]


def test_a_slower_clock_is_not_a_slower_kernel():
    slower = timed(times=samples(2, 1.05e-3), hertz=1.5e9 / 1.05)
    [pair] = outcome([timed(times=samples(1))], [slower]).pairs
    assert pair.judgement.verdict == "AMBG"
    assert "cycle" in pair.judgement.told


def test_wall_times_need_no_clock():
    [pair] = outcome([wall(times=samples(1))], [wall(times=samples(2, 1.05e-3))]).pairs
    assert (pair.judgement.verdict, pair.judgement.told) == ("SLOW", "judged by wall time alone: no clock")
    assert verdicts([wall(times=samples(1))], [wall(times=samples(2))]) == ["SAME"]
    [pair] = outcome([wall(times=samples(1, noise=0.1))], [wall(times=samples(2, 1.02e-3, noise=0.1))]).pairs
    assert (pair.judgement.verdict, pair.judgement.reason) == ("AMBG", "centers_not_close")
    assert "not close enough" in pair.judgement.told
    assert verdicts([timed(times=samples(1), hertz=None)], [timed(times=samples(2, 1.05e-3), hertz=None)]) == ["AMBG"]


def test_broken_samples_are_told(tmp_path):
    ref, cmp = tmp_path / "ref.json", tmp_path / "cmp.json"
    write_nvbench([timed(times=samples(1))], ref)
    write_nvbench([timed(times=samples(2))], cmp)
    assert "1 SAME" in invoke(ref, cmp)
    [sidecar] = (tmp_path / "cmp.json-bin").iterdir()
    sidecar.write_bytes(b"\0\0\0\0")
    text = invoke(ref, cmp)
    assert "1 AMBG" in text
    assert "expected 60 values" in text


# ---- matching ------------------------------------------------------------------------------------------------------


def test_only_the_same_row_matches():
    first = timed()
    others = {
        "cache": timed(mode="hot"),
        "axis": other_axes(first, batching=1),
        "dataset": timed(fingerprint="e" * 64),
        "kind": wall(),
        "strategy": timed("p2g_block_sync"),
    }
    for what, other in others.items():
        with pytest.raises(InputError, match="no row in common"):
            outcome([first], [other])
        found = outcome([first, other], [first])
        assert (len(found.pairs), len(found.only_ref), found.only_cmp) == (1, 1, ()), what
    assert verdicts([first, *others.values()], [*others.values(), first]) == ["SAME"] * 6
    [row] = rows_of_records([first], "a.jsonl")
    assert match([row], [dataclasses.replace(row, kind=WALL)])[0] == []  # whatever its device is called


def test_order_does_not_matter_but_repeated_rows_keep_theirs():
    rows = [timed(times=samples(1)), timed(times=samples(1, 2e-3))]
    assert verdicts(rows, rows) == ["SAME", "SAME"]
    assert verdicts(rows, rows[::-1]) == ["SLOW", "FAST"]
    found = outcome([*rows, timed("p2g_block_sync")], rows[:1])
    assert [row.strategy for row in found.only_ref] == ["p2g_global_atomic", "p2g_block_sync"]


def test_gpus_pair_by_identity_then_by_order():
    def on(device, gpu, median):
        return dataclasses.replace(timed(times=samples(1, median), gpu={**GPU, "uuid": gpu}), device=device)

    one, two = on("cuda:0", "aa", 1e-3), on("cuda:1", "bb", 2e-3)
    assert verdicts([one, two], [two, one]) == ["SAME", "SAME"]
    moved = outcome([one, two], [on("cuda:0", "cc", 1e-3), on("cuda:1", "dd", 2e-3)])
    assert [pair.judgement.verdict for pair in moved.pairs] == ["SAME", "SAME"]
    assert [(d.key, d.ref, d.cmp) for d in moved.refused] == [("gpu.uuid", "aa", "cc"), ("gpu.uuid", "bb", "dd")]
    assert moved.pairs[1].cmp.device == ("cuda:1", "dd")


def test_a_row_that_failed_meets_its_partner_and_says_why():
    good = timed("p2g_block_sync", mode="hot")
    failed = untimed(good, check=None, failed_because="no launch")
    found = outcome([timed(), good], [timed(), timed("g2p_block_gather", mode="hot"), failed])
    assert [pair.judgement.verdict for pair in found.pairs] == ["SAME", "????"]
    assert found.pairs[1].judgement.told == "CMP: no launch"
    assert [summary.count for summary in found.summaries] == [1]
    twice = outcome([timed(), good], [timed(), failed, failed])
    assert (len(twice.pairs), len(twice.only_cmp)) == (2, 1)
    with pytest.raises(InputError, match=r"no row has a time in both files: .*CMP: no launch"):
        outcome([timed(), good], [untimed(timed(), check=None, failed_because="no launch"), timed("p2g_block_pull")])


def test_simulated_rows_are_counted_not_compared():
    found = outcome([timed(), simulated(), simulated()], [timed()])
    assert len(found.pairs) == 1
    assert found.untimed == ({"simulated": 2}, {})
    with pytest.raises(InputError, match=r"cmp\.jsonl holds no measured time \(1 rows; counted on the simulated"):
        outcome([timed()], [simulated()])


def test_filters_are_nvbenchs():
    rows = [timed(), other_axes(timed(), batching=1), timed("g2p_block_gather"), timed("p2g_global_node", axes={})]

    def kept(**options):
        return [pair.cmp.strategy for pair in outcome(rows, rows, **options).pairs]

    assert len(kept(benchmarks=["p2g"])) == 3
    assert kept(benchmarks=["g2p_*"]) == ["g2p_block_gather"]
    assert kept(axes=["batching=1"]) == ["p2g_global_atomic"]
    assert len(kept(axes=["batching=[1,4]", "block_shape=8x4x4"])) == 3
    assert len(kept(axes=["particles[pow2]=12"])) == 4
    for options, message in (
        ({"axes": ["depth=4"]}, "unknown axis 'depth': valid are strategy, dataset, particles"),
        ({"axes": ["batching"]}, "axis filter must be NAME=VALUE"),
        ({"axes": ["batching=9"]}, "leave no rows"),
        ({"benchmarks": ["q2p*"]}, r"nothing matches 'q2p\*': valid are p2g, p2g_global_atomic"),
    ):
        with pytest.raises(InputError, match=message):
            kept(**options)


# ---- environments --------------------------------------------------------------------------------------------------


def changed(record, **facts):
    gpu = {name: value for name, value in facts.items() if name in GPU}
    other = {name: value for name, value in facts.items() if name not in GPU}
    environment = record.environment
    return dataclasses.replace(
        record, environment=dataclasses.replace(environment, gpu={**environment.gpu, **gpu}, **other)
    )


@pytest.mark.parametrize(
    ("facts", "key"),
    [
        ({"name": "Other GPU"}, "gpu.name"),
        ({"cuda_driver": 13000}, "gpu.cuda_driver"),
        ({"cupy": "14.3.0"}, "gpu.cupy"),
        ({"clocks_locked": False}, "gpu.clocks_locked"),
        ({"nvrtc": "13.0"}, "gpu.nvrtc"),
        ({"mpmbench": "9.9"}, "mpmbench"),
    ],
)
def test_a_different_environment_is_refused(facts, key):
    other = changed(timed(), **facts)
    [difference] = outcome([timed()], [other]).refused
    assert (difference.key, difference.rows) == (key, 1)
    for allow in (key, key.partition(".")[0], "all"):
        found = outcome([timed()], [other], allow=[allow])
        assert found.refused == ()
        assert [d.key for d in found.differences] == [key]
    with pytest.raises(InputError, match="no such key"):
        outcome([timed()], [other], allow=["gpu.nmae"])


def test_what_is_not_recorded_is_different_too():
    older = timed(gpu={name: value for name, value in GPU.items() if name != "clocks_locked"})
    [difference] = outcome([older], [timed()]).refused
    assert (difference.key, difference.ref, difference.cmp) == ("gpu.clocks_locked", "not recorded", True)


def test_kernels_are_compared_of_matched_rows_only():
    new = timed(hashes={"p2g_global_atomic": "cd" * 32})
    lonely = timed("p2g_block_sync", hashes={"p2g_block_sync": "ef" * 32})
    [difference] = outcome([timed()], [new, lonely]).refused
    assert (difference.key, difference.ref, difference.cmp) == ("kernel.p2g_global_atomic", "ab" * 6, "cd" * 6)
    assert outcome([timed()], [new], allow=["kernel"]).refused == ()


def test_what_never_matters_is_not_compared():
    never = changed(timed(), date="2030-01-01", argv=("x",), seed=1, git_commit="abc", git_dirty=True)
    host = changed(timed(), cpu="other", python="3.99")
    assert outcome([timed()], [never]).differences == outcome([timed()], [host]).differences == ()
    wall_host = changed(wall(), cpu="other")
    assert [d.key for d in outcome([wall()], [wall_host]).refused] == ["cpu"]
    fields = {field.name for field in dataclasses.fields(ENVIRONMENT)}
    assert {*comparing.NEVER_MATTER, *comparing.HOST} <= fields


# ---- summary and limits --------------------------------------------------------------------------------------------


def test_geometric_mean_and_worst_row_by_kind():
    ref = [timed("p2g_a", times=(1e-3,) * 9), timed("p2g_b", times=(1e-3,) * 9), wall("p2g_a", times=(1.0,) * 9)]
    cmp = [timed("p2g_a", times=(2e-3,) * 9), timed("p2g_b", times=(5e-4,) * 9), wall("p2g_a", times=(3.0,) * 9)]
    events, cpu = outcome(ref, cmp).summaries
    assert (events.kind, events.count, events.worst.cmp.strategy) == (EVENTS, 2, "p2g_a")
    assert math.isclose(events.ratio, 1)
    assert (cpu.kind, cpu.count) == (WALL, 1)
    assert math.isclose(cpu.ratio, 3)
    assert events.verdicts == {"SLOW": 1, "FAST": 1}


def test_limits():
    pairs = outcome(
        [timed("p2g_a", times=samples(1)), timed("p2g_b", times=samples(1, noise=0.1))],
        [timed("p2g_a", times=samples(2, 1.05e-3)), timed("p2g_b", times=samples(1, 1.06e-3, noise=0.1))],
    ).pairs
    assert [pair.judgement.verdict for pair in pairs] == ["SLOW", "AMBG"]
    assert [pair.cmp.strategy for pair in Limit.parse("median:4%").failed(pairs)] == ["p2g_a"]
    assert [Limit("median", 4).exceeded(pair) for pair in pairs] == [True, True]
    assert Limit.parse("min:6.5%").failed(pairs) == []
    assert str(Limit.parse(" mean:2%")) == "mean:2%"
    for text in ("median", "median:5", "median:-1%", "max:5%", "median:nan%", "median:x%", ":5%", "median:inf%", ""):
        with pytest.raises(InputError, match="cannot read --fail-on"):
            Limit.parse(text)


# ---- the command line ----------------------------------------------------------------------------------------------


def test_compare_prints_and_writes_everything(tmp_path, files):
    text = invoke(*files, "--md", tmp_path / "out" / "c.md", "--json", tmp_path / "c.json")
    assert "**measured (events)**; every row: batching=4, block_shape=8x4x4, spline=cubic, cache=cold" in text
    assert "2 SAME" in text
    assert "1 SLOW" in text
    markdown = (tmp_path / "out" / "c.md").read_text()
    assert text.startswith(markdown)
    content = json.loads((tmp_path / "c.json").read_text())
    assert [row["verdict"] for row in content["rows"]] == ["SAME", "SLOW", "SAME"]
    assert content["rows"][1]["ratio"] == pytest.approx(1.05, abs=0.01)
    assert content["summaries"][0]["count"] == 3


def test_exit_code_three_for_a_regression(files):
    text = invoke(*files, "--fail-on", "median:4%", code=3)
    assert "--fail-on median:4%: 1 row failed" in text
    invoke(*files, "--fail-on", "median:6%")
    invoke(*files, "--fail-on", "min:4%", "--fail-on", "median:90%", code=3)
    invoke(*files, "--fail-on", "median:4%", "-b", "p2g_global_*")


def test_differing_files_are_refused_with_a_list(tmp_path, files):
    other = journal(tmp_path / "other.jsonl", changed(timed(times=samples(3)), name="Other GPU", cupy="15"))
    *listed, last = invoke(files[0], other, code=2).strip().splitlines()
    assert listed == ["gpu.name: Test GPU (REF), Other GPU (CMP), 1 row", "gpu.cupy: 14.2.0 (REF), 15 (CMP), 1 row"]
    assert last.endswith("add --allow-different gpu.name,gpu.cupy")
    text = invoke(files[0], other, "--allow-different", "gpu.name,gpu.cupy")
    assert "gpu.name" in text
    assert "Only in REF" in text
    assert "p2g_block_sync" in text
    invoke(files[0], other, "--allow-different", "gpu.name", code=2)


def test_a_journal_against_an_nvbench_file(tmp_path, files):
    assert CliRunner().invoke(main, ["report", str(files[1]), "--nvbench", str(tmp_path / "c.json")]).exit_code == 0
    assert "1 SLOW, 2 SAME" in invoke(files[0], tmp_path / "c.json")


def test_a_failed_row_stands_in_the_table_as_its_partner(tmp_path):
    rows = [timed(), timed("p2g_block_sync")]
    failed = untimed(rows[1], check=None, failed_because="no launch")
    text = invoke(journal(tmp_path / "a.jsonl", *rows), journal(tmp_path / "b.jsonl", rows[0], failed))
    assert "cache=cold" in text
    assert "REF median " in text
    assert "| ????      | CMP: no launch" in text
    assert "over 1 row;" in text


def test_names_cannot_break_the_table(tmp_path):
    row = timed(dataset="a|b\nröhre")
    path = journal(tmp_path / "r.jsonl", row, wall(dataset="a|b\nröhre"))
    assert "a\\|b röhre" in invoke(path, path)


def test_refusals_are_one_line(tmp_path, files):
    (tmp_path / "empty").write_text("")
    assert "is empty" in refusal(files[0], tmp_path / "empty")
    (tmp_path / "torn.jsonl").write_bytes(files[0].read_bytes()[:200])
    with pytest.warns(UserWarning, match="torn"):
        assert f"{tmp_path / 'torn.jsonl'} holds no rows" in refusal(files[0], tmp_path / "torn.jsonl")
    assert "no such file" in refusal(files[0], tmp_path / "none")
    assert "is a directory" in refusal(files[0], tmp_path)
    assert "neither a journal" in refusal(files[0], Path(__file__))
    assert "holds no measured time" in refusal(files[0], journal(tmp_path / "s.jsonl", simulated()))
    assert "is read by the same command" in refusal(*files, "--md", files[0])
    assert "cannot read --fail-on" in refusal(*files, "--fail-on", "5%")


def test_without_cuda_bench_one_line_says_how(files, monkeypatch):
    monkeypatch.setitem(sys.modules, "cuda.bench.scripts", None)
    assert "pip install 'mpmbench[nvbench]'" in refusal(*files)


def test_another_cuda_bench_is_told_by_version(files, monkeypatch):
    from cuda.bench.scripts import nvbench_compare_robust as theirs

    monkeypatch.delattr(theirs, "compare_gpu_timings")
    assert "cuda-bench 0.3" in refusal(*files)
