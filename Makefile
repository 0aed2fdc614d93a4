# `make demo` and `make test` set everything up by themselves: a virtual environment with pinned packages and an LLVM.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
# Two processes, one file of tests at a time each: scenes that a file's tests share are rendered once.
PYTEST := $(BIN)/python -m pytest -n 2 --dist loadfile
# Tests start hundreds of commands. With compiled modules a small one takes a sixth less time.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test test-all lint docs notebooks clean

demo: $(STAMP)
	$(BIN)/scene2spad demo

test: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy --num-workers 2
	$(PYTEST)

test-all: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy --num-workers 2
	$(PYTEST) -m "slow or not slow"

lint: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
	$(BIN)/mypy --num-workers 2

# Pages of the documentation, from docs/ and the code: out/site/index.html, which loads nothing from elsewhere.
docs: $(VENV)/.docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict

notebooks: $(VENV)/.docs
	$(BIN)/jupytext --quiet --to notebook examples/*.py

$(VENV)/.docs: $(STAMP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[docs]'
	touch $@

# The stamp is touched last: an interrupted installation starts again. The wheel of LLVM completes itself when the
# environment's Python first starts, hence the start before the stamp.
$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	    { echo "scene2spad needs Python 3.11 or newer; say which with: make PYTHON=/path/to/python3.11 $(MAKECMDGOALS)"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[test]'
	$(BIN)/python -c 'from render.backend.llvm import start_mitsuba; start_mitsuba()'
	touch $(STAMP)

clean:
	rm -rf $(VENV) build *.egg-info
