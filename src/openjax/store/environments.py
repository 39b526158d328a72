"""The game with what files add to it: a vehicle, physical effects, an evader."""

import dataclasses
import functools
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from openjax.errors import UserError
from openjax.evaluation.judges.networks import init_network
from openjax.evaluation.judges.opponent import opponent as learned_opponent
from openjax.evaluation.judges.senses import number_of_senses
from openjax.files import to_plain
from openjax.pursuit import Pursuit, PursuitSettings
from openjax.pursuit.evaders import SCRIPTED, Evader, EvaderKind
from openjax.store.own_code import is_own_code, own_code
from openjax.store.policy_files import fill, load_policy_file, save_policy_file
from openjax.vehicle.effects import load_effects
from openjax.vehicle.effects.effects_file import unusual_values
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
    """The game of the airframe that a vehicle file, or a name, says; a family of the
    former one becomes the new one's.

    Raises:
      UserError: a file that can't be used.
    """
    airframe = settings.airframe if vehicle is None else load_vehicle_file(vehicle).airframe
    # a vehicle of one's own is no airframe by name: it flies in the game as it is
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
    """The game with the vehicle of a vehicle.toml, or of an airframe's name, the
    effects of an effects.toml, and one evader, where given: a scripted one's name, or
    see `find_opponent`.

    Raises:
      UserError: a file that can't be used, or an evader that nobody knows.
    """
    evaders = None
    if isinstance(opponent, str | Path) and str(opponent) in SCRIPTED:
        settings = dataclasses.replace(settings, evaders=(str(opponent),))
    elif opponent is not None:
        evaders = (find_opponent(opponent, settings),)
    names, parameters = load_effects(effects) if effects else ((), {})
    for text in unusual_values(effects) if effects else ():
        _warn(text)
    return Pursuit(
        with_airframe(settings, vehicle),
        vehicle=load_vehicle_file(vehicle).vehicle if vehicle else None,
        effects=names,
        effect_parameters=parameters,
        evaders=evaders,
    )


@functools.cache
def _warn(text: str) -> None:
    """Say it once, however often a command makes its game."""
    print(f"warning: {text}", file=sys.stderr)


def is_evader_file(opponent: Any) -> bool:
    """True if it is a file that `openjax exploit` wrote, neither a scripted
    evader's name nor code.
    """
    is_name = isinstance(opponent, str | Path) and str(opponent) not in SCRIPTED
    return is_name and not is_own_code(opponent)


def save_evader(
    path: Path, evader: tuple[Any, jax.Array], hold: int, game: PursuitSettings, notes: dict
) -> None:
    """Write a learned evader, its actor and whether it sees in the world's axes, how
    many control steps it holds a decision, and the game that it learned.
    """
    actor, world_axes = evader
    content = {"evader": {"actor": actor, "world_axes": world_axes, "hold": jnp.int32(hold)}}
    save_policy_file(path, content, {"environment": game}, notes, storage="float32")


def _check_game(path, learned_in, game):
    """Raises UserError where a file's evader learned in a game unlike this one."""
    plain = to_plain(game)
    for name in SAME:
        if learned_in.get(name) != plain[name]:
            raise UserError(
                f"--opponent {path}: learned in a game with {name} {learned_in.get(name)}, here "
                f"it's {plain[name]}"
            )
    slots = learned_in["max_pillars"]
    if game.max_pillars > slots:
        raise UserError(
            f"--opponent {path}: senses {slots} pillars at most, the game has up to "
            f"{game.max_pillars}; environment.max_pillars {slots} would be right"
        )


def find_opponent(evader: str | Path | Evader, game: PursuitSettings) -> Evader:
    """An evader that isn't one of the library's.

    Args:
      evader: a function or row of one's own, or `FILE.py:function`, or a file that
        `openjax exploit` wrote.
      game: that it shall play.

    Raises:
      UserError: nobody of that name, no such file, or an evader of another game.
    """
    if not isinstance(evader, str | Path):
        return evader
    if is_own_code(evader):
        what = "function {}(scene, memory) that gives a velocity and the memory"
        return own_code("--opponent", evader, (EvaderKind,), what)
    path = Path(evader)
    if not path.is_file():
        raise UserError(
            f"--opponent {str(evader)[:60]}: no such evader or file; possible are "
            f"{', '.join(SCRIPTED)}, FILE.py:function, or a file written by openjax exploit"
        )
    leaves, settings, _ = load_policy_file(path, "evader's file", "openjax exploit")
    if not {"evader/hold", "evader/actor/bias_0", "evader/actor/bias_2"} <= set(leaves):
        raise UserError(
            f"--opponent {path}: holds no evader of this version; openjax exploit writes one"
        )
    learned_in = settings["environment"]
    _check_game(path, learned_in, game)
    slots = learned_in["max_pillars"]
    # the network's sizes are those of its biases
    width, outputs = (leaves[f"evader/actor/bias_{layer}"].shape[-1] for layer in (0, 2))
    sizes = (number_of_senses(game.num_pursuers, slots), outputs)
    actor = jax.eval_shape(lambda key: init_network(key, [width], sizes), jax.random.key(0))
    one = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), actor)
    scalar = {"world_axes": jnp.bool_, "hold": jnp.int32}
    abstract = {name: jax.ShapeDtypeStruct((), kind) for name, kind in scalar.items()}
    content = fill({"evader": {"actor": one, **abstract}}, leaves, str(path))["evader"]
    return learned_opponent(content["actor"], content["world_axes"], int(content["hold"]), slots)
