"""A mixed strategy: several policies, one of which the team draws and the evader isn't
told.

Whoever knows a deterministic team can find the one way past it. Against a team that
draws, an evader needs a way that is past all of its members at once.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from openjax.policy.policy import Policy, PolicyParameters
from openjax.policy.settings import NetworkSettings, PredictorSettings
from openjax.pursuit import Observation
from openjax.pursuit.rows import where_rows


def mixed_parameters(members: Sequence[PolicyParameters]) -> PolicyParameters:
    """Parameters of the members (leaves (...)) as those of one mixed policy: leaves (K,
    ...).
    """
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *members)


@dataclass(frozen=True)
class MixedPolicy:
    """K members of one kind, with the interface of `Policy`; every leaf of the
    parameters has a leading axis K.

    `Observation.strategy` says which one flies in each world. All K are worked out and
    one is taken, so a step of the policy costs K times a member's.
    """

    member: Policy
    number: int

    @property
    def network(self) -> NetworkSettings:
        """Of each member."""
        return self.member.network

    @property
    def predictor(self) -> PredictorSettings:
        """Of each member."""
        return self.member.predictor

    @property
    def sample_size(self) -> int:
        """Numbers of one pursuer's sample."""
        return self.member.sample_size

    def init(self, key: PRNGKeyArray, observation: Observation) -> PolicyParameters:
        """Initial parameters, of each member from a key of its own."""
        keys = jax.random.split(key, self.number)
        return jax.vmap(self.member.init, in_axes=(0, None))(keys, observation)

    def _pick(
        self, function: Callable[[Any], Any], parameters: Any, observation: Observation
    ) -> Any:
        """Apply `function` to the parameters of the member that each world has drawn; leaves with
        the worlds' axes first.
        """
        # written out and not mapped: exported policies have neither loops nor indices
        result = function(_member(parameters, 0))
        for place in range(1, self.number):
            is_drawn = observation.strategy == place
            result = where_rows(is_drawn, function(_member(parameters, place)), result)
        return result

    def predict(
        self, parameters: PolicyParameters, observation: Observation
    ) -> Float[Array, "*worlds horizons 3"] | None:
        """Evader positions in the world (m) as the drawn member predicts them; None
        without a predictor.
        """
        if not self.predictor.enabled:
            return None

        def predict(predictor):
            return self.member.predict_from(predictor, observation.frames, observation.last_seen)

        return self._pick(predict, parameters.predictor, observation)

    def distribution(
        self,
        actor: Any,
        observation: Observation,
        prediction: Float[Array, "*worlds horizons 3"] | None,
    ) -> tuple[Float[Array, "*worlds pursuers sample"], Float[Array, "*worlds 1 sample"]]:
        """Mean and log standard deviation of the drawn member's Gaussian; `prediction`
        is that member's.
        """
        shape = (*observation.strategy.shape, 1, self.sample_size)

        def distribution(actor):
            mean, log_std = self.member.distribution(actor, observation, prediction)
            return mean, jnp.broadcast_to(log_std, shape)

        return self._pick(distribution, actor, observation)

    def action(
        self,
        sample: Float[Array, "*worlds pursuers sample"],
        observation: Observation | None = None,
    ) -> Float[Array, "*worlds pursuers sample"]:
        """As of each member."""
        return self.member.action(sample, observation)

    def act(
        self, parameters: PolicyParameters, observation: Observation
    ) -> Float[Array, "*worlds pursuers 4"]:
        """The drawn member's mean action in -1..1."""

        def act(member):
            return self.member.act(member, observation)

        return self._pick(act, parameters, observation)


def _member(parameters, place):
    """The parameters of one member, of those of all (K, ...)."""
    return jax.tree.map(lambda leaf: jax.lax.index_in_dim(leaf, place, keepdims=False), parameters)
