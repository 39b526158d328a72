"""The methods without a network, as policies like any other."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from openjax.baselines.angelani import AngelaniParameters, angelani
from openjax.baselines.apf import ApfParameters, apf
from openjax.baselines.janosov import JanosovParameters, janosov
from openjax.baselines.parameters import best
from openjax.baselines.stack import StackParameters, stack
from openjax.baselines.surroundings import Craft, Surroundings, surroundings
from openjax.baselines.velocity_controller import check_flyable, velocity_action
from openjax.policy import PolicyParameters, PredictorSettings
from openjax.pursuit import Observation, Pursuit


@dataclasses.dataclass(frozen=True)
class Method:
    """A rule that turns surroundings into desired velocities, and the kind of its
    parameters.
    """

    kind: type
    rule: Callable[[Craft, Any, Surroundings], jax.Array]


METHODS = {
    "angelani": Method(AngelaniParameters, angelani),
    "janosov": Method(JanosovParameters, janosov),
    "apf": Method(ApfParameters, apf),
    "stack": Method(StackParameters, stack),
}


class WithoutNetwork:
    """A policy that isn't learnt, with the interface of `openjax.policy.Policy`; a subclass has
    `mean`.
    """

    predictor = PredictorSettings(enabled=False)

    def mean(self, actor: Any, observation: Observation) -> jax.Array:
        """Action (..., N, 4) in -1..1."""
        raise NotImplementedError

    def predict(self, parameters: PolicyParameters, observation: Observation) -> None:
        """It predicts nothing."""

    def distribution(
        self, actor: Any, observation: Observation, prediction: None
    ) -> tuple[jax.Array, jax.Array]:
        """Action (..., N, 4) in -1..1 and log standard deviation (4,): none, as nothing
        explores.
        """
        return self.mean(actor, observation), jnp.full(4, -jnp.inf)

    def action(self, sample: jax.Array, observation: Observation) -> jax.Array:
        """The sample is the action."""
        return sample

    def act(self, parameters: PolicyParameters, observation: Observation) -> jax.Array:
        """Action (..., N, 4) in -1..1."""
        return self.mean(parameters.actor, observation)


@dataclasses.dataclass(frozen=True)
class Heuristic(WithoutNetwork):
    """A method of `METHODS` as a policy; its parameters take the actor's place."""

    name: str
    craft: Craft = dataclasses.field(default_factory=Craft)

    @classmethod
    def for_environment(cls, name: str, environment: Pursuit) -> "Heuristic":
        """A method for an environment's arena and vehicle.

        Raises:
          UserError: the velocity controller can't fly there.
        """
        craft = Craft.of(environment)
        check_flyable(name, craft, environment.settings.time_step)
        return cls(name, craft)

    def parameters(self) -> PolicyParameters:
        """The parameters that the search found."""
        return PolicyParameters(
            actor=best(self.name, METHODS[self.name].kind), critic={}, predictor={}
        )

    def mean(self, actor: Any, observation: Observation) -> jax.Array:
        """Action (..., N, 4) in -1..1."""
        velocity = METHODS[self.name].rule(self.craft, actor, surroundings(self.craft, observation))
        return velocity_action(self.craft, observation, velocity)


@dataclasses.dataclass(frozen=True)
class OwnController(WithoutNetwork):
    """A pure function from an `Observation` to actions (N, 4). It is mapped over
    worlds, so it sees the observation of one.
    """

    function: Callable[[Observation], jax.Array]

    def mean(self, actor: Any, observation: Observation) -> jax.Array:
        """Actions (..., N, 4) in -1..1."""
        function = self.function
        for _ in range(observation.position.ndim - 2):
            function = jax.vmap(function)
        return jnp.clip(function(observation), -1.0, 1.0)
