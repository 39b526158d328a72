"""A network while it learns: its parameters and its optimiser's state, side by side."""

import re
from typing import Any

import jax
import optax
from flax import struct
from jaxtyping import Array, Int32, PRNGKeyArray


@struct.dataclass
class TrainState:
    """One network. Flax's own would carry the optimiser itself, which would make every build a
    carry of another type.
    """

    parameters: Any
    optimiser: Any
    """State of the `optax` transformation."""

    def updated(
        self, optimiser: optax.GradientTransformation, gradient: Any, **others: Any
    ) -> "TrainState":
        """One step against `gradient`, a tree like the parameters; `others` is what else the
        optimiser's update takes.
        """
        update, state = optimiser.update(gradient, self.optimiser, self.parameters, **others)
        return TrainState(optax.apply_updates(self.parameters, update), state)


def clipped_adam(
    most: float, rate: optax.ScalarOrSchedule, *after
) -> optax.GradientTransformationExtraArgs:
    """Adam of gradients cut at norm `most`, and what comes after it.

    On one vector instead of dozens of small arrays: on a GPU their updates cost by number, not by
    size.
    """
    return optax.flatten(
        optax.chain(optax.clip_by_global_norm(most), optax.adam(rate, eps=1e-5), *after)
    )


def shuffled(
    key: PRNGKeyArray, epochs: int, minibatches: int
) -> Int32[Array, " {epochs*minibatches}"]:
    """(epochs * minibatches,) the minibatches in the order in which they are learnt from, each once
    in an epoch.
    """
    keys = jax.random.split(key, epochs)
    return jax.vmap(lambda key: jax.random.permutation(key, minibatches))(keys).ravel()


_NETWORK = "(actor|critic|predictor)"
_OF_POLICY = re.compile(f"policy/{_NETWORK}/(.+)"), re.compile(f"{_NETWORK}/parameters/(.+)")


def policy_leaf(name: str) -> str | None:
    """The path in `PolicyParameters` of a leaf of a training carry: `actor/params/x` for
    `policy/actor/params/x`.

    None for one that isn't of the policy. In carries from when each network lay beside its
    optimiser it is `actor/parameters/params/x`.
    """
    for pattern in _OF_POLICY:
        if found := pattern.fullmatch(name):
            return "/".join(found.groups())
    return None
