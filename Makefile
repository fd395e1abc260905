# Everything runs in the project's own environment, .venv, made from Python >= 3.11, this file and .ci/install.
# TORCH_INDEX: index to take torch from, e.g. make run TORCH_INDEX=ADDRESS; without it uv picks the build (see below)
# PYTHON:      the interpreter that makes the environment, when the first one found is not the one wanted.
# ARGS:        passed on by `make run` (to `ethbrake run`), `make test` (to pytest) and the long programmes.
# WORKERS:     processes of `make test`. 0: one process, as a debugger needs.
# SEEDS:       of the orders of `make test-order`.

SHELL := /bin/sh
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
DOCS_STAMP := $(VENV)/.docs
PROGRAMME := $(BIN)/python -m tests.programmes
TORCH_INDEX ?=
PYTHON ?=
ARGS ?=
WORKERS ?= 2
SEEDS ?= 1 2 3 4 5 6 7 8 9 10
INSTALL := sh .ci/install $(VENV)
# uv compiles nothing (all of it would take 48 CPU-s). Python compiles what it imports, once, unless this is passed on.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help venv run test lint check clean test-physics test-resume test-shield test-hostile test-light test-order planted-bugs mutation bench-peers test-libraries test-bounds test-machines proofs test-cluster docs dist audit figures

help:
	@echo "make run [ARGS=...]   train, evaluate and report in runs/ (ethbrake run)"
	@echo "make test [ARGS=...]  the test suite, without the tests marked slow or long (.ci/run runs the slow ones, too)"
	@echo "make lint             ruff, ruff format --check, mypy --strict, deptry, import-linter"
	@echo "make check            lint and test"
	@echo "make docs             the documentation site, its notebooks run: docs/_build/html; a warning is an error"
	@echo "make figures          the printed blocks, tables and pictures of README and docs made again and compared (minutes)"
	@echo "make dist             wheel and sdist in dist/, built twice with the same SHA-256"
	@echo "make test-physics     the long programme on the physics: one line per gate"
	@echo "make test-resume      kill trainings at random moments, resume, compare: three lines"
	@echo "make test-shield      try to break the step shield: speed, interference, search, interfaces, bound (three quarters of an hour of one core)"
	@echo "make test-hostile     7,000 files and command lines of strangers: each refused in one line, or in order"
	@echo "make audit            every pinned package with its licence; reported weaknesses where pip-audit is installed"
	@echo "make test-light       install the wheel alone: at most 650 MB, no torch, and its examples run; then the sdist"
	@echo "make test-libraries   train with other people's libraries, each in its own environment below .venvs/, and print the matrix"
	@echo "make proofs           statements about the code that a solver proves, one line each"
	@echo "make test-cluster     a sweep on a Ray cluster of two nodes on this machine, whose workers are killed at random, its driver once"
	@echo "make test-bounds      the tests at the lowest versions that pyproject.toml allows, and at the newest"
	@echo "make test-machines    recorded results again, as on nine older processors: the same bits"
	@echo "make test-order       the suite ten times in random orders and in parallel: no failure"
	@echo "make planted-bugs     plant 164 bugs, each in a copy of the code; each must turn a test red"
	@echo "make mutation [ARGS=] 40 small random changes of each folder: how many turn a test red (ARGS='--folders shield')"
	@echo "make bench-peers      speed beside other simulators, each in its own environment below .venvs/"
	@echo "make venv             the environment alone: $(VENV)"
	@echo "make clean            remove $(VENV), .venvs, caches and builds (runs/ stays)"
	@echo "TORCH_INDEX=URL       take torch from this index; else uv picks the build for this machine"

venv: $(STAMP)

# The stamp holds the folder it was made in: an environment copied or moved along would run the code of the old folder.
MADE_IN := $(shell cat $(STAMP) 2>/dev/null)
ifneq ($(MADE_IN),$(CURDIR))
.PHONY: $(STAMP)
REASON := $(if $(MADE_IN),made in $(MADE_IN),not installed yet)
else
REASON := pyproject.toml or constraints.txt changed
endif

$(STAMP): pyproject.toml constraints.txt
	@echo "== Making the environment $(VENV) ($(REASON))"
	@found=; \
	for candidate in $(if $(PYTHON),"$(PYTHON)",python3 python3.11 python3.12 python3.13 python3.14 python); do \
	  if "$$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1; then \
	    found="$$candidate"; break; \
	  fi; \
	done; \
	if [ -z "$$found" ]; then \
	  echo "error: needs Python 3.11 or newer; $(or $(PYTHON),python3) gives: $$("$(or $(PYTHON),python3)" --version 2>&1)" >&2; \
	  echo "       Install one, or name it: make $(firstword $(MAKECMDGOALS)) PYTHON=/path/to/python3.11" >&2; \
	  exit 1; \
	fi; \
	echo "== Using $$("$$found" --version) ($$(command -v "$$found"))"; \
	if ! "$$found" -m venv $(if $(MADE_IN),$(if $(filter $(MADE_IN),$(CURDIR)),,--clear)) $(VENV); then \
	  echo "error: $$found cannot make a virtual environment (on Debian: apt install python3-venv)" >&2; \
	  exit 1; \
	fi
	@echo "== Installing ethbrake_marl"
	@$(INSTALL) -e .
	@echo "== Compiling the physics, beside the rest of the installation"
	@PYTHONPATH="$(CURDIR)" $(BIN)/python -c "from ethbrake_marl.cli import doctor; raise SystemExit(not doctor.compile_ahead(training=False, run_alone=True)[0])" & \
	compiling=$$!; \
	trap "kill $$compiling" INT TERM; \
	echo "== Installing torch$(if $(TORCH_INDEX), from $(TORCH_INDEX),: uv looks for the build for this machine)"; \
	$(INSTALL) --torch "$(TORCH_INDEX)" || exit; \
	echo "== Installing what it needs to train and to be tested, at the versions of constraints.txt"; \
	$(INSTALL) -e ".[train,dev]" || exit; \
	wait $$compiling || \
	  echo "== not all could be compiled (above): the rest is compiled when it is needed" >&2
	@echo "== torch $$($(BIN)/python -c 'from importlib.metadata import version; print(version("torch"))')"
	@$(BIN)/ethbrake evaluate --help >/dev/null
	@echo "$(CURDIR)" > $@
	@echo "== Environment ready"

run: $(STAMP)
	@echo "== ethbrake run $(ARGS)"
	@$(BIN)/ethbrake run $(ARGS)

test: $(STAMP)
	@echo "== pytest"
	@$(BIN)/python -m pytest -q -n $(WORKERS) --dist worksteal $(ARGS)

lint: $(STAMP)
	@echo "== ruff check"
	@$(BIN)/python -m ruff check .
	@echo "== ruff format --check"
	@$(BIN)/python -m ruff format --check .
	@echo "== mypy --strict"
	@$(BIN)/python -m mypy --strict ethbrake_marl tests/every_public_name.py
	@echo "== deptry: every package that is imported is asked for, and the other way round"
	@$(BIN)/deptry ethbrake_marl
	@echo "== import-linter: imports point down, without a circle"
	@$(BIN)/lint-imports --no-cache

check: lint
	@$(MAKE) --no-print-directory test

$(DOCS_STAMP): $(STAMP)
	@echo "== Installing what builds the site"
	@$(INSTALL) -e ".[docs]"
	@touch $@

docs: $(DOCS_STAMP)
	@echo "== the documentation site"
	@$(BIN)/python -m sphinx -W --keep-going -q -b html -d docs/_build/doctrees docs docs/_build/html $(ARGS)
	@echo "== docs/_build/html/index.html"

figures: $(STAMP)
	@echo "== what the pages show, made again"
	@$(PROGRAMME) figures $(ARGS)

dist: $(STAMP)
	@echo "== wheel and sdist, twice"
	@$(PROGRAMME) wheel --only built $(ARGS)

test-physics: $(STAMP)
	@echo "== long programme on the physics"
	@$(PROGRAMME) physics $(ARGS)

test-resume: $(STAMP)
	@echo "== long programme on resuming: trainings are killed at random moments"
	@$(PROGRAMME) resume $(ARGS)

test-shield: $(STAMP)
	@echo "== trying to break the step shield"
	@$(PROGRAMME) shield $(ARGS)

test-light: $(STAMP)
	@echo "== the wheel alone in an empty environment: size, and what it must do without torch"
	@$(PROGRAMME) wheel --only light $(ARGS)

test-bounds: $(STAMP)
	@echo "== the lowest and the highest versions"
	@$(PROGRAMME) bounds $(ARGS)

test-machines: $(STAMP)
	@echo "== the same bits on other processors"
	@$(PROGRAMME) machines $(ARGS)

test-order: $(STAMP)
	@echo "== the suite in random orders"
	@for seed in $(SEEDS); do \
	  $(BIN)/python -m pytest -q -p randomly -p xdist --randomly-seed=$$seed -n 2 --dist worksteal $(ARGS) || \
	    { echo "== repeat it with SEEDS=$$seed" >&2; exit 1; }; \
	done

test-hostile: $(STAMP)
	@echo "== files that a stranger wrote or a disk damaged"
	@$(PROGRAMME) hostile $(ARGS)

audit: $(STAMP)
	@echo "== what the package stands on"
	@$(PROGRAMME) audit $(ARGS)
	@if [ -x $(BIN)/pip-audit ]; then \
	  $(BIN)/pip-audit --requirement constraints.txt --no-deps --disable-pip --progress-spinner off; \
	else echo "== pip-audit is not installed here: nobody was asked for reported weaknesses"; fi

test-libraries: $(STAMP)
	@echo "== other people's libraries"
	@$(PROGRAMME) libraries $(ARGS)

proofs: $(STAMP)
	@echo "== proofs"
	@NUMBA_DISABLE_JIT=1 $(PROGRAMME) proofs $(ARGS)

test-cluster: $(STAMP)
	@echo "== a sweep on a Ray cluster, disturbed"
	@$(INSTALL) -e ".[cluster]"
	@$(PROGRAMME) cluster $(ARGS)

planted-bugs: $(STAMP)
	@echo "== planted bugs"
	@$(PROGRAMME) faults bugs $(ARGS)

mutation: $(STAMP)
	@echo "== mutation testing"
	@$(PROGRAMME) faults mutants $(ARGS)

bench-peers: $(STAMP)
	@echo "== speed beside other simulators"
	@PYTHONPATH="$(CURDIR)" $(BIN)/python docs/studies/peers.py $(ARGS)

clean:
	rm -rf $(VENV) .venvs .pytest_cache .ruff_cache .mypy_cache .hypothesis build dist docs/_build
	find ethbrake_marl tests train docs -name __pycache__ -type d -prune -exec rm -rf {} +
