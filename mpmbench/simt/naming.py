"""Threads, thread blocks and source lines in compute-sanitizer's words."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mpmbench.simt.counters import SourceLine

if TYPE_CHECKING:
    from mpmbench.simt.engine import _Job

_NAMED_THREADS = 4


def threads_text(job: _Job, warp: int, lanes: int) -> str:
    """The threads of a warp's lanes (bits): ``threads (3,0,0), (4,0,0) and 5 more``."""
    x, y = max(job.get("block_x"), 1), max(job.get("block_y"), 1)
    numbers = [32 * warp + lane for lane in range(32) if lanes >> lane & 1]
    named = [f"({n % x},{n // x % y},{n // (x * y)})" for n in numbers[:_NAMED_THREADS]]
    more = f" and {len(numbers) - len(named)} more" if len(numbers) > len(named) else ""
    return f"thread{'s' if len(numbers) > 1 else ''} {', '.join(named)}{more}"


def block_text(job: _Job, number: int) -> str:
    """A thread block by its number in the launch: ``(1,0,0)``."""
    x, y = max(job.get("grid_x"), 1), max(job.get("grid_y"), 1)
    return f"({number % x},{number // x % y},{number // (x * y)})"


def line_text(line: SourceLine | None) -> str:
    return f"{line.file}:{line.line}" if line else "an unknown line"
