"""All effects by name: adding an effect takes one file."""

import importlib
from collections.abc import Mapping

from openjax.errors import UserError, suggestion
from openjax.vehicle.effect_names import effect_names
from openjax.vehicle.effects.effect import Effect

EFFECTS: dict[str, Effect] = {
    name: importlib.import_module(f"openjax.vehicle.effects.{name}").EFFECT
    for name in effect_names()
}


def find_effect(
    name: str, parameter: str | None = None, where: str = "", known: Mapping[str, Effect] = EFFECTS
) -> Effect:
    """The effect of that name. Raises UserError where there is none, or it hasn't that
    parameter.
    """
    if name not in known:
        raise UserError(f"{where}effect {name!r} is unknown; {suggestion(name, known)}")
    own = known[name].parameters
    if parameter is not None and parameter not in own:
        raise UserError(
            f"{where}effect {name!r} has no parameter {parameter!r}; it has {', '.join(own)}"
        )
    return known[name]
