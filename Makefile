PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
# the versions that were tested; `make test PINS=` takes the newest of everything
PINS   ?= -c constraints.txt
READY  := $(VENV)/.ready$(if $(PINS),,-newest)
PYTEST  = $(BIN)/python -m pytest -n auto --maxprocesses 8 --dist worksteal

.PHONY: train test test-slow test-real-time test-all lint docs benchmark evaluate tables exam constraints clean

# `make train` accepts extra options: make train ARGS="--preset paper --seed 1"
train: $(READY)
	$(BIN)/python -m openjax.train --out runs/train --overwrite $(ARGS)

# the fast part, as long as nothing is wrong; everything: `make test-all`
test: $(READY)
	$(PYTEST) -m "not slow" $(ARGS)

test-slow: $(READY)
	$(PYTEST) -m "slow and not real_time" $(ARGS)

# flights of real processes at 100 Hz: one after the other, with nothing beside them
test-real-time: $(READY)
	$(BIN)/python -m pytest -m real_time $(ARGS)

test-all: lint test test-slow test-real-time docs

lint: $(READY)
	$(BIN)/ruff check src tests experiments examples conftest.py
	$(BIN)/ruff format --check src tests experiments examples conftest.py

# the site, into docs/_build/html; a warning is an error
docs: $(READY)
	$(BIN)/python -m pip install -q --group docs $(PINS)
	$(BIN)/python -m sphinx -W --keep-going -q docs docs/_build/html

benchmark: $(READY)
	$(BIN)/python -m openjax benchmark $(ARGS)

evaluate: $(READY)
	$(BIN)/python -m openjax.evaluate --policy open open_seed_1 open_seed_2 --scenario all $(ARGS)

tables: $(READY)
	$(BIN)/python -m experiments.paper.tables $(ARGS)

exam: $(READY)
	$(BIN)/python -m experiments.diagnosis.run $(ARGS)

# One install for everything; again only when what it installs changes. A GPU is used where
# nvidia-smi finds one.
$(READY): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install -q --upgrade pip
	if command -v nvidia-smi >/dev/null 2>&1; then extras=all,cuda; else extras=all; fi; \
	$(BIN)/python -m pip install -q -e ".[$$extras]" --group dev $(PINS) $(if $(PINS),,--upgrade)
	touch $(READY)

# the newest versions that fit together, for every Python that is promised; test them, then commit
constraints:
	uv pip compile pyproject.toml --universal --python-version 3.11 --all-extras --group dev \
	  --group docs --no-annotate --no-header --upgrade --output-file constraints.txt

clean:
	rm -rf $(VENV) runs
