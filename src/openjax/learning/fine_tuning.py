"""Fine-tuning a policy to one diagnosed vehicle: the updates one after the other, and
which of the policies on the way is kept.
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from openjax.learning.adaptation import Adaptation
from openjax.learning.train_state import TrainState
from openjax.policy import PolicyParameters


@dataclass(frozen=True)
class Look:
    """A policy's episodes, of the same tasks and vehicles each time."""

    scores: Float[np.ndarray, " episodes"]
    """What is to be large."""
    steps: Float[np.ndarray, " episodes"]
    """Control steps to the capture."""


@dataclass(frozen=True)
class Tuned:
    """What fine-tuning led to."""

    parameters: PolicyParameters
    """The best of those looked at, the first ones among them; without a critic."""
    update: int
    """After which update they were found; 0: they are the first ones."""
    history: list[dict[str, float]]
    """Metrics of each update."""
    looks: dict[int, float]
    """{update: mean score}."""


def fine_tune(
    adaptation: Adaptation,
    parameters: PolicyParameters,
    bounds: Float[Array, "ranges 4"],
    key: PRNGKeyArray,
    look: Callable[[PolicyParameters], Look],
) -> Tuned:
    """Train `parameters` (from `starting_parameters`) on vehicles within `bounds` (R,
    4), and keep the best on the way.

    `look` flies a policy; what doesn't improve on the first parameters, by the
    differences of single episodes, isn't kept.
    """
    settings = adaptation.settings
    bounds = jnp.asarray(bounds)
    fly_key, update_key = jax.random.split(key)
    flights = adaptation.fly(parameters, fly_key, bounds)
    actor = TrainState(parameters.actor, adaptation.optimiser.init(parameters.actor))
    history = []
    first = look(parameters)
    best = parameters
    best_update = 0
    looks = {0: float(first.scores.mean())}
    for update in range(1, settings.updates + 1):
        step_key = jax.random.fold_in(update_key, update)
        actor, metrics = adaptation.update(actor, parameters, flights, step_key, bounds)
        history.append(metrics)
        if update % settings.look_every == 0 or update == settings.updates:
            candidate = parameters.replace(actor=actor.parameters)
            ahead = look(candidate)
            looks[update] = float(ahead.scores.mean())
            # better than the best so far by the mean, and than the first ones beyond
            # doubt: each look is another chance to be lucky
            if looks[update] > looks[best_update] and improves(first, ahead):
                best = candidate
                best_update = update
    # fetched at the end: to wait for every update's numbers would leave the device idle
    history = [
        {name: float(value) for name, value in row.items()} for row in jax.device_get(history)
    ]
    return Tuned(best, best_update, history, looks)


def improves(first: Look, ahead: Look) -> bool:
    """Whether a policy is clearly better, or clearly sooner and no worse.

    In scores a crash is worth thousands of steps, and is rare: where a vehicle costs
    time alone, a thousand episodes' scores don't tell what is won from chance.
    """
    if clearly_better(first.scores, ahead.scores):
        return True
    no_worse = ahead.scores.mean() >= first.scores.mean()
    return bool(no_worse) and clearly_better(-first.steps, -ahead.steps)


def clearly_better(
    first: Float[np.ndarray, " episodes"],
    scores: Float[np.ndarray, " episodes"],
    errors: float = 2.0,
) -> bool:
    """Whether the scores (B,) of the same episodes rose by more than so many standard
    errors of their differences.
    """
    gain = np.asarray(scores, float) - np.asarray(first, float)
    return bool(gain.mean() > errors * gain.std() / np.sqrt(len(gain)))
