"""A profile keeps everything through JSON, and a record refuses one that it cannot vouch for."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from profiled import modelled_time, profile, record, strategies

from mpmbench.profile_record import METRICS, from_plain, to_plain
from mpmbench.record import Check, flatten, from_json, to_json


def test_profiles_survive_json():
    for made in strategies(("gtx970", "a100")):
        again = from_json(to_json(made))
        assert again == made
        assert again.modelled is not None
        assert again.modelled["a100"].lines == made.modelled["a100"].lines


def test_a_line_without_profiles_stays_readable():
    """As every record was before there were profiles."""
    line = to_json(record())
    assert json.loads(line)["modelled"] is None
    assert from_json(line).modelled is None


def test_numpy_numbers_become_plain():
    made = profile(modelled_time("gtx970", "dram", 1e-3), metrics={"vram_percent": np.float32(61.5)})
    assert from_json(to_json(record(profiles=(made,)))).modelled["gtx970"].metrics == {"vram_percent": 61.5}
    assert from_plain(to_plain(made)) == made


def test_a_torn_profile_is_no_record():
    plain = json.loads(to_json(strategies()[0]))
    del plain["modelled"]["gtx970"]["memory"]["dram_read"]
    plain["modelled"]["gtx970"]["time"]["colour"] = "blue"
    with pytest.raises(TypeError):
        from_json(json.dumps(plain))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"check": None}, "needs counters of a simulated run whose check passed"),
        ({"check": Check(False, 1.0, 1e-6)}, "needs counters of a simulated run whose check passed"),
        ({"device": "cuda:0", "transfer_counters": None, "preprocess": {}}, "needs counters of a simulated run"),
    ],
)
def test_no_modelled_time_without_a_checked_simulated_run(changes, words):
    with pytest.raises(ValueError, match=words):
        dataclasses.replace(strategies()[0], **changes)


def test_a_profile_stands_under_its_own_gpu():
    made = strategies()[0]
    with pytest.raises(ValueError, match="under the name of another GPU"):
        dataclasses.replace(made, modelled={"h100": made.modelled["gtx970"]})


def test_modelled_times_are_columns_of_the_data_frame():
    row = flatten(strategies(("gtx970", "a100"))[0])
    assert row["modelled_gtx970_s"] == 44.4e-3
    assert row["modelled_a100_low_s"] < row["modelled_a100_s"] < row["modelled_a100_high_s"]
    assert row["modelled_a100_bound"] == "activations"


def test_metrics_have_the_words_of_the_thesis():
    assert [title for title, _ in METRICS.values()][:3] == ["VRAM SOL%", "SM SOL%", "L2 SOL%"]
