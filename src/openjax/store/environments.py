"""The game with what files add to it: a vehicle, physical effects, an evader."""

import dataclasses
import importlib.util
from pathlib import Path
from typing import Any

import jax

from openjax.errors import UserError
from openjax.files import to_plain
from openjax.pursuit import Pursuit, PursuitSettings
from openjax.pursuit.evaders import SCRIPTED, Evader, EvaderKind, init_network
from openjax.store.policy_files import fill, load_policy_file, save_policy_file
from openjax.vehicle.effects import load_effects
from openjax.vehicle.family import vehicle_family
from openjax.vehicle.parameters import AIRFRAMES
from openjax.vehicle.vehicle_file import load_vehicle_file

SAME = (
    "num_pursuers",
    "arena_radius",
    "arena_height",
    "pillar_radius",
    "capture_radius",
    "evader_speed",
    "max_speed",
    "time_step",
)
"""Settings of the game that an evader learned; it can't play another."""


def with_airframe(settings: PursuitSettings, vehicle: Path | None) -> PursuitSettings:
    """The game of the airframe that a vehicle file, or a name, says; a family of the former one
    becomes the new one's.

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
    settings: PursuitSettings,
    vehicle: Path | None,
    effects: Path | None,
    opponent: str | Path | Evader | None = None,
) -> Pursuit:
    """The game with the vehicle of a vehicle.toml, or of an airframe's name, the effects of an
    effects.toml, and one evader (`find_opponent`, or one's own), where given.

    Raises:
      UserError: a file that can't be used, or an evader that nobody knows.
    """
    network = evaders = None
    if is_own_code(opponent):
        opponent = own_evader(opponent)
    if opponent is not None and not isinstance(opponent, str | Path):
        evaders = (opponent,)
    elif opponent is not None:
        settings, network = find_opponent(opponent, settings)
    names, parameters = load_effects(effects) if effects else ((), {})
    return Pursuit(
        with_airframe(settings, vehicle),
        vehicle=load_vehicle_file(vehicle).vehicle if vehicle else None,
        effects=names,
        effect_parameters=parameters,
        evaders=evaders,
        evader_networks=None if network is None else jax.tree.map(lambda leaf: leaf[None], network),
    )


def is_own_code(name: Any) -> bool:
    """Whether it names a function in a Python file, `FILE.py:function`."""
    return isinstance(name, str) and ".py:" in name


def own_evader(name: str) -> Evader:
    """The function, or the row, that `FILE.py:function` names; the file is run.

    Raises:
      UserError: no such file, it doesn't run, or it has nothing of that name.
    """
    file, _, attribute = name.rpartition(":")
    path = Path(file)
    if not path.is_file():
        raise UserError(f"--opponent {name}: there is no file {file}")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:  # whatever the file does
        raise UserError(f"--opponent {name}: {path} doesn't run: {error}") from error
    found = getattr(module, attribute, None)
    if not callable(found) and not isinstance(found, EvaderKind):
        raise UserError(
            f"--opponent {name}: {path} has no function {attribute}(scene, memory) that gives a "
            "velocity and the memory"
        )
    return found


def save_evader(path: Path, network: Any, game: PursuitSettings, notes: dict) -> None:
    """Write a learned evader and the game that it learned."""
    game = dataclasses.replace(game, evaders=("learned",))
    save_policy_file(path, {"evader": network}, {"environment": game}, notes, storage="float32")


def find_opponent(name_or_path: str | Path, game: PursuitSettings) -> tuple[PursuitSettings, Any]:
    """A game with one evader, and the network of that where it is learned (else None).

    Args:
      name_or_path: a scripted evader's name, or a file that `openjax exploit` wrote.
      game: the game otherwise.

    Raises:
      UserError: nobody of that name, no such file, or an evader of another game.
    """
    if str(name_or_path) in SCRIPTED:
        return dataclasses.replace(game, evaders=(str(name_or_path),)), None
    path = Path(name_or_path)
    if not path.is_file():
        raise UserError(
            f"--opponent {str(name_or_path)[:60]}: no such evader or file; possible are "
            f"{', '.join(SCRIPTED)} or a file "
            "written by openjax exploit"
        )
    leaves, settings, _ = load_policy_file(path, "evader's file", "openjax exploit")
    if not any(name.startswith("evader/") for name in leaves):
        raise UserError(
            f"--opponent {path}: holds a policy of pursuers; an evader's file comes from openjax "
            "exploit"
        )
    learned_in = settings["environment"]
    plain = to_plain(game)
    for name in SAME:
        if learned_in.get(name) != plain[name]:
            raise UserError(
                f"--opponent {path}: learned in a game with {name} {learned_in.get(name)}, here "
                f"it's {plain[name]}"
            )
    abstract = {"evader": jax.eval_shape(init_network, jax.random.key(0))}
    return dataclasses.replace(game, evaders=("learned",)), fill(abstract, leaves, str(path))[
        "evader"
    ]
