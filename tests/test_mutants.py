"""Broken kernels must be refused: each mutant is one edit of a shipped source, sent through the public check."""

from __future__ import annotations

import inspect
import re
import shutil
import tomllib
from pathlib import Path

import pytest
from transfers import crowded, transfer

from mpmbench import device as devices
from mpmbench import discovery, kernel, preprocess
from mpmbench.awkward import awkward_datasets
from mpmbench.kernel import load_source
from mpmbench.variants import discover, get
from mpmbench.workspace import NEUTRAL

MUTANTS = tomllib.loads((Path(__file__).parent / "mutants" / "mutants.toml").read_text())
MARGIN = 10  # how many times its allowance a wrong result must miss, so that a looser check would still refuse it


@pytest.fixture(scope="module")
def modes():
    return {mode: devices.open_device("simulated", arch="sm_52", mode=mode) for mode in ("run", "debug")}


def mutated_sources(mutant: dict, folder: Path) -> Path:
    """A copy of the kernel sources with one edit, whose old text must be there exactly once."""
    sources = folder / "raw_kernels"
    shutil.copytree(kernel.RAW_KERNELS, sources)
    path = sources / mutant["file"]
    text = path.read_text()
    assert text.count(mutant["old"]) == 1, f"{mutant['file']} holds the text {text.count(mutant['old'])} times"
    path.write_text(text.replace(mutant["old"], mutant["new"]))
    return sources


def mode_of(mutant: dict) -> str:
    return "debug" if mutant["refused_by"] == "finding" else mutant.get("mode", "run")


def run(mutant: dict, modes: dict) -> tuple:
    """The verdict and the findings."""
    axes = {"writing": "literal"} | mutant.get("axes", {})
    dataset = awkward_datasets()[mutant["dataset"]] if "dataset" in mutant else crowded()
    check, _, findings = transfer(get(mutant["variant"]), dataset, modes[mode_of(mutant)], **axes)
    return check, findings


@pytest.mark.parametrize("name", MUTANTS)
def test_mutant_is_refused(name: str, modes, tmp_path: Path, monkeypatch) -> None:
    mutant = MUTANTS[name]
    sources = mutated_sources(mutant, tmp_path)
    monkeypatch.setattr(kernel, "RAW_KERNELS", sources)
    monkeypatch.setattr(discovery, "RAW_KERNELS", sources)
    check, findings = run(mutant, modes)
    if mutant["refused_by"] == "finding":
        assert mutant["kind"] in {finding.kind for finding in findings}
    else:
        assert not check.passed
        assert check.ratio >= MARGIN


def origin(mutant: dict) -> tuple:
    """What a mutant is without its edit."""
    return mode_of(mutant), mutant["variant"], mutant.get("dataset", ""), repr(mutant.get("axes", {}))


@pytest.mark.parametrize("mutant", {origin(m): m for m in MUTANTS.values()}.values(), ids=lambda m: "-".join(origin(m)))
def test_unbroken_origin_passes(mutant: dict, modes) -> None:
    """It is the edit that is refused, in both ways of refusing."""
    check, findings = run(mutant, modes)
    assert check.passed, str(check)
    assert not findings


def test_every_file_of_a_transfer_has_been_broken() -> None:
    helpers = re.findall(r'helper\(\s*"(\w+)"', inspect.getsource(preprocess))
    stems = {*helpers, "scan_lookback", *(variant.kernel for variant in discover())}
    texts = [load_source(stem, NEUTRAL).text for stem in stems]
    files = {file for text in texts for file in re.findall(r'^#line \d+ "(.*)"$', text, re.M)}
    assert {mutant["file"] for mutant in MUTANTS.values()} == files
