# `make repro` and `make test` are all that a fresh clone needs. Both can be run again at any time.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
export PATH := $(CURDIR)/$(BIN):$(PATH)

.PHONY: help setup repro test thorough lint docs clean

help:
	@echo "make repro     set up and run the whole pipeline; the page is data/report/index.html"
	@echo "make test      set up and run the tests"
	@echo "make thorough  the slow tests that make test leaves out"
	@echo "make lint      ruff, mypy, import-linter, tables up to date"
	@echo "make docs      the documentation site, in outputs/site"
	@echo "make clean     remove the virtual environment and caches (data/ stays)"

setup: $(READY)

$(READY): pyproject.toml constraints.txt .ci/lpips.txt .ci/setup
	@.ci/setup "$(PYTHON)" "$(VENV)"
	@touch $(READY)

repro: setup
	dvc repro

# Tests start many processes. Without bytecode on disk, each of them would compile polarnet anew.
test thorough: export PYTHONDONTWRITEBYTECODE =
test: setup
	python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

thorough: setup
	python -m pytest -n 2 --dist loadfile --no-loadscope-reorder -m thorough

lint: setup
	ruff check .
	ruff format --check .
	mypy
	lint-imports
	python -m studies.docs --check

docs: setup
	NO_MKDOCS_2_WARNING=1 mkdocs build

clean:
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis build *.egg-info
