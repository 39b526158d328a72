"""The search over plans: candidates of one side are tried, and the one that is worth most
to it is taken, against the worst of the other side's answers where it has several
(`best_of`). A team's plans are those of `openjax.learning.team_plans`.

An evader's are sequences of held velocities, each tried in a copy of its world, in which
the pursuers answer as they will.

The best plan is the one in which the evader is free longest; of those the one at whose
end it has most room. A judge's evader flies the beginning of it
(`openjax.evaluation.judges.planner`), and in the last stage of a run pursuers learn
along it (`openjax.learning.gradient.worst_plans`). No plan needs anything to be learnt, so
the search doesn't share the blind spots of evaders that learn.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from openjax.learning.settings import PlanSettings
from openjax.pursuit import Observation, PursuitSettings, PursuitState
from openjax.pursuit.shapes import Scalar
from openjax.vehicle.vectors import unit

World = tuple[Observation, PursuitState]
"""Worlds (B, ...) on their way."""
Plan = Float[Array, "worlds pieces 3"]
"""Velocities as shares of the evader's speed; NaN is its own rule."""
Plans = Float[Array, "worlds plans pieces 3"]
Fly = Callable[[World, Float[Array, "worlds 3"], int], World]
"""Worlds (B, ...), the evaders' velocities, control steps -> worlds after these."""

SPREAD = 0.6
"""How far the pieces of a refined plan lead aside, a share of their length: some 40
degrees.
"""


class Trials(NamedTuple):
    """The outcome of the plans of B worlds."""

    plans: Plans
    promise: Float[Array, "worlds plans"]
    """See `PlanSearch.promise`."""
    free: jax.Array  # (B, plans)
    """Control steps in which the evader was free."""
    end: PursuitState
    """(B, plans, ...)"""

    @property
    def best(self) -> Plan:
        """The plan of each world that promises its evader most."""
        return jax.vmap(best_of)(self.plans, self.promise)[0]


@dataclass(frozen=True, eq=False)
class PlanSearch:
    """A search over plans: those that are tried, and their worth."""

    settings: PlanSettings
    game: PursuitSettings
    constant: tuple[float, ...] = ()
    """Velocities along each axis of plans that hold one throughout: 0 stays, NaN is the
    evader's own rule.
    """
    value: Callable[[PursuitState], jax.Array] | None = None
    """State of one world -> () steps that an evader will be free from there; None: the
    farther from the pursuers the better.
    """

    def no_plan(self, worlds: int) -> Plan:
        """The last plan of those that have none."""
        return jnp.zeros((worlds, self.settings.pieces, 3))

    def attempt(self, fly: Fly, world: World, plan: Plan, key: PRNGKeyArray) -> Trials:
        """All plans tried in worlds (B, ...), and what became of them; `plan` is the
        rest of the last one.
        """
        settings = self.settings
        plans = self.candidates(key, plan)
        start = jax.tree.map(lambda leaf: jnp.repeat(leaf, settings.plans, axis=0), world)
        pieces = jnp.moveaxis(plans.reshape(-1, *plans.shape[2:]), 1, 0)

        def piece(world, velocity):
            return fly(world, velocity, settings.piece_steps), None

        (_, end), _ = jax.lax.scan(piece, start, pieces)

        def by_world(leaf):
            return leaf.reshape(plan.shape[0], settings.plans, *leaf.shape[1:])

        return Trials(
            plans,
            promise=by_world(jax.vmap(self.promise)(start[1], end)),
            free=by_world(jax.vmap(self.free_steps)(start[1], end)),
            end=jax.tree.map(by_world, end),
        )

    def candidates(self, key: PRNGKeyArray, plan: Plan) -> Plans:
        """The last best plan, the same shifted by a piece, the constant ones, straight
        ways, random ones, and the shifted one refined.
        """
        settings = self.settings
        near_key, straight_key, bent_key = jax.random.split(key, 3)
        following = shifted_plan(plan)
        # two are none of chance: the last plan, and the same a piece later
        others = settings.plans - 2 - len(self.constant)
        near = int(settings.refined * others)
        straight = (others - near) // 3
        bent = others - near - straight
        number = plan.shape[0]
        ways = unit(jax.random.normal(straight_key, (number, straight, 1, 3)))
        ways = jnp.broadcast_to(ways, (number, straight, settings.pieces, 3))
        constant = [jnp.full_like(plan, value)[:, None] for value in self.constant]
        parts = [plan[:, None], following[:, None], *constant, ways]
        parts.append(self._bent(bent_key, number, bent))
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
        # the last piece at which a way turned is the one that it flies
        last_turn = jax.lax.cummax(jnp.where(turns, jnp.arange(settings.pieces), 0), axis=2)
        bent = jnp.take_along_axis(ways, last_turn[..., None], axis=2)
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
        """() how good the end of a plan is for the evader: steps free first, then the
        room that is left.
        """
        ahead = end.drones.position + self.settings.ahead * end.drones.velocity
        room = jnp.min(jnp.linalg.norm(ahead - end.evader_position, axis=-1))
        free = self.free_steps(start, end)
        if self.value is not None:
            free += jnp.where(end.statistics.captured, 0.0, self.value(end))
        return free + room / self.game.arena_radius

    def free_steps(self, start: PursuitState, end: PursuitState) -> jax.Array:
        """() control steps of a plan before the capture, all of them where there is
        none.
        """
        newly = end.statistics.captured & ~start.statistics.captured
        return jnp.where(newly, end.statistics.capture_step - start.step, self.settings.steps)


def best_of(plans: Any, worth: jax.Array) -> tuple[Any, Scalar]:
    """Of plans (P, ...) the one whose worth (P,) to the side that tries them is largest, and
    that worth (); where it differs with A answers of the other side, (P, A), the least counts.
    """
    least = jnp.min(worth.reshape(worth.shape[0], -1), axis=1)
    place = jnp.argmax(least)
    return jax.tree.map(lambda leaf: leaf[place], plans), least[place]


def shifted_plan(plan: Plan) -> Plan:
    """The plan after its first piece; its last one goes on."""
    return jnp.concatenate([plan[:, 1:], plan[:, -1:]], axis=1)
