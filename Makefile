# One word per task. Needs make, python3 (3.12 or newer, with venv) and a package index; installs everything else from
# requirements.lock into .venv, and for the documentation from docs.lock into .venv-docs.
PYTHON ?= python3
VENV := .venv
DOCS := .venv-docs
BIN := $(VENV)/bin
PIP := pip --disable-pip-version-check --quiet
COMPILE := .uv/bin/uv pip compile pyproject.toml --universal --upgrade --generate-hashes --no-annotate --no-header \
  --no-emit-index-url --quiet
PYTEST := $(BIN)/python -m pytest -n 2 --dist worksteal --durations 10 --durations-min 0.1
OUT ?= demo
SAMPLE ?= 300
MODULES ?= recon calib rig/session rig/capture rig/stages

SHELL := bash
# Without stored byte code, each command that a test starts compiles all sources again.
unexport PYTHONDONTWRITEBYTECODE
TIMEFORMAT = %R s elapsed, %U s + %S s of CPU (budget of all quick tests: 180 s, 330 s of CPU; CONTRIBUTING.md)

.PHONY: demo test deep lint bench mutants docs results lock clean help

help: ## list the tasks
	@grep -E '^[a-z%-]+:.*##' Makefile | sed -E 's/:[^#]*##/\t/' | expand -t 8

# Capturing needs one core and no kernel: meanwhile the other compiles them.
demo: $(VENV)/installed ## the whole experiment, simulated; the last line is the path of its report
	@$(MAKE) -s $(VENV)/compiled & $(BIN)/faintfield demo $(OUT); made=$$?; wait; exit $$made

test: $(VENV)/compiled-float64 ## the quick tests, on two cores
	@TIMEFORMAT='$(TIMEFORMAT)'; time $(PYTEST)

test-%: $(VENV)/compiled-float64 ## those of one folder: make test-rig, -calib, -recon, -pipelines, -end_to_end, -faults
	@TIMEFORMAT='$(TIMEFORMAT)'; time $(PYTEST) tests/$*

deep: $(VENV)/compiled-float64 ## damaged files, kills, full demo, mutants, installs: an hour, before a release; one of them: STAGES=mutants
	.ci/deep $(STAGES)

lint: $(VENV)/installed ## style, types and import contracts
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: $(VENV)/compiled build/bench ## speed against peers, as ratios; docs/benchmarks.md keeps the last result
	PYTHONPATH=build/bench $(BIN)/python -m benchmarks --keep docs/benchmarks.md

mutants: $(VENV)/compiled-float64 ## wrong changes of the sources, and how many the tests find: SAMPLE=300 MODULES="recon calib"
	$(BIN)/python -m tests.mutants $(MODULES) --sample $(SAMPLE)

# Packages that only the benchmarks compare with stay out of .venv.
build/bench:
	$(BIN)/$(PIP) install --no-deps --target $@ 'pyproximal>=0.10' 'odl>=1.0' \
	  array-api-compat future || mkdir -p $@

docs: $(DOCS)/installed ## the site of the documentation: build/docs/index.html
	$(DOCS)/bin/python -c 'from faintfield.recon import compile_kernels; compile_kernels()'
	PATH="$(CURDIR)/$(DOCS)/bin:$$PATH" $(DOCS)/bin/python -m sphinx -E -W --keep-going -q docs build/docs

results: $(VENV)/installed ## the demo's figures and pictures, put into docs and the paper; needs Chromium
	$(BIN)/faintfield demo $(OUT)
	$(BIN)/python docs/collect_results.py $(OUT)
	PYTHONPATH=. $(BIN)/python docs/draw_pictures.py $(OUT)
	PYTHONPATH=. $(BIN)/python docs/draw_capture.py

lock: ## renew requirements.lock and docs.lock from pyproject.toml; they leave out the extras for cameras and napari
	$(PYTHON) -m venv .uv
	.uv/bin/pip --disable-pip-version-check --quiet install uv
	$(COMPILE) --extra cluster --extra zarr --group dev --override overrides.txt -o requirements.lock
	$(COMPILE) --extra notebook --group docs --override overrides.txt --constraint requirements.lock -o docs.lock

clean: ## remove what the tasks made
	find . -name __pycache__ -not -path './$(VENV)/*' -prune -exec rm -rf {} +
	rm -rf $(VENV) $(DOCS) .uv build dist demo *.egg-info .ruff_cache .mypy_cache .pytest_cache .hypothesis .import_linter_cache
	rm -rf docs/reference/names docs/tutorials/gallery docs/tutorials/failures

# uv installs the same packages four times faster than pip; where it cannot reach pip's index, pip does it.
# $(call install,LOCK,ENVIRONMENT)
define install
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 12))' || \
	  { echo "faintfield needs Python 3.12 or newer; $(PYTHON) is $$($(PYTHON) --version 2>&1). Try: make PYTHON=python3.13"; exit 1; }
	$(PYTHON) -m venv --clear $(2)
	@echo "Installing the locked packages into $(2) ..."
	sed -n '/^uv==/,/[^\\]$$/p' requirements.lock > $(2)/uv.lock
	$(2)/bin/$(PIP) install --no-deps --no-compile --require-hashes -r $(2)/uv.lock
	$(2)/bin/uv pip install --python $(2)/bin/python --quiet --no-deps --require-hashes -r $(1) || \
	  $(2)/bin/$(PIP) install --no-deps --no-compile --require-hashes -r $(1)
	$(2)/bin/$(PIP) install --no-deps --no-build-isolation -e .
	@touch $@
endef

$(VENV)/installed: requirements.lock pyproject.toml
	$(call install,requirements.lock,$(VENV))

$(DOCS)/installed: docs.lock pyproject.toml
	$(call install,docs.lock,$(DOCS))

# numba compiles a file again when that file changes, but not when a file changes whose functions it calls.
$(VENV)/compiled: $(VENV)/installed $(wildcard recon/*.py recon/*/*.py)
	@echo "Compiling the kernels ..."
	find recon -name '*.nb[ci]' -delete
	$(BIN)/python -c 'from faintfield.recon import compile_kernels; compile_kernels()'
	@touch $@

# Tests compare in double precision, which no command uses.
$(VENV)/compiled-float64: $(VENV)/compiled
	$(BIN)/python -c 'from faintfield.recon import compile_kernels; compile_kernels("float64")'
	@touch $@
