"""The ``cuda`` device: CuPy compiles and launches the kernels, CUDA events time them.

The only file that imports CuPy, and only once a device is opened: the package works without it. It stays thin,
because every line here runs on a GPU alone; what can be decided elsewhere (sampling, checks) is decided elsewhere.

All work goes to one non-default stream of the device, so that nothing of the legacy default stream can end up
between two events.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import cached_property
from types import ModuleType
from typing import Any

import numpy as np

from mpmbench.device import CompiledKernel, KernelInfo, Launch, LaunchReport
from mpmbench.device.cuda_timing import Stamp, StreamTimer
from mpmbench.device.nvml import Nvml, hashed, visible_devices
from mpmbench.device.ptxas import source_infos
from mpmbench.errors import InputError
from mpmbench.kernel import COMPILE_OPTIONS, KernelSource

MAILBOX_BYTES = 8
DEFAULT_SHARED_BYTES = 48 * 1024  # a kernel that wants more dynamic shared memory has to ask for it
CURE_KERNEL = "run it on the device 'simulated' in its debug mode to find the cause; this process has lost the GPU"
CURE_LAUNCH = "use another block shape or fewer threads per thread block"
CURE_NO_GPU = "run on a machine with an NVIDIA GPU and driver, or use the device 'simulated'"

# Options that CuPy appends to every compile, beside the architecture; given twice they only make its cache key differ.
CUPY_APPENDS = ("-ftz=true", "-default-device")


def import_cupy() -> ModuleType:
    """CuPy, or an InputError that says how to install it."""
    try:
        import cupy
    except ImportError as error:
        raise InputError(
            "the device 'cuda' needs CuPy, which cannot be imported "
            f"({_one_line(error)}): pip install 'mpmbench[cuda12x]' for a CUDA 12 driver, 'mpmbench[cuda13x]' for 13"
        ) from error
    return cupy


def cupy_options(options: tuple[str, ...]) -> tuple[str, ...]:
    """Our NVRTC options without those that CuPy adds by itself."""
    return tuple(option for option in options if option not in CUPY_APPENDS)


class CudaDevice:
    """One GPU. ``name`` is "cuda" (the first GPU) or "cuda:N"; it is "cuda:N" afterwards.

    Besides the device protocol it offers what timing needs: ``flush_cache``, ``hold`` and ``release``, ``record`` and
    ``elapsed``, ``stamp`` and ``clock_between``.
    """

    def __init__(self, name: str = "cuda", arch: str | None = None) -> None:
        index = _device_index(name)
        self._cupy = import_cupy()
        cuda = self._cupy.cuda
        try:
            count = cuda.runtime.getDeviceCount()
        except RuntimeError as error:
            raise InputError(f"no GPU for device {name!r} ({_one_line(error)}): {CURE_NO_GPU}") from error
        if count == 0:
            raise InputError(f"no GPU for device {name!r}: {CURE_NO_GPU}")
        if index >= count:
            last = count - 1
            raise InputError(f"no GPU {index} for device {name!r}: this machine has cuda:0 to cuda:{last}")
        self.name, self.count = f"cuda:{index}", count
        self._gpu = cuda.Device(index)
        with self._errors("cannot use the GPU"), self._gpu:
            self.properties: dict[str, Any] = cuda.runtime.getDeviceProperties(index)
            self.arch = f"sm_{self._gpu.compute_capability}"
            self._stream = cuda.Stream(non_blocking=True)
        if arch not in (None, self.arch):
            raise InputError(
                f"{self.name} compiles for itself, {self.arch}, not for {arch}: leave the architecture out"
            )
        self._flush_buffer: Any = None

    @property
    def facts(self) -> dict[str, Any]:
        """What records keep of this GPU and of what runs on it; ``Nvml.facts`` tells the meaning of NVML's.

        nvml_missing: why there are none of them. Facts whose names end in ``_now`` change from moment to moment.
        """
        cuda, properties = self._cupy.cuda, self.properties
        name = properties["name"]
        with self._errors("cannot ask for versions"):
            facts = {
                "name": name.decode() if isinstance(name, bytes) else str(name),
                "uuid": hashed(properties.get("uuid")),
                "arch": self.arch,
                "multiprocessors": properties["multiProcessorCount"],
                "memory_bytes": properties["totalGlobalMem"],
                "l2_bytes": properties["l2CacheSize"],
                "clock_khz": properties["clockRate"],
                "memory_clock_khz": properties["memoryClockRate"],
                "memory_bus_bits": properties["memoryBusWidth"],
                "ecc": bool(properties["ECCEnabled"]),
                "cuda_driver": cuda.runtime.driverGetVersion(),
                "cuda_runtime": cuda.runtime.runtimeGetVersion(),
                "nvrtc": ".".join(map(str, cuda.nvrtc.getVersion())),
                "nvrtc_options": " ".join(COMPILE_OPTIONS),
                "cupy": self._cupy.__version__,
                "visible_devices": visible_devices(),
            }
        nvml, missing = self._nvml
        if nvml is None:
            return {**facts, "nvml_missing": missing}
        told = nvml.facts()
        return {**facts, **{key: value for key, value in told.items() if value is not None or key not in facts}}

    @cached_property
    def _nvml(self) -> tuple[Nvml | None, str]:
        with self._errors("cannot ask for the PCI bus id"):
            return Nvml.of(self.properties.get("uuid"), self._cupy.cuda.runtime.deviceGetPCIBusId(self._gpu.id))

    def throttle_reasons(self) -> str:
        """What holds the clocks down right now; "" for nothing, or where nobody tells."""
        nvml, _ = self._nvml
        return (nvml.throttle_reasons() or "") if nvml is not None else ""

    def lock_clocks(self, spec: str) -> AbstractContextManager[None]:
        """See ``Nvml.lock_clocks``; InputError where there is no NVML."""
        nvml, missing = self._nvml
        if nvml is None:
            raise InputError(f"{self.name}: cannot lock the clocks: {missing}; see `mpmbench doctor`")
        return nvml.lock_clocks(spec)

    @property
    def usual_hertz(self) -> float | None:
        """SM clock that a GPU in good health has [Hz]: the one that this process locked, else the driver's; None where
        neither is told."""
        nvml, _ = self._nvml
        if nvml is not None and nvml.locked:
            megahertz = nvml.sm_clock  # a lock is a request: this is what came of it
            return megahertz * 1e6 if megahertz else None
        return self.properties["clockRate"] * 1e3 or None

    # Memory

    @property
    def free_bytes(self) -> int:
        """Device memory that is free now [bytes], with what CuPy's pool holds without using it."""
        with self._errors("cannot ask for the free memory"), self._current():
            free, _total = self._gpu.mem_info
            return int(free) + int(self._cupy.get_default_memory_pool().free_bytes())

    def upload(self, host: np.ndarray) -> Any:
        with self._allocating(host.nbytes):
            # A copy of pageable memory may still be under way when a non-blocking call returns.
            return self._cupy.asarray(np.ascontiguousarray(host), blocking=True)

    def empty(self, shape: int | tuple[int, ...], dtype: Any) -> Any:
        with self._allocating(int(np.prod(shape, dtype=np.int64)) * np.dtype(dtype).itemsize):
            return self._cupy.empty(shape, dtype=dtype)

    def download(self, array: Any) -> np.ndarray:
        with self._errors("a kernel launched before has failed", CURE_KERNEL), self._current():
            return self._cupy.asnumpy(array, blocking=True)

    # Kernels

    def compile(self, source: KernelSource, entry: str) -> CompiledKernel:
        compile_error = self._cupy.cuda.compiler.CompileException
        try:
            with self._errors(f"cannot compile and load kernel {entry} of {source.name}"), self._current():
                module = self._cupy.RawModule(code=source.text, options=cupy_options(source.all_options))
                kernel = module.get_function(entry)  # compiles and loads: none of it may land in the first sample
        except compile_error as error:
            raise InputError(f"{source.name} does not compile for {self.arch}: {_first_error(str(error))}") from error
        return CompiledKernel(source, entry, kernel)

    def library_sort(self) -> CompiledKernel:
        """CuPy's own stable sort (CUB's radix sort for integers) to be launched like a kernel of ours.

        Its arguments are keys (n,) and order (n,) int64, which becomes the places of the keys from small to large; a
        launch's geometry means nothing to it. It allocates on every call, as CuPy does.
        """
        source = f"cupy.argsort of CuPy {self._cupy.__version__}"
        digest = hashlib.sha256(source.encode()).hexdigest()
        return CompiledKernel(KernelSource("cupy.argsort", source, (), digest), "argsort", self._argsort)

    def _argsort(self, grid: object, block: object, args: tuple[Any, Any], shared_mem: int = 0) -> None:
        keys, order = args
        self._cupy.copyto(order, self._cupy.argsort(keys))

    def info(self, kernel: CompiledKernel) -> KernelInfo:
        """What the driver says of the loaded kernel. It counts spills as local memory: how many they are and how many
        instructions there are says ``ptxas``, where it is installed and knows this GPU; else both are None."""
        if kernel.handle == self._argsort:
            return KernelInfo(arch=self.arch)
        with self._errors(f"cannot ask for the attributes of {kernel.entry}"), self._current():
            attributes = kernel.handle.attributes
        try:
            assembled = source_infos(kernel.source, self.arch)[kernel.entry]
        except InputError:
            assembled = KernelInfo(arch=self.arch)
        return KernelInfo(
            arch=self.arch,
            registers=attributes["num_regs"],
            shared_bytes=attributes["shared_size_bytes"],
            local_bytes=attributes["local_size_bytes"],
            spill_bytes=assembled.spill_bytes,
            sass_instructions=assembled.sass_instructions,
        )

    def launch(self, launch: Launch) -> LaunchReport:
        # CuPy would turn an empty grid into one thread block.
        if 0 in launch.grid or 0 in launch.block:
            return LaunchReport()
        failure = f"kernel {launch.name} cannot be launched ({_geometry(launch)})"
        with self._errors(failure, CURE_LAUNCH), self._current():
            if launch.shared_bytes > DEFAULT_SHARED_BYTES:
                self._allow_shared(launch)
            launch.kernel.handle(
                launch.grid, launch.block, tuple(map(_argument, launch.args)), shared_mem=launch.shared_bytes
            )
        return LaunchReport()

    def synchronize(self) -> None:
        with self._errors("a kernel launched before has failed", CURE_KERNEL):
            self._stream.synchronize()

    # Timing

    def flush_cache(self) -> None:
        """Evict the second-level cache: overwrite a buffer of twice its size, on the stream."""
        size = 2 * int(self.properties["l2CacheSize"])
        if self._flush_buffer is None:
            self._flush_buffer = self.empty(size, np.uint8)
        with self._errors("cannot flush the cache"), self._current():
            self._flush_buffer.data.memset_async(0, size, stream=self._stream)

    @cached_property
    def _timer(self) -> StreamTimer:
        cuda = self._cupy.cuda
        with self._errors("cannot map host memory"), self._current():
            memory = cuda.PinnedMemory(MAILBOX_BYTES, cuda.runtime.hostAllocMapped)
            pointer = cuda.PinnedMemoryPointer(memory, 0)
        # Addresses are unified on every 64-bit system: kernels reach mapped host memory by the host's own address.
        return StreamTimer(self, np.frombuffer(pointer, np.uint32), pointer.ptr)

    def hold(self) -> None:
        """Keep the stream from going on until ``release``, while the host enqueues what comes next.

        Every kernel that is enqueued meanwhile must have run before: loading one waits for the stream.
        """
        self._timer.hold()

    def release(self) -> None:
        """Let a held stream go on."""
        self._timer.release()

    @property
    def hold_expired(self) -> bool:
        """Once the stream is done: whether the last hold ended by itself, so that the sample in it is worth nothing."""
        return self._timer.expired

    def stamp(self) -> Stamp:
        """Read the clocks at this point of the stream."""
        return self._timer.stamp()

    def clock_between(self, first: Stamp, second: Stamp) -> float | None:
        """SM clock between the last two stamps [Hz], once the stream is done; None where they caught no clock."""
        return self._timer.clock_between(first, second)

    def record(self) -> Any:
        """A new event at this point of the stream."""
        with self._errors("cannot record an event"), self._current():
            return self._stream.record(self._cupy.cuda.Event())

    def elapsed(self, start: Any, end: Any) -> float:
        """Time between two events [s]; both must have happened."""
        with self._errors("cannot read the time between two events"):
            return self._cupy.cuda.get_elapsed_time(start, end) * 1e-3

    # Helpers

    @contextmanager
    def _current(self) -> Iterator[None]:
        with self._gpu, self._stream:
            yield

    @contextmanager
    def _errors(self, what: str, cure: str = "see `mpmbench doctor`") -> Iterator[None]:
        try:
            yield
        except (RuntimeError, OSError) as error:  # CuPy's errors, of CUDA and its own, are RuntimeErrors
            raise InputError(f"{self.name}: {what}: {_one_line(error)}; {cure}") from error

    @contextmanager
    def _allocating(self, size: int) -> Iterator[None]:
        try:
            with self._errors(f"cannot allocate {size:,} bytes"), self._current():
                yield
        except self._cupy.cuda.memory.OutOfMemoryError as error:
            raise InputError(
                f"{self.name}: out of device memory ({size:,} bytes asked for, {self.free_bytes:,} free): "
                "use fewer particles or a smaller grid, or end other programs on this GPU"
            ) from error

    def _allow_shared(self, launch: Launch) -> None:
        limit = int(self.properties["sharedMemPerBlockOptin"])
        if launch.shared_bytes > limit:
            raise InputError(
                f"{self.name}: kernel {launch.name} wants {launch.shared_bytes:,} bytes of shared memory per thread "
                f"block, this GPU has {limit:,}: use a smaller block shape or float32"
            )
        kernel = launch.kernel.handle
        if kernel.max_dynamic_shared_size_bytes < launch.shared_bytes:
            kernel.max_dynamic_shared_size_bytes = launch.shared_bytes


def list_gpus() -> list[tuple[str, str]]:
    """Name ("cuda:0") and a one-line summary of each GPU; InputError where there is none, or no CuPy."""
    gpus, index = [], 0
    while True:
        device = CudaDevice(f"cuda:{index}")
        facts = device.facts
        gpus.append((device.name, f"{facts['name']}, {facts['arch']}, {facts['memory_bytes'] / 2**30:.1f} GiB"))
        index += 1
        if index == device.count:
            return gpus


def _device_index(name: str) -> int:
    kind, colon, number = name.partition(":")
    if kind != "cuda" or (colon and not number.isdecimal()):
        raise InputError(f"unknown device {name!r}: valid are 'simulated', 'cuda' and 'cuda:N' with N = 0, 1, ...")
    return int(number) if colon else 0


def _argument(value: Any) -> Any:
    """CuPy passes a NumPy array of one element by value, whatever its dtype: the documented way for structs."""
    return np.asarray(value) if isinstance(value, np.void) else value


def _geometry(launch: Launch) -> str:
    return f"grid {launch.grid}, thread block {launch.block}, {launch.shared_bytes} bytes of shared memory"


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())[:200]


def _first_error(log: str) -> str:
    """The first line of an NVRTC log that is an error."""
    lines = [line.strip() for line in log.splitlines() if line.strip()]
    return next((line for line in lines if "error" in line), lines[0] if lines else "no message")
