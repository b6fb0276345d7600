# Everything on a fresh machine with Python 3.11 or newer: `make setup`, `make demo`, `make test`.
# Choose an interpreter with `make setup PYTHON=/path/to/python`.
PYTHON ?=
VENV := .venv
BIN := $(VENV)/bin
PEERS := .venv-bench
FIGURES := build/bench
STAMP := $(VENV)/.installed
CHECKED := pytest --jaxtyping-packages=jaxsid,beartype.beartype -n 2 --dist loadfile --no-loadscope-reorder --benchmark-disable --durations=12

.PHONY: setup demo lint test test-all bench bench-refine bench-effects bench-calibration blind docs notebooks clean

setup: $(STAMP)

demo: $(STAMP)
	$(BIN)/jaxsid demo --out demo

lint: $(STAMP)
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/pyright --pythonpath $(BIN)/python

test: lint
	$(BIN)/python -m $(CHECKED) -m "not slow"

test-all: lint
	JAXSID_OPTIMIZED=1 $(BIN)/python -m $(CHECKED)

# The peers live in an environment of their own; the figures go into benchmarks/README.md.
bench: $(STAMP) $(PEERS)/.installed
	mkdir -p $(FIGURES)
	OPENBLAS_NUM_THREADS=1 $(PEERS)/bin/python benchmarks/era_cases.py $(FIGURES)/cases.npz
	$(BIN)/python benchmarks/era_rounds.py $(FIGURES)/cases.npz $(PEERS)/bin/python $(FIGURES)/era.json
	OPENBLAS_NUM_THREADS=1 $(BIN)/python benchmarks/rates.py $(FIGURES)/rates.json
	$(PEERS)/bin/python benchmarks/peers.py $(FIGURES)/peers.json
	$(BIN)/python benchmarks/structure.py $(FIGURES)/structure.json
	$(BIN)/python -m pytest benchmarks --benchmark-only -p no:cacheprovider --benchmark-json $(FIGURES)/timings.json
	$(BIN)/python benchmarks/write_tables.py $(FIGURES)

bench-refine: $(STAMP)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python benchmarks/refinement.py

bench-effects: $(STAMP)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python benchmarks/effects.py $(FIGURES)/effects-truth.npz

bench-calibration: $(STAMP)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python benchmarks/calibration.py

# Diagnoses of systems whose effects are withheld; goes on where it stopped. Cases and results stay in build/blind.
blind: $(STAMP)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python benchmarks/blind/generate.py build/blind --set test --cases 240 --samples 4000 2000
	$(BIN)/python benchmarks/blind/run.py build/blind
	OPENBLAS_NUM_THREADS=1 $(BIN)/python benchmarks/blind/baselines.py build/blind
	$(BIN)/python benchmarks/blind/score.py build/blind
	$(BIN)/python benchmarks/blind/figures.py build/blind build/blind/figures

$(PEERS)/.installed: $(STAMP) benchmarks/constraints.txt
	$(BIN)/python -m venv --clear $(PEERS)
	$(PEERS)/bin/python -m pip install --quiet --disable-pip-version-check -c benchmarks/constraints.txt control mdof pymor pyyeti
	@touch $@

docs: $(STAMP)
	$(BIN)/jaxsid effects --out docs

notebooks: $(STAMP)
	$(BIN)/jupyter nbconvert --execute --to html --output-dir build/notebooks notebooks/*.ipynb

clean:
	rm -rf $(VENV) $(PEERS) demo build dist .pytest_cache .ruff_cache .hypothesis .benchmarks

# A name on the PATH may be a shim for a version that is not there, and a system Python may lack venv: try each.
$(STAMP): pyproject.toml constraints.txt
	@set -e; found=; \
	if ! $(BIN)/python -m pip --version >/dev/null 2>&1; then \
	  for python in $(or $(PYTHON),python3.13 python3.12 python3.11 python3 python); do \
	    if $$python -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1; then \
	      found=$$python; break; \
	    fi; \
	  done; \
	  if [ -z "$$found" ]; then \
	    echo "jaxsid needs Python 3.11 or newer with its venv module; none of '$(or $(PYTHON),python3.13 python3.12 python3.11 python3 python)' is one." >&2; \
	    echo "Install it (on Debian and Ubuntu the package python3-venv too), or name it: make PYTHON=/path/to/python" >&2; \
	    exit 1; \
	  fi; \
	  echo "making $(VENV) with $$($$found --version)"; \
	  $$found -m venv --clear $(VENV); \
	fi
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt hatchling editables
	extras=$$($(BIN)/python -c 'import tomllib; print(",".join(sorted(set(tomllib.load(open("pyproject.toml", "rb"))["project"]["optional-dependencies"]) - {"cuda"})))') && \
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-build-isolation -c constraints.txt -e ".[$$extras]"
	@touch $@
