"""Reports say what the records say: kinds apart, bad runs in sight and unranked, nothing from the network."""

from __future__ import annotations

import dataclasses
import errno
import math
import os
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import pytest

from mpmbench import report
from mpmbench.environment import Environment
from mpmbench.errors import InputError
from mpmbench.grid import Grid
from mpmbench.record import Check, DatasetSummary, Measurement, Record, StepCost
from mpmbench.report import document, html_text, markdown_text, plots, write_report
from mpmbench.report import measured as times
from mpmbench.report import table as tables
from mpmbench.report.markdown import code, escape
from mpmbench.report.table import Cell, Column, Kind, Quantity, Row, Split, Table, break_even
from mpmbench.report.text import format_value
from mpmbench.simt.counters import Counters, Finding, SourceLine, Tally

GOLDEN = Path(__file__).parent / "golden" / "report.md"

ENVIRONMENT = Environment(
    mpmbench="0.1.0", git_commit="c0ffee", git_dirty=False, python="3.11.0", numpy="2.0", numba="0.68", llvmlite="0.50",
    nvrtc="12.9", cpu="A CPU", cores=2, os="Linux", date="2026-01-01T00:00:00+00:00", argv=("mpmbench", "run"), seed=1,
)  # fmt: skip
DATASET = DatasetSummary(
    "uniform_cube", {"particles_per_cell": 4}, 1, 1000, Grid((16, 16, 16), 0.1), "ab" * 32,
    {"cells_occupied": 250, "mean_per_cell": 4.0, "histogram": {"1": 0, "3-4": 250}},
)  # fmt: skip
GLOBAL_AXES = {"dtype": "float32", "spline": "cubic", "payload": "pic", "layout": "soa", "particle_order": "given"}
BLOCK_AXES = {**GLOBAL_AXES, "particle_order": "deep", "block_shape": (8, 4, 4), "batching": 1}


def counters(warp_inst: int, sectors: int) -> Counters:
    line, other = SourceLine("p2g.cu", 12), SourceLine("p2g.cu", 13)
    total = Tally(
        warp_inst=warp_inst, lane_inst=30 * warp_inst, branch=100, div_branch=5, gld_req=50, gatom_req=500,
        gatom_lane=16_000, gatom_sectors=sectors, gatom_pass=2 * sectors,
    )  # fmt: skip
    return Counters(total, {line: Tally(warp_inst=warp_inst - 7), other: Tally(warp_inst=7, gatom_sectors=sectors)})


def simulated(variant: str = "p2g_global_atomic", warp_inst: int = 20_000, sectors: int = 300_000, **changes) -> Record:
    """A good run on the simulated device."""
    defaults = BLOCK_AXES if "block" in variant else GLOBAL_AXES
    axes = {**defaults, **changes.pop("axes", {})}
    preprocess = {"grid_clear": StepCost(counters(100, 1000))}
    if axes["particle_order"] != "given":
        preprocess["bin"] = StepCost(counters(2_000, 4_000))
    made = Record(
        variant=variant,
        transfer=variant[:3],
        dataset=DATASET,
        axes=axes,
        default_axes=defaults,
        device="simulated",
        arch="sm_52",
        environment=ENVIRONMENT,
        variant_summary="what it does",
        check=Check(True, 1e-7, 1e-6, (1, 2, 3)),
        preprocess=preprocess,
        transfer_counters=counters(warp_inst, sectors),
        line_texts={SourceLine("p2g.cu", 12): "w = a | b;", SourceLine("p2g.cu", 13): "atomicAdd(&node, w);"},
        hashes={variant: "cd" * 32},
        kernel_info={variant: {"arch": "sm_52", "registers": 40, "shared_bytes": 0, "spill_bytes": 0}},
        floor_bytes=64_000,
        device_bytes_predicted=1 << 20,
        host_seconds=0.5,
    )
    return dataclasses.replace(made, **changes)


def measured(record: Record, transfer: float, step: float = 1e-5) -> Record:
    """The same run on a GPU, with these times [s]."""

    def time(seconds: float) -> Measurement:
        return Measurement((seconds,) * 10, "cold", 5, "precision")

    environment = dataclasses.replace(ENVIRONMENT, gpu={"name": "Test GPU", "driver": "1.0"})
    return dataclasses.replace(
        record, device="cuda:0", arch="sm_90", environment=environment, transfer_counters=None, line_texts={},
        preprocess={name: StepCost(None, time(step)) for name in record.preprocess},
        transfer_measurement=time(transfer),
    )  # fmt: skip


def strategies() -> list[Record]:
    return [
        simulated(),
        simulated(axes={"particle_order": "deep"}, sectors=100_000, warp_inst=21_000),
        simulated("p2g_block_sync", 60_000, 15_000),
        simulated("p2g_block_sync", 50_000, 16_000, axes={"batching": 4}),
    ]


def bad_runs() -> list[Record]:
    race = Finding("race", "k", "two warps write s[3]", SourceLine("a.cu", 4), SourceLine("a.cu", 9), 17)
    nothing = {"check": None, "preprocess": {}, "transfer_counters": None, "kernel_info": {}}
    return [
        simulated("p2g_wrong", 1, 1, check=Check(False, 3e-4, 1e-6, (4, 5, 6))),
        simulated("p2g_racy", 2, 2, findings=(race,)),
        simulated("p2g_big", **nothing, skipped_because="needs 99 GiB"),
        simulated("p2g_odd", **nothing, failed_because="opcode tex.3d at a.cu:3"),
        simulated("p2g_lazy", 3, 3, check=None),
    ]


def all_tables(doc: document.Document) -> list[Table]:
    return [t for s in doc.sections for t in (*s.tables, *(t for d in s.details for t in d.tables))]


def column(table: Table, title: str) -> list:
    at = [c.title for c in table.columns].index(title)
    return [row.cells[at].value for row in table.rows]


# ---- kinds ---------------------------------------------------------------------------------------------------


def test_a_cell_of_another_kind_is_refused():
    columns = (Column("sectors", Kind.SIMULATED),)
    Table("t", columns, (Row((Cell(1, Kind.SIMULATED),)),))
    with pytest.raises(ValueError, match="a measured value in the simulated column 'sectors'"):
        Table("t", columns, (Row((Cell(1, Kind.MEASURED),)),))


def test_measured_and_simulated_numbers_are_in_tables_of_their_own():
    records = strategies()
    doc = document.build(records + [measured(r, 1e-3) for r in records])
    shown = all_tables(doc)
    assert {k for t in shown for k in t.kinds} == {Kind.SIMULATED, Kind.MEASURED, Kind.CHECKED, Kind.PREDICTED}
    assert not [t.title for t in shown if {Kind.SIMULATED, Kind.MEASURED} <= set(t.kinds)]


def test_no_time_in_a_report_without_a_gpu():
    shown = all_tables(document.build(strategies()))
    assert not [c.title for t in shown for c in t.columns if c.kind is Kind.MEASURED or c.quantity is Quantity.SECONDS]
    for title in (t.title for t in shown if "ank" in t.title or "ewest" in t.title):
        assert title.endswith("simulated, not time")


def test_only_what_is_comparable_is_compared():
    other = dataclasses.replace(DATASET, name="random", fingerprint="ef" * 32)
    records = [
        simulated(),
        simulated("g2p_global_gather"),
        simulated(dataset=other),
        simulated(axes={"dtype": "float64"}),
        simulated(arch="sm_90"),
        measured(simulated(), 1e-3),
        dataclasses.replace(measured(simulated(), 1e-3), arch="sm_52", environment=ENVIRONMENT),
    ]
    assert [len(g.records) for g in tables.group(records)] == [1] * len(records)
    assert [len(g.records) for g in tables.group(strategies())] == [4]
    order = [(g.first.transfer, g.first.dataset.name) for g in tables.group([records[1], records[2], records[0]])]
    assert order == [("p2g", "uniform_cube"), ("g2p", "uniform_cube"), ("p2g", "random")]
    assert len(tables.group([simulated(), simulated()])[0].records) == 1  # repeated, not compared with itself


# ---- ranking ---------------------------------------------------------------------------------------------------


def test_ranks_by_both_counters():
    (g,) = tables.group(strategies())
    ranking = tables.ranking(g)
    assert column(ranking, "strategy") == ["p2g_block_sync", "p2g_block_sync", "p2g_global_atomic", "p2g_global_atomic"]
    assert column(ranking, "axes changed") == ["", "batching=4", "particle_order=deep", ""]
    assert column(ranking, "rank by sectors") == [1, 2, 3, 4]
    assert column(ranking, "rank by warp inst") == [4, 3, 2, 1]
    assert column(ranking, "sectors / particle") == [15, 16, 100, 300]
    assert tables.WHY_RANKS_DISAGREE in ranking.notes
    assert [row.baseline for row in ranking.rows] == [False, False, False, True]
    assert g.baseline is not None
    assert tables.label(g.baseline) == "p2g_global_atomic"


def test_bad_runs_are_seen_and_never_ranked():
    (g,) = tables.group([*bad_runs(), *strategies()])
    ranking = tables.ranking(g)
    good, bad = range(4), range(4, 9)
    assert column(ranking, "rank by sectors") == [1, 2, 3, 4, *[None] * 5]
    assert all(ranking.best(c) <= set(good) for c in range(len(ranking.columns)))
    assert [column(ranking, "break-even, sectors")[i] for i in bad] == [None] * 5
    remarks = " | ".join(column(ranking, "remark")[i] for i in bad)
    for words in ("WRONG RESULT: error 300 times the allowance at 4x5x6", "skipped: needs 99 GiB", "found race",
                  "failed: opcode tex.3d at a.cu:3", "not checked"):  # fmt: skip
        assert words in remarks
    assert len(tables.counters(g).rows) == 4


@pytest.mark.parametrize("render", [html_text, markdown_text])
def test_bad_runs_come_before_any_table(render):
    text = render([*strategies(), *bad_runs()])
    head = re.sub(r"\\(.)", r"\1", text[: text.index("Answer in one table")])
    assert "4 runs of 8 cannot be trusted" in head
    for name in ("p2g_wrong", "p2g_racy", "p2g_big", "p2g_odd", "p2g_lazy"):
        assert name in head
    assert "two warps write s" in text
    assert "agree with the float64 reference" in render(strategies())


def test_the_verdict_is_about_what_ran():
    skipped = bad_runs()[2]
    assert document.build([skipped]).verdict == "Nothing ran: 1 run skipped."
    assert not document.build([skipped]).agreed
    good = document.build([*strategies(), skipped])
    assert good.agreed
    assert good.verdict == (
        "All 2 strategies agree with the float64 reference (4 runs on 1 dataset, worst error 0.100 of the allowance)."
    )


# ---- break-even ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("per_sort", "per_transfer", "expected"),
    [
        (0, 9, 1), (0.5, 9, 1), (1, 9, 2), (10, 9, 11), (10, 8, 6), (9.9, 8, 5),
        (10, 10, math.inf), (0, 11, math.inf), (-1, 10, 1),
    ],
)  # fmt: skip
def test_break_even(per_sort, per_transfer, expected):
    baseline = Split(0, 10)
    this = Split(per_sort, per_transfer)
    assert break_even(this, baseline) == expected
    if math.isfinite(expected):  # the first number of transfers that costs less, by trying them all

        def costs_less(k: int) -> bool:
            return this.per_sort + k * this.per_transfer < k * baseline.per_transfer

        assert next(k for k in range(1, 100) if costs_less(k)) == expected


def test_break_even_counts_the_sort_once_and_the_clear_every_time():
    deep = simulated(axes={"particle_order": "deep"}, sectors=100_000, warp_inst=20_001)
    (g,) = tables.group([simulated(), deep])
    assert tables.split(deep, tables.count_of(tables.sectors)) == Split(4_000, 101_000)
    ranking = tables.ranking(g)
    assert column(ranking, "break-even, sectors") == [1, None]
    assert column(ranking, "break-even, warp inst") == [math.inf, None]
    assert "at once" in markdown_text([simulated(), deep])
    assert "never" in markdown_text([simulated(), deep])
    preprocessing = tables.preprocessing(g)
    assert column(preprocessing, "sectors per sort / particle") == [4, 0]
    assert column(preprocessing, "sectors per transfer / particle") == [101, 301]
    assert column(preprocessing, "sectors total / particle") == [105, 301]


def test_no_baseline_no_break_even_and_it_says_so():
    doc = document.build(strategies()[1:])
    assert "break-even, sectors" not in [c.title for t in all_tables(doc) for c in t.columns]
    assert any("the baseline did not run" in a.text for a in doc.attention)


# ---- measured ----------------------------------------------------------------------------------------------------


def test_published_primitives_are_counted_per_element():
    scan = replace(
        simulated(preset_row={"source": "thesis", "table": 8, "row": "unrolled", "place": 0}), transfer="scan"
    )
    (table,) = tables.presets([scan])
    titles = [column.title for column in table.columns]
    assert "sectors / element" in titles
    assert not [title for title in titles if "particle" in title]


def test_no_winner_below_the_resolution_of_events():
    quick = [measured(simulated("p2g_block_sync"), 6e-6, step=1e-6), measured(simulated(), 9e-6, step=1e-6)]
    doc = document.build(quick)
    assert any("too short to say which is fastest" in line for line in doc.answer)
    assert not any(" use p2g" in line for line in doc.answer)
    fastest = [t for t in all_tables(doc) if t.title == "Fastest transfer, measured, caches cold"]
    assert [t.rows for t in fastest] == [()]


def test_measured_numbers():
    fast, slow = measured(simulated("p2g_block_sync"), 64e-6, step=1e-4), measured(simulated(), 640e-6, step=1e-4)
    (g,) = tables.group([slow, fast])
    table = times.ranking(g)
    assert column(table, "strategy") == ["p2g_block_sync", "p2g_global_atomic"]
    assert column(table, "transfer") == pytest.approx([64e-6, 640e-6])
    assert column(table, "ns / node visit") == pytest.approx([1, 10])
    assert column(table, "particles / s") == pytest.approx([1000 / 64e-6, 1000 / 640e-6])
    assert column(table, "speedup") == pytest.approx([10, 1])
    assert column(table, "preprocessing") == pytest.approx([2e-4, 1e-4])
    assert column(table, "break-even") == [1, None]
    assert column(table, "device memory") == [1 << 20] * 2
    assert (
        "use p2g_block_sync with block 8x4x4 and batching 1, 64 µs, 10.0 times as fast as unsorted p2g_global_atomic"
        in document.build([slow, fast]).answer[0]
    )


def test_doubtful_times_are_warned_of():
    quick = measured(simulated(), 5e-6)
    noisy = Measurement((1e-3, 2e-3, 3e-3), "cold", 5, "timeout")
    spilling = simulated(kernel_info={"k": {"spill_bytes": 8}})
    dirty = dataclasses.replace(ENVIRONMENT, git_dirty=True)
    for record, words in (
        (quick, "Too short for the resolution of events"),
        (dataclasses.replace(quick, transfer_measurement=noisy), "Samples scatter"),
        (spilling, "Kernel k spills 8 bytes"),
        (simulated(environment=dirty), "changes that are in no commit"),
    ):
        assert any(words in a.text for a in document.build([record]).attention)
    assert not document.build(strategies()).attention


# ---- published ---------------------------------------------------------------------------------------------------


def test_published_numbers_stand_beside_ours_in_columns_of_their_own():
    def row(name: str, us: float, speedup: float | None, **more) -> dict:
        printed = {"source": "thesis", "table": 13, "row": name, "published_us": us, "published_speedup": speedup}
        return printed | {"published": {"sm_percent": "61.3"}} | more

    records = [
        simulated(preset_row=row("global", 254410.0, None)),
        simulated("p2g_block_sync", 60_000, 15_000, preset_row=row("P2G-Sync*", 12801.0, 19.87, erratum="misprint")),
    ]
    (table,) = tables.presets(records)
    assert table.title == "Thesis, table 13: P2G on uniform_cube"
    kinds = {c.title: c.kind for c in table.columns}
    assert {t for t, k in kinds.items() if k is Kind.PUBLISHED} == {"time [µs]", "speedup", "sm [%]"}
    assert column(table, "sectors, baseline / this") == [None, 20]
    assert column(table, "warp inst, baseline / this") == [None, pytest.approx(1 / 3)]
    assert table.notes == ("Erratum. P2G-Sync*: misprint",)
    assert all(word in markdown_text(records) for word in ("254,410", "12,801", "19.87", "61.3"))


def test_published_rows_come_in_the_order_printed():
    def run(table: int, place: int) -> Record:
        return simulated(preset_row={"table": table, "row": f"{table}.{place}", "place": place}, sectors=table + place)

    found = tables.presets([run(12, 0), run(9, 1), run(12, 2), run(9, 0), run(12, 1)])
    assert [column(t, "row as printed") for t in found] == [["9.0", "9.1"], ["12.0", "12.1", "12.2"]]


def test_a_second_row_without_a_speedup_is_a_second_baseline():
    """Table 15 of the thesis prints two families of rows, each against its own first row."""
    speedups = (None, 1.1, None, 1.2)
    records = [
        simulated(
            sectors=s, axes={"batching": i}, preset_row={"table": 15, "row": str(i), "published_speedup": speedup}
        )
        for i, (s, speedup) in enumerate(zip((400, 200, 900, 300), speedups, strict=True))
    ]
    (table,) = tables.presets(records)
    assert column(table, "sectors, baseline / this") == [None, 2, None, 3]


# ---- hottest lines, datasets ---------------------------------------------------------------------------------------


def test_hottest_lines_are_those_of_either_counter():
    lines = {SourceLine("/x/k.cu", i): Tally(warp_inst=100 - i, gld_sectors=i) for i in range(20)}
    total = Tally(warp_inst=sum(t.warp_inst for t in lines.values()), gld_sectors=sum(range(20)))
    record = simulated(transfer_counters=Counters(total, lines), line_texts={SourceLine("/x/k.cu", 0): "first();"})
    table = tables.hottest_lines(record, "name")
    assert table is not None
    assert column(table, "line") == [f"k.cu:{i}" for i in (*range(5), *range(15, 20))]
    assert column(table, "source")[0] == "first();"
    assert column(table, "share of warp inst")[0] == pytest.approx(100 / total.warp_inst)
    assert column(table, "share of sectors")[-1] == pytest.approx(19 / 190)
    assert tables.hottest_lines(measured(simulated(), 1.0), "name") is None


def test_dataset_statistics_are_shown():
    table = tables.datasets(strategies())
    assert table is not None
    assert column(table, "dataset") == ["uniform_cube (4 per cell)"]
    assert column(table, "cells occupied") == [250]
    assert "histogram" not in [c.title for c in table.columns]
    (histogram,) = tables.distributions(strategies())
    assert column(histogram, "3-4") == [250]
    assert histogram.title in markdown_text(strategies())


# ---- Markdown ------------------------------------------------------------------------------------------------------


def test_golden_markdown():
    """To renew after a wanted change: MPMBENCH_RENEW_GOLDEN=1 pytest tests/test_report.py, then read the diff."""
    text = markdown_text([*strategies(), *bad_runs()])
    if os.environ.get("MPMBENCH_RENEW_GOLDEN"):
        GOLDEN.parent.mkdir(exist_ok=True)
        GOLDEN.write_text(text)
    assert text == GOLDEN.read_text()


ODD = '<script>alert("x")</script> | `a` *b* [c](d) & \\ \n# e'


def test_odd_names_stay_text_in_markdown():
    odd = dataclasses.replace(DATASET, name=ODD)
    text = markdown_text([simulated("p2g_" + ODD, dataset=odd, skipped_because=None), simulated(dataset=odd)])
    outside = re.sub(r"(`+) ?.*?\1", "", text)
    assert not re.search(r"(?<!\\)<script>", outside)
    assert not re.search(r"^# e", text, re.MULTILINE)
    for block in re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE):  # every row has as many cells as its header
        widths = {len(re.findall(r"(?<!\\)\|", line)) for line in block.splitlines()}
        assert len(widths) == 1
    assert escape("a_b*c") == r"a\_b\*c"
    assert code("a ``b` c") == "``` a ``b` c ```"


# ---- HTML ----------------------------------------------------------------------------------------------------------


class Page(HTMLParser):
    """Collects what a page is made of, and fails on tags that do not match."""

    VOID = ("meta", "br", "hr", "link", "img", "input")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str | None]] = []
        self.text: list[str] = []
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += attrs
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += attrs

    def handle_data(self, data):
        self.text.append(data)


def test_html_needs_nothing_but_itself():
    records = strategies()
    text = html_text([*records, *bad_runs(), *(measured(r, 1e-3) for r in records)])
    page = Page(text)
    assert not re.search(r"https?:|//[a-z]|@import|url\((?!#)", text.replace("// Without", ""))
    assert not {"link", "img", "iframe", "object", "embed", "base"} & set(page.tags)
    links = [value for name, value in page.attributes if name in ("src", "href", "srcset", "action")]
    ids = {value for name, value in page.attributes if name == "id"}
    assert links
    assert all(link and link.startswith("#") and link[1:] in ids for link in links)
    assert page.tags.count("svg") == 4 + 2
    assert ("name", "viewport") in page.attributes
    assert "prefers-color-scheme: dark" in text
    assert page.tags.count("table") == len(re.findall(r'<div class="scroll"', text))


def test_html_says_what_markdown_says():
    """Every table of the document, cell by cell."""
    records = [*strategies(), *bad_runs()]
    text = html_text(records)
    assert "<small> batching=4</small>" in text  # the column that HTML shows beneath the strategy
    shown = "".join(Page(text).text)
    for table in all_tables(document.build(records)):
        for row in table.rows:
            for cell, col in zip(row.cells, table.columns, strict=True):
                assert format_value(cell.value, col.quantity) in shown


def test_odd_names_stay_text_in_html():
    odd = dataclasses.replace(DATASET, name=ODD)
    attack = simulated("p2g_" + ODD, dataset=odd, line_texts={SourceLine("p2g.cu", 12): ODD})
    text = html_text([attack, simulated(dataset=odd)])
    page = Page(text)
    assert page.tags.count("script") == 1  # ours
    assert "<script>alert" not in text
    assert any(ODD in piece for piece in page.text)


def test_a_large_report_sheds_details_and_says_so(monkeypatch):
    lines = {SourceLine("p2g.cu", i): Tally(warp_inst=1 + i, gld_sectors=i) for i in range(30)}
    base = strategies()[2]
    assert base.transfer_counters is not None
    heavy = dataclasses.replace(
        base,
        transfer_counters=Counters(base.transfer_counters.total, lines),
        line_texts={line: "x" * 400 for line in lines},
    )
    monkeypatch.setattr(report, "HTML_LIMIT", 100_000)  # a small limit keeps the test quick
    text = html_text([dataclasses.replace(heavy, axes={**heavy.axes, "batching": i}) for i in range(40)])
    assert len(text.encode()) <= 100_000
    assert "Left out to keep the page small: hottest lines" in text
    assert "Left out" not in html_text(strategies())
    many = [dataclasses.replace(base, axes={**base.axes, "batching": i}) for i in range(200)]
    text = html_text([*strategies(), *many])
    assert len(text.encode()) <= 100_000
    assert re.search(r"\d+ more rows are left out", text)


def test_pages_do_not_change_from_run_to_run():
    first = html_text(strategies())
    plots.svg.cache_clear()
    assert html_text(strategies()) == first


def test_charts_show_their_values_as_text():
    svg = plots.svg(plots.Bars("Sectors", "per particle", ("a<b", "c"), (1234.0, 0.5), 1))
    assert "font-family" not in svg  # the page's
    for word in ("a&lt;b", "1,234", "0.5", "currentColor", "var(--series-0)", "var(--muted)", 'role="img"'):
        assert word in svg
    assert "#0" not in svg.replace('"#', "")  # no placeholder colour is left
    assert len(svg) < 6_000
    line = plots.Line("x", (1.0, 10.0), (5.0, 5.0), baseline=True)
    assert "x (baseline)" in plots.svg(plots.Lines("t", "y", "x", (line,)))


def test_a_chart_of_many_lines_keeps_the_baseline_and_the_best():
    lines = [plots.Line(str(i), (1.0, 2.0), (10.0 + i, 10.0 + i)) for i in range(20)]
    lines.append(plots.Line("base", (1.0, 2.0), (99.0, 99.0), baseline=True))
    assert [line.label for line in plots.thin(lines)] == [*map(str, range(7)), "base"]


# ---- files and edges -------------------------------------------------------------------------------------------------


def test_write_report(tmp_path):
    write_report(strategies(), html=tmp_path / "new" / "r.html", markdown=tmp_path / "r.md")
    assert (tmp_path / "new" / "r.html").read_text(encoding="utf-8") == html_text(strategies())
    assert (tmp_path / "r.md").read_text(encoding="utf-8") == markdown_text(strategies())
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["new", "r.html", "r.md"]
    with pytest.raises(InputError, match="no records"):
        write_report([], html=tmp_path / "empty.html")


def test_a_full_disk_leaves_the_old_report(tmp_path, monkeypatch):
    path = tmp_path / "r.md"
    path.write_text("old")

    def full(self: Path, text: str, **options) -> None:
        self.write_bytes(b"")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(InputError, match=r"cannot write the report to .*r\.md: no space left on device"):
        write_report(strategies(), markdown=path)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("record", [
    simulated(dataset=dataclasses.replace(DATASET, n=0), transfer_counters=Counters(), preprocess={}),
    simulated(dataset=dataclasses.replace(DATASET, statistics={}, recipe={}), default_axes={}),
    simulated(check=Check(False, math.nan, 0.0)),
    simulated("g2g_unheard_of", axes={"spline": "linear"}),
])  # fmt: skip
def test_unusual_records_still_make_a_report(record):
    Page(html_text([record, strategies()[2]]))
    assert markdown_text([record])


@pytest.mark.parametrize(
    ("value", "quantity", "text"),
    [
        (0, Quantity.NUMBER, "0"),
        (300.00000000000006, Quantity.NUMBER, "300"),
        (100, Quantity.NUMBER, "100"),
        (1.5, Quantity.NUMBER, "1.50"),
        (20.0, Quantity.NUMBER, "20"),
        (0.0123456, Quantity.NUMBER, "0.0123"),
        (123456.7, Quantity.NUMBER, "123,457"),
        (2.5e-7, Quantity.NUMBER, "2.5e-07"),
        (999.7, Quantity.NUMBER, "1,000"),
        (9.996, Quantity.NUMBER, "10.0"),
        (0.9996, Quantity.NUMBER, "1.00"),
        (math.nan, Quantity.NUMBER, "nan"),
        (None, Quantity.NUMBER, "–"),
        (None, Quantity.TEXT, ""),
        (1, Quantity.TRANSFERS, "at once"),
        (1234.0, Quantity.TRANSFERS, "1,234"),
        (math.inf, Quantity.TRANSFERS, "never"),
        (1536, Quantity.BYTES, "1.50 KiB"),
        (12801e-6, Quantity.SECONDS, "12.8 ms"),
        (4e-7, Quantity.SECONDS, "400 ns"),
        (12801.0, Quantity.PRINTED, "12,801"),
        (19.87, Quantity.PRINTED, "19.87"),
        (2.5e9, Quantity.RATE, "2.50 G"),
        (0.1234, Quantity.SHARE, "12.3 %"),
        (3.917, Quantity.FACTOR, "3.92×"),
    ],
)
def test_numbers_as_text(value, quantity, text):
    assert format_value(value, quantity) == text
