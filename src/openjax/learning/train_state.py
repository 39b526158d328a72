"""A network while it learns: its parameters and its optimiser's state, side by side."""

import re
from typing import Any

import jax
import optax
from flax import struct
from jaxtyping import Array, Int32, PRNGKeyArray


@struct.dataclass
class TrainState:
    """One network. Flax's own would carry the optimiser itself, which would make every
    build a carry of another type.
    """

    parameters: Any
    optimiser: Any
    """State of the `optax` transformation."""

    def update(
        self, optimiser: optax.GradientTransformation, gradient: Any, **others: Any
    ) -> "TrainState":
        """One step against `gradient`, a tree like the parameters; `others` is what
        else the optimiser's update takes.
        """
        update, state = optimiser.update(gradient, self.optimiser, self.parameters, **others)
        return TrainState(optax.apply_updates(self.parameters, update), state)


def clipped_adam(
    max_norm: float, rate: optax.ScalarOrSchedule, last: optax.GradientTransformation | None = None
) -> optax.GradientTransformationExtraArgs:
    """Adam of gradients cut at norm `max_norm`, and one more transformation behind it.

    On one vector instead of dozens of small arrays: on a GPU their updates cost by
    number, not by size.
    """
    # PPO's usual epsilon, a thousand times Adam's own: where a gradient has nearly
    # vanished, its noise isn't blown up to whole steps
    steps = [optax.clip_by_global_norm(max_norm), optax.adam(rate, eps=1e-5)]
    if last is not None:
        steps.append(last)
    return optax.flatten(optax.chain(*steps))


def shuffle(
    key: PRNGKeyArray, epochs: int, minibatches: int
) -> Int32[Array, " {epochs*minibatches}"]:
    """(epochs * minibatches,) the minibatches in the order in which they are learnt
    from, each once in an epoch.
    """
    keys = jax.random.split(key, epochs)
    return jax.vmap(lambda key: jax.random.permutation(key, minibatches))(keys).ravel()


_NETWORK = "(actor|critic|predictor)"
_LEAF = re.compile(f"policy/{_NETWORK}/(.+)")
_OLD_LEAF = re.compile(f"{_NETWORK}/parameters/(.+)")


def policy_leaf(name: str) -> str | None:
    """The path in `PolicyParameters` of a leaf of a training carry: `actor/params/x`
    for `policy/actor/params/x`.

    None for one that isn't of the policy. In carries from when each network lay beside
    its optimiser it is `actor/parameters/params/x`.
    """
    # old runs can't be resumed, but their policies load
    match = _LEAF.fullmatch(name) or _OLD_LEAF.fullmatch(name)
    return "/".join(match.groups()) if match else None
