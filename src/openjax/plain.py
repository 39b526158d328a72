"""Plain values, as TOML and JSON hold them, to nested frozen dataclasses, strictly;
`openjax.files.to_plain` is the way back.
"""

import dataclasses
import math
import types
import typing
from pathlib import Path
from typing import Any

from openjax.errors import UserError, suggestion
from openjax.ranges import check_intervals, shown

ROOT = ": "
"""What the name of a place ends in that is a file, and no setting: `a.toml: `, then
`a.toml: motor.order`.
"""

WORDS = {int: "a whole number", float: "a number", str: "text", bool: "true or false"}


def from_plain(kind: Any, value: Any, place: str = "settings") -> Any:
    """The inverse of `to_plain` for the annotated type `kind`; numbers are finite and
    lie in their intervals.

    Raises:
      UserError: an unknown key, a missing one, or a value that doesn't fit its
      annotation; `place` names the place.
    """
    if dataclasses.is_dataclass(kind):
        return _dataclass_from_plain(kind, value, place)
    origin = typing.get_origin(kind)
    arguments = typing.get_args(kind)
    if origin is typing.Annotated:
        return from_plain(arguments[0], value, place)
    if origin in (typing.Union, types.UnionType):
        return _union_from_plain(arguments, value, place)
    if origin is tuple:
        return _tuple_from_plain(arguments, value, place)
    if origin is dict:
        values_of = {}
        for key, entry in _table(value, place).items():
            name = from_plain(arguments[0], key, f"{place}: a key")
            values_of[name] = from_plain(arguments[1], entry, _place(place, key))
        return values_of
    if origin is typing.Literal and value not in arguments:
        raise UserError(
            f"{place} is {shown(value)}; expected one of {', '.join(map(repr, arguments))}"
        )
    return value if origin is typing.Literal else _leaf_from_plain(kind, value, place)


def _place(place, key):
    return f"{place}{key}" if place.endswith(ROOT) else f"{place}.{key}"


def _table(value, place):
    if not isinstance(value, dict):
        raise UserError(f"{place.removesuffix(ROOT)} is {shown(value)}; expected a table")
    return value


def _tuple_from_plain(arguments, value, place):
    if not isinstance(value, list | tuple):
        raise UserError(f"{place} is {shown(value)}; expected a list")
    if len(arguments) == 2 and arguments[1] is Ellipsis:
        arguments = arguments[:1] * len(value)
    if len(arguments) != len(value):
        raise UserError(f"{place} has {len(value)} entries; expected {len(arguments)}")
    places = (f"{place}[{i}]" for i in range(len(value)))
    return tuple(map(from_plain, arguments, value, places))


def _leaf_from_plain(kind, value, place):
    # TOML's 1 may stand for 1.0; to Python, True is a number, too
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if kind is Path and isinstance(value, str):
        return Path(value)
    if kind in WORDS and (not isinstance(value, kind) or (kind is int and isinstance(value, bool))):
        raise UserError(f"{place} is {shown(value)}; expected {WORDS[kind]}")
    if kind is float and not math.isfinite(value):
        raise UserError(f"{place} is {value}; expected a finite number")
    if kind is type(None) and value is not None:
        raise UserError(f"{place} is {shown(value)}; expected nothing")
    return value


def _dataclass_from_plain(kind, value, place):
    fields = {field.name: field for field in dataclasses.fields(kind) if field.init}
    root = place.removesuffix(ROOT)
    entries = _table(value, place)
    unknown = [key for key in entries if key not in fields]
    for key in unknown:
        if not _was_setting(kind, key, entries, place):
            raise UserError(
                f"{root} has the unknown key {shown(key)}; {suggestion(str(key), sorted(fields))}"
            )
    entries = {key: entry for key, entry in entries.items() if key in fields}
    for name, field in fields.items():
        has_no_default = field.default is field.default_factory is dataclasses.MISSING
        if has_no_default and name not in entries:
            raise UserError(f"{root} lacks {name}")
    hints = typing.get_type_hints(kind, include_extras=True)
    values = {
        key: from_plain(hints[key], entry, _place(place, key)) for key, entry in entries.items()
    }
    instance = kind(**values)
    # once more, though most kinds check themselves: here the error names the file
    check_intervals(instance, _place(place, ""))
    return instance


def _was_setting(kind, key, entries, place):
    """True if earlier versions had this setting, which is a constant of the class now: of the
    same name in capitals, or in its `FORMER` where the code doesn't need it, a set if it had
    several values.

    Raises:
      UserError: it has another value, in a part that isn't switched off (`SWITCH` names the
      setting that does it by 0).
    """
    constants = {name.lower(): value for name, value in vars(kind).items() if name.isupper()}
    constants |= constants.pop("former", {})
    switch = constants.pop("switch", None)
    if key not in constants:
        return False
    constant = constants[key]
    values = constant if isinstance(constant, set) else {constant}
    is_off = switch is not None and entries.get(switch) == 0
    value = tuple(entries[key]) if isinstance(entries[key], list) else entries[key]
    is_known = any(
        value == one and isinstance(value, bool) == isinstance(one, bool) for one in values
    )
    if not is_off and not is_known:
        raise UserError(
            f"{_place(place, key)} is {shown(value)}; it is no longer a setting and is always "
            f"{' or '.join(map(str, sorted(values)))}"
        )
    return True


def _union_from_plain(arguments, value, place):
    reasons = []
    # the exact match first: True is not 1, and 1 must not become 1.0 when int stands in
    # the union
    for argument in sorted(arguments, key=lambda kind: kind is not type(value)):
        try:
            return from_plain(argument, value, place)
        except UserError as error:
            reasons.append(str(error))
    # the first: that of the kind which fits best
    raise UserError(reasons[0])
