"""Teams of strangers: pursuers of several policies in one team.

Each policy looks at the world as its own settings say, and takes the others for its
like. So a world has a state for each policy, with its own frames and history; drones
and evader are the same in all of them.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from openjax.policy import Policy, PolicyParameters
from openjax.pursuit import EpisodeStatistics, Pursuit, Task


@dataclass(frozen=True, eq=False)
class Strangers:
    """K policies, and the one game of all of them as each observes it."""

    environments: tuple[Pursuit, ...]
    policies: tuple[Policy, ...]

    def fly(
        self,
        parameters: tuple[PolicyParameters, ...],
        tasks: Task,
        members: jax.Array,
        key: jax.Array,
    ) -> EpisodeStatistics:
        """One episode per task, to be compiled by the caller.

        Args:
          parameters: of each policy.
          tasks: (B, ...).
          members: (B, N) int32, the policy of each pursuer.
          key: draws evaders, start attitudes and whatever else a reset draws.

        Returns:
          statistics (B,).
        """
        keys = jax.random.split(key, members.shape[0])
        # each draws the same from the same key
        worlds = tuple(jax.vmap(game.reset_to)(keys, tasks) for game in self.environments)
        which = jnp.arange(members.shape[1])

        def one(worlds, _):
            actions = jnp.stack(
                [
                    policy.act(of_policy, observation)
                    for policy, of_policy, (observation, _) in zip(
                        self.policies, parameters, worlds, strict=True
                    )
                ],
                axis=1,
            )
            action = jax.vmap(lambda of_policy, member: of_policy[member, which])(actions, members)
            action = jnp.clip(action, -1.0, 1.0)
            drones = jax.vmap(self.environments[0].move)(worlds[0][1], action)
            results = []
            for game, (_, state) in zip(self.environments, worlds, strict=True):
                observation, state, *_ = jax.vmap(game.follow)(state, action, drones)
                results.append((observation, state))
            return tuple(results), None

        length = self.environments[0].settings.episode_length
        return jax.lax.scan(one, worlds, length=length)[0][0][1].statistics


def bootstrap_mean(values: np.ndarray, seed: int = 0, draws: int = 5000) -> tuple[float, float]:
    """95 % interval of the mean over strata (M) and their episodes (E), (M, E):
    episodes are drawn anew within each stratum (the stratified bootstrap of Agarwal et
    al., 2021).

    Which strata there are isn't drawn: it is an interval for these M, not for others
    like them.
    """
    generator = np.random.default_rng(seed)
    strata, episodes = values.shape
    means = np.zeros(draws)
    for episode_values in values:
        resample = generator.integers(episodes, size=(draws, episodes))
        means += episode_values[resample].mean(axis=1) / strata
    low, high = np.quantile(means, (0.025, 0.975))
    return float(low), float(high)
