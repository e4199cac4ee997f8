# make demo    sets everything up in .venv, runs, maps, asks and compares on a rendered sequence, offline and live
# make test    sets up and runs the tests; TESTS="tests/graph -x" passes other arguments to pytest
# make check   lint, format, types, security (bandit, pip-audit) and tests (with the layer rule)
# make typing  makes build/typing, the tree that mypy (and an editor) reads the package from
# make docs    builds the documentation site in build/site, strictly
# make fuzz    gives every reader broken files for two minutes; FUZZ="--seconds 3600 --seed 7" for longer
# make bench   measures and writes docs/results/benchmarks.md; BENCH="..." passes arguments
# make clean   removes what these made, but for runs/

PYTHON ?= python3
VENV ?= .venv
BENCH ?=
FUZZ ?=
TESTS ?= --numprocesses 3 --dist worksteal
BIN := $(VENV)/bin
READY := $(VENV)/.ready
DEMO := runs/demo-sequence
TYPING := build/typing/bmask_slam

# Compiled modules are kept, also where the environment says otherwise: tests start many processes.
export PYTHONDONTWRITEBYTECODE :=
export PIP_DISABLE_PIP_VERSION_CHECK := 1
export PIP_ROOT_USER_ACTION := ignore

.PHONY: demo test check docs typing fuzz bench setup clean
.DELETE_ON_ERROR:

demo: $(DEMO)
	@$(BIN)/bmask-slam run $(DEMO) --out runs/demo --overwrite
	@$(BIN)/bmask-slam map runs/demo --mesh --plan
	@$(BIN)/bmask-slam query runs/demo
	@$(BIN)/bmask-slam film runs/demo --quiet > /dev/null
	@$(BIN)/bmask-slam report runs/demo
	@$(BIN)/bmask-slam live $(DEMO) --map --out runs/demo-live --overwrite
	@$(BIN)/bmask-slam compare rendered --out runs/demo-comparison --sequences office \
	  --configurations "default,without registration" --seeds 0

$(DEMO): | $(READY)
	@$(BIN)/bmask-slam render office --frames 200 --out $@

test: $(READY)
	@$(BIN)/python -m pytest $(TESTS)

check: $(READY) typing
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy
	@$(BIN)/bandit --quiet --configfile pyproject.toml --recursive graph semantics mapping slam
	@$(BIN)/python tests/audit.py
	@$(BIN)/python -m pytest $(TESTS)

# The four folders as the one package that they are installed as, for mypy and editors; made anew
# each time, so that a file that is gone leaves no link.
typing:
	@rm -rf build/typing
	@mkdir -p $(TYPING)
	@for path in slam/*.py slam/py.typed slam/*/ graph semantics mapping; do \
	  name=$$(basename $$path); \
	  test $$name = __pycache__ || ln -s ../../../$${path%/} $(TYPING)/$$name; \
	done

# The site, by mkdocs, without anything loaded from elsewhere; a broken link or page is an error.
docs: $(READY) typing
	@$(BIN)/python -m pip install -qq --constraint constraints.txt --editable '.[docs]'
	@$(BIN)/python docs/parameters.py
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo "build/site; to read it with its search: $(BIN)/python -m http.server --directory build/site"

fuzz: $(READY)
	@$(BIN)/python tests/fuzz/run.py $(FUZZ)

bench: $(READY)
	@$(BIN)/python -m benchmarks.run $(BENCH)

setup: $(READY)

# Again whenever what is to be installed has changed.
$(READY): pyproject.toml constraints.txt
	@echo "Setting up $(VENV) (some minutes the first time) ..."
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "error: Python 3.11 or newer is needed; give it as make PYTHON=python3.11")'
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@$(BIN)/python -m pip install -qq --constraint constraints.txt --editable '.[dev]'
	@touch $@

clean:
	rm -rf $(VENV) build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis
