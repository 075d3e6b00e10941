"""A user's particles in a ``.npz`` or ``.npy`` file.

``.npz``: position, velocity (n, 3) [m], [m/s]; mass (n,) or one number [kg]; optionally affine (n, 3, 3) [1/s], and the
grid: grid_shape (or grid) as one number or three, dx [m], origin [m]. Other arrays are ignored, unless their name is
nearly one of these.
``.npy``: (n, 7) with the columns x, y, z, vx, vy, vz, mass.
"""

from __future__ import annotations

from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np

from mpmbench.errors import InputError

SUFFIXES = (".npz", ".npy")
REQUIRED = ("position", "velocity", "mass")
OPTIONAL = ("affine", "grid_shape", "dx", "origin")


def read(path: Path) -> dict[str, Any]:
    """The arrays of a file by name, as stored: position, velocity, mass and those of ``OPTIONAL`` that it has."""
    try:
        content = np.load(path, allow_pickle=False)
        arrays = dict(content) if isinstance(content, np.lib.npyio.NpzFile) else None
    except FileNotFoundError:
        raise InputError(f"no such file: {path}") from None
    except Exception as error:  # a damaged file can raise nearly anything in there
        first_line = str(error).partition("\n")[0] or type(error).__name__
        if "pickle" in first_line:
            first_line = "it is something else, or holds Python objects"
        raise InputError(f"file {str(path)!r} is not a readable {path.suffix} of plain numbers: {first_line}") from None
    if arrays is None:
        if content.ndim != 2 or content.shape[1] != 7:
            raise InputError(
                f"file {str(path)!r} has shape {content.shape}, want (n, 7): columns x, y, z, vx, vy, vz, mass"
            )
        return {"position": content[:, :3], "velocity": content[:, 3:6], "mass": content[:, 6]}
    if "grid" in arrays:
        arrays.setdefault("grid_shape", arrays["grid"])
    missing = [name for name in REQUIRED if name not in arrays]
    if missing:
        raise InputError(
            f"file {str(path)!r} lacks {', '.join(missing)}: want arrays {', '.join(REQUIRED)} "
            f"and optionally {', '.join(OPTIONAL)}; it has {', '.join(arrays) or 'none'}"
        )
    absent = [name for name in OPTIONAL if name not in arrays]
    for name in arrays:
        if name not in (*REQUIRED, *OPTIONAL, "grid") and (meant := get_close_matches(name, absent, 1, 0.8)):
            raise InputError(
                f"file {str(path)!r} has an array {name!r}: rename it to {meant[0]!r}, or to something else"
            )
    return {name: arrays[name] for name in REQUIRED + OPTIONAL if name in arrays}
