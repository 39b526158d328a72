"""The numbers that decide, read once from `decision.toml`: each with its meaning and
its source.
"""

import tomllib
from dataclasses import make_dataclass
from pathlib import Path

_TABLE = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
DECISION = make_dataclass("Decision", _TABLE, frozen=True)(
    *(float(entry["value"]) for entry in _TABLE.values())
)
