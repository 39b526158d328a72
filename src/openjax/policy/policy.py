"""Actor, critic and predictor as one policy: initial parameters, distribution, value,
prediction.
"""

from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from openjax.policy.actor_critic import Actor, Critic
from openjax.policy.predictor import EvaderPredictor
from openjax.policy.settings import NetworkSettings, PredictorSettings
from openjax.pursuit import Observation, Pursuit, hover_action


@struct.dataclass
class PolicyParameters:
    """Parameters of the three networks; `predictor` is empty where it is switched
    off.
    """

    actor: Any
    critic: Any
    predictor: Any


@dataclass(frozen=True)
class Policy:
    """The networks for one game, as pure functions of their parameters."""

    network: NetworkSettings = field(default_factory=NetworkSettings)
    predictor: PredictorSettings = field(default_factory=PredictorSettings)
    arena_radius: float = 0.9
    arena_height: float = 1.2
    initial_action: tuple[float, ...] = (0.2549, 0.0, 0.0, 0.0)
    """Before the tanh; by default what hovers the nominal Crazyflie."""

    @classmethod
    def for_environment(
        cls, environment: Pursuit, network: NetworkSettings, predictor: PredictorSettings
    ) -> "Policy":
        """The policy for an environment: its arena's size, and a start that hovers its
        vehicle.
        """
        # an environment may be made inside a compiled program
        with jax.ensure_compile_time_eval():
            hover = np.asarray(hover_action(environment.vehicle), np.float64)
        # before the tanh, which has no inverse at its ends
        hover = np.arctanh(np.clip(hover, -0.99, 0.99))
        return cls(
            network=network,
            predictor=predictor,
            arena_radius=environment.settings.arena_radius,
            arena_height=environment.settings.arena_height,
            initial_action=tuple(float(x) for x in hover),
        )

    @property
    def _actor(self) -> Actor:
        return Actor(self.network, self.initial_action)

    @property
    def _critic(self) -> Critic:
        return Critic(self.network)

    @property
    def _predictor(self) -> EvaderPredictor:
        return EvaderPredictor(self.predictor, self.arena_radius, self.arena_height)

    def init(self, key: PRNGKeyArray, observation: Observation) -> PolicyParameters:
        """Initial parameters for observations shaped like `observation`."""
        actor_key, critic_key, predictor_key = jax.random.split(key, 3)
        predictor = {}
        if self.predictor.enabled:
            predictor = self._predictor.init(
                predictor_key, observation.frames, observation.last_seen
            )
        # in this order: the actor sees what the predictor predicts, the critic what the
        # actor's encoder makes of it
        parameters = PolicyParameters(actor={}, critic={}, predictor=predictor)
        prediction = self.predict(parameters, observation)
        actor = self._actor.init(actor_key, observation, prediction)
        encoding = self._actor.apply(actor, observation, prediction)[2]
        return parameters.replace(
            actor=actor, critic=self._critic.init(critic_key, observation, prediction, encoding)
        )

    def predict(
        self, parameters: PolicyParameters, observation: Observation
    ) -> Float[Array, "*worlds horizons 3"] | None:
        """Predicted evader positions in the world (m); None without a predictor."""
        if not self.predictor.enabled:
            return None
        return self.predict_from(parameters.predictor, observation.frames, observation.last_seen)

    def predict_from(
        self,
        predictor: Any,
        frames: Float[Array, "*worlds window features"],
        last_seen: Float[Array, "*worlds 3"],
    ) -> Float[Array, "*worlds horizons 3"]:
        """Positions (m) predicted from windows of frames, oldest first, and last seen
        positions (m).
        """
        return self._predictor.apply(predictor, frames, last_seen)

    def distribution(
        self,
        actor: Any,
        observation: Observation,
        prediction: Float[Array, "*worlds horizons 3"] | None,
    ) -> tuple[Float[Array, "*worlds pursuers sample"], Float[Array, " sample"]]:
        """Mean and log standard deviation of the Gaussian over samples; see
        `action`.
        """
        return self._actor.apply(actor, observation, prediction)[:2]

    @property
    def sample_size(self) -> int:
        """Numbers of one pursuer's sample."""
        return len(self.initial_action)

    def action(
        self,
        sample: Float[Array, "*worlds pursuers sample"],
        observation: Observation | None = None,
    ) -> Float[Array, "*worlds pursuers sample"]:
        """The action in -1..1 of a sample of the Gaussian, or of its mean.

        Policies whose samples aren't commands work the four out from the `observation`
        (`openjax.baselines.dacoop`).
        """
        return jnp.clip(sample, -1.0, 1.0) if self.network.squash == "mean" else jnp.tanh(sample)

    def value(
        self,
        actor: Any,
        critic: Any,
        observation: Observation,
        prediction: Float[Array, "*worlds horizons 3"] | None,
    ) -> Float[Array, "*worlds pursuers"]:
        """Normalised values; the actor's parameters matter if its encoder is shared."""
        return self.evaluate(actor, critic, observation, prediction)[2]

    def evaluate(
        self,
        actor: Any,
        critic: Any,
        observation: Observation,
        prediction: Float[Array, "*worlds horizons 3"] | None,
    ) -> tuple[
        Float[Array, "*worlds pursuers sample"],
        Float[Array, " sample"],
        Float[Array, "*worlds pursuers"],
    ]:
        """`distribution` and `value`: mean, log standard deviation, value."""
        mean, log_std, encoding = self._actor.apply(actor, observation, prediction)
        return (mean, log_std, self._critic.apply(critic, observation, prediction, encoding))

    def act(
        self, parameters: PolicyParameters, observation: Observation
    ) -> Float[Array, "*worlds pursuers 4"]:
        """The mean policy's action in -1..1."""
        prediction = self.predict(parameters, observation)
        mean, _ = self.distribution(parameters.actor, observation, prediction)
        return self.action(mean, observation)


def gaussian_log_prob(
    sample: Float[Array, "*samples size"],
    mean: Float[Array, "*samples size"],
    log_std: Float[Array, " size"],
) -> Float[Array, "*samples"]:
    """Log density of samples under independent Gaussians."""
    score = (sample - mean) * jnp.exp(-log_std)
    return jnp.sum(-0.5 * score**2 - log_std - 0.5 * jnp.log(2 * jnp.pi), axis=-1)


def gaussian_entropy(log_std: Float[Array, " size"]) -> Float[Array, ""]:
    """Entropy of independent Gaussians."""
    return jnp.sum(log_std + 0.5 * jnp.log(2 * jnp.pi * jnp.e))
