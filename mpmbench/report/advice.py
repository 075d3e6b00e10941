"""What binds a run on a GPU and what would help, in one plain sentence: a table of rules, no prose by hand.

Where the model's range lets the second-largest term bind too, the sentence names both.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from mpmbench.gpu.modelled import TERM_WORDS, TERMS
from mpmbench.profile_record import Profile
from mpmbench.record import Record
from mpmbench.report.text import number
from mpmbench.simt.counters import Tally

SECTOR_BYTES = 32
LANES = 32

NEAR_FLOOR = 1.5  # DRAM traffic over the compulsory: below it, no strategy can save much
FEW_LANES = 20  # of 32, on average
ROUND = 5  # machine instructions of one trip of a compare-and-swap loop: load, add, swap, compare, branch
MANY_ROUNDS = 0.3  # of the issue slots
MANY_WAITS = 0.3  # of the life of a warp
MANY_WAVEFRONTS = 2.0  # per shared access
HOT = 0.01  # of all atomics, on one word
LAUNCH_BOUND = 0.5  # of the time


@dataclass(frozen=True)
class Facts:
    """What the rules ask of a record on one GPU."""

    record: Record
    profile: Profile

    @property
    def tally(self) -> Tally:
        counters = self.record.transfer_counters
        return Tally() if counters is None else counters.total

    @property
    def unsorted(self) -> bool:
        return self.record.axes.get("particle_order") == "given"

    @property
    def by_index(self) -> bool:
        return self.record.axes.get("particle_order") == "index"

    @property
    def per_block(self) -> bool:
        """Whether a thread block works on a block of the grid; block_shape alone may only shape the sort."""
        return "blocks" in self.record.axes

    @property
    def global_transfer(self) -> bool:
        """A transfer whose nodes go through the caches, each access for itself."""
        return self.record.is_transfer and not self.per_block

    @property
    def scatters(self) -> bool:
        return self.record.transfer == "p2g"

    @property
    def dram_over_floor(self) -> float | None:
        floor = self.record.floor_bytes
        return SECTOR_BYTES * self.profile.memory.dram_sectors / floor if floor else None

    @property
    def lanes(self) -> float:
        """Active lanes of a warp instruction, on average."""
        return self.tally.lane_inst / self.tally.warp_inst if self.tally.warp_inst else LANES

    @property
    def wavefronts(self) -> float:
        """Of a shared load or store, on average."""
        accesses = self.tally.sld_req + self.tally.sst_req
        return self.tally.shm_wavefronts / accesses if accesses else 0.0

    @property
    def trips(self) -> float:
        """Of the compare-and-swap loop of a shared atomic, on average."""
        return self.tally.satom_iter / self.tally.satom_req if self.tally.satom_req else 0.0

    @property
    def looping(self) -> float:
        """Share of the issue slots that those loops take."""
        rounds = ROUND * self.tally.satom_iter
        return rounds / (self.tally.warp_inst + rounds) if rounds else 0.0

    @property
    def waiting(self) -> float:
        """Share of the warps' life that barriers take, if latency alone took time."""
        return self.profile.barrier_wait_cycles / self.profile.warp_cycles if self.profile.warp_cycles else 0.0

    @property
    def hot(self) -> float:
        """Share of the atomics that meet on one word."""
        lanes = self.profile.memory.atomic_lanes
        return self.profile.hot_address / lanes if lanes else 0.0

    @property
    def sparse(self) -> bool:
        """Fewer warps were there than an SM has room for: the launch is small."""
        achieved = self.profile.metrics.get("sm_occupancy_warps")
        return achieved is not None and achieved < 0.5 * self.profile.occupancy.warps

    def limited_by(self, limiter: str) -> bool:
        held = self.profile.occupancy
        return held.limiter == limiter and held.warps < held.max_warps

    @property
    def room(self) -> str:
        held = self.profile.occupancy
        return f"{held.warps} of {held.max_warps} warps per SM"


@dataclass(frozen=True)
class Rule:
    """when: whether it applies.  help: what would help, as a clause."""

    when: Callable[[Facts], bool]
    help: Callable[[Facts], str]


def _always(text: str) -> Rule:
    return Rule(lambda f: True, lambda f: text)


def _loops(f: Facts) -> str:
    return (
        f"shared float atomics are loops, here of {number(f.trips)} trip{'' if f.trips == 1 else 's'} on average: "
        "adding up more particles in registers first (batching), or barriers instead (p2g_block_sync), would help"
    )


_SORT = Rule(
    lambda f: f.record.is_transfer and f.unsorted,
    lambda f: "sorting the particles (particle_order=deep) would bring the accesses of a warp together",
)
_DEEP = Rule(
    lambda f: f.by_index,
    lambda f: "moving the attributes too (particle_order=deep) would make the reads of particles contiguous",
)
_BLOCK = Rule(
    lambda f: f.global_transfer,
    lambda f: f"a block strategy ({f.record.transfer}_block_*) would meet the nodes in shared memory, once per block",
)

# Bound -> rules; the first one that applies is said. The last one of each always does.
RULES: dict[str, tuple[Rule, ...]] = {
    "issue": (
        Rule(
            lambda f: f.record.axes.get("writing") == "literal" and f.record.default_axes.get("writing") == "hoisted",
            lambda f: "writing=hoisted would compute the weights of a particle once and not at every node",
        ),
        Rule(lambda f: f.scatters and f.looping > MANY_ROUNDS, _loops),
        Rule(
            lambda f: f.lanes < FEW_LANES,
            lambda f: (
                f"only {number(f.lanes)} of {LANES} lanes work on average: work spread more evenly over the "
                "lanes of a warp would help"
            ),
        ),
        _always("only fewer instructions would help, not less memory traffic"),
    ),
    "shared": (
        Rule(lambda f: f.scatters and f.tally.satom_req > 0, _loops),
        Rule(
            lambda f: f.wavefronts > MANY_WAVEFRONTS,
            lambda f: (
                f"a shared access takes {number(f.wavefronts)} wavefronts on average: another block_shape may "
                "have fewer bank conflicts"
            ),
        ),
        Rule(
            lambda f: f.tally.shm_wavefronts + f.tally.satom_req == 0,
            lambda f: "fewer, wider global requests would help",
        ),
        _always("only fewer shared accesses would help"),
    ),
    "l1": (_SORT, _BLOCK, _always("fewer or wider global loads would help")),
    "l2": (_SORT, _DEEP, _BLOCK, _always("only fewer sectors per global request, or fewer requests, would help")),
    "dram": (
        Rule(
            lambda f: (f.dram_over_floor or NEAR_FLOOR) < NEAR_FLOOR,
            lambda f: (
                f"DRAM traffic is {number(f.dram_over_floor or 0)} times the compulsory, so no strategy can "
                "be much faster on the same data; fewer bytes per particle would help"
            ),
        ),
        _SORT,
        _DEEP,
        Rule(
            lambda f: f.dram_over_floor is not None,
            lambda f: (
                f"DRAM traffic is {number(f.dram_over_floor or 0)} times the compulsory: data used again "
                "sooner, while the caches still hold it, would help"
            ),
        ),
        _always("only less DRAM traffic would help"),
    ),
    "activations": (_SORT, _DEEP, _always("only accesses that lie closer together in memory would help")),
    "atomics": (
        Rule(
            lambda f: f.scatters and f.global_transfer,
            lambda f: (
                "a block strategy (p2g_block_*) would add up in shared memory and send one global atomic per "
                "node and block"
            ),
        ),
        Rule(
            lambda f: f.record.axes.get("blocks") == "all",
            lambda f: "blocks=active would send none for empty blocks",
        ),
        Rule(
            lambda f: f.hot > HOT,
            lambda f: f"{100 * f.hot:.0f} % of the atomics meet on one word: adding up more of them first would help",
        ),
        Rule(
            lambda f: f.per_block,
            lambda f: "a larger block_shape has less halo per cell, hence fewer atomics",
        ),
        _always("fewer global atomics would help"),
    ),
    "latency": (
        Rule(
            lambda f: f.sparse,
            lambda f: "there are too few thread blocks to fill the GPU: more work per launch would help",
        ),
        Rule(
            lambda f: f.waiting > MANY_WAITS,
            lambda f: (
                f"warps spend {100 * f.waiting:.0f} % of their life waiting at barriers: fewer of them, or cells "
                "filled more evenly, would help"
            ),
        ),
        Rule(
            lambda f: f.limited_by("registers"),
            lambda f: f"registers leave room for {f.room}: a kernel that needs fewer would hide more latency",
        ),
        Rule(
            lambda f: f.limited_by("shared memory"),
            lambda f: f"shared memory leaves room for {f.room}: a smaller block_shape would hide more latency",
        ),
        Rule(
            lambda f: f.limited_by("blocks"),
            lambda f: f"small thread blocks leave room for {f.room}: larger ones would hide more latency",
        ),
        _always("every place for a warp is taken: only shorter chains of dependent accesses would help"),
    ),
}


def sentence(record: Record, profile: Profile) -> str:
    """What binds, and what would help."""
    facts, time = Facts(record, profile), profile.time
    launch = time.terms.get("launch", 0.0)
    if time.seconds and launch / time.seconds > LAUNCH_BOUND:
        return f"Launch overhead is {_share(launch, profile)} of the time: more work per launch would help."
    first, *others = binding(profile)
    words = f"Bound by {TERM_WORDS[first]}, {_share(time.terms.get(first, 0.0), profile)} of the time"
    if not others:
        return f"{words}: {advice(first, facts)}."
    second = others[0]
    words += f" or, within the model's range, by {TERM_WORDS[second]}, {_share(time.terms[second], profile)}"
    for_first, for_second = advice(first, facts), advice(second, facts)
    if for_first == for_second:
        return f"{words}: {for_first}."
    return f"{words}. For the first, {for_first}; for the second, {for_second}."


def binding(profile: Profile) -> tuple[str, ...]:
    """The term that binds and, if the range lets it bind as well, the second-largest one."""
    time = profile.time
    launch = time.terms.get("launch", 0.0)
    others = sorted((t for t in TERMS if t != time.bound), key=lambda t: -time.terms.get(t, 0.0))
    second = others[0]
    may_bind = time.terms.get(second, 0.0) > 0 and launch + time.terms[second] >= time.low
    return (time.bound, second) if may_bind else (time.bound,)


def advice(bound: str, facts: Facts) -> str:
    """The clause of the first rule that applies."""
    return next(rule.help(facts) for rule in RULES[bound] if rule.when(facts))


def _share(seconds: float, profile: Profile) -> str:
    return f"{100 * seconds / profile.time.seconds:.0f} %" if profile.time.seconds else "all"
