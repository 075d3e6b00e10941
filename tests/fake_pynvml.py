"""A stand-in for pynvml that holds every call to the real module's signatures, constants and errors, and logs commands.

nvidia-ml-py imports without a driver, so the real functions are at hand. What the fake has not, the real module has:
its constants and its errors are used as they are, and a name that it lacks is an AttributeError here too.
"""

from __future__ import annotations

import ctypes
import inspect
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import pynvml

COMMANDS = ("Set", "Reset")


@dataclass
class NvmlGpu:
    """A GPU as NVML knows it. refuses: functions that it answers with this error code, by name."""

    uuid: str = "GPU-01020304-0506-0708-090a-0b0c0d0e0f10"
    pci_bus_id: str = "00000000:01:00.0"
    name: str = "Fake GPU"
    capability: tuple[int, int] = (9, 0)
    sm_clock: int = 1050
    sm_clock_max: int = 1980
    sm_clock_default: int = 1500
    memory_clock: int = 2619
    power_limit: int = 700_000  # [mW]
    power_limit_default: int = 700_000
    temperature: int = 41
    reasons: int = 0
    ecc: int = 1
    mig: int = 0
    persistence: int = 1
    compute_mode: int = 0
    processes: list[int] = field(default_factory=lambda: [4711])
    part_of: NvmlGpu | None = None  # for an instance: the GPU it is a part of
    locked_to: tuple[int, int] | None = None
    refuses: dict[str, int] = field(default_factory=dict)


class FakeNvml:
    """The module to put in place of ``pynvml``. commands: what changed a GPU, in order."""

    def __init__(self, *gpus: NvmlGpu, fail_init: int | None = None) -> None:
        self.gpus, self.fail_init = list(gpus) or [NvmlGpu()], fail_init
        self.commands: list[tuple[Any, ...]] = []
        self.log = self.commands.append

    def __getattr__(self, name: str) -> Any:
        real = getattr(pynvml, name)
        if not inspect.isfunction(real):
            return real
        answer = getattr(self, f"_{name}", None) if not name.startswith("_") else None
        if answer is None:
            raise NotImplementedError(f"the fake of pynvml has no {name}")
        return self._held_to(name, inspect.signature(real), answer)

    def _held_to(self, name: str, signature: inspect.Signature, answer: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **named: Any) -> Any:
            bound = signature.bind(*arguments, **named)
            bound.apply_defaults()
            first = next(iter(bound.arguments.values()), None)
            if isinstance(first, NvmlGpu) and name in first.refuses:
                raise pynvml.NVMLError(first.refuses[name])
            if any(name.startswith(f"nvmlDevice{command}") for command in COMMANDS):
                self.log((name, *bound.args[1:]))
            return answer(*bound.args)

        return call

    def _nvmlInit(self) -> None:
        if self.fail_init is not None:
            raise pynvml.NVMLError(self.fail_init)

    def _nvmlShutdown(self) -> None: ...

    def _nvmlSystemGetDriverVersion(self) -> str:
        return "580.65.06"

    def _nvmlDeviceGetCount(self) -> int:
        return len(self.gpus)

    def _nvmlDeviceGetHandleByIndex(self, index: int) -> NvmlGpu:
        return self.gpus[index]

    def _nvmlDeviceGetHandleByUUID(self, uuid: str) -> NvmlGpu:
        return self._found(lambda gpu: gpu.uuid == uuid)

    def _nvmlDeviceGetHandleByPciBusId(self, bus_id: str) -> NvmlGpu:
        # NVML takes a domain of four digits as well as its own eight.
        return self._found(lambda gpu: gpu.pci_bus_id.lower().endswith(bus_id.lower()))

    def _found(self, is_it: Callable[[NvmlGpu], bool]) -> NvmlGpu:
        for gpu in self.gpus:
            if is_it(gpu):
                return gpu
        raise pynvml.NVMLError(pynvml.NVML_ERROR_NOT_FOUND)

    def _nvmlDeviceIsMigDeviceHandle(self, gpu: NvmlGpu) -> ctypes.c_uint:
        return ctypes.c_uint(gpu.part_of is not None)  # as pynvml does: not its value

    def _nvmlDeviceGetDeviceHandleFromMigDeviceHandle(self, gpu: NvmlGpu) -> NvmlGpu | None:
        return gpu.part_of

    def _nvmlDeviceGetUUID(self, gpu: NvmlGpu) -> str:
        return gpu.uuid

    def _nvmlDeviceGetName(self, gpu: NvmlGpu) -> str:
        return gpu.name

    def _nvmlDeviceGetCudaComputeCapability(self, gpu: NvmlGpu) -> tuple[int, int]:
        return gpu.capability

    def _nvmlDeviceGetClockInfo(self, gpu: NvmlGpu, domain: int) -> int:
        return {pynvml.NVML_CLOCK_SM: gpu.sm_clock, pynvml.NVML_CLOCK_MEM: gpu.memory_clock}[domain]

    def _nvmlDeviceGetMaxClockInfo(self, gpu: NvmlGpu, domain: int) -> int:
        return {pynvml.NVML_CLOCK_SM: gpu.sm_clock_max, pynvml.NVML_CLOCK_MEM: gpu.memory_clock}[domain]

    def _nvmlDeviceGetClock(self, gpu: NvmlGpu, domain: int, which: int) -> int:
        assert which == pynvml.NVML_CLOCK_ID_APP_CLOCK_DEFAULT
        return {pynvml.NVML_CLOCK_GRAPHICS: gpu.sm_clock_default, pynvml.NVML_CLOCK_MEM: gpu.memory_clock}[domain]

    def _nvmlDeviceGetCurrentClocksEventReasons(self, gpu: NvmlGpu) -> int:
        return gpu.reasons

    def _nvmlDeviceGetCurrentClocksThrottleReasons(self, gpu: NvmlGpu) -> int:
        return gpu.reasons

    def _nvmlDeviceGetPowerManagementLimit(self, gpu: NvmlGpu) -> int:
        return gpu.power_limit

    def _nvmlDeviceGetPowerManagementDefaultLimit(self, gpu: NvmlGpu) -> int:
        return gpu.power_limit_default

    def _nvmlDeviceGetPowerManagementLimitConstraints(self, gpu: NvmlGpu) -> list[int]:
        return [200_000, 700_000]

    def _nvmlDeviceGetTemperatureV(self, gpu: NvmlGpu, sensor: int, version: int) -> int:
        assert (sensor, version) == (pynvml.NVML_TEMPERATURE_GPU, pynvml.nvmlTemperature_v1)
        return gpu.temperature

    def _nvmlDeviceGetTemperature(self, gpu: NvmlGpu, sensor: int) -> int:
        return gpu.temperature

    def _nvmlDeviceGetEccMode(self, gpu: NvmlGpu) -> list[int]:
        return [gpu.ecc, 0]

    def _nvmlDeviceGetMigMode(self, gpu: NvmlGpu) -> list[int]:
        return [gpu.mig, 0]

    def _nvmlDeviceGetPersistenceMode(self, gpu: NvmlGpu) -> int:
        return gpu.persistence

    def _nvmlDeviceGetComputeMode(self, gpu: NvmlGpu) -> int:
        return gpu.compute_mode

    def _nvmlDeviceGetComputeRunningProcesses(self, gpu: NvmlGpu) -> list[Any]:
        return [pynvml.nvmlStructToFriendlyObject(pynvml.c_nvmlProcessInfo_t(pid=pid)) for pid in gpu.processes]

    def _nvmlDeviceSetGpuLockedClocks(self, gpu: NvmlGpu, lowest: int, highest: int) -> None:
        gpu.locked_to = lowest, highest
        gpu.sm_clock = highest if highest < gpu.sm_clock_max else 1300

    def _nvmlDeviceResetGpuLockedClocks(self, gpu: NvmlGpu) -> None:
        gpu.locked_to = None
