"""The numbers that decide, read once from `decision.toml`: each with its meaning and its source."""

import tomllib
from pathlib import Path
from types import SimpleNamespace

_TABLE = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
DECISION = SimpleNamespace(**{name: float(entry["value"]) for name, entry in _TABLE.items()})
