# Everything runs in the project's own environment, .venv. This file and .ci/install make it with Python 3.11 to 3.14.
# TORCH_INDEX: package index for torch, e.g. make run TORCH_INDEX=ADDRESS. Default: uv chooses the build.
# PYTHON:      Python that makes the environment. Default: the first suitable one.
# ARGS:        arguments for `ethbrake run` (make run), pytest (make test) and the programmes.
# NAME:        name of the programme that `make programme` runs.
# WORKERS:     number of processes of `make test`; 0: one process, for a debugger.

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
# uv does not compile the installed files (this would take 48 CPU-s). Python compiles a file when it is first imported, and
# stores the result, unless this variable is set.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help venv run test core lint docs figures programme clean

help:
	@echo "make venv             make only the environment $(VENV)"
	@echo "make run [ARGS=...]   train, evaluate and write a report to runs/ (ethbrake run)"
	@echo "make core [ARGS=...]   check a copy without extensions: tests of the core, training, evaluation, shield"
	@echo "make test [ARGS=...]  run the tests; ARGS=--all also runs the slow ones, as .ci/run does; ARGS='-m nightly' attacks"
	@echo "make lint             check the code: ruff, ruff format --check, mypy --strict, deptry, import-linter"
	@echo "make docs             build the site in docs/_build/html and run its notebooks; a warning is an error"
	@echo "make figures          make blocks, tables and pictures of README and docs again, and compare them (half an hour)"
	@echo "make programme NAME=NAME [ARGS=...]  run a long check (python -m tests.programmes); without NAME list all"
	@echo "make clean            delete $(VENV), .venvs, caches and builds, but not runs/"
	@echo "TORCH_INDEX=URL       package index for torch; default: uv chooses the build for this machine"

venv: $(STAMP)

# The stamp contains the folder of its environment. A copied or moved environment would use the code of the old folder.
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
	  if "$$candidate" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 15))' >/dev/null 2>&1; then \
	    found="$$candidate"; break; \
	  fi; \
	done; \
	if [ -z "$$found" ]; then \
	  echo "error: Python 3.11 to 3.14 is needed; $(or $(PYTHON),python3) gives: $$("$(or $(PYTHON),python3)" --version 2>&1)" >&2; \
	  echo "       Install it, or give its path: make $(firstword $(MAKECMDGOALS)) PYTHON=/path/to/python3.11" >&2; \
	  exit 1; \
	fi; \
	echo "== Using $$("$$found" --version) ($$(command -v "$$found"))"; \
	if ! "$$found" -m venv $(if $(MADE_IN),$(if $(filter $(MADE_IN),$(CURDIR)),,--clear)) $(VENV); then \
	  echo "error: $$found cannot make a virtual environment (on Debian: apt install python3-venv)" >&2; \
	  exit 1; \
	fi
	@echo "== Installing ethbrake_marl"
	@$(INSTALL) -e ".[report]"
	@echo "== Compiling the physics in the background"
	@sh .ci/compile "$(CURDIR)/$(BIN)/ethbrake" evaluate & \
	compiling=$$!; \
	trap "kill $$compiling" INT TERM; \
	echo "== Installing torch$(if $(TORCH_INDEX), from $(TORCH_INDEX),: uv chooses the build for this machine)"; \
	$(INSTALL) --torch "$(TORCH_INDEX)" || exit; \
	echo "== Installing the packages for training and tests, at the versions of constraints.txt"; \
	$(INSTALL) -e ".[train,dev]" || exit; \
	! kill -0 $$compiling 2>/dev/null || echo "== Waiting for the physics to be compiled: a minute or more, only once"; \
	wait $$compiling && sh .ci/compile "$(CURDIR)/$(BIN)/ethbrake" train || \
	  echo "== Some of the physics could not be compiled (see above); commands compile it when they need it" >&2
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
	@echo "== deptry: the imported packages are the required packages"
	@$(BIN)/deptry ethbrake_marl
	@echo "== import-linter: imports only from lower folders, without circles"
	@$(BIN)/lint-imports --no-cache

$(DOCS_STAMP): $(STAMP)
	@echo "== Installing the packages for the site"
	@$(INSTALL) -e ".[docs]"
	@touch $@

docs: $(DOCS_STAMP)
	@echo "== the documentation site"
	@$(BIN)/python -m sphinx -W --keep-going -q -b html -d docs/_build/doctrees docs docs/_build/html $(ARGS)
	@echo "== docs/_build/html/index.html"

figures: $(STAMP)
	@echo "== make the blocks, tables and pictures of the pages again"
	@$(PROGRAMME) figures $(ARGS)

programme: $(STAMP)
	@$(PROGRAMME) $(NAME) $(ARGS)

clean:
	rm -rf $(VENV) .venvs .pytest_cache .ruff_cache .mypy_cache .hypothesis build dist docs/_build
	find ethbrake_marl tests train docs -name __pycache__ -type d -prune -exec rm -rf {} +
