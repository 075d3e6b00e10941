"""A disk cache of compiled things, keyed by a hash of everything that went into them.

Entries are files that appear by an atomic rename, so that processes that compile the same thing at once do no harm.
The first 32 bytes of a file are the digest of the rest: an entry that is damaged or cut short is compiled again. A
folder that cannot be written (full disk, read-only home) costs time, never a failure.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
from pathlib import Path

_DIGEST = hashlib.sha256
_DIGEST_BYTES = _DIGEST().digest_size


def cache_folder() -> Path:
    """``MPMBENCH_CACHE_DIR``, else ``$XDG_CACHE_HOME/mpmbench``, else ``~/.cache/mpmbench``. Read at every call."""
    if chosen := os.environ.get("MPMBENCH_CACHE_DIR"):
        return Path(chosen)
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "mpmbench"


def content_key(*parts: str | bytes) -> str:
    """Hex digest of the parts; their borders count, so that ("ab", "c") and ("a", "bc") differ."""
    digest = _DIGEST()
    for part in parts:
        data = part.encode() if isinstance(part, str) else part
        digest.update(len(data).to_bytes(8, "little"))
        digest.update(data)
    return digest.hexdigest()


def source_digest(folder: Path) -> str:
    """Digest of the Python files of a folder: compiled code is stale as soon as its generator changes."""
    return content_key(*(path.read_bytes() for path in sorted(folder.glob("*.py"))))


def load(kind: str, key: str) -> bytes | None:
    """The stored bytes, or None where there is no sound entry. kind names the sub-folder, key is a hex digest."""
    try:
        stored = _path(kind, key).read_bytes()
    except OSError:
        return None
    digest, data = stored[:_DIGEST_BYTES], stored[_DIGEST_BYTES:]
    return data if _DIGEST(data).digest() == digest else None


def store(kind: str, key: str, data: bytes) -> None:
    """Keep ``data``; where the disk refuses, nothing is kept and nothing is said."""
    path = _path(kind, key)
    temporary = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=".new-")
        with os.fdopen(handle, "wb") as file:
            file.write(_DIGEST(data).digest() + data)
        Path(temporary).replace(path)
    except OSError:
        if temporary is not None:
            with contextlib.suppress(OSError):
                Path(temporary).unlink()


def _path(kind: str, key: str) -> Path:
    return cache_folder() / kind / key[:2] / key[2:]
