"""Why a row is likely off: what is known about the row, then what its terms and counters say."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from functools import cache
from pathlib import Path

from mpmbench.gpu import Gpu
from mpmbench.gpu.modelled import TERM_WORDS, TERMS, ModelledTime
from mpmbench.reproduce.comparable import Judged
from mpmbench.reproduce.targets import BYTES, implied_bytes, prints_less_than_moves

PATH = Path(__file__).with_name("causes.toml")

# Warp stalls that Nsight names, the wait that each is (thesis table 2), and the terms that such a wait is spent in.
STALLS = {
    "L. Scoreb.": ("a wait for global memory", ("dram", "activations", "latency", "l2", "l1")),
    "S. Scoreb.": ("a wait for shared memory or atomics", ("shared", "atomics", "l2", "latency")),
    "Barrier": ("a wait at barriers", ("latency", "shared", "issue")),
    "No Instr.": ("a wait for instructions", ("issue",)),
}

SECOND_COUNTS = 0.3  # of the modelled time: a shorter second term explains nothing


@cache
def known_causes(path: Path = PATH) -> Mapping[tuple[int, str], str]:
    """Hand-written causes by table and printed name."""
    with path.open("rb") as file:
        return {(entry["table"], entry["row"]): entry["cause"] for entry in tomllib.load(file)["row"]}


def likely_cause(judged: Judged, gpu: Gpu) -> str:
    """A few sentences; what is certain first."""
    row = judged.row
    if row.failed is not None or row.modelled is None:
        return f"No modelled time: {row.failed or 'no reason given'}."
    sentences = [known_causes().get((row.table, row.row), "")]
    if judged.ratio is not None and row.published_us:
        sentences.append(_by_terms(row.modelled, row.published_us, judged.ratio))
    implied, ours = implied_bytes(row, gpu), row.metrics.get("dram_bytes")
    if implied and ours is not None and abs(ours / implied - 1) > BYTES:
        text = f"DRAM: {ours / 1e6:,.0f} MB counted, {implied / 1e6:,.0f} MB by the printed VRAM share times the time"
        if prints_less_than_moves(row, gpu):
            text += f", which is less than the {(row.floor_bytes or 0) / 1e6:,.0f} MB that each input and result are"
        sentences.append(f"{text}.")
    sentences.append(_by_stall(row.published.get("top_stall", ""), row.modelled.bound))
    return " ".join(filter(None, sentences))


def ranked_terms(modelled: ModelledTime) -> list[str]:
    """Names of the terms, largest first; without the launch."""
    return sorted((t for t in TERMS if modelled.terms.get(t)), key=lambda t: -modelled.terms[t])


def _by_terms(modelled: ModelledTime, published_us: float, ratio: float) -> str:
    if ratio >= 1:
        text = f"What binds would have to be {ratio:.2f} times as fast."
    else:
        text = f"What binds would have to take {1 / ratio:.2f} times as long."
        others = [term for term in ranked_terms(modelled) if term != modelled.bound]
        if others and (second := modelled.terms[others[0]]) > SECOND_COUNTS * modelled.seconds:
            together = (modelled.seconds + second) * 1e6 / published_us
            text += f" Without overlap, it and {TERM_WORDS[others[0]]} make {together:.2f} of the printed time."
    inside = modelled.low <= published_us * 1e-6 <= modelled.high
    return f"{text} The printed time lies in the modelled range." if inside else text


def _by_stall(printed: str, bound: str) -> str:
    for name, (wait, terms) in STALLS.items():
        if printed.startswith(name) and bound not in terms:
            return f"The printed top stall, {printed}, is {wait}: another limit than ours."
    return ""
