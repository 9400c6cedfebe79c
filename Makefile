# Two commands do everything, set-up included: `make run` and `make test`.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
TASK ?= navigation
PRESET ?= cpu
SEED ?= 0
# More settings for the recipe, e.g. `make run ARGS="planner.num_candidates=500"`.
ARGS ?=

# Threads that wait must not burn the cores that others compute on.
export OMP_WAIT_POLICY = passive

.PHONY: help run test soak smoke lint types docs package check lock clean

help:
	@echo "make run    train LS3 on Navigation from pixels; pictures and figures land in runs/"
	@echo "            (TASK=navigation PRESET=cpu|paper|smoke SEED=0 ARGS='key=value ...')"
	@echo "make test   install what the tests need and run them"
	@echo "make soak   the long form of the tests of reliability: kill, signals, full disks, memory; about an hour"
	@echo "make docs   build the documentation site in build/docs; a warning is an error"
	@echo "make check  package, tests, lint, format, types, docs and the smoke recipe: what CI runs"
	@echo "make lock   write constraints.txt anew from this environment"

$(VENV)/run.installed: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(0 if v >= (3, 11) else f"Python 3.11 or newer is needed, {v.major}.{v.minor} was found; try make PYTHON=python3.12")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[recipes]'
	@touch $@

$(VENV)/test.installed: $(VENV)/run.installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[recipes,dev]'
	@touch $@

run: $(VENV)/run.installed
	$(BIN)/python recipes/ls3.py task=$(TASK) preset=$(PRESET) seed=$(SEED) $(ARGS)

test: $(VENV)/test.installed
	$(BIN)/python -m pytest -n auto --maxprocesses 4 --dist worksteal

soak: $(VENV)/test.installed
	$(BIN)/python -m pytest tests/reliability tests/trainers/test_checkpoints.py --soak -s -p no:cacheprovider

lint: $(VENV)/test.installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/test.installed
	$(BIN)/mypy

docs: $(VENV)/test.installed
	$(BIN)/python -m sphinx --fresh-env --fail-on-warning --keep-going --quiet --builder html docs build/docs

smoke: $(VENV)/run.installed
	$(BIN)/python recipes/ls3.py preset=smoke

package:
	PYTHON=$(PYTHON) .ci/package

check: package test lint types docs smoke

lock: $(VENV)/test.installed
	$(BIN)/python -m pip freeze --exclude-editable > constraints.txt

clean:
	rm -rf $(VENV) build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache
