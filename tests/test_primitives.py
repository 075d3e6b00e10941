"""A primitive is one kernel file and one module: pairing, docstrings, flow, command line and report."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from mpmbench import device as devices
from mpmbench import preprocess, primitives
from mpmbench.cli import main
from mpmbench.environment import Environment
from mpmbench.errors import InputError
from mpmbench.presets import PRIMITIVE_TABLES, preset, published_rows
from mpmbench.primitive_runs import PrimitiveCase, primitive_cases
from mpmbench.primitives import Operation, Primitive, discover, get, resolve_axes, why_impossible
from mpmbench.record import from_json, read_records, to_json
from mpmbench.report import html_text, markdown_text
from mpmbench.runner import Inputs, resume_key

PRIMITIVES = discover()
NAMES = [p.name for p in PRIMITIVES]
ENVIRONMENT = Environment.capture(argv=[])
SMALL = 600


@pytest.fixture(scope="module")
def device():
    return devices.open_device("simulated", arch="sm_52", mode="count")


def record_of(device, name: str, size: int = SMALL, **axes):
    primitive = get(name)
    return PrimitiveCase(primitive, size, resolve_axes(primitive, axes), 1).run(device, Inputs(), ENVIRONMENT)


# --- layout -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("primitive", PRIMITIVES, ids=NAMES)
def test_module_kernel_and_operation_share_their_name(primitive: Primitive) -> None:
    assert primitive.path is not None
    assert primitive.path.stem == primitive.name
    assert primitive.name.startswith(primitive.operation.name + "_")
    if primitive.kernel:
        assert primitive.kernel_path.stem == primitive.kernel


@pytest.mark.parametrize("primitive", PRIMITIVES, ids=NAMES)
def test_docstring_says_idea_use_and_source(primitive: Primitive) -> None:
    assert primitive.path is not None
    text = ast.get_docstring(ast.parse(primitive.path.read_text()))
    assert text is not None
    for part in ("Idea: ", "Wins when: ", "Loses when: ", "Source: "):
        assert re.search(rf"^{part}", text, re.M), f"{primitive.name}: docstring lacks '{part}'"
    assert primitive.reference
    assert "\n" not in primitive.summary
    assert len(primitive.summary) <= 70


@pytest.mark.parametrize("primitive", PRIMITIVES, ids=NAMES)
def test_defaults_are_possible(primitive: Primitive) -> None:
    assert why_impossible(primitive, resolve_axes(primitive, {})) is None


def test_listing_waits_for_no_compiler() -> None:
    code = (
        "import sys; from mpmbench.primitives import discover; discover();"
        "print(sorted({'llvmlite', 'numba', 'cupy'} & set(sys.modules)))"
    )
    listed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert listed.stdout.strip() == "[]"


# --- axes -------------------------------------------------------------------------------------------------------------


def test_axes_are_checked() -> None:
    sequential, shuffle = get("reduce_sequential"), get("reduce_shuffle")
    assert resolve_axes(sequential, {"loads": "4"})["loads"] == 4
    with pytest.raises(InputError, match="valid are element"):
        resolve_axes(sequential, {"padding": "full"})
    with pytest.raises(InputError, match="valid are 1, 2, 4"):
        resolve_axes(sequential, {"loads": 3})
    # Another strategy of the operation has it: a sweep skips the row and goes on.
    narrow = replace(shuffle, axes={**shuffle.axes, "loads": (1,)})
    assert resolve_axes(narrow, {"loads": 8})["loads"] == 8
    assert "does not exist" in (why_impossible(narrow, {"loads": 8}) or "")
    assert "particles" in (why_impossible(shuffle, {"element": "int", "operator": "speed_max"}) or "")


def test_sweeps_ignore_axes_that_a_primitive_lacks() -> None:
    chosen = [get("reduce_interleaved"), get("reduce_sequential")]
    cases = primitive_cases(chosen, {"loads": [1, 2]}, size=None, seed=None)
    assert [(c.name, c.axes.get("loads")) for c in cases] == [
        ("reduce_interleaved", None), ("reduce_sequential", 1), ("reduce_sequential", 2),
    ]  # fmt: skip
    assert {c.size for c in cases} == {1024 * 1024}


# --- flow -------------------------------------------------------------------------------------------------------------


def test_record_survives_json_and_finds_its_case_again(device) -> None:
    record = record_of(device, "scan_shuffle")
    assert record.status == "ok"
    assert not record.is_transfer
    assert (record.transfer, record.dataset.n, record.floor_bytes) == ("scan", SMALL, 8 * SMALL)
    assert record.transfer_counters is not None
    assert any("scan" in line.file for line in record.line_texts)
    assert from_json(to_json(record)) == record
    case = PrimitiveCase(get("scan_shuffle"), SMALL, resolve_axes(get("scan_shuffle"), {}))
    assert case.resume_key(device) == resume_key(record)
    assert replace(case, size=SMALL + 1).resume_key(device) != resume_key(record)


def test_a_wrong_result_is_a_wrong_record(device) -> None:
    """The check is the operation's, whatever the strategy says of itself."""
    honest = get("reduce_shuffle")

    def lose_the_last(bench):
        bench.size -= 1
        return honest.build(bench)

    axes = resolve_axes(honest, {"element": "int", "operator": "length_add"})
    liar = replace(honest, build=lose_the_last)
    assert PrimitiveCase(liar, SMALL, axes, 1).run(device, Inputs(), ENVIRONMENT).status == "wrong"
    assert PrimitiveCase(honest, SMALL, axes, 1).run(device, Inputs(), ENVIRONMENT).status == "ok"


def test_what_cannot_run_is_a_row_with_a_reason(device) -> None:
    record = record_of(device, "reduce_shuffle", element="int", operator="momentum_add")
    assert record.status == "skipped"
    assert "particles" in (record.skipped_because or "")
    huge = replace(get("scan_shuffle"), operation=replace(get("scan_shuffle").operation, floor=lambda *_: 2**60))
    record = PrimitiveCase(huge, SMALL, resolve_axes(huge, {}), 1).run(device, Inputs(), ENVIRONMENT)
    assert "GiB" in (record.skipped_because or "")
    with pytest.raises(InputError, match="out of range"):
        record_of(device, "scan_shuffle", size=2**31)


def test_preprocessing_uses_the_best_scan() -> None:
    assert preprocess.lookback.__module__ == get("scan_lookback").build.__module__


# --- a primitive of one's own -----------------------------------------------------------------------------------------

OWN_MODULE = '''"""Reduction as shipped, under a name of its own.

Idea: show that a folder is enough.
"""

from mpmbench.operations.reduce import REDUCE, pyramid
from mpmbench.primitives import Primitive

PRIMITIVE = Primitive(
    name="reduce_own", operation=REDUCE, summary="a user's own", kernel="reduce_own",
    axes={"element": ("int",), "operator": ("identity_add",), "threads": (64,)}, build=pyramid, reference="none",
)
'''


def test_a_folder_adds_a_primitive(tmp_path) -> None:
    (tmp_path / "reduce_own.py").write_text(OWN_MODULE)
    source = get("reduce_shuffle").kernel_path.read_text()
    (tmp_path / "reduce_own.cu").write_text(source.replace("reduce_shuffle", "reduce_own"))
    assert "reduce_own" in [p.name for p in discover([tmp_path])]
    assert "reduce_own" not in [p.name for p in discover()]
    result = CliRunner().invoke(
        main, ["run", "-b", "reduce_own", "--variants", str(tmp_path), "--size", "777", "-d", "simulated"]
    )
    assert result.exit_code == 0, result.output
    assert "1 ok" in result.output
    (tmp_path / "reduce_own.cu").unlink()
    with pytest.raises(InputError, match=r"kernel .* does not exist"):
        discover([tmp_path])


def test_a_name_must_begin_with_its_operation(tmp_path) -> None:
    (tmp_path / "fold_own.py").write_text(OWN_MODULE.replace("reduce_own", "fold_own"))
    with pytest.raises(InputError, match="must begin with its operation"):
        discover([tmp_path])


# --- command line, report, published tables ---------------------------------------------------------------------------


def invoke(*words: object) -> str:
    result = CliRunner().invoke(main, [str(word) for word in words])
    assert result.exit_code == 0, result.output
    return result.output


def test_listed_with_axes_of_every_operation() -> None:
    text = invoke("list")
    for words in ("Primitives", "Axes of reduce", "Axes of scan", "Axes of map", "scan_lookback"):
        assert words in text


def test_run_check_resume_and_report(tmp_path) -> None:
    rows = tmp_path / "rows.jsonl"
    words = ("-b", "reduce_s*", "-a", "element=[int,float]", "--size", 999, "-d", "simulated", "--json", rows)
    assert "4 ok" in invoke("run", *words)
    before = rows.read_bytes()
    assert "4 ok" in invoke("run", *words, "--resume")
    assert rows.read_bytes() == before
    assert "4 ok" in invoke("check", *words[:-2])
    records = read_records(rows)
    for text in (markdown_text(records), html_text(records)):
        assert "Reduce of 999 elements" in text
        assert "bytes / floor" in text
        assert "Datasets: density" not in text


def test_by_default_transfers_run_alone() -> None:
    text = invoke("run", "--dry-run", "-d", "simulated")
    assert not any(name in text for name in NAMES)


def test_thesis_rows_run_with_their_printed_figures(device) -> None:
    cases = [case for case in preset("thesis") if isinstance(case, PrimitiveCase)]
    assert len(cases) == sum(len(published_rows(table)) for table in PRIMITIVE_TABLES)
    for case in cases:
        assert case.preset_row is not None
        assert why_impossible(case.primitive, case.axes) is None, case.title
        assert case.shrunk(size=10).preset_row is None
    first = replace(cases[0], size=SMALL).run(device, Inputs(), ENVIRONMENT)
    assert first.status == "ok"
    assert first.preset_row is not None
    assert (first.preset_row["table"], first.preset_row["published_us"]) == (5, 243.0)
    assert "Thesis, table 5" in markdown_text([first])


@pytest.mark.parametrize("table", [5, 6, 7, 8])
def test_printed_speedups_follow_from_printed_times(table: int) -> None:
    """Or an erratum says that they do not. A speedup may be rounded or cut off to its last printed digit."""
    rows = published_rows(table)
    base = float(rows[0]["time_us"])
    for row in rows[1:]:
        digits = len(row["speedup"].partition(".")[2])
        agrees = np.isclose(float(row["speedup"]), base / float(row["time_us"]), rtol=0, atol=0.5001 * 10**-digits)
        assert agrees == (not row["erratum"]), row


def test_operations_are_written_down_once() -> None:
    """Strategies of one operation share its inputs, reference and floor by being given the same object."""
    found: dict[str, Operation] = {}
    for primitive in PRIMITIVES:
        assert found.setdefault(primitive.operation.name, primitive.operation) is primitive.operation
    assert {"map", "reduce", "scan", "block_scan"} <= set(found)
    assert primitives.get("reduce_shuffle").operation.summary
