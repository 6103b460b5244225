# Every target sets up what it needs by itself, in VENV: the demo the package alone, the others its tools and extras.
# Another version of Python needs a folder of its own: make test PYTHON=python3.13 VENV=.venv-3.13
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

.PHONY: demo docs example test test-all lint install clean

install: $(VENV)/developed

$(VENV)/installed: pyproject.toml
	@echo "Installing avmsf into $(VENV), once: one to a few minutes, most of it downloads. Where pip takes PyTorch with"
	@echo "CUDA libraries (Linux), PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu saves 4 GB."
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --editable .
	touch $@

$(VENV)/developed: $(VENV)/installed
	$(BIN)/pip install --quiet --editable '.[dev]'
	touch $@

demo: $(VENV)/installed
	$(BIN)/avmsf demo demo

# Makes anew what `make demo` starts from, the same to the last bit where numpy and scipy are the same.
example: $(VENV)/developed
	rm -rf src/avmsf/example
	$(BIN)/avmsf simulate example --output src/avmsf/example

# Neighbors stay on one worker where possible (worksteal), so that a module's fixtures are made once.
PYTEST := OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 $(BIN)/pytest -n auto --dist worksteal

# The fast tests of every package: 5 minutes at most on two idle cores.
test: $(VENV)/developed
	$(PYTEST)

# All tests: the fast ones, then the slow ones and those of the page (Debian's chromium), with the types and shapes of
# all arguments checked at run time.
test-all: test
	$(PYTEST) -m "slow or page" --jaxtyping-packages=avmsf,beartype.beartype

lint: $(VENV)/developed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# The documentation, into site/. A link or an anchor that leads nowhere is an error, and so is one in the notebook, which
# is executed for its sounds and pictures.
docs: $(VENV)/developed
	rm -rf .cache/mkdocs-jupyter
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

clean:
	rm -rf .venv .venv-* demo site
