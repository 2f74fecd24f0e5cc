# Copyright 2026 The sfa_localization authors
# SPDX-License-Identifier: Apache-2.0
PYTHON ?= python3
VENV ?= .venv
# More requirements or version limits for pip, such as PINS='numpy==1.26.4'.
PINS ?=
ARGS ?=
# Files of tests run side by side, but not many: each may hold a training in memory.
PARALLEL := --numprocesses logical --maxprocesses 4 --dist loadfile

PY := $(VENV)/bin/python
READY := $(VENV)/.ready

.DEFAULT_GOAL := help
.PHONY: help env demo reproduce study test robustness troubles animation map fuzz soak bench reference lint format colcon matrix clean

help:  ## list the targets
	@awk -F ':.*## ' '/^[a-z]+:.*## / {printf "  make %-11s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

env: $(READY)  ## build the environment alone, in .venv

$(READY): setup.py .ci/env
	PYTHON='$(PYTHON)' VENV='$(VENV)' PINS='$(PINS)' sh .ci/env

demo: $(READY)  ## simulate, train, run the three nodes live, print the errors (about 5 minutes)
	$(PY) -m sfa_localization demo $(ARGS)

reproduce: $(READY)  ## the studies and their pages, test/EVALUATION.md and PAPER.md: hours, which go on where they ended (ARGS=--quick)
	PYTHONPATH=.:test $(PY) -m study all $(ARGS)

study: $(READY)  ## one of these studies, given or half-real bags, or the page (ARGS='baselines --quick'; ARGS=--help)
	PYTHONPATH=.:test $(PY) -m study $(ARGS)

test: $(READY)  ## run the tests, several files at once (ARGS='-k bag' for some of them, '-m study' for those of the studies)
	$(PY) -m pytest $(PARALLEL) -m 'not study' $(ARGS)

robustness: $(READY)  ## run the tests of faults, write their tables, replay a drive with each fault (25 minutes)
	PYTHONPATH=.:test $(PY) -m robustness --page
	$(PY) -m pytest -m robustness $(ARGS)
	PYTHONPATH=.:test $(PY) -m robustness --frozen
	PYTHONPATH=.:test $(PY) -m robustness --live --lights

troubles: $(READY)  ## train on recorded drives with each trouble, print errors and what is said (half an hour)
	PYTHONPATH=.:test $(PY) -m robustness --troubles $(ARGS)

map: $(READY)  ## draw the map of the demo: resource/map.png
	PYTHONPATH=.:test $(PY) -m study.map_picture demo/model.npz demo/test resource/map.png

animation: $(READY)  ## film the nodes of a kidnapped robot, and of one that is taught: resource/*.webp
	PYTHONPATH=.:test $(PY) -m study.animation resource/kidnapped.webp
	PYTHONPATH=.:test $(PY) -m study.teaching resource/teaching.webp

fuzz: $(READY)  ## thousands of damaged messages, models, bags, YAML and image files (ARGS='-k bags')
	FUZZ_INPUTS=10000 $(PY) -m pytest -q test/test_fuzz.py $(ARGS)

soak: $(READY)  ## run the three nodes for an hour at 20x; nothing may grow (ARGS='--seconds 800')
	PYTHONPATH=. $(PY) test/benchmarks/soak.py $(ARGS)

bench: $(READY)  ## speeds beside the last release, on an idle machine; writes the table of test/README.md (ARGS=--quick)
	$(PY) test/benchmarks/bench_all.py $(ARGS)

reference: $(READY)  ## write config/python.md, the reference for programs in Python, from docstrings
	$(PY) .ci/reference

lint: $(READY)  ## ruff, ruff format, mypy, lines of each room beside its budget
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy sfa_localization
	$(PY) .ci/budgets

format: $(READY)  ## sort imports and format the code with ruff
	$(VENV)/bin/ruff check --fix .
	$(VENV)/bin/ruff format .

colcon:  ## colcon build and colcon test in a clean environment
	PYTHON='$(PYTHON)' sh .ci/colcon $(PARALLEL) $(ARGS)

matrix:  ## the tests on NumPy 1.26 with Python 3.12, on the newest NumPy and Python, and with ROS 2 Kilted
	sh .ci/matrix $(ARGS)

clean:  ## remove build results, but not the environment
	rm -rf build install log demo .pytest_cache .mypy_cache .ruff_cache
	find . -name __pycache__ -not -path './.venv/*' -prune -exec rm -rf {} +
