"""The doctor: every finding has a remedy of one line, and nothing makes it raise."""

from __future__ import annotations

import sys
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace

import pynvml
import pytest
from click.testing import CliRunner
from fake_cupy import FakeGpu, fake_cupy
from fake_pynvml import FakeNvml, NvmlGpu

from mpmbench import doctor
from mpmbench.cli import main
from mpmbench.doctor import Check, diagnose, satisfies
from mpmbench.errors import InputError
from mpmbench.gpu import MEANINGS, Constant, get_gpu
from mpmbench.gpu.write import describe, most_similar


def by_name(checks: list[Check]) -> dict[str, Check]:
    return {check.name: check for check in checks}


def test_this_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MPMBENCH_CACHE_DIR", str(tmp_path / "cache"))
    checks = diagnose()
    found = by_name(checks)
    assert {
        "Python",
        "numpy",
        "numba",
        "llvmlite",
        "NVRTC",
        "ptxas",
        "CPU",
        "memory",
        "kernel cache",
        "disk",
        "CuPy",
    } <= (found.keys())
    for name in ("numba", "llvmlite", "NVRTC", "ptxas", "kernel cache"):
        assert found[name].status == "ok", found[name]
    assert "sm_52" in doctor.nvrtc()[0].detail or "sm_50" in doctor.nvrtc()[0].detail
    for check in checks:
        assert check.detail
        assert "\n" not in check.detail + check.remedy
        assert (check.status == "ok") == (not check.remedy), check


def test_a_look_that_fails_is_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken() -> list[Check]:
        raise RuntimeError("cannot\nread")

    def refused() -> list[Check]:
        raise InputError("no such thing")

    monkeypatch.setattr(doctor, "LOOKS", (("one", broken), ("two", refused)))
    one, two = diagnose()
    assert (one.status, one.detail) == ("warn", "cannot be looked at: RuntimeError: cannot read")
    assert (two.status, two.detail) == ("missing", "no such thing")


def installed(monkeypatch: pytest.MonkeyPatch, **versions: str | None) -> None:
    """Pretend that distributions (names with _ for -) are installed in these versions, None: not installed."""
    real = metadata.version
    wanted = {name.replace("_", "-"): version for name, version in versions.items()}

    def version(name: str) -> str:
        if name not in wanted:
            return real(name)
        if wanted[name] is None:
            raise metadata.PackageNotFoundError(name)
        return str(wanted[name])

    monkeypatch.setattr(metadata, "version", version)


def test_wrong_and_missing_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    installed(monkeypatch, numba="0.70.0", llvmlite=None)
    found = by_name(doctor.packages())
    assert (found["numba"].status, found["numba"].remedy) == ("warn", "pip install 'numba==0.68.*'")
    assert (found["llvmlite"].status, found["llvmlite"].remedy) == ("missing", "pip install 'llvmlite==0.50.*'")


@pytest.mark.parametrize(
    ("version", "specifiers", "answer"),
    [
        ("0.68.1", "==0.68.*", True),
        ("0.69.0", "==0.68.*", False),
        ("2.4.6", ">=2.0", True),
        ("1.26.4", ">=2.0", False),
        ("3.10", ">=3.9,==3.*", True),
        ("1.0", "", True),
    ],
)
def test_satisfies(version: str, specifiers: str, answer: bool) -> None:
    assert satisfies(version, specifiers) is answer


def test_compiler_without_the_old_gpus(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mpmbench.simt.nvrtc.supported_archs", lambda: ["sm_75", "sm_120"])
    (check,) = doctor.nvrtc()
    assert check.status == "warn"
    assert "sm_52" in check.detail
    assert "12.9" in check.remedy


def test_ptxas_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing() -> Path:
        raise InputError("ptxas not found")

    monkeypatch.setattr("mpmbench.device.ptxas.find_ptxas", missing)
    (check,) = doctor.ptxas()
    assert check.status == "missing"
    assert "nvidia-cuda-nvcc-cu12" in check.remedy


def test_cache_that_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("MPMBENCH_CACHE_DIR", str(tmp_path / "file" / "cache"))
    found = by_name(doctor.cache_and_disk())
    assert found["kernel cache"].status == "warn"
    assert "MPMBENCH_CACHE_DIR" in found["kernel cache"].remedy


def test_little_disk_and_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MPMBENCH_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=1000))
    assert by_name(doctor.cache_and_disk())["disk"].status == "warn"
    monkeypatch.setattr(doctor, "WANTED_MEMORY", 2**60)
    assert doctor.memory()[0].status == "warn"


def test_no_cupy_and_two_cupys(monkeypatch: pytest.MonkeyPatch) -> None:
    installed(monkeypatch, cupy_cuda12x=None, cupy_cuda13x=None)
    assert doctor.cupy()[0].status == "missing"
    assert "mpmbench[cuda12x]" in doctor.cupy()[0].remedy
    assert doctor.gpu()[0].status == "missing"
    installed(monkeypatch, cupy_cuda12x="14.2.0", cupy_cuda13x="14.2.0")
    assert doctor.cupy()[0].remedy == "keep one of them: pip uninstall cupy-cuda12x"
    installed(monkeypatch, cupy_cuda12x="15.0.0", cupy_cuda13x=None)
    assert doctor.cupy()[0].remedy == "pip install 'cupy-cuda12x==14.2.*'"


def test_no_headers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cuda.pathfinder.find_nvidia_header_directory", lambda name: None)
    (check,) = doctor.headers()
    assert (check.status, check.remedy) == ("missing", doctor.INSTALL_CUPY)
    installed(monkeypatch, cupy_cuda12x=None, cupy_cuda13x=None)
    assert doctor.headers() == []


def test_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    machine = FakeGpu()
    monkeypatch.setitem(sys.modules, "cupy", fake_cupy(machine))
    assert doctor.gpu() == [Check("cuda:0", "ok", "Fake GPU, sm_90, 1.0 GiB")]
    machine.count = 0
    assert doctor.gpu()[0].status == "missing"


@pytest.mark.parametrize(
    ("changes", "what", "status", "remedy"),
    [
        ({}, "compute mode", "ok", ""),
        ({}, "neighbours", "ok", ""),
        ({}, "throttling", "ok", ""),
        ({}, "persistence", "ok", ""),
        ({"capability": (5, 2)}, "clocks", "warn", "one session"),
        ({"reasons": 0x4 | 0x1}, "throttling", "warn", "power limit"),
        ({"compute_mode": 2}, "compute mode", "missing", "--compute-mode=0"),
        ({"processes": [1]}, "neighbours", "warn", "of your own"),
        ({"persistence": 0}, "persistence", "warn", "--persistence-mode=1"),
    ],
)
def test_driver(monkeypatch: pytest.MonkeyPatch, changes, what, status, remedy) -> None:
    installed(monkeypatch, nvidia_ml_py="13.0")
    gpu = NvmlGpu(name="NVIDIA GeForce GTX 970", **{"processes": [], **changes})
    monkeypatch.setitem(sys.modules, "pynvml", FakeNvml(gpu))
    found = by_name(doctor.driver())
    assert found["driver"].status == "ok"
    assert "580.65.06" in found["driver"].detail
    check = found[f"NVML 0 (NVIDIA GeForce GTX 970): {what}"]
    assert check.status == status
    assert remedy in check.remedy


@pytest.mark.parametrize(("user", "status"), [(0, "ok"), (1000, "warn")])
def test_clocks_may_be_locked_by_root_only(monkeypatch: pytest.MonkeyPatch, user: int, status: str) -> None:
    installed(monkeypatch, nvidia_ml_py="13.0")
    fake = FakeNvml(NvmlGpu(sm_clock_max=1500))
    monkeypatch.setitem(sys.modules, "pynvml", fake)
    monkeypatch.setattr("os.geteuid", lambda: user)
    check = by_name(doctor.driver())["NVML 0 (Fake GPU): clocks"]
    assert check.status == status
    assert "--lock-gpu-clocks" in check.detail + check.remedy
    assert fake.commands == [], "a doctor changes nothing"


def test_questions_that_the_driver_refuses(monkeypatch: pytest.MonkeyPatch) -> None:
    refused = {
        f"nvmlDeviceGet{question}": pynvml.NVML_ERROR_NO_PERMISSION
        for question in ("ClockInfo", "CurrentClocksEventReasons", "CurrentClocksThrottleReasons", "PersistenceMode")
    }
    installed(monkeypatch, nvidia_ml_py="13.0")
    monkeypatch.setitem(sys.modules, "pynvml", FakeNvml(NvmlGpu(processes=[], refuses=refused)))
    found = by_name(doctor.driver())
    for what in ("clocks", "throttling", "persistence"):
        assert found[f"NVML 0 (Fake GPU): {what}"].detail == "not told: Insufficient Permissions"
    assert found["NVML 0 (Fake GPU): neighbours"].status == "ok"
    monkeypatch.setitem(sys.modules, "pynvml", FakeNvml(fail_init=pynvml.NVML_ERROR_DRIVER_NOT_LOADED))
    assert doctor.driver()[0].status == "missing"
    assert "Driver Not Loaded" in doctor.driver()[0].detail
    installed(monkeypatch, nvidia_ml_py=None)
    assert doctor.driver()[0].remedy == "pip install nvidia-ml-py"


@pytest.mark.parametrize(
    ("text", "user", "status"),
    [
        ("RmProfilingAdminOnly: 0\n", 1000, "ok"),
        ("A: 1\nRmProfilingAdminOnly: 1\nB: 0\n", 1000, "warn"),
        ("RmProfilingAdminOnly: 1\n", 0, "ok"),
        ("A: 1\n", 1000, "warn"),
    ],
)
def test_who_may_read_counters(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text, user, status) -> None:
    parameters = tmp_path / "params"
    monkeypatch.setattr(doctor, "DRIVER_PARAMETERS", parameters)
    assert doctor.counters() == doctor.ncu() == [], "no driver, no counters to speak of"
    parameters.write_text(text)
    monkeypatch.setattr("os.geteuid", lambda: user)
    (check,) = doctor.counters()
    assert check.status == status
    assert (status == "ok") == (not check.remedy)


def test_ncu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    parameters = tmp_path / "params"
    parameters.touch()
    monkeypatch.setattr(doctor, "DRIVER_PARAMETERS", parameters)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert doctor.ncu()[0].status == "missing"
    (tmp_path / "ncu").touch(mode=0o755)
    assert doctor.ncu() == [Check("ncu", "ok", str(tmp_path / "ncu"))]


def test_this_gpu_is_described(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cupy", fake_cupy(FakeGpu(capability="86", memory_bytes=8 << 30)))
    path = tmp_path / "mine.toml"
    result = CliRunner().invoke(main, ["doctor", "--write-gpu", str(path)])
    assert result.exit_code == 0, result.output
    assert "Fake GPU: sm_86, 4 SMs at 1000 MHz, 128 GB/s" in result.output
    gpu, similar = get_gpu(path), get_gpu("rtx3090")
    assert (gpu.name, gpu.title, gpu.arch) == ("mine", "Fake GPU", "sm_86")
    told = {"sm_count": 4, "clock_mhz": 1000, "warps_per_sm": 64, "blocks_per_sm": 32, "registers_per_sm": 65_536,
            "shared_bytes_per_sm": 233_472, "shared_bytes_per_block": 232_448, "shared_reserved_bytes_per_block": 1024,
            "l2_bytes": 1 << 20, "memory_bytes": 8 << 30, "dram_bandwidth": 128e9}  # fmt: skip
    for name, value in told.items():
        assert gpu.constants[name] == Constant(value, "CUDA driver of this machine", "high"), name
    for name, constant in gpu.constants.items():
        if name not in told:
            assert constant.confidence == "low"
            assert "taken from NVIDIA GeForce RTX 3090" in constant.source
            assert constant.value == similar[name] or name == "dram_bandwidth_achieved"
    assert gpu["dram_bandwidth_achieved"] == pytest.approx(128e9 * 913 / 936)
    assert set(gpu.constants) == set(similar.constants)
    assert all(f"# {meaning}\n" in path.read_text() for name, meaning in MEANINGS.items() if name in gpu.constants)

    before = path.read_text()
    again = CliRunner().invoke(main, ["doctor", "--write-gpu", str(path)])
    assert (again.exit_code, path.read_text()) == (2, before)
    assert again.output.count("\n") == 1
    assert "mine.toml exists and is not overwritten" in again.output


def test_without_a_gpu_nothing_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cupy", fake_cupy(FakeGpu(fail_count=RuntimeError("no driver"))))
    path = tmp_path / "mine.toml"
    result = CliRunner().invoke(main, ["doctor", "--write-gpu", str(path)])
    assert result.exit_code == 2
    assert result.output.startswith("mpmbench: no GPU for device 'cuda'")
    assert result.output.count("\n") == 1
    assert not path.exists()
    for name, message in (("mine.json", "is a .toml file"), ("no/such/folder.toml", "cannot write")):
        monkeypatch.setitem(sys.modules, "cupy", fake_cupy(FakeGpu()))
        result = CliRunner().invoke(main, ["doctor", "--write-gpu", str(tmp_path / name)])
        assert (result.exit_code, message in result.output) == (2, True)


@pytest.mark.parametrize(
    ("arch", "sms", "expected"),
    [("sm_90", 132, "h100_sxm"), ("sm_90", 114, "h100"), ("sm_86", 28, "rtx3090"), ("sm_75", 40, "v100"),
     ("sm_88", 10, "rtx3090"), ("sm_61", 28, "gtx970"), ("sm_120", 170, "h100_sxm"), ("sm_50", 5, "gtx970")],
)  # fmt: skip
def test_what_is_unknown_comes_from_a_similar_gpu(arch: str, sms: int, expected: str) -> None:
    assert most_similar(arch, sms).name == expected


def test_what_a_driver_does_not_tell_is_taken_too() -> None:
    properties = fake_cupy(FakeGpu()).cuda.runtime.getDeviceProperties(0) | {"clockRate": 0, "memoryClockRate": 0}
    gpu = describe("mine", "sm_75", properties)
    assert gpu["clock_mhz"] == get_gpu("v100")["clock_mhz"]
    assert gpu["dram_bandwidth_achieved"] == get_gpu("v100")["dram_bandwidth_achieved"]
    assert "of another architecture (sm_70)" in gpu.constants["clock_mhz"].source
