"""A clock that follows a script: noise, outliers, drift, steps, throttling. The protocol is held to it without a GPU.

Each sample takes what its arm takes, times the level of the machine at that moment, times noise. Every sample moves the
level on, whoever takes it; the warm-up does as well. No time passes in earnest.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mpmbench.protocol.rounds import Arm, Sample


@dataclass(frozen=True)
class Script:
    """What the machine does. Shares are of all samples, sizes are relative.

    drift: root-mean-square difference of the mean levels of two successive windows of 120 samples; the level walks at
    random.  noise: scale of the one-sided (exponential) noise.  outliers: share of samples that take 1.2 to 3 times as
    long.  step: size of one lasting change of the level at a random moment.  throttle: by how much the level falls
    during ``throttled``, a share of the samples in one piece at a random place.
    """

    drift: float = 0.0
    noise: float = 0.004
    outliers: float = 0.01
    step: float = 0.0
    throttle: float = 0.0
    throttled: float = 0.2
    samples: int = 480

    def levels(self, random: np.random.Generator) -> np.ndarray:
        """Level times noise at each moment, (samples,): how much longer than in calm a sample takes."""
        n = self.samples
        # Means of successive windows of w samples of a walk with steps s differ by s sqrt(2 w / 3).
        level = np.cumsum(random.normal(0, self.drift / np.sqrt(2 * WINDOW / 3), n)) if self.drift else np.zeros(n)
        if self.step:
            level[random.integers(n) :] += self.step * random.choice((-1, 1))
        if self.throttle:
            length = round(self.throttled * n)
            begin = random.integers(n - length + 1)
            level[begin : begin + length] += self.throttle
        slow = np.where(random.random(n) < self.outliers, random.uniform(1.2, 3.0, n), 1.0)
        return np.exp(level) * (1 + random.exponential(self.noise, n)) * slow


WINDOW = 120


class ScriptedClock:
    """Follows a script. seconds: arm name -> what it takes in calm [s]; a name that ends in " again" takes what the
    name without it takes. Starts over when the script is at its end."""

    def __init__(self, script: Script, seconds: Mapping[str, float], random: np.random.Generator) -> None:
        self.seconds = {**seconds, **{f"{name} again": s for name, s in seconds.items()}}
        self._levels = script.levels(random).tolist()
        self._place = 0
        self._now = 0.0

    def sample(self, arm: Arm) -> Sample:
        level = self._levels[self._place]
        self._place += 1
        if self._place == len(self._levels):
            self._place = 0
        seconds = self.seconds[arm.name] * level
        self._now += seconds
        return Sample(seconds)

    def now(self) -> float:
        return self._now

    def pause(self, seconds: float) -> None:
        self._now += seconds

    def trouble(self) -> str:
        return ""
