"""The clocks of real devices."""

from __future__ import annotations

import time
from typing import Any

from mpmbench.protocol.rounds import Arm, Sample

HOLD_SECONDS = 30e-6
HOLD_SECONDS_PER_LAUNCH = 20e-6


class DeviceClock:
    def __init__(self, device: Any, cache: str) -> None:
        self.device, self.cache = device, cache

    def sample(self, arm: Arm) -> Sample:
        device = self.device
        arm.prepare()
        if self.cache == "hot":
            arm.run()
            arm.prepare()
        if self.cache == "cold":
            device.flush_cache()
        device.synchronize()
        device.hold(HOLD_SECONDS + HOLD_SECONDS_PER_LAUNCH * arm.launches)
        start = device.record()
        arm.run()
        end = device.record()
        device.synchronize()
        return Sample(device.elapsed(start, end))

    def now(self) -> float:
        return time.monotonic()

    def pause(self, seconds: float) -> None:
        time.sleep(seconds)

    def trouble(self) -> str:
        return ""


def clock_of(device: Any, cache: str) -> DeviceClock:
    """The clock that times this device."""
    return DeviceClock(device, cache)
