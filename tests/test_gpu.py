"""GPU descriptions and occupancy, against figures worked out by hand from NVIDIA's published rules."""

from __future__ import annotations

import pytest

import mpmbench as mb
from mpmbench.errors import InputError
from mpmbench.gpu import get_gpu, list_gpus
from mpmbench.gpu.occupancy import Occupancy, occupancy


def test_every_constant_has_a_source_and_a_plausible_size():
    names = [gpu.name for gpu in list_gpus()]
    assert names == [gpu.name for gpu in mb.list_gpus()]
    assert {"gtx970", "v100", "rtx3090", "a100", "rtx4090", "h100", "h200"} <= set(names)
    for gpu in list_gpus():
        assert all(c.source and c.value >= 0 for c in gpu.constants.values())
        assert 100e9 < gpu["dram_bandwidth"] < 10e12
        assert gpu["dram_bandwidth"] < gpu["l2_bandwidth"]
        assert gpu["l2_bytes"] < gpu["memory_bytes"]
        assert "\n" not in gpu.summary


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
