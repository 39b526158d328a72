"""Adapting a policy to one diagnosed vehicle by the gradient through the simulation:
the programs, which are compiled before the diagnosis is known.
`openjax.learning.fine_tuning` runs them.

Two things are learnt at once, from flights of half a second. From drawn starts, leaning
and close to things: to touch nothing. From moments of the policy's flights with the
nominal vehicle: to fly the diagnosed vehicle, settled in flight, where and as fast as
the policy flew the nominal one. The simulator's derivative says in one update what
MAPPO has to find by trying.
"""

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

import openjax.baselines  # noqa: F401  registers its policies
from openjax.learning.adapting_game import adapting_game
from openjax.learning.drawn_starts import draw_start
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
from openjax.learning.nominal_flights import LAG, STEPS, Flights, NominalFlights
from openjax.learning.settings import AdaptSettings, TrainSettings
from openjax.learning.smooth_measures import breach_share, crash_share, nearest_gap
from openjax.learning.train_state import TrainState
from openjax.policy import Policy, PolicyParameters, make_policy
from openjax.pursuit import Pursuit, PursuitSettings
from openjax.vehicle import Vehicle, load_vehicle

NEAR_POSITION = 0.02
"""Distance (m) from the nominal vehicle's flight that counts as one ..."""
NEAR_VELOCITY = 0.1
"""... and so does this difference in velocity (m/s)."""


@dataclass(frozen=True)
class Adaptation:
    """The programs, not compiled yet; vehicles' bounds (R, 4) are an argument."""

    settings: AdaptSettings
    game: PursuitSettings
    policy: Policy
    optimiser: optax.GradientTransformation
    fly: Callable[[PolicyParameters, jax.Array, jax.Array], Flights]
    """(parameters, key, bounds) -> moments of flights."""
    update: Callable[..., tuple[TrainState, dict[str, jax.Array]]]
    """(actor, parameters, flights, key, bounds) -> actor, metrics; the actor with its
    optimiser's state, the parameters are the policy's before.
    """


def make_adaptation(training: TrainSettings, settings: AdaptSettings) -> Adaptation:
    """The programs for a policy that was trained with `training`."""
    game = adapting_game(training.environment)
    policy = make_policy(Pursuit(game), training.network, training.predictor)
    optimiser = clipped_descent(falling_rate(settings.learning_rate, settings.updates))
    # nothing is solid while the gradient is taken: a crash is told by the gap
    free = dataclasses.replace(game, physics="rigid", contacts=False)
    vehicle = load_vehicle(training.environment.airframe)
    worlds = settings.worlds or (8 if jax.default_backend() == "cpu" else 320)
    flights = NominalFlights(free, vehicle, policy, 4 * worlds)
    stage = _Stage(settings, free, vehicle, policy, optimiser, worlds)
    return Adaptation(
        settings,
        game,
        policy,
        optimiser,
        fly=jax.jit(flights.fly),
        update=jax.jit(stage.update),
    )


@dataclass(frozen=True)
class _Stage:
    """What the programs have in common."""

    settings: AdaptSettings
    free: PursuitSettings
    """The game in which is learnt."""
    vehicle: Vehicle
    policy: Policy
    optimiser: optax.GradientTransformation
    worlds: int
    """Of each kind of flight in an update."""

    def pursuit(self, bounds):
        """The game that is learnt in, with vehicles of the bounds."""
        return Pursuit(self.free, self.vehicle, vehicle_bounds=bounds)

    def _begin(self, flights, key, bounds):
        """Half of the worlds at starts, half in flight, all with vehicles of the
        bounds; and the flights to follow.
        """
        pursuit = self.pursuit(bounds)
        worlds = self.worlds
        task_key, reset_key, moment_key = jax.random.split(key, 3)
        task_keys = jax.random.split(task_key, worlds)
        tasks = jax.vmap(lambda key: draw_start(self.free, key))(task_keys)
        _, starts = jax.vmap(pursuit.reset_to)(jax.random.split(reset_key, worlds), tasks)
        start_indices = jax.random.choice(
            moment_key, flights.position.shape[1], (worlds,), replace=False
        )
        moments = jax.tree.map(lambda leaf: leaf[start_indices], flights.state)
        state = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), starts, moments)
        return (
            pursuit,
            state,
            flights.position[:, start_indices],
            flights.velocity[:, start_indices],
        )

    def loss(self, actor, parameters, flights, key, bounds):
        """() what is learnt, and its parts."""
        free = self.free
        worlds = self.worlds
        pursuit, state, position, velocity = self._begin(flights, key, bounds)
        # worked out again on the way back, which takes a fraction of the memory
        fly_on = jax.checkpoint(mean_step(pursuit, self.policy, parameters))

        def one(carry, _):
            observation, state, least, breach = carry
            observation, state = fly_on(actor, observation, state)
            least = jnp.minimum(least, nearest_gap(free, state))
            breach = breach + breach_share(free, state) / STEPS
            track = (state.drones.position, state.drones.velocity)
            return (observation, state, least, breach), track

        team = state.drones.position.shape[:2]  # worlds, pursuers
        observation = jax.vmap(pursuit.observe)(state)
        first = (observation, state, jnp.full(team, jnp.inf), jnp.zeros(team))
        (_, end, least, breach), (path, speed) = jax.lax.scan(one, first, None, length=STEPS)
        crash = jnp.mean(crash_share(least), axis=-1)
        # only at the end: a dive saves some starts. Flights follow the nominal
        # vehicle's speeds
        fast = jnp.sqrt(jnp.sum(end.drones.velocity[:worlds] ** 2, axis=-1) + 1e-9) - FASTEST
        low = LOWEST - end.drones.position[:worlds, :, 2]
        off = off_the_flight(path[:, worlds:], speed[:, worlds:], position, velocity)
        parts = {
            "crashes_from_starts": (1.0, crash[:worlds]),
            "crashes_in_flight": (1.0, crash[worlds:]),
            "breaches": (1.0, breach),
            "ends": (END, jnp.mean(jax.nn.relu(fast)) + jnp.mean(jax.nn.relu(low))),
            "off_the_nominal_flight": (self.settings.follow, off),
        }
        return weighted_sum(parts)

    def update(self, actor, parameters, flights, key, bounds):
        """The actor (a `TrainState`) after a step, and the parts of the loss."""
        gradient, watch = jax.grad(self.loss, has_aux=True)(
            actor.parameters, parameters, flights, key, bounds
        )
        return actor.update(self.optimiser, finite_or_zero(gradient)), watch


def off_the_flight(
    position: Float[Array, "steps worlds pursuers 3"],
    velocity: Float[Array, "steps worlds pursuers 3"],
    target: Float[Array, "all worlds pursuers 3"],
    target_velocity: Float[Array, "all worlds pursuers 3"],
) -> Float[Array, "steps worlds pursuers"]:
    """(T, W, N) how far flights (T, W, N, 3) are from those that are wanted (LAG + T,
    W, N, 3), at the lag that suits best.

    In multiples of `NEAR_POSITION` and `NEAR_VELOCITY`, less one where it is large and
    half the square where it is small.
    """

    def at(lag):
        part = slice(LAG - lag, LAG - lag + position.shape[0])
        off = jnp.sum(((position - target[part]) / NEAR_POSITION) ** 2, axis=-1)
        off = off + jnp.sum(((velocity - target_velocity[part]) / NEAR_VELOCITY) ** 2, axis=-1)
        return jnp.sqrt(1.0 + off) - 1.0

    # every other lag: between them a flight moves less than `NEAR_POSITION`
    return functools.reduce(jnp.minimum, [at(lag) for lag in range(0, LAG + 1, 2)])
