"""A network of one's own as a policy: three functions, the rest is said here once."""

from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp

from openjax.errors import UserError, part_name
from openjax.policy.policy import PolicyParameters
from openjax.policy.settings import NetworkSettings, PredictorSettings
from openjax.pursuit import Observation


@runtime_checkable
class Network(Protocol):
    """An actor and a critic, as pure functions of their parameters. Observations have any leading
    axes.
    """

    def init(self, key: jax.Array, observation: Observation) -> tuple[Any, Any]:
        """Fresh parameters of actor and critic for observations shaped like this one of
        a world.
        """

    def distribution(self, actor: Any, observation: Observation) -> tuple[jax.Array, jax.Array]:
        """Mean (..., N, 4) and log standard deviation (4,) of the Gaussian over
        actions: collective thrust, roll, pitch and yaw rate; samples are cut to -1..1.
        """

    def value(self, critic: Any, observation: Observation) -> jax.Array:
        """(..., N), normalised."""


def check_network(network: Any, observation: Observation) -> None:
    """Try a network on shapes alone; `observation` is one world's, of N pursuers.

    Raises:
      UserError: it lacks a function of `Network`, or gives other shapes.
    """
    name = part_name(network)
    if isinstance(network, type):
        raise UserError(f"policy {name}: a class; an object of it would be right")
    if not isinstance(network, Network):
        raise UserError(
            f"policy {name}: init, distribution and value are needed; see openjax.policy.Network"
        )
    actor, critic = jax.eval_shape(network.init, jax.random.key(0), observation)
    # with another leading axis than a world's, as a rollout has
    worlds = jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct((2, *leaf.shape), leaf.dtype), observation
    )
    per_pursuer = worlds.self_state.shape[:-1]
    mean, log_std = jax.eval_shape(network.distribution, actor, worlds)
    value = jax.eval_shape(network.value, critic, worlds)
    shapes = {
        "distribution's mean": (mean, (*per_pursuer, 4)),
        "distribution's log standard deviation": (log_std, (4,)),
        "value": (value, per_pursuer),
    }
    for what, (output, shape) in shapes.items():
        if output.shape != shape:
            raise UserError(
                f"policy {name}: {what} has shape {output.shape} for two worlds of "
                f"{per_pursuer[1]} pursuers; {shape} would be right"
            )


@dataclass(frozen=True)
class OwnPolicy:
    """A `Network` with the interface of `openjax.policy.Policy`; nothing predicts the
    evader.
    """

    own: Network
    network: NetworkSettings = field(default_factory=NetworkSettings)
    """Says nothing here."""
    predictor: PredictorSettings = field(default_factory=lambda: PredictorSettings(enabled=False))
    sample_size: int = 4

    def init(self, key: jax.Array, observation: Observation) -> PolicyParameters:
        """Fresh parameters."""
        actor, critic = self.own.init(key, observation)
        return PolicyParameters(actor=actor, critic=critic, predictor={})

    def predict(self, parameters: PolicyParameters, observation: Observation) -> None:
        """It predicts nothing."""

    def distribution(
        self, actor: Any, observation: Observation, prediction: None
    ) -> tuple[jax.Array, jax.Array]:
        """Mean (..., N, 4) and log standard deviation (4,)."""
        return self.own.distribution(actor, observation)

    def action(self, sample: jax.Array, observation: Observation | None = None) -> jax.Array:
        """The sample, cut to -1..1."""
        return jnp.clip(sample, -1.0, 1.0)

    def value(
        self, actor: Any, critic: Any, observation: Observation, prediction: None
    ) -> jax.Array:
        """(..., N), normalised."""
        return self.own.value(critic, observation)

    def evaluate(
        self, actor: Any, critic: Any, observation: Observation, prediction: None
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Mean, log standard deviation and value."""
        return *self.own.distribution(actor, observation), self.own.value(critic, observation)

    def act(self, parameters: PolicyParameters, observation: Observation) -> jax.Array:
        """The mean's action (..., N, 4)."""
        return self.action(self.own.distribution(parameters.actor, observation)[0])
