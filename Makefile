# Two commands are enough: `make demo` runs the main job and leaves a report, `make test` passes the tests.
# Everything they need is installed into .venv; PYTHON picks the interpreter (3.11 or later).
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin

.DEFAULT_GOAL := help
.PHONY: help demo test test-all bench lint clean

help:
	@echo "make demo      run every strategy on three datasets, leave reports/demo/report.html, and modelled on two GPUs gpus.html"
	@echo "make test      install and run the tests, the linter and the type checker (some 12 minutes the first time)"
	@echo "make test-all  the full product of axes on top; resumable"
	@echo "make bench     engine against native CPU code, NVIDIA Warp and Taichi (CPU wall clock)"

# The stamp makes a second call start at once; it is renewed when pyproject.toml changes.
$(VENV)/.installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[test]'
	@touch $@

demo: $(VENV)/.installed
	$(BIN)/mpmbench run --preset demo --json reports/demo/records.jsonl --html reports/demo/report.html --md reports/demo/report.md
	$(BIN)/mpmbench run --gpu h100,rtx4090 --dataset random --dataset uniform_cube --particles 200_000 --json reports/demo/gpus.jsonl --html reports/demo/gpus.html

lint: $(VENV)/.installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

test: lint
	$(BIN)/python -m pytest -n auto --dist worksteal -m "not slow" $(PYTEST_ARGS)

test-all: lint
	$(BIN)/python -m pytest -n auto --dist worksteal $(PYTEST_ARGS)

bench: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[peers]'
	$(BIN)/python benchmarks/engine_vs_cpu.py
	$(BIN)/python benchmarks/compile_and_count.py

clean:
	rm -rf $(VENV) build dist *.egg-info
