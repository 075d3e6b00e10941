"""The wheel is complete: recipes, published tables, kernel sources and templates work far from the checkout."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """The wheel, unpacked into a folder of its own; its dependencies come from this environment."""
    folder = tmp_path_factory.mktemp("wheel")
    built, site = folder / "built", folder / "site"
    _run([sys.executable, "-m", "build", "--wheel", "--outdir", built, ROOT], folder)
    (wheel,) = built.glob("*.whl")
    _run([sys.executable, "-m", "pip", "install", "--no-deps", "--target", site, wheel], folder)
    return site


def _run(command, folder, **env):
    process = subprocess.run(
        [str(word) for word in command], cwd=folder, env=os.environ | env, capture_output=True, text=True, timeout=300
    )
    assert process.returncode == 0, process.stdout + process.stderr
    return process.stdout


def test_wheel_works_in_an_empty_directory(installed, tmp_path):
    env = {"PYTHONPATH": str(installed), "PYTHONSAFEPATH": "1"}
    where = _run([sys.executable, "-c", "import mpmbench; print(mpmbench.__file__)"], tmp_path, **env)
    assert where.startswith(str(installed))
    listed = _run([sys.executable, "-m", "mpmbench", "list"], tmp_path, **env)
    assert "p2g_block_sync" in listed
    assert "splash" in listed
    thesis = _run([sys.executable, "-m", "mpmbench", "run", "--preset", "thesis", "--dry-run"], tmp_path, **env)
    assert "54 rows" in thesis
    words = ["run", "--quick", "-d", "simulated", "--html", "report.html"]
    out = _run([sys.executable, "-m", "mpmbench", *words], tmp_path, **env)
    assert "7 rows: 7 ok" in out
    assert (tmp_path / "report.html").stat().st_size > 10_000
