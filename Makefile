# make demo    the main job on a fresh machine: plant FMU → data → learned model → NMPC in co-simulation → report
# make test    the test suite, with coverage
# make check   the quality gate: lint, format, types, import directions, coverage
# make bench   the speed and accuracy claims
PYTHON ?= python3
BIN := .venv/bin
INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt
# Two cores at most; threaded BLAS would slow small matrices down.
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1

.PHONY: demo test check bench clean
.DELETE_ON_ERROR:

demo: .venv/.user
	$(BIN)/exlinn run scenarios/dcwc_tracking.yaml

test: .venv/.dev
	$(BIN)/python -m pytest -n 2 --cov --cov-report=

check: .venv/.dev .coverage
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/coverage report --fail-under=95 --skip-covered

bench: .venv/.bench
	for file in benchmarks/*.py; do echo "== $$file" && $(BIN)/python $$file || exit 1; done

.coverage:
	$(MAKE) test

.venv/.user: pyproject.toml constraints.txt
	@echo "Setting up .venv (once; PyTorch and CasADi are large) …"
	$(PYTHON) -m venv .venv
	$(INSTALL) -e .
	touch $@

.venv/.dev: .venv/.user
	$(INSTALL) -e '.[dev,bench,compiler]'
	$(INSTALL) --no-deps gemseo-fmu  # for the FMUs of OpenModelica inside
	touch $@

.venv/.bench: .venv/.dev
	$(INSTALL) -e '.[bench]'
	touch $@

clean:
	rm -rf .venv runs .coverage .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
