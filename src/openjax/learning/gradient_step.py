"""What the three stages by the gradient through the simulation have in common: before
MAPPO (`first_flights`), after it (`analytic_gradient`), and for a diagnosed vehicle
(`adaptation`).

Each flies the policy's mean for some steps, adds up weighted parts of what its pursuers
met, and lets the actor follow the gradient.
"""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float

from openjax.policy import Policy, PolicyParameters
from openjax.pursuit import Observation, Pursuit, PursuitState
from openjax.pursuit.rows import where_rows
from openjax.pursuit.shapes import Scalar

LOWEST = 0.35
"""The end of a start costs below this height (m) ..."""
FASTEST = 1.0
"""... and above this speed (m/s): a dive saves some starts, and must end."""
END = 0.2
"""Weight of that, beside the share of pursuers that touch something."""
SLOWEST_RATE = 0.05
"""Share of the step size that is left at a stage's end."""
MOST_NORM = 1.0
"""Norm at which gradients are cut."""


def clipped_descent(rate: optax.ScalarOrSchedule) -> optax.GradientTransformation:
    """Adam with gradients cut at `MOST_NORM`."""
    return optax.chain(optax.clip_by_global_norm(MOST_NORM), optax.adam(rate))


def falling_rate(rate: float, updates: int) -> optax.Schedule:
    """From `rate` linearly to a twentieth over so many updates."""
    return optax.linear_schedule(rate, SLOWEST_RATE * rate, max(updates, 1))


def finite_or_zero(gradient: Any) -> Any:
    """A gradient through the simulation, zero where it isn't finite: a world that
    tumbles may have none.
    """
    finite = jnp.isfinite(optax.global_norm(gradient))
    return jax.tree.map(lambda leaf: jnp.where(finite, leaf, 0.0), gradient)


def renew(over: Bool[Array, " worlds"], world: Any, fresh: Any) -> Any:
    """Worlds (W, ...), those that are `over` (W,) replaced by fresh ones."""
    return where_rows(over, fresh, world)


def weighted_sum(
    parts: Mapping[str, tuple[float | Scalar, Float[Array, "..."]]],
) -> tuple[Scalar, dict[str, Scalar]]:
    """() sum of the weighted means of a loss's parts, {name: (weight, values)}; and the
    means.
    """
    means = {name: jnp.mean(values) for name, (_, values) in parts.items()}
    return sum(weight * means[name] for name, (weight, _) in parts.items()), means


def mean_step(
    environment: Pursuit, policy: Policy, parameters: PolicyParameters
) -> Callable[..., tuple[Observation, PursuitState]]:
    """A control step of worlds (W, ...) by the policy's mean: (actor, observation,
    state, wish) -> observation, state; the predictor of `parameters` has no gradient.

    `wish` (W, 3) is where the evaders fly, as a share of their speed; None or NaN:
    their own rule.
    """
    step = jax.vmap(environment.step, in_axes=(None, 0, 0, 0))

    def fly_on(actor, observation, state, wish=None):
        prediction = jax.lax.stop_gradient(policy.predict(parameters, observation))
        mean, _ = policy.distribution(actor, observation, prediction)
        # no key: the game draws nothing after its reset
        observation, state, *_ = step(None, state, policy.action(mean, observation), wish)
        return observation, state

    return fly_on
