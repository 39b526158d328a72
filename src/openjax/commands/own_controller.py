"""A user's own function in a policy's place, so that it is flown and counted like any other."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from openjax.policy import PolicyParameters, PredictorSettings
from openjax.pursuit import Observation


@dataclasses.dataclass(frozen=True)
class OwnController:
    """A pure function from an `Observation` to actions (N, 4) with the interface of `openjax.policy.Policy`.

    It is mapped over worlds, so it sees the observation of one world.
    """

    function: Callable[[Observation], jax.Array]
    predictor: PredictorSettings = dataclasses.field(default_factory=lambda: PredictorSettings(enabled=False))

    def predict(self, parameters: PolicyParameters, observation: Observation) -> None:
        """It predicts nothing."""

    def distribution(
        self, actor: Any, observation: Observation, predicted: None
    ) -> tuple[jax.Array, jax.Array]:
        """Actions (..., N, 4) in -1..1 and their log standard deviation (4,): none."""
        function = self.function
        for _ in range(observation.position.ndim - 2):
            function = jax.vmap(function)
        return jnp.clip(function(observation), -1.0, 1.0), jnp.full(4, -jnp.inf)

    def action(self, sample: jax.Array, observation: Observation) -> jax.Array:
        """The sample is the action."""
        return sample

    def act(self, parameters: PolicyParameters, observation: Observation) -> jax.Array:
        """Actions (..., N, 4) in -1..1."""
        return self.distribution(None, observation, None)[0]
