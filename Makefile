# The two commands a newcomer needs: `make demo` and `make test`. Both set everything up first.
# A Python of 3.11 or newer and make are all that must be there; PYTHON=... picks another interpreter.

# What pip may look at besides PyPI. On Linux PyPI's PyTorch is the CUDA build, gigabytes of it; the CPU build comes with
#   make install TORCH_INDEX=https://download.pytorch.org/whl/cpu
TORCH_INDEX ?=
PIP_INSTALL = $(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt $(if $(TORCH_INDEX),--extra-index-url $(TORCH_INDEX))
PYTHON ?= $(shell for p in python3.11 python3.12 python3.13 python3 python; do \
  $$p -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && { echo $$p; break; }; done)
BIN := .venv/bin
PYTEST = $(BIN)/pytest -n auto --dist loadfile --no-loadscope-reorder

.PHONY: help install demo paper test pytest check lint bench soak load screenshots clean

help: ## this list
	@grep -hE '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*## /\t/' | expand -t 10

install: .venv/.installed ## .venv with the service, the client and the tools from constraints.txt

.venv/.installed: pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "No Python 3.11 or newer with venv found; install one, or name it: make PYTHON=/path/to/python $(MAKECMDGOALS)" >&2; exit 1; }
	$(PYTHON) -m venv --clear .venv
	@echo "Installing the service, the client, PyTorch and the tools of constraints.txt into .venv: about 0.6 GB to download and 1.8 GB on the disk with PyTorch's CPU build, 4 and 8 GB with CUDA's," >&2
	@echo "which is what pip takes on Linux unless told: make $(or $(MAKECMDGOALS),install) TORCH_INDEX=https://download.pytorch.org/whl/cpu" >&2
	$(PIP_INSTALL) --editable '.[dev]'
	@touch $@

demo: install ## renders a campus, maps it, localizes a drive of another season against a live server
	@$(BIN)/python -m deepsimbad_client.commands.demo

paper: install ## renders four seasons of a campus and runs the paper's section III on them, 18 minutes on two cores
	@$(BIN)/python -m deepsimbad_campus paper-output/campus --frames 1500 --spacing-m 0.5 >&2
	@$(BIN)/deepsimbad experiment paper --nclt paper-output/campus --out paper-output

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

check: lint ## every check but the slow ones
	$(PYTEST) -m "not slow"

test: install ## every check
	@$(MAKE) --no-print-directory -j2 lint pytest

pytest: install
	$(PYTEST)

bench: install ## the benchmark tables under docs/results/
	$(PIP_INSTALL) --editable '.[bench]'
	$(BIN)/python -m bench

soak: install ## kills the service 200 times under load and looks for what it acknowledged: docs/results/soak.md
	$(BIN)/python -m bench.soak --out docs/results/soak.md

load: install ## an hour of 20 robots with remaps and rollbacks: docs/results/load.md
	$(BIN)/python -m bench.load --out docs/results/load.md

screenshots: install ## pictures of the console before a rendered campus, for README: docs/images
	$(BIN)/python -m tests.browser.screenshots

clean: ## removes what the other targets made
	rm -rf .venv demo-output paper-output .mypy_cache .ruff_cache .pytest_cache .import_linter_cache
