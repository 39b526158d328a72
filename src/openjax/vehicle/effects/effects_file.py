"""`effects.toml`: which effects act, and how strongly. Written by the diagnosis, read
by the trainer.

    notes = "optional text"

    [rotor_drag]
    d_xy = { value = 0.012, unit = "N s/m", interval90 = [0.0113, 0.0128] }
    d_z = 0.0            # a bare number is in the parameter's own unit

A parameter that is left out has no effect. `unit` and `interval90` are optional; a unit
other than the parameter's own is an error, so that nothing is converted silently.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import tomlkit

from openjax.errors import UserError
from openjax.files import read_toml, write_text
from openjax.plain import from_plain
from openjax.vehicle.effects.effect import Parameter
from openjax.vehicle.effects.registry import find_effect

FAR = 100.0
"""Values may lie outside of a parameter's usual range by this many of its widths."""
UNUSUAL = 3.0
"""Times what is usual, from which on a value is worth a warning."""


@dataclasses.dataclass(frozen=True)
class _Entry:
    """A parameter of an effect."""

    value: float
    unit: str | None = None
    interval90: tuple[float, float] | None = None


def load_effects(path: str | Path) -> tuple[tuple[str, ...], dict[str, dict[str, float]]]:
    """Names of the effects, sorted, and {effect: {parameter: value}} from an effects
    file.

    Raises UserError for a missing or unreadable file, unknown names, wrong units and
    values that aren't numbers.
    """
    effects = _read(Path(path))
    values = {
        name: {key: entry.value for key, entry in entries.items()}
        for name, entries in effects.items()
    }
    return tuple(sorted(effects)), values


def load_intervals(path: str | Path) -> dict[str, dict[str, tuple[float, float]]]:
    """90 % intervals {effect: {parameter: (low, high)}} of an effects file, of those
    that have any.
    """
    by_name = {}
    for name, entries in _read(Path(path)).items():
        intervals = {key: entry.interval90 for key, entry in entries.items() if entry.interval90}
        if intervals:
            by_name[name] = intervals
    return by_name


def unusual_values(path: str | Path) -> list[str]:
    """Values of an effects file that are several times as large as is usual, in words:
    right for a larger vehicle than a Crazyflie, else probably a wrong unit.
    """
    return [
        f"{path}: {name}.{key} = {entry.value:g} {parameter.unit} is more than "
        f"{UNUSUAL:g} times what is usual, {low:g} to {high:g}"
        for name, entries in _read(Path(path)).items()
        for key, entry in entries.items()
        for parameter in [find_effect(name, key).parameters[key]]
        for low, high in [parameter.prior]
        if abs(entry.value - parameter.none)
        > UNUSUAL * max(abs(low - parameter.none), abs(high - parameter.none))
    ]


def _read(path: Path) -> dict[str, dict[str, _Entry]]:
    """The entries of an effects file."""
    table = read_toml(path, "effects file")
    values = {}
    table.pop("notes", None)
    for name, entries in table.items():
        if not isinstance(entries, dict):
            raise UserError(f"{path}: [{name}] must be a table of its parameters")
        find_effect(name, prefix=f"{path}: ")
        values[name] = {key: _entry(path, name, key, entry) for key, entry in entries.items()}
    return values


def _entry(path: Path, name: str, key: str, text) -> _Entry:
    """One parameter's entry from what TOML reads, a number or a table."""
    place = f"{path}: {name}.{key}"
    parameter = find_effect(name, key, f"{path}: ").parameters[key]
    entry = from_plain(_Entry, text if isinstance(text, dict) else {"value": text}, place)
    if entry.unit not in (None, parameter.unit):
        raise UserError(f"{place} is in {entry.unit!r}; {parameter.unit!r} would be right")
    if entry.interval90 is not None and not entry.interval90[0] <= entry.interval90[1]:
        raise UserError(
            f"{place}: interval90 is {list(entry.interval90)}; low must not exceed high"
        )
    if entry.interval90 is not None:
        low, high = entry.interval90
        slack = 1e-5 * max(abs(low), abs(high))  # of numbers written with six digits
        if not low - slack <= entry.value <= high + slack:
            raise UserError(
                f"{place} = {entry.value:g} lies outside its interval90, {low} to {high}"
            )
    for number in (entry.value, *(entry.interval90 or ())):
        _check_number(parameter, number, place)
    return entry


def _check_number(parameter: Parameter, number: float, place: str) -> None:
    """Refuse a value, or an end of an interval, that no vehicle has."""
    usual = parameter.prior
    reach = FAR * (usual[1] - usual[0])
    if not usual[0] - reach <= number <= usual[1] + reach:
        raise UserError(
            f"{place} = {number:g} {parameter.unit} is far from what occurs, {usual[0]:g} to "
            f"{usual[1]:g}"
        )
    low, high = parameter.limits()
    slack = 1e-6 * (usual[1] - usual[0])  # of numbers written with six digits
    if not low - slack <= number <= high + slack:
        raise UserError(
            f"{place} = {number:g} {parameter.unit} can't be; it lies between {low:g} and {high:g}"
        )


def save_effects(
    path: str | Path,
    parameters: Mapping[str, Mapping[str, float]],
    intervals: Mapping[str, Mapping[str, tuple[float, float]]] | None = None,
    notes: str = "",
) -> None:
    """Write an effects file: {effect: {parameter: value}}, with 90 % intervals where
    `intervals` has them.

    Raises UserError for unknown effects or parameters, before anything is written.
    """
    document = tomlkit.document()
    if notes:
        document.add("notes", notes)
    for name in sorted(parameters):
        effect = find_effect(name)
        table = tomlkit.table()
        table.comment(effect.description)
        for key, value in parameters[name].items():
            find_effect(name, key)
            entry = tomlkit.inline_table()
            entry.append("value", float(value))
            entry.append("unit", effect.parameters[key].unit)
            interval = (intervals or {}).get(name, {}).get(key)
            if interval is not None:
                entry.append("interval90", [float(bound) for bound in interval])
            table.append(key, entry)
        document.append(name, table)
    write_text(path, tomlkit.dumps(document))
