"""The first stage of a run: to fly, and to go after the evader, by the gradient through
the simulation.

From scratch MAPPO spends half of its data on learning to fly. The equations of motion
teach that in seconds: how far the nearest pursuer is from the evader over the next
moments has a gradient, and so have near misses (`openjax.learning.analytic_gradient`).
What has none, waiting or cutting off, is left to MAPPO.
"""

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import PRNGKeyArray

from openjax.learning.analytic_gradient import AnalyticGradient, free_flight
from openjax.learning.collectives import mean_over_devices, own_share
from openjax.learning.drawn_starts import draw_anywhere, is_lost
from openjax.learning.gradient_step import (
    SLOWEST_RATE,
    clipped_descent,
    finite_or_zero,
    renew,
    weighted_sum,
)
from openjax.learning.settings import AnalyticSettings, FirstFlightsSettings, GeneratorSettings
from openjax.learning.smooth_measures import crash_share, tip_share
from openjax.policy import Policy, PolicyParameters
from openjax.pursuit import Pursuit
from openjax.pursuit.shapes import Scalar
from openjax.vehicle.family import narrowed_bounds

PHYSICS_STEP = 0.01
"""Seconds of a physics step: finer ones teach nothing more."""
LOW = 0.25
"""Height (m) below which the end of a moment costs: the gap to the floor is felt too
late.
"""


def first_game(environment: Pursuit, stage: FirstFlightsSettings) -> Pursuit:
    """`environment` as it is learnt in: in free flight, with control steps of its own
    and episodes as long.
    """
    free = free_flight(environment)
    game = free.settings
    ratio = max(1, round(stage.time_step / game.time_step))
    game = dataclasses.replace(
        game,
        time_step=ratio * game.time_step,
        substeps=max(1, round(ratio * game.time_step / PHYSICS_STEP)),
        episode_length=max(stage.steps, game.episode_length // ratio),
    )
    return dataclasses.replace(free, settings=game, dynamics=None)


@struct.dataclass
class FirstCarry:
    """What the stage is between two updates."""

    parameters: PolicyParameters
    optimiser: Any
    """The state of the actor's."""
    world: Any  # (B, ...)
    ramp: jax.Array
    """() how far the penalties have risen, 0 to 1"""


@dataclass(frozen=True)
class FirstFlights:
    """How a fresh actor learns to fly. `World`s are observations and states (B, ...), a
    device's share of them all.
    """

    settings: FirstFlightsSettings
    environment: Pursuit
    """See `first_game`."""
    policy: Policy
    tasks: GeneratorSettings = field(default_factory=GeneratorSettings)
    """How the generator's uniform tasks differ from the paper's; these do, too."""
    axis: str | None = None
    """Of the devices, where there are several."""

    @property
    def stage(self) -> AnalyticGradient:
        """What flies, and measures."""
        return AnalyticGradient(AnalyticSettings(), self.environment, self.policy)

    def start(self, key: PRNGKeyArray):
        """Worlds at the starts of uniform tasks and of scattered ones, their vehicles
        nominal.
        """
        game = self.environment.settings

        task_keys, reset_keys = (
            own_share(jax.random.split(k, self.settings.worlds), self.axis)
            for k in jax.random.split(key)
        )
        tasks = jax.vmap(functools.partial(draw_anywhere, game, self.tasks))(task_keys)
        environment = self.environment
        if game.vehicles:
            environment = environment.with_bounds(narrowed_bounds(game.vehicles, 0.0))
        return jax.vmap(environment.reset_to)(reset_keys, tasks)

    def loss(self, actor: Any, parameters: PolicyParameters, world, ramp: Scalar):
        """What is learnt (); worlds after it and its parts. `ramp` () is how far the
        penalties have risen, 0 to 1.
        """
        settings = self.settings
        is_fast_possible = self.environment.settings.speed_limit == "none"
        end, encounter = self.stage.fly(actor, parameters, world, settings.steps)
        # with whole penalties from the start, pursuers stay away from the evader for
        # good
        penalty = settings.penalty_start + (1.0 - settings.penalty_start) * ramp
        parts = {
            "free": (1.0, encounter.free),
            # along the shortest path: by the straight line they wait in sight of the
            # evader, on the wrong side of a row of pillars
            "distance": (settings.distance, encounter.distance),
            # felt from farther than a touch, or they never leave such a place either:
            # over 5 cm they go round rows and hardly crash, over 1 cm they do neither
            "crashes": (
                penalty * settings.crash,
                crash_share(encounter.least, settings.crash_smooth),
            ),
            "tips": (ramp * settings.crash, tip_share(encounter.upright)),
            "breaches": (penalty * settings.breach, encounter.breach),
            "speed": (settings.speed * is_fast_possible, encounter.excess),
            "low": (1.0, jax.nn.relu(LOW - end[1].drones.position[..., 2])),
        }
        total, means = weighted_sum(parts)
        return total, (end, means)

    def update(self, carry: FirstCarry, key: PRNGKeyArray) -> tuple[FirstCarry, dict[str, Scalar]]:
        """The carry after an update, and the parts of the loss."""
        parameters = carry.parameters
        world = carry.world
        ramp = carry.ramp
        gradient, (end, parts) = jax.grad(self.loss, has_aux=True)(
            parameters.actor, parameters, world, ramp
        )
        gradient, parts = mean_over_devices((gradient, parts), self.axis)
        # penalties wait for pursuers that catch: who fears a crash before that never
        # comes near
        step = 1.0 / (self.settings.penalty_ramp * max(self.settings.updates, 1))
        ramp = jnp.minimum(
            ramp + jnp.where(parts["free"] < self.settings.penalty_free, step, 0.0), 1.0
        )
        change, state = self.optimiser.update(finite_or_zero(gradient), carry.optimiser)
        parameters = parameters.replace(actor=optax.apply_updates(parameters.actor, change))
        start_key, choice_key = jax.random.split(key)
        worlds_drawn = jax.random.uniform(choice_key, (self.settings.worlds,)) < self.settings.anew
        over = self._over(end[1]) | own_share(worlds_drawn, self.axis)
        world = renew(over, end, self.start(start_key))
        return FirstCarry(parameters, state, world, ramp), parts

    def _over(self, state):
        """(B,) worlds that end: crashed, far outside, or too late for another
        moment.
        """
        game = self.environment.settings
        is_late = state.step > game.episode_length - self.settings.steps
        return is_lost(game, state) | is_late

    @functools.cached_property
    def optimiser(self) -> optax.GradientTransformation:
        """Adam with clipped gradients; its step size falls to a twentieth."""
        schedule = optax.cosine_decay_schedule(
            self.settings.learning_rate, max(self.settings.updates, 1), SLOWEST_RATE
        )
        return clipped_descent(schedule)

    def begin(self, parameters: PolicyParameters, key: PRNGKeyArray) -> FirstCarry:
        """The carry of `update` before the first one."""
        return FirstCarry(
            parameters, self.optimiser.init(parameters.actor), self.start(key), jnp.zeros(())
        )


def make_first_flights(flights: FirstFlights, together: int) -> Callable:
    """`together` updates as one function (carry, key, updates done) -> carry, mean
    parts of the loss; to be compiled.
    """

    def some(carry, key, updates_done):
        keys = jax.vmap(lambda i: jax.random.fold_in(key, i))(updates_done + jnp.arange(together))
        carry, parts = jax.lax.scan(flights.update, carry, keys)
        return carry, jax.tree.map(jnp.mean, parts)

    return some
