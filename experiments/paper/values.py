"""What the paper's tables say, as `values.toml` has it."""

from pathlib import Path

from openjax.files import read_toml

MAIN, PARTS, PREDICTION = read_toml(Path(__file__).with_name("values.toml")).values()
"""By layout and method: means and standard deviations, of the main table and of layouts unlike the
training's. By layout: mean error of OPEN's predicted next position (m).
"""


def means(layout: str, method: str) -> tuple[float, int, float] | None:
    """Capture rate, capture step and collision rate; None of what the paper doesn't have."""
    value = (MAIN.get(layout, {}) | PARTS.get(layout, {})).get(method)
    if value is None:
        return None
    (rate, _), (step, _), (collisions, _) = value
    return rate, round(step), collisions
