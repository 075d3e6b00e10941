"""Errors of tables 3 and 4, from files that ``mpmbench verify --json`` wrote.

A file ships with the package, since a thousand round trips take an hour: table 3 at full size, table 4 as ``--quick``
leaves it. Files named by a user go before it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mpmbench.errors import InputError

SHIPPED = Path(__file__).with_name("verified.json")


def verified_parts(paths: Sequence[Path] = ()) -> dict[str, Mapping[str, Any]]:
    """Parts by name (table3, table4), each with the environment it was made in; later files win."""
    found: dict[str, Mapping[str, Any]] = {}
    for path in (SHIPPED, *paths):
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            for part in content["parts"]:
                found[part["name"]] = {"environment": content["environment"], **part}
        except OSError as error:
            raise InputError(f"cannot read {path}: {(error.strerror or str(error)).lower()}") from None
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(
                f"{path} was not written by mpmbench verify --json ({type(error).__name__}: {error}): name another file"
            ) from None
    return found
