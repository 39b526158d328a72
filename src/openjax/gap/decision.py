"""The numbers that decide, read once from `decision.toml`: each with its meaning and its source."""

import tomllib
from dataclasses import dataclass, fields
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


def read_decision(path: Path) -> Decision:
    """The numbers of a file. Raises ValueError where one is missing, unknown or lacks its meaning or source."""
    table = tomllib.loads(path.read_text(encoding="utf-8"))
    if set(table) != {f.name for f in fields(Decision)}:
        raise ValueError(f"{path}: holds {sorted(table)}")
    for name, entry in table.items():
        if set(entry) != {"value", "meaning", "source"}:
            raise ValueError(f"{path}: [{name}] needs value, meaning and source")
    return Decision(**{name: float(entry["value"]) for name, entry in table.items()})


DECISION = read_decision(Path(__file__).with_name("decision.toml"))
