"""Variants of the evader predictor, trained on the same flights and compared by how far off they are."""

import functools
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import optax

from experiments.prediction_flights import Flights, inside, last_known
from openjax.learning.predictor_update import make_predictor_optimiser, prediction_loss
from openjax.policy import PredictorSettings
from openjax.policy.predictor import EvaderPredictor
from openjax.pursuit import PursuitSettings
from openjax.pursuit.settings import HIDDEN

HORIZONS = (1, 5, 10, 20, 40)
"""Control steps ahead at which all are compared."""
VISIBILITY = ("seen", "lost", "not yet seen", "all")
"""When a prediction is made: somebody sees the evader; nobody does any more; nobody has yet; any of them."""


@dataclass(frozen=True)
class Variant:
    """What a predictor sees and predicts."""

    name: str
    horizons: tuple[int, ...] = HORIZONS
    relative: bool = True
    """Predict the displacement from where the evader was last seen; False: positions in the arena."""
    frames: int = 10
    spacing: int = 1
    """Control steps between two frames."""
    memory: bool = False
    """Frames hold where the evader was last seen, its velocity then and the time since; else -5 where unseen."""
    pillars: bool = False
    """Frames hold all pillars, relative to where the evader was last seen, nearest first."""
    units: int = 64
    loss: str = "scaled"
    """As in `openjax.policy.PredictorSettings`."""
    learning_rate: float = 1e-3
    balanced: bool = False
    """Half of the windows end where the evader is lost from sight, which else are a few in a thousand."""


VARIANTS = (
    Variant("1–40 ahead, relative (default)"),
    Variant(
        "paper: 1–5 ahead, absolute, step size 1e-4",
        (1, 2, 3, 4, 5),
        False,
        loss="squared",
        learning_rate=1e-4,
    ),
    Variant("squared error of all windows", loss="squared"),
    Variant("1–5 ahead, relative", (1, 2, 3, 4, 5)),
    Variant("1–40 ahead, absolute", relative=False),
    Variant("spacing 4", spacing=4),
    Variant("pillars", pillars=True),
    Variant("last seen position as input", memory=True),
    Variant("last seen and pillars", memory=True, pillars=True),
    Variant("last seen, half of the windows lost", memory=True, balanced=True),
    Variant("last seen and pillars, half of the windows lost", memory=True, pillars=True, balanced=True),
    Variant("paper's, step size 1e-3", (1, 2, 3, 4, 5), False, loss="squared"),
    Variant("spacing 8", spacing=8),
    Variant("20 frames, spacing 8", frames=20, spacing=8),
    Variant("last seen and pillars, absolute", memory=True, pillars=True, relative=False),
    Variant("last seen and pillars, spacing 4", memory=True, pillars=True, spacing=4),
    Variant("last seen and pillars, 128 units", memory=True, pillars=True, units=128),
)
"""Those that answer the most come first."""


@dataclass(frozen=True)
class Budget:
    """How long each variant is trained."""

    updates: int
    batch: int
    """Windows per update."""
    seeds: int


def frames_of(variant: Variant, settings: PursuitSettings, flights: Flights) -> jax.Array:
    """(B, T, F) frames; without memory and pillars those of `openjax.pursuit.observation.frame`."""
    worlds, length = flights.seen.shape
    time = jnp.broadcast_to(jnp.arange(length) / settings.episode_length, (worlds, length))
    position, velocity, age = last_known(settings, flights)
    if variant.memory:
        evader = [position, velocity, age[..., None]]
    else:
        known = jnp.concatenate([flights.evader[:, :-1], flights.velocity], axis=-1)
        evader = [jnp.where(flights.seen[..., None], known, HIDDEN)]
    parts = [time[..., None], *evader, flights.pursuers.reshape(worlds, length, -1)]
    if variant.pillars:
        away = position[:, :, None, :2] - flights.pillar_position[:, None]
        active = jnp.broadcast_to(flights.pillar_active[:, None], away.shape[:3])
        away = jnp.where(active[..., None], away, 2 * settings.arena_radius)
        slots = jnp.concatenate([away, active[..., None]], axis=-1)
        order = jnp.argsort(jnp.linalg.norm(away, axis=-1), axis=-1)
        parts.append(jnp.take_along_axis(slots, order[..., None], axis=2).reshape(worlds, length, -1))
    return jnp.concatenate(parts, axis=-1).astype(jnp.float32)


def own_settings(variant: Variant) -> PredictorSettings:
    """The variant as the package's own settings, as far as they go; one gradient step per update."""
    return PredictorSettings(
        units=variant.units,
        horizons=variant.horizons,
        relative=variant.relative,
        loss=variant.loss,
        learning_rate=variant.learning_rate,
        steps=1,
    )


def network(variant: Variant, settings: PursuitSettings) -> EvaderPredictor:
    """The package's own network."""
    return EvaderPredictor(own_settings(variant), settings.arena_radius, settings.arena_height)


def window(variant: Variant, frames: jax.Array, world: jax.Array, time: jax.Array) -> jax.Array:
    """(..., n, F) windows that end at `time`; the start's frame stands for those before it, as in the game."""
    back = variant.spacing * np.arange(variant.frames - 1, -1, -1)
    return frames[world[..., None], jnp.maximum(time[..., None] - back, 0)]


def lost_steps(flights: Flights) -> jax.Array:
    """(2, M) world and time of all steps from which a window may end where the evader is lost; (2, 1) zeros if none."""
    length = flights.seen.shape[1] - HORIZONS[-1] + 1
    found = np.stack(np.nonzero(visibility(flights, np.arange(length))[..., 1]))
    return jnp.asarray(found if found.size else np.zeros((2, 1)), jnp.int32)


@functools.partial(jax.jit, static_argnums=(0, 1, 2))
def train(
    variant: Variant, settings: PursuitSettings, budget: Budget, flights: Flights, lost: jax.Array
) -> tuple[dict, jax.Array]:
    """Parameters and last loss of `budget.seeds` predictors, leading axis seeds.

    All variants of a seed see the same windows in the same order, but for those that prefer steps from `lost_steps`.
    """
    frames = frames_of(variant, settings, flights)
    position = last_known(settings, flights)[0]
    worlds, length = flights.seen.shape
    own, net = own_settings(variant), network(variant, settings)
    optimiser = make_predictor_optimiser(own, budget.updates)
    ahead = np.array(variant.horizons)

    def loss(parameters, world, time):
        predicted = net.apply(parameters, window(variant, frames, world, time), position[world, time])
        true = flights.evader[world[:, None], time[:, None] + ahead]
        return prediction_loss(own, settings, predicted, position[world, time], true)

    def update(carry, key):
        parameters, state = carry
        world_key, time_key, lost_key = jax.random.split(key, 3)
        world = jax.random.randint(world_key, (budget.batch,), 0, worlds)
        time = jax.random.randint(time_key, (budget.batch,), 0, length - HORIZONS[-1] + 1)
        if variant.balanced:
            half = budget.batch // 2
            chosen = lost[:, jax.random.randint(lost_key, (half,), 0, lost.shape[1])]
            world, time = world.at[:half].set(chosen[0]), time.at[:half].set(chosen[1])
        value, gradient = jax.value_and_grad(loss)(parameters, world, time)
        change, state = optimiser.update(gradient, state, parameters)
        return (optax.apply_updates(parameters, change), state), value

    def one(key):
        start_key, data_key = jax.random.split(key)
        zero = jnp.zeros(1, jnp.int32)
        start = net.init(start_key, window(variant, frames, zero, zero), position[zero, zero])
        keys = jax.random.split(data_key, budget.updates)
        (parameters, _), losses = jax.lax.scan(update, (start, optimiser.init(start)), keys)
        return parameters, jnp.mean(losses[-max(1, budget.updates // 20) :])

    return jax.vmap(one)(jax.random.split(jax.random.key(0), budget.seeds))


@functools.partial(jax.jit, static_argnums=(0, 1, 4))
def predict(
    variant: Variant, settings: PursuitSettings, parameters, flights: Flights, stride: int
) -> jax.Array:
    """(seeds, B, times, K, 3) positions predicted at every `stride`-th step; see `compared_times`."""
    frames = frames_of(variant, settings, flights)
    position = last_known(settings, flights)[0]
    worlds, length = flights.seen.shape
    time = jnp.asarray(compared_times(length, stride))
    net = network(variant, settings)

    def of_world(parameters, world):
        world = jnp.broadcast_to(world, time.shape)
        return net.apply(parameters, window(variant, frames, world, time), position[world, time])

    def one(parameters):  # a few hundred worlds at a time, to bound the memory
        return jax.lax.map(lambda world: of_world(parameters, world), jnp.arange(worlds), batch_size=512)

    return jax.lax.map(one, parameters)


def compared_times(length: int, stride: int) -> np.ndarray:
    """Steps whose largest horizon still lies within the episode."""
    return np.arange(0, length - HORIZONS[-1] + 1, stride)


def simple_guesses(settings: PursuitSettings, flights: Flights, times: np.ndarray) -> dict[str, jax.Array]:
    """(B, times, K, 3) positions without learning: keeping the last seen one, and going straight on from it."""
    position, velocity, age = (leaf[:, times] for leaf in last_known(settings, flights))
    ahead = settings.time_step * jnp.array(HORIZONS)[:, None]
    kept = jnp.broadcast_to(position[:, :, None], (*position.shape[:2], len(HORIZONS), 3))
    straight = kept + velocity[:, :, None] * (age[..., None, None] + ahead)
    return {
        "keeping the last seen position": kept,
        "constant velocity from there": inside(settings, straight),
    }


def visibility(flights: Flights, times: np.ndarray) -> np.ndarray:
    """(B, times, `VISIBILITY`) bool."""
    seen, known = np.asarray(flights.seen[:, times]), np.asarray(flights.last_index[:, times]) >= 0
    return np.stack([seen, ~seen & known, ~known, np.ones_like(seen)], axis=-1)


def errors(
    predicted: jax.Array, horizons: tuple[int, ...], flights: Flights, times: np.ndarray, groups: np.ndarray
) -> np.ndarray:
    """Mean distances (m) to the true positions by group of worlds, horizon and visibility.

    Args:
        predicted: (..., B, times, K, 3).
        horizons: those of `predicted`.
        flights: B worlds.
        times: those of `predicted`.
        groups: (B,) number of each world's group.

    Returns:
        (..., groups, `HORIZONS`, `VISIBILITY`); NaN at horizons that aren't predicted and where there is no such step.
    """
    masks = visibility(flights, times).astype(np.float32)
    member = (groups[:, None] == np.arange(groups.max() + 1)).astype(np.float32)
    count = np.einsum("bg,btm->gm", member, masks)
    columns = []
    for horizon in HORIZONS:
        if horizon not in horizons:
            columns.append(None)
            continue
        true = flights.evader[:, times + horizon]
        distance = jnp.linalg.norm(predicted[..., horizons.index(horizon), :] - true, axis=-1)
        total = jnp.einsum("...bt,bg,btm->...gm", distance, member, masks, precision="highest")
        columns.append(np.asarray(total) / np.where(count > 0, count, np.nan))
    empty = np.full_like(next(column for column in columns if column is not None), np.nan)
    return np.stack([empty if column is None else column for column in columns], axis=-2)
