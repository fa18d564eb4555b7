# What one types here. Every target that needs .venv makes it first, once, from constraints.txt.

PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
READY  := $(VENV)/.ready
DOCS   := .venv-docs
BROWSER := $(VENV)/.browser
CODE   := src tests examples benchmarks tools
PYTEST := $(BIN)/python -m pytest -n auto --dist loadfile --no-loadscope-reorder
REST   := realtime or browser or ray or sdk or qemu or wheel or notebook or slow

export PIP_DISABLE_PIP_VERSION_CHECK := 1
# Tests start some hundred processes: each would compile the sources that it imports.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help setup demo test test-rest test-all style lint format bench docs clean distclean FORCE

help: ## Show these targets
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  make \1@\2/p' Makefile | awk -F@ '{ printf "%-18s %s\n", $$1, $$2 }'

# The stamp holds the folder that .venv was made for, and is written last. Without it, after a move or copy of the
# repository, or when its Python has gone, .venv is made afresh; after a change of pins it is brought up to date.
MADE_FOR := $(shell test -x $(BIN)/python && cat $(READY) 2>/dev/null)
ifneq "$(MADE_FOR)" "$(CURDIR)"
$(READY): FORCE
endif
FORCE:

$(READY): pyproject.toml constraints.txt
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || \
	  { echo "surefoot needs Python 3.11 or newer, and '$(PYTHON)' is not: name one, as in 'make setup PYTHON=python3.12'" >&2; exit 1; }
	@if [ "$(MADE_FOR)" = "$(CURDIR)" ]; then \
	  echo "surefoot: the pins have changed, bringing $(VENV) up to date"; \
	else \
	  echo "surefoot: making $(VENV), once (a few minutes; torch is the large part)"; \
	  "$(PYTHON)" -m venv --clear $(VENV); \
	fi
	@rm -f $(READY)
	@$(BIN)/python -m pip install -c constraints.txt -e ".[train,report,dev]"
	@# PyBullet has no wheels for some Pythons, and is long to compile: without it the tests of its world are skipped.
	@$(BIN)/python -m pip install -c constraints.txt --only-binary pybullet -e ".[bullet]" || \
	  echo "surefoot: no PyBullet for this Python; the Bullet world and its tests are left out"
	@# The link to a Go2, and the vendor's SDKs that test it. Their own requirements name versions that do not go together.
	@# The first one is in the path of motor commands: by its hash (docs/dependencies.md).
	@grep ^tensor-ipc-cyclonedds robot-requirements.txt | \
	  $(BIN)/python -m pip install -q --no-deps --only-binary :all: --require-hashes -r /dev/stdin || \
	  echo "surefoot: no tensor-ipc-cyclonedds for this Python; tests that need it are left out"
	@for package in rich-click unitree-sdk2py-dimos far-unitree-sdk; do \
	  $(BIN)/python -m pip install -q -c constraints.txt --no-deps --only-binary :all: $$package || \
	  echo "surefoot: no $$package for this Python; tests that need it are left out"; \
	done
	@echo "$(CURDIR)" > $(READY)
	@echo "surefoot: $(VENV) is ready"

setup: $(READY) ## Make .venv with everything for training, reports and tests
	@:

demo: $(READY) ## Run the demonstration
	@$(BIN)/python examples/demo.py $(ARGS)

# Tried once: without a browser, pytest's summary says which tests are left out.
$(BROWSER): $(READY)
	@$(BIN)/python tests/chromium.py
	@touch $(BROWSER)

# Threads that wait for work do not spin: others have work.
test test-rest: export OPENBLAS_NUM_THREADS := 1
test test-rest: export OMP_WAIT_POLICY := passive

# Types are checked beside the tests; the summary of the tests comes last. In a fresh clone, kernels are compiled before,
# and not in each of the processes.
test: style ## Check style and types, and run the tests that every change needs (ARGS="-k gait" for some)
	@nice $(BIN)/mypy & types=$$!; \
	test -e src/surefoot/actuator/__pycache__/kernels.sha256 || \
	  $(BIN)/python -m surefoot emulate --duration 0.01 >/dev/null 2>&1; \
	$(PYTEST) -m "not ($(REST))" $(ARGS); tests=$$?; \
	wait $$types || { echo "surefoot: mypy has found errors, printed above" >&2; exit 1; }; \
	exit $$tests

test-rest: $(BROWSER) ## Run the tests that `make test` leaves out
	@$(PYTEST) -m "$(REST)" $(ARGS)

test-all: ## Run all tests
	@$(MAKE) --no-print-directory test
	@$(MAKE) --no-print-directory test-rest

style: $(READY)
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .

lint: style ## Check style and types
	@$(BIN)/mypy

format: $(READY) ## Format the code and fix what can be fixed
	@$(BIN)/ruff check --fix .
	@$(BIN)/ruff format .

bench: $(READY) ## Run the benchmarks, one after the other
	@for script in benchmarks/*.py; do echo "== $$script"; $(BIN)/python "$$script" $(ARGS) || exit 1; done

# An environment of its own, without torch: pages of reference are made from the code.
$(DOCS)/.ready: pyproject.toml constraints.txt
	@"$(PYTHON)" -m venv --clear $(DOCS)
	@$(DOCS)/bin/python -m pip install -c constraints.txt -e ".[docs]"
	@touch $@

# mkdocs is not told to be quiet: its strict mode counts only the warnings that it prints.
docs: $(DOCS)/.ready ## Build the documentation as a site, in site/
	@NO_MKDOCS_2_WARNING=1 $(DOCS)/bin/python -m mkdocs build
	@echo "surefoot: the documentation is site/index.html"

clean: ## Remove caches and build output; runs and .venv stay
	@rm -rf build dist site .pytest_cache .mypy_cache .ruff_cache .hypothesis
	@find $(wildcard $(CODE)) -name __pycache__ -prune -exec rm -rf {} +

distclean: clean ## Remove .venv and .venv-docs too
	@rm -rf $(VENV) $(DOCS)
