PYTHON ?= python3
BIN := .venv/bin
CORE := .venv/.installed-core
DEV := .venv/.installed-dev
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check
RUN := runs/foam_cylinder
# A test process has a core of its own; more threads would take turns.
ALONE := COLLOCATION_SYSID_THREADS=1 OMP_NUM_THREADS=1

TRIED := build/tried

.PHONY: help solve test test-quick test-long test-dependencies corpus check bench docs dist clean

help: ## list these targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-17s %s\n", $$1, $$2 }' Makefile

solve: $(CORE) ## identify the foam cylinder's parameters
	@$(BIN)/collocation-sysid solve problems/foam_cylinder/recording.toml --out $(RUN)
	@echo "Plots, result.json and ParaView frames are in $(RUN)/"

# Tests of a test process; the slowest of them are printed.
PYTEST := $(ALONE) $(BIN)/python -m pytest -n auto --dist worksteal --durations 10 --durations-min 1

test: $(DEV) ## run the tests
	@$(PYTEST)

test-quick: $(DEV) ## run the tests of bodies, recordings and parameters, and of the structure: about a minute
	@$(PYTEST) tests/fem tests/recording tests/model tests/common tests/project/test_architecture.py

test-long: $(DEV) ## run whole runs, the notebook and the gallery
	@$(PYTEST) -m "long and not slow"

test-dependencies: ## run the tests with the lowest dependencies, and with the newest
	@mkdir -p build && $(PYTHON) scripts lowest_dependencies > build/lowest.txt && : > build/newest.txt
	@for which in lowest newest; do \
	  echo "With the $$which dependencies" && rm -rf build/$$which && $(PYTHON) -m venv build/$$which && \
	  build/$$which/bin/python -m pip install --quiet --disable-pip-version-check --upgrade \
	    -c build/$$which.txt -e '.[test]' && \
	  $(ALONE) build/$$which/bin/python -m pytest -n auto --dist loadfile || exit 1; \
	done

corpus: $(DEV) ## solve the recordings with known truth; CORPUS has the options of the script
	@$(BIN)/python scripts corpus $(CORPUS)

check: $(DEV) ## lint, formatting and types
	@$(BIN)/ruff check
	@$(BIN)/ruff format --check
	@$(BIN)/pyright --pythonpath $(BIN)/python

bench: $(CORE) ## time the constraint Jacobian
	@$(BIN)/python scripts benchmark_jacobian

docs: $(CORE) ## build the documentation's pages
	@$(PIP) -e '.[docs]'
	@echo "Building the pages: some minutes, because the scripts of the gallery are executed"
	@$(BIN)/sphinx-build -b html docs docs/_build/html
	@echo "Open docs/_build/html/index.html"

dist: $(CORE) ## build wheel and sdist, install each afresh, and solve a problem with it
	@$(PIP) build
	@rm -rf dist && $(BIN)/python -m build --outdir dist > /dev/null
	@for file in dist/*.whl dist/*.tar.gz; do \
	  echo "Trying $$file" && rm -rf $(TRIED) && $(PYTHON) -m venv $(TRIED) && \
	  $(TRIED)/bin/python -m pip install --quiet --disable-pip-version-check $$file && \
	  (cd build && tried/bin/collocation-sysid explain trust > /dev/null && \
	    tried/bin/collocation-sysid solve ../problems/foam_cylinder/recording.toml \
	    --out tried/run --quiet > /dev/null) || exit 1; \
	done
	@ls dist/*

clean: ## remove the environment and caches; runs stay
	@rm -rf .venv build dist .pytest_cache .ruff_cache docs/_build docs/generated
	@find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(BIN)/pip:
	@$(PYTHON) -c 'import sys; sys.version_info >= (3, 11) or sys.exit("Python 3.11 or newer is needed, $(PYTHON) is " + sys.version.split()[0] + ": make PYTHON=python3.12 ...")'
	@echo "Creating .venv"
	@$(PYTHON) -m venv --clear .venv

$(CORE): pyproject.toml | $(BIN)/pip
	@echo "Installing collocation-sysid into .venv"
	@$(PIP) -e .
	@touch $@

$(DEV): pyproject.toml | $(BIN)/pip
	@echo "Installing collocation-sysid with the test and development tools into .venv"
	@$(PIP) -e '.[test,dev]'
	@touch $(CORE) $@
