"""Named parameters of the methods: literature's value, range of the search, unit; and
the values that the search found.
"""

import dataclasses
import json
from pathlib import Path
from typing import Any, TypeVar

import jax.numpy as jnp
from flax import struct

FOUND = Path(__file__).with_name("parameters.json")
"""{method: {parameter: value}}: the best of 512 sets each on training tasks, by capture
rate, step and collisions.
"""

Parameters = TypeVar("Parameters")


def parameter(default: float, low: float, high: float) -> Any:
    """A field whose `default` is the literature's, searched between `low` and `high` on
    a logarithmic scale.
    """
    return struct.field(default=default, metadata={"range": (low, high)})


def ranges(kind: type) -> dict[str, tuple[float, float]]:
    """Parameter -> (low, high) of a method's parameters."""
    return {field.name: field.metadata["range"] for field in dataclasses.fields(kind)}


def best(method: str, kind: type[Parameters]) -> Parameters:
    """A method's parameters as the search found them; the literature's where there is
    no result of it.
    """
    searches = json.loads(FOUND.read_text(encoding="utf-8"))
    values = {field.name: field.default for field in dataclasses.fields(kind)}
    values |= searches.get(method, {})
    return kind(**{name: jnp.float32(value) for name, value in values.items()})
