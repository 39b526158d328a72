"""A last stage by the gradient through the simulation: what one is, and its programs,
compiled while the run learns.
"""

from collections.abc import Callable, Iterator
from typing import Any, Protocol, runtime_checkable

import jax
from jaxtyping import PRNGKeyArray

from openjax.background import in_background
from openjax.learning.settings import AnalyticSettings
from openjax.policy import PolicyParameters
from openjax.pursuit.shapes import Scalar


@runtime_checkable
class GradientStage(Protocol):
    """A last stage of a run: `AnalyticGradient`, or
    `openjax.learning.worst_plans.WorstPlans`.
    """

    settings: AnalyticSettings

    def record(self, parameters: PolicyParameters, key: PRNGKeyArray) -> Any:
        """Flights of the policy as it was before the stage."""

    def begin(self, parameters: PolicyParameters, key: PRNGKeyArray) -> Any:
        """What is carried from update to update beside the actor."""

    def update(
        self,
        actor: Any,
        state: Any,
        parameters: PolicyParameters,
        flights,
        key: PRNGKeyArray,
    ) -> tuple[Any, Any, dict[str, Scalar]]:
        """Actor and state after an update, and parts of the loss."""


def compile_stage(
    stage: GradientStage, parameters: PolicyParameters
) -> Callable[
    [PolicyParameters, jax.Array], Iterator[tuple[PolicyParameters, dict[str, float]]]
]:
    """Start to compile the stage for parameters of these shapes (or abstract ones), in
    the background.

    Returns:
      the stage, which waits for the compiler: (parameters, key) -> after every update
      the parameters and its metrics.
    """
    key = jax.eval_shape(lambda: jax.random.key(0))
    record = jax.jit(stage.record)
    begin = jax.jit(stage.begin)
    flights = jax.eval_shape(record, parameters, key)
    state = jax.eval_shape(begin, parameters, key)
    update = jax.jit(stage.update)
    lowered = (
        record.lower(parameters, key),
        begin.lower(parameters, key),
        update.lower(parameters.actor, state, parameters, flights, key),
    )
    ready = [in_background(program.compile) for program in lowered]

    def learn(parameters, key):
        record, begin, update = (wait() for wait in ready)
        flight_key, update_key = jax.random.split(key)
        actor = parameters.actor
        state = begin(parameters, jax.random.fold_in(flight_key, 1))
        flights = record(parameters, flight_key)
        for number in range(stage.settings.updates):
            step_key = jax.random.fold_in(update_key, number)
            # `parameters` stay those from before: what flew the moments, and what is
            # held to
            actor, state, parts = update(actor, state, parameters, flights, step_key)
            yield parameters.replace(actor=actor), jax.device_get(parts)

    return learn
