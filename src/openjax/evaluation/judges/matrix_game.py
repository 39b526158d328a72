"""Both sides plan in the true simulation: what any pursuers could hold, and what none could.

Every few steps each side thinks of some plans, and all pairs of them are flown in copies of the
world: a matrix game (von Neumann, 1928). Who chooses last knows what the other has chosen. So with
the pursuers last the captures bound from above what a team of these plans can hold, and with the
evader last from below. Both sides see everything, pillars or not; or the pursuers what the game
lets them see.

An evader's plan is a sequence of held velocities (`openjax.evaluation.judges.planner`). A plan of
the pursuers says of each of them, piece by piece, that it flies as the policy does, or to a place
beside the evader, wherever that will be.
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from flax import struct

from openjax.evaluation.judges.duel import Duel, World
from openjax.evaluation.judges.planner import Planner, unit
from openjax.evaluation.judges.settings import MatrixGameSettings, PlannerSettings
from openjax.policy import PolicyParameters
from openjax.pursuit import EpisodeStatistics, Observation, PursuitState

BESIDE = 0.4
"""Places beside the evader to which a pursuer is sent are at most so far from it (m)."""
LEAD = 0.15
"""Seconds that a vehicle takes to fly what it is told: it is sent to where the evader will be."""
REACTION = 0.1
"""Seconds in which a pursuer would reach its place, were it fast enough."""
SPEED = 0.98
"""Share of the pursuers' speed at which they fly to it: short of what a controller overshoots."""
CRASH = 2.0
"""What a crash costs the pursuers, in horizons that the evader is free."""


@struct.dataclass
class TeamPlans:
    """Plans of N pursuers, of P pieces each."""

    beside: jax.Array  # (..., P, N, 3) m, from the evader to the place
    by_policy: jax.Array  # (..., P, N) bool, flies as the policy does


VelocityFlight = Callable[[Observation, PursuitState, jax.Array], jax.Array]
"""observation, state of one world and desired velocities (N, 3) m/s -> actions (N, 4)."""


def choose(payoff: jax.Array, pursuers_last: bool) -> tuple[jax.Array, jax.Array]:
    """Places () of the evader's plan and of the pursuers' in a payoff (E, P) that the evader wants
    large.
    """
    if pursuers_last:
        evader = jnp.argmax(jnp.min(payoff, axis=1))
        return evader, jnp.argmin(payoff[evader])
    team = jnp.argmin(jnp.max(payoff, axis=0))
    return jnp.argmax(payoff[:, team]), team


@dataclass(frozen=True, eq=False)
class MatrixGame:
    """Both sides' plans in one game; the policy is one of the pursuers' plans."""

    settings: MatrixGameSettings
    duel: Duel
    flight: VelocityFlight

    @property
    def _planner(self) -> Planner:
        own = self.settings
        how = PlannerSettings(own.evader_plans, own.pieces, own.piece_steps, own.replan)
        return Planner(how, self.duel)

    def fly(self, parameters: PolicyParameters, start: World, key: jax.Array) -> EpisodeStatistics:
        """Statistics (B,) of one episode from each of B starts."""
        settings = self.settings
        game = self.duel.environment.settings
        number = start[1].step.size
        shape = (number, settings.pieces, game.num_pursuers)
        team = TeamPlans(jnp.zeros((*shape, 3)), jnp.ones(shape, bool))
        plan = jnp.zeros((number, settings.pieces, 3))

        def one(carry, key):
            world, plan, team = carry
            plan, team = self._decide(parameters, world, plan, team, key)
            now = jax.tree.map(lambda leaf: leaf[:, 0], team)
            world = self._fly_piece(parameters, world, plan[:, 0], now, settings.replan)
            return (world, plan, team), None

        keys = jax.random.split(key, game.episode_length // settings.replan)
        return jax.lax.scan(one, (start, plan, team), keys)[0][0][1].statistics

    def _decide(self, parameters, world, plan, team, key):
        """(B, P, 3) and TeamPlans (B, P, ...): what both sides fly in worlds (B, ...)."""
        settings = self.settings
        evader_key, team_key = jax.random.split(key)
        plans = self._planner.candidates(evader_key, plan)  # (B, E, P, 3)
        teams = self._team_candidates(team_key, team)  # (B, T, P, ...)
        pairs = settings.evader_plans * settings.team_plans

        def of_pairs(leaf, axis):
            """(P, B * E * T, ...) of (B, E or T, P, ...)."""
            leaf = jnp.expand_dims(leaf, axis)
            shape = (leaf.shape[0], settings.evader_plans, settings.team_plans, *leaf.shape[3:])
            leaf = jnp.broadcast_to(leaf, shape)
            return jnp.moveaxis(leaf.reshape(-1, *leaf.shape[3:]), 1, 0)

        copied = jax.tree.map(lambda leaf: jnp.repeat(leaf, pairs, axis=0), world)
        pieces = of_pairs(plans, 2), jax.tree.map(lambda leaf: of_pairs(leaf, 1), teams)

        def piece(world, both):
            return self._fly_piece(parameters, world, *both, settings.piece_steps), None

        end = jax.lax.scan(piece, copied, pieces)[0][1]
        payoff = jax.vmap(self._payoff)(copied[1], end)
        payoff = payoff.reshape(-1, settings.evader_plans, settings.team_plans)
        if not settings.full_sight:
            # a team that doesn't see has one plan, the first: to fly as the policy does
            payoff = jnp.where(world[1].seen[:, None, None], payoff, payoff[:, :, :1])
        mine, theirs = jax.vmap(lambda own: choose(own, settings.pursuers_last))(payoff)

        def chosen(leaf, place):
            return jax.vmap(lambda own, place: own[place])(leaf, place)

        return chosen(plans, mine), jax.tree.map(lambda leaf: chosen(leaf, theirs), teams)

    def _fly_piece(self, parameters, world, velocity, team, steps):
        """Worlds (B, ...) after control steps of one piece of both plans."""
        speed = SPEED * self.duel.environment.settings.max_speed

        def action(observation, state, by_policy, team):
            place = state.evader_position + LEAD * state.evader_velocity
            if not self.settings.full_sight:
                place = jnp.where(state.seen, place, state.last_seen)
            place = place + team.beside
            desired = (place - state.drones.position) / REACTION
            length = jnp.linalg.norm(desired, axis=-1, keepdims=True)
            desired = desired * jnp.minimum(1.0, speed / jnp.maximum(length, 1e-6))
            flown = self.flight(observation, state, desired)
            return jnp.where(team.by_policy[:, None], by_policy, flown)

        def act(observation, state):
            by_policy = self.duel.policy.act(parameters, observation)
            return jax.vmap(action)(observation, state, by_policy, team)

        return self.duel.fly_actions(act, world, velocity, steps)

    def _team_candidates(self, key, team):
        """(B, T, P, ...) the policy, straight at the evader, the last plan, the same shifted by a
        piece, and random ones.
        """
        others = self.settings.team_plans - 4
        number, pieces, pursuers = team.by_policy.shape
        shape = (number, others, pieces, pursuers)
        way_key, far_key, straight_key, policy_key, turn_key = jax.random.split(key, 5)
        far = BESIDE * jax.random.uniform(far_key, (*shape, 1)) ** (1 / 3)
        beside = far * unit(jax.random.normal(way_key, (*shape, 3)))
        straight = jax.random.bernoulli(straight_key, 0.5, (*shape, 1))
        drawn = TeamPlans(
            beside=jnp.where(straight, 0.0, beside),
            by_policy=jax.random.bernoulli(policy_key, 0.5, shape),
        )
        # half of them do the same all the time
        steady = jax.random.bernoulli(turn_key, 0.5, (number, others))

        def held(leaf):
            same = steady.reshape(*steady.shape, *[1] * (leaf.ndim - 2))
            return jnp.where(same, leaf[:, :, :1], leaf)

        drawn = jax.tree.map(held, drawn)
        shifted = jax.tree.map(lambda leaf: jnp.concatenate([leaf[:, 1:], leaf[:, -1:]], 1), team)
        none = jnp.zeros_like(team.beside)
        policy = TeamPlans(none, jnp.ones_like(team.by_policy))
        at_it = TeamPlans(none, jnp.zeros_like(team.by_policy))
        known = (policy, at_it, team, shifted)
        known = jax.tree.map(lambda *leaves: jnp.stack(leaves, axis=1), *known)
        return jax.tree.map(lambda a, b: jnp.concatenate([a, b], axis=1), known, drawn)

    def _payoff(self, start: PursuitState, end: PursuitState) -> jax.Array:
        """() what the end of a pair of plans is worth to the evader, in steps."""
        horizon = self.settings.pieces * self.settings.piece_steps
        crashed = end.statistics.crashed & ~start.statistics.crashed
        return self._planner.promise(start, end) + CRASH * horizon * crashed
