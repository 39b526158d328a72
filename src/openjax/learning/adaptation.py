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
from flax import struct
from jaxtyping import Array, Float

import openjax.baselines  # noqa: F401  registers its policies
from openjax.evaluation.episodes import Evaluation, make_evaluate
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
from openjax.learning.settings import AdaptSettings, TrainSettings
from openjax.learning.smooth_measures import breach_share, crash_share, nearest_gap
from openjax.learning.train_state import TrainState
from openjax.policy import Policy, PolicyParameters, make_policy
from openjax.policy.growth import with_longer_history
from openjax.pursuit import (
    Pursuit,
    PursuitSettings,
    PursuitState,
    RewardSettings,
    Task,
    turn_task,
    uniform_task,
)
from openjax.vehicle import Vehicle, load_vehicle
from openjax.vehicle.family import (
    REST,
    adapted_family,
    draw_vehicles,
    family_bounds,
    known_effects,
)
from openjax.vehicle.parameters import NOMINAL

RATE_LOOP = 0.002
"""Period of a Crazyflie's rate loop (s)."""
HISTORY = 12
"""Frames of its own flight that an adapted policy sees at least: with late commands and
slow motors one isn't enough.
"""
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
NEAR_POSITION = 0.02
"""Distance (m) from the nominal vehicle's flight that counts as one ..."""
NEAR_VELOCITY = 0.1
"""... and so does this difference in velocity (m/s)."""


def adapting_game(game: PursuitSettings) -> PursuitSettings:
    """The game as vehicles fly it, whatever a policy was trained in: no clamp, the rate
    loop at 500 Hz, solid pillars.
    """
    return dataclasses.replace(
        game,
        vehicles=adapted_family({}, {}, airframe=game.airframe),
        rare_vehicles=0.0,
        observe_history=max(game.observe_history, HISTORY),
        speed_limit="none",
        physics="stops",
        substeps=max(game.substeps, round(game.time_step / RATE_LOOP)),
        start_attitude="drawn",
        reward=RewardSettings(),
    )


def starting_parameters(
    parameters: PolicyParameters, settings: TrainSettings
) -> PolicyParameters:
    """A policy as it begins in `adapting_game`, without its critic; it acts as
    before.
    """
    game = settings.environment

    def longer(one):
        return with_longer_history(one, settings.predictor, game, adapting_game(game))

    start = parameters.replace(critic={})
    # the members of a team that draws stand side by side
    start = longer(start) if game.strategies == 1 else jax.vmap(longer)(start)
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), start)


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
    evaluate: Callable[[PolicyParameters, Task, jax.Array, jax.Array], Evaluation]
    """(parameters, tasks, key, bounds) -> one episode per task."""


def make_adaptation(training: TrainSettings, settings: AdaptSettings) -> Adaptation:
    """The programs for a policy that was trained with `training`."""
    game = adapting_game(training.environment)
    policy = make_policy(Pursuit(game), training.network, training.predictor)
    optimiser = clipped_descent(falling_rate(settings.learning_rate, settings.updates))
    stage = _Stage(
        settings=settings,
        game=game,
        # nothing is solid while the gradient is taken: a crash is told by the gap
        free=dataclasses.replace(game, physics="rigid", contacts=False),
        vehicle=load_vehicle(training.environment.airframe),
        policy=policy,
        optimiser=optimiser,
        worlds=settings.worlds or (8 if jax.default_backend() == "cpu" else 320),
    )
    fly = jax.jit(stage.fly)
    update = jax.jit(stage.update)
    return Adaptation(
        settings, game, policy, optimiser, fly, update, jax.jit(stage.evaluate)
    )


@dataclass(frozen=True)
class _Stage:
    """What the programs have in common."""

    settings: AdaptSettings
    game: PursuitSettings
    free: PursuitSettings
    """The game in which is learnt."""
    vehicle: Vehicle
    policy: Policy
    optimiser: optax.GradientTransformation
    worlds: int
    """Of each kind of flight in an update."""

    def pursuit(self, bounds, game=None):
        """The game that is learnt in, or another one, with vehicles of the bounds."""
        return Pursuit(game or self.free, self.vehicle, vehicle_bounds=bounds)

    def fly(self, parameters, key, bounds):
        """Moments of flights with the nominal vehicle, in which vehicles of the bounds
        fly on.
        """
        nominal = self.pursuit(bounds_of({}, {}, rest=0.0))
        # more than an update takes, so that these differ
        number = 4 * self.worlds
        task_key, reset_key, moment_key, vehicle_key = jax.random.split(key, 4)
        tasks = jax.vmap(lambda key: _task(self.free, key))(
            jax.random.split(task_key, number)
        )
        _, start = jax.vmap(nominal.reset_to)(
            jax.random.split(reset_key, number), tasks
        )
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
        (_, _, at_settling, at_moment), tracks = jax.lax.scan(
            one, first, jnp.arange(FLIGHT)
        )
        steps = moment + jnp.arange(-LAG, STEPS)[:, None]
        position, velocity = (track[steps, jnp.arange(number)] for track in tracks)
        state_of_vehicle = self._settle(parameters, at_settling, vehicle_key, bounds)
        return Flights(_in_its_place(state_of_vehicle, at_moment), position, velocity)

    def _settle(self, parameters, state, key, bounds):
        """States (W, ...) SETTLE steps later, flown by vehicles of the bounds."""
        number = state.step.shape[0]
        draw = functools.partial(draw_vehicles, self.free.vehicles)
        vehicles = jax.vmap(lambda key: draw(key, self.free.num_pursuers, 0.0, bounds))(
            jax.random.split(key, number)
        )
        environment = self.pursuit(bounds)
        fly_on = mean_step(environment, self.policy, parameters)

        def one(carry, _):
            observation, state = carry
            return fly_on(parameters.actor, observation, state), None

        state = state.replace(vehicles=vehicles)
        start = (jax.vmap(environment.observe)(state), state)
        (_, last_state), _ = jax.lax.scan(one, start, None, length=SETTLE)
        return last_state

    def _begin(self, flights, key, bounds):
        """Half of the worlds at starts, half in flight, all with vehicles of the
        bounds; and the flights to follow.
        """
        pursuit = self.pursuit(bounds)
        worlds = self.worlds
        task_key, reset_key, moment_key = jax.random.split(key, 3)
        task_keys = jax.random.split(task_key, worlds)
        tasks = jax.vmap(lambda key: draw_start(self.free, key))(task_keys)
        _, starts = jax.vmap(pursuit.reset_to)(
            jax.random.split(reset_key, worlds), tasks
        )
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
        (_, end, least, breach), (path, speed) = jax.lax.scan(
            one, first, None, length=STEPS
        )
        crash = jnp.mean(crash_share(least), axis=-1)
        # only at the end: a dive saves some starts. Flights follow the nominal
        # vehicle's speeds
        fast = (
            jnp.sqrt(jnp.sum(end.drones.velocity[:worlds] ** 2, axis=-1) + 1e-9)
            - FASTEST
        )
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

    def evaluate(self, parameters, tasks, key, bounds):
        """One episode per task, with vehicles of the bounds."""
        pursuit = self.pursuit(bounds, self.game)
        return make_evaluate(pursuit, self.policy)(parameters, tasks, key)


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
        off = off + jnp.sum(
            ((velocity - target_velocity[part]) / NEAR_VELOCITY) ** 2, axis=-1
        )
        return jnp.sqrt(1.0 + off) - 1.0

    # every other lag: between them a flight moves less than `NEAR_POSITION`
    return functools.reduce(jnp.minimum, [at(lag) for lag in range(0, LAG + 1, 2)])


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
    kinematic = (
        "position",
        "quaternion",
        "velocity",
        "body_rates",
        "previous_body_rates",
    )
    sensors = {
        name for name, effect in known_effects().items() if effect.sensor is not None
    }
    memory = {
        name: nominal.drones.effect_memory[name] if name in sensors else memory
        for name, memory in flight.drones.effect_memory.items()
    }
    drones = flight.drones.replace(
        **{name: getattr(nominal.drones, name) for name in kinematic},
        effect_memory=memory,
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


def bounds_of(
    values, intervals, rest: float = REST, airframe: str = NOMINAL
) -> Float[Array, "ranges 4"]:
    """(R, 4) bounds of the family of a diagnosed vehicle; see `adapted_family`. Of
    nothing found and no rest: nominal.
    """
    return jnp.asarray(family_bounds(adapted_family(values, intervals, rest, airframe)))
