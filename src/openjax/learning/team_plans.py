"""Plans of a team for the next second or two: many plans of the pursuers against many of the
evader, flown by points.

A policy that learns by small changes of what it does waits where it could close in:
none of three who stand round an evader gains by going first. A search over plans of the
whole team doesn't. Here the pursuers are points that turn and brake as quadrotors can,
so that 600 pairs of plans cost less than flying the networks against 32; the team plan
that is best against the evader's best answer is the one to learn from (a matrix game,
in which the evader chooses last; `openjax.learning.plan_search.best_of`). No judge knows
of the team's plans.
"""

import dataclasses
import functools
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from openjax.learning.plan_search import best_of
from openjax.pursuit import PursuitSettings, PursuitState
from openjax.pursuit.collisions import breaches
from openjax.pursuit.evaders.behaviours import into_free_space
from openjax.pursuit.shapes import Scalar, Team, Vector
from openjax.pursuit.shortest_paths import ROOM, ShortestPaths, path_length, shortest_paths
from openjax.pursuit.task import Task, arena_of, capture_radius
from openjax.vehicle.vectors import length, unit

STEP = 0.04
"""Seconds of a point's step: it flies 4 cm."""
STRIDE = 2
"""Steps after which a point asks for its way: finding it is most of the work."""
NARROW = 0.02
"""How much nearer to pillars than other paths the points' may lead (m): through ways
of .4 m between two axes, which breach nothing.
"""
RESPONSE = 0.12
"""Seconds in which a quadrotor takes on a velocity that it is told."""
ACCELERATION = 6.0
"""m/s², as a quadrotor that tilts by 31 degrees."""
BRAKING = 0.1
"""Seconds in which a point would reach its place, were it fast enough."""
BESIDE = 0.45
"""Places beside the evader to which a pursuer is sent are at most so far from it (m):
a capture radius and a half.
"""
OTHERS = 0.5
"""What the mean of all ways to the evader counts beside the shortest one: it is for
those who aren't the nearest to come round.
"""
LOWEST = 0.15
"""Pursuers are sent no nearer than this to floor and ceiling (m): from there they
reach who is at it.
"""
LEAST_HEIGHT = 0.1
"""Nor are they ever nearer to the floor (m), where the rotors' flow comes back."""
BREACH = 0.2
"""Steps' worth of each step in which somebody breaches a safety distance: a plan that
catches the evader may, one that waits may not.
"""
APART = 1.15
"""Share of the safety distance that points keep from one another: quadrotors swing."""
STRAIGHT = 0.3
ANYWHERE = 0.25
"""Share of the pursuers that fly straight at the evader, and of those that go to a
place anywhere; all others go to places beside it.
"""
LONGEST = 1.5
"""Plans' lengths after which a pursuer turns to the evader at the latest: one of three
doesn't within the plan.
"""


Velocities = Float[Array, "plans steps 3"]
Places = Float[Array, "steps drones 3"]


@struct.dataclass
class TeamPlan:
    """The way of N pursuers until they turn to the evader itself."""

    place: jax.Array  # (..., N, 3) m, beside the evader or of the world
    is_fixed: jax.Array  # (..., N) bool, the place is one of the world
    until: jax.Array  # (..., N) s, when they turn to the evader


def no_plan(number: int) -> TeamPlan:
    """Of so many pursuers, who all fly at the evader."""
    return TeamPlan(jnp.zeros((number, 3)), jnp.zeros(number, bool), jnp.zeros(number))


@struct.dataclass
class Points:
    """A team and an evader on their way."""

    position: jax.Array  # (N, 3) m
    velocity: jax.Array  # (N, 3) m/s
    evader: jax.Array  # (3,) m
    caught: jax.Array  # () bool
    free: jax.Array  # () steps in which it was free
    breaches: jax.Array  # () steps in which somebody breached a safety distance


@dataclass(frozen=True)
class TeamPlans:
    """The number of plans that a team tries, their reach, and their worth."""

    game: PursuitSettings
    plans: int = 48
    seconds: float = 1.2

    @property
    def steps(self) -> int:
        """Points' steps of a plan."""
        return STRIDE * max(1, round(self.seconds / (STRIDE * STEP)))

    @functools.cached_property
    def narrow_game(self) -> PursuitSettings:
        """The game in whose paths narrower ways are open."""
        clearance = max(0.0, self.game.pillar_clearance - min(NARROW, ROOM))
        # whose vehicles, which points aren't, couldn't be checked inside a program
        return dataclasses.replace(
            self.game, pillar_clearance=clearance, vehicles=(), rare_vehicles=0.0
        )

    @functools.cached_property
    def strict_game(self) -> PursuitSettings:
        """The game in which pursuers keep further apart."""
        return dataclasses.replace(
            self.narrow_game,
            pillar_clearance=self.game.pillar_clearance,
            drone_clearance=APART * self.game.drone_clearance,
        )

    def paths(self, task: Task) -> ShortestPaths:
        """Round the task's pillars, narrow ways included."""
        return shortest_paths(self.narrow_game, task)

    def candidates(self, key: PRNGKeyArray, team_plan: TeamPlan) -> TeamPlan:
        """(T, ...) plans of N pursuers: straight at the evader, the rest of the last
        plan, and for a while or to the end to places beside the evader and to places
        anywhere.
        """
        shape = (self.plans, *team_plan.until.shape)
        keys = jax.random.split(key, 7)
        way = unit(jax.random.normal(keys[0], (*shape, 3)))
        # evenly in a ball, whose volume grows with the third power of its radius
        far = BESIDE * jax.random.uniform(keys[1], (*shape, 1)) ** (1 / 3)
        angle = jax.random.uniform(keys[2], shape, maxval=2 * jnp.pi)
        # evenly in a disc, whose area grows with the square
        out = 0.9 * self.game.arena_radius * jnp.sqrt(jax.random.uniform(keys[3], shape))
        height = self.game.arena_height * jax.random.uniform(
            keys[4], shape, minval=0.15, maxval=0.9
        )
        anywhere = jnp.stack([out * jnp.cos(angle), out * jnp.sin(angle), height], axis=-1)
        kind = jax.random.uniform(keys[5], shape)
        is_fixed = kind > 1.0 - ANYWHERE
        until = self.seconds * jax.random.uniform(keys[6], shape, maxval=LONGEST)
        until = jnp.where(kind < STRAIGHT, 0.0, until)
        random_plan = TeamPlan(jnp.where(is_fixed[..., None], anywhere, far * way), is_fixed, until)
        straight = no_plan(team_plan.until.shape[0])
        return jax.tree.map(
            lambda leaf, *first: leaf.at[: len(first)].set(jnp.stack(first)),
            random_plan,
            straight,
            team_plan,
        )

    def target(self, plan: TeamPlan, evader: Vector, time: Scalar) -> Team:
        """(N, 3) m, where pursuers go at a time."""
        beside = plan.place + jnp.where(plan.is_fixed[:, None], 0.0, evader)
        place = jnp.where((time >= plan.until)[:, None], evader, beside)
        low = jnp.array([-jnp.inf, -jnp.inf, LOWEST])
        high = jnp.array([jnp.inf, jnp.inf, self.game.arena_height - LOWEST])
        return jnp.clip(place, low, high)

    def desired_velocity(self, task, paths: ShortestPaths, position: Team, target: Team) -> Team:
        """(N, 3) m/s, along the shortest path to (N, 3) targets."""

        def one(position, target):
            def way(position):
                return path_length(self.narrow_game, task, paths, position[None], target)[0]

            far, away = jax.value_and_grad(way)(position)
            return -away * jnp.minimum(self.game.max_speed, far / BRAKING)

        return jax.vmap(one)(position, target)

    def fly(self, task, paths: ShortestPaths, start: Points, plan: TeamPlan, velocities):
        """Points at the end of a plan against (steps, 3) velocities of the evader in
        m/s, and where the pursuers were after each step (steps, N, 3).
        """

        def stride(points, step):
            first, velocities = step
            # to where it is by the time that they have answered
            lead = points.evader + RESPONSE * velocities[0]
            target = self.target(plan, lead, first * STEP)
            velocity_wish = self.desired_velocity(task, paths, points.position, target)
            places = []
            for velocity in velocities:
                points = self._after_step(task, points, velocity_wish, velocity)
                places.append(points.position)
            return points, jnp.stack(places)

        firsts = jnp.arange(0, self.steps, STRIDE)
        end, places = jax.lax.scan(stride, start, (firsts, velocities.reshape(-1, STRIDE, 3)))
        return end, places.reshape(-1, *places.shape[2:])

    def _after_step(self, task, points, velocity_wish, velocity):
        """Points a step later, whose pursuers wish to fly (N, 3) m/s."""
        game = self.game
        # as the game's evader it keeps two centimetres from bounds and pillars
        evader = into_free_space(
            arena_of(game, task),
            points.evader + STEP * velocity,
            task.pillar_position,
            task.pillar_active,
        )
        push = (velocity_wish - points.velocity) / RESPONSE
        size = length(push, keepdims=True)
        next_velocity = points.velocity + STEP * push * jnp.minimum(1.0, ACCELERATION / size)
        low = jnp.array([-jnp.inf, -jnp.inf, LEAST_HEIGHT])
        high = jnp.array([jnp.inf, jnp.inf, game.arena_height])
        position = jnp.clip(points.position + STEP * next_velocity, low, high)
        square = jnp.sum((position - evader) ** 2, axis=-1)
        breach = breaches(
            arena_of(self.strict_game, task), position, task.pillar_position, task.pillar_active
        )
        is_caught = points.caught | jnp.any(square < capture_radius(game, task) ** 2)
        return Points(
            position,
            next_velocity,
            evader,
            is_caught,
            free=points.free + ~is_caught,
            breaches=points.breaches + jnp.any(breach.total > 0),
        )

    def payoff(self, task, paths: ShortestPaths, end: Points) -> Scalar:
        """() what a pair of plans is worth to the evader, in steps: those that it is
        free first.
        """
        room = self._room(task, paths, end.position, end.evader)
        return end.free + room + BREACH * end.breaches

    def start(self, state: PursuitState) -> Points:
        """A world's vehicles as points."""
        drones = state.drones
        none = jnp.zeros((), jnp.int32)
        return Points(
            drones.position, drones.velocity, state.evader_position, jnp.zeros((), bool), none, none
        )

    def best(
        self,
        state: PursuitState,
        paths: ShortestPaths,
        velocities: Velocities,
        team_plan: TeamPlan,
        key: PRNGKeyArray,
    ) -> tuple[TeamPlan, Scalar]:
        """Of one world: the team's plan that is best against the worst of the evader's
        (E, steps, 3) m/s, and what that is worth to the evader.
        """
        task = state.task
        start = self.start(state)
        teams = self.candidates(key, team_plan)

        def pair(team, velocity):
            return self.payoff(task, paths, self.fly(task, paths, start, team, velocity)[0])

        payoff = jax.vmap(jax.vmap(pair, (None, 0)), (0, None))(teams, velocities)
        # what the evader wins the team loses
        best, worth = best_of(teams, -payoff)
        return best, -worth

    def way(self, state: PursuitState, paths: ShortestPaths, plan: TeamPlan, velocity) -> Places:
        """The positions of one world's pursuers after each step of a plan against the evader's
        (steps, 3) m/s.
        """
        return self.fly(state.task, paths, self.start(state), plan, velocity)[1]

    def room(self, state: PursuitState, paths: ShortestPaths) -> Scalar:
        """() of a step, how far a world's evader is from the pursuers."""
        return self._room(state.task, paths, state.drones.position, state.evader_position)

    def _room(self, task, paths, position, evader):
        ways = path_length(self.narrow_game, task, paths, position, evader)
        room = jnp.min(ways) + OTHERS * jnp.mean(ways)
        # less than a step
        return room / (4.0 * self.game.arena_radius)
