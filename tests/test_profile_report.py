"""The pages made of profiles: who wins on which GPU, as far as the ranges allow, and what binds."""

from __future__ import annotations

import dataclasses
import math
import re
from html.parser import HTMLParser

import pytest
from profiled import DATASET, modelled_time, profile, record, strategies

from mpmbench.record import Record
from mpmbench.report import document, html_text, markdown_text, modelled, plots, speed_of_light
from mpmbench.report import profile as pages
from mpmbench.report.modelled import Span, break_even, gpu_groups, ranks, winners
from mpmbench.report.table import Kind, Quantity, Table
from mpmbench.report.text import format_value

GPUS = ("gtx970", "a100")


def column(table: Table, title: str) -> list:
    at = [c.title for c in table.columns].index(title)
    return [row.cells[at].value for row in table.rows]


def section(doc: document.Document, begin: str) -> document.Section:
    return next(s for s in doc.sections if s.title.startswith(begin))


def timed(variant: str, seconds: float, low: float, high: float, bound: str = "dram", **changes) -> Record:
    time = modelled_time("gtx970", bound, seconds, low / seconds, high / seconds)
    return record(variant, (profile(time, {"grid_clear": 0.0, "bin": 0.0, "reorder_deep": 0.0}),), **changes)


# ---- ranks ---------------------------------------------------------------------------------------------------


def test_overlapping_ranges_share_the_mark():
    spans = [Span(1, 0.9, 1.1), Span(1.05, 1.0, 1.2), Span(1.3, 1.15, 1.5), Span(3, 2, 4), None]
    assert ranks(spans) == ["1=", "1=", "2=", "4", None]
    assert ranks([Span(1, 1, 1)]) == ["1"]


def test_winner_and_those_who_cannot_be_told_from_it():
    (g,) = gpu_groups(strategies())
    assert [r.variant for r in winners(g, g.transfer)] == ["p2g_block_sync", "p2g_block_pull"]
    ranking = modelled.ranking(g)
    assert column(ranking, "rank") == ["1=", "1=", "2=", "3=", "5"]
    assert column(ranking, "strategy")[-1] == "p2g_global_atomic"
    assert [row.baseline for row in ranking.rows] == [False] * 4 + [True]


def test_rank_with_the_sort_is_of_its_own():
    fast = timed("p2g_block_sync", 1e-3, 0.9e-3, 1.1e-3)
    costly = profile(fast.modelled["gtx970"].time, {"grid_clear": 0.0, "bin": 9e-3, "reorder_deep": 0.0})
    slow = timed("p2g_global_atomic", 2e-3, 1.9e-3, 2.1e-3)
    (g,) = gpu_groups([dataclasses.replace(fast, modelled={"gtx970": costly}), slow])
    ranking = modelled.ranking(g)
    assert column(ranking, "rank") == ["1", "2"]
    assert column(ranking, "rank with sort") == ["2", "1"]
    assert column(ranking, "per sort") == [pytest.approx(9e-3), None]
    table = modelled.winners_table([g])
    assert column(table, "fastest transfer") == ["p2g_block_sync"]
    assert column(table, "fastest with its sort") == ["p2g_global_atomic"]


# ---- break-even ------------------------------------------------------------------------------------------------


def test_break_even_in_time_with_both_ends_of_the_ranges():
    base = timed("p2g_global_atomic", 10e-3, 9e-3, 11e-3)
    time = modelled_time("gtx970", "issue", 6e-3, 4.5 / 6, 9.5 / 6)
    this = record("p2g_block_sync", (profile(time, {"grid_clear": 0.0, "bin": 10e-3, "reorder_deep": 0.0}),))
    (g,) = gpu_groups([base, this])
    nominal, at_best, at_worst = break_even(g, this)
    assert nominal == 3  # 10 / (10 - 6) = 2.5
    assert at_best == 2  # 7.5 / (11 - 4.5) = 1.2
    assert at_worst == math.inf  # 9.5 is never below 9
    assert break_even(g, base) is None
    assert "2 to never" in markdown_text([base, this])


def test_clearing_is_paid_with_every_transfer():
    made = strategies()[2]
    (g,) = gpu_groups([made])
    costs = g.costs(made)
    assert costs.per_sort.seconds == pytest.approx(360e-6)
    assert costs.per_transfer.seconds == pytest.approx(3.05e-3 + 40e-6)
    assert costs.total.low == pytest.approx(0.75 * costs.total.seconds)


def test_no_total_where_a_step_is_not_modelled():
    made = record("p2g_block_sync", (profile(modelled_time("gtx970", "issue", 1e-3), {"bin": 1e-4}),))
    (g,) = gpu_groups([made])
    assert g.costs(made) is None
    assert column(modelled.ranking(g), "sort and transfer") == [None]
    assert column(modelled.winners_table([g]), "fastest with its sort") == [None]
    assert html_text([made])


# ---- groups ----------------------------------------------------------------------------------------------------


def test_gpus_and_datasets_stay_apart_and_the_gpu_leads():
    other = dataclasses.replace(DATASET, name="random", fingerprint="cd" * 32, recipe={})
    records = strategies(GPUS) + strategies(GPUS, dataset=other)
    groups = gpu_groups(records)
    assert [(g.gpu, g.group.first.dataset.name) for g in groups] == [
        ("gtx970", "uniform_cube"), ("gtx970", "random"), ("a100", "uniform_cube"), ("a100", "random"),
    ]  # fmt: skip
    table = modelled.winners_table(groups)
    assert column(table, "GPU") == ["gtx970", "gtx970", "a100", "a100"]
    assert len(gpu_groups([dataclasses.replace(r, modelled=None) for r in records])) == 0


def test_problems_are_named_where_the_dataset_does_not_tell_them_apart():
    double = [dataclasses.replace(r, axes={**r.axes, "dtype": "float64"}) for r in strategies()]
    (single,) = gpu_groups(strategies())
    assert single.title == "P2G on uniform_cube (4 per cell), NVIDIA GeForce GTX 970"
    titles = [g.title for g in gpu_groups([*strategies(), *double])]
    assert len(set(titles)) == 2
    assert "1,000,000 particles, cubic, pic, float64, compiled for sm_52" in titles[1]


def test_what_failed_has_no_place():
    wrong = dataclasses.replace(strategies()[2], failed_because="launch error")
    (g,) = gpu_groups([*strategies()[:2], wrong])
    assert "p2g_block_sync" not in [r.variant for r in g.runs]


# ---- kinds -----------------------------------------------------------------------------------------------------


def tables_of(doc: document.Document) -> list[Table]:
    modelled_parts = [s for s in doc.sections if s.title.startswith(("What would", "Profile"))]
    folded = [part for s in modelled_parts for part in (*s.details, *s.cards)]
    return [t for s in modelled_parts for t in s.tables] + [t for part in folded for t in part.tables]


def test_every_modelled_table_names_its_gpu_and_no_column_is_measured():
    shown = tables_of(document.build(strategies(GPUS)))
    assert len(shown) > 10
    for table in shown:
        if Kind.MODELLED in table.kinds and table.columns[0].title != "GPU" and table.title:
            assert "NVIDIA" in table.title
        assert Kind.MEASURED not in table.kinds
        for col in table.columns:
            if col.quantity in (Quantity.SECONDS, Quantity.SECONDS_RANGE):
                assert col.kind is Kind.MODELLED


def test_instructions_of_a_line_are_simulated_and_its_traffic_modelled():
    made = strategies()[0]
    table = pages.hottest_lines(made, made.modelled["gtx970"])
    kinds = {c.title: c.kind for c in table.columns}
    assert kinds["warp inst"] is Kind.SIMULATED
    assert kinds["DRAM sectors"] is Kind.MODELLED
    assert column(table, "line") == [f"p2g.cu:{40 + i}" for i in range(6)]
    assert column(table, "share of activations")[0] == 0.5
    assert column(table, "source")[1] == "add(nodes.mass, at, w_1 * mass);"


def test_metrics_in_the_words_of_the_thesis():
    (g,) = gpu_groups(strategies())
    table = pages.metrics(g)
    assert column(table, "VRAM SOL%") == [61.25] * 5
    assert column(table, "SM Occupancy") == [43.3] * 5
    assert column(table, "limiter") == ["shared memory"] * 5
    bare = dataclasses.replace(g.profile(g.runs[0]), metrics={})
    (without,) = gpu_groups([dataclasses.replace(g.runs[0], modelled={"gtx970": bare})])
    assert pages.metrics(without) is None


def test_traffic_over_the_compulsory():
    (g,) = gpu_groups([strategies()[0]])
    table = pages.traffic(g)
    assert column(table, "DRAM / compulsory") == [pytest.approx(32 * 80_000_000 / 60_000_000)]
    assert column(table, "L2 bytes") == [32 * (90_000_000 - 40_000_000 + 40_000_000)]


def test_uncalibrated_times_say_why():
    records = strategies(GPUS)
    for text in (html_text(records), markdown_text(records)):
        assert "ncalibrated: the atomic rate of this GPU is not known." in text.replace(":** ", ": ")
    doc = document.build(records)
    (row,) = [r for t in tables_of(doc) if t.title.startswith("Modelled") and "A100" in t.title for r in t.rows
              if "atomics" in [c.value for c in r.cells]]  # fmt: skip
    assert "uncalibrated" in [c.value for c in row.cells]
    cards = section(doc, "Profile: P2G on uniform_cube (4 per cell), NVIDIA GeForce")
    assert not any(card.badge for card in cards.cards)  # of the GTX 970


# ---- the head --------------------------------------------------------------------------------------------------


def test_the_answer_names_gpu_time_range_and_doubt():
    doc = document.build(strategies())
    assert doc.answer[0].startswith("No GPU took part")
    assert doc.answer[1] == (
        "Modelled, P2G on uniform_cube (4 per cell), NVIDIA GeForce GTX 970: p2g_block_sync, 3.05 ms "
        "(2.29 to 3.81 ms), 14.6 times as fast as unsorted p2g_global_atomic (transfer alone); within the "
        "model's error of p2g_block_pull."
    )
    assert doc.sections[0].title == "What would it do on my GPU?"
    assert doc.sections[1].title.startswith("Profile: P2G")


def test_a_baseline_within_the_error_is_not_beaten():
    base, this = timed("p2g_global_atomic", 1.1e-3, 1e-3, 1.3e-3), timed("p2g_block_sync", 1e-3, 0.9e-3, 1.2e-3)
    said = document.build([base, this]).answer[1]
    assert "it cannot be told from unsorted p2g_global_atomic" in said
    assert "times as fast" not in said


# ---- charts ----------------------------------------------------------------------------------------------------


def test_the_bar_is_term_over_time_and_marks_what_binds():
    made = profile(modelled_time("gtx970", "issue", 1e-3, latency=0.8))
    chart = speed_of_light.speed_of_light(made)
    assert dict(zip(chart.labels, chart.shares, strict=True))["latency"] == pytest.approx(0.8)
    assert [chart.labels[i] for i in chart.binding] == ["issue", "latency"]
    svg = plots.svg(chart)
    assert "binds" in svg
    assert "80 %  may bind" in svg
    assert 'role="img"' in svg


def test_the_roofline_is_instructions_over_transactions():
    made = record(profiles=(profile(modelled_time("gtx970", "issue", 1e-3), sectors=(5_000_000, 2_000_000)),))
    chart = speed_of_light.roofline(made, made.modelled["gtx970"])
    assert {level.name: level.intensity for level in chart.levels} == pytest.approx(
        {"L1": 20_000_000 / 9_400_000, "L2": 4.0, "DRAM": 10.0}
    )
    assert chart.achieved == pytest.approx(20e9)
    assert chart.low < chart.achieved < chart.high
    assert {level.name: level.rate for level in chart.levels}["DRAM"] == pytest.approx(175e9 / 32)
    assert "issue limit 61.2" in plots.svg(chart)


@pytest.mark.parametrize("changes", [{"peak": {}}, {"sectors": (0, 0), "peak": {"warp_inst": 1e9}}])
def test_no_roofline_without_what_it_stands_on(changes):
    made = record(profiles=(profile(modelled_time("gtx970", "issue", 1e-3), **changes),))
    assert speed_of_light.roofline(made, made.modelled["gtx970"]) is None
    assert html_text([made])


@pytest.mark.parametrize(
    ("value", "quantity", "text"),
    [
        ((1e-3, 2e-3), Quantity.SECONDS_RANGE, "1 to 2 ms"),
        ((9e-4, 2e-3), Quantity.SECONDS_RANGE, "900 µs to 2 ms"),
        ((1e-3, 1e-3), Quantity.SECONDS_RANGE, "1 ms"),
        (None, Quantity.SECONDS_RANGE, "–"),
        ((1, 1), Quantity.TRANSFERS_RANGE, "at once"),
        ((1, math.inf), Quantity.TRANSFERS_RANGE, "at once to never"),
        ((2, 1500), Quantity.TRANSFERS_RANGE, "2 to 1,500"),
    ],
)
def test_ranges_as_text(value, quantity, text):
    assert format_value(value, quantity) == text


# ---- pages -----------------------------------------------------------------------------------------------------


class Text(HTMLParser):
    def __init__(self, page: str) -> None:
        super().__init__()
        self.pieces: list[str] = []
        self.open: list[str] = []
        self.feed(page)
        assert not self.open

    def handle_starttag(self, tag, attrs):
        if tag not in ("meta",):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.pieces.append(data)


def test_html_and_markdown_say_the_same():
    records = strategies(GPUS)
    doc = document.build(records)
    html, markdown = "".join(Text(html_text(records)).pieces), re.sub(r"\\(.)", r"\1", markdown_text(records))
    cards = [card for s in doc.sections for card in s.cards]
    assert len(cards) == 10
    for card in cards:
        for words in (card.title, card.headline, card.sentence, card.badge):
            assert words in html
            assert words in markdown
    for table in tables_of(doc):
        for row in table.rows:
            for cell, col in zip(row.cells, table.columns, strict=True):
                if cell.value is not None:
                    assert format_value(cell.value, col.quantity) in html


def test_odd_names_stay_text():
    odd = '<script>alert("x")</script> | `a` *b*'
    time = modelled_time("gtx970", "atomics", 1e-3, reason=odd)
    made = record("p2g_" + odd, (profile(time, title=odd),))
    html = html_text([made, record(profiles=(profile(time, title=odd),))])
    assert "<script>alert" not in html
    assert odd in "".join(Text(html).pieces)
    assert "<script>alert" not in re.sub(r"(`+) ?.*?\1", "", markdown_text([made])).replace("\\<", "")


def test_a_large_page_sheds_charts_and_keeps_sentences(monkeypatch):
    from mpmbench import report

    monkeypatch.setattr(report, "HTML_LIMIT", 200_000)
    records = strategies(("gtx970", "a100", "h100"))
    page = html_text(records)
    assert len(page.encode()) <= 200_000
    assert re.search(r"charts and lines of \d+ profiles", page)
    assert page.count('class="card"') == 15
    assert page.count("Bound by") == 15


def test_a_primitive_has_a_profile_and_no_ranking():
    made = record("scan_shuffle", (profile(modelled_time("gtx970", "dram", 1e-4)),), transfer="scan")
    doc = document.build([made])
    assert not [s for s in doc.sections if s.title.startswith("What would")]
    assert section(doc, "Profile: Scan on uniform_cube (4 per cell), NVIDIA").intro.startswith("1,000,000 elements, ")


def test_records_without_profiles_make_the_page_they_made():
    text = markdown_text([dataclasses.replace(r, modelled=None) for r in strategies()])
    assert "What would it do" not in text
    assert "Profile" not in text
