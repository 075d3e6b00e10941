"""GPU descriptions and occupancy, against figures worked out by hand from NVIDIA's published rules."""

from __future__ import annotations

import tomllib
from dataclasses import fields
from pathlib import Path

import pytest

import mpmbench as mb
import mpmbench.gpu
from mpmbench.errors import InputError
from mpmbench.gpu import CONFIDENCES, MEANINGS, REQUIRED, get_gpu, list_gpus
from mpmbench.gpu.calibration import CELLS
from mpmbench.gpu.machine import carve_out, machine_of
from mpmbench.gpu.occupancy import Occupancy, occupancy

# Widest range that any GPU since Maxwell lies in.
SANE = {
    "sm_count": (1, 300), "clock_mhz": (500, 3500), "schedulers_per_sm": (4, 4), "warps_per_sm": (32, 64),
    "blocks_per_sm": (16, 32), "registers_per_sm": (65_536, 65_536), "shared_bytes_per_sm": (65_536, 262_144),
    "shared_bytes_per_block": (49_152, 262_144), "shared_granularity_bytes": (128, 256),
    "shared_reserved_bytes_per_block": (0, 1024), "l1_bytes": (12 << 10, 256 << 10), "l1_per_sm": (1, 2),
    "l1_holds_plain_loads": (0, 1), "l1_bytes_per_clk": (32, 256), "l2_bytes": (1 << 20, 256 << 20),
    "l2_slices": (8, 256), "l2_bandwidth": (2e11, 3e13), "memory_bytes": (2e9, 3e11), "dram_bandwidth": (1e11, 1e13),
    "dram_bandwidth_achieved": (1e11, 1e13), "dram_channels": (4, 128), "dram_banks": (8, 64),
    "dram_row_bytes": (512, 4096), "alu_latency": (3, 10), "shared_latency": (15, 50), "l1_latency": (25, 150),
    "l2_latency": (150, 400), "dram_latency": (300, 1000), "barrier_latency": (10, 100),
    "block_start_cycles": (0, 2000), "launch_overhead": (1e-6, 2e-5), "rate_fp32": (2, 4), "rate_fp64": (1 / 32, 2),
    "rate_int_add": (2, 4), "rate_int_mul": (1, 4), "rate_logic": (2, 4), "rate_shift": (1, 4),
    "rate_compare": (1, 4), "rate_convert": (0.5, 2), "rate_special": (0.5, 1), "rate_load_store": (0.5, 1),
    "issue_efficiency": (0.3, 1), "atomic_word_rate": (1e9, 1e13), "row_activation_rate": (1e8, 1e12),
}  # fmt: skip


def test_the_shipped_gpus():
    names = [gpu.name for gpu in list_gpus()]
    assert names == [gpu.name for gpu in mb.list_gpus()]
    assert {"gtx970", "v100", "rtx3090", "a100", "rtx4090", "h100", "h100_sxm", "h200"} == set(names)
    for gpu in list_gpus():
        assert "\n" not in gpu.summary


@pytest.mark.parametrize("gpu", list_gpus(), ids=lambda gpu: gpu.name)
def test_every_constant_has_a_source_and_a_plausible_size(gpu):
    for name, constant in gpu.constants.items():
        low, high = SANE[name]
        assert low <= constant.value <= high, name
        assert len(constant.source) > 10, name
        assert constant.confidence in CONFIDENCES, name
        guessed = any(word in constant.source for word in ("estimate", "not measured"))
        assert not guessed or constant.confidence == "low", name
    assert gpu["dram_bandwidth"] < gpu["l2_bandwidth"] < gpu["sm_count"] * 129 * gpu["clock_mhz"] * 1e6
    assert (gpu.get("dram_bandwidth_achieved") or 0) < gpu["dram_bandwidth"]
    assert gpu["l2_bytes"] < gpu["memory_bytes"]
    assert gpu["shared_bytes_per_block"] <= gpu["shared_bytes_per_sm"]
    assert gpu["alu_latency"] < gpu["shared_latency"] <= gpu["l1_latency"] < gpu["l2_latency"] < gpu["dram_latency"]


def test_the_issue_efficiency_and_three_calibrated_rates_alone_come_from_the_thesis():
    for gpu in list_gpus():
        quoted = {name for name, constant in gpu.constants.items() if "thesis" in constant.source.lower()}
        assert quoted == {"issue_efficiency", *(CELLS if gpu.name == "gtx970" else ())}
    assert get_gpu("gtx970")["issue_efficiency"] == get_gpu("h100")["issue_efficiency"] == 0.65
    assert get_gpu("h100").constants["issue_efficiency"].confidence == "low"


def test_what_is_calibrated_or_unknown_is_absent():
    with (Path(mpmbench.gpu.__file__).parent / "gtx970.toml").open("rb") as file:
        assert not set(CELLS) & set(tomllib.load(file)["constants"]), "calibrated constants have a file of their own"
    for gpu in list_gpus():
        if gpu.name != "gtx970":
            assert gpu.get("atomic_word_rate") is None
            assert gpu.get("row_activation_rate") is None
    assert get_gpu("v100").get("l2_bytes") == 6 << 20


def test_the_machine_of_a_gpu():
    gtx970 = machine_of(get_gpu("gtx970"), 11, 8624)
    assert (gtx970.sms, gtx970.blocks_per_sm, gtx970.l1_bytes, gtx970.l1_per_sm) == (13, 11, 24 << 10, 2)
    assert gtx970.l1_holds_plain_loads is False
    counts = [f.name for f in fields(gtx970) if f.type in ("int", "bool")]
    assert len(counts) > 15
    assert all(isinstance(getattr(gtx970, name), int) for name in counts)
    v100 = machine_of(get_gpu("v100"), 7, 8624)
    assert v100.l1_holds_plain_loads is True
    # 7 x 8,704 bytes = 59.5 KiB: 64 of 128 KiB become shared memory.
    assert v100.l1_bytes == (128 - 64) << 10


@pytest.mark.parametrize(
    ("name", "blocks", "shared", "expected"),
    [
        ("gtx970", 11, 8624, 0),  # a memory of its own
        ("v100", 16, 0, 0),
        ("v100", 11, 8624, 96),  # 11 x 8,704 = 93.5 KiB
        ("a100", 16, 0, 16),  # 1 KiB is reserved for each thread block
        ("a100", 8, 8624, 100),  # 8 x 9,728 = 76 KiB
        ("rtx3090", 10, 8624, 100),
        ("h100", 16, 8624, 164),  # 16 x 9,728 = 152 KiB
        ("h100", 1, 232_448, 228),
    ],
)
def test_the_shared_memory_carved_out_of_l1(name, blocks, shared, expected):
    assert carve_out(get_gpu(name), blocks, shared) == expected << 10


@pytest.mark.parametrize(
    ("name", "threads", "registers", "shared", "expected"),
    [
        # 8,624 bytes round to 8,704; 98,304 / 8,704 = 11.3. The thesis measured 43.3 to 43.4 warps (table 15).
        ("gtx970", 128, 32, 8624, Occupancy(11, 44, "shared memory")),
        # 255 registers: 8,160 per warp, 8,192 after rounding; 65,536 / 8,192 = 8 warps.
        ("gtx970", 128, 255, 0, Occupancy(2, 8, "registers")),
        ("gtx970", 32, 32, 0, Occupancy(32, 32, "blocks")),
        ("gtx970", 256, 32, 0, Occupancy(8, 64, "warps")),
        # 1,024 bytes are reserved: (8,624 + 1,024) rounds to 9,728; 233,472 / 9,728 = 24 blocks, but 16 fill 64 warps.
        ("h100", 128, 32, 8624, Occupancy(16, 64, "warps")),
        ("rtx3090", 128, 32, 8624, Occupancy(10, 40, "shared memory")),
        # 40 registers: 1,280 per warp; 65,536 / 1,280 = 51.2 -> 48 warps in groups of four; 48 / 8 = 6 blocks.
        ("v100", 256, 40, 0, Occupancy(6, 48, "registers")),
        # Thread blocks of two warps: 48 / 2 = 24; without the groups of four it would be 51 / 2 = 25.
        ("v100", 64, 40, 0, Occupancy(24, 48, "registers")),
        ("a100", 1024, 33, 0, Occupancy(1, 32, "registers")),
        ("h200", 128, 32, 300_000, Occupancy(0, 0, "shared memory")),
        # 72 registers: 2,304 per warp; 28.4 -> 28 warps in groups of four, no thread block of 32.
        ("gtx970", 1024, 72, 0, Occupancy(0, 0, "registers")),
        # A warp started is a warp taken: 129 threads are 5 warps; 64 / 5 = 12.
        ("gtx970", 129, 16, 0, Occupancy(12, 60, "warps")),
        # 12,288 bytes fill 98,304 eight times; one more byte makes 12,544 of it: seven.
        ("gtx970", 128, 32, 12_288, Occupancy(8, 32, "shared memory")),
        ("gtx970", 128, 32, 12_289, Occupancy(7, 28, "shared memory")),
        ("gtx970", 128, 32, 49_153, Occupancy(0, 0, "shared memory")),
        # 33 registers are given out as 40: 1,056 rounds to 1,280 per warp, as 256 is the unit.
        ("v100", 128, 33, 0, Occupancy(12, 48, "registers")),
        ("v100", 128, 64, 8624, Occupancy(8, 32, "registers")),
        ("v100", 128, 32, 98_304, Occupancy(1, 4, "shared memory")),
        # 167,936 / (8,624 + 1,024 -> 9,728) = 17.3, but 16 thread blocks fill 64 warps.
        ("a100", 128, 32, 8624, Occupancy(16, 64, "warps")),
        # 19,968 + 1,024 = 20,992 = 164 x 128: exactly 8 of 167,936. One byte more: 21,120, 7.95.
        ("a100", 128, 32, 19_968, Occupancy(8, 32, "shared memory")),
        ("a100", 128, 32, 19_969, Occupancy(7, 28, "shared memory")),
        ("a100", 128, 32, 166_912, Occupancy(1, 4, "shared memory")),
        ("a100", 128, 128, 0, Occupancy(4, 16, "registers")),
        # 48 warps and 16 thread blocks: one of two warps is short of blocks.
        ("rtx3090", 64, 32, 0, Occupancy(16, 32, "blocks")),
        ("rtx3090", 256, 40, 0, Occupancy(6, 48, "warps")),
        ("rtx3090", 128, 32, 101_376, Occupancy(1, 4, "shared memory")),
        ("rtx4090", 64, 32, 0, Occupancy(24, 48, "warps")),
        ("rtx4090", 32, 32, 0, Occupancy(24, 24, "blocks")),
        ("rtx4090", 128, 32, 8624, Occupancy(10, 40, "shared memory")),
        ("rtx4090", 128, 255, 0, Occupancy(2, 8, "registers")),
        # 168 registers, three groups of warps: 5,376 per warp, 12.2 -> 12 warps.
        ("h100", 128, 168, 0, Occupancy(3, 12, "registers")),
        ("h100", 384, 168, 0, Occupancy(1, 12, "registers")),
        ("h100", 128, 32, 232_448, Occupancy(1, 4, "shared memory")),
    ],
)
def test_occupancy(name, threads, registers, shared, expected):
    assert occupancy(get_gpu(name), threads, registers, shared) == expected


def test_refusals(tmp_path):
    with pytest.raises(InputError, match="gtx970"):
        get_gpu("gtx1")
    with pytest.raises(InputError, match="no such file"):
        get_gpu(tmp_path / "mine.toml")
    mine = tmp_path / "mine.toml"
    mine.write_text("name = 3\n")
    with pytest.raises(InputError, match=r"mine\.toml"):
        get_gpu(mine)
    mine.write_text(
        'name = "x"\narch = "sm_90"\n[constants]\nsm_count = { value = 1, source = "", confidence = "high" }'
    )
    with pytest.raises(InputError, match="source"):
        get_gpu(mine)


@pytest.mark.parametrize(
    ("value", "says"),
    [
        ("-3", "'sm_count' is -3"),
        ("0", "'sm_count' is 0"),
        ("nan", "'sm_count' is nan"),
        ("'x'", "'sm_count' is no number"),
    ],
)
def test_a_constant_is_a_number_above_zero(tmp_path, value, says):
    text = Path(mpmbench.gpu.__file__).with_name("v100.toml").read_text()
    mine = tmp_path / "mine.toml"
    mine.write_text(text.replace("sm_count = { value = 80", f"sm_count = {{ value = {value}"))
    with pytest.raises(InputError, match=says):
        get_gpu(mine)
    mine.write_text(text.replace("sm_count = { value = 80", "sm_count = 80 #"))
    with pytest.raises(InputError, match="'sm_count' must be"):
        get_gpu(mine)


def test_a_description_of_ones_own_works_by_path(tmp_path):
    shipped = Path(mpmbench.gpu.__file__).with_name("v100.toml").read_text()
    mine = tmp_path / "mine.toml"
    mine.write_text(shipped.replace("Tesla V100 (SXM2)", "Tesla V100 of mine"))
    gpu = get_gpu(mine)
    assert (gpu.name, gpu.title, gpu.arch) == ("mine", "NVIDIA Tesla V100 of mine", "sm_70")
    assert gpu.constants == get_gpu("v100").constants
    assert get_gpu(str(mine)) == gpu
    for name in REQUIRED:
        mine.write_text("\n".join(line for line in shipped.splitlines() if not line.startswith(f"{name} =")))
        with pytest.raises(InputError, match=f"mine.toml: constant '{name}' is missing"):
            get_gpu(mine)
    mine.write_text(shipped + 'l2_size = { value = 1, source = "a guess", confidence = "low" }\n')
    with pytest.raises(InputError, match="unknown constant 'l2_size'"):
        get_gpu(mine)


def test_every_constant_is_explained_with_its_unit():
    assert set(SANE) == set(MEANINGS)
    for name, meaning in MEANINGS.items():
        unit = {"latency": "[cycles]", "bandwidth": "[bytes/s]", "rate": "[", "bytes": "["}
        wanted = next((mark for part, mark in unit.items() if part in name), "")
        assert wanted in meaning, name
