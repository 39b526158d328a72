"""A network of one's own as a policy: three functions, the rest is said here once."""

from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp

from openjax.policy.policy import PolicyParameters
from openjax.policy.settings import NetworkSettings, PredictorSettings
from openjax.pursuit import Observation


@runtime_checkable
class Network(Protocol):
    """What acts and what judges, as pure functions of their parameters. Observations
    have any leading axes.
    """

    def init(self, key: jax.Array, observation: Observation) -> tuple[Any, Any]:
        """Fresh parameters of actor and critic for observations shaped like this one of
        a world.
        """

    def distribution(
        self, actor: Any, observation: Observation
    ) -> tuple[jax.Array, jax.Array]:
        """Mean (..., N, 4) and log standard deviation (4,) of the Gaussian over
        actions: collective thrust, roll, pitch and yaw rate; samples are cut to -1..1.
        """

    def value(self, critic: Any, observation: Observation) -> jax.Array:
        """(..., N), normalised."""


@dataclass(frozen=True)
class OwnPolicy:
    """A `Network` with the interface of `openjax.policy.Policy`; nothing predicts the
    evader.
    """

    own: Network
    network: NetworkSettings = field(default_factory=NetworkSettings)
    """Says nothing here."""
    predictor: PredictorSettings = field(
        default_factory=lambda: PredictorSettings(enabled=False)
    )
    sample_size: int = 4

    def init(self, key: jax.Array, observation: Observation) -> PolicyParameters:
        """Fresh parameters."""
        actor, critic = self.own.init(key, observation)
        return PolicyParameters(actor=actor, critic=critic, predictor={})

    def predict(self, parameters: PolicyParameters, observation: Observation) -> None:
        """It predicts nothing."""

    def distribution(
        self, actor: Any, observation: Observation, predicted: None
    ) -> tuple[jax.Array, jax.Array]:
        """Mean (..., N, 4) and log standard deviation (4,)."""
        return self.own.distribution(actor, observation)

    def action(
        self, sample: jax.Array, observation: Observation | None = None
    ) -> jax.Array:
        """The sample, cut to -1..1."""
        return jnp.clip(sample, -1.0, 1.0)

    def value(
        self, actor: Any, critic: Any, observation: Observation, predicted: None
    ) -> jax.Array:
        """(..., N), normalised."""
        return self.own.value(critic, observation)

    def evaluate(
        self, actor: Any, critic: Any, observation: Observation, predicted: None
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Mean, log standard deviation and value."""
        return *self.own.distribution(actor, observation), self.own.value(
            critic, observation
        )

    def act(self, parameters: PolicyParameters, observation: Observation) -> jax.Array:
        """The mean's action (..., N, 4)."""
        return self.action(self.own.distribution(parameters.actor, observation)[0])
