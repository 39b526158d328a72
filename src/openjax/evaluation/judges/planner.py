"""An evader that plans in the true simulation against the true policy, with a receding
horizon.

Every few steps it tries plans, sequences of held velocities, in copies of its world, in
which the policy answers as it will; it flies the beginning of the best one. It needs no
learning, so it doesn't share the learner's blind spots: a learner that is caught sooner
than the planner on the same tasks has not converged.
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from openjax.evaluation.judges.duel import Duel, World
from openjax.evaluation.judges.receding_horizon import RecedingHorizon
from openjax.evaluation.judges.settings import PlannerSettings
from openjax.policy import PolicyParameters
from openjax.pursuit import PursuitSettings, PursuitState
from openjax.pursuit.teams import draw_strategies

SPREAD = 0.6
"""How far the pieces of a refined plan lead aside, a share of their length: some 40
degrees.
"""


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
    """State of one world -> () steps that an evader will be free from there; None: the
    farther from the pursuers the better.
    """

    def begin(self, start: World) -> Planned:
        """Worlds (B, ...) at the start of an episode, and plans that are none."""
        return Planned(start, jnp.zeros((start[1].step.size, self.settings.pieces, 3)))

    def replan(self, parameters: PolicyParameters, carry: Planned, key: jax.Array) -> Planned:
        """The same after it has planned once and flown until the next time."""
        plan = self._best(parameters, carry.world, carry.plan, key)
        world = self.duel.fly(parameters, carry.world, plan[:, 0], self.settings.replan)
        return Planned(world, plan)

    def _best(self, parameters, world, plan, key):
        """(B, pieces, 3) the plan of those tried that promises most in each world (B,
        ...).
        """
        settings = self.settings
        candidates = self.candidates(key, plan)  # (B, M, pieces, 3)
        start = jax.tree.map(
            lambda leaf: jnp.repeat(leaf, settings.plans, axis=0),
            # a key beside those that `candidates` splits this one into
            without_foresight(self.duel.environment.settings, world, jax.random.fold_in(key, 1)),
        )
        pieces = jnp.moveaxis(candidates.reshape(-1, *candidates.shape[2:]), 1, 0)

        def piece(world, velocity):
            return self.duel.fly(parameters, world, velocity, settings.piece_steps), None

        (_, end), _ = jax.lax.scan(piece, start, pieces)
        score = jax.vmap(self.promise)(start[1], end).reshape(plan.shape[0], -1)
        best = jnp.argmax(score, axis=1)
        return jnp.take_along_axis(candidates, best[:, None, None, None], axis=1)[:, 0]

    def candidates(self, key: jax.Array, plan: jax.Array) -> jax.Array:
        """(B, plans, pieces, 3) the last best plan (B, pieces, 3), the same shifted by
        a piece, straight ways, random ones, and the shifted one refined. NaN is the
        evader's own rule.
        """
        settings = self.settings
        near_key, straight_key, bent_key = jax.random.split(key, 3)
        following = jnp.concatenate([plan[:, 1:], plan[:, -1:]], axis=1)
        # two are none of chance: the last plan, and the same a piece later
        others = settings.plans - 2
        near = int(settings.refined * others)
        straight = (others - near) // 3
        bent = others - near - straight
        number = plan.shape[0]
        ways = unit(jax.random.normal(straight_key, (number, straight, 1, 3)))
        ways = jnp.broadcast_to(ways, (number, straight, settings.pieces, 3))
        parts = [plan[:, None], following[:, None], ways, self._bent(bent_key, number, bent)]
        if near:
            parts.append(self._refine(near_key, following, near))
        return jnp.concatenate(parts, axis=1)

    def _bent(self, key, number, plans):
        """(B, plans, pieces, 3) random ones that turn now and then; some of them end by
        the evader's own rule.
        """
        settings = self.settings
        way_key, turn_key, end_key = jax.random.split(key, 3)
        ways = unit(jax.random.normal(way_key, (number, plans, settings.pieces, 3)))
        turns = jax.random.uniform(turn_key, ways.shape[:3]) < settings.turn

        def follow(last_way, piece):
            way, turn = piece
            way = jnp.where(turn[..., None], way, last_way)
            return way, way

        pieces = (jnp.moveaxis(ways, 2, 0), jnp.moveaxis(turns, 2, 0))
        bent = jnp.moveaxis(jax.lax.scan(follow, ways[:, :, 0], pieces)[1], 0, 2)
        by_rule = int(settings.own_rule * plans)
        if not by_rule:
            return bent
        # the first flies by it from the beginning
        end = jax.random.randint(end_key, (number, by_rule), 0, settings.pieces).at[:, 0].set(0)
        is_own = jnp.arange(settings.pieces) >= end[..., None]
        return bent.at[:, :by_rule].set(jnp.where(is_own[..., None], jnp.nan, bent[:, :by_rule]))

    def _refine(self, key, plan, plans):
        """(B, plans, pieces, 3) a plan (B, pieces, 3), some pieces of which lead
        elsewhere.
        """
        pieces = self.settings.pieces
        shape = (plan.shape[0], plans)
        first_key, last_key, way_key = jax.random.split(key, 3)
        first = jax.random.randint(first_key, (*shape, 1), 0, pieces)
        last = jax.random.randint(last_key, (*shape, 1), first, pieces)
        place = jnp.arange(pieces)
        is_change = ((place >= first) & (place <= last))[..., None]
        aside = SPREAD * jax.random.normal(way_key, (*shape, 1, 3))
        plan = plan[:, None]
        return jnp.where(is_change, unit(plan + aside), jnp.broadcast_to(plan, (*shape, pieces, 3)))

    def promise(self, start: PursuitState, end: PursuitState) -> jax.Array:
        """() how good the end of a plan is: steps free first, then the room that is
        left.
        """
        ahead = end.drones.position + self.settings.ahead * end.drones.velocity
        room = jnp.min(jnp.linalg.norm(ahead - end.evader_position, axis=-1))
        free = self.free_steps(start, end)
        if self.value is not None:
            free += jnp.where(end.statistics.captured, 0.0, self.value(end))
        return free + room / self.duel.environment.settings.arena_radius

    def free_steps(self, start: PursuitState, end: PursuitState) -> jax.Array:
        """() steps of a plan before the capture, all of them where there is none."""
        newly = end.statistics.captured & ~start.statistics.captured
        horizon = self.settings.pieces * self.settings.piece_steps
        return jnp.where(newly, end.statistics.capture_step - start.step, horizon)


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


def unit(vector: jax.Array) -> jax.Array:
    """(..., 3) of length one."""
    return vector / jnp.sqrt(jnp.sum(vector**2, axis=-1, keepdims=True) + np.float32(1e-12))
