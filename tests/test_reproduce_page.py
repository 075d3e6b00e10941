"""The page and the command, on made-up rows: nothing left out, kinds apart, stamps where they belong."""

from __future__ import annotations

import json
import re

import pytest
from click.testing import CliRunner
from made_up_rows import CONSTANTS, retime, row, thesis_rows

from mpmbench.cli import main
from mpmbench.gpu import get_gpu
from mpmbench.presets import published_rows
from mpmbench.report.plots import svg
from mpmbench.report.scatter import Point, Scatter
from mpmbench.report.table import Kind
from mpmbench.reproduce import frozen, page, rows, sensitivity, targets
from mpmbench.reproduce.cells import terms_bars
from mpmbench.reproduce.comparable import judge
from mpmbench.reproduce.score import score
from mpmbench.reproduce.thesis_tables import banks_section, baselines_of, ranks, times_section
from mpmbench.reproduce.verified import verified_parts

MISSES = {(12, "G2P-global"): 0.24, (14, "global"): 0.47, (8, "Seq. (2x)"): 1.9}


def reproduction(found=None, differs=(), history=(), verified=None) -> page.Reproduction:
    found = found or thesis_rows(lambda table, name: MISSES.get((table, name), 1.0))
    judged, gpu = judge(found), get_gpu("gtx970")
    total = score(judged)
    verified = verified_parts() if verified is None else verified
    return page.Reproduction(
        gpu, CONSTANTS, judged, total, targets.targets(judged, total, gpu),
        sensitivity.sensitivity(found, CONSTANTS, retime), differs, history, verified,
    )  # fmt: skip


@pytest.fixture(scope="module")
def document():
    return page.document(reproduction())


def section(document, begin: str):
    return next(one for one in document.sections if one.title.startswith(begin))


def column(table, title: str, kind: Kind) -> list:
    (place,) = [i for i, one in enumerate(table.columns) if (one.title, one.kind) == (title, kind)]
    return [one.cells[place].value for one in table.rows]


# --- the page ---------------------------------------------------------------------------------------------------------


def test_answer_comes_first_and_misses_before_the_tables(document) -> None:
    assert document.verdict.startswith(
        "Half of 45 comparable rows are modelled within a factor of 1.00, the worst within 4.17;"
    )
    assert not document.agreed
    titles = [one.title for one in document.sections]
    assert titles[:3] == ["Targets", "Misses, worst first", "Modelled against published"]
    assert [int(title.split(":")[0][6:]) for title in titles if re.match(r"Table \d", title)] == list(range(3, 19))


def test_misses_are_sorted_and_every_scored_row_is_among_them_or_the_rest(document) -> None:
    misses = section(document, "Misses")
    (shown,), (rest,) = misses.tables, misses.details
    assert column(shown, "row as printed", Kind.NAME) == [
        "Table 12: G2P-global", "Table 14: global", "Table 8: Seq. (2x)"
    ]  # fmt: skip
    assert column(shown, "modelled / published", Kind.MODELLED) == pytest.approx([0.24, 0.47, 1.9])
    assert "which it does not state" in column(shown, "likely cause", Kind.NAME)[0]
    assert len(shown.rows) + len(rest.tables[0].rows) == 45


def test_a_row_without_a_time_leads_the_misses_and_is_named_on_top() -> None:
    found = thesis_rows()
    found[0] = row(5, "AoS", 243, None, failed="no memory")
    made = page.document(reproduction(found))
    (shown,) = section(made, "Misses").tables
    assert column(shown, "row as printed", Kind.NAME) == ["Table 5: AoS"]
    assert column(shown, "likely cause", Kind.NAME) == ["No modelled time: no memory."]
    assert any("table 5, AoS: no memory" in item.text for item in made.attention)
    assert page.html(reproduction(found))


def test_every_printed_time_stands_as_printed_with_both_speedups() -> None:
    judged, gpu = judge(thesis_rows()), get_gpu("gtx970")
    for number in range(5, 17):
        times = times_section(number, judged, gpu).tables[0]
        printed = published_rows(number)
        assert column(times, "time [µs]", Kind.PUBLISHED) == [float(one["time_us"]) for one in printed]
        if any(one.get("speedup") for one in printed):
            assert column(times, "speedup as printed", Kind.PUBLISHED) == [one["speedup"] or None for one in printed]
        for one in printed:
            if one["erratum"]:
                assert any(one["erratum"] in note for note in times.notes)
    fourteen = times_section(14, judged, gpu).tables[0]
    assert column(fourteen, "speedup by the times", Kind.PUBLISHED)[-1] == pytest.approx(44442 / 2595)
    assert column(fourteen, "rank", Kind.PUBLISHED) == [6, 7, 5, 4, 3, 2, 1]


def test_metrics_stand_as_printed_and_ours_apart() -> None:
    _, counters = times_section(6, judge(thesis_rows()), get_gpu("gtx970")).tables
    assert column(counters, "L2 hit [%]", Kind.PUBLISHED) == ["53.8", "20.0"]
    assert column(counters, "L2 hit [%]", Kind.SIMULATED) == [40, 40]
    assert column(counters, "VRAM [%]", Kind.MODELLED) == pytest.approx([0.9 * 61.3, 0.9 * 75.4])
    assert column(counters, "DRAM [MB]", Kind.PUBLISHED) == pytest.approx([37.76, 40.54], abs=0.01)
    _, pull = times_section(14, judge(thesis_rows()), get_gpu("gtx970")).tables
    assert column(pull, "occupancy [warps]", Kind.PUBLISHED)[4] == 16


def test_baseline_is_the_last_row_that_prints_no_speedup() -> None:
    judged = [one for one in judge(thesis_rows()) if one.row.table == 15]
    names = [base and base.row.row for base in baselines_of(judged)]
    assert names == [None, "P2G-Atomic", "P2G-Atomic", "P2G-Atomic", None, "P2G-Sync"]
    assert ranks([30.0, None, 10.0, 30.0]) == [2, None, 1, 2]


def test_rows_that_are_not_scored_are_shown_with_their_reason_and_what_they_would_change(document) -> None:
    (table,) = section(document, "Rows that are shown").tables
    assert len(table.rows) == 9
    assert all(column(table, "reason", Kind.NAME))
    assert "54 in all" in table.notes[0]


def test_stamp_and_history() -> None:
    versions = [
        frozen.Frozen("v1", "2026-01-02T03:04:05Z", "first", "docs/decisions/005-freeze-v1.md", "gtx970", CONSTANTS, {},
                      {"date": "2026-01-03", "median_abs_log2": 0.3, "worst_abs_log2": 2.0, "geomean": 0.9,
                       "kendall_tau": {"pooled": 0.8}}),
        frozen.Frozen("v2", "2026-02-02T03:04:05Z", "latency", "docs/decisions/006-freeze-v2.md", "gtx970", CONSTANTS,
                      {}),
    ]  # fmt: skip
    stamped = page.document(reproduction(differs=["constant eta was 0.65, now 0.7"], history=versions))
    assert stamped.verdict.startswith("Post-hoc. ")
    assert "constant eta was 0.65, now 0.7" in stamped.attention[0].text
    table, differs = section(stamped, "Frozen versions").tables
    assert column(differs, "what differs in this run", Kind.NAME) == ["constant eta was 0.65, now 0.7"]
    assert column(table, "version", Kind.NAME) == ["v1", "v2"]
    assert column(table, "median", Kind.MODELLED) == [0.3, None]
    clean = page.document(reproduction(thesis_rows(), history=versions))
    assert clean.agreed
    assert not clean.attention
    rehearsal = page.document(reproduction(differs=[frozen.NOT_FROZEN]))
    assert rehearsal.verdict.startswith("Nothing is frozen yet. ")


def test_page_is_one_file_that_holds_every_row() -> None:
    text = page.html(reproduction())
    assert text.count("<h2") == 3 + 16 + 4 + 2
    for pattern in ("src=", "http://", "https://", "@import", "url("):
        assert pattern not in text.replace("url(#", "")
    for number in range(3, 17):
        for one in published_rows(number):
            assert one["row"].replace(">", "&gt;") in text
    assert len(text) < 1_000_000


def test_errors_without_a_file_say_how_to_get_them() -> None:
    made = page.document(reproduction(verified={}))
    assert "mpmbench verify --part table4" in section(made, "Table 4").intro
    shipped = page.document(reproduction())
    assert len(section(shipped, "Table 3").tables) == 2


@pytest.mark.parametrize("table", [17, 18])
def test_printed_banks_are_those_predicted(table: int) -> None:
    (shown,) = banks_section(table).tables
    assert set(column(shown, "same", Kind.PREDICTED)) == {"yes"}


def test_bars_of_terms_colour_what_binds() -> None:
    (one,) = judge([row(5, "AoS", 100, 100)])
    text = terms_bars(one.row.modelled)
    assert text.count("<rect") == 8
    assert re.findall(r'height="([\d.]+)" fill="var\(--series-1\)"', text) == ["20.0"]
    assert "instruction issue 100 µs" in text


def test_scatter_marks_every_point_and_labels_those_asked_for() -> None:
    points = (Point(10, 12), Point(100, 30, "far off"), Point(120, 31, "next to it", filled=False))
    text = svg(Scatter("made up", "modelled", "published", (("one", points), ("none", ()))))
    assert text.startswith("<svg")
    assert "far off" in text
    assert "next to it" in text


# --- the command ------------------------------------------------------------------------------------------------------


@pytest.fixture
def command(monkeypatch, tmp_path):
    """``mpmbench reproduce thesis`` on made-up rows, with frozen versions in a folder of their own."""
    state = {"rows": thesis_rows(lambda table, name: MISSES.get((table, name), 1.0))}
    monkeypatch.setattr(rows, "model_constants", lambda gpu: CONSTANTS)
    monkeypatch.setattr(rows, "thesis_rows", lambda gpu, constants, progress, jobs, cache: state["rows"])
    monkeypatch.setattr(rows, "retime", retime)
    monkeypatch.setattr(frozen, "FOLDER", tmp_path / "frozen")

    def run(*words: str):
        return CliRunner().invoke(main, ["reproduce", "thesis", *words])

    run.state = state
    return run


def test_command_prints_score_misses_and_sensitivity(command) -> None:
    result = command()
    assert result.exit_code == 0
    assert "-2.06  table 12, G2P-global: published 10,316 µs, modelled 2,476 µs" in result.output
    assert "missed worst |log2(modelled / published)|: 2.059 (at most 1.0)" in result.output
    assert "issue_efficiency: " in result.output


def test_freeze_then_score_then_change(command, tmp_path) -> None:
    target = tmp_path / "score.json"

    def stamp() -> dict:
        assert command("--json", str(target)).exit_code == 0
        return json.loads(target.read_text())["frozen"]

    assert stamp()["stamp"] == "not frozen"
    result = command("--freeze", "v1", "--reason", "before the first score")
    assert result.exit_code == 0
    assert "docs/decisions/" in result.output
    assert "median" not in result.output, "no score is shown before it is frozen"
    assert stamp() == {"version": "v1", "stamp": "as frozen", "differs": []}
    assert command("--record-score").exit_code == 0
    assert stamp()["stamp"] == "as frozen"
    command.state["rows"] = thesis_rows()
    after = stamp()
    assert after["stamp"] == "post-hoc"
    assert len(after["differs"]) == len(MISSES)
    assert command("--record-score").exit_code == 2
    assert command("--freeze", "v1", "--reason", "again").exit_code == 2
    assert command("--freeze", "v2", "--reason", "a latency term").exit_code == 0
    html = tmp_path / "page.html"
    assert command("--html", str(html)).exit_code == 0
    assert "a latency term" in html.read_text()


def test_a_row_that_failed_is_a_harness_error(command, tmp_path) -> None:
    command.state["rows"] = [row(5, "AoS", 243, None, failed="no memory"), *thesis_rows()[1:]]
    target = tmp_path / "score.json"
    result = command("--json", str(target))
    assert result.exit_code == 1
    assert "missed median" in result.output
    first = json.loads(target.read_text())["rows"][0]
    assert (first["modelled_us"], first["comparable"], first["reason"]) == (None, True, "no memory")


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--freeze", "v1"], "needs its reason"),
        (["--reason", "x"], "goes with --freeze"),
        (["--freeze", "v1", "--reason", "x", "--record-score"], "comes before a score"),
        (["--verify", "missing.json"], "missing.json"),
    ],
)
def test_bad_usage_is_one_line(command, words, says) -> None:
    result = command(*words)
    assert result.exit_code == 2
    assert says in result.output
    assert "Traceback" not in result.output
