"""Proximal policy optimisation (Schulman et al., 2017, arXiv 1707.06347) for all that
learn by it: the pursuers (`mappo`), the evaders that learn beside them (`evasion`), and
a judge's evaders (`openjax.evaluation.judges.best_response`).

Each hands in networks of its own, what these were shown, and how samples are averaged.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct

from openjax.learning.train_state import TrainState

Mean = Callable[[jax.Array], jax.Array]
"""The mean over samples; of several learners at once, each its own."""


@struct.dataclass
class Samples:
    """The samples to learn from, with the same leading axes."""

    inputs: Any
    """The inputs of the networks: observations and actions."""
    log_prob: jax.Array  # (...) of what was done, by the networks that did it
    advantage: jax.Array  # (...) of mean zero and standard deviation one
    target: jax.Array  # (...) of the values


class NetworkOutputs(NamedTuple):
    """The outputs of the learning networks for samples."""

    log_prob: jax.Array  # (...) of what was done
    value: jax.Array  # (...)
    bonus: jax.Array | float
    """() of the entropy, weighted"""


class Terms(NamedTuple):
    """The terms of the loss, and their ratio of probabilities."""

    policy_loss: jax.Array
    value_loss: jax.Array
    ratio: jax.Array  # (...)
    log_ratio: jax.Array  # (...)


@dataclass(frozen=True)
class Objective:
    """The loss that gradient steps minimise."""

    mean: Mean
    clip: jax.Array | float
    """The ratio of probabilities counts within 1 +- this."""
    value_error: Callable[[jax.Array, jax.Array], jax.Array]
    """Values, targets -> errors."""
    value_coefficient: float = 1.0

    def loss(self, answer: NetworkOutputs, samples: Samples) -> tuple[jax.Array, Terms]:
        """Sum of the policy's and the values' loss; and its terms."""
        log_ratio = answer.log_prob - samples.log_prob
        ratio = jnp.exp(log_ratio)
        clipped_ratio = jnp.clip(ratio, 1.0 - self.clip, 1.0 + self.clip)
        # the lesser of both: a pessimistic bound (section 3)
        surrogate = jnp.minimum(ratio * samples.advantage, clipped_ratio * samples.advantage)
        policy_loss = -self.mean(surrogate) - answer.bonus
        value_loss = self.mean(self.value_error(answer.value, samples.target))
        terms = Terms(policy_loss, value_loss, ratio, log_ratio)
        return policy_loss + self.value_coefficient * value_loss, terms

    def watch(self, terms: Terms) -> dict[str, jax.Array]:
        """() metrics of one loss."""
        return {
            # the same mean as that of -log_ratio, with less noise and never negative
            # (Schulman 2020, Approximating KL divergence)
            "kl": self.mean(terms.ratio - 1.0 - terms.log_ratio),
            "clipped": self.mean(jnp.abs(terms.ratio - 1.0) > self.clip),
            "policy_loss": terms.policy_loss,
            "value_loss": terms.value_loss,
        }


def normalise(advantage: jax.Array, mean: Mean) -> jax.Array:
    """Advantages less their mean, in standard deviations."""
    deviation = advantage - mean(advantage)
    return deviation / (jnp.sqrt(mean(deviation**2)) + 1e-8)


def gradient_steps(
    networks: tuple[TrainState, ...],
    optimisers: tuple[optax.GradientTransformationExtraArgs, ...],
    gradient: Callable[[tuple[Any, ...], Any], tuple[tuple[Any, ...], dict[str, jax.Array]]],
    order: Any,
    names: tuple[str, ...] = (),
) -> tuple[tuple[TrainState, ...], dict[str, jax.Array]]:
    """Networks after a gradient step on each of the minibatches.

    Args:
      networks: parameters, and their optimisers' states.
      optimisers: of each; their updates take what is watched, too.
      gradient: parameters of all, one of `order` -> their gradients, and what to watch.
      order: (S, ...) where the minibatches are found.
      names: of what is watched, which is told.

    Returns:
      the networks, and the means of what has these `names`.
    """

    def step(networks, minibatch):
        parameters = tuple(network.parameters for network in networks)
        gradients, watch = gradient(parameters, minibatch)
        networks = tuple(
            network.update(optimiser, of_network, **watch)
            for network, optimiser, of_network in zip(networks, optimisers, gradients, strict=True)
        )
        return networks, jnp.stack([watch[name] for name in names]) if names else None

    networks, measures = jax.lax.scan(step, networks, order)
    if not names:
        return networks, {}
    return networks, dict(zip(names, jnp.mean(measures, axis=0), strict=True))


def for_many(
    optimiser: optax.GradientTransformation,
) -> optax.GradientTransformationExtraArgs:
    """The same optimiser for each of many networks, whose axis is every leaf's first."""

    def update(gradient, state, parameters=None, **watch):
        return jax.vmap(optimiser.update)(gradient, state, parameters)

    return optax.GradientTransformationExtraArgs(jax.vmap(optimiser.init), update)
