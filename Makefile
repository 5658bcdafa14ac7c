# Everything happens in .venv, made on the first use with the first Python >= 3.11 that is found.
# `make demo PYTHON=/path/to/python3.12` chooses another.

DEMO = .venv/bin/python examples/demo.py

VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet
PINS := constraints.txt
FORMATTED := doedesign fab sim tests bench examples docs

.PHONY: demo train-demo test test-slow studies campaign mutants lint bench docs clean
.DEFAULT_GOAL := demo

demo: $(VENV)/.base
	$(DEMO)

# About 65 minutes on two cores.
train-demo: $(VENV)/.base
	$(BIN)/python examples/train_demo.py

test: $(VENV)/.dev
	$(BIN)/python -m pytest -q -n 2 --dist loadfile -m "not slow and not study"

test-slow: $(VENV)/.dev
	$(BIN)/python -m pytest -q -n 2 --dist worksteal -m "slow and not study" --durations=40

# Tests that take minutes, or repeat for many plates what a shorter one shows once: before a release.
studies: $(VENV)/.dev
	$(BIN)/python -m pytest -q -n 2 --dist worksteal -m study --durations=0

# Minutes; hours with a count: make campaign CAMPAIGN="kills mutations --count 10000"
campaign: $(VENV)/.dev
	$(BIN)/python -m tests.campaign $(CAMPAIGN)

# Of what changed since the last commit; of everything: make mutants MUTANTS="--all --sample 500"
mutants: $(VENV)/.dev
	$(BIN)/python -m tests.mutants $(MUTANTS)

lint: $(VENV)/.dev
	$(BIN)/ruff check $(FORMATTED)
	$(BIN)/ruff format --check $(FORMATTED)
	$(BIN)/pyright
	$(BIN)/lint-imports

bench: $(VENV)/.bench
	$(BIN)/python -m bench

# The site, in build/site; its pictures are drawn once and kept in build/pictures.
docs: $(VENV)/.docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo build/site/index.html

clean:
	rm -rf $(VENV) build dist .pytest_cache .ruff_cache .import_linter_cache .hypothesis
	find doedesign fab sim tests bench examples docs -name __pycache__ -prune -exec rm -rf {} +

# uv installs in a fifth of the time that pip takes; where it cannot be had, or cannot install, pip does. It takes the
# packages from where pip would: an index in place of the public one is handed on to it. Modules are compiled on first
# use, by either: compiling all of them takes a quarter of the time.
# The stamp files say which set is installed; they are renewed when the project's needs or pins change.
define install
@echo "Installing $(2) into $(VENV) (a minute at most) ..."
@{ $(PIP) install --constraint $(PINS) uv && \
    index=$${PIP_INDEX_URL:-$$($(PIP) config get global.index-url || true)} && \
    $(BIN)/uv pip install --quiet $${index:+--default-index "$$index"} --python $(BIN)/python --constraint $(PINS) --editable '$(1)'; } 2>/dev/null || \
    $(PIP) install --no-compile --constraint $(PINS) --editable '$(1)'
@touch $@ $(VENV)/.base
endef

$(VENV)/.base: pyproject.toml $(PINS) | $(BIN)/python
	$(call install,.,doedesign and its libraries)

$(VENV)/.dev: pyproject.toml $(PINS) | $(BIN)/python
	$(call install,.[dev],doedesign with its test tools)

$(VENV)/.bench: pyproject.toml $(PINS) | $(BIN)/python
	$(call install,.[bench],doedesign with the peers it is measured against)

$(VENV)/.docs: pyproject.toml $(PINS) | $(BIN)/python
	$(call install,.[docs],doedesign and what builds its documentation)

$(BIN)/python:
	@found=; \
	for candidate in $(or $(PYTHON),python3 python3.13 python3.12 python3.11 python3.14); do \
	    if "$$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then \
	        found=$$candidate; break; \
	    fi; \
	done; \
	if [ -z "$$found" ]; then \
	    echo "doedesign needs Python 3.11 or newer; '$(or $(PYTHON),python3)' is" \
	        "$$($(or $(PYTHON),python3) --version 2>&1 | head -n 1)." \
	        "Install one, or name it: make demo PYTHON=/path/to/python3.11" >&2; \
	    exit 1; \
	fi; \
	rm -rf $(VENV); \
	if ! "$$found" -m venv $(VENV); then \
	    rm -rf $(VENV); \
	    echo "'$$found' cannot make a virtual environment; on Debian and Ubuntu install python3-venv." >&2; \
	    exit 1; \
	fi
