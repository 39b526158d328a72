"""Settings from JSON: plain values back to nested frozen dataclasses, strictly; `openjax.files.to_plain` is the way there."""

import dataclasses
import types
import typing
from pathlib import Path
from typing import Any

from openjax.errors import UserError

SETTINGS_FILE = "settings.json"


def from_plain(kind: Any, value: Any, where: str = "settings") -> Any:
    """The inverse of `to_plain` for the annotated type `kind`.

    Raises:
      UserError: an unknown key, or a value that doesn't fit its annotation; `where` names the place.
    """
    if dataclasses.is_dataclass(kind):
        return _dataclass_from_plain(kind, value, where)
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is typing.Annotated:
        return from_plain(arguments[0], value, where)
    if origin in (typing.Union, types.UnionType):
        return _union_from_plain(arguments, value, where)
    if origin is tuple:
        return _tuple_from_plain(arguments, value, where)
    if origin is typing.Literal and value not in arguments:
        raise UserError(f"{where} is {value!r}; expected one of {', '.join(map(repr, arguments))}")
    return value if origin is typing.Literal else _leaf_from_plain(kind, value, where)


def _tuple_from_plain(arguments, value, where):
    if not isinstance(value, list | tuple):
        raise UserError(f"{where} is {value!r}; expected a list")
    if len(arguments) == 2 and arguments[1] is Ellipsis:
        arguments = arguments[:1] * len(value)
    if len(arguments) != len(value):
        raise UserError(f"{where} has {len(value)} entries; expected {len(arguments)}")
    places = (f"{where}[{i}]" for i in range(len(value)))
    return tuple(map(from_plain, arguments, value, places))


def _leaf_from_plain(kind, value, where):
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if kind is Path and isinstance(value, str):
        return Path(value)
    if isinstance(kind, type) and kind in (int, float, str, bool):
        if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
            raise UserError(f"{where} is {value!r}; expected {kind.__name__}")
    if kind is type(None) and value is not None:
        raise UserError(f"{where} is {value!r}; expected nothing")
    return value


def _dataclass_from_plain(kind, value, where):
    if not isinstance(value, dict):
        raise UserError(f"{where} is {value!r}; expected a table of settings")
    known = {field.name for field in dataclasses.fields(kind) if field.init}
    for key in value:
        if key not in known:
            raise UserError(f"{where} has the unknown setting {key!r}; known are {', '.join(sorted(known))}")
    hints = typing.get_type_hints(kind, include_extras=True)
    return kind(**{key: from_plain(hints[key], entry, f"{where}.{key}") for key, entry in value.items()})


def _union_from_plain(arguments, value, where):
    reasons = []
    # The exact match first: True is not 1, and 1 must not become 1.0 when int stands in the union.
    for argument in sorted(arguments, key=lambda kind: kind is not type(value)):
        try:
            return from_plain(argument, value, where)
        except UserError as error:
            reasons.append(str(error))
    raise UserError(reasons[0])
