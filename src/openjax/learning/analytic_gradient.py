"""The last stage of a policy that is to be flown: the gradient through the simulation
(analytic policy gradient).

MAPPO is a poor teacher of what is decided within tenths of a second. Starts lean by up
to 36 degrees, some beside a pillar or another pursuer; its noise averages out in the
motors, and a crash says little of what would have avoided it. The equations of motion
know. Here the actor follows the gradient of smooth crashes, breaches and speeds over
the limit through half seconds of free flight, from the hardest of many leaning starts
and from moments of its own flights (Xu et al. 2022, short-horizon actor-critic, without
the critic). All else is held to what it did.
"""

import dataclasses
import functools
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from openjax.learning.drawn_starts import draw_start
from openjax.learning.encounter import Encounter, no_encounter
from openjax.learning.gradient_stage import Turn, Updated
from openjax.learning.gradient_step import (
    END,
    FASTEST,
    LOWEST,
    clipped_descent,
    falling_rate,
    finite_or_zero,
    mean_step,
    weighted_sum,
)
from openjax.learning.settings import AnalyticSettings
from openjax.learning.smooth_measures import (
    FAST,
    breach_share,
    crash_depth,
    crash_share,
    evader_distance,
    free_share,
    hidden_share,
    nearest_distance,
    nearest_gap,
    speed,
    territory_share,
)
from openjax.policy import Policy, PolicyParameters
from openjax.pursuit import Pursuit, PursuitSettings, RewardSettings
from openjax.pursuit.axes import rotation_axes
from openjax.pursuit.shapes import Scalar
from openjax.pursuit.shortest_paths import shortest_paths
from openjax.pursuit.task import capture_radius
from openjax.vehicle.family import partly_nominal

Bounds = Float[Array, "worlds ranges 4"]
"""Of each world's vehicles; see `openjax.vehicle.family`."""

HORIZON = 0.5
"""Seconds that are learnt at once."""
CRASH_IN_FLIGHT = 4.0
BREACH_AT_START = 0.5
"""Weights beside the crashes from starts: an episode has one start, and many half
seconds after it.
"""
REST = 0.9
"""Share of the capture radius within which a pursuer needn't come nearer to the
evader.
"""


@dataclass(frozen=True)
class AnalyticGradient:
    """A policy's game in free flight, and what is learnt in it. `World`s are
    observations and states (B, ...).
    """

    settings: AnalyticSettings
    environment: Pursuit
    """See `free_flight`."""
    policy: Policy

    @property
    def game(self) -> PursuitSettings:
        """The environment's settings."""
        return self.environment.settings

    @property
    def steps(self) -> int:
        """Control steps that are learnt at once."""
        return max(1, round(HORIZON / self.game.time_step))

    @property
    def moments(self) -> int:
        """How often a flight is looked at: after each `HORIZON` but the episode's
        last.
        """
        # what is learnt from a moment takes another `HORIZON`, which has to end with
        # the episode
        return max(1, self.game.episode_length // self.steps - 1)

    def inputs(self, parameters: PolicyParameters, observation):
        """What the actor acts on: observations and predictions, without a gradient
        through the predictor.
        """
        return observation, jax.lax.stop_gradient(self.policy.predict(parameters, observation))

    def fly(
        self,
        actor: Any,
        parameters: PolicyParameters,
        world,
        steps: int,
        wish: Float[Array, "worlds 3"] | None = None,
    ) -> tuple[Any, "Encounter"]:
        """Worlds some steps later, and what their pursuers met in these; `wish` is
        where the evaders fly, see `mean_step`.
        """
        fly_on = mean_step(self.environment, self.policy, parameters)
        # found once: pillars stand still
        paths = jax.vmap(functools.partial(shortest_paths, self.game))(world[1].task)

        # only the worlds between steps are kept, the rest is worked out again on the
        # way back: it would take many times the memory
        @jax.checkpoint
        def move(world):
            observation, state = world
            return fly_on(actor, observation, state, wish)

        def one(carry, _):
            world = move(carry[0])
            encounter = self._measure(carry[1], world[1], paths, steps)
            return (world, encounter), None

        nothing = no_encounter(world[1].drones.position.shape[:2])
        return jax.lax.scan(one, (world, nothing), None, length=steps)[0]

    def _measure(self, encounter, state, paths, steps):
        """What pursuers have met so far, with what the step that ended with `state`
        adds.
        """
        limit = self.settings.speed_from * self.game.max_speed
        radius = capture_radius(self.game, state.task)
        rest = REST * radius
        if jnp.ndim(rest):  # of each world, beside its pursuers' distances
            rest = rest[:, None]
        distance = evader_distance(self.game, state, paths)
        beyond_rest = jax.nn.relu(distance - rest)
        return Encounter(
            least=jnp.minimum(encounter.least, nearest_gap(self.game, state)),
            upright=jnp.minimum(
                encounter.upright, rotation_axes(state.drones.quaternion)[1][..., 2]
            ),
            breach=encounter.breach + breach_share(self.game, state) / steps,
            excess=encounter.excess + jax.nn.relu(speed(state.drones) - limit) / FAST / steps,
            distance=encounter.distance + nearest_distance(beyond_rest) / steps,
            free=encounter.free + free_share(radius, distance) / steps,
            territory=encounter.territory + territory_share(self.game, state, paths) / steps,
            unseen=encounter.unseen + hidden_share(self.game, state) / steps,
        )

    def starts(self, key: PRNGKeyArray, bounds: Bounds):
        """Worlds to learn from, at their starts; bounds (B, R, 4)."""

        def one(task_key, key, bounds):
            return self.environment.with_bounds(bounds).reset_to(
                key, draw_start(self.game, task_key)
            )

        task_key, reset_key = jax.random.split(key)
        number = bounds.shape[0]
        return jax.vmap(one)(
            jax.random.split(task_key, number), jax.random.split(reset_key, number), bounds
        )

    def flights(self, parameters: PolicyParameters, key: PRNGKeyArray, bounds: Bounds):
        """Worlds (`moments` * B, ...) along the policy's flights."""

        def segment(world, _):
            world = self.fly(parameters.actor, parameters, world, self.steps)[0]
            return world, world

        worlds = jax.lax.scan(segment, self.starts(key, bounds), None, length=self.moments)[1]
        return jax.tree.map(lambda leaf: jax.lax.collapse(leaf, 0, 2), worlds)

    def hard_starts(self, actor: Any, parameters: PolicyParameters, key: PRNGKeyArray):
        """Of `settings.draws` times as many starts those with the least gaps on the
        actor's way: few of all come near a crash.
        """
        starts = self.starts(key, jnp.concatenate([self.bounds()] * self.settings.draws))
        least = jnp.min(self.fly(actor, parameters, starts, self.steps)[1].least, axis=-1)
        hardest = jax.lax.top_k(-least, self.settings.worlds)[1]
        return jax.tree.map(lambda leaf: leaf[hardest], starts)

    def loss(
        self, actor: Any, parameters: PolicyParameters, starts, flying
    ) -> tuple[Scalar, dict[str, Scalar]]:
        """What is learnt (), and its parts. `parameters` are the policy's before."""
        settings = self.settings
        number = starts[1].step.shape[0]
        observation, prediction = self.inputs(parameters, flying[0])
        start_mean, log_std = self.policy.distribution(parameters.actor, observation, prediction)
        mean, _ = self.policy.distribution(actor, observation, prediction)
        change = (mean - start_mean) * jnp.exp(-log_std)
        # starts and flights by one program, the starts first
        worlds = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), starts, flying)
        (_, end), encounter = self.fly(actor, parameters, worlds, self.steps)
        drones = jax.tree.map(lambda leaf: leaf[:number], end.drones)
        fast = speed(drones) - FASTEST
        low = LOWEST - drones.position[..., 2]
        parts = {
            "crashes_from_starts": (1.0, crash_depth(encounter.least[:number])),
            "breaches_from_starts": (BREACH_AT_START, encounter.breach[:number]),
            # a dive saves some of those that start tilted towards something, so there
            # the speed is free but for its end
            "ends": (END, jax.nn.relu(fast) + jax.nn.relu(low)),
            "crashes_in_flight": (CRASH_IN_FLIGHT, crash_share(encounter.least[number:])),
            "breaches_in_flight": (settings.breach, encounter.breach[number:]),
            "speed_in_flight": (settings.speed, encounter.excess[number:]),
            "change": (settings.hold, jnp.sum(change**2, axis=-1)),
        }
        return weighted_sum(parts)

    def begin(self, parameters: PolicyParameters, key: PRNGKeyArray) -> Any:
        """What `update` carries on, before the first one: the optimiser's state."""
        del key
        return self.optimiser.init(parameters.actor)

    def record(self, parameters: PolicyParameters, key: PRNGKeyArray):
        """Worlds along the policy's flights, of which each update learns from some."""
        return self.flights(parameters, key, self.bounds())

    def gradient(self, actor: Any, parameters: PolicyParameters, flights, key: PRNGKeyArray):
        """The actor's gradient, and the loss's parts."""
        start_key, choice_key = jax.random.split(key)
        moments = flights[1].step.shape[0]
        moment_indices = jax.random.randint(choice_key, (self.settings.worlds,), 0, moments)
        flying = jax.tree.map(lambda leaf: leaf[moment_indices], flights)
        starts = self.hard_starts(actor, parameters, start_key)
        gradient, parts = jax.grad(self.loss, has_aux=True)(actor, parameters, starts, flying)
        return finite_or_zero(gradient), parts

    @property
    def programs(self):
        """An update is one program; see `GradientStage`."""
        return (self._update,)

    def _update(self, turn: Turn, _results: tuple) -> Updated:
        actor = turn.actor
        gradient, parts = self.gradient(actor, turn.parameters, turn.flights, turn.key)
        change, state = self.optimiser.update(gradient, turn.state)
        return optax.apply_updates(actor, change), state, parts

    def bounds(self) -> Bounds:
        """(B, R, 4) of each world's vehicles: the game's family, and a share of nominal
        ones.
        """
        return partly_nominal(self.game.vehicles, self.settings.worlds, self.settings.nominal)

    @functools.cached_property
    def optimiser(self) -> optax.GradientTransformation:
        """Adam with clipped gradients; its step size falls linearly to a twentieth."""
        return clipped_descent(falling_rate(self.settings.learning_rate, self.settings.updates))


def free_flight(environment: Pursuit) -> Pursuit:
    """`environment` as it is learnt in: nothing is solid while the gradient is taken, a
    crash is told by the gap.
    """
    free = dataclasses.replace(
        environment.settings, physics="rigid", contacts=False, reward=RewardSettings()
    )
    by_default = {"vehicle_bounds": None, "evader_share": None, "dynamics": None}
    return dataclasses.replace(environment, settings=free, **by_default)
