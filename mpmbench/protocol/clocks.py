"""The clocks of real devices: events on a GPU, wall clock on a CPU.

State of the caches before a sample: "cold", overwritten; "hot", as a run of the same arm left them; "step", as the rest
of a simulation's step left them, which is part of preparing the arm.
"""

from __future__ import annotations

import time
from typing import Any

from mpmbench.protocol.rounds import Arm, Clock, Sample

THROTTLED = 0.75  # of the usual SM clock; slower samples are thrown away (NVBench's threshold)

# How much of a wall-clock sample the process may spend off its core: a share of it, and something for short ones.
DISTURBED_SHARE = 0.03
DISTURBED_SECONDS = 1e-3  # [s]


class _RealTime:
    """Limits and pauses in real time; what brings the caches into their state."""

    def __init__(self, device: Any, cache: str) -> None:
        self.device, self.cache = device, cache

    def now(self) -> float:
        return time.monotonic()

    def pause(self, seconds: float) -> None:
        time.sleep(seconds)

    def trouble(self) -> str:
        return ""

    def _prepare(self, arm: Arm) -> None:
        arm.prepare()
        if self.cache == "hot":
            arm.run()
            arm.prepare()
        elif self.cache == "cold":
            self.device.flush_cache()
        self.device.synchronize()


class EventClock(_RealTime):
    """CUDA events on a stream that is held until the sample is enqueued, between two stamps of the SM clock.

    Every kernel of an arm must have run before its first sample; checking its result has seen to that.
    """

    def __init__(self, device: Any, cache: str) -> None:
        super().__init__(device, cache)
        self._usual_hertz = device.usual_hertz

    def sample(self, arm: Arm) -> Sample:
        device = self.device
        self._prepare(arm)
        device.hold()
        try:
            before = device.stamp()
            start = device.record()
            arm.run()
            end = device.record()
            after = device.stamp()
        finally:
            device.release()  # after an error too: whoever waits for the stream next must not wait for the limit
        device.synchronize()
        seconds, hertz = device.elapsed(start, end), device.clock_between(before, after)
        return Sample(seconds, hertz, "hold timed out" if device.hold_expired else self._too_slow(hertz))

    def trouble(self) -> str:
        return self.device.throttle_reasons()

    def _too_slow(self, hertz: float | None) -> str:
        usual = self._usual_hertz
        if hertz is None or usual is None or hertz >= THROTTLED * usual:
            return ""
        return f"SM clock below {100 * THROTTLED:.0f} % of its default"


class WallClock(_RealTime):
    """Wall clock around a run on this CPU. A sample in which another process took the core is thrown away, judged by
    processor time and never by how fast the sample was. It is tolerable: on a machine that is always busy, that is what
    runs are like."""

    def sample(self, arm: Arm) -> Sample:
        self._prepare(arm)
        wall, processor = time.perf_counter(), time.process_time()
        arm.run()
        self.device.synchronize()
        wall, processor = time.perf_counter() - wall, time.process_time() - processor
        lost = wall - processor > DISTURBED_SHARE * wall + DISTURBED_SECONDS
        return Sample(wall, None, "another process took the core" if lost else "", tolerable=True)


def clock_of(device: Any, cache: str) -> Clock:
    """The clock that times this device."""
    return EventClock(device, cache) if hasattr(device, "stamp") else WallClock(device, cache)
