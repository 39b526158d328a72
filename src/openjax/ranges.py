"""Ranges of settings, declared once: in the type of the field that they belong to.

    learning_rate: Annotated[float, Interval("(0, 1]")] = 5e-4

`check_intervals` validates by them, `--help` shows them, and one test draws values from
inside and outside of each.
"""

import dataclasses
import functools
import math
import numbers
import re
import types
import typing
from typing import Annotated, Any

from openjax.errors import UserError, suggestion

_NOTATION = re.compile(r"([\[(])\s*([^,\s]+)\s*,\s*([^,\s]+)\s*([\])])")


@dataclasses.dataclass(frozen=True)
class Interval:
    """The numbers that a setting may have, in the notation of mathematics: "[1, 8]",
    "(0, 1]". Always bounded.
    """

    notation: str
    unit: str = ""

    def __post_init__(self):
        is_interval = self._parts and self.low < self.high
        if not (is_interval and math.isfinite(self.low) and math.isfinite(self.high)):
            raise ValueError(f"{self.notation!r} isn't a bounded interval")

    @functools.cached_property
    def _parts(self):
        return _NOTATION.fullmatch(self.notation)

    @property
    def low(self) -> float:
        """The lower end, whether it belongs to the interval or not."""
        return float(self._parts[2])

    @property
    def high(self) -> float:
        """The upper end, whether it belongs to the interval or not."""
        return float(self._parts[3])

    def __contains__(self, value: float) -> bool:
        above = value > self.low if self._parts[1] == "(" else value >= self.low
        below = value < self.high if self._parts[4] == ")" else value <= self.high
        return bool(above and below)

    def __str__(self) -> str:
        return f"{self.notation} {self.unit}".rstrip()


Seed = Annotated[int, Interval("[0, 4294967295]")]
"""What `jax.random.key` takes."""


@dataclasses.dataclass(frozen=True)
class Ranged:
    """A field of a settings class that holds one number, several, or, where `optional`,
    nothing.
    """

    name: str
    kind: type
    """int or float."""
    interval: Interval
    several: bool
    optional: bool


@functools.cache
def ranged_fields(settings: type) -> tuple[Ranged, ...]:
    """The fields of a dataclass that declare an interval."""
    fields = []
    for name, hint in typing.get_type_hints(settings, include_extras=True).items():
        notes = getattr(hint, "__metadata__", ())
        intervals = [note for note in notes if isinstance(note, Interval)]
        if not intervals:
            continue
        # peeled off one after the other: Annotated[...], ... | None, tuple[..., ...]
        kind = typing.get_args(hint)[0]
        optional = isinstance(kind, types.UnionType)
        if optional:
            kind = next(entry for entry in typing.get_args(kind) if entry is not type(None))
        several = typing.get_origin(kind) is tuple
        if several:
            kind = typing.get_args(kind)[0]
        fields.append(Ranged(name, kind, intervals[0], several, optional))
    return tuple(fields)


def check_intervals(settings: Any, group: str = "") -> None:
    """Raise UserError unless every number of a dataclass lies in its interval.

    Args:
      settings: dataclass; nested ones check themselves.
      group: what stands before a field's name in the error, for example `mappo.`.

    Raises:
      UserError: one doesn't, with its name and interval.
    """
    for field in ranged_fields(type(settings)):
        setting = getattr(settings, field.name)
        if setting is None and field.optional:
            continue
        if field.several and not isinstance(setting, tuple | list):
            raise UserError(
                f"{group}{field.name} is {shown(setting)}; it must be a list of numbers"
            )
        kind = numbers.Integral if field.kind is int else numbers.Real
        for value in setting if field.several else (setting,):
            # to Python, True is a whole number
            is_number = isinstance(value, kind) and not isinstance(value, bool)
            if not is_number or value not in field.interval:
                kind_words = "a whole number in" if field.kind is int else "in"
                raise UserError(
                    f"{group}{field.name} is {shown(value)}; it must be {kind_words} "
                    f"{field.interval}"
                )


def changed(settings: Any, **changes) -> Any:
    """`dataclasses.replace` for settings within settings: a dict holds changes of the settings
    under that name.

    `changed(preset("paper"), seed=1, environment=dict(reward=dict(crash=40.0)))`

    Raises:
      UserError: no such setting, or a value that it can't have.
    """
    names = [field.name for field in dataclasses.fields(settings)]
    for name in changes:
        if name not in names:
            of = type(settings).__name__
            raise UserError(f"{name}: {of} has no such setting; {suggestion(name, names)}")
    for name, value in changes.items():
        if isinstance(value, dict):
            changes[name] = changed(getattr(settings, name), **value)
    return dataclasses.replace(settings, **changes)


def shown(value: Any) -> str:
    """A value as it may stand in one line."""
    if isinstance(value, int) and abs(value) >= 10**20:
        return "a number of more than 20 digits"
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
