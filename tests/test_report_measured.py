"""Reports of measured rows: the answer with its doubts, marks that ties share, kinds and cache states apart."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest
from made_up_measured import contest, dataset, everyday, on_cpu, row, search, steady
from test_report import Page, all_tables, bad_runs, column, strategies

from mpmbench import preflight, report
from mpmbench.protocol.verdict import geometric_mean
from mpmbench.record import Measurement, Record, Repeat, StepCost
from mpmbench.report import (
    answer,
    chart_data,
    density,
    distributions,
    document,
    html_text,
    markdown_text,
    measured,
    plots,
    searches,
    winners,
)
from mpmbench.report import table as tables
from mpmbench.report.document import Attention
from mpmbench.report.doubts import next_command
from mpmbench.report.table import Group, Kind, Quantity
from mpmbench.report.text import format_value, interval_text

THROTTLED = "THROTTLED: clock below 75 % of default (SwPowerCap), 20 passes in a row"
CASE = "P2G of these particles (random, 1,000,000, 4 per cell, quadratic apic float32, caches cold)"


def group(records: list[Record]) -> Group:
    (found,) = tables.group(records)
    return found


def said(records: list[Record]) -> str:
    return answer.sentence(group(records))


def attention(records: list[Record], words: str) -> list[Attention]:
    return [a for a in document.build(records).attention if words in a.text]


def with_argv(records: list[Record], *argv: str) -> list[Record]:
    return [replace(r, environment=replace(r.environment, argv=argv)) for r in records]


def on_gpu(records: list[Record], name: str, device: str = "cuda:0", **facts) -> list[Record]:
    gpu = {"name": name, **facts}
    return [replace(r, device=device, environment=replace(r.environment, gpu=gpu)) for r in records]


def failed(variant: str, why: str = THROTTLED, **changes) -> Record:
    return row(variant, check=None, failed_because=why, **changes)


def twins(**options) -> list[Record]:
    """Two strategies that are equally fast, and faster than the baseline."""
    return contest([(row(), 2e-3), (row("p2g_block_sync"), 1.4e-3), (row("p2g_block_atomic"), 1.4e-3)], **options)


def judged(record: Record, **changes) -> Record:
    """With another comparison, or another measurement."""
    assert record.comparison is not None
    assert record.transfer_measurement is not None
    times = {name: changes.pop(name) for name in ("discarded", "hertz", "samples", "stopped_by") if name in changes}
    return replace(
        record,
        comparison=replace(record.comparison, **changes),
        transfer_measurement=replace(record.transfer_measurement, **times),
    )


# ---- the answer ----------------------------------------------------------------------------------------------


def test_the_answer_names_gpu_particles_strategy_axes_gain_and_sort():
    records = everyday()
    best = next(r for r in records if r.tuning)
    assert best.comparison is not None
    _, low, high = best.comparison.speedup or (0, 0, 0)
    assert said(records) == (
        f"On this GPU (Test GPU), {CASE}: use p2g_block_sync with block 8x4x4 and batching 2: 1.36 ms, "
        f"1.420× [{low:.3f}, {high:.3f}] over unsorted global atomics (p2g_global_atomic, 1.93 ms); sorting pays from "
        "4 transfers per sort."
    )
    assert document.build(records).answer == (said(records),)


def test_the_sort_may_pay_at_once_or_never():
    assert said(everyday(sort=1e-5)).endswith("; sorting pays at once.")
    base, best = contest([(row(), 2e-3), (row("p2g_block_sync"), 1.9e-3)])
    costly = replace(best, preprocess={**best.preprocess, "grid_divide": StepCost(None, steady(1e-3))})
    assert said([base, costly]).endswith("; its sort never pays.")
    unsorted = contest([(row(), 2e-3), (row("p2g_warp_reduce"), 1.9e-3)])
    assert "sort" not in said(unsorted).replace("unsorted", "")


def test_several_leaders_cannot_be_told_apart():
    records = twins()
    first, second = (r.variant for r in group(records).leaders)
    assert f": use {first} with block 8x4x4 and batching 1: 1.4" in said(records)
    assert said(records).endswith(f"; {second} cannot be told apart from it.")
    table = measured.ranking(group(records))
    assert [r.mark for r in table.rows] == ["tied", "tied", ""]
    for title in ("transfer", "speedup", "particles / s", "ns / node visit"):
        assert table.best([c.title for c in table.columns].index(title)) == {0, 1}
    assert "**tied**" in markdown_text(records)
    assert html_text(records).count('<span class="tag lead">tied</span>') == 2
    (summary,) = winners.tables_of(tables.group(records))
    assert column(summary, "cannot be told from it")[0].startswith("= p2g_block_")


def test_a_baseline_that_nothing_beats():
    worse = contest([(row(), 2e-3), (row("p2g_block_sync"), 2.4e-3)])
    assert said(worse).endswith(": use unsorted global atomics (p2g_global_atomic, 2.00 ms): nothing is faster.")
    equal = contest([(row(), 2e-3), (row("p2g_warp_reduce"), 2e-3)])
    assert "nothing is faster for sure than unsorted global atomics" in said(equal)
    assert "p2g_warp_reduce cannot be told apart from it (1.00" in said(equal)
    assert said(equal).endswith("the same within 0.5 %).")
    open_ = contest([(row(), 2e-3), (row("p2g_warp_reduce"), 1.99e-3)], samples=24, noise=0.03)
    assert "p2g_warp_reduce" in said(open_)
    assert said(open_).endswith("not decided).")


@pytest.mark.parametrize(
    ("verdict", "words"),
    [
        (
            "SAME",
            "p2g_block_sync: 1.36 ms, {} over unsorted global atomics (p2g_global_atomic, 1.93 ms): the same within",
        ),
        ("AMBG", ": whether it is faster is not decided"),
        ("????", ": the two cannot be compared"),
    ],
)
def test_a_leader_without_a_clear_verdict_says_so(verdict, words):
    records = [judged(r, verdict=verdict) if r.tuning else r for r in everyday()]
    assert words.split("{}")[-1] in said(records)


def test_another_baseline_is_not_called_plain():
    records = contest([(row("p2g_warp_reduce"), 2e-3), (row("p2g_block_sync"), 1.4e-3)])
    assert "over the baseline (p2g_warp_reduce, 2.00 ms)" in said(records)
    deep = contest([(row(axes={"particle_order": "deep"}), 2e-3), (row("p2g_block_sync"), 1.4e-3)])
    assert "over the baseline (p2g_global_atomic with particle order deep, " in said(deep)


def test_a_baseline_that_failed():
    base, *others = everyday()
    others = [judged(r, verdict="????", speedup=None, leads=False) for r in others]
    records = [failed(base.variant, dataset=base.dataset), *others]
    assert ", compared with nothing: the baseline p2g_global_atomic has no time" in said(records)
    (doubt,) = attention(records, "The baseline p2g_global_atomic has no time")
    assert "run again" in doubt.action
    table = measured.ranking(group(records))
    assert not any(r.baseline for r in table.rows)
    assert "break-even" not in [c.title for c in table.columns]
    assert "No break-even: the baseline p2g_global_atomic has no row here." in table.notes
    assert "has no time" in html_text(records)


def test_a_later_part_of_a_contest_was_timed_beside_a_baseline_without_a_row():
    _, *others = everyday()
    assert ", 1.42" in said(others)
    assert " over the baseline (p2g_global_atomic); " not in said(others)  # without its row no break-even is known
    assert said(others).endswith(" over the baseline (p2g_global_atomic).")
    assert not attention(others, "nothing is compared")


def test_one_arm_and_no_comparison():
    alone = contest([(row(), 2e-3)])
    assert said(alone).endswith(
        "unsorted global atomics (p2g_global_atomic, 2.00 ms) ran alone: there is nothing to compare it with."
    )
    old = [replace(r, comparison=None) for r in everyday()]
    assert said(old).startswith(f"On this GPU (Test GPU), {CASE}: use p2g_block_sync with block 8x4x4 and batching 2, ")
    assert "1.42 times as fast as unsorted p2g_global_atomic (transfer alone)" in said(old)
    table = measured.ranking(group(old))
    speedup = next(c for c in table.columns if c.title == "speedup")
    assert speedup.quantity is Quantity.FACTOR
    assert "verdict" not in [c.title for c in table.columns]
    for records in (alone, old):
        Page(html_text(records))
        assert not attention(records, "AMBG")


def test_throttled_rows_have_no_time_and_are_not_called_wrong():
    every = [failed("p2g_global_atomic"), failed("p2g_block_sync")]
    doc = document.build(every)
    assert doc.verdict == "Nothing was timed. 2 runs lost the time to a processor that slowed down."
    assert not doc.agreed
    assert doc.answer[0].endswith("float32): no answer, every row was throttled.")
    assert "No GPU took part" not in "".join(doc.answer)
    doc = document.build([*everyday(), failed("p2g_odd", dataset=dataset())])
    assert doc.agreed
    assert doc.verdict.endswith("1 run lost the time to a processor that slowed down.")
    (one,) = attention([*everyday(), failed("p2g_odd", dataset=dataset())], "THROTTLED")
    assert (one.level, "cool the GPU" in one.action) == ("warning", True)
    mixed = [failed("p2g_global_atomic"), failed("p2g_x", "launch error")]
    assert document.build(mixed).answer[0].endswith("no answer, no row of it has a time.")


def test_too_short_is_of_events_only():
    rows = [("p2g_global_atomic", 5e-6), ("p2g_x", 4e-6)]
    quick = contest([(row(name), seconds) for name, seconds in rows])
    assert said(quick).endswith(": too short to say which is fastest; use more particles.")
    assert attention(quick, "Too short for the resolution of events")
    cpu = contest([(on_cpu(name), seconds) for name, seconds in rows])
    assert "use p2g_x" in said(cpu)
    assert not attention(cpu, "Too short")


def test_each_device_has_its_say_before_any_has_two():
    many = [r for n in range(1, 8) for r in everyday(dataset(n=1_000_000 * n), seed=n)]
    records = [*many, *on_gpu(everyday(seed=9), "Other GPU")]
    lines = document.build(records).answer
    assert "On this GPU (Test GPU)" in lines[0]
    assert "On this GPU (Other GPU)" in lines[1]
    assert lines[document.NAMED] == "The table below has 3 more measured cases."


# ---- what may stand together ---------------------------------------------------------------------------------


def test_states_of_the_caches_are_never_in_one_table():
    refused = failed("p2g_odd", "launch error")
    cold, hot = everyday(), everyday(mode="hot", seed=2)
    groups = tables.group([*cold, *hot, refused])
    assert [g.caches for g in groups] == ["caches cold", "caches hot"]
    assert [len(g.records) for g in groups] == [7, 7]  # nobody knows in which state the refused one would have been
    doc = document.build([*cold, *hot, refused])
    titles = [s.title for s in doc.sections] + [t.title for t in doc.sections[0].tables]
    for words in ("caches cold", "caches hot"):
        assert len([t for t in titles if words in t]) == 2
    assert len(doc.answer) == 2
    step = tables.group(everyday(mode="step"))[0]
    assert step.title.endswith("caches as a step leaves them")


def test_a_run_without_a_time_stands_in_the_state_that_it_was_meant_for():
    refused = failed("p2g_odd", "launch error", cache="hot")
    groups = tables.group([*everyday(), *everyday(mode="hot", seed=2), refused])
    assert [len(g.records) for g in groups] == [6, 7]
    cold, hot = tables.group([*everyday(), refused])
    assert (len(cold.records), hot.records, hot.caches) == (6, (refused,), "caches hot")
    assert len(tables.group([refused, replace(refused, cache="cold")])) == 2


def test_of_equal_runs_the_last_counts_whether_it_worked_or_not():
    first, again = everyday(), everyday()
    assert len(group([*first, *again]).records) == 6
    broken = replace(first[2], transfer_measurement=None, comparison=None, check=None, preprocess={},
                     failed_because="launch error")  # fmt: skip
    assert len(group([*first, broken]).ranked) == 5
    assert len(group([broken, *first]).ranked) == 6


def test_contests_are_apart():
    """Samples of two contests were not taken in the same rounds, even for one problem on one device."""
    one = contest([(row(), 2e-3), (row("p2g_a"), 1.4e-3)], "one")
    two = contest([(row("p2g_b"), 2e-3), (row("p2g_c"), 1.4e-3)], "two")
    groups = tables.group([*one, *two])
    assert [[r.variant for r in g.records] for g in groups] == [["p2g_a", "p2g_global_atomic"], ["p2g_c", "p2g_b"]]
    assert [g.note for g in groups] == ["timing 1 of 2", "timing 2 of 2"]
    assert "timing 2 of 2" in groups[1].title
    same_name = [*one, *on_gpu(two, "Test GPU", "cuda:1")]
    assert [g.note for g in tables.group(same_name)] == ["cuda:0", "cuda:1"]
    apart = [*on_gpu(everyday(), "T", uuid="a"), *on_gpu(everyday(), "T", uuid="b")]
    assert len(tables.group(apart)) == 2


def mixed() -> list[Record]:
    cpu = contest([(on_cpu(name), s) for name, s in (("peer_warp", 2e-2), ("peer_taichi", 3e-2))], "cpu", mode="hot")
    cpu = [replace(r, transfer="p2g") for r in cpu]
    return [*everyday(), *cpu, *strategies(), *bad_runs()]


def test_wall_clock_is_a_kind_of_its_own():
    doc = document.build(mixed())
    shown = all_tables(doc)
    kinds = [set(t.kinds) & {Kind.MEASURED, Kind.WALL, Kind.SIMULATED} for t in shown]
    assert all(len(k) <= 1 for k in kinds)
    assert {Kind.WALL} in kinds
    assert any(line.startswith("On this CPU (A CPU of 64 cores), wall clock, P2G") for line in doc.answer)
    assert "Fastest transfer, wall clock on a CPU, caches hot" in [t.title for t in shown]
    for text in (html_text(mixed()), markdown_text(mixed())):
        assert "time of runs on a CPU: comparable among themselves, and with no event time" in text
    charts = [c for s in doc.sections for c in s.charts]
    assert {getattr(c, "kind", None) for c in charts} == {Kind.MEASURED, Kind.WALL, Kind.SIMULATED}
    alone = document.build([r for r in mixed() if r.device == "cpu"])
    assert alone.answer[0] == "No GPU took part: times are wall clock on a CPU, and say nothing about a GPU."


def test_wall_clock_of_a_primitive_and_of_a_published_row():
    scan = replace(contest([(on_cpu("scan_x"), 2e-3)])[0], transfer="scan", comparison=None)
    published = replace(scan, transfer="p2g", preset_row={"source": "thesis", "table": 9, "row": "x", "place": 0})
    for record, title in ((scan, "time"), (published, "transfer")):
        shown = [t for t in all_tables(document.build([record])) if title in [c.title for c in t.columns]]
        assert shown
        assert all(Kind.MEASURED not in t.kinds for t in shown)


def test_published_rows_are_apart_by_cache_state():
    row_of = {"source": "thesis", "table": 13, "row": "global", "place": 0, "published_us": 5.0}
    records = [replace(r, preset_row=row_of) for mode in ("cold", "hot") for r in contest([(row(), 2e-3)], mode=mode)]
    found = tables.presets([*records, failed("p2g_odd", preset_row=row_of)])
    assert [t.title.rsplit(", ", 1)[-1] for t in found] == ["caches cold", "caches hot"]
    assert [len(t.rows) for t in found] == [2, 2]


# ---- tables --------------------------------------------------------------------------------------------------


def test_the_measured_table():
    records = everyday(megahertz=(1755, 1755, 1750, 1755, 1754, 1755))
    table = measured.ranking(group(records))
    best = next(r for r in records if r.tuning)
    assert best.transfer_measurement is not None
    assert best.comparison is not None
    first = {c.title: cell.value for c, cell in zip(table.columns, table.rows[0].cells, strict=True)}
    assert first["strategy"] == "p2g_block_sync"
    assert first["transfer"] == best.transfer_measurement.median
    assert first["q1 to q3"] == best.transfer_measurement.quartiles
    assert first["least"] == min(best.transfer_measurement.samples)
    assert first["noise"] == best.transfer_measurement.noise
    assert (first["samples"], first["SM MHz"], first["verdict"]) == (240, 1750, "FAST")
    assert first["speedup"] == best.comparison.speedup
    assert first["particles / s"] == pytest.approx(1e6 / best.transfer_measurement.median)
    assert [r.mark for r in table.rows] == ["fastest", "", "", "", "", ""]
    assert [r.baseline for r in table.rows].index(True) == column(table, "verdict").index("")
    assert column(table, "verdict") == ["FAST", "FAST", "FAST", "SAME", "", "SLOW"]
    assert "(caches cold)" in table.title
    assert any(n.startswith("Noise floor: two copies of the baseline differ by -0.") for n in table.notes)
    assert "SM MHz" not in [c.title for c in measured.ranking(group(everyday())).columns]
    text = markdown_text(records)
    assert "`p2g_block_sync` **fastest**" in text
    assert "`p2g_global_atomic` (baseline)" in text


def test_steps_in_another_state_of_the_caches_are_named():
    records = everyday()
    records[0] = replace(records[0], preprocess={"grid_clear": StepCost(None, steady(1e-5, "hot"))})
    assert "Steps around the transfer: caches hot." in measured.ranking(group(records)).notes
    assert not [n for n in measured.ranking(group(everyday())).notes if n.startswith("Steps around")]


def test_a_whole_step_is_the_sum_of_its_parts():
    divide, gather = (StepCost(None, Measurement((s,), "step", 1, "precision")) for s in (7e-5, 8e-4))
    records = [
        replace(r, rest_of_step={"grid_divide": divide, "g2p_global_gather": gather}) for r in everyday(mode="step")
    ]
    table = measured.whole_step(group(records))
    assert table is not None
    parts = ["grid clear", "p2g", "grid divide", "g2p global gather"]
    assert [c.title for c in table.columns][-4:] == parts
    for i in range(6):
        assert column(table, "whole step")[i] == pytest.approx(sum(column(table, part)[i] for part in parts))
    assert re.search(r"1\.3\d ms, the whole step 2\.3\d ms, 1\.42", said(records))
    assert any(t.title == "Whole step" for t in all_tables(document.build(records)))
    assert measured.whole_step(group(everyday())) is None


def test_g2p_is_the_last_part_of_its_step():
    around = {name: StepCost(None, steady(1e-4, "step")) for name in ("grid_clear", "p2g_global_atomic", "grid_divide")}
    (record,) = contest([(row("g2p_global_gather"), 1e-3)], mode="step")
    parts = measured.step_parts(replace(record, rest_of_step=around))
    assert list(parts) == ["grid_clear", "p2g_global_atomic", "grid_divide", "g2p"]


def test_a_search_shows_its_losers():
    record = search(row("p2g_block_sync"), 1e-3)
    (table,) = searches.found(Group((record,)))
    assert record.tuning is not None
    assert len(table.rows) == len(record.tuning.tried) == 12
    assert column(table, "configuration")[0] == "block_shape=8x4x4 batching=2"
    assert column(table, "remark") == ["chosen", *[""] * 10, "needs 61 KiB of shared memory, 48 are there"]
    times = column(table, "time")
    assert times[1:-1] == sorted(times[1:-1])
    assert times[-1] is None
    assert table.notes[0] == (
        "Searched: block shape and batching. 12 of 40 possible configurations tried, 12 allowed. Times: measured "
        "(events) for Test GPU."
    )
    for kind, expected in (("modelled", Kind.MODELLED), ("measured (wall, CPU)", Kind.WALL)):
        (table,) = searches.found(Group((search(row("p2g_block_sync"), 1e-3, None, kind),)))
        assert table.kinds == (expected,)
    folded = [d for s in document.build(everyday()).sections for d in s.details if "searched" in d.summary]
    assert [d.summary for d in folded] == ["How axes were chosen: 1 strategy was searched, losers included"]


def test_run_to_run_differences_are_in_the_agreement():
    table = tables.agreement(everyday())
    assert dict(zip(column(table, "strategy"), column(table, "run to run"), strict=True)) == {
        "p2g_global_atomic": "1,204,551 of 8,388,608 numbers differ in bits, at most 4.1e-07",
        "p2g_block_sync": "12,345 of 8,388,608 numbers differ in bits, at most 2.3e-07",
        "p2g_block_atomic": "",
        "p2g_warp_reduce": "the same bits in all 8,388,608 numbers",
        "p2g_node_gather": "",
    }
    assert tables.repeat_text([row(repeat=Repeat(9, 10, 1e-9)), row(repeat=Repeat(1, 10, 1e-7))]).startswith("1 of 10")
    assert "run to run" not in [c.title for c in tables.agreement(strategies()).columns]


def test_a_winner_per_gpu():
    records = [*on_gpu(everyday(), "GPU A"), *on_gpu(everyday(seed=3), "GPU B")]
    (table,) = winners.tables_of(tables.group(records))
    assert table.title == "Winner per GPU and dataset, measured, caches cold"
    assert column(table, "device") == ["GPU A, sm_90", "GPU B, sm_90"]
    assert column(table, "fastest") == ["p2g_block_sync batching=2"] * 2
    assert column(table, "verdict") == ["FAST", "FAST"]
    assert all(text.startswith("1.42") for text in column(table, "speedup"))
    (alone,) = winners.tables_of(tables.group(everyday()))
    assert alone.title == "Fastest transfer, measured, caches cold"


def test_means_over_cases_are_geometric():
    cases = {4: 1.2e-3, 8: 2.5e-3}
    records = []
    for per_cell, seconds in cases.items():
        data = dataset(per_cell=per_cell)
        rows = [(row(dataset=data), 2e-3), (search(row("p2g_block_sync", dataset=data), 1e-3), seconds)]
        if per_cell == 4:
            rows.append((row("p2g_rare", dataset=data), 1e-3))
        records += contest(rows, str(per_cell), per_cell)
    _, mean = winners.tables_of(tables.group(records))
    speedups = [r.comparison.speedup[0] for r in records if r.tuning and r.comparison and r.comparison.speedup]
    assert column(mean, "strategy") == ["p2g_block_sync (tuned)"]  # p2g_rare has one case: no mean
    assert column(mean, "geometric mean") == [pytest.approx(geometric_mean(speedups))]
    assert column(mean, "cases") == [2]
    assert column(mean, "worst case") == [min(speedups)]
    assert column(mean, "its dataset") == ["random (8 per cell)"]
    assert column(mean, "slower than the baseline") == [1]
    assert mean.rows[0].mark == ("best mean" if geometric_mean(speedups) > 1 else "")
    assert len(winners.tables_of(tables.group(everyday()))) == 1  # one case: nothing to average


# ---- doubts --------------------------------------------------------------------------------------------------


def test_what_is_not_decided_comes_with_the_next_command():
    records = contest(
        [(row(), 2e-3), (row("p2g_a"), 1.99e-3), (row("p2g_b"), 1.2e-3)], stopped_by="time limit; undecided: p2g_a",
    )  # fmt: skip
    records = [judged(r, verdict="AMBG") if r.variant == "p2g_a" else r for r in records]
    (limit,) = attention(records, "time limit came before a verdict on p2g_a")
    assert limit.action.startswith("Run `mpmbench run -b 'p2g_*' --dataset random --rigorous`:")
    assert not attention(records, "AMBG")  # said already
    quiet = [judged(r, stopped_by="precision") for r in records]
    (open_,) = attention(
        quiet, "Neither faster nor slower than p2g_global_atomic for sure (AMBG): p2g_a (P2G on random"
    )
    assert open_.action == limit.action


@pytest.mark.parametrize(
    ("argv", "action"),
    [
        (("mpmbench", "run", "--quick", "--resume", "--json", "a b.jsonl", "--dataset", "x y"),
         "Run `mpmbench run --dataset 'x y' --rigorous`"),
        (("__main__.py", "run", "--html=r.html", "-b", "p2g_a"), "Run `mpmbench run -b p2g_a --rigorous`"),
        (("mpmbench", "run", "--rigorous"), "`--rigorous` was in use: take them as equal"),
        (("pytest",), "Run again with `--rigorous`"),
        (("mpmbench", "report", "x.jsonl"), "Run again with `--rigorous`"),
        ((), "Run again with `--rigorous`"),
    ],
)  # fmt: skip
def test_the_next_command_knows_what_was_in_use(argv, action):
    assert next_command(with_argv([row()], *argv)[0]).startswith(action)


def test_scattered_samples_are_warned_of_and_more_so_where_they_scatter_more():
    def noisy(scale: float, **changes) -> list[Record]:
        return [replace(row(**changes), transfer_measurement=steady(1e-3, noise=scale, samples=200))]

    assert not attention(noisy(0.02), "scatter")
    (some,) = attention(noisy(0.15), "scatter by more than 10 %")
    assert "`--lock-gpu-clocks base`" in some.action
    (much,) = attention(noisy(0.5), "scatter by more than 25 %")
    assert much.action.startswith("Do not use these times")
    (locked,) = attention(with_argv(noisy(0.15), "mpmbench", "run", "--lock-gpu-clocks", "base"), "scatter")
    assert "locked already" in locked.action
    assert "--lock-gpu-clocks" not in locked.action
    cpu = [replace(on_cpu("p2g_x"), transfer_measurement=steady(1e-3, noise=0.15, samples=200))]
    (wall,) = attention(cpu, "scatter")
    assert "GPU" not in wall.action


def test_a_noise_floor_wider_than_the_margin():
    (floor,) = attention(everyday(copy=1.02), "Two copies of the baseline differ by up to 2")
    assert "smaller differences are not called" in floor.text
    assert not attention(everyday(), "Two copies")


def test_discarded_samples_are_told_once_per_contest():
    (one,) = attention(everyday(discarded={"clock below 75 % of default": 12}), "thrown away")
    assert "Of passes 12 were thrown away (12 for clock below 75 % of default), 240 kept" in one.text
    assert one.level == "note"
    assert "cool the GPU" in one.action
    old = [replace(r, comparison=None) for r in everyday(discarded={"slow": 3})]
    (each,) = attention(old, "Of samples 3 were thrown away")
    assert each.text.count(" on random") >= 5


def test_a_gpu_that_was_held_down_says_how_often():
    def held(rounds: int) -> list[Record]:
        return [
            replace(r, transfer_measurement=replace(r.transfer_measurement, held_down={"power cap": rounds}))
            if r.transfer_measurement
            else r
            for r in everyday()
        ]

    (often,) = attention(held(30), "held the clocks down in 30 of 60 rounds (power cap)")
    assert often.level == "warning"
    assert "speedups stand" in often.action
    (seldom,) = attention(held(1), "held the clocks down in 1 of 60 rounds")
    assert seldom.level == "note"


def test_a_working_set_that_the_cache_holds_is_noted():
    small = [replace(r, floor_bytes=8 << 20) for r in on_gpu(everyday(), "Test GPU", l2_bytes=4 << 20)]
    (note,) = attention(small, "Particles and nodes are 2 times the second-level cache")
    assert "cache=[cold,hot,step]" in note.action
    assert not attention([replace(r, floor_bytes=20 << 20) for r in small], "second-level cache")


def test_compulsory_bytes_are_set_beside_the_peak_rate():
    facts = {"memory_clock_khz": 3_505_000, "memory_bus_bits": 256}  # 224.32 GB/s
    records = [replace(r, floor_bytes=200_000_000) for r in on_gpu(everyday(), "Test GPU", **facts)]
    (first, *_) = column(measured.ranking(group(records)), "of peak")
    best = min(r.transfer_measurement.median for r in records if r.transfer_measurement)
    assert first == pytest.approx(200e6 / best / 224.32e9)
    assert "of peak" not in [c.title for c in measured.ranking(group(everyday())).columns]


def test_rows_whose_clock_differs_are_not_compared():
    records = everyday(megahertz=(1755, 1755, 1600, 1755, 1755, 1755))
    (apart,) = attention(records, "Clocks differ by more than 1 %")
    assert "p2g_block_sync batching=2" in apart.text
    assert "cannot be compared" in said(records)
    few = [judged(r, verdict="????") if r.variant == "p2g_node_gather" else r for r in everyday()]
    (left,) = attention(few, "Too few samples to compare")
    assert "p2g_node_gather" in left.text


def test_preflight_is_asked_once_per_gpu(monkeypatch):
    asked = []

    def warnings(facts):
        asked.append(facts["name"])
        return [("The GPU is shared", "Stop the other process.")]

    monkeypatch.setattr(preflight, "warnings", warnings)
    records = [*everyday(), *on_gpu(everyday(), "GPU B"), *mixed()]
    (shared,) = attention(records, "The GPU is shared")
    assert asked == ["Test GPU", "GPU B"]
    assert shared.text == "The GPU is shared: Test GPU; GPU B."
    assert shared.action == "Stop the other process."


# ---- charts --------------------------------------------------------------------------------------------------


def test_distributions_are_of_all_samples_and_robust_to_outliers():
    records = everyday(outliers=0.05)
    strips = distributions.chart(group(records))
    assert strips is not None
    assert [s.baseline for s in strips.strips].count(True) == 1
    table = distributions.data(strips)
    for strip, r in zip(strips.strips, group(records).ranked, strict=True):
        assert r.transfer_measurement is not None
        assert strip.seconds == tuple(sorted(r.transfer_measurement.samples))
        assert column(table, "median")[column(table, "strategy").index(strip.label)] == pytest.approx(
            r.transfer_measurement.median
        )
    low, high = distributions.limits(strips.strips)
    assert -0.05 < low < 0 < high < 0.15  # outliers take 1.2 to 3 times as long
    svg = plots.svg(strips)
    assert "beyond" in svg
    assert "p2g_block_sync batching=2" in svg
    assert len(svg) < 20_000
    constant = [replace(r, transfer_measurement=Measurement((1e-3,) * 10, "cold", 1, "x"), comparison=None)
                for r in everyday()]  # fmt: skip
    assert distributions.chart(group(constant)) is None


def test_one_noisy_strategy_does_not_hide_the_others():
    strips = distributions.chart(group(everyday(noise=(0.004, 0.004, 0.004, 0.004, 0.004, 0.5))))
    assert strips is not None
    assert distributions.limits(strips.strips)[1] < 0.2


def test_strategy_against_density():
    records = [r for d in (1, 4, 16) for r in everyday(dataset("uniform_cube", 1_000_000 * d, d), seed=d)]
    ((chart, table),) = density.charts(tables.group(records))
    assert chart.x_axis == "particles per cell"
    line = next(one for one in chart.lines if one.label == "p2g_block_sync, deep")
    assert line.x == (1, 4, 16)
    expected = [r.transfer_measurement.median / r.dataset.n for r in records if r.tuning and r.transfer_measurement]
    assert line.y == pytest.approx([1e9 * e for e in expected])
    assert {(n, o) for n, o in zip(column(table, "strategy"), column(table, "order"), strict=True)} >= {
        ("p2g_global_atomic", "random"), ("p2g_global_atomic", "deep"),
    }  # fmt: skip
    assert column(table, "4 per cell")[0] == pytest.approx(expected[1])
    assert not density.charts(tables.group(everyday()))
    doc = document.build(records)
    (section,) = [s for s in doc.sections if s.title == "Strategy against density"]
    assert section.charts == (chart,)
    assert section.tables == (table,)
    assert "Strategy against density" in markdown_text(records)
    plots.svg(chart)


def test_density_shows_the_fastest_of_several_choices_of_axes():
    records = []
    for d in (1, 4):
        data = dataset("uniform_cube", per_cell=d)
        slow = row("p2g_block_sync", dataset=data, axes={"batching": 4})
        records += contest([(row("p2g_block_sync", dataset=data), 1e-3), (slow, 2e-3)], str(d))
    ((_, table),) = density.charts(tables.group(records))
    assert column(table, "4 per cell") == [pytest.approx(1e-9, rel=0.02)]


def test_density_of_the_cells_that_hold_any_where_none_was_asked_for():
    assert density.per_cell(dataset(per_cell=None)) == 2
    assert density.per_cell(replace(dataset(per_cell=None), statistics={})) is None
    assert "(random, 1,000,000, quadratic" in said(everyday(replace(dataset(per_cell=None), statistics={})))


def test_the_break_even_chart_has_bands():
    g = group(everyday())
    (chart,) = [c for s in document.build(list(g.records)).sections for c in s.charts if isinstance(c, plots.Lines)]
    for line in chart.lines:
        assert line.band is not None
        assert all(low <= y <= high for low, y, high in zip(line.band[0], line.y, line.band[1], strict=True))
    assert [line.baseline for line in chart.lines].count(True) == 1
    data = chart_data.data(chart)
    assert data is not None
    assert [c.title for c in data.columns[1:]] == ["1", "2", "5", "10", "20", "50", "100", "200", "500", "1,000"]
    best = next(r for r in g.ranked if r.tuning)
    parts = tables.split(best, tables.seconds)
    assert parts is not None
    cells = data.rows[[line.label for line in chart.lines].index(g.label(best))].cells
    assert cells[3].value == pytest.approx(1e6 * (parts.per_sort / 5 + parts.per_transfer))


def test_every_chart_has_its_numbers_beneath():
    records = [r for d in (1, 4) for r in everyday(dataset("uniform_cube", per_cell=d), seed=d)] + mixed()
    text = html_text(records)
    page = Page(text)
    assert page.tags.count("figure") == page.tags.count("svg") == len(re.findall(r'<details class="data">', text))
    shown = "".join(page.text)
    charts = [c for s in document.build(records).sections for c in s.charts]
    for chart in charts:
        data = chart_data.data(chart)
        assert data is not None
        assert {c.kind for c in data.columns[1:]} == {chart.kind}  # type: ignore[union-attr]
        for line in data.rows:
            for cell, col in zip(line.cells, data.columns, strict=True):
                assert format_value(cell.value, col.quantity) in shown


# ---- edges ---------------------------------------------------------------------------------------------------


def test_forty_strategies():
    rows = [(row(), 2e-3), *((row("p2g_block_sync", axes={"batching": i + 2}), 1.4e-3 + 1e-5 * i) for i in range(39))]
    records = contest(rows, samples=40)
    text = html_text(records)
    assert len(text.encode()) < 300_000
    assert "; the first 20 of 40" in text
    assert len(measured.ranking(group(records)).rows) == 40
    assert document.build(records).answer[0].count("p2g_block_sync") <= answer.NAMED + 1


def test_odd_names_and_awkward_numbers():
    odd = '粒子 <b>"x"</b> | `é` ½'
    records = contest([(row(dataset=dataset(odd)), 2e-3), (row("p2g_" + odd, dataset=dataset(odd)), 1.4e-3)])
    page = Page(html_text(records))
    assert "b" not in page.tags
    assert any("粒子" in piece for piece in page.text)
    assert "粒子" in markdown_text(records)
    infinite = [judged(r, speedup=(1.4, -float("inf"), float("inf")), noise=(1.0, -float("inf"), float("inf")))
                for r in everyday()]  # fmt: skip
    assert "1.40×, no interval" in said(infinite)
    nan = [judged(r, speedup=(float("nan"), -float("inf"), float("inf")), verdict="????") for r in everyday()]
    zero = [judged(r, samples=(0.0,) * 10, hertz=()) for r in everyday()]
    empty = [replace(r, dataset=replace(r.dataset, n=0)) for r in everyday()]
    for rows in (infinite, nan, zero, empty):
        Page(html_text(rows))
        assert markdown_text(rows)


def test_a_fact_of_many_values_is_told_by_the_first():
    rows = [replace(r, environment=replace(r.environment, gpu={"temperature": 40 + i}))
            for i in range(30) for r in contest([(row(f"p2g_{i}"), 2e-3)])]  # fmt: skip
    facts = dict(document.build(rows).environment)
    assert facts["GPU temperature"].endswith(", and 18 more")


def test_pages_of_many_cases_fit(monkeypatch):
    monkeypatch.setattr(report, "HTML_LIMIT", 60_000)  # a small limit keeps the test quick
    records = [r for d in (1, 2, 4) for r in everyday(dataset(n=1000 * d, per_cell=d), seed=d, samples=60)]
    text = html_text(records)
    assert len(text.encode()) <= 60_000
    assert "Left out to keep the page small: hottest lines, searches, single steps" in text
    assert "How axes were chosen" not in text
    assert "Answer in one table" in text


@pytest.mark.parametrize(
    ("three", "text"),
    [
        ((1.42, 1.40, 1.44), "1.42× [1.40, 1.44]"),
        ((1.0036, 1.0031, 1.0042), "1.004× [1.003, 1.004]"),
        ((1.0, 0.86, 1.14), "1.00× [0.86, 1.14]"),
        ((12.44, 12.1, 12.7), "12.4× [12.1, 12.7]"),
        ((240.0, 200.0, 280.0), "240× [200, 280]"),
        ((2.0, 2.0, 2.0), "2.00× [2.00, 2.00]"),
        ((1.5, float("-inf"), float("inf")), "1.50×, no interval"),
        ((float("nan"), float("-inf"), float("inf")), "–"),
    ],
)
def test_an_interval_says_the_digits_that_it_knows(three, text):
    assert interval_text(*three) == text
