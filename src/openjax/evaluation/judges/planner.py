"""An evader that plans in the true simulation against the true policy, with a receding
horizon: every few steps it flies the beginning of the best of the plans that it tries
(`openjax.learning.plan_search`).

A learner that is caught sooner than the planner on the same tasks has not converged.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from flax import struct

from openjax.evaluation.judges.duel import Duel, World
from openjax.evaluation.judges.receding_horizon import RecedingHorizon
from openjax.evaluation.judges.settings import PlannerSettings
from openjax.learning.plan_search import PlanSearch
from openjax.policy import PolicyParameters
from openjax.pursuit import PursuitSettings, PursuitState
from openjax.pursuit.teams import draw_strategies


@struct.dataclass
class Planned:
    """B worlds, and what their evaders have planned."""

    world: World
    plan: jax.Array  # (B, pieces, 3) shares of the speed


@dataclass(frozen=True, eq=False)
class Planner(RecedingHorizon):
    """The planner against a policy's mean."""

    settings: PlannerSettings
    duel: Duel
    value: Callable[[PursuitState], jax.Array] | None = None
    """See `PlanSearch.value`."""

    @property
    def search(self) -> PlanSearch:
        """Its plans, and what they are worth to it."""
        return PlanSearch(self.settings, self.duel.environment.settings, value=self.value)

    def begin(self, start: World) -> Planned:
        """Worlds (B, ...) at the start of an episode, and plans that are none."""
        return Planned(start, self.search.no_plan(start[1].step.size))

    def replan(self, parameters: PolicyParameters, carry: Planned, key: jax.Array) -> Planned:
        """The same after it has planned once and flown until the next time."""
        fly = functools.partial(self.duel.fly, parameters)
        # a key beside those that the search splits this one into
        thought = without_foresight(
            self.duel.environment.settings, carry.world, jax.random.fold_in(key, 1)
        )
        plan = self.search.attempt(fly, thought, carry.plan, key).best
        return Planned(fly(carry.world, plan[:, 0], self.settings.replan), plan)


def without_foresight(game: PursuitSettings, world: World, key: jax.Array) -> World:
    """Worlds (B, ...) whose teams draw other strategies than they will: an evader can
    tell from what it sees which one they fly, and not which come next.
    """
    observation, state = world
    other = draw_strategies(game, key, state.step.shape)
    if other is None:
        return world
    current = state.step // game.strategy_steps
    is_known = jnp.arange(state.strategies.shape[1]) <= current[:, None]
    strategies = jnp.where(is_known, state.strategies, other)
    return observation, state.replace(strategies=strategies)
