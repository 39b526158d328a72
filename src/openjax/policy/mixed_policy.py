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
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from openjax.policy.policy import Policy, PolicyParameters
from openjax.policy.settings import NetworkSettings, PredictorSettings
from openjax.pursuit import Observation, PursuitSettings
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


@dataclass(frozen=True)
class SortedPolicy(MixedPolicy):
    """The same for B worlds that draw by themselves: each member is worked out only in
    worlds that fly it, so that a step costs little more than one member's.

    Room is kept for eight standard deviations more of a member's worlds than it flies
    in the mean.
    """

    most: tuple[float, ...] = ()
    """Largest share of the worlds that each member flies in the mean."""
    copies: int = 1
    """Worlds that draw together."""

    @classmethod
    def of(cls, policy: MixedPolicy, game: PursuitSettings, copies: int = 1) -> "SortedPolicy":
        """For the draws of a game; of so many `copies` each draws as the others."""
        usual = game.strategy_odds or (1.0,) * game.strategies
        shares = [
            np.divide(odds, np.sum(odds)) for odds in (usual, game.strategy_odds_unseen or usual)
        ]
        most = tuple(np.max(shares, axis=0).tolist())
        return cls(policy.member, policy.number, most, copies)

    def act(
        self, parameters: PolicyParameters, observation: Observation
    ) -> Float[Array, "worlds pursuers 4"]:
        """The drawn member's mean action in -1..1."""
        strategy = observation.strategy
        (worlds,) = strategy.shape
        spare = 4 * (worlds * self.copies) ** 0.5 + 4
        rooms = [min(worlds, int(share * worlds + spare)) if share else 1 for share in self.most]
        is_drawn = strategy[:, None] == jnp.arange(self.number)
        place = jnp.sum(jnp.where(is_drawn, jnp.cumsum(is_drawn, axis=0) - 1, 0), axis=1)
        # all members' rooms in one row
        first = jnp.asarray(np.cumsum([0, *rooms[:-1]]))[strategy]
        slot = first + jnp.minimum(place, jnp.asarray(rooms)[strategy] - 1)
        worlds_of = jnp.zeros(sum(rooms), jnp.int32).at[slot].set(jnp.arange(worlds))
        ends = np.cumsum(rooms).tolist()
        actions = []
        for number, (end, room) in enumerate(zip(ends, rooms, strict=True)):
            flying = worlds_of[end - room : end]
            some = jax.tree.map(lambda leaf, flying=flying: leaf[flying], observation)
            actions.append(self.member.act(_member(parameters, number), some))
        return jnp.concatenate(actions)[slot]


def _member(parameters, place):
    """The parameters of one member, of those of all (K, ...)."""
    return jax.tree.map(lambda leaf: jax.lax.index_in_dim(leaf, place, keepdims=False), parameters)
