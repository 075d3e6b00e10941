"""Every combination of the axes that change a strategy's text, against the reference: hours of ``make test-all``.

What has passed is noted in the cache folder under a hash of the whole package, so a run that was stopped goes on where
it was, and any change of the code starts afresh.
"""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from pairwise import texts_of
from transfers import crowded, transfer

import mpmbench
from mpmbench.device import open_device
from mpmbench.simt import cache
from mpmbench.variants import discover

PACKAGE = Path(mpmbench.__file__).parent


@pytest.mark.slow
@pytest.mark.parametrize("variant", discover(), ids=lambda variant: variant.name)
def test_every_combination(variant) -> None:
    journal = cache.cache_folder() / f"passed-{variant.name}.txt"
    journal.parent.mkdir(parents=True, exist_ok=True)
    passed = set(journal.read_text().split("\n")) if journal.exists() else set()
    rows = texts_of(variant)
    random.Random(1).shuffle(rows)  # a run that is stopped early has seen a bit of everything
    device = open_device("simulated", arch="sm_52", mode="run")
    code = "".join(path.read_text() for path in sorted(PACKAGE.rglob("*")) if path.suffix in {".py", ".cu", ".cuh"})
    dataset = crowded()
    with pytest.MonkeyPatch.context() as patch, journal.open("a") as notes:
        patch.setattr(cache, "store", lambda *_: None)  # tens of thousands of kernels would fill the disk
        for axes in rows:
            key = cache.content_key(code, repr(sorted(axes.items())))
            if key in passed:
                continue
            check, _, findings = transfer(variant, dataset, device, **axes)
            assert check.passed, f"{axes}: {check}"
            assert not findings
            notes.write(key + "\n")
            notes.flush()
