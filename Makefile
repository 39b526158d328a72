PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
READY  := $(VENV)/.ready

.PHONY: train test lint benchmark evaluate tables exam clean

# `make train` accepts extra options: make train ARGS="--preset paper --seed 1"
train: $(READY)
	$(BIN)/python -m openjax.train --out runs/train --overwrite $(ARGS)

test: $(READY)
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder $(ARGS)

lint: $(READY)
	$(BIN)/ruff check src tests experiments
	$(BIN)/ruff format --check src tests experiments

benchmark: $(READY)
	$(BIN)/python -m openjax.benchmark $(ARGS)

evaluate: $(READY)
	$(BIN)/python -m openjax.evaluate --policy open open_seed_1 open_seed_2 --scenario all $(ARGS)

tables: $(READY)
	$(BIN)/python -m experiments.tables $(ARGS)

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
