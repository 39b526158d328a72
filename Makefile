PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
READY  := $(VENV)/.ready
PYTEST  = $(BIN)/python -m pytest -n auto --maxprocesses 8 --dist worksteal

.PHONY: train test test-slow test-real-time test-all lint docs benchmark evaluate tables exam clean

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
	$(BIN)/python -m pip install -q -e ".[docs]"
	$(BIN)/python -m sphinx -W --keep-going -q docs docs/_build/html

benchmark: $(READY)
	$(BIN)/python -m openjax benchmark $(ARGS)

evaluate: $(READY)
	$(BIN)/python -m openjax.evaluate --policy open open_seed_1 open_seed_2 --scenario all $(ARGS)

tables: $(READY)
	$(BIN)/python -m experiments.paper.tables $(ARGS)

exam: $(READY)
	$(BIN)/python -m experiments.diagnosis.run $(ARGS)

# One install for everything; again only when pyproject.toml changes. A GPU is used where nvidia-smi finds one.
$(READY): pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install -q --upgrade pip
	if command -v nvidia-smi >/dev/null 2>&1; then $(BIN)/python -m pip install -q -e ".[dev,cuda]"; \
	else $(BIN)/python -m pip install -q -e ".[dev]"; fi
	touch $(READY)

clean:
	rm -rf $(VENV) runs
