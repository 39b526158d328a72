"""The evaders that learn while the pursuers do, as a learner of the training step."""

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from openjax.learning.evader_learning import EvaderLearning, EvaderSamples, LearningEvaders
from openjax.learning.learners.learner import Flown
from openjax.policy import PolicyParameters
from openjax.pursuit import PursuitState


@dataclass(frozen=True)
class EvaderLearner:
    """A learner that also flies the worlds of its evaders, by samples of their
    policies.
    """

    learning: EvaderLearning

    def start(self, parameters: PolicyParameters, key: PRNGKeyArray) -> LearningEvaders:
        """Evaders that do as greedy ones."""
        return self.learning.start(key)

    def act(
        self, state: LearningEvaders, worlds: PursuitState, noise: Float[Array, "worlds 3"]
    ) -> tuple[Float[Array, "worlds 3"], EvaderSamples]:
        """Desired velocities (E, 3) in worlds (E, ...) as shares of the speed, NaN
        where none of these evaders flies, and the samples; noise (E, 3).
        """
        return self.learning.act(state, worlds, noise)

    def learn(
        self,
        state: LearningEvaders,
        parameters: PolicyParameters,
        experience: Flown,
        key: PRNGKeyArray,
    ) -> tuple[LearningEvaders, PolicyParameters, dict[str, Any]]:
        """After all epochs on the samples of a rollout."""
        samples = experience.rollout.learning
        state = self.learning.learn(state, samples, experience.state, key, experience.axis)
        return state, parameters, {"evader_noise": jnp.mean(state.log_std)}
