# Every target sets up what it needs by itself, in .venv: the demo the package alone, the others its tools and extras.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: demo example test page lint install clean

install: .venv/developed

.venv/installed: pyproject.toml
	@echo "Installing avmsf into .venv, once: one to a few minutes, most of it downloads."
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --editable .
	touch $@

.venv/developed: .venv/installed
	$(BIN)/pip install --quiet --editable '.[dev]'
	touch $@

demo: .venv/installed
	$(BIN)/avmsf demo demo

# Makes anew what `make demo` starts from, the same to the last bit where numpy and scipy are the same.
example: .venv/developed
	rm -rf src/avmsf/example
	$(BIN)/avmsf simulate example --output src/avmsf/example

test: .venv/developed
	OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 $(BIN)/pytest -n auto

# What the page does, in Debian's chromium: minutes in real time, which `test` has the centre of.
page: .venv/developed
	OMP_NUM_THREADS=1 $(BIN)/pytest -n auto -m page tests/studio

lint: .venv/developed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

clean:
	rm -rf .venv demo
