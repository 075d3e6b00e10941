"""Cases on named GPUs from end to end, and a published row from its counts to other constants."""

from __future__ import annotations

from dataclasses import replace

import pytest

from mpmbench import presets, variants
from mpmbench.errors import InputError
from mpmbench.gpu import get_gpu
from mpmbench.profile import Modeller, profile_cases, run_modelled
from mpmbench.record import from_json, to_json
from mpmbench.reproduce import rows
from mpmbench.runner import Case, DatasetChoice
from mpmbench.variants import resolve_axes


def case(name: str = "p2g_block_sync", **axes) -> Case:
    variant = variants.get(name)
    return Case(variant, DatasetChoice("uniform_cube", particles=2_000), resolve_axes(variant, axes))


def quiet(what: str, done: int, total: int) -> None:
    pass


@pytest.fixture(scope="module")
def records():
    gpus = [get_gpu(name) for name in ("h100", "h200", "gtx970")]
    return profile_cases([case(), case("g2p_global_gather", particle_order="deep")], gpus, quiet)


def test_gpus_of_one_architecture_share_a_record(records):
    assert [(r.variant, r.arch, sorted(r.modelled)) for r in records] == [
        ("p2g_block_sync", "sm_90", ["h100", "h200"]),
        ("p2g_block_sync", "sm_52", ["gtx970"]),
        ("g2p_global_gather", "sm_90", ["h100", "h200"]),
        ("g2p_global_gather", "sm_52", ["gtx970"]),
    ]
    assert all(record.status == "ok" for record in records)
    assert from_json(to_json(records[0])) == records[0]


def test_a_profile_is_whole(records):
    for record in records:
        for name, profile in record.modelled.items():
            time, gpu = profile.time, get_gpu(name)
            assert 0 < time.low <= time.seconds <= time.high
            assert time.seconds == pytest.approx(time.terms["launch"] + time.terms[time.bound])
            assert profile.steps.keys() == record.steps.keys()
            assert sum(line.share for line in profile.lines.values()) == pytest.approx(1)
            assert 0 < profile.metrics["sm_occupancy_warps"] <= gpu["warps_per_sm"]
            assert 0 <= profile.metrics["l2_hit_percent"] <= 100
            assert profile.memory.dram_sectors * 32 >= record.floor_bytes / 2
            assert profile.time.gpu == name


def test_caches_are_each_gpus_own(records):
    h100, gtx970 = records[0].modelled["h100"], records[1].modelled["gtx970"]
    assert records[0].transfer_counters.total.gatom_lane == h100.memory.atomic_lanes
    assert h100.occupancy.max_warps == 64
    assert h100.memory.l1_hit > gtx970.memory.l1_hit, "plain loads hit L1 from Volta on"


def test_known_records_are_not_run_again(records):
    kept = []
    again = profile_cases([case()], [get_gpu("gtx970")], quiet, kept.append, records)
    assert (kept, again) == ([], [records[1]])
    more = profile_cases([case()], [get_gpu("gtx970"), get_gpu("v100")], quiet, kept.append, records)
    assert [record.arch for record in kept] == ["sm_70"]
    assert more[0] is records[1]


def test_what_does_not_fit_has_no_time():
    impossible = case("p2g_block_pull", block_shape=(8, 8, 4), dtype="float64", payload="apic")
    (record,) = profile_cases([impossible], [get_gpu("gtx970")], quiet)
    assert record.status == "skipped"
    assert record.modelled is None


def test_bad_input_comes_before_any_work():
    variant = variants.get("p2g_block_sync")
    missing = Case(variant, DatasetChoice("no_such_recipe"), resolve_axes(variant, {}))
    with pytest.raises(InputError, match="no_such_recipe"):
        profile_cases([missing], [get_gpu("gtx970")], quiet)


# --- rows of published tables -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def copied() -> rows.Row:
    """Table 5, AoS: a quarter of a second at full size."""
    found = next(c for c in presets.thesis() if c.preset_row["table"] == 5 and c.preset_row["row"] == "AoS")
    gpu = get_gpu("gtx970")
    return rows._row(found, gpu, gpu, rows._count_case(found, gpu))


def test_a_row_has_what_it_is_judged_by(copied):
    assert copied.failed is None
    assert copied.modelled.bound == "dram"
    assert copied.metrics["dram_bytes"] == pytest.approx(2**20 * (32 + 4), rel=0.02), "both attributes and a length"
    assert 16 < copied.metrics["occupancy_warps"] <= 64, "thread blocks end early, and the next ones take time to start"
    assert len(copied.kernel_hash) == len(copied.dataset_fingerprint) == 64


def test_other_constants_move_the_time(copied):
    gpu = get_gpu("gtx970")

    def microseconds(**factors: float) -> float:
        constants = {n: replace(c, value=c.value * factors.get(n, 1.0)) for n, c in gpu.constants.items()}
        (row,) = rows.retime([copied], constants)
        return row.modelled_us

    overhead = 1e6 * gpu["launch_overhead"]
    assert microseconds() == pytest.approx(copied.modelled_us)
    assert microseconds(dram_bandwidth_achieved=0.8) - overhead == pytest.approx((copied.modelled_us - overhead) / 0.8)
    assert microseconds(rate_convert=0.5) == pytest.approx(copied.modelled_us)
    slow = microseconds(dram_latency=100.0)
    assert slow > copied.modelled_us, "loads are waited for, and now take longest"


def test_latencies_share_the_time_of_warps(copied):
    (launch,) = copied.state.launches
    shares = rows.latency_shares(launch, get_gpu("gtx970"))
    assert sum(shares.values()) == pytest.approx(1)
    assert shares["dram_latency"] > 0.5
    assert min(shares.values()) >= 0


def test_counts_survive_the_cache(copied):
    (launch,) = copied.state.launches
    again = rows._launch(rows._plain(launch))
    assert again == launch
    assert again.opcodes == launch.opcodes


def test_a_row_that_fails_has_no_time():
    found = next(c for c in presets.thesis() if c.preset_row["table"] == 5)
    gpu = get_gpu("gtx970")
    counts = {"launches": [], "kernel_hash": "", "fingerprint": "", "floor_bytes": None, "failed": "broken"}
    row = rows._row(found, gpu, gpu, counts)
    assert (row.modelled, row.failed) == (None, "broken")
    assert rows.retime([row], gpu.constants) == [row]


def test_a_model_sees_the_transfer_alone():
    model = Modeller(get_gpu("gtx970"))
    record = run_modelled(case(), model, rows._inputs(), rows.Environment.capture(argv=[]))
    assert [launch.entry for launch in model.seen] == ["p2g_block_sync"]
    assert record.modelled["gtx970"].memory.atomic_lanes == model.seen[0].memory.total.atomic_lanes
