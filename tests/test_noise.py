"""A/A on a scripted clock: a fair machine is called fair, a biased one is not, and the bound is the binomial one."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner

from mpmbench import noise as noise_module
from mpmbench.cli import main
from mpmbench.device.cpu import CpuDevice
from mpmbench.noise import COPIES, Noise, describe, measure_noise, trials
from mpmbench.protocol.rounds import Arm, Rules, Sample
from mpmbench.protocol.scripted import Script, ScriptedClock

RULES = Rules(min_rounds=10, warmup_seconds=0.0, warmup_limit=0.0)
CPU = SimpleNamespace(name="cpu")


def nothing():
    return None


ARM = Arm("a", nothing, nothing)
NAMES = ["a", *(f"a copy {n}" for n in range(1, COPIES + 1))]


def scripted(script=None, **slower):
    """A clock under which all copies take 1 ms but those named."""
    seconds = dict.fromkeys(NAMES, 1e-3) | {name.replace("_", " "): value for name, value in slower.items()}
    return ScriptedClock(script or Script(noise=0.01, drift=0.03), seconds, np.random.default_rng(1))


def made(false, copies, unusable=0, spreads=(0.01, 0.05, 0.002), discarded=None):
    return Noise(30, 30.0, copies, false, unusable, spreads, discarded or {})


def test_equal_copies_on_a_drifting_machine_are_hardly_ever_called_unequal():
    found = trials(ARM, scripted(), seconds=20.0, rules=RULES)
    assert found.copies == COPIES * len(found.spreads) > 100
    assert found.unusable == 0
    assert found.rate <= 0.01
    assert found.rounds == 10
    assert 20.0 <= found.seconds < 21.0


def test_copies_that_are_not_equal_are_counted():
    found = trials(ARM, scripted(Script(noise=0.001, outliers=0), a_copy_2=1.1e-3), seconds=2.0, rules=RULES)
    assert found.false * COPIES == found.copies


def test_at_least_one_trial_and_each_ends_at_its_first_look():
    found = trials(ARM, scripted(), seconds=0.0, rules=RULES)
    assert len(found.spreads) == 1
    samples = RULES.min_rounds * RULES.passes * (COPIES + 2)
    assert found.seconds == pytest.approx(samples * 1e-3, rel=0.2)


def test_every_trial_has_an_order_of_its_own():
    clock, taken = scripted(), []
    sample = clock.sample
    clock.sample = lambda arm: (taken.append(arm.name), sample(arm))[1]
    found = trials(ARM, clock, seconds=1.0, rules=RULES)
    of_a_trial = len(taken) // len(found.spreads)
    orders = {tuple(taken[at : at + of_a_trial]) for at in range(0, len(taken), of_a_trial)}
    assert len(orders) == len(found.spreads) > 2


class Restless:
    """Throws away every third pass at first, and in the end all samples of one copy."""

    def __init__(self, hopeless=""):
        self.taken, self.hopeless = 0, hopeless

    def sample(self, arm):
        self.taken += 1
        spoiled = arm.name == self.hopeless or (not self.hopeless and self.taken % 40 == 0)
        return Sample(1e-3, None, "core taken" if spoiled else "")

    def now(self):
        return self.taken * 1e-3

    def pause(self, seconds):
        pass

    def trouble(self):
        return ""


def test_what_was_thrown_away_is_said():
    found = trials(ARM, Restless(), seconds=0.0, rules=RULES)
    assert found.discarded["core taken"] > 0
    assert any("thrown away: core taken" in line for line in describe(found, CPU))


def test_a_copy_without_samples_has_no_verdict():
    found = trials(ARM, Restless("a copy 1"), seconds=0.0, rules=RULES)
    assert (found.copies, found.unusable) == (COPIES - 1, 1)


def test_a_baseline_without_samples_is_no_verdict_at_all():
    found = trials(ARM, Restless("a"), seconds=0.0, rules=RULES)
    assert (found.copies, found.unusable, found.spreads) == (0, COPIES, ())
    text = "\n".join(describe(found, CPU))
    assert "no verdict: " in text
    assert "-> stop other programs" in text


def test_bound_is_that_of_the_binomial_distribution():
    assert made(0, 299).bound == pytest.approx(1 - 0.05 ** (1 / 299))  # the rule of three
    assert made(0, 299).bound <= 0.01 < made(0, 298).bound
    assert made(5, 5).bound == made(0, 0).bound == 1.0
    assert made(0, 0).rate == 0.0


@pytest.mark.parametrize(
    ("noise", "expected"),
    [
        (made(0, 400), "-> good: below 1%"),
        (made(0, 100), "--noise-seconds 120"),
        (made(1, 110), "-> too few trials to promise 1%: stop other programs"),
        (made(20, 400), "-> more than 1%: differences are not to be trusted here; stop other programs"),
    ],
)
def test_what_to_do(noise, expected):
    lines = describe(noise, CPU)
    assert expected in lines[-1]
    assert "1.00% in the median trial, 5.00% in the worst" in "\n".join(lines)


def test_a_gpu_is_told_about_clocks():
    assert "lock its clocks" in describe(made(20, 400), SimpleNamespace(name="cuda:0"))[-1]


def test_on_this_machine(monkeypatch):
    monkeypatch.setitem(noise_module.TRANSFERS, "cpu", (64, "hot"))
    monkeypatch.setattr(noise_module, "Rules", lambda: RULES)
    told = []
    found = measure_noise(CpuDevice(), seconds=0.01, tick=lambda *state: told.append(state))
    assert found.copies + found.unusable == COPIES * len(told) > 0


def test_doctor_prints_it(monkeypatch):
    monkeypatch.setitem(noise_module.TRANSFERS, "cpu", (64, "hot"))
    monkeypatch.setattr(noise_module, "Rules", lambda: RULES)
    monkeypatch.setattr("mpmbench.cli._gpu_present", lambda: False)
    result = CliRunner().invoke(main, ["doctor", "--noise", "--noise-seconds", "1"])
    assert result.exit_code == 0, result.output
    assert f"{COPIES + 1} copies of g2p_global_gather" in result.output
    assert "-> " in result.output
    assert CliRunner().invoke(main, ["doctor", "--noise-seconds", "0"]).exit_code == 2
