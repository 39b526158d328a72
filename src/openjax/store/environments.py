"""The game with what two files add to it: a vehicle and physical effects."""

from pathlib import Path

from openjax.pursuit import Pursuit, PursuitSettings
from openjax.vehicle.effects import load_effects
from openjax.vehicle.vehicle_file import load_vehicle_file


def make_environment(settings: PursuitSettings, vehicle: Path | None, effects: Path | None) -> Pursuit:
    """The game with the vehicle of a vehicle.toml and the effects of an effects.toml, where given.

    Raises:
      UserError: a file that can't be used.
    """
    names, parameters = load_effects(effects) if effects else ((), {})
    return Pursuit(
        settings,
        vehicle=load_vehicle_file(vehicle).vehicle if vehicle else None,
        effects=names,
        effect_parameters=parameters,
    )
