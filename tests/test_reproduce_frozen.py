"""Frozen versions: written once, scored once, and whatever differs from them is said."""

from __future__ import annotations

from dataclasses import replace

import pytest
from made_up_rows import CONSTANTS, modelled, thesis_rows

from mpmbench.errors import InputError
from mpmbench.gpu import Constant
from mpmbench.reproduce import frozen
from mpmbench.reproduce.comparable import judge


@pytest.fixture
def judged():
    return judge(thesis_rows(lambda table, name: 1.1))


@pytest.fixture
def folder(tmp_path, judged):
    frozen.freeze("v1", "before the first score", "gtx970", CONSTANTS, judged, tmp_path)
    return tmp_path


def test_a_version_reads_back_as_written(folder, judged) -> None:
    one = frozen.newest(folder)
    assert (one.version, one.reason, one.gpu, one.score) == ("v1", "before the first score", "gtx970", None)
    assert one.constants == CONSTANTS
    assert len(one.rows) == 54
    assert one.rows[9, "Random"].reason == "calibrated: sets the rate of DRAM row activations"
    assert one.rows[13, "global"].comparable
    assert one.rows[13, "global"].kernel_hash == "hash-p2g_global_atomic"
    assert one.note == "docs/decisions/007-freeze-v1.md", "the decision that is there"
    assert frozen.note_name("v99").endswith("-freeze-v99.md")
    assert frozen.differences(one, "gtx970", CONSTANTS, judged) == []
    text = (folder / "v1.json").read_text()
    assert len(text.splitlines()) < 80, "one line per row and constant"


def test_times_are_not_frozen_before_they_are_scored(folder) -> None:
    other = judge(thesis_rows(lambda table, name: 3.0))
    assert frozen.differences(frozen.newest(folder), "gtx970", CONSTANTS, other) == []


def _changed(judged, **fields):
    return [replace(judged[0], row=replace(judged[0].row, **fields)), *judged[1:]]


def test_everything_that_differs_is_named(folder, judged) -> None:
    def says(*, gpu="gtx970", constants=CONSTANTS, rows=judged) -> list[str]:
        return frozen.differences(frozen.newest(folder), gpu, constants, rows)

    assert says(gpu="h100") == ["GPU gtx970, now h100"]
    assert says(constants=CONSTANTS | {"new": Constant(1, "guess", "low")}) == ["constant new is new"]
    assert says(constants={k: v for k, v in CONSTANTS.items() if k != "block_overhead"}) == [
        "constant block_overhead is gone"
    ]
    moved = CONSTANTS | {"issue_efficiency": Constant(0.66, "thesis", "medium")}
    assert says(constants=moved) == ["constant issue_efficiency was 0.65, now 0.66"]
    rounded = CONSTANTS | {"issue_efficiency": Constant(0.65 * (1 + 1e-14), "thesis", "medium")}
    assert says(constants=rounded) == []
    assert says(rows=_changed(judged, kernel_hash="other")) == ["table 5, AoS: other kernel sources"]
    assert says(rows=_changed(judged, dataset_fingerprint="x")) == ["table 5, AoS: other particles or elements"]
    assert says(rows=_changed(judged, published_us=200.0)) == ["table 5, AoS: published time was 243.0, now 200.0"]
    assert says(rows=judged[1:]) == ["table 5, AoS: is gone"]
    out = [replace(judged[0], status="not comparable", reason="too far off"), *judged[1:]]
    assert says(rows=out) == ["table 5, AoS: was comparable, now not comparable"]
    assert frozen.differences(None, "gtx970", CONSTANTS, judged) == [frozen.NOT_FROZEN]


def test_the_first_score_is_recorded_once_and_stays(folder, judged) -> None:
    frozen.record_score(judged, [], folder)
    one = frozen.newest(folder)
    assert one.score["median_abs_log2"] == pytest.approx(0.1375, abs=1e-4)
    assert one.score["kendall_tau"]["pooled"] == 1
    with pytest.raises(InputError, match="the first score stays"):
        frozen.record_score(judged, [], folder)
    assert frozen.differences(one, "gtx970", CONSTANTS, judged) == []
    slower = _changed(judged, modelled=modelled(400))
    (line,) = frozen.differences(one, "gtx970", CONSTANTS, slower)
    assert line == "table 5, AoS: modelled 267.3 µs when v1 was scored, now 400 µs"


def test_a_post_hoc_run_or_one_with_holes_records_nothing(folder, judged) -> None:
    with pytest.raises(InputError, match="post-hoc"):
        frozen.record_score(judged, ["constant x was 1, now 2"], folder)
    with pytest.raises(InputError, match="no modelled time"):
        frozen.record_score(_changed(judged, modelled=None), [], folder)
    assert frozen.newest(folder).score is None


def test_a_version_is_never_written_twice_nor_without_a_reason(folder, judged) -> None:
    def freeze(version: str, reason: str = "why", rows=judged):
        return frozen.freeze(version, reason, "gtx970", CONSTANTS, rows, folder)

    before = (folder / "v1.json").read_bytes()
    with pytest.raises(InputError, match="take v2"):
        freeze("v1")
    with pytest.raises(InputError, match="needs its reason"):
        freeze("v2", " ")
    with pytest.raises(InputError, match="not of the form"):
        freeze("../v2")
    with pytest.raises(InputError, match="no memory"):
        freeze("v2", rows=_changed(judged, failed="no memory"))
    assert (folder / "v1.json").read_bytes() == before
    freeze("v2")
    freeze("v10")
    assert [one.version for one in frozen.versions(folder)] == ["v1", "v2", "v10"]


def test_a_broken_file_is_named(folder) -> None:
    (folder / "v2.json").write_text("{}")
    with pytest.raises(InputError, match=r"v2\.json is no frozen version"):
        frozen.versions(folder)


def test_shipped_versions_can_be_read() -> None:
    for one in frozen.versions():
        assert one.reason
        assert one.constants
        assert one.rows
