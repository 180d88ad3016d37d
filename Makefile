# Everything happens in .venv; `make demo` and `make test` set it up first.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP_INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint requirements.lock

.PHONY: setup demo test lint bench docs site

setup: $(VENV)/.installed
	tools/ensure_runtime.sh $(BIN)/python

demo: setup
	$(BIN)/calibray demo

test: setup
	$(BIN)/python -m pytest --numprocesses auto --maxprocesses 4 --dist loadfile --doctest-modules src tests

# What builds the pages is checked too, against the packages that it calls.
lint: $(VENV)/.lint $(VENV)/.docs
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/pyright

bench: setup
	$(BIN)/python benchmarks/replay.py
	$(BIN)/python benchmarks/interactions.py
	$(BIN)/python benchmarks/nuisance.py
	$(BIN)/python benchmarks/diffuse.py
	$(BIN)/python benchmarks/launches.py
	$(BIN)/python benchmarks/time_to_result.py
	$(BIN)/python benchmarks/chunks.py speed-up --links 800
	$(BIN)/python benchmarks/chunks.py links --chunks 10 100
	$(BIN)/python benchmarks/chunks.py city --samples auto

docs: setup site
	$(BIN)/python tools/check_docs.py
	$(BIN)/python tools/run_docs.py

# Fails on a link that leads nowhere; nothing is fetched, and the pages load nothing from elsewhere.
site: $(VENV)/.docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

# The stamps keep a second run from installing again unless the packages asked for have changed.
$(VENV)/.installed: pyproject.toml requirements.lock
	tools/make_venv.sh $(PYTHON) $(VENV)
	@echo "Installing Calibray and its packages into $(VENV), some minutes the first time"
	$(PIP_INSTALL) --editable '.[test]'
	@touch $@

$(VENV)/.docs: $(VENV)/.installed
	$(PIP_INSTALL) --editable '.[docs]'
	@touch $@

$(VENV)/.lint: $(VENV)/.installed
	$(PIP_INSTALL) --editable '.[lint]'
	@touch $@
