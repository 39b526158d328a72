"""All effects by name: adding an effect takes one file."""

import importlib

from openjax.vehicle.effect_names import effect_names
from openjax.vehicle.effects.effect import Effect

EFFECTS: dict[str, Effect] = {
    name: importlib.import_module(f"openjax.vehicle.effects.{name}").EFFECT for name in effect_names()
}
