"""NVML over a fake held to the real module: the right GPU, what is told of it, and clocks that are always set free."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

import pynvml
import pytest
from click.testing import CliRunner
from fake_cupy import FakeGpu, fake_cupy
from fake_pynvml import FakeNvml, NvmlGpu

from mpmbench import cli
from mpmbench.cli import main
from mpmbench.device import nvml
from mpmbench.device.cuda import CudaDevice
from mpmbench.device.nvml import Nvml, hashed, parse_lock, visible_devices
from mpmbench.errors import InputError

BASE = pynvml.NVML_CLOCK_LIMIT_ID_TDP
UUID = bytes(range(1, 17))
OTHER = NvmlGpu(uuid="GPU-ffffffff-0506-0708-090a-0b0c0d0e0f10", pci_bus_id="00000000:02:00.0", sm_clock=210)


@pytest.fixture
def gpu() -> NvmlGpu:
    return NvmlGpu()


@pytest.fixture
def fake(gpu: NvmlGpu, monkeypatch: pytest.MonkeyPatch) -> FakeNvml:
    """The GPU in question is second in NVML's order and first in CUDA's."""
    module = FakeNvml(OTHER, gpu)
    monkeypatch.setitem(sys.modules, "pynvml", module)
    monkeypatch.setattr(nvml, "SETTLE_SECONDS", 0)
    return module


def found(uuid: Any = UUID, pci_bus_id: str | None = None) -> Nvml:
    one, reason = Nvml.of(uuid, pci_bus_id)
    assert one is not None, reason
    return one


# The fake


def test_fake_refuses_what_pynvml_would_refuse() -> None:
    fake, gpu = FakeNvml(), NvmlGpu()
    with pytest.raises(TypeError):
        fake.nvmlDeviceGetClockInfo(gpu)
    with pytest.raises(TypeError):
        fake.nvmlDeviceSetGpuLockedClocks(gpu, 1, clock=2)
    with pytest.raises(AttributeError):
        fake.nvmlDeviceGetLockedClocks  # noqa: B018
    assert fake.NVML_CLOCK_SM == pynvml.NVML_CLOCK_SM


@pytest.mark.parametrize(
    ("name", "bit"),
    list(zip(nvml.REASONS, (0x4, 0x8, 0x20, 0x40, 0x80), strict=True)),
)
def test_reasons_have_the_documented_bits(name: str, bit: int) -> None:
    assert getattr(pynvml, name) == bit


# Which GPU


def test_a_gpu_is_found_by_uuid_though_nvml_counts_in_another_order(fake: FakeNvml, gpu: NvmlGpu) -> None:
    assert fake.nvmlDeviceGetHandleByIndex(0) is not gpu
    assert found().sm_clock == gpu.sm_clock
    assert found(gpu.uuid).sm_clock == gpu.sm_clock


@pytest.mark.parametrize("uuid", [None, UUID[:3]])  # the fourth byte is zero: a C string ends there
def test_without_a_whole_uuid_the_pci_bus_id_decides(fake: FakeNvml, gpu: NvmlGpu, uuid: bytes | None) -> None:
    assert found(uuid, "0000:01:00.0").sm_clock == gpu.sm_clock
    assert found(uuid, "0000:02:00.0").sm_clock == 210


def test_a_uuid_that_runs_on_is_cut(fake: FakeNvml, gpu: NvmlGpu) -> None:
    assert found(UUID + b"\x01\x02").sm_clock == gpu.sm_clock


def test_an_instance_stands_for_its_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = NvmlGpu(uuid="GPU-0", mig=1, sm_clock=990)
    instance = NvmlGpu(uuid="MIG-01020304-0506-0708-090a-0b0c0d0e0f10", part_of=whole)
    monkeypatch.setitem(sys.modules, "pynvml", FakeNvml(whole, instance))
    assert found().facts()["sm_clock_now"] == 990
    assert found().facts()["mig"] is True


def test_no_nvml_has_a_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pynvml", FakeNvml(fail_init=pynvml.NVML_ERROR_LIBRARY_NOT_FOUND))
    assert Nvml.of(UUID) == (None, "NVML Shared Library Not Found")
    monkeypatch.setitem(sys.modules, "pynvml", FakeNvml(OTHER))
    assert Nvml.of(UUID, "0000:07:00.0") == (None, "NVML does not know this GPU: Not Found")
    assert Nvml.of(None)[1] == "this GPU has neither UUID nor PCI bus id"
    monkeypatch.setitem(sys.modules, "pynvml", None)
    assert Nvml.of(UUID) == (None, "nvidia-ml-py is not installed")


# Facts


def test_facts(fake: FakeNvml, gpu: NvmlGpu) -> None:
    gpu.reasons, gpu.processes = 0x1 | 0x2 | 0x8 | 0x80, [4711, 4712]
    facts = found().facts()
    assert facts == {
        "uuid": hashed(gpu.uuid), "driver": "580.65.06", "sm_clock_now": 1050, "sm_clock_max": 1980,
        "sm_clock_default": 1500, "memory_clock_now": 2619, "memory_clock_max": 2619, "memory_clock_default": 2619,
        "clocks_locked": None, "clocks_lockable": True, "throttle_now": "hardware slowdown, power brake",
        "power_limit": 700.0, "power_limit_default": 700.0, "power_limit_min": 200.0, "power_limit_max": 700.0,
        "temperature_now": 41, "ecc": True, "mig": False, "persistence": True, "compute_mode": "default",
        "other_processes_now": 1,
    }  # fmt: skip
    json.dumps(facts)


def test_a_question_that_is_not_answered_is_none(fake: FakeNvml, gpu: NvmlGpu) -> None:
    questions = [name for name in vars(FakeNvml) if name.startswith("_nvmlDeviceGet")]
    gpu.refuses = {name[1:]: pynvml.NVML_ERROR_NOT_SUPPORTED for name in questions if "Handle" not in name}
    assert {key: value for key, value in found().facts().items() if value is not None} == {"driver": "580.65.06"}
    assert found().name == "unknown GPU"


def test_older_drivers_know_reasons_and_temperature_by_other_names(fake: FakeNvml, gpu: NvmlGpu) -> None:
    gpu.reasons = 0x20
    gpu.refuses = {
        f"nvmlDeviceGet{name}": pynvml.NVML_ERROR_FUNCTION_NOT_FOUND
        for name in ("CurrentClocksEventReasons", "TemperatureV")
    }
    assert found().throttle_reasons() == "software thermal slowdown"
    assert found().facts()["temperature_now"] == 41


@pytest.mark.parametrize("bits", [0x0, 0x1, 0x2, 0x10, 0x100])
def test_what_somebody_chose_is_no_trouble(fake: FakeNvml, gpu: NvmlGpu, bits: int) -> None:
    gpu.reasons = bits
    assert found().throttle_reasons() == ""


def test_no_uuid_leaves_this_machine(fake: FakeNvml, gpu: NvmlGpu, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cupy", fake_cupy(FakeGpu()))
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", f"{gpu.uuid},1")
    told = json.dumps(CudaDevice("cuda").facts)
    assert gpu.uuid[4:12] not in told
    assert UUID.hex() not in told
    assert hashed(UUID) == hashed(gpu.uuid) == hashed(gpu.uuid.encode())
    assert visible_devices() == f"GPU-{hashed(gpu.uuid)},1"
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES")
    assert visible_devices() is None


def test_facts_of_the_cuda_device(fake: FakeNvml, gpu: NvmlGpu, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cupy", fake_cupy(FakeGpu()))
    gpu.refuses = {"nvmlDeviceGetEccMode": pynvml.NVML_ERROR_NOT_SUPPORTED}
    facts = CudaDevice("cuda").facts
    assert facts["sm_clock_now"] == 1050
    assert facts["ecc"] is False, "what CUDA knows is not forgotten where NVML is silent"
    assert (facts["cuda_driver"], facts["cuda_runtime"], facts["cupy"]) == (12090, 12080, "14.2.0")
    assert "-ftz=true" in facts["nvrtc_options"]
    assert "nvml_missing" not in facts
    monkeypatch.setitem(sys.modules, "pynvml", None)
    facts = CudaDevice("cuda").facts
    assert facts["nvml_missing"] == "nvidia-ml-py is not installed"
    assert facts["uuid"] == hashed(UUID)


# Clocks


@pytest.mark.parametrize(("spec", "megahertz"), [("base", BASE), ("max", 1980), ("1200", 1200)])
def test_clocks_are_locked_and_set_free(fake: FakeNvml, gpu: NvmlGpu, spec: str, megahertz: int) -> None:
    one = found()
    with one.lock_clocks(spec):
        assert gpu.locked_to == (megahertz, megahertz)
        assert one.facts()["clocks_locked"] is True
    assert gpu.locked_to is None
    assert one.facts()["clocks_locked"] is None
    assert [command for command, *_ in fake.commands] == [
        "nvmlDeviceSetGpuLockedClocks",
        "nvmlDeviceResetGpuLockedClocks",
    ]


def test_reset_only_sets_them_free(fake: FakeNvml, gpu: NvmlGpu) -> None:
    gpu.locked_to = (1, 1)
    with found().lock_clocks("reset"):
        assert gpu.locked_to is None
    assert fake.commands == [("nvmlDeviceResetGpuLockedClocks",)]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, SystemExit])
def test_clocks_are_set_free_after_an_exception(fake: FakeNvml, gpu: NvmlGpu, error: type[BaseException]) -> None:
    handlers = [signal.getsignal(number) for number in nvml.SIGNALS]
    with pytest.raises(error), found().lock_clocks("max"):
        raise error
    assert gpu.locked_to is None
    assert [signal.getsignal(number) for number in nvml.SIGNALS] == handlers


@pytest.mark.parametrize("spec", ["", "fast", "0", "-5", "1.5"])
def test_other_words_are_refused(spec: str) -> None:
    with pytest.raises(InputError, match="base, max, reset and a number of MHz"):
        parse_lock(spec)


@pytest.mark.parametrize(
    ("code", "cure"),
    [
        (pynvml.NVML_ERROR_NO_PERMISSION, "only root may"),
        (pynvml.NVML_ERROR_NOT_SUPPORTED, "leave --lock-gpu-clocks out"),
        (pynvml.NVML_ERROR_INVALID_ARGUMENT, "SUPPORTED_CLOCKS"),
        (pynvml.NVML_ERROR_GPU_IS_LOST, "GPU is lost"),
    ],
)
def test_a_lock_that_is_refused_says_what_to_do(fake: FakeNvml, gpu: NvmlGpu, code: int, cure: str) -> None:
    gpu.refuses = {"nvmlDeviceSetGpuLockedClocks": code}
    one = found()
    with pytest.raises(InputError, match=cure) as caught, one.lock_clocks("max"):
        pytest.fail("nothing runs under a lock that was refused")
    assert "\n" not in str(caught.value)
    assert not one.locked
    assert fake.commands == [], "what was not locked is not set free"


CHILD = """
import os, signal, sys, time
sys.path[:0] = {paths!r}
from fake_pynvml import FakeNvml, NvmlGpu
fake = sys.modules["pynvml"] = FakeNvml(NvmlGpu())
fake.log = lambda command: os.write(1, (command[0] + "\\n").encode())
from mpmbench.device import nvml
nvml.SETTLE_SECONDS = 0
one, _ = nvml.Nvml.of(None, "0000:01:00.0")
{body}
"""


def child(body: str) -> subprocess.Popen[str]:
    tests = Path(__file__).parent
    text = CHILD.format(paths=[str(tests), str(tests.parent)], body=textwrap.dedent(body))
    return subprocess.Popen([sys.executable, "-c", text], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


SET, RESET = "nvmlDeviceSetGpuLockedClocks", "nvmlDeviceResetGpuLockedClocks"


@pytest.mark.parametrize("number", nvml.SIGNALS)
def test_a_signal_sets_the_clocks_free_and_still_kills(number: signal.Signals) -> None:
    process = child("""
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        with one.lock_clocks("max"):
            print("locked", flush=True)
            time.sleep(60)
    """)
    assert process.stdout is not None
    assert [process.stdout.readline().strip() for _ in range(2)] == [SET, "locked"]
    os.kill(process.pid, number)
    out, _ = process.communicate(timeout=30)
    assert out.split() == [RESET]
    assert process.returncode == -number


def test_a_handler_of_the_program_is_left_in_place() -> None:
    process = child("""
        def stop(*_): raise KeyboardInterrupt
        signal.signal(signal.SIGTERM, stop)
        try:
            with one.lock_clocks("max"):
                os.kill(os.getpid(), signal.SIGTERM)
                time.sleep(60)
        except KeyboardInterrupt:
            print("stopped", flush=True)
    """)
    out, errors = process.communicate(timeout=30)
    assert out.split() == [SET, RESET, "stopped"], errors


def test_clocks_are_set_free_at_exit_by_whoever_locked_them() -> None:
    """A block that is never left, and a forked child that must not set free what it did not lock."""
    process = child("""
        import atexit
        parent = os.getpid()
        atexit.register(lambda: os.getpid() == parent and print("over", flush=True))  # the last to run
        lock = one.lock_clocks("max")
        lock.__enter__()
        if os.fork() == 0:
            sys.exit()
        os.wait()
        print("child is gone", flush=True)
        sys.exit(3)
    """)
    out, errors = process.communicate(timeout=30)
    assert out.split() == [SET, "child", "is", "gone", RESET, "over"], errors
    assert process.returncode == 3


# Command line


@pytest.fixture
def machine(fake: FakeNvml, monkeypatch: pytest.MonkeyPatch) -> FakeNvml:
    monkeypatch.setitem(sys.modules, "cupy", fake_cupy(FakeGpu()))
    return fake


def run(*words: str) -> Any:
    return CliRunner().invoke(main, ["run", "--quick", "-b", "p2g_global_atomic", "--dataset", "one_cell", *words])


def test_run_locks_what_it_times_and_warns_first(
    machine: FakeNvml, gpu: NvmlGpu, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[Any] = []
    monkeypatch.setattr(cli, "_run_cases", lambda *_: seen.append(gpu.locked_to) or [])
    monkeypatch.setattr(cli, "_write_reports", lambda *_: None)
    monkeypatch.setattr(cli, "_summarise", lambda *_: None)
    gpu.persistence = 0
    result = run("-d", "cuda", "--lock-gpu-clocks", "base")
    assert result.exit_code == 0, result.output
    assert seen == [(BASE, BASE)]
    assert gpu.locked_to is None
    assert "Persistence mode is off" in result.output
    assert "did not lock" not in result.output
    assert "did not lock the clocks" in run("-d", "cuda").output


@pytest.mark.parametrize("words", [["-d", "cuda"], ["-d", "cuda", "--lock-gpu-clocks", "max", "--dry-run"]])
def test_clocks_are_never_touched_unasked(machine: FakeNvml, monkeypatch: pytest.MonkeyPatch, words: list[str]) -> None:
    monkeypatch.setattr(cli, "_run_cases", lambda *_: [])
    monkeypatch.setattr(cli, "_write_reports", lambda *_: None)
    monkeypatch.setattr(cli, "_summarise", lambda *_: None)
    assert run(*words).exit_code == 0
    assert machine.commands == []


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["-d", "simulated", "--lock-gpu-clocks", "base"], "add -d cuda"),
        (["--gpu", "h100", "--lock-gpu-clocks", "base"], "add -d cuda"),
        (["-d", "cuda", "--lock-gpu-clocks", "fast"], "base, max, reset"),
    ],
)
def test_run_refuses_a_lock_that_makes_no_sense(machine: FakeNvml, words: list[str], message: str) -> None:
    result = run(*words)
    assert result.exit_code == 2
    assert message in result.output
    assert result.output.count("\n") == 1
    assert machine.commands == []


def test_no_gpu_or_no_nvml_to_lock_with(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cupy", fake_cupy(FakeGpu(count=0)))
    assert "no GPU here to be timed" in run("--lock-gpu-clocks", "base").output
    monkeypatch.setitem(sys.modules, "cupy", fake_cupy(FakeGpu()))
    monkeypatch.setitem(sys.modules, "pynvml", None)
    result = run("-d", "cuda", "--lock-gpu-clocks", "base")
    assert (result.exit_code, result.output.count("\n")) == (2, 1)
    assert "nvidia-ml-py is not installed" in result.output
