# Everything happens in .venv; `make demo` and `make test` set it up first.

PYTHON ?= python3
NEWEST ?= python3.13
VENV := .venv
BIN := $(VENV)/bin
PIP_INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint requirements.lock

QUICK := tests/measurements tests/optimizers tests/parameters tests/result tests/test_tables.py tests/test_public_api.py tests/comparison/test_comparison.py

.PHONY: setup demo test quick lint package lowest newest bench docs site

setup: $(VENV)/.installed
	tools/ensure_runtime.sh $(BIN)/python

demo: setup
	$(BIN)/calibray demo

test: setup
	$(BIN)/python -m pytest --numprocesses auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder --doctest-modules src tests

# The tests that trace little, in about 90 seconds.
quick: setup
	$(BIN)/python -m pytest --numprocesses auto --maxprocesses 4 --dist loadfile -q $(QUICK)

# The lowest versions that pyproject.toml allows, whose warnings are those of their time, and the newest versions with
# the newest Python.
lowest:
	tools/make_venv.sh $(PYTHON) .venv-lowest
	$(PYTHON) tools/lowest.py test > .venv-lowest/constraints.txt
	.venv-lowest/bin/pip install --quiet --constraint .venv-lowest/constraints.txt --editable '.[test]'
	.venv-lowest/bin/python -m pytest --numprocesses auto --dist loadfile -q -W ignore $(QUICK)

newest:
	@$(NEWEST) --version || { echo "newest: '$(NEWEST)' does not run; name a newer Python: make newest NEWEST=PATH" >&2; exit 1; }
	tools/make_venv.sh $(NEWEST) .venv-newest
	.venv-newest/bin/pip install --quiet --upgrade --upgrade-strategy eager --editable '.[test]'
	.venv-newest/bin/python -m pytest --numprocesses auto --dist loadfile -q $(QUICK)

# The built package, installed into a fresh environment, runs the demo.
package: setup
	tools/check_package.sh $(BIN)/python

# What builds the pages is checked too, against the packages that it calls.
lint: $(VENV)/.checks
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
site: $(VENV)/.checks
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

# The stamps keep a second run from installing again unless the packages asked for have changed.
$(VENV)/.installed: pyproject.toml requirements.lock
	tools/make_venv.sh $(PYTHON) $(VENV)
	@echo "Installing Calibray and its packages into $(VENV), some minutes the first time"
	$(PIP_INSTALL) --editable '.[test]'
	@touch $@

$(VENV)/.checks: $(VENV)/.installed
	$(PIP_INSTALL) --editable '.[docs,lint]'
	@touch $@
