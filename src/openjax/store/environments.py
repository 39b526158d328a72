"""The game with what files add to it: a vehicle, physical effects, an evader."""

import dataclasses
from pathlib import Path

import jax

from openjax.pursuit import Pursuit, PursuitSettings
from openjax.store.evader_files import find_opponent
from openjax.vehicle.effects import load_effects
from openjax.vehicle.family import vehicle_family
from openjax.vehicle.parameters import AIRFRAMES
from openjax.vehicle.vehicle_file import load_vehicle_file


def with_airframe(settings: PursuitSettings, vehicle: Path | None) -> PursuitSettings:
    """The game of the airframe that a vehicle file, or a name, says; a family of the former one becomes the new one's.

    Raises:
      UserError: a file that can't be used.
    """
    airframe = settings.airframe if vehicle is None else load_vehicle_file(vehicle).airframe
    if airframe == settings.airframe or airframe not in AIRFRAMES:
        return settings
    if settings.vehicles and settings.vehicles == vehicle_family(settings.airframe):
        settings = dataclasses.replace(settings, vehicles=vehicle_family(airframe))
    return dataclasses.replace(settings, airframe=airframe)


def make_environment(
    settings: PursuitSettings, vehicle: Path | None, effects: Path | None, opponent: str | Path | None = None
) -> Pursuit:
    """The game with the vehicle of a vehicle.toml, or of an airframe's name, the effects of an effects.toml, and one evader
    (`find_opponent`), where given.

    Raises:
      UserError: a file that can't be used, or an evader that nobody knows.
    """
    network = None
    if opponent is not None:
        settings, network = find_opponent(opponent, settings)
    names, parameters = load_effects(effects) if effects else ((), {})
    return Pursuit(
        with_airframe(settings, vehicle),
        vehicle=load_vehicle_file(vehicle).vehicle if vehicle else None,
        effects=names,
        effect_parameters=parameters,
        evader_networks=None if network is None else jax.tree.map(lambda leaf: leaf[None], network),
    )
