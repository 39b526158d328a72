"""A policy for a game in which it observes more: the same policy until it learns to use
it.
"""

from collections.abc import Mapping

import jax.numpy as jnp

from openjax.errors import UserError
from openjax.policy.policy import PolicyParameters
from openjax.policy.settings import PredictorSettings
from openjax.pursuit.settings import OWN_FRAME, PursuitSettings


def in_larger_game(
    parameters: PolicyParameters,
    predictor: PredictorSettings,
    old: PursuitSettings,
    new: PursuitSettings,
) -> PolicyParameters:
    """`parameters` of a policy trained in the game `old`, for the game `new`, which
    observes the same or more.

    The first layers' weights for what is additional are zero. The critic, which may see
    other privileged numbers as well, is left out where something is.

    Raises:
      UserError: the policy isn't made of networks.
    """
    inputs = _rows(_own_parts(old, predictor), _own_parts(new, predictor))
    frames = _rows(_frame_parts(old), _frame_parts(new))
    if inputs is None and frames is None:
        return parameters
    if not (isinstance(parameters.actor, Mapping) and "params" in parameters.actor):
        raise UserError("the policy has no networks that could learn")
    params = dict(parameters.actor["params"])
    encoder = dict(params["encoder"])
    kernel = _with_rows(encoder["self_1"]["kernel"], inputs)
    # to a multiple of eight, as the encoder pads what it observes
    kernel = jnp.pad(kernel, ((0, -kernel.shape[0] % 8), (0, 0)))
    encoder["self_1"] = {**encoder["self_1"], "kernel": kernel}
    actor = {**parameters.actor, "params": {**params, "encoder": encoder}}
    guesses = parameters.predictor
    if predictor.enabled:
        layers = dict(guesses["params"])
        layers["input"] = {
            **layers["input"],
            "kernel": _with_rows(layers["input"]["kernel"], frames),
        }
        guesses = {**guesses, "params": layers}
    return parameters.replace(actor=actor, critic={}, predictor=guesses)


def _own_parts(game: PursuitSettings, predictor: PredictorSettings) -> dict[str, int]:
    """The parts of a pursuer's own observation, name -> size, in the order of
    `Observation.self_state`, and the predicted positions behind it.
    """
    parts = {
        "axes": 16,
        "time": 4 * game.observe_time,
        "position": 3 * game.observe_position,
        "game": 2 * game.observe_game,
        "arena": int(game.observe_arena),
    }
    # the oldest frame comes first
    for age in reversed(range(game.observe_history)):
        parts[f"frame {age}"] = OWN_FRAME
    if predictor.enabled:
        parts["predicted"] = 3 * len(predictor.horizons)
    return parts


def _frame_parts(game: PursuitSettings) -> dict[str, int]:
    """The same of a frame from which the evader is predicted."""
    parts = {"time, evader": 7}
    if game.history_pursuers != "pooled":
        parts["each"] = 3 * game.num_pursuers
    if game.history_pursuers != "each":
        parts["pooled"] = 6
    return parts


def _rows(old: dict[str, int], new: dict[str, int]) -> list[tuple[int, int, int]] | None:
    """For each part of the new input its first row in the old one, how many rows it has
    there, and how many are additional; None where none is.
    """
    if any(size > new.get(name, 0) for name, size in old.items()):
        return None  # another game, not a larger one
    if sum(old.values()) == sum(new.values()):
        return None
    place = 0
    firsts = {}
    for name, size in old.items():
        firsts[name] = place
        place += size
    rows = []
    for name, size in new.items():
        old_size = old.get(name, 0)
        rows.append((firsts.get(name, 0), old_size, size - old_size))
    return rows


def _with_rows(kernel, rows):
    """A kernel (inputs, units) with zeros in the rows of what is additional, and
    without those of an encoder's padding, which are added anew for the new size.
    """
    if rows is None:
        return kernel
    parts = []
    for first, old_size, more in rows:
        parts += [
            kernel[first : first + old_size],
            jnp.zeros((more, kernel.shape[1]), kernel.dtype),
        ]
    return jnp.concatenate(parts)
