"""The last stage against evaders that plan: the gradient of the pursuers' loss at the
plan that is worst for them.

An evader that learns beside the pursuers finds some of their weaknesses, and an evader
that plans in the true simulation against the true policy finds others: those of the
next second, without having to learn anything. Here evaders plan, and the pursuers
follow the gradient through the simulation along the plan that came out worst. The
gradient of a maximum is the gradient at the place of the maximum (Danskin 1966, The
theory of max-min), so the plan itself needs none; training networks against their worst
inputs works the same way (Madry et al. 2018, arXiv 1706.06083).

It shares no code with the planner of `openjax.evaluation.judges`, which judges what is
learnt here.
"""

import dataclasses
import functools
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from openjax.learning.analytic_gradient import AnalyticGradient
from openjax.learning.drawn_starts import draw_anywhere, is_lost
from openjax.learning.gradient_stage import Turn, Updated
from openjax.learning.gradient_step import (
    clipped_descent,
    falling_rate,
    finite_or_zero,
    mean_step,
    renew,
    weighted_sum,
)
from openjax.learning.settings import AnalyticSettings, GeneratorSettings, WorstPlansSettings
from openjax.learning.smooth_measures import crash_share
from openjax.learning.team_search import STEP, TeamPlan, TeamSearch, no_plan
from openjax.policy import PolicyParameters
from openjax.pursuit import Pursuit, PursuitSettings, PursuitState
from openjax.pursuit.shapes import Scalar
from openjax.pursuit.task import evader_speed
from openjax.vehicle.family import partly_nominal
from openjax.vehicle.vectors import unit

Plans = Float[Array, "worlds plans pieces 3"]
Plan = Float[Array, "worlds pieces 3"]

AHEAD = 0.15
"""Seconds after which pursuers are thought to be where their velocity leads, at a
plan's end.
"""
NOMINAL = 0.5
"""Share of the worlds whose vehicles are nominal ones: evaders are judged against
these.
"""
WARM_UP = 15
"""Updates in which the step size rises: Adam's first steps are of full size whatever
the gradient, and one of them undoes a policy (captures of a planner fell from .44 to
.06).
"""
ANSWERS = 12
"""Plans of the evader, those that promised it most, against which a team's plan has to
be good.
"""
MARGIN = 0.02
CLEAR = 0.1
"""From this much better, in points' steps, the team's plan is followed at all, and from
both together in full: points turn a little sooner than quadrotors. A metre of all ways
to the evader is .4 of a step.
"""
NEAR = 0.05
"""Who is nearer than this to where they should be is taken to be there (m)."""


@struct.dataclass
class Planned:
    """What is carried from update to update."""

    optimiser: Any
    world: Any
    """Observations and states (B, ...)"""
    plan: jax.Array
    """(B, pieces, 3) the rest of the last plan of each, NaN or zero where there is
    none
    """
    team: TeamPlan | None = None
    """(B, ...) the rest of the last plan that their pursuers should have flown; None:
    no such plans are searched for
    """


class Tried(NamedTuple):
    """Plans that evaders of B worlds tried."""

    plans: jax.Array
    """(B, plans, pieces, 3)"""
    promise_of_plans: jax.Array
    """(B, plans), see `promise`"""
    free: jax.Array
    """(B, plans) control steps in which it was free"""
    end: PursuitState
    """(B, plans, ...)"""


class Example(NamedTuple):
    """What the pursuers of B worlds are shown by the search."""

    places: jax.Array
    """(B, pieces, N, 3) m, where they should be after each piece of the evader's
    plan
    """
    gain: jax.Array
    """(B,) from 0 to 1, how much better the team's plan is than what they do"""


@dataclass(frozen=True, eq=False)
class WorstPlans:
    """A last stage in which evaders plan, beside what `usual` learns."""

    planning: WorstPlansSettings
    environment: Pursuit
    """See `planning_game`."""
    usual: AnalyticGradient
    tasks: GeneratorSettings
    """How the generator's uniform tasks differ from the paper's; these do, too."""

    @property
    def settings(self) -> AnalyticSettings:
        """The stage's length, its step size and what it weighs in flight."""
        return self.usual.settings

    @functools.cached_property
    def flight(self) -> AnalyticGradient:
        """What flies in that game, and measures."""
        return dataclasses.replace(self.usual, environment=self.environment)

    @property
    def game(self) -> PursuitSettings:
        """The game's settings."""
        return self.environment.settings

    @property
    def piece_steps(self) -> int:
        """Control steps of a plan's piece."""
        return max(1, round(self.planning.piece_seconds / self.game.time_step))

    @property
    def steps(self) -> int:
        """Control steps of a plan."""
        return self.planning.pieces * self.piece_steps

    @functools.cached_property
    def optimiser(self) -> optax.GradientTransformation:
        """Adam with clipped gradients, whose step size rises first and falls then."""
        rate = self.settings.learning_rate
        warm_up = min(WARM_UP, self.settings.updates // 4)
        rising = optax.linear_schedule(0.0, rate, warm_up)
        falling = falling_rate(rate, self.settings.updates - warm_up)
        return clipped_descent(optax.join_schedules([rising, falling], [warm_up]))

    @functools.cached_property
    def team(self) -> TeamSearch:
        """What a team could do."""
        seconds = self.steps * self.game.time_step
        return TeamSearch(self.game, self.planning.team_plans, seconds)

    def begin(self, parameters: PolicyParameters, key: PRNGKeyArray) -> Planned:
        """Fresh worlds, and no plan yet."""
        worlds = self.planning.worlds
        plan = jnp.zeros((worlds, self.planning.pieces, 3))
        team = None
        if self.planning.team_plans:
            none = no_plan(self.game.num_pursuers)
            team = jax.tree.map(lambda leaf: jnp.stack([leaf] * worlds), none)
        return Planned(self.optimiser.init(parameters.actor), self.start(key), plan, team)

    def record(self, parameters: PolicyParameters, key: PRNGKeyArray):
        """Flights for the usual part."""
        return self.usual.record(parameters, key)

    def start(self, key: PRNGKeyArray):
        """Worlds (B, ...) at the starts of tasks like the generator's uniform ones."""
        game = self.game

        def one(key, bounds):
            environment = self.environment
            if game.vehicles:
                environment = environment.with_bounds(bounds)
            task = draw_anywhere(game, self.tasks, key)
            return environment.reset_to(jax.random.fold_in(key, 1), task)

        worlds = self.planning.worlds
        bounds = partly_nominal(game.vehicles, worlds, NOMINAL)
        return jax.vmap(one)(jax.random.split(key, worlds), bounds)

    def candidates(self, key: PRNGKeyArray, plan: Plan) -> Plans:
        """The rest of the last plan and the same a piece later, to stay, the evader's
        own rule (NaN), straight ways, and ways that turn after a piece as often as not.
        """
        planning = self.planning
        number = plan.shape[0]
        # four are none of chance: the last plan, the same later, to stay, its own rule
        straight = (planning.plans - 4) // 3
        turn_key, way_key, straight_key = jax.random.split(key, 3)
        shape = (number, planning.plans - 4 - straight, planning.pieces)
        random_ways = unit(jax.random.normal(way_key, (*shape, 3)))
        turns = jax.random.bernoulli(turn_key, 0.5, shape)
        # the last piece at which a way turned is the one that it flies
        last_turn = jax.lax.cummax(jnp.where(turns, jnp.arange(planning.pieces), 0), axis=2)
        bent = jnp.take_along_axis(random_ways, last_turn[..., None], axis=2)
        ways = unit(jax.random.normal(straight_key, (number, straight, 1, 3)))
        parts = [
            plan[:, None],
            _shift(plan)[:, None],
            jnp.zeros_like(plan)[:, None],
            jnp.full_like(plan, jnp.nan)[:, None],
            jnp.broadcast_to(ways, (number, straight, planning.pieces, 3)),
            bent,
        ]
        return jnp.concatenate(parts, axis=1)

    def attempts(
        self, actor: Any, parameters: PolicyParameters, world, plan: Plan, key: PRNGKeyArray
    ) -> Tried:
        """All plans tried in worlds (B, ...), and what became of them; `plan` is the
        rest of the last one.
        """
        plans = self.candidates(key, plan)
        number = self.planning.plans
        copies = jax.tree.map(lambda leaf: jnp.repeat(leaf, number, axis=0), world)
        pieces = jnp.moveaxis(plans.reshape(-1, *plans.shape[2:]), 1, 0)
        fly_on = mean_step(self.environment, self.usual.policy, parameters)

        def piece(world, wish):
            def one(world, _):
                observation, state = world
                return fly_on(actor, observation, state, wish), None

            return jax.lax.scan(one, world, length=self.piece_steps)[0], None

        (_, end), _ = jax.lax.scan(piece, copies, pieces)
        free = self._free(copies[1], end)
        promise = self.promise(copies[1], end)

        def by_world(leaf):
            return leaf.reshape(-1, number, *leaf.shape[1:])

        return Tried(plans, by_world(promise), by_world(free), jax.tree.map(by_world, end))

    def _free(self, start, end):
        """(W,) control steps of a plan in which the evader was free."""
        is_new = end.statistics.captured & ~start.statistics.captured
        return jnp.where(is_new, end.statistics.capture_step - start.step, self.steps)

    def show(
        self, trials: Tried, world, team_plan: TeamPlan, plan: Plan, key: PRNGKeyArray
    ) -> tuple[TeamPlan, Example]:
        """What the teams of worlds (B, ...) should do against evaders that fly `plan`:
        what is best against the worst of the plans that promised most. `team_plan` is
        the rest of the last one.
        """
        team = self.team
        # found once: pillars stand still, whatever is tried
        paths = jax.vmap(team.paths)(world[1].task)
        room = jax.vmap(jax.vmap(team.room, (0, None)))(trials.end, paths)
        worth = trials.free * (self.game.time_step / STEP) + room
        most = jax.lax.top_k(trials.promise_of_plans, min(ANSWERS, self.planning.plans))[1]

        def pick(leaf):
            return jax.vmap(lambda values, places: values[places])(leaf, most)

        task = world[1].task
        velocities = self._velocities(task, pick(trials.plans))
        keys = jax.random.split(key, plan.shape[0])
        best, promise = jax.vmap(team.search)(world[1], paths, velocities, team_plan, keys)
        gain = jnp.max(pick(worth), axis=1) - promise
        way = jax.vmap(team.way)(world[1], paths, best, self._velocities(task, plan))
        ends_of_pieces = np.arange(1, self.planning.pieces + 1) * team.steps // self.planning.pieces
        places = way[:, ends_of_pieces - 1]
        return best, Example(places, jnp.clip((gain - MARGIN) / CLEAR, 0.0, 1.0))

    def _velocities(self, task, plans):
        """(B, ..., steps, 3) m/s at the points' steps of plans (B, ..., pieces, 3) of
        the evaders of tasks (B, ...); who flies by its own rule is taken to stay.
        """
        pieces = self.planning.pieces
        piece = np.arange(self.team.steps) * pieces // self.team.steps
        shares = jnp.nan_to_num(plans[..., piece, :])
        speed = jnp.asarray(evader_speed(self.game, task))
        return speed.reshape(-1, *[1] * (shares.ndim - 1)) * shares

    def promise(self, start: PursuitState, end: PursuitState) -> Float[Array, " worlds"]:
        """(W,) how good the end of a plan is for the evader: steps free first, then the
        room that is left.
        """
        free = self._free(start, end)
        ahead = end.drones.position + AHEAD * end.drones.velocity
        offset = ahead - end.evader_position[:, None]
        room = jnp.sqrt(jnp.min(jnp.sum(offset**2, axis=-1), axis=-1))
        return free + room / self.game.arena_radius

    def loss(
        self,
        actor: Any,
        parameters: PolicyParameters,
        world,
        plan: Plan,
        example: Example | None = None,
    ) -> tuple[Scalar, tuple[Any, dict[str, Scalar]]]:
        """What is learnt () while evaders fly their plans; the worlds after the plans'
        first piece, and the loss's parts.
        """
        planning = self.planning
        policy = self.usual.policy

        def piece(world, wish):
            world, encounter = self.flight.fly(actor, parameters, world, self.piece_steps, wish)
            return world, (world, encounter)

        # one body for all pieces: each would take a GPU's compiler half a minute
        worlds, encounter = jax.lax.scan(piece, world, jnp.moveaxis(plan, 1, 0))[1]
        next_worlds = jax.tree.map(lambda leaf: jax.lax.stop_gradient(leaf[0]), worlds)
        observation, prediction = self.usual.inputs(parameters, world[0])
        reference_mean, log_std = policy.distribution(parameters.actor, observation, prediction)
        mean, _ = policy.distribution(actor, observation, prediction)
        change = (mean - reference_mean) * jnp.exp(-log_std)
        # the gradient knows where the evader is, and who doesn't see it can't learn
        # from that: they would unlearn to search
        is_seen = world[1].seen.astype(jnp.float32)
        hold = jnp.where(world[1].seen, self.settings.hold, planning.hold_unseen)
        distance = is_seen * jnp.mean(encounter.distance, axis=0)
        positions = jnp.moveaxis(worlds[1].drones.position, 0, 1)
        parts = {
            "free": (1.0, is_seen * jnp.mean(encounter.free, axis=0)),
            "distance": (planning.distance, distance),
            **self._optional_parts(encounter, is_seen, positions, example),
            "crashes": (planning.crash, crash_share(jnp.min(encounter.least, axis=0))),
            "breaches": (planning.breach, encounter.breach),
            "speed": (self.settings.speed, encounter.excess),
            "held": (1.0, hold[:, None] * jnp.sum(change**2, axis=-1)),
        }
        total, means = weighted_sum(parts)
        return total, (next_worlds, means)

    def _optional_parts(self, encounter, weight, position, example):
        """Parts of the loss that a stage may have, `weight` (B,) where the evader is
        seen; what isn't weighed isn't worked out, nor told.
        """
        planning = self.planning
        parts = {}
        if planning.territory:
            territory = weight * jnp.mean(encounter.territory, axis=0)
            parts["territory"] = (planning.territory, territory)
        if planning.unseen:
            # where nobody sees it, too: to look where it was last seen is what is to be
            # learnt
            parts["unseen"] = (planning.unseen, encounter.unseen)
        if example is not None:
            square = jnp.sum((position - example.places) ** 2, axis=-1)
            # of two ways round a pillar the nearer one: a mean of both leads into it
            off = jnp.mean(jnp.sqrt(square + NEAR**2) - NEAR, axis=(1, 2))
            parts["follow"] = (planning.follow, weight * example.gain * off)
        return parts

    @property
    def programs(self):
        """Plans; what is learnt from them; what is always learnt; and what comes of
        both. See `GradientStage`.
        """
        return self._plan, self._learnt, self._always_learnt, self._update

    def _plan(self, turn: Turn, _results: tuple):
        """Plans (B, ...) of the evaders and what these promise, plans of their
        pursuers' teams, and what these show.
        """
        key = _keys(turn)[0]
        state = turn.state
        trials = self.attempts(turn.actor, turn.parameters, state.world, state.plan, key)
        plan, promise = worst_of(trials)
        if state.team is None:
            return plan, promise, None, None
        team, example = self.show(trials, state.world, state.team, plan, jax.random.fold_in(key, 1))
        team = team.replace(until=team.until - self.planning.piece_seconds)
        return plan, promise, team, example

    def _learnt(self, turn: Turn, results: tuple):
        """The gradient, the worlds after the plans' first piece, and the loss's
        parts.
        """
        plan, _, _, example = results[0]
        gradient, (world, parts) = jax.grad(self.loss, has_aux=True)(
            turn.actor, turn.parameters, turn.state.world, plan, example
        )
        return finite_or_zero(gradient), world, parts

    def _always_learnt(self, turn: Turn, _results: tuple):
        """The gradient of the usual part, and its loss's parts."""
        key = _keys(turn)[1]
        return self.usual.gradient(turn.actor, turn.parameters, turn.flights, key)

    def _update(self, turn: Turn, results: tuple) -> Updated:
        (plan, promise, team, example), (gradient, world, parts), usual = results
        usual_gradient, usual_parts = usual
        gradient = jax.tree.map(jnp.add, gradient, usual_gradient)
        change, optimiser = self.optimiser.update(gradient, turn.state.optimiser)
        over = self._over(world[1])
        world = renew(over, world, self.start(_keys(turn)[2]))
        plan = jnp.where(over[:, None, None], 0.0, _shift(plan))
        parts = {f"planned_{name}": value for name, value in parts.items()}
        parts["planned_survived"] = jnp.mean(promise >= self.steps)
        if example is not None:
            parts["planned_gain"] = jnp.mean(example.gain)
        return (
            optax.apply_updates(turn.actor, change),
            Planned(optimiser, world, plan, team),
            usual_parts | parts,
        )

    def _over(self, state: PursuitState) -> Bool[Array, " worlds"]:
        """(B,) worlds that start anew: the evader is caught, a pursuer crashed or left,
        or there is no time for another plan.
        """
        late = state.step > self.game.episode_length - self.steps
        return is_lost(self.game, state) | state.statistics.captured | late


def worst_of(trials: Tried) -> tuple[Plan, Float[Array, " worlds"]]:
    """The plan that promises the evader of each world most, and how much."""
    best = jnp.argmax(trials.promise_of_plans, axis=1)
    plans = jnp.take_along_axis(trials.plans, best[:, None, None, None], axis=1)
    return plans[:, 0], jnp.max(trials.promise_of_plans, axis=1)


def planning_game(environment: Pursuit) -> Pursuit:
    """`environment` with an evader that flies as it's told, without limits of
    acceleration.
    """
    settings = dataclasses.replace(environment.settings, evaders=("field",))
    return dataclasses.replace(environment, settings=settings, evaders=None)


def _keys(turn):
    """Of the plans, of the usual part and of fresh worlds."""
    return jax.random.split(turn.key, 3)


def _shift(plan):
    """(..., pieces, 3) the plan after its first piece; its last one goes on."""
    return jnp.concatenate([plan[:, 1:], plan[:, -1:]], axis=1)
