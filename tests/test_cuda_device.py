"""The cuda device over a fake driver: every call follows CuPy's documented signatures, errors are one clear line."""

from __future__ import annotations

import builtins
import ctypes
import hashlib
import inspect
import json
import sys
from dataclasses import replace
from pathlib import Path

import cupy
import numpy as np
import pytest
from fake_cupy import FakeGpu, compile_as_cupy_does, documented_signature, fake_cupy

from mpmbench.device import KernelInfo, Launch, open_device
from mpmbench.device.cuda import CudaDevice, cupy_options, list_gpus
from mpmbench.device.cuda_timing import HOLD_LIMIT, KERNELS
from mpmbench.device.ptxas import kernel_infos
from mpmbench.device.simulated import SimulatedDevice
from mpmbench.errors import InputError
from mpmbench.kernel import COMPILE_OPTIONS, KernelSource, compile_options

GRID = np.dtype([("scale", np.float32), ("count", np.int32)], align=True)

AXPY = """
struct Grid { float scale; int count; };
extern "C" __global__ void axpy(float* y, const float* x, Grid grid, double shift)
{
    const int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i < grid.count) y[i] = grid.scale * x[i] + (float)shift;
}
"""


def source(text: str, name: str = "axpy") -> KernelSource:
    return KernelSource(name, text, (), hashlib.sha256(text.encode()).hexdigest())


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch) -> FakeGpu:
    machine = FakeGpu()
    monkeypatch.setitem(sys.modules, "cupy", fake_cupy(machine))
    return machine


def axpy_launch(device: CudaDevice, grid: tuple[int, int, int] = (2, 1, 1), shared_bytes: int = 0) -> Launch:
    kernel = device.compile(source(AXPY), "axpy")
    x = device.upload(np.arange(64, dtype=np.float32))
    y = device.empty(64, np.float32)
    struct = np.array((2.0, 64), dtype=GRID)[()]
    return Launch("axpy", kernel, grid, (32, 1, 1), (y, x, struct, np.float64(1)), shared_bytes)


def test_documented_signatures_are_read_from_cupy() -> None:
    memset = documented_signature("cuda.MemoryPointer.memset_async")
    assert list(memset.parameters) == ["value", "size", "stream"]
    assert list(documented_signature("RawKernel.__call__").parameters) == ["grid", "block", "args", "shared_mem"]
    module = documented_signature("RawModule").parameters
    assert module["options"].kind is inspect.Parameter.KEYWORD_ONLY
    assert module["options"].annotation is tuple


@pytest.mark.parametrize(
    "wrong",
    [
        lambda fake: fake.RawModule(source="x"),
        lambda fake: fake.RawModule(code="x", options=["-std=c++17"]),
        lambda fake: fake.empty((3,), np.float32, "C", 7),
        lambda fake: fake.cuda.Stream(nonblocking=True),
        lambda fake: fake.asarray(np.zeros(3), block=True),
        lambda fake: fake.RawModule(code=AXPY).get_function("axpy")((1,), (1,), (), shared_memory=4),
    ],
)
def test_fake_refuses_a_call_that_cupy_would_refuse(wrong) -> None:
    with pytest.raises(TypeError):
        wrong(fake_cupy(FakeGpu()))


def test_fake_cannot_have_a_function_that_cupy_lacks() -> None:
    with pytest.raises(AttributeError):
        documented_signature("cuda.Stream.flush")


def test_device_compiles_uploads_launches_and_downloads(gpu: FakeGpu) -> None:
    device = open_device("cuda")
    assert (device.name, device.arch) == ("cuda:0", "sm_90")
    launch = axpy_launch(device)
    device.launch(launch)
    device.synchronize()
    call = gpu.details("kernel")[-1]
    assert (call.name, call.grid, call.block, call.shared) == ("axpy", (2, 1, 1), (32, 1, 1), 0)
    assert call.stream is not None, "kernels must not run on the default stream"
    assert not call.stream.null
    struct = call.args[2]
    assert isinstance(struct, np.ndarray), "CuPy documents one-element arrays as the way to pass a struct by value"
    assert struct.size == 1
    assert struct.tobytes() == np.array((2.0, 64), dtype=GRID).tobytes()
    np.testing.assert_array_equal(device.download(launch.args[1]), np.arange(64, dtype=np.float32))


def test_cupy_itself_passes_the_bytes_of_our_arguments() -> None:
    """On the real CuPy: what it would hand to the driver is the value's memory, structs included."""
    struct = np.array((2.5, 7), dtype=GRID)
    pointer = cupy.cuda.function.CNumpyArray(struct).ptr
    assert ctypes.string_at(pointer, GRID.itemsize) == struct.tobytes()


def test_empty_grid_is_not_launched(gpu: FakeGpu) -> None:
    """CuPy turns a grid of 0 into one thread block (cupy/cuda/function.pyx); a launch over nothing must do nothing."""
    device = CudaDevice("cuda")
    device.launch(axpy_launch(device, grid=(0, 1, 1)))
    assert not gpu.details("kernel")


def test_options_are_those_of_the_simulated_device_once_cupy_has_added_its_own() -> None:
    appended = ("-ftz=true", "-default-device")
    assert sorted((*cupy_options(COMPILE_OPTIONS), *appended)) == sorted(COMPILE_OPTIONS)
    text = Path(cupy.cuda.compiler.__file__).read_text()
    assert "options += ('-ftz=true',)" in text, "CuPy no longer appends -ftz=true: revise cupy_options"
    assert "--device-as-default-execution-space" in text


@pytest.mark.parametrize("options", [(), ("--use_fast_math",), ("--fmad=false",), ("--use_fast_math", "--fmad=false")])
def test_both_devices_get_the_same_ptx(gpu: FakeGpu, options: tuple[str, ...]) -> None:
    """CuPy's way to PTX and ours agree to the last character of code."""
    text = AXPY.replace("grid.scale *", "grid.scale / (1 + x[i]) *")  # something that fast math changes
    program = cupy.cuda.compiler._NVRTCProgram(text, "fake.cu", method="ptx")
    ours, _ = program.compile((*compile_options(f"sm_{gpu.capability}"), *options))
    ours = ours.decode() if isinstance(ours, bytes) else ours
    kernel = CudaDevice("cuda").compile(replace(source(text), options=options), "axpy")
    assert kernel.handle.ptx == ours
    assert compile_as_cupy_does(text, cupy_options((*COMPILE_OPTIONS, *options)), gpu.capability) == ours


def test_property_names_exist_in_cupy() -> None:
    """The keys of getDeviceProperties show only on a GPU; their names are in CuPy's binary."""
    binary = Path(cupy.cuda.runtime.getDeviceCount.__self__.__file__).read_bytes()
    gpu = FakeGpu()
    for key in fake_cupy(gpu).cuda.runtime.getDeviceProperties(0):
        assert key.encode() in binary, key


def test_list_gpus(gpu: FakeGpu) -> None:
    gpu.count = 2
    assert list_gpus() == [("cuda:0", "Fake GPU, sm_90, 1.0 GiB"), ("cuda:1", "Fake GPU, sm_90, 1.0 GiB")]


def test_gpu_compiles_for_itself(gpu: FakeGpu) -> None:
    assert open_device("cuda:0", arch="sm_90").arch == "sm_90"
    with pytest.raises(InputError, match="compiles for itself, sm_90"):
        open_device("cuda:0", arch="sm_52")


def test_facts_for_the_record(gpu: FakeGpu) -> None:
    facts = CudaDevice("cuda").facts
    assert facts["name"] == "Fake GPU"
    assert facts["arch"] == "sm_90"
    assert facts["nvrtc"] == "12.9"
    json.dumps(facts)


def test_kernel_info(gpu: FakeGpu, monkeypatch: pytest.MonkeyPatch) -> None:
    device = CudaDevice("cuda")
    kernel = device.compile(source(AXPY), "axpy")
    info = device.info(kernel)
    assert info == KernelInfo("sm_90", 32, 32, 32, spill_bytes=0, sass_instructions=info.sass_instructions)
    assert info.sass_instructions

    def missing(*_):
        raise InputError("no ptxas")

    monkeypatch.setattr("mpmbench.device.cuda.source_infos", missing)
    assert device.info(kernel) == KernelInfo("sm_90", 32, 32, 32)


def test_large_shared_memory_is_asked_for_once(gpu: FakeGpu) -> None:
    device = CudaDevice("cuda")
    launch = axpy_launch(device, shared_bytes=100_000)
    device.launch(launch)
    assert launch.kernel.handle.max_dynamic_shared_size_bytes == 100_000


def calls(gpu: FakeGpu) -> list[str]:
    return [detail.name if what == "kernel" else what for what, detail in gpu.calls]


def test_timing_calls(gpu: FakeGpu) -> None:
    device = CudaDevice("cuda:0")
    launch = axpy_launch(device)
    gpu.seconds, gpu.hertz = {"axpy": 0.0025}, 1.5e9
    device.hold()
    device.release()
    device.synchronize()
    warm = calls(gpu)
    assert warm.index("mpmbench_stamp") < warm.index("sync"), "both kernels are loaded before the first hold"
    gpu.calls.clear()
    device.hold()
    first = device.stamp()
    start = device.record()
    device.launch(launch)
    end = device.record()
    second = device.stamp()
    device.release()
    device.synchronize()
    assert device.elapsed(start, end) == pytest.approx(0.0025)
    assert device.clock_between(first, second) == pytest.approx(1.5e9, rel=1e-5)
    assert not device.hold_expired
    assert calls(gpu) == ["mpmbench_hold", "mpmbench_stamp", "event", "axpy", "event", "mpmbench_stamp", "sync"]
    hold, stamp, *_ = gpu.details("kernel")
    assert (hold.grid, hold.block, stamp.block) == ((1, 1, 1), (1, 1, 1), (1, 1, 1))
    assert hold.args[3] == np.uint64(HOLD_LIMIT * 1e9)
    stream = gpu.details("sync")[0]
    assert all(used is stream for used in gpu.details("event"))
    assert all(call.stream is stream for call in gpu.details("kernel"))


def test_flush_overwrites_twice_the_cache(gpu: FakeGpu) -> None:
    device = CudaDevice("cuda")
    device.flush_cache()
    device.synchronize()
    ((size, stream),) = gpu.details("flush")
    assert size == 2 * gpu.l2_bytes
    assert stream is gpu.details("sync")[-1]


def test_a_hold_that_is_not_let_go_says_so_and_the_next_one_is_good(gpu: FakeGpu) -> None:
    device = CudaDevice("cuda")
    device.hold()
    device.synchronize()
    assert device.hold_expired
    assert "hold expired" in gpu.names()
    device.hold()
    device.release()
    device.synchronize()
    assert not device.hold_expired


def test_no_clock_where_no_thread_block_lands_on_sm_0(gpu: FakeGpu) -> None:
    device = CudaDevice("cuda")
    first, gpu.on_sm_0 = device.stamp(), False
    second = device.stamp()
    device.synchronize()
    assert device.clock_between(first, second) is None
    gpu.on_sm_0 = True
    third, fourth = device.stamp(), device.stamp()
    device.synchronize()
    assert device.clock_between(third, fourth) == pytest.approx(gpu.hertz, rel=1e-3)
    assert device.clock_between(first, fourth) is None, "a stamp that was overwritten"


TIMED_ARCHS = ["sm_52", "sm_70", "sm_90", "sm_120"]


@pytest.mark.parametrize("arch", TIMED_ARCHS)
def test_timing_kernels_compile_for_every_gpu(arch: str) -> None:
    ptx = compile_as_cupy_does(KERNELS.text, cupy_options(COMPILE_OPTIONS), arch.removeprefix("sm_"))
    for entry in ("mpmbench_hold", "mpmbench_stamp"):
        assert kernel_infos(ptx, arch)[entry].spill_bytes == 0
    assert "ld.volatile" in ptx, "a read that may be cached never sees the host's word"


@pytest.mark.parametrize("arch", TIMED_ARCHS)
def test_hold_kernel_ends_when_let_go_and_says_when_it_was_not(arch: str) -> None:
    """On the NumPy executor, whose clocks count instructions."""
    device = SimulatedDevice(arch, mode="oracle")
    kernel = device.compile(KERNELS, "mpmbench_hold")
    let_go, expired = device.upload(np.array([5], np.uint32)), device.upload(np.zeros(1, np.uint32))
    for ticket, says in ((4, 0), (5, 0), (6, 6)):
        arguments = (let_go, expired, np.uint32(ticket), np.uint64(300))
        device.launch(Launch("hold", kernel, (1, 1, 1), (1, 1, 1), arguments))
        assert expired[0] == says


@pytest.mark.parametrize("arch", TIMED_ARCHS)
def test_stamp_kernel_reads_both_clocks_once(arch: str) -> None:
    device = SimulatedDevice(arch, mode="oracle")
    kernel = device.compile(KERNELS, "mpmbench_stamp")
    stamps = device.upload(np.zeros((2, 3), np.uint64))
    for number in (7, 8):
        device.launch(Launch("stamp", kernel, (3, 1, 1), (1, 1, 1), (stamps, np.uint64(number))))
    assert stamps[:, 0].tolist() == [8, 7]
    assert (stamps[:, 1:] > 0).all()
    # Both count instructions there, and the first of three blocks has the word.
    assert (abs(stamps[:, 1].astype(int) - stamps[:, 2].astype(int)) < 5).all()
    assert (stamps[:, 1] < 30).all()


# Errors


def test_no_cupy(monkeypatch: pytest.MonkeyPatch) -> None:
    real_import = builtins.__import__

    def refuse(name, *args, **kwargs):
        if name == "cupy":
            raise ImportError("No module named 'cupy'")
        return real_import(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(InputError, match=r"mpmbench\[cuda12x\]"):
        open_device("cuda")


def test_no_driver_on_real_cupy() -> None:
    if cupy.cuda.is_available():
        pytest.skip("this machine has a GPU")
    with pytest.raises(InputError, match=r"no GPU for device 'cuda'.*simulated"):
        open_device("cuda")


def test_no_gpu(gpu: FakeGpu) -> None:
    gpu.count = 0
    with pytest.raises(InputError, match="no GPU for device 'cuda'"):
        open_device("cuda")
    gpu.fail_count = cupy.cuda.runtime.CUDARuntimeError(100)
    with pytest.raises(InputError, match="cudaErrorNoDevice"):
        open_device("cuda")


@pytest.mark.parametrize(("name", "message"), [("cuda:3", "cuda:0 to cuda:0"), ("cuda:x", "unknown device 'cuda:x'")])
def test_no_such_gpu(gpu: FakeGpu, name: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        open_device(name)


def test_out_of_memory(gpu: FakeGpu) -> None:
    gpu.memory_bytes = 1000
    device = CudaDevice("cuda")
    with pytest.raises(InputError, match=r"out of device memory \(4,000 bytes asked for, 1,000 free\)"):
        device.empty(1000, np.float32)
    with pytest.raises(InputError, match="out of device memory"):
        device.upload(np.zeros(1000, np.float32))


def test_source_that_does_not_compile(gpu: FakeGpu) -> None:
    device = CudaDevice("cuda")
    text = '#line 7 "mine.cu"\nextern "C" __global__ void axpy() { undefined = 1; }\n'
    with pytest.raises(InputError, match=r"mine.cu\(7\).*undefined"):
        device.compile(source(text), "axpy")
    with pytest.raises(InputError, match="cannot compile and load kernel missing"):
        device.compile(source(AXPY), "missing")


@pytest.mark.parametrize(
    "failure",
    [
        RuntimeError("Failed to find CUDA headers."),  # CuPy's own: pip brings them in a wheel apart
        PermissionError("cannot write the kernel cache"),
    ],
)
def test_cupy_that_cannot_compile(gpu: FakeGpu, failure: Exception) -> None:
    gpu.fail_compile = failure
    with pytest.raises(InputError, match=r"cannot compile and load kernel axpy.*mpmbench doctor"):
        CudaDevice("cuda").compile(source(AXPY), "axpy")


def test_errors_of_cuda_are_what_the_device_catches() -> None:
    for error in (cupy.cuda.runtime.CUDARuntimeError, cupy.cuda.driver.CUDADriverError, cupy.cuda.nvrtc.NVRTCError):
        assert issubclass(error, RuntimeError)


def test_free_memory_counts_what_the_pool_holds_unused(gpu: FakeGpu) -> None:
    device = CudaDevice("cuda")
    gpu.pooled = 1000
    assert device.free_bytes == gpu.memory_bytes + 1000


def test_launch_failure_names_the_kernel(gpu: FakeGpu) -> None:
    device = CudaDevice("cuda")
    launch = axpy_launch(device)
    gpu.fail_launch = cupy.cuda.runtime.CUDARuntimeError(701)
    with pytest.raises(InputError, match=r"kernel axpy cannot be launched \(grid \(2, 1, 1\).*LaunchOutOfResources"):
        device.launch(launch)


def test_failure_of_an_earlier_kernel_is_reported_when_waiting(gpu: FakeGpu) -> None:
    device = CudaDevice("cuda")
    launch = axpy_launch(device)
    device.launch(launch)
    gpu.fail_synchronize = cupy.cuda.runtime.CUDARuntimeError(700)
    with pytest.raises(InputError, match=r"launched before has failed.*IllegalAddress.*debug"):
        device.synchronize()
    with pytest.raises(InputError, match="launched before has failed"):
        device.download(launch.args[0])


def test_too_much_shared_memory(gpu: FakeGpu) -> None:
    device = CudaDevice("cuda")
    with pytest.raises(InputError, match="this GPU has 232,448: use a smaller block shape"):
        device.launch(axpy_launch(device, shared_bytes=300_000))
    assert not gpu.details("kernel")
