"""What binds and what would help: one sentence, from facts, and no nonsense."""

from __future__ import annotations

import dataclasses

import pytest
from profiled import modelled_time, profile, record

from mpmbench.gpu.modelled import TERMS
from mpmbench.profile_record import Residency
from mpmbench.report.advice import RULES, Facts, advice, binding, sentence
from mpmbench.simt.counters import Counters, Tally

FULL = Residency(64, 16, "warps", 64)


def facts(bound: str, variant: str = "p2g_global_atomic", *, tally: Tally | None = None, **changes) -> Facts:
    """A record bound by one term. changes: of the profile; axes and floor_bytes: of the record."""
    about = {name: changes.pop(name) for name in ("axes", "floor_bytes", "transfer") if name in changes}
    made = record(variant, **about)
    if tally is not None:
        made = dataclasses.replace(made, transfer_counters=Counters(tally))
    return Facts(made, profile(modelled_time("gtx970", bound, 1e-3), **changes))


def test_every_bound_has_advice_that_always_applies():
    assert set(RULES) == set(TERMS)
    plain = facts("issue", "reduce_shuffle", axes={"particle_order": "x"}, occupancy=FULL, barrier_wait_cycles=0)
    assert all(rules[-1].when(plain) for rules in RULES.values())


@pytest.mark.parametrize(
    ("bound", "changes", "words"),
    [
        ("activations", {}, "sorting the particles"),
        ("activations", {"axes": {"particle_order": "index"}}, "moving the attributes too"),
        ("activations", {"axes": {"particle_order": "deep"}}, "closer together"),
        ("dram", {"sectors": (10, 1_900_000)}, "DRAM traffic is 1.01 times the compulsory"),
        ("dram", {"sectors": (10, 19_000_000)}, "sorting the particles"),
        ("dram", {"sectors": (10, 19_000_000), "axes": {"particle_order": "deep"}}, "10.1 times the compulsory"),
        ("dram", {"floor_bytes": None, "axes": {"particle_order": "deep"}}, "only less DRAM traffic"),
        ("l1", {}, "sorting the particles"),
        ("l2", {"axes": {"particle_order": "deep"}}, "p2g_block_"),
        ("l2", {"variant": "g2p_global_gather", "axes": {"particle_order": "deep"}}, "g2p_block_"),
        ("l2", {"variant": "p2g_block_sync"}, "fewer sectors per global request"),
        ("atomics", {"axes": {"particle_order": "deep"}}, "add up in shared memory"),
        ("atomics", {"variant": "p2g_block_sync", "axes": {"blocks": "all"}}, "blocks=active"),
        ("atomics", {"variant": "p2g_block_sync", "hot_address": 500_000}, "50 % of the atomics meet on one word"),
        ("atomics", {"variant": "p2g_block_sync"}, "a larger block_shape"),
        ("issue", {"axes": {"writing": "literal"}}, "writing=hoisted"),
        ("issue", {"tally": Tally(warp_inst=100, lane_inst=1_000)}, "only 10 of 32 lanes"),
        ("issue", {"variant": "p2g_block_atomic"}, "loops, here of 3.25 trips on average"),
        ("issue", {"tally": Tally(warp_inst=100, lane_inst=3200, satom_req=5, satom_iter=5)}, "only fewer instr"),
        ("issue", {}, "only fewer instructions"),
        ("shared", {"variant": "p2g_block_atomic"}, "loops, here of 3.25 trips on average"),
        ("shared", {"variant": "p2g_block_sync"}, "only fewer shared accesses"),
        ("shared", {"tally": Tally(sld_req=10, shm_wavefronts=70)}, "takes 7 wavefronts"),
        ("shared", {}, "wider global requests"),
        ("latency", {"metrics": {"sm_occupancy_warps": 3.0}}, "too few thread blocks"),
        ("latency", {"barrier_wait_cycles": 20_000}, "50 % of their life waiting at barriers"),
        ("latency", {"occupancy": Residency(24, 6, "registers", 64)}, "registers leave room for 24 of 64 warps"),
        ("latency", {"occupancy": Residency(44, 11, "shared memory", 64)}, "a smaller block_shape"),
        ("latency", {"occupancy": Residency(32, 32, "blocks", 64)}, "larger ones"),
        ("latency", {"occupancy": FULL}, "every place for a warp is taken"),
    ],
)
def test_advice_follows_from_facts(bound, changes, words):
    assert words in advice(bound, facts(bound, **changes))


def test_what_is_sorted_is_not_told_to_sort():
    for bound in TERMS:
        assert "sorting" not in advice(bound, facts(bound, "p2g_block_sync"))
        assert "sorting" not in advice(bound, facts(bound, axes={"particle_order": "deep"}))


def test_a_gather_is_not_told_about_scatters():
    for bound in TERMS:
        assert "p2g" not in advice(bound, facts(bound, "g2p_global_gather"))


def test_a_primitive_is_not_told_about_particles():
    for bound in TERMS:
        said = advice(bound, facts(bound, "scan_lookback", transfer="scan", axes={"particle_order": "given"}))
        assert not {"particle", "node", "p2g"} & set(said.replace("_", " ").split())


def test_one_bound_outside_the_range_of_the_second():
    made = record()
    alone = profile(modelled_time("gtx970", "activations", 1e-3, 0.75, atomics=0.7))
    assert binding(alone) == ("activations",)
    assert sentence(made, alone) == (
        "Bound by DRAM row activations (scattered access), 100 % of the time: "
        "sorting the particles (particle_order=deep) would bring the accesses of a warp together."
    )


def test_both_bounds_where_the_range_reaches_the_second():
    both = profile(modelled_time("gtx970", "activations", 1e-3, 0.75, atomics=0.8))
    assert binding(both) == ("activations", "atomics")
    said = sentence(record(), both)
    assert "or, within the model's range, by global atomics, 80 %" in said
    assert "For the first, sorting" in said
    assert "for the second, a block strategy" in said


def test_the_same_advice_is_said_once():
    both = profile(modelled_time("gtx970", "l1", 1e-3, 0.75, l2=0.9))
    assert sentence(record(), both).count("sorting") == 1


def test_launch_overhead():
    time = dataclasses.replace(modelled_time("gtx970", "dram", 1e-5), terms={"dram": 2e-6, "launch": 8e-6})
    assert sentence(record(), profile(time)) == (
        "Launch overhead is 80 % of the time: more work per launch would help."
    )
