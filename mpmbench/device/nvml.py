"""NVML, the driver's management library: clocks, power, heat, other programs of a GPU. No other file imports pynvml.

A CUDA device is found by its UUID or its PCI bus id, never by its number: ``CUDA_VISIBLE_DEVICES`` and MIG number GPUs
in another way than NVML does. A question that a GPU or a container does not answer is None.

Names and calls are those of nvidia-ml-py 13, and are held to it by the tests; nothing here has run on hardware.
"""

from __future__ import annotations

import atexit
import hashlib
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

from mpmbench.errors import InputError

LOCKABLE_ARCH = (7, 0)  # nvmlDeviceSetGpuLockedClocks: Volta and later
UUID_BYTES = 16

# Bits of the clock event reasons that mean: slower than it could be. Idle, application clocks, sync boost and display
# settings are somebody's choice and no trouble.
REASONS = {
    "nvmlClocksEventReasonSwPowerCap": "power cap",
    "nvmlClocksEventReasonHwSlowdown": "hardware slowdown",
    "nvmlClocksEventReasonSwThermalSlowdown": "software thermal slowdown",
    "nvmlClocksEventReasonHwThermalSlowdown": "hardware thermal slowdown",
    "nvmlClocksEventReasonHwPowerBrakeSlowdown": "power brake",
}

COMPUTE_MODES = {
    "NVML_COMPUTEMODE_DEFAULT": "default",
    "NVML_COMPUTEMODE_EXCLUSIVE_THREAD": "exclusive thread",
    "NVML_COMPUTEMODE_PROHIBITED": "prohibited",
    "NVML_COMPUTEMODE_EXCLUSIVE_PROCESS": "exclusive process",
}

SETTLE_SECONDS = 0.1  # clocks follow a lock within some 10 ms
SIGNALS = (signal.SIGTERM, signal.SIGHUP, signal.SIGINT)


class Nvml:
    """One GPU as NVML sees it."""

    def __init__(self, library: Any, handle: Any) -> None:
        self._nvml, self._handle = library, handle
        self.refusal = ""  # why the last question without an answer has none
        self.locked = False  # by this process; NVML does not tell whether another one locked the clocks

    @classmethod
    def of(cls, uuid: bytes | str | None, pci_bus_id: str | None = None) -> tuple[Nvml | None, str]:
        """The GPU with this UUID (16 bytes, or text such as "GPU-..."), or at this PCI bus id; (None, why not) where
        NVML is not there or knows none.

        MIG: of an instance of a GPU it is the whole GPU, whose clocks and power the instance shares.
        """
        library, reason = _open()
        if library is None:
            return None, reason
        searches = [(library.nvmlDeviceGetHandleByUUID, name) for name in _uuid_names(uuid)]
        searches += [(library.nvmlDeviceGetHandleByPciBusId, pci_bus_id)] if pci_bus_id else []
        for search, name in searches:
            try:
                return cls(library, _whole_gpu(library, search(name))), ""
            except library.NVMLError as error:
                reason = f"NVML does not know this GPU: {_one_line(error)}"
        return None, reason or "this GPU has neither UUID nor PCI bus id"

    @classmethod
    def all(cls) -> tuple[list[Nvml], str]:
        """Every GPU, in NVML's own order; (none, why not) where NVML is not there."""
        library, reason = _open()
        if library is None:
            return [], reason
        count = library.nvmlDeviceGetCount()
        return [cls(library, library.nvmlDeviceGetHandleByIndex(index)) for index in range(count)], ""

    def ask(self, question: str, *arguments: Any) -> Any:
        """The answer to ``nvmlDeviceGet<question>``; None where the driver, the GPU or nvidia-ml-py has none."""
        function = getattr(self._nvml, f"nvmlDeviceGet{question}", None)
        if function is None:
            self.refusal = "nvidia-ml-py cannot ask for it"
            return None
        try:
            return function(self._handle, *arguments)
        except (self._nvml.NVMLError, self._nvml.NVMLLibraryMismatchError) as error:
            self.refusal = _one_line(error)
            return None

    def facts(self) -> dict[str, Any]:
        """What a record keeps. What changes from moment to moment ends in ``_now``.

        Clocks in MHz, power in W, temperature in degrees Celsius. uuid: the first 16 hex digits of a hash, for a UUID
        names a machine. clocks_locked: True where this process locked them, else None: NVML does not tell.
        other_processes_now: that compute on this GPU, less this one, which has opened the GPU.
        """
        nvml, ask = self._nvml, self.ask
        processes, ecc, mig = ask("ComputeRunningProcesses"), ask("EccMode"), ask("MigMode")
        smallest, largest = ask("PowerManagementLimitConstraints") or (None, None)
        return {
            "uuid": hashed(ask("UUID")),
            "driver": self.driver,
            "sm_clock_now": ask("ClockInfo", nvml.NVML_CLOCK_SM),
            "sm_clock_max": ask("MaxClockInfo", nvml.NVML_CLOCK_SM),
            # Application clocks are set for the graphics domain, which the SMs are in.
            "sm_clock_default": ask("Clock", nvml.NVML_CLOCK_GRAPHICS, nvml.NVML_CLOCK_ID_APP_CLOCK_DEFAULT),
            "memory_clock_now": ask("ClockInfo", nvml.NVML_CLOCK_MEM),
            "memory_clock_max": ask("MaxClockInfo", nvml.NVML_CLOCK_MEM),
            "memory_clock_default": ask("Clock", nvml.NVML_CLOCK_MEM, nvml.NVML_CLOCK_ID_APP_CLOCK_DEFAULT),
            "clocks_locked": self.locked or None,
            "clocks_lockable": self.lockable,
            "throttle_now": self.throttle_reasons(),
            "power_limit": _watts(ask("PowerManagementLimit")),
            "power_limit_default": _watts(ask("PowerManagementDefaultLimit")),
            "power_limit_min": _watts(smallest),
            "power_limit_max": _watts(largest),
            "temperature_now": self.temperature,
            "ecc": None if ecc is None else ecc[0] == nvml.NVML_FEATURE_ENABLED,
            "mig": None if mig is None else mig[0] == nvml.NVML_DEVICE_MIG_ENABLE,
            "persistence": self.persistence,
            "compute_mode": self.compute_mode,
            # A container sees the process numbers of its host: which of them is this process cannot be told by number.
            "other_processes_now": None if processes is None else max(0, len(processes) - 1),
        }

    @property
    def name(self) -> str:
        return _text(self.ask("Name") or "unknown GPU")

    @property
    def driver(self) -> str | None:
        """Version, such as "580.65.06"."""
        try:
            return _text(self._nvml.nvmlSystemGetDriverVersion())
        except self._nvml.NVMLError:
            return None

    @property
    def lockable(self) -> bool | None:
        capability = self.ask("CudaComputeCapability")
        return None if capability is None else tuple(capability) >= LOCKABLE_ARCH

    @property
    def compute_mode(self) -> str | None:
        mode = self.ask("ComputeMode")
        return next((word for name, word in COMPUTE_MODES.items() if getattr(self._nvml, name) == mode), None)

    @property
    def persistence(self) -> bool | None:
        mode = self.ask("PersistenceMode")
        return None if mode is None else mode == self._nvml.NVML_FEATURE_ENABLED

    @property
    def process_ids(self) -> list[int] | None:
        """Of the programs that compute on this GPU."""
        processes = self.ask("ComputeRunningProcesses")
        return None if processes is None else [process.pid for process in processes]

    @property
    def sm_clock(self) -> int | None:
        """[MHz] now."""
        return self.ask("ClockInfo", self._nvml.NVML_CLOCK_SM)

    @property
    def sm_clock_max(self) -> int | None:
        """[MHz]"""
        return self.ask("MaxClockInfo", self._nvml.NVML_CLOCK_SM)

    @property
    def temperature(self) -> int | None:
        """[degrees Celsius]"""
        sensor = self._nvml.NVML_TEMPERATURE_GPU
        now = self.ask("TemperatureV", sensor)
        return now if now is not None else self.ask("Temperature", sensor)  # older drivers know this one only

    def throttle_reasons(self) -> str | None:
        """What holds the clocks down right now, such as "power cap, hardware thermal slowdown"; "" for nothing."""
        bits = self.ask("CurrentClocksEventReasons")
        if bits is None:  # drivers before 535 know them by the older name
            bits = self.ask("CurrentClocksThrottleReasons")
        if bits is None:
            return None
        return ", ".join(word for name, word in REASONS.items() if bits & getattr(self._nvml, name))

    @contextmanager
    def lock_clocks(self, spec: str) -> Iterator[None]:
        """Hold the SM clock while the block runs: "base", "max" or MHz. "reset" sets it free at once and holds nothing.

        The clock is set free again when the block ends, by an exception too, at exit, and when SIGTERM, SIGHUP or
        SIGINT ends the process; kill -9 leaves it locked. A lock that somebody else made before is lost, for NVML does
        not tell what it was. Locked is a request: power and heat still lower clocks; what counts is ``sm_clock``.

        Raises InputError for another spec, where the GPU cannot lock its clocks, and where only root may.
        """
        wanted = parse_lock(spec)
        if wanted == "reset":
            self._command("ResetGpuLockedClocks")
            yield
            return
        megahertz = self._megahertz(wanted)
        with _undone(self._unlock):
            self.locked = True  # before the call: a signal may come between the lock and the next line
            try:
                self._command("SetGpuLockedClocks", megahertz, megahertz)
            except InputError:
                self.locked = False
                raise
            time.sleep(SETTLE_SECONDS)
            yield

    def _megahertz(self, wanted: str | int) -> int:
        if wanted == "base":
            return int(self._nvml.NVML_CLOCK_LIMIT_ID_TDP)  # NVML's word for the clock that the power limit can hold
        if wanted == "max":
            highest = self.sm_clock_max
            if highest is None:
                raise InputError(f"{self.name} does not tell its highest clock: name one in MHz")
            return highest
        return int(wanted)

    def _unlock(self) -> None:
        if self.locked:
            self._command("ResetGpuLockedClocks")
            self.locked = False  # afterwards: a signal in between resets once more, and that does no harm

    def _command(self, command: str, *arguments: int) -> None:
        nvml, who = self._nvml, self.name
        try:
            getattr(nvml, f"nvmlDevice{command}")(self._handle, *arguments)
        except nvml.NVMLError as error:
            failed = f"{who}: cannot {'set free' if command.startswith('Reset') else 'lock'} the clocks"
            cures = {
                nvml.NVML_ERROR_NO_PERMISSION: "only root may: run as root, or ask an administrator for "
                "nvidia-smi --lock-gpu-clocks",
                nvml.NVML_ERROR_NOT_SUPPORTED: "this GPU cannot (Volta and later can, virtual ones cannot): "
                "leave --lock-gpu-clocks out",
                nvml.NVML_ERROR_INVALID_ARGUMENT: "no such clock: see nvidia-smi -q -d SUPPORTED_CLOCKS",
            }
            value = getattr(error, "value", None)
            raise InputError(f"{failed}: {cures.get(value, _one_line(error))}") from error


def parse_lock(spec: str) -> str | int:
    """ "base", "max", "reset" or a clock [MHz]; InputError for anything else."""
    if spec in ("base", "max", "reset"):
        return spec
    if spec.isdecimal() and int(spec) > 0:
        return int(spec)
    raise InputError(f"cannot lock the GPU's clocks to {spec!r}: valid are base, max, reset and a number of MHz")


def hashed(uuid: str | bytes | None) -> str | None:
    """16 hex digits that stand for a UUID ("GPU-...", or its 16 bytes) and do not give it away."""
    if isinstance(uuid, bytes) and not uuid.startswith((b"GPU-", b"MIG-")):
        uuid = next(iter(_uuid_names(uuid)), None)
    if not uuid:
        return None
    return hashlib.sha256(_text(uuid).encode()).hexdigest()[:16]


def visible_devices() -> str | None:
    """``CUDA_VISIBLE_DEVICES``, its UUIDs hashed."""
    given = os.environ.get("CUDA_VISIBLE_DEVICES")
    if given is None:
        return None
    words = (word.strip() for word in given.split(","))
    return ",".join(f"{word[:4]}{hashed(word)}" if word.startswith(("GPU-", "MIG-")) else word for word in words)


def _open() -> tuple[Any, str]:
    """(pynvml, "") with NVML started, or (None, why not). NVML stays open: it counts its users and costs nothing."""
    try:
        library = import_module("pynvml")
    except ImportError:
        return None, "nvidia-ml-py is not installed"
    try:
        library.nvmlInit()
    except library.NVMLError as error:
        return None, _one_line(error)
    return library, ""


def _uuid_names(uuid: bytes | str | None) -> list[str]:
    """What NVML may call a UUID. CuPy hands over 16 bytes as a C string: shorter where one of them is zero (then the
    UUID is not known), longer where none is."""
    if isinstance(uuid, str):
        return [uuid]
    if uuid is None or len(uuid) < UUID_BYTES:
        return []
    digits = uuid[:UUID_BYTES].hex()
    dashed = "-".join((digits[:8], digits[8:12], digits[12:16], digits[16:20], digits[20:]))
    return [f"GPU-{dashed}", f"MIG-{dashed}"]


def _whole_gpu(library: Any, handle: Any) -> Any:
    """The GPU that a MIG instance is a part of; any other GPU is itself."""
    try:
        if library.nvmlDeviceIsMigDeviceHandle(handle).value:
            return library.nvmlDeviceGetDeviceHandleFromMigDeviceHandle(handle)
    except library.NVMLError:
        pass
    return handle


@contextmanager
def _undone(undo: Callable[[], None]) -> Iterator[None]:
    """``undo`` runs when the block ends, at exit, and before a signal ends this process; a child that this process
    forks leaves it alone."""
    owner = os.getpid()

    def once() -> None:
        if os.getpid() == owner:
            undo()

    def on_signal(number: int, frame: object) -> None:
        once()
        signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)

    # Whoever handles a signal in Python already goes on after it, or raises; then the block ends.
    mine = []
    if threading.current_thread() is threading.main_thread():
        mine = [number for number in SIGNALS if signal.getsignal(number) == signal.SIG_DFL]
    for number in mine:
        signal.signal(number, on_signal)
    atexit.register(once)
    try:
        yield
    finally:
        once()
        atexit.unregister(once)
        for number in mine:
            if signal.getsignal(number) is on_signal:
                signal.signal(number, signal.SIG_DFL)


def _watts(milliwatts: int | None) -> float | None:
    return None if milliwatts is None else milliwatts / 1000


def _text(value: str | bytes) -> str:
    return value.decode() if isinstance(value, bytes) else value


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())[:200]
