"""The score of the thesis's tables, on rows worked out by hand; which rows are scored; targets; likely causes."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from made_up_rows import CONSTANTS, modelled, retime, row, thesis_rows

from mpmbench.errors import InputError, MpmbenchError
from mpmbench.gpu import get_gpu
from mpmbench.presets import published_rows
from mpmbench.reproduce.causes import known_causes, likely_cause
from mpmbench.reproduce.comparable import CALIBRATED, Judged, excluded_rows, judge
from mpmbench.reproduce.score import Pairs, pairs, score, to_json
from mpmbench.reproduce.sensitivity import sensitivity
from mpmbench.reproduce.targets import targets


def judged(*rows) -> list[Judged]:
    return [Judged(one, "comparable", "") for one in rows]


@pytest.fixture(scope="module")
def gpu():
    return get_gpu("gtx970")


# --- errors -----------------------------------------------------------------------------------------------------------


def test_errors_are_logarithms_of_ratios() -> None:
    """Ratios 2, 1/4 and 1: errors 1, 2 and 0; their median 1, the worst 2, the geometric mean 2 ** (-1/3)."""
    found = score(judged(row(5, "a", 100, 200), row(6, "b", 100, 25), row(7, "c", 100, 100)))
    assert found.median_abs_log2 == pytest.approx(1)
    assert found.worst_abs_log2 == pytest.approx(2)
    assert found.geomean == pytest.approx(2 ** (-1 / 3))
    assert found.rows == 3
    assert found.kendall_tau == {"pooled": None}, "no table has two rows"


def test_rows_that_are_not_comparable_leave_the_score() -> None:
    out = Judged(row(5, "b", 100, 800), CALIBRATED, "sets a rate")
    found = score([*judged(row(5, "a", 100, 200)), out])
    assert (found.rows, found.worst_abs_log2, found.pooled.count) == (1, pytest.approx(1), 0)


def test_a_row_without_a_time_is_counted_and_not_scored() -> None:
    found = score(judged(row(5, "a", 100, 200), row(5, "b", 300, None, failed="no memory")))
    assert (found.rows, found.unmodelled) == (1, 1)
    with pytest.raises(MpmbenchError, match="nothing to score"):
        score(judged(row(ours=None)))


# --- order ------------------------------------------------------------------------------------------------------------


def test_pairs_worked_out_by_hand() -> None:
    """Published 100, 104, 200, 400; modelled 50, 60, 59.5, 70. 100 and 104 differ by 4 %: no pair. 104 and 200 are
    modelled the wrong way round and within 1 % of each other: D. 100-200, 100-400, 104-400 and 200-400 are C."""
    rows = [row(13, str(i), p, m) for i, (p, m) in enumerate([(100, 50), (104, 60), (200, 59.5), (400, 70)])]
    assert pairs(judged(*rows)) == Pairs(4, 1)
    assert pairs(judged(*rows)).tau == pytest.approx(3 / 5)


def test_a_modelled_tie_counts_against_and_a_printed_one_not_at_all() -> None:
    assert pairs(judged(row(5, "a", 100, 100), row(5, "b", 200, 100.9))) == Pairs(0, 1)
    assert pairs(judged(row(5, "a", 100, 100), row(5, "b", 200, 101.1))) == Pairs(1, 0)
    assert pairs(judged(row(5, "a", 100, 100), row(5, "b", 200, 98))) == Pairs(0, 1)
    assert pairs(judged(row(5, "a", 100, 100), row(5, "b", 105, 50))) == Pairs(0, 0)
    assert pairs(judged(row(5, "a", 100, 100), row(5, "b", 105.1, 50))) == Pairs(0, 1)


def test_rows_of_different_tables_are_no_pair_and_small_tables_enter_the_pool_alone() -> None:
    """Four rows in table 13: 6 pairs, all right. Three in table 14: 3 pairs, all wrong. Pool: (6 - 3) / 9."""
    right = [row(13, str(us), us, us) for us in (100, 200, 400, 800)]
    wrong = [row(14, str(us), us, 1e5 / us) for us in (100, 200, 400)]
    found = score(judged(*right, *wrong))
    assert found.kendall_tau == {"pooled": pytest.approx(1 / 3), "13": 1}
    assert found.pairs[14] == Pairs(0, 3)


# --- JSON -------------------------------------------------------------------------------------------------------------


def test_json_has_the_promised_keys_and_every_row() -> None:
    rows = thesis_rows()
    content = to_json(judge(rows))
    assert content.keys() == {"score", "rows"}
    assert content["score"].keys() == {"median_abs_log2", "worst_abs_log2", "geomean", "kendall_tau"}
    assert set(content["score"]["kendall_tau"]) == {"pooled", "7", "8", "13", "14", "15", "16"}
    assert len(content["rows"]) == len(rows) == 54
    for entry in content["rows"]:
        assert list(entry) == ["table", "row", "published_us", "modelled_us", "bound", "comparable", "reason"]
        assert bool(entry["reason"]) is not entry["comparable"]
    soa = content["rows"][1]
    assert (soa["row"], soa["published_us"], soa["comparable"]) == ("SoA", 120, False)
    assert soa["reason"].startswith("calibrated: ")


# --- which rows -------------------------------------------------------------------------------------------------------


def test_excluded_rows_and_known_causes_name_printed_rows() -> None:
    printed = {(table, one["row"]) for table in range(5, 17) for one in published_rows(table)}
    assert set(excluded_rows()) <= printed
    assert set(known_causes()) <= printed


def test_three_cells_are_calibrated_and_the_misses_of_old_stay_scored() -> None:
    calibrated = {key for key, one in excluded_rows().items() if one.status == CALIBRATED}
    assert calibrated == {(5, "SoA"), (9, "Random"), (14, "global sorted")}
    assert not {(12, "G2P-global"), (14, "global"), (13, "global")} & set(excluded_rows())


def test_printed_traffic_of_the_mey15_rows_is_what_their_reasons_say() -> None:
    """Gigabytes: VRAM share x 224 GB/s x time."""
    moved = {
        (table, one["row"]): float(one["vram_percent"]) / 100 * 224 * float(one["time_us"]) * 1e-6
        for table in (13, 14)
        for one in published_rows(table)
    }
    for table, name, gigabytes, times in (
        (13, "[Mey15] sorted", 4.4, 13),
        (14, "[Mey15]", 2.5, 6),
        (14, "[Mey15] sorted", 2.3, 7),
    ):
        same_data = "global sorted" if "sorted" in name else "global"
        assert moved[table, name] == pytest.approx(gigabytes, abs=0.05)
        assert moved[table, name] / moved[table, same_data] == pytest.approx(times, abs=0.5)
        assert f"{gigabytes} GB, {times} times" in excluded_rows()[table, name].reason


def test_an_exclusion_needs_a_reason(tmp_path) -> None:
    path = tmp_path / "comparable.toml"
    path.write_text('[[row]]\ntable = 5\nrow = "AoS"\nstatus = "not comparable"\nreason = ""\n')
    with pytest.raises(InputError, match="a reason"):
        judge([row()], path)


# --- targets ----------------------------------------------------------------------------------------------------------


def _met(rows, gpu) -> dict[str, bool | None]:
    found = judge(rows)
    return {target.name.split(" ")[0]: target.met for target in targets(found, score(found), gpu)}


def test_exact_times_meet_every_target(gpu) -> None:
    assert set(_met(thesis_rows(), gpu).values()) == {True}


def test_one_wrong_figure_misses_one_target(gpu) -> None:
    off = _met(thesis_rows(lambda table, name: 0.4 if (table, name) == (11, "G2P-global") else 1), gpu)
    assert [name for name, met in off.items() if not met] == ["worst"]
    rows = thesis_rows()
    for i, one in enumerate(rows):
        if (one.table, one.row) == (13, "global"):
            rows[i] = row(13, one.row, one.published_us, one.published_us, place=one.place, published=one.published,
                          metrics={"dram_bytes": 1.0e10 * 1.12})  # fmt: skip
        if (one.table, one.row) == (15, "P2G-Sync"):
            rows[i] = row(15, one.row, one.published_us, one.published_us, place=one.place, published=one.published,
                          metrics={"occupancy_warps": 46.0})  # fmt: skip
    found = judge(rows)
    missed = {t.name.split(" ")[0]: t.detail for t in targets(found, score(found), gpu) if not t.met}
    assert missed == {"DRAM": "table 13, global: 1.10x", "occupancy": "table 15, P2G-Sync: +2.7"}
    rows = [replace(one, floor_bytes=2 * 10**10 if one.row == "global" else 1) for one in rows]
    found = judge(rows)
    (detail,) = (t.detail for t in targets(found, score(found), gpu) if t.name.startswith("DRAM"))
    assert detail == ("table 13, global: 1.10x (printed is less than must move in table 13, global, table 14, global)")


def test_targets_leave_out_other_kernels_and_batched_ones(gpu) -> None:
    """[Mey15] moves other bytes, and the registers of batched kernels are the compiler's choice."""
    rows = [
        replace(one, metrics=one.metrics | {"dram_bytes": 1.0, "occupancy_warps": 1.0})
        if one.row.startswith("[Mey15]") or one.row == "P2G-Sync batching=4"
        else one
        for one in thesis_rows()
    ]
    assert set(_met(rows, gpu).values()) == {True}


def test_no_target_is_met_while_a_comparable_row_lacks_its_time(gpu) -> None:
    rows = thesis_rows()
    rows[0] = row(5, "AoS", 243, None, failed="no memory")
    met = _met(rows, gpu)
    assert (met["median"], met["worst"], met["Kendall's"]) == (False, False, False)


# --- causes and sensitivity -------------------------------------------------------------------------------------------


def test_likely_causes_by_terms_counters_and_stall(gpu) -> None:
    def cause(ours: float, bound: str = "issue", **more) -> str:
        one = row(6, "AoS", 100, modelled=modelled(ours, bound), **more)
        return likely_cause(Judged(one, "comparable", ""), gpu)

    assert "1.50 times as fast" in cause(150)
    assert "take 2.00 times as long" in cause(50)
    near = likely_cause(Judged(row(6, "AoS", 100, modelled=modelled(50, l2=40e-6)), "comparable", ""), gpu)
    assert "it and L2 bandwidth make 0.90 of the printed time" in near
    assert "lies in the modelled range" in cause(110)
    assert "lies in the modelled range" not in cause(150)
    stalled = {"published": {"top_stall": "L. Scoreb.(95.1%)"}}
    assert "L. Scoreb.(95.1%), is a wait for global memory" in cause(50, **stalled)
    assert "Scoreb" not in cause(50, bound="dram", **stalled)
    bytes_off = {"published": {"vram_percent": "50"}, "metrics": {"dram_bytes": 5e6}}
    assert "5 MB counted, 11 MB by the printed VRAM share times the time." in cause(50, **bytes_off)
    assert "11 MB by the printed VRAM share times the time, which is less than the 12 MB" in cause(
        50, **bytes_off, floor_bytes=12_000_000
    )
    assert likely_cause(Judged(row(ours=None, failed="no memory"), "comparable", ""), gpu) == (
        "No modelled time: no memory."
    )


def test_sensitivity_moves_one_constant_at_a_time() -> None:
    """Made-up times go as one over the first constant: 1 / 0.8 is 0.32 in log2, 1 / 1.2 is 0.26."""
    rows = thesis_rows()
    first, *others = sensitivity(rows, CONSTANTS, retime)
    assert first.less.median_abs_log2 == pytest.approx(math.log2(1 / 0.8))
    assert first.more.median_abs_log2 == pytest.approx(math.log2(1.2))
    assert [moved.reach for moved in others] == [0, 0]
