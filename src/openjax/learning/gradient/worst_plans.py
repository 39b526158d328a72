"""The last lesson against evaders that plan: the gradient of the pursuers' loss at the
plan that is worst for them.

An evader that learns beside the pursuers finds some of their weaknesses, and an evader
that plans in the true simulation against the true policy finds others: those of the
next second, without having to learn anything. Here evaders plan
(`openjax.learning.plan_search`), and the pursuers follow the gradient through the
simulation along the plan that came out worst. The gradient of a maximum is the gradient
at the place of the maximum (Danskin 1966, The theory of max-min), so the plan itself
needs none; training networks against their worst inputs works the same way (Madry et
al. 2018, arXiv 1706.06083).
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

from openjax.learning.drawn_starts import draw_anywhere, is_lost
from openjax.learning.gradient.last_flights import LastFlights
from openjax.learning.gradient.measures import (
    SmoothFlight,
    Worlds,
    crash_share,
    mean_step,
    team_weight,
)
from openjax.learning.gradient.stage import (
    Learnt,
    Turn,
    clipped_descent,
    falling_rate,
    finite_or_zero,
    weighted_sum,
)
from openjax.learning.plan_search import Plan, PlanSearch, Trials, shifted_plan
from openjax.learning.settings import GeneratorSettings, PlanSettings, WorstPlansSettings
from openjax.learning.team_plans import STEP, TeamPlan, TeamPlans, no_plan
from openjax.policy import PolicyParameters
from openjax.pursuit import Pursuit, PursuitSettings, PursuitState
from openjax.pursuit.rows import where_rows
from openjax.pursuit.shapes import Scalar
from openjax.pursuit.task import evader_speed
from openjax.vehicle.family import partly_nominal

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
class PlannedWorlds:
    """The lesson's state between two updates."""

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


class Example(NamedTuple):
    """The search's example for the pursuers of B worlds."""

    places: jax.Array
    """(B, pieces, N, 3) m, where they should be after each piece of the evader's
    plan
    """
    gain: jax.Array
    """(B,) from 0 to 1, how much better the team's plan is than what they do"""

    def distance(self, position: Float[Array, "worlds pieces pursuers 3"]) -> Worlds:
        """(B,) m, how far pursuers are from their places, by the gain."""
        square = jnp.sum((position - self.places) ** 2, axis=-1)
        # of two ways round a pillar the nearer one: a mean of both leads into it
        return self.gain * jnp.mean(jnp.sqrt(square + NEAR**2) - NEAR, axis=(1, 2))


@dataclass(frozen=True, eq=False)
class WorstPlans:
    """A lesson in which evaders plan, beside what `usual` teaches."""

    planning: WorstPlansSettings
    environment: Pursuit
    """See `planning_game`."""
    usual: LastFlights
    tasks: GeneratorSettings
    """The generator's differences from the paper's uniform tasks; these have them, too."""

    @property
    def updates(self) -> int:
        """Of the actor."""
        return self.usual.updates

    @functools.cached_property
    def flight(self) -> SmoothFlight:
        """The flight in that game, with its measures."""
        return dataclasses.replace(self.usual.flight, environment=self.environment)

    @property
    def game(self) -> PursuitSettings:
        """The game's settings."""
        return self.environment.settings

    @functools.cached_property
    def search(self) -> PlanSearch:
        """The evaders' plans; to stay and their own rule are two of them."""
        planning = self.planning
        piece_steps = max(1, round(planning.PIECE_SECONDS / self.game.time_step))
        plans = PlanSettings(planning.PLANS, planning.PIECES, piece_steps)
        return PlanSearch(plans, self.game, constant=(0.0, np.nan))

    @functools.cached_property
    def team(self) -> TeamPlans:
        """The plans that a team could follow."""
        seconds = self.search.settings.steps * self.game.time_step
        return TeamPlans(self.game, self.planning.TEAM_PLANS, seconds)

    @functools.cached_property
    def optimiser(self) -> optax.GradientTransformation:
        """Adam with clipped gradients, whose step size rises first and falls then."""
        rate = self.usual.settings.learning_rate
        warm_up = min(WARM_UP, self.updates // 4)
        rising = optax.linear_schedule(0.0, rate, warm_up)
        falling = falling_rate(rate, self.updates - warm_up)
        return clipped_descent(optax.join_schedules([rising, falling], [warm_up]))

    def record(self, parameters: PolicyParameters, key: PRNGKeyArray, late: None = None):
        """Flights for the usual part."""
        return self.usual.record(parameters, key)

    def begin(self, key: PRNGKeyArray) -> PlannedWorlds:
        """Fresh worlds, and no plan yet."""
        worlds = self.planning.worlds
        team = None
        if not self.game.team_sizes:
            none = no_plan(self.game.num_pursuers)
            team = jax.tree.map(lambda leaf: jnp.stack([leaf] * worlds), none)
        return PlannedWorlds(self.start(key), self.search.no_plan(worlds), team)

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

    def attempts(
        self, actor: Any, parameters: PolicyParameters, world, plan: Plan, key: PRNGKeyArray
    ) -> Trials:
        """Outcome of the evaders' plans in worlds (B, ...); `plan` is the rest of the last."""
        fly_on = mean_step(self.environment, self.flight.policy, parameters)

        def fly(world, velocity, steps):
            def one(world, _):
                observation, state = world
                return fly_on(actor, observation, state, velocity), None

            return jax.lax.scan(one, world, length=steps)[0]

        return self.search.attempt(fly, world, plan, key)

    def show(
        self, trials: Trials, world, team_plan: TeamPlan, plan: Plan, key: PRNGKeyArray
    ) -> tuple[TeamPlan, Example]:
        """The best actions of the teams of worlds (B, ...) against evaders that fly `plan`: those
        that do best against the worst of the most promising plans. `team_plan` is the rest of the
        last one.
        """
        team = self.team
        # found once: pillars stand still, whatever is tried
        paths = jax.vmap(team.paths)(world[1].task)
        room = jax.vmap(jax.vmap(team.room, (0, None)))(trials.end, paths)
        worth = trials.free * (self.game.time_step / STEP) + room
        most = jax.lax.top_k(trials.promise, min(ANSWERS, self.planning.PLANS))[1]

        def pick(leaf):
            return jax.vmap(lambda values, places: values[places])(leaf, most)

        task = world[1].task
        velocities = self._velocities(task, pick(trials.plans))
        keys = jax.random.split(key, plan.shape[0])
        best, promise = jax.vmap(team.best)(world[1], paths, velocities, team_plan, keys)
        gain = jnp.max(pick(worth), axis=1) - promise
        way = jax.vmap(team.way)(world[1], paths, best, self._velocities(task, plan))
        ends_of_pieces = np.arange(1, self.planning.PIECES + 1) * team.steps // self.planning.PIECES
        places = way[:, ends_of_pieces - 1]
        return best, Example(places, jnp.clip((gain - MARGIN) / CLEAR, 0.0, 1.0))

    def _velocities(self, task, plans):
        """(B, ..., steps, 3) m/s at the points' steps of plans (B, ..., pieces, 3) of
        the evaders of tasks (B, ...); who flies by its own rule is taken to stay.
        """
        pieces = self.planning.PIECES
        piece = np.arange(self.team.steps) * pieces // self.team.steps
        shares = jnp.nan_to_num(plans[..., piece, :])
        speed = jnp.asarray(evader_speed(self.game, task))
        return speed.reshape(-1, *[1] * (shares.ndim - 1)) * shares

    def loss(
        self,
        actor: Any,
        parameters: PolicyParameters,
        world,
        plan: Plan,
        example: Example | None = None,
    ) -> tuple[Scalar, tuple[Any, dict[str, Scalar]]]:
        """The loss () while evaders fly their plans, the worlds after the plans' first piece, and
        the loss's parts.
        """
        planning = self.planning
        weight = functools.partial(team_weight, self.game)
        steps = self.search.settings.piece_steps

        def piece(world, velocity):
            world, encounter = self.flight.fly(actor, parameters, world, steps, velocity)
            return world, (world, encounter)

        # one body for all pieces: each would take a GPU's compiler half a minute
        worlds, encounter = jax.lax.scan(piece, world, jnp.moveaxis(plan, 1, 0))[1]
        next_worlds = jax.tree.map(lambda leaf: jax.lax.stop_gradient(leaf[0]), worlds)
        change = self.flight.change(actor, parameters, world[0])
        # the gradient knows where the evader is: who doesn't see it would unlearn to search
        is_seen = world[1].seen.astype(jnp.float32)
        hold = jnp.where(world[1].seen, self.usual.settings.hold, weight(planning.HOLD_UNSEEN))
        positions = jnp.moveaxis(worlds[1].drones.position, 0, 1)
        parts = {
            "free": (1.0, is_seen * jnp.mean(encounter.free, axis=0)),
            "distance": (planning.DISTANCE, is_seen * jnp.mean(encounter.distance, axis=0)),
            # where nobody sees it, too: to look where it was last seen is what is to be learnt
            "unseen": (planning.UNSEEN, encounter.unseen),
        }
        if example is not None:
            parts["follow"] = (planning.FOLLOW, is_seen * example.distance(positions))
        parts |= {
            "crashes": (weight(planning.CRASH), crash_share(jnp.min(encounter.least, axis=0))),
            "breaches": (weight(planning.BREACH), encounter.breach),
            "speed": (weight(self.usual.settings.SPEED), encounter.excess),
            "held": (1.0, hold[:, None] * change),
        }
        total, means = weighted_sum(parts)
        return total, (next_worlds, means)

    @property
    def programs(self):
        """Plans; what is learnt from them; and that with what is always learnt. See
        `Lesson`.
        """
        return self._plan, self._learn_from_plans, self._learn_as_usual, self._learn

    def _plan(self, turn: Turn, _results: tuple):
        """Plans (B, ...) of the evaders and what the best promise, plans of their
        pursuers' teams, and what these show.
        """
        key = _keys(turn)[0]
        worlds = turn.carry.lesson
        trials = self.attempts(turn.actor, turn.parameters, worlds.world, worlds.plan, key)
        plan = trials.best
        promise = jnp.max(trials.promise, axis=1)
        if worlds.team is None:
            return plan, promise, None, None
        show_key = jax.random.fold_in(key, 1)
        team, example = self.show(trials, worlds.world, worlds.team, plan, show_key)
        team = team.replace(until=team.until - self.planning.PIECE_SECONDS)
        return plan, promise, team, example

    def _learn_from_plans(self, turn: Turn, results: tuple):
        """The gradient, the worlds after the plans' first piece, and the loss's
        parts.
        """
        plan, _, _, example = results[0]
        gradient, (world, parts) = jax.grad(self.loss, has_aux=True)(
            turn.actor, turn.parameters, turn.carry.lesson.world, plan, example
        )
        return finite_or_zero(gradient), world, parts

    def _learn_as_usual(self, turn: Turn, _results: tuple):
        """The gradient of the usual part, and its loss's parts."""
        key = _keys(turn)[1]
        gradient, parts = self.usual.gradient(turn.actor, turn.parameters, turn.flights, key)
        return finite_or_zero(gradient), parts

    def _learn(self, turn: Turn, results: tuple) -> Learnt:
        (plan, promise, team, example), (gradient, world, parts), usual = results
        usual_gradient, usual_parts = usual
        gradient = jax.tree.map(jnp.add, gradient, usual_gradient)
        over = self._over(world[1])
        world = where_rows(over, self.start(_keys(turn)[2]), world)
        plan = jnp.where(over[:, None, None], 0.0, shifted_plan(plan))
        parts = {f"planned_{name}": value for name, value in parts.items()}
        parts["planned_survived"] = jnp.mean(promise >= self.search.settings.steps)
        if example is not None:
            parts["planned_gain"] = jnp.mean(example.gain)
        return Learnt(gradient, PlannedWorlds(world, plan, team), usual_parts | parts)

    def _over(self, state: PursuitState) -> Bool[Array, " worlds"]:
        """(B,) worlds that start anew: the evader is caught, a pursuer crashed or left,
        or there is no time for another plan.
        """
        late = state.step > self.game.episode_length - self.search.settings.steps
        return is_lost(self.game, state) | state.statistics.captured | late


def planning_game(environment: Pursuit) -> Pursuit:
    """`environment` with an evader that flies as it's told, without limits of
    acceleration.
    """
    settings = dataclasses.replace(environment.settings, evaders=("field",))
    return dataclasses.replace(environment, settings=settings, evaders=None)


def _keys(turn):
    """Of the plans, of the usual part and of fresh worlds."""
    return jax.random.split(turn.key, 3)
