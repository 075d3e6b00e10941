"""The performance model: each term against arithmetic done here, ranges, calibration, and what the GPU is told."""

from __future__ import annotations

from dataclasses import replace

import pytest

from mpmbench.device import KernelInfo, LaunchProfile
from mpmbench.errors import InputError
from mpmbench.gpu import Constant, Gpu, get_gpu
from mpmbench.gpu.calibration import CELLS, Cell, calibrate, to_toml
from mpmbench.gpu.machine import machine_for, machine_of
from mpmbench.gpu.model import Rates, add_times, busy_sms, metrics_of, model_launch, model_launches, rates_of, terms_of
from mpmbench.gpu.modelled import TERMS
from mpmbench.simt.counters import Counters, Tally
from mpmbench.simt.machine import MemoryCounters, MemoryTally

RATES = Rates(dram_bandwidth=100e9, atomics=10e9, activations=1e9)
INFO = KernelInfo("sm_52", registers=32, shared_bytes=0)


def gpu(**changes: float) -> Gpu:
    """A GTX 970 of 10 SMs at 1 GHz, with a launch that costs nothing."""
    known = get_gpu("gtx970")
    values = {"sm_count": 10, "clock_mhz": 1000, "launch_overhead": 0, "issue_efficiency": 0.5, "l2_bandwidth": 320e9}
    constants = {name: Constant(value, "made up", "low") for name, value in {**values, **changes}.items()}
    return replace(known, constants={**known.constants, **constants})


def launch(blocks: int = 1000, tally: Tally | None = None, memory: MemoryTally | None = None, **more) -> LaunchProfile:
    counters = MemoryCounters(total=memory or MemoryTally(), **{k: v for k, v in more.items() if k != "opcodes"})
    return LaunchProfile("kernel", blocks, 128, 0, INFO, Counters(tally or Tally()), counters, more.get("opcodes", {}))


def terms(one: LaunchProfile, on: Gpu | None = None, rates: Rates = RATES) -> dict[str, float]:
    found = terms_of(on or gpu(), one, rates)
    assert set(found) == set(TERMS)
    return {name: value for name, value in found.items() if value}


def test_units_share_the_issue_slots_and_a_slow_one_can_bind():
    """Slots: 4 schedulers at an efficiency of 0.5, so two instructions per cycle and SM. Conversions run at one."""
    opcodes = {("fma.rn.f32", None): 10_000, ("shl.b32", 2): 10_000, ("cvt.rn.f32.s32", None): 10_000}
    assert terms(launch(opcodes=opcodes)) == {"issue": pytest.approx(30_000 / 2 / 10 / 1e9)}
    slow = {**opcodes, ("cvt.rn.f32.s32", None): 40_000}
    assert terms(launch(opcodes=slow)) == {"issue": pytest.approx(40_000 / 10 / 1e9)}


def test_rounds_of_a_float_atomic_in_shared_memory_are_instructions_and_wavefronts():
    opcodes = {("atom.shared.add.f32", None): 100}
    tallies = (Tally(satom_req=100, satom_iter=rounds, satom_wavefronts=4 * rounds) for rounds in (100, 300))
    few, many = (terms(launch(opcodes=opcodes, tally=tally)) for tally in tallies)
    assert many["shared"] - few["shared"] == pytest.approx(3 * 4 * 200 / 10 / 1e9)
    # Five instructions a round, two per cycle.
    assert many["issue"] - few["issue"] == pytest.approx(200 * 5 / 2 / 10 / 1e9)
    whole = {("atom.shared.add.u32", None): 100}
    assert terms(launch(opcodes=whole, tally=Tally(satom_req=100, satom_iter=300)))["issue"] < few["issue"]


@pytest.mark.parametrize(
    ("tally", "memory", "more", "term", "seconds"),
    [
        (Tally(shm_wavefronts=500, gld_req=300, gst_req=150, gatom_req=50), None, {}, "shared", 1000 / 10 / 1e9),
        (None, MemoryTally(l1_request_bytes=32_000), {}, "l1", 1000 / 10 / 1e9),
        (None, MemoryTally(l2_hit=600, l2_miss=400), {}, "l2", 1000 * 32 / 320e9),
        (None, MemoryTally(dram_read=600, dram_write=400), {}, "dram", 1000 * 32 / 100e9),
        (None, MemoryTally(dram_activations=1000), {}, "activations", 1000 / 1e9),
        (None, MemoryTally(atomic_lanes=1000), {}, "atomics", 1000 / 10e9),
        (None, MemoryTally(atomic_lanes=1000), {"hot_address": 500}, "atomics", 500 / 1e9),
        (None, None, {"latency_cycles": 1000}, "latency", 1000 / 1e9),
    ],
)
def test_terms(tally, memory, more, term, seconds):
    assert terms(launch(tally=tally, memory=memory, **more)) == {term: pytest.approx(seconds)}


def test_few_thread_blocks_keep_few_sms_busy():
    """4 blocks: 4 SMs. 15 blocks on 10 SMs: one SM has two, so 7.5 SMs' worth runs at a time."""
    on = gpu()
    assert [busy_sms(on, blocks) for blocks in (1, 4, 10, 15, 1000, 0)] == [1, 4, 10, 7.5, 10, 1]


def test_the_largest_term_binds_and_the_overhead_is_added():
    one = launch(memory=MemoryTally(dram_read=1000, l2_miss=1000), latency_cycles=100)
    time = model_launch(gpu(launch_overhead=5e-6), one, RATES)
    assert time.bound == "dram"
    assert time.seconds == pytest.approx(5e-6 + 320e-9)
    assert time.low == pytest.approx(5e-6 + 320e-9 / 1.25)
    # L2 takes 100 ns as well: without overlap 420 ns, which is more than 1.25 x 320.
    assert time.high == pytest.approx(5e-6 + 420e-9)
    assert time.calibrated
    assert time.terms["launch"] == 5e-6


def test_unknown_rates_widen_the_range_where_they_could_decide():
    rates = replace(RATES, atomics_range=(0.5, 4.0), uncalibrated="atomics are a guess")
    on = gpu()
    binds = model_launch(on, launch(memory=MemoryTally(atomic_lanes=1000)), rates)
    assert not binds.calibrated
    assert binds.reason == "atomics are a guess"
    assert binds.low == pytest.approx(100e-9 / 4 / 1.25)
    assert binds.high == pytest.approx(1.25 * 200e-9)
    far = model_launch(on, launch(memory=MemoryTally(atomic_lanes=1000), latency_cycles=1000), rates)
    assert far.calibrated
    assert far.reason == ""
    near = model_launch(on, launch(memory=MemoryTally(atomic_lanes=1000), latency_cycles=150), rates)
    assert not near.calibrated, "at half the rate atomics would bind"


def test_launches_add_up():
    on = gpu(launch_overhead=1e-6)
    short, long = launch(latency_cycles=100), launch(memory=MemoryTally(dram_read=1000))
    time = model_launches(on, [short, long, short], RATES)
    parts = [model_launch(on, one, RATES) for one in (short, long, short)]
    assert time.seconds == pytest.approx(sum(part.seconds for part in parts))
    assert (time.low, time.high) == pytest.approx((sum(p.low for p in parts), sum(p.high for p in parts)))
    assert time.bound == "latency", "two launches of 1.1 us against one of 1.32"
    assert add_times(on, []).seconds == 0


def test_rates_of_a_gpu_that_has_all_and_of_one_that_has_none():
    known = rates_of(get_gpu("gtx970"))
    assert known.uncalibrated == ""
    h100 = get_gpu("h100")
    guessed = rates_of(h100)
    assert "atomics" in guessed.uncalibrated
    assert guessed.atomics == pytest.approx((h100.get("l2_slices") or 0) * h100["clock_mhz"] * 1e6)
    assert guessed.atomics_range == (0.5, 4.0)


def test_metrics_are_shares_of_peaks():
    on = gpu(dram_bandwidth=200e9)
    one = launch(
        memory=MemoryTally(dram_read=600, dram_write=400, l2_hit=300, l2_miss=1000, l1_hit=1, l1_miss=3),
        opcodes={("fma.rn.f32", None): 2000},
    )
    time = model_launch(on, one, RATES)
    found = metrics_of(on, [one], time)
    assert found["vram_percent"] == pytest.approx(50), "a bandwidth of 100 GB/s is reached, 200 are nominal"
    assert (found["read_percent"], found["write_percent"]) == pytest.approx((30, 20))
    assert found["l2_hit_percent"] == pytest.approx(100 * 300 / 1300)
    assert found["l1_hit_percent"] == 25
    assert found["sm_percent"] == pytest.approx(100 * 500 / (10 * 320))
    assert found["dram_bytes"] == 32_000
    slow = launch(opcodes={("cvt.rn.f32.s32", None): 2000})
    shares = metrics_of(on, [slow], model_launch(on, slow, RATES))
    assert (shares["sm_percent"], shares["sm_issue_percent"]) == pytest.approx((100, 25)), (
        "its unit is all it waits for"
    )
    assert metrics_of(on, [], time) == {}


def cells() -> dict[tuple[int, str], Cell]:
    empty = {cell: Cell(110e-6, 0, 0, 0) for cell in CELLS.values()}
    return {
        **empty,
        (5, "SoA"): Cell(110e-6, 1000, 5, 0),
        (9, "Random"): Cell(210e-6, 7, 4000, 9),
        (14, "global sorted"): Cell(1010e-6, 7, 8, 5000),
    }


def test_calibration_takes_its_three_cells_and_no_other():
    found = calibrate(cells(), launch_overhead=10e-6)
    assert found == {
        "dram_bandwidth_achieved": pytest.approx(32_000 / 100e-6),
        "row_activation_rate": pytest.approx(4000 / 200e-6),
        "atomic_word_rate": pytest.approx(5000 / 1000e-6),
    }
    with pytest.raises(InputError, match="exactly the cells"):
        calibrate({**cells(), (13, "global"): Cell(1, 1, 1, 1)}, 0)
    with pytest.raises(InputError, match="exactly the cells"):
        calibrate({(5, "SoA"): Cell(1, 1, 1, 1)}, 0)
    assert 'row_activation_rate = { value = 2e+07, source = "calibrated: the thesis, table 9, Random"' in to_toml(found)


def test_the_calibrated_gpu_holds_what_calibration_wrote():
    known = get_gpu("gtx970")
    for name, (table, row) in CELLS.items():
        assert known.constants[name].source == f"calibrated: the thesis, table {table}, {row}"
        assert known[name] > 0
    assert not set(CELLS) & set(get_gpu("h100").constants) - {"dram_bandwidth_achieved"}


def test_a_kernel_sees_its_own_machine():
    on = get_gpu("gtx970")
    machine = machine_for(on)(KernelInfo("sm_52", registers=32), 128, 8624)
    assert machine.blocks_per_sm == 11
    assert machine.block_start == on["block_start_cycles"]
    assert machine == replace(machine_of(on, 11, 8624), issue_cycles=machine.issue_cycles), (
        "functions compare by identity"
    )
    with pytest.raises(InputError, match="cannot hold a thread block"):
        machine_for(on)(KernelInfo("sm_52", registers=255), 1024, 0)
