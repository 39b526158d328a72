"""`effects.toml`: which effects act, and how strongly. Written by the diagnosis, read by the trainer.

    notes = "optional text"

    [rotor_drag]
    d_xy = { value = 0.012, unit = "N s/m", interval90 = [0.0113, 0.0128] }
    d_z = 0.0            # a bare number is in the parameter's own unit

A parameter that is left out has no effect. `unit` and `interval90` are optional; a unit other than the
parameter's own is an error, so that nothing is converted silently.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import tomlkit

from openjax.errors import UserError
from openjax.files import read_toml, write_text
from openjax.vehicle.effects.effect import Parameter
from openjax.vehicle.effects.registry import EFFECTS

FAR = 100.0
"""Values may lie outside of a parameter's usual range by this many of its widths."""

_KEYS = {"value", "unit", "interval90"}


def load_effects(path: str | Path) -> tuple[tuple[str, ...], dict[str, dict[str, float]]]:
    """Names of the effects, sorted, and {effect: {parameter: value}} from an effects file.

    Raises UserError for a missing or unreadable file, unknown names, wrong units and values that aren't
    numbers.
    """
    path = Path(path)
    table = read_toml(path, "effects file")
    table.pop("notes", None)
    parameters = {}
    for name, entries in table.items():
        if name not in EFFECTS:
            raise UserError(f"{path}: effect {name!r} is unknown; known: {', '.join(EFFECTS)}")
        if not isinstance(entries, dict):
            raise UserError(f"{path}: [{name}] must be a table of its parameters")
        known = EFFECTS[name].parameters
        for parameter in entries:
            if parameter not in known:
                raise UserError(f"{path}: [{name}] has no parameter {parameter!r}; it has {', '.join(known)}")
        parameters[name] = {key: _value(path, name, key, entry, known[key]) for key, entry in entries.items()}
    return tuple(sorted(parameters)), parameters


def _value(path: Path, name: str, key: str, entry, parameter: Parameter) -> float:
    where = f"{path}: [{name}] {key}"
    if isinstance(entry, dict):
        if strangers := sorted(set(entry) - _KEYS):
            raise UserError(f"{where} has an unknown key {strangers[0]!r}; known: {', '.join(sorted(_KEYS))}")
        if entry.get("unit", parameter.unit) != parameter.unit:
            raise UserError(f"{where} is in {entry['unit']!r}; {parameter.unit!r} would be right")
        entry = entry.get("value")
    if isinstance(entry, bool) or not isinstance(entry, int | float) or not np.isfinite(entry):
        raise UserError(f"{where} must be a finite number in {parameter.unit}")
    low, high = parameter.prior
    if not low - FAR * (high - low) <= entry <= high + FAR * (high - low):
        raise UserError(f"{where} = {entry:g} {parameter.unit} is far from what occurs, {low:g} to {high:g}")
    return float(entry)


def save_effects(
    path: str | Path,
    parameters: Mapping[str, Mapping[str, float]],
    intervals: Mapping[str, Mapping[str, tuple[float, float]]] | None = None,
    notes: str = "",
) -> None:
    """Write an effects file: {effect: {parameter: value}}, with 90 % intervals where `intervals` has them.

    Raises UserError for unknown effects or parameters, before anything is written.
    """
    document = tomlkit.document()
    if notes:
        document.add("notes", notes)
    for name in sorted(parameters):
        if name not in EFFECTS:
            raise UserError(f"effect {name!r} is unknown; known: {', '.join(EFFECTS)}")
        effect = EFFECTS[name]
        table = tomlkit.table()
        table.comment(effect.description)
        for key, value in parameters[name].items():
            if key not in effect.parameters:
                raise UserError(
                    f"effect {name!r} has no parameter {key!r}; it has {', '.join(effect.parameters)}"
                )
            entry = tomlkit.inline_table()
            entry.append("value", float(value))
            entry.append("unit", effect.parameters[key].unit)
            interval = (intervals or {}).get(name, {}).get(key)
            if interval is not None:
                entry.append("interval90", [float(bound) for bound in interval])
            table.append(key, entry)
        document.append(name, table)
    write_text(path, tomlkit.dumps(document))


def load_intervals(path: str | Path) -> dict[str, dict[str, tuple[float, float]]]:
    """90 % intervals {effect: {parameter: (low, high)}} of an effects file that `load_effects` accepts."""
    table = read_toml(path, "effects file")
    found: dict[str, dict[str, tuple[float, float]]] = {}
    for name, entries in table.items():
        for key, entry in entries.items() if isinstance(entries, dict) else ():
            interval = entry.get("interval90") if isinstance(entry, dict) else None
            if interval is not None and len(interval) == 2 and interval[0] <= interval[1]:
                found.setdefault(name, {})[key] = (float(interval[0]), float(interval[1]))
    return found
