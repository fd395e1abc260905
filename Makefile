# Everything runs in the project's own environment, .venv, made from Python >= 3.11, this file and .ci/install.
# TORCH_INDEX: index to take torch from, e.g. make run TORCH_INDEX=ADDRESS; without it uv picks the build (see below)
# PYTHON:      the interpreter that makes the environment, when the first one found is not the one wanted.
# ARGS:        passed on by `make run` (to `ethbrake run`), `make test` (to pytest) and the long programmes.
# NAME:        of the programme that `make programme` runs.
# WORKERS:     processes of `make test`. 0: one process, as a debugger needs.

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
NAME ?=
INSTALL := sh .ci/install $(VENV)
# uv compiles nothing (all of it would take 48 CPU-s). Python compiles what it imports, once, unless this is passed on.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help venv run test core lint docs figures programme clean

help:
	@echo "make venv             the environment alone: $(VENV)"
	@echo "make run [ARGS=...]   train, evaluate and report in runs/ (ethbrake run)"
	@echo "make core [ARGS=...]   a copy without any extension passes the core's tests, trains, evaluates and shields"
	@echo "make test [ARGS=...]  the test suite, without the tests marked slow or long (.ci/run runs the slow ones, too)"
	@echo "make lint             ruff, ruff format --check, mypy --strict, deptry, import-linter"
	@echo "make docs             the documentation site, its notebooks run: docs/_build/html; a warning is an error"
	@echo "make figures          the printed blocks, tables and pictures of README and docs made again and compared (minutes)"
	@echo "make programme NAME=NAME [ARGS=...]  a long programme (python -m tests.programmes); without a name they are listed"
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

core: $(STAMP)
	@echo "== the core without any extension"
	@$(PROGRAMME) core $(ARGS)

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

programme: $(STAMP)
	@$(if $(filter cluster,$(NAME)),$(INSTALL) -e ".[cluster]",:)
	@$(if $(filter proofs,$(NAME)),NUMBA_DISABLE_JIT=1) $(PROGRAMME) $(NAME) $(ARGS)

clean:
	rm -rf $(VENV) .venvs .pytest_cache .ruff_cache .mypy_cache .hypothesis build dist docs/_build
	find ethbrake_marl tests train docs -name __pycache__ -type d -prune -exec rm -rf {} +
