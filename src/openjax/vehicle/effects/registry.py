"""All effects by name. Each module of this package that defines `EFFECT` is one: adding an effect takes one
file."""

import importlib
import pkgutil

from openjax.vehicle.effects.effect import Effect


def _discover() -> dict[str, Effect]:
    package = __name__.rpartition(".")[0]
    paths = importlib.import_module(package).__path__
    names = sorted(module.name for module in pkgutil.iter_modules(paths) if not module.name.startswith("_"))
    skip = __name__.rpartition(".")[2]
    found = (
        getattr(importlib.import_module(f"{package}.{name}"), "EFFECT", None)
        for name in names
        if name not in (skip, "composition", "effects_file")
    )
    return {effect.name: effect for effect in found if effect is not None}


EFFECTS: dict[str, Effect] = _discover()
