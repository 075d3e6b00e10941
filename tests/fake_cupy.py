"""A stand-in for CuPy that holds every call to the pinned CuPy's own documented signatures, and logs it.

CuPy imports without a GPU, so the real functions are at hand; most are compiled and show their signature only in the
first lines of their docstring. A call with a wrong name, a wrong keyword, too many arguments or a wrong built-in type
fails here as it would fail on a GPU. The timeline is scripted: kernels take the time a test gives them.
"""

from __future__ import annotations

import ctypes
import functools
import inspect
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import cupy
import numpy as np

# Loads the compiler now: it imports from ``cupy`` when first used, by when the fake may have taken the name.
cupy.cuda.nvrtc.getVersion()

BUILTIN_TYPES: dict[str, Any] = {
    "str": str, "tuple": tuple, "list": list, "dict": dict, "bytes": bytes, "bool": (bool, int), "bint": (bool, int),
    "int": int, "size_t": int, "intptr_t": int, "float": (float, int), "double": (float, int),
}  # fmt: skip


def real(path: str) -> Any:
    """The real object at ``cupy.<path>``; AttributeError where CuPy has none."""
    return functools.reduce(getattr, path.split("."), cupy)


def documented_signature(path: str) -> inspect.Signature:
    """Signature of ``cupy.<path>``, from Python where it knows it, else from the docstring; without ``self``."""
    target = real(path)
    try:
        signature = inspect.signature(target)
    except (ValueError, TypeError):
        signature = _from_docstring(path, target.__doc__ or "")
    parameters = [p for p in signature.parameters.values() if p.name != "self"]
    return signature.replace(parameters=parameters)


def _from_docstring(path: str, text: str) -> inspect.Signature:
    name = path.rsplit(".", 1)[-1]
    # A compiled method that takes **kwargs documents them in a second line of the same form: the last one counts.
    found = re.findall(rf"^\s*(?:\w+\.)*{name}\((.*)\)", text.split("Args:")[0], flags=re.MULTILINE)
    if not found:
        raise LookupError(f"CuPy documents no signature for {path}")
    parameters, kind = [], inspect.Parameter.POSITIONAL_OR_KEYWORD
    for word in filter(None, (part.strip() for part in found[-1].replace("\\", "").split(","))):
        if word == "*":
            kind = inspect.Parameter.KEYWORD_ONLY
            continue
        declaration, _, default = (part.strip() for part in word.partition("="))
        *c_type, argument = declaration.split()
        parameters.append(
            inspect.Parameter(
                argument,
                kind,
                default=default or inspect.Parameter.empty,
                annotation=BUILTIN_TYPES.get(c_type[-1], object) if c_type else object,
            )
        )
    return inspect.Signature(parameters)


def follows(path: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Hold a fake function (or method) to the signature of ``cupy.<path>``.

    The fake must know every argument by its documented name; the caller's call must bind to the signature.
    """
    signature = documented_signature(path)

    def decorate(fake: Callable[..., Any]) -> Callable[..., Any]:
        own = list(inspect.signature(fake).parameters)
        is_method = own[:1] == ["self"]
        unknown = set(own[is_method:]) - set(signature.parameters)
        if unknown:
            raise TypeError(f"the fake of {path} has arguments that CuPy does not: {sorted(unknown)}")

        @functools.wraps(fake)
        def call(*args: Any, **kwargs: Any) -> Any:
            this, rest = args[:is_method], args[is_method:]
            bound = signature.bind(*rest, **kwargs)
            for name, value in bound.arguments.items():
                wanted = signature.parameters[name].annotation
                optional = signature.parameters[name].default == "None" and value is None
                if wanted in BUILTIN_TYPES.values() and not optional and not isinstance(value, wanted):
                    raise TypeError(f"cupy.{path}: {name} must be {wanted}, not {type(value).__name__}")
            given = {name: value for name, value in bound.arguments.items() if name in own}
            ignored = {name: value for name, value in bound.arguments.items() if name not in own}
            if ignored:
                raise NotImplementedError(f"the fake of {path} ignores {ignored}")
            return fake(*this, **given)

        return call

    return decorate


def attribute(path: str) -> Callable[[Callable[[Any], Any]], property]:
    """A fake property that must exist in CuPy."""
    real(path)
    return property


@dataclass
class FakeGpu:
    """The machine behind the fake: what it has, what happened to it, and what shall fail.

    calls: ("flush" | "sync" | "event" | "kernel" | ..., detail), in order. seconds: duration of each kernel by name.
    execute: called as execute(ptx, name, grid, block, arguments, shared) to really run a kernel, or None.
    """

    count: int = 1
    capability: str = "90"
    l2_bytes: int = 1 << 20
    memory_bytes: int = 1 << 30
    shared_optin: int = 232_448
    calls: list[tuple[str, Any]] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)
    execute: Callable[..., None] | None = None
    compile_for_real: bool = True
    fail_launch: Exception | None = None
    fail_synchronize: Exception | None = None
    fail_compile: Exception | None = None
    fail_count: Exception | None = None
    now: float = 0.0  # [s] on the device's timeline
    used: int = 0
    pooled: int = 0  # bytes that CuPy's pool holds without using them
    uuid: bytes = bytes(range(1, 17))
    pci_bus_id: str = "0000:01:00.0"
    hertz: float = 1e9  # of SM 0
    on_sm_0: bool = True  # whether a thread block of a stamp lands there
    held: tuple[int, int, int] | None = None  # addresses of let go and expired, ticket
    streams: list[Any] = field(default_factory=list)  # the current one is last; empty: the default stream
    devices: list[int] = field(default_factory=lambda: [0])

    def log(self, what: str, detail: Any = None) -> None:
        self.calls.append((what, detail))

    def names(self) -> list[str]:
        return [what for what, _ in self.calls]

    def details(self, what: str) -> list[Any]:
        return [detail for name, detail in self.calls if name == what]


def fake_cupy(gpu: FakeGpu) -> SimpleNamespace:
    """The module to put in place of ``cupy``."""

    class MemoryPointer:
        def __init__(self, array: Array) -> None:
            self.array = array

        @follows("cuda.MemoryPointer.memset_async")
        def memset_async(self, value: int, size: int, stream: Any = None) -> None:
            assert size <= self.array.host.nbytes, "memset beyond the buffer"
            gpu.now += 1e-4
            gpu.log("flush", (size, stream))

    class Array:
        def __init__(self, host: np.ndarray) -> None:
            if gpu.used + host.nbytes > gpu.memory_bytes:
                raise cupy.cuda.memory.OutOfMemoryError(host.nbytes, gpu.used)
            if host.dtype.fields is not None:
                raise TypeError("CuPy has no arrays of structs")
            gpu.used += host.nbytes
            self.host = host

        def __del__(self) -> None:
            if hasattr(self, "host"):
                gpu.used -= self.host.nbytes

        @attribute("ndarray.data")
        def data(self) -> MemoryPointer:
            return MemoryPointer(self)

    class Event:
        time: float | None = None

        @follows("cuda.Event")
        def __init__(self, block: bool = False, disable_timing: bool = False, interprocess: bool = False) -> None:
            self.timing = not disable_timing

    class Stream:
        @follows("cuda.Stream")
        def __init__(self, null: bool = False, non_blocking: bool = False) -> None:
            self.null, self.device = null, gpu.devices[-1]

        def __enter__(self) -> Stream:
            assert self.device == gpu.devices[-1], "a stream of another device than the current one"
            gpu.streams.append(self)
            return self

        def __exit__(self, *_: Any) -> None:
            assert gpu.streams.pop() is self

        @follows("cuda.Stream.synchronize")
        def synchronize(self) -> None:
            end_hold(gpu)
            gpu.log("sync", self)
            if gpu.fail_synchronize is not None:
                raise gpu.fail_synchronize

        @follows("cuda.Stream.record")
        def record(self, event: Event | None = None) -> Event:
            event = event or Event()
            event.time = gpu.now
            gpu.log("event", self)
            return event

    @follows("cuda.get_elapsed_time")
    def get_elapsed_time(start_event: Event, end_event: Event) -> float:
        assert start_event.timing
        assert end_event.timing
        assert gpu.names()[-1] == "sync", "elapsed time asked for before the events have happened"
        assert start_event.time is not None
        assert end_event.time is not None
        return (end_event.time - start_event.time) * 1e3

    class Device:
        @follows("cuda.Device")
        def __init__(self, device: int | None = None) -> None:
            self.id = gpu.devices[-1] if device is None else device

        def __enter__(self) -> Device:
            gpu.devices.append(self.id)
            return self

        def __exit__(self, *_: Any) -> None:
            assert gpu.devices.pop() == self.id

        @attribute("cuda.Device.compute_capability")
        def compute_capability(self) -> str:
            return gpu.capability

        @attribute("cuda.Device.mem_info")
        def mem_info(self) -> tuple[int, int]:
            return gpu.memory_bytes - gpu.used, gpu.memory_bytes

    class RawKernel:
        def __init__(self, module: RawModule, name: str) -> None:
            self.module, self.name, self.dynamic_limit, self.ptx = module, name, 48 * 1024, ""

        def load(self) -> None:
            """What the real ``RawModule.get_function`` does before it returns a kernel."""
            if gpu.fail_compile is not None:
                raise gpu.fail_compile
            if gpu.compile_for_real:
                self.ptx = compile_as_cupy_does(self.module.code, self.module.options, gpu.capability)
                if f".entry {self.name}(" not in self.ptx:
                    raise cupy.cuda.runtime.CUDARuntimeError(500)  # named symbol not found

        @attribute("RawKernel.attributes")
        def attributes(self) -> dict[str, int]:
            keys = ("num_regs", "shared_size_bytes", "local_size_bytes", "max_threads_per_block")
            return {key: 32 for key in keys if real(f"RawKernel.{key}")}

        @attribute("RawKernel.max_dynamic_shared_size_bytes")
        def max_dynamic_shared_size_bytes(self) -> int:
            return self.dynamic_limit

        @max_dynamic_shared_size_bytes.setter
        def max_dynamic_shared_size_bytes(self, size: int) -> None:
            self.dynamic_limit = size

        @follows("RawKernel.__call__")
        def __call__(self, grid: tuple, block: tuple, args: tuple, shared_mem: int = 0) -> None:
            assert isinstance(grid, tuple)
            assert isinstance(block, tuple)
            assert shared_mem <= self.dynamic_limit, "more shared memory than the kernel may have"
            assert gpu.streams, "launched on the default stream"
            if gpu.fail_launch is not None:
                raise gpu.fail_launch
            values = tuple(_by_value(a) for a in args)
            if self.name == "mpmbench_hold":
                assert gpu.held is None, "held twice"
                gpu.held = int(values[0]), int(values[1]), int(values[2])
            elif self.name == "mpmbench_stamp":
                assert grid == (4, 1, 1), "a thread block for each SM"
                play_stamp(gpu, *values)
            elif gpu.execute is not None:
                gpu.execute(self.ptx, self.name, grid, block, values, shared_mem)
            gpu.now += gpu.seconds.get(self.name, 1e-5)
            gpu.log("kernel", SimpleNamespace(name=self.name, grid=grid, block=block, args=args, shared=shared_mem,
                                              stream=gpu.streams[-1]))  # fmt: skip

    def _by_value(value: Any) -> Any:
        """What CuPy makes of an argument: the memory of a device array, else the bytes of one element."""
        if isinstance(value, Array):
            return value.host
        if isinstance(value, np.ndarray):
            if value.size != 1:
                raise TypeError(f"a numpy array of shape {value.shape} cannot be passed by value")
            return value.reshape(())[()]
        if not isinstance(value, np.generic):
            raise TypeError(f"unsupported argument {type(value).__name__}")
        return value

    class RawModule:
        @follows("RawModule")
        def __init__(self, code: str | None = None, options: tuple[str, ...] = ()) -> None:
            assert code is not None
            self.code, self.options = code, options

        @follows("RawModule.get_function")
        def get_function(self, name: str) -> RawKernel:
            kernel = RawKernel(self, name)
            kernel.load()
            return kernel

    class PinnedMemory:
        @follows("cuda.PinnedMemory")
        def __init__(self, size: int, flags: int = 0) -> None:
            assert flags == real("cuda.runtime.hostAllocMapped")
            self.size = size

    @follows("cuda.PinnedMemoryPointer")
    def pinned_memory_pointer(mem: PinnedMemory, offset: int) -> Any:
        assert offset == 0
        buffer = (ctypes.c_uint8 * mem.size)()

        class Pointer(type(buffer)):  # type: ignore[misc]
            ptr = property(ctypes.addressof)

        real("cuda.PinnedMemoryPointer.ptr")
        return Pointer()

    class Pool:
        @follows("cuda.MemoryPool.free_bytes")
        def free_bytes(self) -> int:
            return gpu.pooled

    @follows("get_default_memory_pool")
    def get_default_memory_pool() -> Pool:
        return Pool()

    @follows("asarray")
    def asarray(a: np.ndarray, blocking: bool = False) -> Array:
        assert blocking, "the source may change before a non-blocking copy has read it"
        return Array(a.copy())

    @follows("empty")
    def empty(shape: Any, dtype: Any = float) -> Array:
        array = Array(np.empty(shape, dtype=dtype))
        array.host.view(np.uint8).fill(0xC5)  # what was there before
        return array

    @follows("asnumpy")
    def asnumpy(a: Array, blocking: bool = True) -> np.ndarray:
        assert blocking
        end_hold(gpu)
        if gpu.fail_synchronize is not None:
            raise gpu.fail_synchronize
        return a.host.copy()

    @follows("argsort")
    def argsort(a: Array) -> Array:
        assert gpu.streams, "sorted on the default stream"
        gpu.now += gpu.seconds.get("argsort", 1e-5)
        gpu.log("argsort", len(a.host))
        return Array(np.argsort(a.host, kind="stable"))

    @follows("copyto")
    def copyto(dst: Array, src: Array) -> None:
        assert gpu.streams, "copied on the default stream"
        np.copyto(dst.host, src.host, casting="same_kind")

    @follows("cuda.runtime.getDeviceCount")
    def get_device_count() -> int:
        if gpu.fail_count is not None:
            raise gpu.fail_count
        return gpu.count

    @follows("cuda.runtime.getDeviceProperties")
    def get_device_properties(device: int) -> dict[str, Any]:
        properties = {
            "name": b"Fake GPU", "l2CacheSize": gpu.l2_bytes, "sharedMemPerBlockOptin": gpu.shared_optin,
            "totalGlobalMem": gpu.memory_bytes, "multiProcessorCount": 4, "clockRate": 1_000_000,
            "memoryClockRate": 2_000_000, "memoryBusWidth": 256, "ECCEnabled": 0,
            "maxThreadsPerMultiProcessor": 2048, "maxBlocksPerMultiProcessor": 32, "regsPerMultiprocessor": 65_536,
            "sharedMemPerMultiprocessor": gpu.shared_optin + 1024, "reservedSharedMemPerBlock": 1024,
            "uuid": gpu.uuid, "kernelExecTimeoutEnabled": 0,
        }  # fmt: skip
        assert device < gpu.count
        return properties

    @follows("cuda.runtime.driverGetVersion")
    def driver_get_version() -> int:
        return 12090

    @follows("cuda.runtime.runtimeGetVersion")
    def runtime_get_version() -> int:
        return 12080

    @follows("cuda.runtime.deviceGetPCIBusId")
    def device_get_pci_bus_id(device: int) -> str:
        assert device < gpu.count
        return gpu.pci_bus_id

    @follows("cuda.nvrtc.getVersion")
    def nvrtc_get_version() -> tuple[int, int]:
        return 12, 9

    fake = SimpleNamespace(
        __version__=cupy.__version__,
        RawModule=RawModule,
        asarray=asarray,
        argsort=argsort,
        asnumpy=asnumpy,
        copyto=copyto,
        empty=empty,
        get_default_memory_pool=get_default_memory_pool,
        cuda=SimpleNamespace(
            Device=Device,
            Event=Event,
            Stream=Stream,
            PinnedMemory=PinnedMemory,
            PinnedMemoryPointer=pinned_memory_pointer,
            get_elapsed_time=get_elapsed_time,
            compiler=SimpleNamespace(CompileException=cupy.cuda.compiler.CompileException),
            memory=SimpleNamespace(OutOfMemoryError=cupy.cuda.memory.OutOfMemoryError),
            nvrtc=SimpleNamespace(getVersion=nvrtc_get_version),
            runtime=SimpleNamespace(
                getDeviceCount=get_device_count,
                getDeviceProperties=get_device_properties,
                deviceGetPCIBusId=device_get_pci_bus_id,
                driverGetVersion=driver_get_version,
                hostAllocMapped=real("cuda.runtime.hostAllocMapped"),
                runtimeGetVersion=runtime_get_version,
            ),
        ),
    )
    _assert_names_exist(fake, "")
    return fake


def end_hold(gpu: FakeGpu) -> None:
    """What waiting for the stream comes to while it is held: not let go, the hold ends by itself and says so."""
    if gpu.held is None:
        return
    let_go, expired, ticket = gpu.held
    gpu.held = None
    if ctypes.c_uint32.from_address(let_go).value < ticket:
        ctypes.c_uint32.from_address(expired).value = ticket
        gpu.log("hold expired")


def play_stamp(gpu: FakeGpu, stamps: np.ndarray, number: np.uint64) -> None:
    """The clocks at this moment of the scripted timeline, where the stamp kernel writes them."""
    if gpu.on_sm_0:
        nanoseconds = round(gpu.now * 1e9) + 1
        stamps[int(number) % 2] = number, round(nanoseconds * 1e-9 * gpu.hertz) + 7, nanoseconds


def on_the_engine(spoil: Callable[[str, tuple[Any, ...]], None] = lambda name, arguments: None) -> Callable[..., None]:
    """For ``FakeGpu.execute``: run each kernel, compiled as CuPy would, on the simulated device's engine.

    spoil: called after each kernel with its name and arguments, to play a GPU that gets something wrong.
    """
    from mpmbench.simt.engine import compile_ptx

    modules: dict[str, Any] = {}

    def execute(ptx: str, name: str, grid: Any, block: Any, arguments: tuple[Any, ...], shared_bytes: int) -> None:
        if ptx not in modules:
            modules[ptx] = compile_ptx(ptx, mode="run")
        modules[ptx].kernel(name).launch(grid, block, arguments, shared_bytes=shared_bytes)
        spoil(name, arguments)

    return execute


@functools.cache
def compile_as_cupy_does(code: str, options: tuple[str, ...], capability: str) -> str:
    """PTX from CuPy's own binding of NVRTC, with the options that CuPy appends (cupy/cuda/compiler.py)."""
    program = cupy.cuda.compiler._NVRTCProgram(code, "fake.cu", method="ptx")
    appended = ("-ftz=true", f"-arch=compute_{capability}", "--device-as-default-execution-space")
    text, _ = program.compile((*options, *appended))
    return text.decode() if isinstance(text, bytes) else text


def _assert_names_exist(fake: SimpleNamespace, prefix: str) -> None:
    for name, value in vars(fake).items():
        real(prefix + name)
        if isinstance(value, SimpleNamespace):
            _assert_names_exist(value, f"{prefix}{name}.")
