"""NVBench's rule for two sets of times: FAST, SLOW, SAME, AMBG or ????, by the code of cuda-bench itself.

The intervals from minimum to third quartile must lie apart by a gap, in seconds and again in clock cycles, for FAST or
SLOW; centers must be close and samples must cover each other for SAME. docs/decisions/010-nvbench-rule-is-imported.md
says why it is imported.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import PurePath
from typing import Any

from mpmbench.errors import InputError
from mpmbench.nvbench import CLOCK_MEAN, CPU_TIME, GPU_TIME, TIMES, WALL
from mpmbench.nvbench_rows import Row

PRESETS = ("default", "permissive", "strict")
UNUSABLE = "????"


@dataclass(frozen=True)
class Judgement:
    """verdict: NVBench's word.  reason: its code.  told: the reason in words, with what was wrong with samples."""

    verdict: str
    reason: str
    told: str


class RobustRule:
    """The rule with one of NVBench's presets of thresholds. Raises InputError where cuda-bench is not installed."""

    def __init__(self, preset: str = "default") -> None:
        self._tool = _tool()
        self._thresholds = self._tool.get_comparison_thresholds(preset)

    def judge(self, ref: Row, cmp: Row) -> Judgement:
        """``cmp`` against ``ref``, both of one kind: SLOW where ``cmp`` takes longer."""
        assert ref.kind == cmp.kind
        skipped = [f"{side}: {row.without_time}" for side, row in (("REF", ref), ("CMP", cmp)) if row.without_time]
        if skipped:
            return Judgement(UNUSABLE, "state_skipped", "; ".join(skipped))
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                timings = [self._timing(row) for row in (ref, cmp)]
            except ValueError as error:
                raise InputError(f"{ref.path}, {cmp.path}: {error}: write the file anew") from None
            found = self._tool.compare_gpu_timings(*timings, self._thresholds)
        told = found.reason.message
        if ref.kind == WALL and found.status.value != "AMBG":
            told = "judged by wall time alone: no clock"
        return Judgement(found.status.value, found.reason.code, "; ".join([told, *(str(w.message) for w in caught)]))

    def _timing(self, row: Row) -> Any:
        def from_memory(name: str) -> bytes:
            assert row.sidecars is not None
            path = PurePath(name)
            return row.sidecars[f"{path.parent.name}/{path.name}"]

        reader = self._tool.read_float32_file if row.sidecars is None else from_memory
        summaries = _as_gpu_time(row.state["summaries"]) if row.kind == WALL else row.state["summaries"]
        return self._tool.extract_gpu_timing_data(summaries, str(row.path.parent), reader, str(row.path))

    def axis_filter(self, filters: Sequence[str]) -> tuple[list[str], Callable[[Row], bool]]:
        """Axes that are named, and a test of rows: ``batching=4``, ``batching=[1,4]``, ``particles[pow2]=20``."""
        try:
            parsed = self._tool.parse_axis_filters(filters)
        except ValueError as error:
            raise InputError(f"{str(error)[0].lower()}{str(error)[1:]}") from None
        names = [one["name"] for one in parsed]
        return names, lambda row: self._tool.matches_axis_filters(row.state, parsed)


def _as_gpu_time(summaries: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Wall times under the names that the rule reads.

    A wall time has no SM clock to confirm a gap in cycles: a clock of 1 Hz on both sides confirms it in seconds. The
    kinds do not mix by this: a row is only ever judged against one of its own kind.
    """
    found = []
    for summary in summaries:
        tag = summary["tag"].replace(CPU_TIME, GPU_TIME).replace(f"{TIMES}nv/cpu_only", f"{TIMES}nv/cold")
        found.append({**summary, "tag": tag})
    clock = {"name": "value", "type": "float64", "value": "1"}
    return [*found, {"tag": CLOCK_MEAN, "data": [clock]}]


def _tool() -> Any:
    cure = "pip install 'mpmbench[nvbench]'"
    try:
        from cuda.bench.scripts import nvbench_compare_robust as tool

        tool.load_nvbench_compare_tooling(load_color=False)
        for name in ("compare_gpu_timings", "extract_gpu_timing_data", "parse_axis_filters", "matches_axis_filters"):
            getattr(tool, name)
        return tool
    except (ImportError, AttributeError, RuntimeError) as error:
        try:
            version = metadata.version("cuda-bench")
        except metadata.PackageNotFoundError:
            raise InputError(f"compare needs NVBench's rule, from the package cuda-bench: {cure}") from None
        raise InputError(f"cuda-bench {version} lacks what compare needs ({error}): {cure}") from None
