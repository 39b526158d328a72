"""A last stage by the gradient through the simulation: what one is, and its programs,
compiled while the run learns.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
from jaxtyping import PRNGKeyArray

from openjax.background import in_background
from openjax.learning.settings import AnalyticSettings
from openjax.policy import PolicyParameters
from openjax.pursuit.shapes import Scalar


class Turn(NamedTuple):
    """What an update begins with."""

    actor: Any
    state: Any
    """See `GradientStage.begin`."""
    parameters: PolicyParameters
    """The policy's before the stage: what flew the flights, and what is held to"""
    flights: Any
    """See `GradientStage.record`."""
    key: PRNGKeyArray


Updated = tuple[Any, Any, dict[str, Scalar]]
"""Actor and state after an update, and parts of the loss."""


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

    @property
    def programs(self) -> tuple[Callable[[Turn, tuple], Any], ...]:
        """What an update does, one after the other: each is handed the turn and what
        those before it returned, and the last one returns what is `Updated`. They are
        compiled side by side, as a whole update would take a GPU's compiler minutes.
        """


def update(programs: Sequence[Callable[[Turn, tuple], Any]], turn: Turn) -> Updated:
    """A whole update by a stage's programs, compiled or not."""
    results = ()
    for program in programs:
        results = (*results, program(turn, results))
    return results[-1]


def compile_stage(
    stage: GradientStage, parameters: PolicyParameters
) -> Callable[[PolicyParameters, jax.Array], Iterator[tuple[PolicyParameters, dict[str, float]]]]:
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
    turn = Turn(parameters.actor, state, parameters, flights, key)
    traces = [record.lower(parameters, key), begin.lower(parameters, key)]
    results = ()
    for program in stage.programs:
        traces.append(jax.jit(program).lower(turn, results))
        results = (*results, traces[-1].out_info)
    ready = [in_background(program.compile) for program in traces]

    def learn(parameters, key):
        record, begin, *programs = (wait() for wait in ready)
        flight_key, update_key = jax.random.split(key)
        actor = parameters.actor
        state = begin(parameters, jax.random.fold_in(flight_key, 1))
        flights = record(parameters, flight_key)
        for number in range(stage.settings.updates):
            step_key = jax.random.fold_in(update_key, number)
            turn = Turn(actor, state, parameters, flights, step_key)
            actor, state, parts = update(programs, turn)
            yield parameters.replace(actor=actor), jax.device_get(parts)

    return learn
