# `make repro` and `make test` are all that a fresh clone needs. Both can be run again at any time.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
export PATH := $(CURDIR)/$(BIN):$(PATH)
# Stages and tests start many processes. Without bytecode on disk, each of them would compile polarnet anew.
export PYTHONDONTWRITEBYTECODE =

.PHONY: help setup repro scenes kernels trained beside test lint docs smoke clean

help:
	@echo "make repro   set up and run the whole pipeline; the page is data/report/index.html"
	@echo "make test    set up and run the tests"
	@echo "make lint    ruff, mypy, import-linter, tables up to date"
	@echo "make docs    the documentation site, in outputs/site"
	@echo "make smoke   the pipeline at CI size, in outputs/run/smoke"
	@echo "make clean   remove the virtual environment and caches (data/ stays)"

setup: $(READY)

$(READY): pyproject.toml constraints.txt .ci/lpips.txt .ci/setup
	@.ci/setup "$(PYTHON)" "$(VENV)"
	@touch $(READY)

# The same as `dvc repro`, with pairs of tasks side by side where each leaves a core idle. Lines of the second trainings
# start with `beside:`.
repro: setup
	$(MAKE) --no-print-directory --jobs=2 scenes kernels
	dvc repro emulate weights
	$(MAKE) --no-print-directory --jobs=2 trained beside
	dvc repro

scenes:
	dvc repro synthesize

kernels:
	test -e data/events.zarr || python -m stages.kernels

trained:
	dvc --wait-for-lock repro --single-item train

beside: SHELL := bash
beside: .SHELLFLAGS := -o pipefail -c
beside:
	dvc --wait-for-lock repro --single-item train_baseline import_recordings calibrate sets emulate_rotating \
		2>&1 | sed -u 's/^/beside: /'

test: setup
	python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

lint: setup
	ruff check .
	ruff format --check .
	mypy
	lint-imports
	python -m studies.docs --check

docs: setup
	NO_MKDOCS_2_WARNING=1 mkdocs build

smoke: setup
	polarnet run experiment=smoke

clean:
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis build *.egg-info
