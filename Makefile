# Every target first makes and fills the environment .venv, once. `make` alone lists the targets.
#
#   PYTHON=/path/to/python   the Python to make .venv with, once (default: the newest that fits)
#   ARGS="..."               passed on to the command, e.g. make train ARGS="--seed 1"

PYTHON ?=
ARGS ?=

VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
UNFINISHED := $(VENV)/.unfinished
LOG := $(VENV)/install.log
IS_NEW_ENOUGH := 'import sys; sys.exit(sys.version_info < (3, 11))'
IS_USABLE := 'import sys, pip; sys.exit(sys.version_info < (3, 11))'

.DEFAULT_GOAL := help
.PHONY: help train test test-long table robustness lint maps notebooks clean

help:  ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "make %-10s %s\n", $$1, $$2 }' Makefile

train: $(INSTALLED)  ## train a robot, evaluate it and draw what it did; options in ARGS
	@$(BIN)/sqn train $(ARGS)

# A file's tests stay in one process: they share what they compile. Files come in the order of
# tests/conftest.py. A process that crashed is not begun anew: the run ends with its test's name.
PYTEST := $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder --max-worker-restart=0

test: $(INSTALLED)  ## run the tests, but for the long ones
	@$(PYTEST) $(ARGS)

test-long: $(INSTALLED)  ## run all tests, their programs compiled as users' are
	@SQN_TESTS_COMPILE=as-users $(PYTEST) -m "" $(ARGS)

table: $(INSTALLED)  ## train three agents, compare them on four maps, write the paper's table
	@$(BIN)/python experiments/table1.py $(ARGS)

robustness: $(INSTALLED)  ## the same agents under noise, with the paper's figure
	@$(BIN)/python experiments/robustness.py $(ARGS)

lint: $(INSTALLED)  ## check style, format, types, and who imports whom
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy
	@$(BIN)/lint-imports

maps: $(INSTALLED)  ## draw the maps in maps/ anew
	@$(BIN)/python experiments/draw_maps.py $(ARGS)

notebooks: $(INSTALLED)  ## run the notebooks in full and keep what they show; names in ARGS
	@$(BIN)/python -m pip install --no-input --disable-pip-version-check --progress-bar off \
	  -c constraints.txt -e '.[notebooks]' >$(LOG) 2>&1 \
	  || { tail -n 15 $(LOG) >&2 ; echo "Installation failed; all of it is in $(LOG)." >&2 ; exit 1 ; }
	@$(BIN)/python notebooks/execute.py $(ARGS)

clean:  ## remove the environment and the caches, keep the runs
	@rm -rf $(VENV) build dist .mypy_cache .pytest_cache .ruff_cache .hypothesis
	@find . -name __pycache__ -type d -prune -exec rm -rf {} +

# A command that exists may still not run (a version manager's stand-in), and Debian ships Python
# without ensurepip: a candidate counts when it is new enough and can make an environment.
define FIND_PYTHON
	python= ; too_old=1 ; \
	for candidate in $(if $(PYTHON),"$(PYTHON)",python3.13 python3.12 python3.11 python3); do \
	  "$$candidate" -c $(IS_NEW_ENOUGH) 2>/dev/null || continue ; \
	  too_old= ; \
	  "$$candidate" -c 'import venv, ensurepip' 2>/dev/null || continue ; \
	  python="$$candidate" ; break ; \
	done ; \
	if [ -n "$$too_old" ]; then \
	  echo "$(if $(PYTHON),PYTHON=$(PYTHON) is not Python 3.11 or newer.,No Python 3.11 or newer found: install python3 and python3-venv or name one with PYTHON=/path/to/python.)" >&2 ; exit 1 ; \
	elif [ -z "$$python" ]; then \
	  echo "Python has no venv or ensurepip: install its venv package (apt-get install python3-venv) and try again." >&2 ; exit 1 ; \
	fi
endef

# .unfinished tells an installation that was broken off, to be begun anew, from one to be brought up
# to date. An environment that was moved or copied would run the code it was made for: the mark says
# where that is. One that no longer runs (its Python gone) is begun anew too.
ifneq "$(CURDIR)" "$(shell cat $(INSTALLED) 2>/dev/null)"
.PHONY: $(INSTALLED)
endif

$(INSTALLED): pyproject.toml constraints.txt
	@if [ -e $(UNFINISHED) ] \
	  || { [ -e $(INSTALLED) ] && [ "$(CURDIR)" != "$$(cat $(INSTALLED))" ] ; } \
	  || ! $(BIN)/python -c $(IS_USABLE) 2>/dev/null ; then \
	  $(FIND_PYTHON) ; \
	  echo "Making $(VENV) with $$("$$python" --version)" ; \
	  rm -rf $(VENV) && mkdir $(VENV) && touch $(UNFINISHED) && "$$python" -m venv $(VENV) || exit 1 ; \
	fi
	@rm -f $(INSTALLED)
	@echo "$(CURDIR)" > $(UNFINISHED)
	@echo "Installing sqn_jax and what it needs into $(VENV) (once, up to a few minutes)"
	@$(BIN)/python -m pip install --no-input --disable-pip-version-check --progress-bar off \
	  -c constraints.txt -e '.[dev]' >$(LOG) 2>&1 \
	  || { tail -n 15 $(LOG) >&2 ; echo "Installation failed; all of it is in $(LOG)." >&2 ; exit 1 ; }
	@mv $(UNFINISHED) $(INSTALLED)
