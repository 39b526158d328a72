"""Both sides plan in the true simulation: what any pursuers could hold, and what none
could.

Every few steps each side thinks of some plans, and all pairs of them are flown in
copies of the world: a matrix game (von Neumann, 1928). Who chooses last knows what the
other has chosen. So with the pursuers last the captures bound from above what a team of
these plans can hold, and with the evader last from below. Both sides see everything,
pillars or not; or the pursuers what the game lets them see.

An evader's plan is a sequence of held velocities (`openjax.evaluation.judges.planner`).
A plan of the pursuers says of each of them, piece by piece, that it flies as the policy
does, or to a place beside the evader, wherever that will be, round the pillars that
stand between. What a pair of plans is worth at its end is how long the ways to the
evader are: by the straight line, pursuers would hover before a pillar behind which it
is, and nobody would go round.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

import jax
import jax.numpy as jnp
from flax import struct

from openjax.evaluation.judges.duel import Duel, World
from openjax.evaluation.judges.planner import Planner, unit
from openjax.evaluation.judges.receding_horizon import RecedingHorizon
from openjax.evaluation.judges.settings import PlannerSettings
from openjax.policy import PolicyParameters
from openjax.pursuit import Observation, PursuitState, Task
from openjax.pursuit.rows import where_rows
from openjax.ranges import Interval, check_intervals

BESIDE = 0.4
"""Places beside the evader to which a pursuer is sent are at most so far from it
(m).
"""
LEAD = 0.15
"""Seconds that a vehicle takes to fly what it is told: it is sent to where the evader
will be.
"""
REACTION = 0.1
"""Seconds in which a pursuer would reach its place, were it fast enough."""
SPEED = 0.98
"""Share of the pursuers' speed at which they fly to it: short of what a controller
overshoots.
"""
CRASH = 2.0
"""What a crash costs the pursuers, in horizons that the evader is free."""
OTHERS = 0.5
"""What the mean of all ways to the evader counts beside the shortest one: who is
nearest may be before a pillar or above the ceiling's edge, and then it's for the others
to come round.
"""


@dataclass(frozen=True)
class MatrixGameSettings:
    """How both sides plan. All pairs of plans are flown: of 16 each and .8 s, every .1
    s, 2,048 steps for one of the game.
    """

    pursuers_last: bool = True
    """Whether the pursuers choose knowing the evader's plan, or the evader knowing
    theirs.
    """
    evader_plans: Annotated[int, Interval("[3, 1000]")] = 16
    team_plans: Annotated[int, Interval("[5, 1000]")] = 16
    """In which pursuers may fly as the policy does."""
    direct_plans: Annotated[int, Interval("[0, 1000]")] = 0
    """Of the team beside those, in which none does: flown without the policy, for
    less.
    """
    refined: Annotated[float, Interval("[0, 1]")] = 0.5
    """Share of the team's new plans that are the last one with another task for one
    pursuer.
    """
    pieces: Annotated[int, Interval("[1, 100]")] = 4
    """Pieces of a plan, one after the other."""
    piece_steps: Annotated[int, Interval("[1, 1000]")] = 20
    """Control steps of each piece."""
    replan: Annotated[int, Interval("[1, 1000]")] = 10
    """Control steps after which both sides plan anew."""
    full_sight: bool = True
    """Whether pursuers that plan see through pillars. Without it, a team that doesn't
    see the evader plans as if it were where the game takes it to be.
    """

    def __post_init__(self):
        check_intervals(self)


@struct.dataclass
class TeamPlans:
    """Plans of N pursuers, of P pieces each."""

    beside: jax.Array  # (..., P, N, 3) m, from the evader to the place
    by_policy: jax.Array  # (..., P, N) bool, flies as the policy does


@struct.dataclass
class BothPlanned:
    """B worlds, and what both sides have planned in them."""

    world: World
    preparation: Any
    """What `Ways` has worked out for each."""
    plan: jax.Array  # (B, P, 3), the evader's
    team: TeamPlans


VelocityFlight = Callable[[Observation, PursuitState, jax.Array], jax.Array]
"""observation, state of one world and desired velocities (N, 3) m/s -> actions (N,
4).
"""


@dataclass(frozen=True)
class Ways:
    """How far it is from place to place."""

    prepare: Callable[[Task], Any]
    """A task -> what is worked out once for it."""
    length: Callable[[Task, Any, jax.Array, jax.Array], jax.Array]
    """task, what was prepared, (3,) position, (3,) target -> () m; its gradient by the
    position points away from the target, along the way.
    """


def _straight_length(task, preparation, position, target):
    return jnp.sqrt(jnp.sum((position - target) ** 2) + 1e-9)


STRAIGHT = Ways(lambda task: (), _straight_length)
"""As if there were no pillars."""


def choose(payoff: jax.Array, pursuers_last: bool) -> tuple[jax.Array, jax.Array]:
    """Places () of the evader's plan and of the pursuers' in a payoff (E, P) that the
    evader wants large.
    """
    if pursuers_last:
        evader = jnp.argmax(jnp.min(payoff, axis=1))
        return evader, jnp.argmin(payoff[evader])
    team = jnp.argmin(jnp.max(payoff, axis=0))
    return jnp.argmax(payoff[:, team]), team


def as_thought(world: World) -> World:
    """Worlds (B, ...) in which an evader that nobody sees is where it's taken to be."""
    observation, state = world
    place = jnp.where(state.seen[:, None], state.evader_position, state.last_seen)
    return observation, state.replace(evader_position=place)


@dataclass(frozen=True, eq=False)
class MatrixGame(RecedingHorizon):
    """Both sides' plans in one game; the policy is one of the pursuers' plans."""

    settings: MatrixGameSettings
    duel: Duel
    flight: VelocityFlight
    ways: Ways = STRAIGHT

    @property
    def _planner(self) -> Planner:
        settings = self.settings
        planning = PlannerSettings(
            settings.evader_plans, settings.pieces, settings.piece_steps, settings.replan
        )
        return Planner(planning, self.duel)

    def begin(self, start: World) -> BothPlanned:
        """Worlds (B, ...) at the start of an episode, and plans that are none."""
        game = self.duel.environment.settings
        shape = (start[1].step.size, self.settings.pieces, game.num_pursuers)
        team = TeamPlans(jnp.zeros((*shape, 3)), jnp.ones(shape, bool))
        preparation = jax.vmap(self.ways.prepare)(start[1].task)
        return BothPlanned(start, preparation, jnp.zeros((*shape[:2], 3)), team)

    def replan(
        self, parameters: PolicyParameters, carry: BothPlanned, key: jax.Array
    ) -> BothPlanned:
        """The same after both have planned once and flown until the next time."""
        evader_key, team_key = jax.random.split(key)
        plans = self._planner.candidates(evader_key, carry.plan)  # (B, E, P, 3)
        teams = self._team_candidates(team_key, carry.team)  # (B, T, P, ...)
        plan, team = self._decide(parameters, carry.world, carry.preparation, plans, teams)
        piece = jax.tree.map(lambda leaf: leaf[:, 0], team)
        act = self._act(parameters, carry.preparation, piece)
        world = self.duel.fly_actions(act, carry.world, plan[:, 0], self.settings.replan)
        return carry.replace(world=world, plan=plan, team=team)

    def _decide(self, parameters, world, preparation, plans, teams):
        """(B, P, 3) and TeamPlans (B, P, ...): what both sides choose in worlds (B,
        ...) of plans (B, E, P, 3) and (B, T, P, ...).
        """
        settings = self.settings

        def pick(leaf, place):
            return jax.vmap(lambda values, place: values[place])(leaf, place)

        if settings.full_sight:
            payoff = self._all_payoffs(parameters, world, preparation, plans, teams)
            mine, theirs = jax.vmap(lambda values: choose(values, settings.pursuers_last))(payoff)
            team = jax.tree.map(lambda leaf: pick(leaf, theirs), teams)
            return pick(plans, mine), team
        # the team plans where it takes the evader to be, and the evader knows better
        thought = self._all_payoffs(parameters, as_thought(world), preparation, plans, teams)
        if settings.pursuers_last:
            true = self._all_payoffs(parameters, world, preparation, plans, teams)
            mine = jnp.argmax(jnp.min(true, axis=2), axis=1)
            theirs = jnp.argmin(pick(thought, mine), axis=1)
            team = jax.tree.map(lambda leaf: pick(leaf, theirs), teams)
            return pick(plans, mine), team
        theirs = jnp.argmin(jnp.max(thought, axis=1), axis=1)
        team = jax.tree.map(lambda leaf: pick(leaf, theirs), teams)
        alone = jax.tree.map(lambda leaf: leaf[:, None], team)
        true = self._payoffs(parameters, world, preparation, (plans, alone))
        return pick(plans, jnp.argmax(true[..., 0], axis=1)), team

    def _all_payoffs(self, parameters, world, preparation, plans, teams):
        """(B, E, T) what all pairs of plans are worth in worlds (B, ...)."""
        settings = self.settings
        # plans in which no pursuer asks the policy are flown without it, which is most
        # of the work
        with_policy = jax.tree.map(lambda leaf: leaf[:, : settings.team_plans], teams)
        payoff = self._payoffs(parameters, world, preparation, (plans, with_policy))
        if not settings.direct_plans:
            return payoff
        direct = jax.tree.map(lambda leaf: leaf[:, settings.team_plans :], teams)
        more = self._payoffs(None, world, preparation, (plans, direct))
        return jnp.concatenate([payoff, more], axis=-1)

    def _payoffs(self, parameters, world, preparation, both):
        """(B, E, T) what all pairs of plans are worth in worlds (B, ...); `parameters`
        None: none of the team's asks the policy.
        """
        plans, teams = both
        number, evader_plans = plans.shape[:2]
        team_plans = teams.by_policy.shape[1]

        def of_pairs(leaf, axis):
            """(P, B * E * T, ...) of (B, E or T, P, ...)."""
            leaf = jnp.expand_dims(leaf, axis)
            shape = (number, evader_plans, team_plans, *leaf.shape[3:])
            leaf = jnp.broadcast_to(leaf, shape)
            return jnp.moveaxis(leaf.reshape(-1, *leaf.shape[3:]), 1, 0)

        def of_worlds(leaf):
            return jnp.repeat(leaf, evader_plans * team_plans, axis=0)

        start, preparation = jax.tree.map(of_worlds, (world, preparation))
        pieces = of_pairs(plans, 2), jax.tree.map(lambda leaf: of_pairs(leaf, 1), teams)

        def piece(world, both):
            velocity, team = both
            act = self._act(parameters, preparation, team)
            return self.duel.fly_actions(act, world, velocity, self.settings.piece_steps), None

        end = jax.lax.scan(piece, start, pieces)[0][1]
        payoff = jax.vmap(self._payoff)(start[1], end, preparation)
        return payoff.reshape(number, evader_plans, team_plans)

    def _act(self, parameters, preparation, team):
        """What the pursuers of worlds (B, ...) do in one piece of their plans (B,
        ...).
        """
        speed = SPEED * self.duel.environment.settings.max_speed
        from_all = jax.vmap(self.ways.length, in_axes=(None, None, 0, 0))

        def fly(observation, state, preparation, beside):
            place = state.evader_position + LEAD * state.evader_velocity
            if not self.settings.full_sight:
                place = jnp.where(state.seen, place, state.last_seen)

            def total(position):
                length = from_all(state.task, preparation, position, place + beside)
                return jnp.sum(length), length

            away, length = jax.grad(total, has_aux=True)(state.drones.position)
            wish = -away * jnp.minimum(speed, length / REACTION)[:, None]
            return self.flight(observation, state, wish)

        def act(observation, state):
            direct = jax.vmap(fly)(observation, state, preparation, team.beside)
            if parameters is None:
                return direct
            by_policy = self.duel.policy.act(parameters, observation)
            return jnp.where(team.by_policy[..., None], by_policy, direct)

        return act

    def _team_candidates(self, key, team):
        """(B, T, P, ...) the policy, straight at the evader, the last plan, the same
        shifted by a piece, the shifted one with another task for one pursuer, and
        random ones; and as many random ones as are `direct_plans`, without the policy.
        """
        settings = self.settings
        random_key, direct_key, near_key, who_key = jax.random.split(key, 4)
        following = jax.tree.map(lambda leaf: jnp.concatenate([leaf[:, 1:], leaf[:, -1:]], 1), team)
        none = jnp.zeros_like(team.beside)
        policy = TeamPlans(none, jnp.ones_like(team.by_policy))
        at_it = TeamPlans(none, jnp.zeros_like(team.by_policy))
        plain = (policy, at_it, team, following)
        parts = [jax.tree.map(lambda *leaves: jnp.stack(leaves, axis=1), *plain)]
        others = settings.team_plans - len(plain)
        near = int(settings.refined * others)
        shape = team.by_policy.shape
        parts.append(_random_teams(random_key, shape, others - near, 0.5))
        if near:
            random = _random_teams(near_key, shape, near, 0.5)
            who = jax.random.randint(who_key, (shape[0], near), 0, shape[-1])
            is_new = (jnp.arange(shape[-1]) == who[..., None])[:, :, None]
            old = jax.tree.map(lambda leaf: leaf[:, None], following)
            parts.append(where_rows(is_new, random, old))
        if settings.direct_plans:
            parts.append(_random_teams(direct_key, shape, settings.direct_plans, 0.0))
        return jax.tree.map(lambda *leaves: jnp.concatenate(leaves, axis=1), *parts)

    def _payoff(self, start: PursuitState, end: PursuitState, preparation: Any) -> jax.Array:
        """() what the end of a pair of plans is worth to the evader, in steps: those
        that it is free first, then how far it is from the pursuers.
        """
        horizon = self.settings.pieces * self.settings.piece_steps
        crashes = end.statistics.crashed & ~start.statistics.crashed
        free = self._planner.free_steps(start, end)
        ahead = end.drones.position + self._planner.settings.ahead * end.drones.velocity
        length = jax.vmap(self.ways.length, in_axes=(None, None, 0, None))
        ways = length(start.task, preparation, ahead, end.evader_position)
        room = jnp.min(ways) + OTHERS * jnp.mean(ways)
        # less than a step, as long as no way goes through a pillar
        room = room / (4.0 * self.duel.environment.settings.arena_radius)
        return free + room + CRASH * horizon * crashes


def _random_teams(key, shape, number, by_policy):
    """(B, number, P, N) plans, in which pieces are the policy's with these odds;
    `shape` is B, P, N.
    """
    worlds, pieces, pursuers = shape
    shape = (worlds, number, pieces, pursuers)
    way_key, far_key, straight_key, policy_key, turn_key = jax.random.split(key, 5)
    # evenly in a ball, whose volume grows with the cube
    far = BESIDE * jax.random.uniform(far_key, (*shape, 1)) ** (1 / 3)
    beside = far * unit(jax.random.normal(way_key, (*shape, 3)))
    straight = jax.random.bernoulli(straight_key, 0.5, (*shape, 1))
    plans = TeamPlans(
        beside=jnp.where(straight, 0.0, beside),
        by_policy=jax.random.bernoulli(policy_key, by_policy, shape),
    )
    # half of them do the same all the time
    steady = jax.random.bernoulli(turn_key, 0.5, (worlds, number))
    first = jax.tree.map(lambda leaf: leaf[:, :, :1], plans)
    return where_rows(steady, first, plans)
