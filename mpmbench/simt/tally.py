"""Raw counter words of a launch -> counters by source line."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mpmbench.simt.codegen_count import PART_WORDS, PARTS, SEGMENT_WORDS, SITE_WORDS
from mpmbench.simt.counters import Counters, SourceLine, Tally

if TYPE_CHECKING:
    from mpmbench.simt.engine import _Description

_NO_LINE = SourceLine("?", 0)

# Fields of a tally that a site's four words (requests, lanes, amount, passes) add to.
_SITE_FIELDS: dict[tuple[str, str], tuple[str | None, ...]] = {
    ("load", "global"): ("gld_req", None, "gld_sectors", None),
    ("store", "global"): ("gst_req", None, "gst_sectors", None),
    ("atomic", "global"): ("gatom_req", "gatom_lane", "gatom_sectors", "gatom_pass"),
    ("load", "shared"): ("sld_req", None, "shm_wavefronts", None),
    ("store", "shared"): ("sst_req", None, "shm_wavefronts", None),
    ("atomic", "shared"): ("satom_req", "satom_lane", "satom_iter", "satom_wavefronts"),
    ("load", "local"): ("lld_req", None, None, None),
    ("store", "local"): ("lst_req", None, None, None),
    ("atomic", "local"): (None, None, None, None),
}


def counters_from(facts: _Description, words: np.ndarray) -> Counters:
    """words: int64, laid out as codegen_count says."""
    counters = Counters()

    def tally(instruction: int) -> Tally:
        line = facts.lines[instruction]
        return counters.lines.setdefault(SourceLine(*line) if line else _NO_LINE, Tally())

    segments = words[: SEGMENT_WORDS * len(facts.segments)].reshape(-1, SEGMENT_WORDS).tolist()
    for (start, stop), (executions, lanes, divergent) in zip(facts.segments, segments, strict=True):
        if not executions:
            continue
        for instruction in range(start, stop):
            entry = tally(instruction)
            entry.warp_inst += executions
            entry.lane_inst += lanes
        last = stop - 1
        root, _, rest = facts.opcodes[last].partition(".")
        if root in ("bar", "barrier"):
            if "warp" in rest.split("."):
                tally(last).bar_warp += executions
            else:
                tally(last).bar += executions
        elif root == "brx" or (root == "bra" and facts.guarded[last]):
            tally(last).branch += executions
            tally(last).div_branch += divergent
    at = SEGMENT_WORDS * len(facts.segments)
    parts = words[at : at + SITE_WORDS * len(facts.sites)].reshape(-1, len(PARTS), PART_WORDS).tolist()
    for site, of_site in zip(facts.sites, parts, strict=True):
        for space, amounts in zip(PARTS, of_site, strict=True):
            if not amounts[0]:
                continue
            entry = tally(site.index)
            for name, amount in zip(_SITE_FIELDS[site.kind, space], amounts, strict=True):
                if name is not None:
                    setattr(entry, name, getattr(entry, name) + amount)
    for entry in counters.lines.values():
        counters.total += entry
    return counters


def opcodes_from(facts: _Description, words: np.ndarray) -> dict[tuple[str, int | None], int]:
    """Executions by a warp of each PTX opcode with each integer literal. words: as above."""
    executions: dict[tuple[str, int | None], int] = {}
    segments = words[: SEGMENT_WORDS * len(facts.segments)].reshape(-1, SEGMENT_WORDS)[:, 0].tolist()
    for (start, stop), times in zip(facts.segments, segments, strict=True):
        if times:
            for key in zip(facts.opcodes[start:stop], facts.literals[start:stop], strict=True):
                executions[key] = executions.get(key, 0) + times
    return executions
