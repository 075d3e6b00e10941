"""Paired rounds under scripted clocks: what drifts, throttles and spikes is not taken for a difference."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest

from mpmbench.errors import InputError
from mpmbench.protocol.rounds import Arm, Contest, Rules, Sample, confidence_at, looks, run_rounds
from mpmbench.protocol.scripted import Script, ScriptedClock
from mpmbench.protocol.verdict import Verdict

TRIALS = 2000
DRIFTS = (0.0, 0.01, 0.03)
# In addition to noise and drift: one step of 5 %, a throttle of 10 % over a fifth of the rounds, 2 % outliers.
HARD = {"step": 0.05, "throttle": 0.10, "throttled": 0.2, "outliers": 0.02}
LIMITED = Rules(max_rounds=30, warmup_seconds=0.005)  # 120 samples an arm and no more


def nothing() -> None:
    pass


def arms(*names: str) -> list[Arm]:
    return [Arm(name, nothing, nothing) for name in names]


def verdicts(script: Script, slower: float) -> Counter[str]:
    """Of an arm that takes ``slower`` times what the baseline takes, by trial."""
    found: Counter[str] = Counter()
    for trial in range(TRIALS):
        clock = ScriptedClock(script, {"a": 1e-3, "b": 1e-3 * slower}, np.random.default_rng(trial))
        found[run_rounds(arms("a", "b"), clock, LIMITED, seed=trial).paired["b"].verdict] += 1
    return found


@pytest.mark.parametrize("drift", DRIFTS)
def test_identical_kernels_are_not_told_apart(drift: float) -> None:
    found = verdicts(Script(drift=drift), 1.0)
    assert found["FAST"] + found["SLOW"] <= 0.01 * TRIALS, found


@pytest.mark.parametrize("drift", DRIFTS)
def test_one_per_cent_is_found(drift: float) -> None:
    found = verdicts(Script(drift=drift), 1.01)
    assert found["SLOW"] >= 0.95 * TRIALS, found


@pytest.mark.parametrize("drift", DRIFTS)
def test_steps_throttling_and_outliers_are_no_difference(drift: float) -> None:
    found = verdicts(Script(drift=drift, **HARD), 1.0)
    assert found["FAST"] + found["SLOW"] <= 0.01 * TRIALS, found


def test_the_script_drifts_as_it_says() -> None:
    """Means of two windows of 120 samples, taken one after the other, differ by the drift (root mean square)."""
    script = Script(drift=0.03, noise=1e-12, outliers=0.0, samples=240)
    levels = np.log([script.levels(np.random.default_rng(seed)) for seed in range(1000)])
    apart = levels[:, 120:].mean(axis=1) - levels[:, :120].mean(axis=1)
    assert np.sqrt((apart**2).mean()) == pytest.approx(0.03, rel=0.08)


def test_the_script_throttles_steps_and_spikes_as_it_says() -> None:
    calm = {"noise": 1e-12, "outliers": 0.0, "samples": 1000}
    throttled = Script(throttle=0.1, **calm).levels(np.random.default_rng(1))  # type: ignore[arg-type]
    assert (throttled > 1.05).mean() == pytest.approx(0.2)
    assert throttled.max() == pytest.approx(np.exp(0.1))
    stepped = Script(step=0.05, **calm).levels(np.random.default_rng(1))  # type: ignore[arg-type]
    assert len(set(np.round(stepped, 6))) == 2
    spikes = Script(noise=1e-12, outliers=0.02, samples=20000).levels(np.random.default_rng(1))
    assert (spikes > 1.1).mean() == pytest.approx(0.02, abs=0.004)
    assert 1.2 <= spikes[spikes > 1.1].min() <= spikes.max() <= 3.0


# --- the order of things ----------------------------------------------------------------------------------------------


@dataclass
class Tape:
    """A clock that writes down who is sampled. answer: (name, how many samples before) -> Sample."""

    answer: Callable[[str, int], Sample] = lambda name, n: Sample(1.0)
    names: list[str] = field(default_factory=list)
    paused: list[float] = field(default_factory=list)
    time: float = 0.0
    reasons: str = ""

    def sample(self, arm: Arm) -> Sample:
        self.names.append(arm.name)
        found = self.answer(arm.name, len(self.names) - 1)
        self.time += found.seconds
        return found

    def now(self) -> float:
        return self.time

    def pause(self, seconds: float) -> None:
        self.paused.append(seconds)

    def trouble(self) -> str:
        return self.reasons


COLD_START = Rules(warmup_seconds=0, warmup_limit=0, min_rounds=3, max_rounds=3, time_limit=1e9)


def test_every_pass_holds_every_arm_and_the_baseline_again() -> None:
    clock = Tape()
    run_rounds(arms("a", "b", "c"), clock, COLD_START, seed=5)
    passes = [tuple(clock.names[i : i + 4]) for i in range(3, len(clock.names), 4)]
    assert clock.names[:3] == ["a", "b", "c"], "one warm-up run of each"
    assert len(passes) == 12
    assert all(sorted(one) == ["a", "a again", "b", "c"] for one in passes)
    assert all(passes[i] == passes[i + 1][::-1] for i in range(0, 12, 2)), "each order is followed by its reverse"
    assert len(set(passes)) > 4, "the order is random"


def test_the_seed_decides_the_order() -> None:
    tapes = [Tape() for _ in range(3)]
    for tape, seed in zip(tapes, (1, 1, 2), strict=True):
        contest = run_rounds(arms("a", "b", "c", "d"), tape, COLD_START, seed=seed)
        assert contest.seed == seed
    assert tapes[0].names == tapes[1].names
    assert tapes[0].names != tapes[2].names


def test_samples_of_a_pass_stay_side_by_side() -> None:
    contest = run_rounds(arms("a", "b"), Tape(lambda name, n: Sample(float(n + 1))), COLD_START)
    places = np.array([contest.seconds["a"], contest.seconds["b"], contest.again])
    assert places.shape == (3, 12)
    assert (np.ptp(places, axis=0) <= 2).all()


def test_a_single_arm_is_timed_beside_its_copy() -> None:
    contest = run_rounds(arms("a"), Tape(), COLD_START)
    assert (contest.stopped_by, contest.paired, contest.leaders) == ("precision", {}, ("a",))
    assert len(contest.seconds["a"]) == len(contest.again) == 12


# --- when it stops ----------------------------------------------------------------------------------------------------


def times(**seconds: float) -> Callable[[str, int], Sample]:
    noise = np.random.default_rng(0).uniform(0, 1e-3, 10000)
    return lambda name, n: Sample(seconds[name.removesuffix(" again")] * (1 + noise[n % 10000]))


PATIENT = Rules(warmup_seconds=0, warmup_limit=0, min_rounds=10, max_rounds=500, time_limit=1e9)


def test_stops_when_every_verdict_is_decided() -> None:
    contest = run_rounds(arms("a", "b", "c"), Tape(times(a=1.0, b=1.1, c=0.9)), PATIENT)
    assert (contest.stopped_by, contest.rounds) == ("verdict", 10)
    assert [contest.paired[name].verdict for name in "bc"] == ["SLOW", "FAST"]
    assert contest.leaders == ("c",)


def test_goes_on_where_a_verdict_is_open_and_stops_when_precise() -> None:
    """A true difference that sits on the margin is never decided; the interval still becomes narrow."""
    contest = run_rounds(arms("a", "b"), Tape(times(a=1.005, b=1.0)), PATIENT)
    assert contest.stopped_by == "precision"
    assert contest.paired["b"].verdict is Verdict.AMBIGUOUS
    assert contest.paired["b"].speedup.half_width <= 0.001


def test_stops_when_time_is_up_and_says_what_is_open() -> None:
    spread = np.random.default_rng(1).uniform(0.5, 1.5, 10000)
    rules = Rules(warmup_seconds=0, warmup_limit=0, time_limit=100.0)
    contest = run_rounds(arms("a", "b"), Tape(lambda name, n: Sample(spread[n % 10000])), rules)
    assert contest.stopped_by.startswith("time limit; undecided: ")
    assert "b" in contest.stopped_by
    assert contest.rounds == pytest.approx(25, abs=3), "100 s an arm, three arms, four samples of 1 s a round"


def test_the_leader_and_its_equals_lead_together() -> None:
    contest = run_rounds(arms("a", "b", "c"), Tape(times(a=1.2, b=1.0, c=1.001)), PATIENT)
    assert set(contest.leaders) == {"b", "c"}


def test_arms_are_compared_with_the_fastest_before_it_stops() -> None:
    """Both beat the baseline at the first look, but which of the two is faster takes longer."""
    spread = np.random.default_rng(1).normal(0, 0.02, 10000)
    seconds = {"a": 2.0, "b": 1.0, "c": 1.03}

    def answer(name: str, n: int) -> Sample:
        return Sample(seconds[name.removesuffix(" again")] * float(np.exp(spread[n % 10000])))

    contest = run_rounds(arms("a", "b", "c"), Tape(answer), PATIENT)
    assert contest.rounds > 10
    assert contest.leaders == ("b",)


def test_looks_are_further_and_further_apart_and_their_errors_add_up() -> None:
    rounds = looks(Rules())
    assert rounds[:3] == [30, 40, 54]
    assert rounds[-1] == 1000
    errors = [1 - confidence_at(look, 0.99) for look in range(10000)]
    assert sum(errors) == pytest.approx(0.01, rel=1e-3)
    assert sum(errors) <= 0.01


# --- trouble ----------------------------------------------------------------------------------------------------------


def test_a_discarded_sample_takes_its_pass_along() -> None:
    clock = Tape(lambda name, n: Sample(9.0, discard="slow clock") if n == 5 else Sample(1.0))
    contest = run_rounds(arms("a", "b"), clock, COLD_START)
    assert contest.discarded == {"slow clock": 1}
    assert {len(contest.seconds["a"]), len(contest.seconds["b"]), len(contest.again)} == {12}
    assert 9.0 not in contest.seconds["a"] + contest.seconds["b"] + contest.again
    assert len(clock.paused) == 1


def test_pauses_grow() -> None:
    clock = Tape(lambda name, n: Sample(1.0, discard="slow clock" if 2 <= n < 6 else ""))
    run_rounds(arms("a", "b"), clock, COLD_START)
    assert clock.paused == pytest.approx([0.05, 0.1, 0.15, 0.2])


def test_what_is_tolerable_is_kept_where_repeating_does_not_help() -> None:
    clock = Tape(lambda name, n: Sample(1.0, discard="core taken", tolerable=True))
    contest = run_rounds(arms("a", "b"), clock, COLD_START)
    assert contest.spoiled == {}
    assert contest.discarded == {"core taken": 3 * 12}, "each pass is repeated three times first"
    assert len(contest.seconds["b"]) == 12


def test_an_arm_that_is_always_throttled_is_given_up_and_the_others_go_on() -> None:
    clock = Tape(lambda name, n: Sample(1.0, discard="slow clock" if name == "b" and n > 3 else ""))
    clock.reasons = "power cap"
    contest = run_rounds(arms("a", "b", "c"), clock, COLD_START)
    assert contest.spoiled == {"b": "THROTTLED: slow clock (power cap), 20 passes in a row"}
    assert "b" not in contest.seconds
    assert "b" not in contest.paired
    assert contest.paired["c"].pairs == 12


def test_a_throttled_baseline_ends_it() -> None:
    clock = Tape(lambda name, n: Sample(1.0, discard="slow clock" if name == "a" and n > 3 else ""))
    contest = run_rounds(arms("a", "b"), clock, COLD_START)
    assert contest.stopped_by == "throttled baseline"
    assert contest.spoiled.keys() == {"a"}


def test_rounds_that_are_held_down_are_counted_by_reason() -> None:
    clock = Tape()
    reasons = iter(["", "power cap", "power cap"])
    clock.trouble = lambda: next(reasons)  # type: ignore[method-assign]
    assert run_rounds(arms("a", "b"), clock, COLD_START).held_down == {"power cap": 2}


def test_arms_under_different_clocks_are_not_compared() -> None:
    hertz = {"a": 1.5e9, "b": 1.45e9, "c": 1.499e9}

    def answer(name: str, n: int) -> Sample:
        return Sample(1.0, hertz[name.removesuffix(" again")])

    contest = run_rounds(arms("a", "b", "c"), Tape(answer), COLD_START)
    assert contest.paired["b"].verdict is Verdict.UNUSABLE
    assert contest.paired["c"].verdict is Verdict.SAME
    assert contest.hertz["b"] == [1.45e9] * 12


def test_warm_up_goes_on_until_the_times_settle() -> None:
    clock = Tape(lambda name, n: Sample(1.0 + max(0, 40 - n) * 0.1))
    contest = run_rounds(arms("a"), clock, Rules(min_rounds=1, max_rounds=1, warmup_seconds=0, warmup_limit=1e9))
    assert contest.warmups >= 40
    assert set(contest.seconds["a"]) == {1.0}


@pytest.mark.parametrize("bad", [{"passes": 3}, {"passes": 0}, {"min_rounds": 0}, {"min_rounds": 5, "max_rounds": 4}])
def test_bad_rules_are_refused(bad: dict[str, int]) -> None:
    with pytest.raises(InputError):
        Rules(**bad)  # type: ignore[arg-type]


def test_arms_need_names_of_their_own() -> None:
    with pytest.raises(InputError, match="one name"):
        run_rounds(arms("a", "a"), Tape(), COLD_START)
    with pytest.raises(InputError, match="nothing"):
        run_rounds([], Tape(), COLD_START)


def test_contest_says_how_noisy_it_was() -> None:
    contest: Contest = run_rounds(arms("a", "b"), Tape(times(a=1.0, b=1.0)), PATIENT)
    assert contest.noise.low < 1 < contest.noise.high
    assert contest.noise.spread < 0.005
