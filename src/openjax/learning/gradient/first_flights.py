"""The first lesson of a run: to fly, and to go after the evader, by the gradient through
the simulation.

From scratch MAPPO spends half of its data on learning to fly. The equations of motion
teach that in seconds: how far the nearest pursuer is from the evader over the next
moments has a gradient, and so have near misses (`last_flights`).
What has none, waiting or cutting off, is left to MAPPO.
"""

import dataclasses
import functools
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import PRNGKeyArray

from openjax.learning.collectives import mean_over_devices, own_share
from openjax.learning.drawn_starts import draw_anywhere, is_lost
from openjax.learning.gradient.measures import SmoothFlight, crash_share, free_flight, tip_share
from openjax.learning.gradient.stage import (
    SLOWEST_RATE,
    Learnt,
    Turn,
    clipped_descent,
    weighted_sum,
)
from openjax.learning.settings import FirstFlightsSettings, GeneratorSettings
from openjax.policy import PolicyParameters
from openjax.pursuit import Pursuit
from openjax.pursuit.rows import where_rows
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
    ratio = max(1, round(stage.TIME_STEP / game.time_step))
    game = dataclasses.replace(
        game,
        time_step=ratio * game.time_step,
        substeps=max(1, round(ratio * game.time_step / PHYSICS_STEP)),
        episode_length=max(stage.STEPS, game.episode_length // ratio),
    )
    return dataclasses.replace(free, settings=game, dynamics=None)


@struct.dataclass
class FirstWorlds:
    """The lesson's state between two updates."""

    world: Any  # (B, ...)
    ramp: jax.Array
    """() how far the penalties have risen, 0 to 1"""


@dataclass(frozen=True)
class FirstFlights:
    """The stage in which a fresh actor learns to fly. `World`s are observations and states (B,
    ...), a device's share of them all.
    """

    settings: FirstFlightsSettings
    flight: SmoothFlight
    """In the `first_game`."""
    tasks: GeneratorSettings = field(default_factory=GeneratorSettings)
    """The generator's differences from the paper's uniform tasks; these have them, too."""
    axis: str | None = None
    """Of the devices, where there are several."""

    @property
    def updates(self) -> int:
        """Of the actor."""
        return self.settings.updates

    @functools.cached_property
    def optimiser(self) -> optax.GradientTransformation:
        """Adam with clipped gradients; its step size falls to a twentieth."""
        schedule = optax.cosine_decay_schedule(
            self.settings.LEARNING_RATE, max(self.settings.updates, 1), SLOWEST_RATE
        )
        return clipped_descent(schedule)

    def record(self, parameters: PolicyParameters, key: PRNGKeyArray, late: None = None) -> None:
        """Nothing: a fresh policy has no flights to learn from."""

    def begin(self, key: PRNGKeyArray) -> FirstWorlds:
        """Worlds at their starts, no penalties yet."""
        return FirstWorlds(self.start(key), jnp.zeros(()))

    def start(self, key: PRNGKeyArray):
        """Worlds at the starts of uniform tasks and of scattered ones, their vehicles
        nominal.
        """
        environment = self.flight.environment
        game = environment.settings
        task_keys, reset_keys = (
            own_share(jax.random.split(k, self.settings.WORLDS), self.axis)
            for k in jax.random.split(key)
        )
        tasks = jax.vmap(functools.partial(draw_anywhere, game, self.tasks))(task_keys)
        if game.vehicles:
            environment = environment.with_bounds(narrowed_bounds(game.vehicles, 0.0))
        return jax.vmap(environment.reset_to)(reset_keys, tasks)

    def loss(self, actor: Any, parameters: PolicyParameters, world, ramp: Scalar):
        """The loss (), the worlds after it, and its parts. `ramp` () is how far the penalties have
        risen, 0 to 1.
        """
        settings = self.settings
        is_fast_possible = self.flight.game.speed_limit == "none"
        end, encounter = self.flight.fly(actor, parameters, world, settings.STEPS)
        # with whole penalties from the start, pursuers stay away from the evader for
        # good
        penalty = settings.PENALTY_START + (1.0 - settings.PENALTY_START) * ramp
        parts = {
            "free": (1.0, encounter.free),
            # along the shortest path: by the straight line they wait in sight of the
            # evader, on the wrong side of a row of pillars
            "distance": (settings.DISTANCE, encounter.distance),
            # felt from farther than a touch, or they never leave such a place either:
            # over 5 cm they go round rows and hardly crash, over 1 cm they do neither
            "crashes": (
                penalty * settings.CRASH,
                crash_share(encounter.least, settings.CRASH_SMOOTH),
            ),
            "tips": (ramp * settings.CRASH, tip_share(encounter.upright)),
            "breaches": (penalty * settings.BREACH, encounter.breach),
            "speed": (settings.SPEED * is_fast_possible, encounter.excess),
            "low": (1.0, jax.nn.relu(LOW - end[1].drones.position[..., 2])),
        }
        total, means = weighted_sum(parts)
        return total, (end, means)

    @property
    def programs(self):
        """An update is one program; see `Lesson`."""
        return (self._learn,)

    def _learn(self, turn: Turn, _results: tuple) -> Learnt:
        world = turn.carry.lesson.world
        ramp = turn.carry.lesson.ramp
        gradient, (end, parts) = jax.grad(self.loss, has_aux=True)(
            turn.actor, turn.parameters, world, ramp
        )
        gradient, parts = mean_over_devices((gradient, parts), self.axis)
        # penalties wait for pursuers that catch: who fears a crash before that never
        # comes near
        step = 1.0 / (self.settings.PENALTY_RAMP * max(self.settings.updates, 1))
        ramp = jnp.minimum(
            ramp + jnp.where(parts["free"] < self.settings.PENALTY_FREE, step, 0.0), 1.0
        )
        start_key, choice_key = jax.random.split(turn.key)
        worlds_drawn = jax.random.uniform(choice_key, (self.settings.WORLDS,)) < self.settings.ANEW
        over = self._over(end[1]) | own_share(worlds_drawn, self.axis)
        world = where_rows(over, self.start(start_key), end)
        return Learnt(gradient, FirstWorlds(world, ramp), parts)

    def _over(self, state):
        """(B,) worlds that end: crashed, far outside, or too late for another
        moment.
        """
        game = self.flight.game
        is_late = state.step > game.episode_length - self.settings.STEPS
        return is_lost(game, state) | is_late
