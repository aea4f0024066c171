# make demo | test | check | bench: each creates .venv with what it needs, once.

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
RUN := $(VENV)/.installed-run
DEV := $(VENV)/.installed-dev
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt

.PHONY: demo test check bench clean

demo: $(RUN)
	$(BIN)/velod demo

test: check
	$(BIN)/python -m pytest --ignore=tests/bench -m "not timed" -n auto --dist loadgroup --no-loadscope-reorder -p no:benchmark
	$(BIN)/python -m pytest --ignore=tests/bench -m timed

check: $(DEV)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: $(DEV)
	$(BIN)/python -m pytest tests/bench
	mkdir -p out
	$(BIN)/velod bench all --json out/bench.json

clean:
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "velod needs Python 3.11 or later; choose one: make PYTHON=python3.11" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(RUN): pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) -e .
	$(BIN)/velod warmup
	touch $@

$(DEV): pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) -e '.[h5,plot,test,check]'
	$(BIN)/velod warmup
	touch $@ $(RUN)
