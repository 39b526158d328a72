"""The numbers that decide, read once from `decision.toml`: each with its meaning and its source."""

import tomllib
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Decision:
    """See `decision.toml` for what each number means."""

    standard_errors: float
    least_gap: float
    form_error: float
    unknown: float
    temperature: float
    clock: float
    packet_loss: float
    rate_gain: float
    gyroscope_gain: float
    world_tilt: float


_TABLE = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
DECISION = Decision(**{name: float(entry["value"]) for name, entry in _TABLE.items()})
