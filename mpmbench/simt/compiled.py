"""Python compiled by numba and kept on disk, in a cache that knows every source file of this folder.

numba's own cache looks at the file of the function alone. What a function takes from other files (places in a job or a
context, parts of it that are inlined) is compiled into it: with a cache that is stale in these, it would write to wrong
places in memory.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import FunctionCache, IndexDataCacheFile

from mpmbench.simt import cache


class _Cache(FunctionCache):
    """One function's cache, stamped with the digest of the folder instead of the date of a file."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        self._cache_file = IndexDataCacheFile(
            cache_path=self._cache_path, filename_base=self._impl.filename_base, source_stamp=_sources()
        )


@functools.cache
def _sources() -> str:
    return cache.source_digest(Path(__file__).parent)


def compiled(function: Callable[..., Any]) -> Any:
    """A function that is compiled at its first call, or comes from the disk."""
    dispatcher = numba.njit(nogil=True, error_model="numpy")(function)
    with contextlib.suppress(RuntimeError):  # neither the package's folder nor the user's cache can be written
        dispatcher._cache = _Cache(function)  # type: ignore[attr-defined]
    return dispatcher


def callback(signature: Any) -> Callable[[Callable[..., Any]], Any]:
    """A function that machine code can call by address, compiled now, or from the disk."""

    def compile_it(function: Callable[..., Any]) -> Any:
        from numba.core.ccallback import CFunc
        from numba.core.sigutils import normalize_signature

        made = CFunc(function, normalize_signature(signature), locals={}, options={})
        with contextlib.suppress(RuntimeError):
            made._cache = _Cache(function)  # type: ignore[attr-defined]
        made.compile()
        return made

    return compile_it


def inlined(function: Callable[..., Any]) -> Any:
    """A part of a compiled function: a call that passes arrays costs more than most of these parts do."""
    return numba.njit(inline="always", error_model="numpy")(function)
