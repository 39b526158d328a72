"""Moments of a policy's flights with the nominal vehicle, in which another vehicle flies
on, and how the nominal one did.
"""

import functools
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from flax import struct

from openjax.learning.adapting_game import bounds_of
from openjax.learning.gradient_step import mean_step
from openjax.policy import Policy
from openjax.pursuit import Pursuit, PursuitSettings, PursuitState, turn_task, uniform_task
from openjax.vehicle import Vehicle
from openjax.vehicle.family import draw_vehicles, known_effects

STEPS = 50
"""Control steps of the flights that are learnt from."""
FLIGHT = 400
"""Control steps of the flights with the nominal vehicle that these begin in."""
SETTLE = 40
"""Control steps that the diagnosed vehicle flies up to such a moment, so that its
controllers, rotors and the policy's memories are those of that vehicle, and not of one
that has just been changed in flight.
"""
LAG = 6
"""Control steps by which the diagnosed vehicle may follow late: one that hears late
can't help it, and would learn to overdo what it does if it were to catch up.
"""


@struct.dataclass
class Flights:
    """Moments of flights with the nominal vehicle, and how that flew on from each."""

    state: PursuitState
    """(W, ...) where the nominal vehicle was; with vehicles of the bounds that are
    adapted to
    """
    position: jax.Array
    """(LAG + T, W, N, 3) m, after the LAG steps before the moment and the steps that
    followed
    """
    velocity: jax.Array
    """(LAG + T, W, N, 3) m/s"""


@dataclass(frozen=True)
class NominalFlights:
    """What they are flown with."""

    game: PursuitSettings
    vehicle: Vehicle
    policy: Policy
    number: int
    """Of flights; more than an update takes, so that updates differ."""

    def _pursuit(self, bounds):
        """The game with vehicles of the bounds."""
        return Pursuit(self.game, self.vehicle, vehicle_bounds=bounds)

    def fly(self, parameters, key, bounds) -> Flights:
        """Moments of flights with the nominal vehicle, in which vehicles of the bounds
        fly on.
        """
        nominal = self._pursuit(bounds_of({}, {}, rest=0.0))
        number = self.number
        task_key, reset_key, moment_key, vehicle_key = jax.random.split(key, 4)
        tasks = jax.vmap(lambda key: _task(self.game, key))(jax.random.split(task_key, number))
        _, start = jax.vmap(nominal.reset_to)(jax.random.split(reset_key, number), tasks)
        moment = jax.random.randint(moment_key, (number,), SETTLE, FLIGHT - STEPS)
        fly_on = mean_step(nominal, self.policy, parameters)

        # the nominal vehicle's flights: their states at each world's moment and SETTLE
        # steps before it, and the tracks
        def one(carry, step):
            observation, state, at_settling, at_moment = carry
            at_settling = _record(moment - SETTLE == step, state, at_settling)
            at_moment = _record(moment == step, state, at_moment)
            observation, state = fly_on(parameters.actor, observation, state)
            track = (state.drones.position, state.drones.velocity)
            return (observation, state, at_settling, at_moment), track

        first = (jax.vmap(nominal.observe)(start), start, start, start)
        (_, _, at_settling, at_moment), tracks = jax.lax.scan(one, first, jnp.arange(FLIGHT))
        steps = moment + jnp.arange(-LAG, STEPS)[:, None]
        position, velocity = (track[steps, jnp.arange(number)] for track in tracks)
        state_of_vehicle = self._settle(parameters, at_settling, vehicle_key, bounds)
        return Flights(_in_its_place(state_of_vehicle, at_moment), position, velocity)

    def _settle(self, parameters, state, key, bounds):
        """States (W, ...) SETTLE steps later, flown by vehicles of the bounds."""
        number = state.step.shape[0]
        draw = functools.partial(draw_vehicles, self.game.vehicles)
        vehicles = jax.vmap(lambda key: draw(key, self.game.num_pursuers, 0.0, bounds))(
            jax.random.split(key, number)
        )
        environment = self._pursuit(bounds)
        fly_on = mean_step(environment, self.policy, parameters)

        def one(carry, _):
            observation, state = carry
            return fly_on(parameters.actor, observation, state), None

        state = state.replace(vehicles=vehicles)
        start = (jax.vmap(environment.observe)(state), state)
        (_, last_state), _ = jax.lax.scan(one, start, None, length=SETTLE)
        return last_state


def _record(is_due, state, record):
    """The states (W, ...) in `record`, with those of worlds that are due (W,) in place
    of older ones.
    """

    def newest(is_due, state, record):
        return jax.tree.map(lambda new, old: jnp.where(is_due, new, old), state, record)

    return jax.vmap(newest)(is_due, state, record)


def _in_its_place(flight: PursuitState, nominal: PursuitState) -> PursuitState:
    """States `nominal` whose vehicles, as one would find them in flight, are those of
    `flight`.

    Where they are and how they move, and what their sensors still show of that, is from
    `nominal`; rotors, controllers, commands on the way, effects, and what the policy
    remembers of the vehicle from `flight`.
    """
    kinematic = ("position", "quaternion", "velocity", "body_rates", "previous_body_rates")
    sensors = {name for name, effect in known_effects().items() if effect.sensor is not None}
    memory = {
        name: nominal.drones.effect_memory[name] if name in sensors else memory
        for name, memory in flight.drones.effect_memory.items()
    }
    drones = flight.drones.replace(
        **{name: getattr(nominal.drones, name) for name in kinematic}, effect_memory=memory
    )
    return nominal.replace(
        vehicles=flight.vehicles,
        drones=drones,
        own_history=flight.own_history,
        previous_action=flight.previous_action,
    )


def _task(game, key):
    """A uniform task, turned about the arena's axis."""
    task_key, turn_key = jax.random.split(key)
    return turn_task(turn_key, uniform_task(game, task_key))
