"""A stage of learning by the gradient through the simulation, and its driver.

Before MAPPO it teaches to fly (`first_flights`), after it what is decided within tenths
of a second (`last_flights`) and what evaders that plan find (`worst_plans`), and for a
diagnosed vehicle to fly that (`adaptation`). A lesson says from which worlds is learnt
and what counts in them; the actor follows the gradient.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from openjax.background import in_background
from openjax.learning.train_state import TrainState
from openjax.policy import PolicyParameters
from openjax.pursuit.shapes import Scalar

SLOWEST_RATE = 0.05
"""Share of the step size that is left at a stage's end."""
MOST_NORM = 1.0
"""Norm at which gradients are cut."""


@struct.dataclass
class StageCarry:
    """The state of a stage between two updates."""

    actor: TrainState
    lesson: Any
    """See `Lesson.begin`."""


class Turn(NamedTuple):
    """The input of an update."""

    carry: StageCarry
    parameters: PolicyParameters
    """The policy's before the stage: what flew the flights, and what is held to."""
    flights: Any
    """See `Lesson.record`."""
    key: PRNGKeyArray

    @property
    def actor(self) -> Any:
        """The actor's parameters."""
        return self.carry.actor.parameters


class Learnt(NamedTuple):
    """The output of an update."""

    gradient: Any
    """The actor's."""
    lesson: Any
    """The input of the next update, see `Lesson.begin`."""
    parts: Mapping[str, Scalar]
    """Of the loss."""


class Lesson(Protocol):
    """The lesson of a stage, and its step size."""

    @property
    def updates(self) -> int:
        """Their number."""

    @property
    def optimiser(self) -> optax.GradientTransformation:
        """The actor's."""

    def record(self, parameters: PolicyParameters, key: PRNGKeyArray, late: Any) -> Any:
        """Flights of the policy as it was before the stage; `late` is what is known
        only when the stage begins.
        """

    def begin(self, key: PRNGKeyArray) -> Any:
        """The state that is carried from update to update beside the actor, such as worlds under
        way.
        """

    @property
    def programs(self) -> tuple[Callable[[Turn, tuple], Any], ...]:
        """The programs of an update, in their order: each gets the turn and the results of those
        before it, and the last one returns what is `Learnt`. They are compiled side by side, as a
        whole update would take a GPU's compiler minutes.
        """


@dataclass(frozen=True)
class GradientStage:
    """The updates of a lesson, as pure functions."""

    lesson: Lesson

    def begin(self, parameters: PolicyParameters, key: PRNGKeyArray) -> StageCarry:
        """The carry before the first update."""
        state = self.lesson.optimiser.init(parameters.actor)
        return StageCarry(TrainState(parameters.actor, state), self.lesson.begin(key))

    @property
    def programs(self) -> tuple[Callable[[Turn, tuple], Any], ...]:
        """The lesson's; the last one returns the carry after the update, and the parts
        of the loss.
        """
        *first, last = self.lesson.programs

        def follow(turn, results):
            learnt = last(turn, results)
            gradient = finite_or_zero(learnt.gradient)
            actor = turn.carry.actor.update(self.lesson.optimiser, gradient)
            return StageCarry(actor, learnt.lesson), learnt.parts

        return (*first, follow)

    def several(self, number: int) -> Callable:
        """`number` updates as one function (carry, parameters, key, updates done) ->
        carry, mean parts of the loss, for a lesson without flights.
        """

        def some(carry, parameters, key, updates_done):
            def one(carry, key):
                return update(self.programs, Turn(carry, parameters, None, key))

            numbers = updates_done + jnp.arange(number)
            keys = jax.vmap(lambda i: jax.random.fold_in(key, i))(numbers)
            carry, parts = jax.lax.scan(one, carry, keys)
            return carry, jax.tree.map(jnp.mean, parts)

        return some


def update(programs: Sequence[Callable[[Turn, tuple], Any]], turn: Turn) -> Any:
    """A whole update by a stage's programs, compiled or not."""
    results = ()
    for program in programs:
        results = (*results, program(turn, results))
    return results[-1]


Updates = Iterator[tuple[PolicyParameters, dict[str, float]]]
"""After each update the policy's parameters, and the parts of the loss."""


@dataclass(frozen=True)
class CompiledStage:
    """A stage whose programs are compiled in the background."""

    stage: GradientStage
    programs: Sequence[Callable[[], Callable]]
    """Each waits for the compiler: `begin`, the lesson's `record`, and those of an
    update.
    """

    def ready(self) -> list[Callable]:
        """All of them, compiled."""
        return [wait() for wait in self.programs]

    def __call__(
        self, parameters: PolicyParameters, key: PRNGKeyArray, late: Any = None
    ) -> Updates:
        """The updates of a policy, one after the other."""
        begin, record, *programs = self.ready()
        flight_key, update_key = jax.random.split(key)
        carry = begin(parameters, jax.random.fold_in(flight_key, 1))
        flights = record(parameters, flight_key, late)
        for number in range(self.stage.lesson.updates):
            step_key = jax.random.fold_in(update_key, number)
            carry, parts = update(programs, Turn(carry, parameters, flights, step_key))
            yield parameters.replace(actor=carry.actor.parameters), jax.device_get(parts)


def compile_stage(
    stage: GradientStage, parameters: PolicyParameters, late: Any = None
) -> CompiledStage:
    """Start to compile a stage for parameters and `late` of these shapes (or abstract
    ones).
    """
    key = jax.eval_shape(lambda: jax.random.key(0))
    begin = jax.jit(stage.begin).lower(parameters, key)
    record = jax.jit(stage.lesson.record).lower(parameters, key, late)
    turn = Turn(begin.out_info, parameters, record.out_info, key)
    traces = [begin, record]
    results = ()
    for program in stage.programs:
        traces.append(jax.jit(program).lower(turn, results))
        results = (*results, traces[-1].out_info)
    return CompiledStage(stage, [in_background(program.compile) for program in traces])


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


def weighted_sum(
    parts: Mapping[str, tuple[float | Scalar, Float[Array, "..."]]],
) -> tuple[Scalar, dict[str, Scalar]]:
    """() sum of the weighted means of a loss's parts, {name: (weight, values)}; and the
    means.
    """
    means = {name: jnp.mean(values) for name, (_, values) in parts.items()}
    return sum(weight * means[name] for name, (weight, _) in parts.items()), means
