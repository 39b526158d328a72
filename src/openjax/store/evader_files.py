"""Evaders from wherever they come: by name, or learned ones as a small file like a policy's."""

import dataclasses
from pathlib import Path
from typing import Any

import jax

from openjax.errors import UserError
from openjax.files import to_plain
from openjax.pursuit import PursuitSettings
from openjax.pursuit.evaders import SCRIPTED, init_network
from openjax.store.policy_files import fill, load_policy_file, save_policy_file

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
            f"--opponent {str(name_or_path)[:60]}: no such evader or file; possible are {', '.join(SCRIPTED)} or a file "
            "written by openjax exploit"
        )
    leaves, settings, _ = load_policy_file(path, "evader's file", "openjax exploit")
    if not any(name.startswith("evader/") for name in leaves):
        raise UserError(
            f"--opponent {path}: holds a policy of pursuers; an evader's file comes from openjax exploit"
        )
    learned_in, plain = settings["environment"], to_plain(game)
    for name in SAME:
        if learned_in.get(name) != plain[name]:
            raise UserError(
                f"--opponent {path}: learned in a game with {name} {learned_in.get(name)}, here it's {plain[name]}"
            )
    abstract = {"evader": jax.eval_shape(init_network, jax.random.key(0))}
    return dataclasses.replace(game, evaders=("learned",)), fill(abstract, leaves, str(path))["evader"]
