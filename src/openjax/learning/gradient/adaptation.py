"""The lesson that adapts a policy to one diagnosed vehicle. Its programs are compiled
before the diagnosis is known.

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
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

import openjax.baselines  # noqa: F401  registers its policies
from openjax.learning.drawn_starts import draw_start
from openjax.learning.gradient.measures import (
    SmoothFlight,
    crash_share,
    end_excess,
    free_flight,
    mean_step,
)
from openjax.learning.gradient.stage import (
    Learnt,
    Turn,
    Updates,
    clipped_descent,
    falling_rate,
    weighted_sum,
)
from openjax.learning.settings import AdaptSettings, TrainSettings
from openjax.policy import Policy, PolicyParameters, make_policy
from openjax.policy.growth import in_larger_game
from openjax.pursuit import (
    Pursuit,
    PursuitSettings,
    PursuitState,
    RewardSettings,
    turn_task,
    uniform_task,
)
from openjax.vehicle.family import REST, adapted_family, draw_vehicles, family_bounds, known_effects
from openjax.vehicle.parameters import NOMINAL

Bounds = Float[Array, "ranges 4"]
"""Of the vehicles that are adapted to; see `openjax.vehicle.family`."""

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
"""Control steps by which the diagnosed vehicle may follow late: one whose commands come late
can't help it, and would learn to overdo what it does if it were to catch up.
"""
NEAR_POSITION = 0.02
"""Distance (m) from the nominal vehicle's flight that counts as one ..."""
NEAR_VELOCITY = 0.1
"""... and so does this difference in velocity (m/s)."""
END = 0.2
"""Weight of a start's end that is low or fast, beside the share of pursuers that touch
something.
"""
RATE_LOOP = 0.002
"""Period of a Crazyflie's rate loop (s)."""
HISTORY = 12
"""Frames of its own flight that an adapted policy sees at least: with late commands and
slow motors one isn't enough.
"""


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


def starting_parameters(parameters: PolicyParameters, settings: TrainSettings) -> PolicyParameters:
    """A policy as it begins in `adapting_game`, without its critic; it acts as
    before.
    """
    game = settings.environment

    def longer(one):
        return in_larger_game(one, settings.predictor, game, adapting_game(game))

    start = parameters.replace(critic={})
    # the members of a team that draws stand side by side
    start = longer(start) if game.strategies == 1 else jax.vmap(longer)(start)
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), start)


def bounds_of(values, intervals, rest: float = REST, airframe: str = NOMINAL) -> Bounds:
    """(R, 4) bounds of the family of a diagnosed vehicle; see `adapted_family`. Of
    nothing found and no rest: nominal.
    """
    return jnp.asarray(family_bounds(adapted_family(values, intervals, rest, airframe)))


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
    """A lesson of starts, and of moments of the nominal vehicle's flights."""

    settings: AdaptSettings
    environment: Pursuit
    """In the `adapting_game`."""
    free: Pursuit
    """The same in `free_flight`."""
    policy: Policy
    worlds: int
    """Of each kind of flight in an update."""

    @property
    def updates(self) -> int:
        """Of the actor."""
        return self.settings.updates

    @property
    def game(self) -> PursuitSettings:
        """The environment's settings."""
        return self.environment.settings

    @functools.cached_property
    def optimiser(self) -> optax.GradientTransformation:
        """Adam with clipped gradients; its step size falls linearly to a twentieth."""
        return clipped_descent(falling_rate(self.settings.learning_rate, self.settings.updates))

    def flight(self, bounds: Bounds) -> SmoothFlight:
        """The flights of vehicles at the bounds, for a gradient."""
        return SmoothFlight(self.free.with_bounds(bounds), self.policy)

    def begin(self, key: PRNGKeyArray) -> tuple:
        """Nothing: all worlds are drawn in each update."""
        return ()

    def record(
        self, parameters: PolicyParameters, key: PRNGKeyArray, late: Bounds
    ) -> tuple[Flights, Bounds]:
        """Moments of flights with the nominal vehicle, in which vehicles of the bounds
        `late` fly on; and these.
        """
        return self.nominal_flights(parameters, key, late), late

    def nominal_flights(
        self, parameters: PolicyParameters, key: PRNGKeyArray, bounds: Bounds
    ) -> Flights:
        """Moments of flights with the nominal vehicle, in which vehicles of the bounds
        fly on; more than an update takes, so that updates differ.
        """
        number = 4 * self.worlds
        nominal = self.flight(bounds_of({}, {}, rest=0.0)).environment
        task_key, reset_key, moment_key, vehicle_key = jax.random.split(key, 4)
        tasks = jax.vmap(lambda key: _task(nominal.settings, key))(
            jax.random.split(task_key, number)
        )
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
        settled_state = self._settle(parameters, at_settling, vehicle_key, bounds)
        return Flights(_in_its_place(settled_state, at_moment), position, velocity)

    def _settle(self, parameters, state, key, bounds):
        """States (W, ...) SETTLE steps later, flown by vehicles of the bounds."""
        number = state.step.shape[0]
        draw = functools.partial(draw_vehicles, self.game.vehicles)
        vehicles = jax.vmap(lambda key: draw(key, self.game.num_pursuers, 0.0, bounds))(
            jax.random.split(key, number)
        )
        environment = self.flight(bounds).environment
        fly_on = mean_step(environment, self.policy, parameters)

        def one(carry, _):
            observation, state = carry
            return fly_on(parameters.actor, observation, state), None

        state = state.replace(vehicles=vehicles)
        start = (jax.vmap(environment.observe)(state), state)
        (_, last_state), _ = jax.lax.scan(one, start, None, length=SETTLE)
        return last_state

    def _begin(self, flights, key, bounds):
        """Worlds at starts and as many in flight, all with vehicles of the bounds; and
        the flights to follow.
        """
        environment = self.flight(bounds).environment
        task_key, reset_key, moment_key = jax.random.split(key, 3)
        task_keys = jax.random.split(task_key, self.worlds)
        tasks = jax.vmap(lambda key: draw_start(environment.settings, key))(task_keys)
        reset_keys = jax.random.split(reset_key, self.worlds)
        _, starts = jax.vmap(environment.reset_to)(reset_keys, tasks)
        indices = jax.random.choice(
            moment_key, flights.position.shape[1], (self.worlds,), replace=False
        )
        moments = jax.tree.map(lambda leaf: leaf[indices], flights.state)
        state = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), starts, moments)
        world = (jax.vmap(environment.observe)(state), state)
        return world, flights.position[:, indices], flights.velocity[:, indices]

    def loss(self, actor: Any, parameters: PolicyParameters, record, key: PRNGKeyArray):
        """() what is learnt, and its parts; `record` is what the method gave."""
        flights, bounds = record
        worlds = self.worlds
        world, position, velocity = self._begin(flights, key, bounds)

        def track(state):
            return state.drones.position, state.drones.velocity

        outcome, (path, speed) = self.flight(bounds).fly_and_keep(
            actor, parameters, world, STEPS, track
        )
        (_, end), encounter = outcome
        crash = jnp.mean(crash_share(encounter.least), axis=-1)
        ends = jax.tree.map(lambda leaf: leaf[:worlds], end.drones)
        off = off_the_flight(path[:, worlds:], speed[:, worlds:], position, velocity)
        parts = {
            "crashes_from_starts": (1.0, crash[:worlds]),
            "crashes_in_flight": (1.0, crash[worlds:]),
            "breaches": (1.0, encounter.breach),
            # only at the end: a dive saves some starts. Flights follow the nominal
            # vehicle's speeds
            "ends": (END, end_excess(ends)),
            "off_the_nominal_flight": (self.settings.follow, off),
        }
        return weighted_sum(parts)

    @property
    def programs(self):
        """An update is one program; see `Lesson`."""
        return (self._learn,)

    def _learn(self, turn: Turn, _results: tuple) -> Learnt:
        gradient, parts = jax.grad(self.loss, has_aux=True)(
            turn.actor, turn.parameters, turn.flights, turn.key
        )
        return Learnt(gradient, (), parts)


def make_adaptation(training: TrainSettings, settings: AdaptSettings) -> Adaptation:
    """The lesson for a policy that was trained with `training`."""
    environment = Pursuit(adapting_game(training.environment))
    policy = make_policy(environment, training.network, training.predictor)
    worlds = settings.worlds or (8 if jax.default_backend() == "cpu" else 320)
    return Adaptation(settings, environment, free_flight(environment), policy, worlds)


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


@dataclass(frozen=True)
class Look:
    """A policy's episodes, of the same tasks and vehicles each time."""

    scores: Float[np.ndarray, " episodes"]
    """The objective, to be maximised."""
    steps: Float[np.ndarray, " episodes"]
    """Control steps to the capture."""


@dataclass(frozen=True)
class Tuned:
    """The result of fine-tuning."""

    parameters: PolicyParameters
    """The best of those looked at, the first ones among them; without a critic."""
    update: int
    """After which update they were found; 0: they are the first ones."""
    history: list[dict[str, float]]
    """Metrics of each update."""
    looks: dict[int, float]
    """{update: mean score}."""


def fine_tune(
    updates: Updates,
    settings: AdaptSettings,
    parameters: PolicyParameters,
    look: Callable[[PolicyParameters], Look],
) -> Tuned:
    """Train a policy by the stage's `updates` of `parameters`, and keep the best on the
    way.

    `look` flies a policy; what doesn't improve on the first parameters, by the
    differences of single episodes, isn't kept.
    """
    history = []
    first = look(parameters)
    best = parameters
    best_update = 0
    looks = {0: float(first.scores.mean())}
    for update, (candidate, metrics) in enumerate(updates, start=1):
        history.append({name: float(value) for name, value in metrics.items()})
        if update % settings.look_every == 0 or update == settings.updates:
            ahead = look(candidate)
            looks[update] = float(ahead.scores.mean())
            # better than the best so far by the mean, and than the first ones beyond
            # doubt: each look is another chance to be lucky
            if looks[update] > looks[best_update] and improves(first, ahead):
                best = candidate
                best_update = update
    return Tuned(best, best_update, history, looks)


def improves(first: Look, ahead: Look) -> bool:
    """True if a policy is clearly better, or clearly sooner and no worse.

    In scores a crash is worth thousands of steps, and is rare: where a vehicle costs
    time alone, a thousand episodes' scores don't tell what is won from chance.
    """
    if clearly_better(first.scores, ahead.scores):
        return True
    no_worse = ahead.scores.mean() >= first.scores.mean()
    return bool(no_worse) and clearly_better(-first.steps, -ahead.steps)


def clearly_better(
    first: Float[np.ndarray, " episodes"],
    scores: Float[np.ndarray, " episodes"],
    errors: float = 2.0,
) -> bool:
    """True if the scores (B,) of the same episodes rose by more than so many standard
    errors of their differences.
    """
    gain = np.asarray(scores, float) - np.asarray(first, float)
    return bool(gain.mean() > errors * gain.std() / np.sqrt(len(gain)))
