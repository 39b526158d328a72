"""All effects by name: adding an effect takes one file, here or outside
(`register_effect`).
"""

import importlib
import sys
from collections.abc import Mapping

from openjax.errors import UserError, suggestion
from openjax.vehicle.effect_names import effect_names
from openjax.vehicle.effects.effect import Effect

EFFECTS: dict[str, Effect] = {
    name: importlib.import_module(f"openjax.vehicle.effects.{name}").EFFECT
    for name in effect_names()
}


def register_effect(effect: Effect) -> None:
    """From now on an effect of one's own is flown, written to files and diagnosed as
    shipped ones are.

    Raises:
      UserError: there is another one of that name, or the diagnosis has been loaded
      already, which gives each effect its place when it is.
    """
    if EFFECTS.get(effect.name, effect) is not effect:
        raise UserError(f"effect {effect.name!r}: there is one of that name already")
    if effect.name not in EFFECTS and "openjax.gap.model.library" in sys.modules:
        raise UserError(
            f"effect {effect.name!r}: register it before openjax.gap is imported, which has read "
            "the list of effects"
        )
    EFFECTS[effect.name] = effect


def find_effect(
    name: str,
    parameter: str | None = None,
    prefix: str = "",
    effects: Mapping[str, Effect] = EFFECTS,
) -> Effect:
    """The effect of that name. Raises UserError where there is none, or it hasn't that
    parameter.
    """
    if name not in effects:
        raise UserError(f"{prefix}effect {name!r} is unknown; {suggestion(name, effects)}")
    parameters = effects[name].parameters
    if parameter is not None and parameter not in parameters:
        raise UserError(
            f"{prefix}effect {name!r} has no parameter {parameter!r}; it has "
            f"{', '.join(parameters)}"
        )
    return effects[name]
