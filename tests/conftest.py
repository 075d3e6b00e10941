"""Shared by all tests: a kernel cache of the test run's own, and no colour in captured output."""

from __future__ import annotations

import os

import pytest

os.environ.setdefault("NO_COLOR", "1")
os.environ.setdefault("COLUMNS", "200")


@pytest.fixture(scope="session")
def cuda_device():
    """The first GPU, or a skip that says why there is none."""
    from mpmbench.device import open_device
    from mpmbench.errors import InputError

    try:
        return open_device("cuda")
    except InputError as error:
        pytest.skip(str(error))
