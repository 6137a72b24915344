# make demo   the whole pipeline at its smallest: a report to look at in runs/demo
# make test   lint, types and tests
# Everything is installed into .venv; nothing outside this folder is touched.
PYTHON ?= python3
VENV ?= .venv
DEMO_ARGS ?= --preset quick --out runs/demo
BENCH_ARGS ?=
PYTEST_ARGS ?=
FAULTS_ARGS ?=
TEST_JOBS ?= 2

BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check

.DEFAULT_GOAL := help
.PHONY: help demo test test-long test-playground lint faults bench clean

help:
	@sed -n 's/^# make/make/p' Makefile
	@echo "make test-long  what \`make test\` leaves out because it takes long: killed processes above all"
	@echo "make test-playground  the tests of the MuJoCo Playground adapter, with Playground itself"
	@echo "make lint   ruff and mypy only"
	@echo "make faults kills, damages and fills whatever can be, and writes docs/reliability.md"
	@echo "make bench  speed, side by side with other packages (BENCH_ARGS=\"render\")"
	@echo "make clean  remove .venv, builds and caches (never runs/)"

# Stamps: reinstall only when the dependencies may have changed.
$(BIN)/python:
	@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; ok = (3, 11) <= v <= (3, 13); \
	  sys.exit(None if ok else "palm_jax needs Python 3.11 to 3.13, $(PYTHON) is %d.%d: " \
	  "call make with PYTHON=python3.12" % v)'
	$(PYTHON) -m venv $(VENV)

$(VENV)/.base: $(BIN)/python pyproject.toml
	$(PIP) install --quiet -e .
	@touch $@

$(VENV)/.test: $(BIN)/python pyproject.toml
	$(PIP) install --quiet -e '.[test]'
	@touch $@ $(VENV)/.base

$(VENV)/.playground: $(BIN)/python pyproject.toml
	$(PIP) install --quiet -e '.[test,playground]'
	@touch $@ $(VENV)/.test $(VENV)/.base

$(VENV)/.bench: $(BIN)/python pyproject.toml
	$(PIP) install --quiet -e '.[bench]'
	@touch $@ $(VENV)/.base

# Large pages: a fifth faster with glibc, without effect elsewhere (docs/performance.md).
demo: export GLIBC_TUNABLES ?= glibc.malloc.hugetlb=1
demo: $(VENV)/.base
	$(BIN)/python -m palm_jax.train $(DEMO_ARGS)

lint: $(VENV)/.test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy -p palm_jax

test: lint
	$(BIN)/python -m pytest --numprocesses $(TEST_JOBS) --dist loadscope $(PYTEST_ARGS)

test-long: $(VENV)/.test
	$(BIN)/python -m pytest -m long --numprocesses $(TEST_JOBS) $(PYTEST_ARGS)

# The import comes first because the tests skip themselves without the package.
test-playground: $(VENV)/.playground
	$(BIN)/python -c 'import mujoco_playground'
	$(BIN)/python -m pytest tests/envs/test_playground.py $(PYTEST_ARGS)

# Compiled programs are kept, as by the tests: every process that is killed compiles the same.
faults: export JAX_COMPILATION_CACHE_DIR ?= $(CURDIR)/.pytest_cache/xla
faults: export JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS ?= 0.1
faults: $(VENV)/.test
	PYTHONPATH=tests $(BIN)/python -m faults.campaign $(FAULTS_ARGS)

bench: $(VENV)/.bench
	$(BIN)/python -m palm_jax bench $(BENCH_ARGS)

clean:
	rm -rf $(VENV) build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
	find . -maxdepth 2 -name '*.egg-info' -prune -exec rm -rf {} +
