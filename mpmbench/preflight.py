"""What to know of a GPU before its times are believed.

This file is the seam: reports ask ``warnings`` about every GPU that timed something.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any


def warnings(facts: Mapping[str, Any]) -> Sequence[tuple[str, str]]:
    """(what is wrong, what to do about it) from the facts that a record keeps of its GPU (``Environment.gpu``)."""
    return []
