"""The last lesson of a policy that is to be flown: what is decided within tenths of a
second (analytic policy gradient).

MAPPO is a poor teacher of that. Starts lean by up to 36 degrees, some beside a pillar or
another pursuer; its noise averages out in the motors, and a crash says little of what
would have avoided it. The equations of motion know. Here the actor follows the gradient
of smooth crashes, breaches and speeds over the limit through half seconds of free
flight, from the hardest of many leaning starts and from moments of its own flights (Xu
et al. 2022, short-horizon actor-critic, without the critic). All else is held to what it
did.
"""

import functools
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from openjax.learning.drawn_starts import draw_start
from openjax.learning.gradient.measures import (
    SmoothFlight,
    crash_depth,
    crash_share,
    end_excess,
    team_weight,
)
from openjax.learning.gradient.stage import (
    Learnt,
    Turn,
    clipped_descent,
    falling_rate,
    weighted_sum,
)
from openjax.learning.settings import AnalyticSettings
from openjax.policy import PolicyParameters
from openjax.pursuit.shapes import Scalar
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
END = 0.2
"""Weight of a start's end that is low or fast, beside the share of pursuers that touch
something.
"""


@dataclass(frozen=True)
class LastFlights:
    """A lesson of starts and moments of flights. `World`s are observations and states
    (B, ...).
    """

    settings: AnalyticSettings
    flight: SmoothFlight

    @property
    def updates(self) -> int:
        """Of the actor."""
        return self.settings.updates

    @property
    def steps(self) -> int:
        """Control steps that are learnt at once."""
        return max(1, round(HORIZON / self.flight.game.time_step))

    @property
    def moments(self) -> int:
        """Number of times a flight is looked at: after each `HORIZON` but the episode's last."""
        # what is learnt from a moment takes another `HORIZON`, which has to end with
        # the episode
        return max(1, self.flight.game.episode_length // self.steps - 1)

    @functools.cached_property
    def optimiser(self) -> optax.GradientTransformation:
        """Adam with clipped gradients; its step size falls linearly to a twentieth."""
        return clipped_descent(falling_rate(self.settings.learning_rate, self.settings.updates))

    def bounds(self) -> Bounds:
        """(B, R, 4) of each world's vehicles: the game's family, and a share of nominal
        ones.
        """
        settings = self.settings
        return partly_nominal(self.flight.game.vehicles, settings.worlds, settings.NOMINAL)

    def starts(self, key: PRNGKeyArray, bounds: Bounds):
        """Worlds to learn from, at their starts; bounds (B, R, 4)."""
        environment = self.flight.environment

        def one(task_key, key, bounds):
            task = draw_start(self.flight.game, task_key)
            return environment.with_bounds(bounds).reset_to(key, task)

        task_key, reset_key = jax.random.split(key)
        number = bounds.shape[0]
        return jax.vmap(one)(
            jax.random.split(task_key, number), jax.random.split(reset_key, number), bounds
        )

    def record(self, parameters: PolicyParameters, key: PRNGKeyArray, late: None = None):
        """Worlds (`moments` * B, ...) along the policy's flights, of which each update
        learns from some.
        """

        def segment(world, _):
            world = self.flight.fly(parameters.actor, parameters, world, self.steps)[0]
            return world, world

        start = self.starts(key, self.bounds())
        worlds = jax.lax.scan(segment, start, None, length=self.moments)[1]
        return jax.tree.map(lambda leaf: jax.lax.collapse(leaf, 0, 2), worlds)

    def begin(self, key: PRNGKeyArray) -> tuple:
        """Nothing: all worlds are drawn in each update."""
        return ()

    def hard_starts(self, actor: Any, parameters: PolicyParameters, key: PRNGKeyArray):
        """Of `settings.DRAWS` times as many starts those with the least gaps on the
        actor's way: few of all come near a crash.
        """
        starts = self.starts(key, jnp.concatenate([self.bounds()] * self.settings.DRAWS))
        encounter = self.flight.fly(actor, parameters, starts, self.steps)[1]
        least = jnp.min(encounter.least, axis=-1)
        hardest = jax.lax.top_k(-least, self.settings.worlds)[1]
        return jax.tree.map(lambda leaf: leaf[hardest], starts)

    def loss(
        self, actor: Any, parameters: PolicyParameters, starts, flying
    ) -> tuple[Scalar, dict[str, Scalar]]:
        """The loss () and its parts. `parameters` are the policy's before."""
        settings = self.settings
        weight = functools.partial(team_weight, self.flight.game)
        number = starts[1].step.shape[0]
        change = self.flight.change(actor, parameters, flying[0])
        # starts and flights by one program, the starts first
        worlds = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), starts, flying)
        (_, end), encounter = self.flight.fly(actor, parameters, worlds, self.steps)
        ends = jax.tree.map(lambda leaf: leaf[:number], end.drones)
        parts = {
            "crashes_from_starts": (1.0, crash_depth(encounter.least[:number])),
            "breaches_from_starts": (BREACH_AT_START, encounter.breach[:number]),
            # a dive saves some of those that start tilted towards something, so there
            # the speed is free but for its end
            "ends": (END, end_excess(ends)),
            "crashes_in_flight": (CRASH_IN_FLIGHT, crash_share(encounter.least[number:])),
            "breaches_in_flight": (weight(settings.BREACH), encounter.breach[number:]),
            "speed_in_flight": (weight(settings.SPEED), encounter.excess[number:]),
            "change": (settings.hold, change),
        }
        return weighted_sum(parts)

    def gradient(self, actor: Any, parameters: PolicyParameters, flights, key: PRNGKeyArray):
        """The actor's gradient, and the loss's parts."""
        start_key, choice_key = jax.random.split(key)
        moments = flights[1].step.shape[0]
        moment_indices = jax.random.randint(choice_key, (self.settings.worlds,), 0, moments)
        flying = jax.tree.map(lambda leaf: leaf[moment_indices], flights)
        starts = self.hard_starts(actor, parameters, start_key)
        return jax.grad(self.loss, has_aux=True)(actor, parameters, starts, flying)

    @property
    def programs(self):
        """An update is one program; see `Lesson`."""
        return (self._learn,)

    def _learn(self, turn: Turn, _results: tuple) -> Learnt:
        gradient, parts = self.gradient(turn.actor, turn.parameters, turn.flights, turn.key)
        return Learnt(gradient, (), parts)
