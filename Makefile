# Every command of development. `make` alone lists them; settings of the tools are in pyproject.toml.
# PYTHON=/path/to/python chooses the interpreter; otherwise the first one that will do is taken.

SHELL := /bin/sh
.DEFAULT_GOAL := help
PYTHON ?=
BIN := .venv/bin
# Tests of numbers that compiled kernels make.
NUMERIC := $(addprefix tests/test_,rotations.py laws.py motion.py scanning.py rigidity.py identity.py)
RUN := $(BIN)/python -m
PIP := $(RUN) pip --disable-pip-version-check

# A venv cannot be moved: in a copied or renamed tree its stamps do not count.
$(shell [ ! -d .venv ] || [ "$$(cat .venv/.tree 2>/dev/null)" = "$(CURDIR)" ] || rm -f .venv/.demo .venv/.test .venv/.docs)

# Prints the first Python >= 3.11 that can make a venv with pip; else "none", or "venvless NAME".
find_python = $(shell found=none; \
  for p in $(or $(PYTHON),python3 python python3.14 python3.13 python3.12 python3.11); do \
    "$$p" -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1 || continue; \
    if "$$p" -c 'import venv, ensurepip' >/dev/null 2>&1; then found=$$p; break; fi; \
    if [ "$$found" = none ]; then found="venvless $$p"; fi; \
  done; echo "$$found")
no_python = perrin needs Python 3.11 or newer: install it \
  (Debian, Ubuntu: apt install python3 python3-venv; macOS: brew install python; or python.org) \
  or name one that is not on the PATH: make PYTHON=/path/to/python
no_venv = $(1) cannot make virtual environments: install its venv module \
  (Debian, Ubuntu: apt install $(shell $(1) -c \
  'import sys; print("python%d.%d-venv" % sys.version_info[:2])'))
check_python = $(if $(filter none,$(1)),$(error $(no_python)),$(if $(filter venvless,$(1)),$(error $(call no_venv,$(lastword $(1))))))

# $(call make_venv,FOLDER): keeps one that works, replaces one that does not.
venv_works = $(shell $(1)/bin/python -c 'import sys, pip; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo yes)
make_venv = $(if $(call venv_works,$(1)),:,$(call new_venv,$(1),$(find_python)))
new_venv = $(call check_python,$(2))rm -rf $(1); $(2) -m venv $(1) || { echo '$(call no_venv,$(2))' >&2; exit 1; }

.PHONY: help coverage demo faults fuzz fuzz-short mutants test test-numpy test-lowest benchmarks long lint types doctests docs release lock clean

help:  ## list these targets
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/make \1 - \2/p' Makefile | awk -F ' - ' '{printf "%-18s %s\n", $$1, $$2}'

demo: .venv/.demo  ## the main job on an embedded table, into perrin-demo/
	$(BIN)/perrin demo

test: .venv/.test  ## the whole suite, on all cores
	PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 $(RUN) pytest -q -n auto --dist loadfile

coverage:  ## coverage by the suite and the paper: lines at least 95 %, branches 90 %
	@$(call make_venv,.venv-coverage)
	.venv-coverage/bin/python -m pip install --quiet --disable-pip-version-check --no-deps --require-hashes \
	  -r requirements/test.lock
	.venv-coverage/bin/python -m pip install --quiet --disable-pip-version-check -e '.[formats]'
	OMP_NUM_THREADS=1 .venv-coverage/bin/python -m pytest -q -n 2 --dist loadfile --cov --cov-report=
	OMP_NUM_THREADS=1 .venv-coverage/bin/coverage run benchmarks/paper.py
	.venv-coverage/bin/coverage combine --quiet --append
	.venv-coverage/bin/coverage report --skip-covered
	.venv-coverage/bin/coverage json -q -o - | .venv-coverage/bin/python tests/coverage_limits.py

test-numpy: .venv/.test  ## the numeric tests again, without the compiled kernels
	PERRIN_COMPILED=0 OMP_NUM_THREADS=1 $(RUN) pytest -q -n auto --dist loadfile $(NUMERIC)

faults: .venv/.test  ## stopped and broken runs: kills, signals, full disks, two at a time (3 minutes)
	OMP_NUM_THREADS=1 $(RUN) pytest -q -m faults -n 2 --dist load tests/faults

SECONDS ?= 3600
fuzz: .venv/.test  ## damaged files of all formats, an hour (SECONDS=...); faults become seeds
	OMP_NUM_THREADS=1 $(BIN)/python tests/fuzz/run.py --seconds $(SECONDS) --jobs 2

fuzz-short: .venv/.test  ## the same for a minute
	OMP_NUM_THREADS=1 $(RUN) pytest -q -m fuzz tests/fuzz

mutants: .venv/.test  ## small changes of the source of which tests must notice 90 % (hours)
	nice -n 5 $(BIN)/python tests/mutants/run.py

test-lowest:  ## the suite on the oldest dependencies allowed (Python 3.11)
	@$(call make_venv,.venv-lowest)
	.venv-lowest/bin/python -m pip install --quiet --disable-pip-version-check \
	  -r requirements/lowest.txt $$(sed -nE 's/^((pytest|hypothesis)==[^ ]+).*/\1/p' requirements/test.lock)
	.venv-lowest/bin/python -m pip install --quiet --disable-pip-version-check --no-deps -e .
	.venv-lowest/bin/python -m pytest -q

benchmarks: .venv/.test  ## the quick benchmarks: coverage of intervals, warnings, the paper's claims
	$(BIN)/python benchmarks/intervals.py --quick
	$(BIN)/python benchmarks/alarms.py --quick --jobs 2
	$(BIN)/python benchmarks/motion.py --quick --jobs 2
	$(BIN)/python benchmarks/paper.py
	$(BIN)/python benchmarks/study_coverage.py --quick
	$(BIN)/python benchmarks/study.py --quick
	$(BIN)/python benchmarks/structure.py
	OMP_NUM_THREADS=1 $(BIN)/python benchmarks/peers.py --quick

long: .venv/.test  ## the Monte-Carlo tests with all repeats, and 40 tables of every warning (hours)
	OMP_NUM_THREADS=1 $(RUN) pytest -q --long -n auto --dist loadfile tests docs/test_pages.py
	$(BIN)/python benchmarks/intervals.py
	$(BIN)/python benchmarks/alarms.py --repeats 40 --jobs 2
	$(BIN)/python benchmarks/motion.py --jobs 2
	$(BIN)/python benchmarks/motion_models.py
	$(BIN)/python benchmarks/motion_switching.py
	$(BIN)/python benchmarks/motion_correlation.py
	$(BIN)/python benchmarks/motion_dense.py
	$(BIN)/python benchmarks/study_coverage.py
	$(BIN)/python benchmarks/study.py

lint: .venv/.test  ## ruff: rules and format
	$(RUN) ruff check .
	$(RUN) ruff format --check .

types: .venv/.test  ## mypy --strict on src
	$(RUN) mypy

doctests: .venv/.test  ## the examples in the docstrings, and the code of all pages
	$(RUN) pytest --doctest-modules src/perrin docs/test_pages.py -q -n auto

docs: .venv/.docs  ## the documentation with its gallery, into docs/_build/html
	OMP_NUM_THREADS=1 $(RUN) sphinx -W --keep-going -q -j 2 -d docs/_build/doctrees -b html docs docs/_build/html
	@echo 'The documentation is in file://$(CURDIR)/docs/_build/html/index.html'

release: .venv/.demo  ## wheel and sdist, checked and installed into an empty environment
	sh requirements/release.sh

lock:  ## resolve the dependencies of pyproject.toml anew into requirements/
	@$(call make_venv,.venv-lock)
	.venv-lock/bin/python -m pip install --quiet --disable-pip-version-check uv
	UV=.venv-lock/bin/uv sh requirements/lock.sh

clean:  ## remove what was installed and built, demo output included
	rm -rf .venv .venv-coverage .venv-lowest .venv-lock dist docs/_build perrin-demo
	rm -rf docs/gallery docs/tutorials/examples docs/reference/python docs/reference/backreferences
	rm -rf .coverage .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find src tests -name __pycache__ -type d -prune -exec rm -rf {} +

# The locks are complete, so pip resolves nothing; `pip check` would show a gap.
.venv/.demo: requirements/demo.lock pyproject.toml hatch_build.py src/perrin/compiled/kernels.c
	@$(call make_venv,.venv)
	@echo 'Installing locked versions into .venv (once; a minute or two)'
	@$(PIP) install --quiet --no-deps --require-hashes -r requirements/demo.lock
	@$(PIP) install --quiet --no-deps --no-build-isolation -e .
	@$(PIP) --quiet check
	@$(BIN)/python -c 'from perrin.compiled import kernels_in_use; print("Compiled kernels:", kernels_in_use())'
	@printf '%s' "$(CURDIR)" > .venv/.tree
	@touch $@

.venv/.test .venv/.docs: .venv/.%: requirements/%.lock .venv/.demo
	@echo 'Installing $< into .venv'
	@$(PIP) install --quiet --no-deps --require-hashes -r $<
	@$(PIP) --quiet check
	@touch $@
