"""Adapting a policy to one diagnosed vehicle by the gradient through the simulation, compiled
before the diagnosis is known.

Two things are learnt at once, from flights of half a second. From drawn starts, leaning and close
to things: to touch nothing. From moments of the policy's flights with the nominal vehicle: to fly
the diagnosed vehicle, settled in flight, where and as fast as the policy flew the nominal one. The
simulator's derivative says in one update what MAPPO has to find by trying.
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
from openjax.evaluation.episodes import Evaluation, make_evaluate
from openjax.learning.analytic_gradient import (
    breach_share,
    crash_share,
    draw_start,
    nearest_gap,
)
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
from openjax.vehicle import load_vehicle
from openjax.vehicle.family import REST, adapted_family, draw_vehicles, family_bounds, known_effects
from openjax.vehicle.parameters import NOMINAL

RATE_LOOP = 0.002
"""Period of a Crazyflie's rate loop (s)."""
HISTORY = 12
"""Frames of its own flight that an adapted policy sees at least: with late commands and slow motors
one isn't enough.
"""
STEPS = 50
"""Control steps of the flights that are learnt from."""
FLIGHT = 400
"""Control steps of the flights with the nominal vehicle that these begin in."""
SETTLE = 40
"""Control steps that the diagnosed vehicle flies up to such a moment, so that its controllers,
rotors and the policy's memories are those of that vehicle, and not of one that has just been
changed in flight.
"""
LAG = 6
"""Control steps by which the diagnosed vehicle may follow late: one that hears late can't help it,
and would learn to overdo what it does if it were to catch up.
"""
NEAR = 0.02
ALIKE = 0.1
"""Distance (m) and difference in velocity (m/s) from the nominal vehicle's flight that count as
one.
"""


def adapting_game(game: PursuitSettings) -> PursuitSettings:
    """The game as vehicles fly it, whatever a policy was trained in: no clamp, the rate loop at 500
    Hz, solid pillars.
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


def starting_parameters(parameters: PolicyParameters, trained: TrainSettings) -> PolicyParameters:
    """A policy as it begins in `adapting_game`, without its critic; it acts as before."""
    game = trained.environment
    grown = with_longer_history(
        parameters.replace(critic={}), trained.predictor, game, adapting_game(game)
    )
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), grown)


@struct.dataclass
class Flights:
    """Moments of flights with the nominal vehicle, and how that flew on from each."""

    # (W, ...) where the nominal vehicle was; with vehicles of the bounds that are adapted to
    state: PursuitState
    position: (
        jax.Array
    )  # (LAG + T, W, N, 3) m, after the LAG steps before the moment and the steps that followed
    velocity: jax.Array  # (LAG + T, W, N, 3) m/s


@dataclass(frozen=True)
class Adaptation:
    """The programs, not compiled yet; vehicles' bounds (R, 4) are an argument."""

    game: PursuitSettings
    policy: Policy
    optimiser: optax.GradientTransformation
    fly: Callable[[PolicyParameters, jax.Array, jax.Array], Flights]
    """(parameters, key, bounds) -> moments of flights."""
    update: Callable[..., tuple[Any, Any, dict[str, jax.Array]]]
    """(actor, optimiser's state, parameters, flights, key, bounds) -> actor, state, metrics."""
    evaluate: Callable[[PolicyParameters, Task, jax.Array, jax.Array], Evaluation]
    """(parameters, tasks, key, bounds) -> one episode per task."""


def make_adaptation(trained: TrainSettings, settings: AdaptSettings) -> Adaptation:
    """The programs for a policy that was trained with `trained`."""
    game = adapting_game(trained.environment)
    vehicle = load_vehicle(trained.environment.airframe)
    # nothing is solid while the gradient is taken: a crash is told by the gap
    free = dataclasses.replace(game, physics="rigid", contacts=False)
    policy = make_policy(Pursuit(game), trained.network, trained.predictor)
    worlds = settings.worlds or (8 if jax.default_backend() == "cpu" else 320)
    nominal = bounds_of({}, {}, rest=0.0)
    optimiser = clipped_descent(falling_rate(settings.learning_rate, settings.updates))

    def environment(settings, bounds):
        return Pursuit(settings, vehicle, vehicle_bounds=bounds)

    def fly(parameters, key, bounds):
        pursuit = environment(free, nominal)
        number = 4 * worlds
        task_key, reset_key, moment_key, vehicle_key = jax.random.split(key, 4)
        tasks = jax.vmap(lambda key: _task(free, key))(jax.random.split(task_key, number))
        _, state = jax.vmap(pursuit.reset_to)(jax.random.split(reset_key, number), tasks)
        moment = jax.random.randint(moment_key, (number,), SETTLE, FLIGHT - STEPS)
        fly_on = mean_step(pursuit, policy, parameters)

        def one(carry, step):
            observation, state, before, kept = carry
            before = _kept(moment - SETTLE == step, state, before)
            kept = _kept(moment == step, state, kept)
            observation, state = fly_on(parameters.actor, observation, state)
            return (observation, state, before, kept), (
                state.drones.position,
                state.drones.velocity,
            )

        first = jax.vmap(pursuit.observe)(state), state, state, state
        (_, _, before, kept), flown = jax.lax.scan(one, first, jnp.arange(FLIGHT))
        after = moment + jnp.arange(-LAG, STEPS)[:, None]
        position, velocity = (track[after, jnp.arange(number)] for track in flown)

        drawn = jax.vmap(
            lambda key: draw_vehicles(free.vehicles, key, free.num_pursuers, 0.0, bounds)
        )(jax.random.split(vehicle_key, number))
        pursuit = environment(free, bounds)
        settled = before.replace(vehicles=drawn)
        fly_on = mean_step(pursuit, policy, parameters)
        settled, _ = jax.lax.scan(
            lambda carry, _: (fly_on(parameters.actor, *carry), None),
            (jax.vmap(pursuit.observe)(settled), settled),
            None,
            length=SETTLE,
        )
        return Flights(_in_its_place(settled[1], kept), position, velocity)

    def begin(flights, key, bounds):
        """Half of the worlds at starts, half in flight, all with vehicles of the bounds; and the
        flights to follow.
        """
        pursuit = environment(free, bounds)
        task_key, reset_key, moment_key = jax.random.split(key, 3)
        tasks = jax.vmap(lambda key: draw_start(free, key))(jax.random.split(task_key, worlds))
        _, starts = jax.vmap(pursuit.reset_to)(jax.random.split(reset_key, worlds), tasks)
        chosen = jax.random.choice(moment_key, flights.position.shape[1], (worlds,), replace=False)
        moments = jax.tree.map(lambda leaf: leaf[chosen], flights.state)
        state = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), starts, moments)
        return pursuit, state, flights.position[:, chosen], flights.velocity[:, chosen]

    def loss(actor, parameters, flights, key, bounds):
        pursuit, state, position, velocity = begin(flights, key, bounds)
        fly_on = jax.checkpoint(mean_step(pursuit, policy, parameters))

        def one(carry, _):
            observation, state, least, breach = carry
            observation, state = fly_on(actor, observation, state)
            least = jnp.minimum(least, nearest_gap(free, state))
            breach = breach + breach_share(free, state) / STEPS
            return (observation, state, least, breach), (
                state.drones.position,
                state.drones.velocity,
            )

        number = state.drones.position.shape[:2]
        first = (
            jax.vmap(pursuit.observe)(state),
            state,
            jnp.full(number, jnp.inf),
            jnp.zeros(number),
        )
        (_, end, least, breach), (flown, speed) = jax.lax.scan(one, first, None, length=STEPS)
        crash = jnp.mean(crash_share(least), axis=-1)
        fast = jnp.sqrt(jnp.sum(end.drones.velocity[:worlds] ** 2, axis=-1) + 1e-9) - FASTEST
        low = LOWEST - end.drones.position[:worlds, :, 2]
        off = off_the_flight(flown[:, worlds:], speed[:, worlds:], position, velocity)
        parts = {
            "crashes_from_starts": (1.0, crash[:worlds]),
            "crashes_in_flight": (1.0, crash[worlds:]),
            "breaches": (1.0, breach),
            "ends": (END, jnp.mean(jax.nn.relu(fast)) + jnp.mean(jax.nn.relu(low))),
            "off_the_nominal_flight": (settings.follow, off),
        }
        return weighted_sum(parts)

    def update(actor, state, parameters, flights, key, bounds):
        gradient, watch = jax.grad(loss, has_aux=True)(actor, parameters, flights, key, bounds)
        change, state = optimiser.update(finite_or_zero(gradient), state, actor)
        return optax.apply_updates(actor, change), state, watch

    def evaluate(parameters, tasks, key, bounds):
        return make_evaluate(environment(game, bounds), policy)(parameters, tasks, key)

    return Adaptation(game, policy, optimiser, jax.jit(fly), jax.jit(update), jax.jit(evaluate))


def off_the_flight(
    position: Float[Array, "steps worlds pursuers 3"],
    velocity: Float[Array, "steps worlds pursuers 3"],
    target: Float[Array, "all worlds pursuers 3"],
    target_velocity: Float[Array, "all worlds pursuers 3"],
) -> Float[Array, "steps worlds pursuers"]:
    """(T, W, N) how far flights (T, W, N, 3) are from those that are wanted (LAG + T, W, N, 3), at
    the lag that suits best.

    In multiples of `NEAR` and `ALIKE`, less one where it is large and half the square where it is
    small.
    """

    def at(lag):
        part = slice(LAG - lag, LAG - lag + position.shape[0])
        off = jnp.sum(((position - target[part]) / NEAR) ** 2, axis=-1)
        off = off + jnp.sum(((velocity - target_velocity[part]) / ALIKE) ** 2, axis=-1)
        return jnp.sqrt(1.0 + off) - 1.0

    return functools.reduce(jnp.minimum, [at(lag) for lag in range(0, LAG + 1, 2)])


def _kept(is_now, state, kept):
    """States (W, ...) kept of earlier steps, but those of worlds whose moment `is_now` (W,)."""
    return jax.vmap(lambda is_now, a, b: jax.tree.map(lambda x, y: jnp.where(is_now, x, y), a, b))(
        is_now, state, kept
    )


def _in_its_place(settled: PursuitState, there: PursuitState) -> PursuitState:
    """States `there` whose vehicles, as one would find them in flight, are those of `settled`.

    Where they are and how they move, and what their sensors still show of that, is from `there`;
    rotors, controllers, commands on the way, effects, and what the policy remembers of the vehicle
    from `settled`.
    """
    kinematic = ("position", "quaternion", "velocity", "body_rates", "previous_body_rates")
    sensors = {name for name, effect in known_effects().items() if effect.sensor is not None}
    memory = {
        name: there.drones.effect_memory[name] if name in sensors else own
        for name, own in settled.drones.effect_memory.items()
    }
    drones = settled.drones.replace(
        **{name: getattr(there.drones, name) for name in kinematic}, effect_memory=memory
    )
    return there.replace(
        vehicles=settled.vehicles,
        drones=drones,
        own_history=settled.own_history,
        previous_action=settled.previous_action,
    )


def _task(game, key):
    """A uniform task, turned about the arena's axis."""
    task_key, turn_key = jax.random.split(key)
    return turn_task(turn_key, uniform_task(game, task_key))


@dataclass(frozen=True)
class Tuned:
    """What fine-tuning led to."""

    parameters: PolicyParameters
    """The best of those looked at, the first ones among them; without a critic."""
    update: int
    """After which update they were found; 0: they are the first ones."""
    history: list[dict[str, float]]
    """Metrics of each update."""
    looks: dict[int, float]
    """{update: mean score}."""


def fine_tune(
    adaptation: Adaptation,
    parameters: PolicyParameters,
    bounds: Float[Array, "ranges 4"],
    training: AdaptSettings,
    key: PRNGKeyArray,
    score: Callable[[PolicyParameters], np.ndarray],
    tell: Callable[[int, dict[str, jax.Array]], Any] = lambda update, metrics: None,
) -> Tuned:
    """Train `parameters` (from `starting_parameters`) on vehicles within `bounds` (R, 4), and keep
    the best on the way.

    `score` gives the scores of episodes (B,), of the same tasks and vehicles each time; what isn't
    clearly better than the first parameters, by the differences of single episodes, isn't kept.
    `tell` hears of every update.
    """
    bounds = jnp.asarray(bounds)
    fly_key, update_key = jax.random.split(key)
    flights = adaptation.fly(parameters, fly_key, bounds)
    actor = parameters.actor
    state = adaptation.optimiser.init(parameters.actor)
    history = []
    first = np.asarray(score(parameters))
    best = (parameters, 0)
    looks = {0: float(first.mean())}
    for update in range(1, training.updates + 1):
        own_key = jax.random.fold_in(update_key, update)
        actor, state, metrics = adaptation.update(
            actor, state, parameters, flights, own_key, bounds
        )
        history.append(metrics)
        tell(update, metrics)
        if update % training.look_every == 0 or update == training.updates:
            now = parameters.replace(actor=actor)
            scores = np.asarray(score(now))
            looks[update] = float(scores.mean())
            if looks[update] > looks[best[1]] and clearly_better(first, scores):
                best = now, update
    history = [
        {name: float(value) for name, value in row.items()} for row in jax.device_get(history)
    ]
    return Tuned(*best, history, looks)


def clearly_better(
    before: Float[np.ndarray, " episodes"],
    after: Float[np.ndarray, " episodes"],
    errors: float = 2.0,
) -> bool:
    """Whether the scores (B,) of the same episodes rose by more than so many standard errors of
    their differences.
    """
    gain = np.asarray(after, float) - np.asarray(before, float)
    return bool(gain.mean() > errors * gain.std() / np.sqrt(len(gain)))


def bounds_of(
    values, intervals, rest: float = REST, airframe: str = NOMINAL
) -> Float[Array, "ranges 4"]:
    """(R, 4) bounds of the family of a diagnosed vehicle; see `adapted_family`. Of nothing found
    and no rest: nominal.
    """
    return jnp.asarray(family_bounds(adapted_family(values, intervals, rest, airframe)))
