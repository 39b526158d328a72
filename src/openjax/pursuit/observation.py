"""The observation of each pursuer, and what the critic may see beside it."""

import functools

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from openjax.pursuit.axes import rotation_axes, turned_back
from openjax.pursuit.collisions import pillar_distance
from openjax.pursuit.settings import HIDDEN, PursuitSettings
from openjax.pursuit.shapes import Actions, Count, Flag, Quaternions, Team, Vector, Which
from openjax.pursuit.state import PursuitState
from openjax.pursuit.task import arena_of, capture_radius, evader_speed
from openjax.pursuit.teams import of_team, strategy_of
from openjax.vehicle import DroneState
from openjax.vehicle.family import standard_parameters

PRESS = 0.2
"""Distance (m) of a pursuer from which on it presses less than it would nearer
still.
"""


@struct.dataclass
class Observation:
    """Observation of N pursuers. Relative positions point from the entity to the
    pursuer (p_i - p_entity), in metres.
    """

    self_state: jax.Array
    """(N, S) evader, quaternion wxyz, velocity, body x, body z axis, t/T x 4 [,
    position] [, evader's speed and capture radius] [, arena] [, history]
    """
    others: jax.Array
    """(N, N - 1, O) other pursuers: relative position [, relative velocity, body z
    axis]
    """
    pillars: jax.Array
    """(N, k, 5) nearest pillars: position relative to their centre (3), height,
    radius
    """
    pillar_seen: jax.Array
    """(N, k) bool, slots in use"""
    privileged: jax.Array
    """(N, Q) true relative evader position, its velocity, own position, seen [, own
    velocity, vehicle]
    """
    position: jax.Array
    """(N, 3) own positions, to express predicted positions relative to them"""
    last_seen: jax.Array
    """(3,) where the evader was last seen"""
    frames: jax.Array
    """(n, F) history for the predictor, oldest first"""
    heading: jax.Array | None = None
    """(N, 2) cosine and sine of the yaw by which each pursuer's vectors are turned
    back, all but `position`; None: by none
    """
    active: jax.Array | None = None
    """(N,) bool, slots of pursuers in use, the others observe zeros; None: all are"""
    others_there: jax.Array | None = None
    """(N, N - 1) bool, the same of `others`"""
    strategy: jax.Array | None = None
    """() int32, which of its strategies the team has drawn; None: it has only one"""


def frame(
    settings: PursuitSettings,
    step: Count,
    pursuers: Float[Array, "kept 3"],
    evader: Vector,
    velocity: Vector,
    is_seen: Flag,
) -> Float[Array, " frame"]:
    """(F,) one frame of the predictor's history: t/T, evader position and velocity (-5
    where unseen), pursuers. Without `observe_time` t/T stays zero.
    """
    steps = step if settings.observe_time else jnp.zeros_like(step)
    time = steps.astype(jnp.float32)[None] / settings.episode_length
    evader = jnp.where(is_seen, jnp.concatenate([evader, velocity]), HIDDEN)
    return jnp.concatenate([time, evader, pursuers.ravel()])


def frame_pursuers(
    settings: PursuitSettings, position: Team, evader: Vector, active: Which | None
) -> Float[Array, "kept 3"]:
    """(M, 3) m, what a frame of the history holds of pursuers at (N, 3): all of them,
    or two, or both.

    Pooled, these are the nearest one's place relative to the evader, as far as one
    knows where that is, and the sum of all such places, each divided by its squared
    distance: whence evaders that flee feel pressed. `active` (N,) says which slots are
    in use.
    """
    if settings.history_pursuers == "each":
        return position
    two = _nearest_and_sum(position, evader, active)
    return two if settings.history_pursuers == "pooled" else jnp.concatenate([position, two])


def _nearest_and_sum(position, evader, active):
    """(2, 3) of `frame_pursuers`."""
    offset = position - evader
    square = jnp.sum(offset**2, axis=-1)
    if active is not None:
        square = jnp.where(active, square, jnp.inf)
    # sums with weights of zero and one instead of an index, whose gradient is a scatter
    is_nearest = jnp.arange(square.shape[0]) == jnp.argmin(square)
    # `PRESS` keeps one that is very near from being all that counts
    weights = jnp.stack([is_nearest.astype(jnp.float32), 1.0 / (square + PRESS**2)])
    return jnp.sum(weights[..., None] * offset, axis=1)


def own_frame(
    quaternion: Quaternions, velocity: Team, action: Actions
) -> Float[Array, "drones own_frame"]:
    """(N, OWN_FRAME) what N pursuers remember of a moment: (N, 3) velocity, body x and
    z axes, the action before it.
    """
    return jnp.concatenate([velocity, *rotation_axes(quaternion), action], axis=-1)


def observe(settings: PursuitSettings, state: PursuitState, seen_drones: DroneState) -> Observation:
    """The observation of all N pursuers in `state`; if one sees the evader, all do.

    `seen_drones` is what sensors tell of `state.drones`; only the critic sees these
    themselves.
    """
    n = settings.num_pursuers
    task = state.task
    position = seen_drones.position
    heading = _heading(seen_drones) if settings.observe_in == "heading" else None
    turn_back = functools.partial(turned_back, heading)

    def of_others(values):
        """(N, N - 1, ...) of (N, ...): for each pursuer the values of all but
        itself.
        """
        # slices and no index: the gradient of an index is a scatter
        return jnp.stack([jnp.concatenate([values[:i], values[i + 1 :]]) for i in range(n)])

    others = turn_back(position[:, None] - of_others(position))
    active = state.active
    others_there = None
    if active is not None:
        others_there = of_others(active)
        others = jnp.where(others_there[..., None], others, HIDDEN)
    pillars, pillar_seen = _nearest_pillars(
        settings, position, task.pillar_position, task.pillar_active
    )
    each = {
        "self_state": _own_part(settings, state, seen_drones, turn_back),
        "others": others,
        "pillars": jnp.where(pillar_seen[..., None], turn_back(pillars), HIDDEN),
        "privileged": _privileged_part(settings, state, turn_back),
        "position": position,
    }
    return Observation(
        **of_team(active, each),
        pillar_seen=pillar_seen,
        last_seen=state.last_seen,
        frames=state.frames[settings.history_spacing - 1 :: settings.history_spacing],
        heading=heading,
        active=active,
        others_there=others_there,
        strategy=_strategy(settings, state),
    )


def _strategy(settings, state):
    """() which of its strategies the team flies now."""
    if settings.strategies == 1:
        return None
    place = state.step // settings.strategy_steps
    # the episode's last observation is that of a step which isn't flown any more
    draw = state.strategies[jnp.minimum(place, len(state.strategies) - 1)]
    return strategy_of(settings, draw, state.seen)


def _heading(drones):
    """(N, 2) cosine and sine of the yaw."""
    ahead = rotation_axes(drones.quaternion)[0][:, :2]
    # shorter than one where a pursuer points straight up or down and has no yaw
    return ahead / jnp.sqrt(jnp.sum(ahead**2, axis=-1, keepdims=True) + 1e-6)


def _own_part(settings, state, seen_drones, turn_back):
    """`self_state`; `turn_back` turns vectors (N, ..., 3)."""
    position = seen_drones.position
    quaternion = seen_drones.quaternion
    body_x, body_z = map(turn_back, rotation_axes(quaternion))
    if settings.observe_in == "heading":
        quaternion = _quaternion(body_x, body_z)
    to_evader = jnp.where(state.seen, turn_back(position - state.evader_position), HIDDEN)
    parts = [to_evader, quaternion, turn_back(seen_drones.velocity), body_x, body_z]
    if settings.observe_time:
        time = state.step.astype(jnp.float32) / settings.episode_length
        # four times, as in the released code
        parts.append(jnp.broadcast_to(time, (len(position), 4)))
    if settings.observe_position:
        parts.append(turn_back(position))
    if settings.observe_game:
        speed = evader_speed(settings, state.task) / settings.max_speed
        numbers = jnp.stack([speed, capture_radius(settings, state.task)]).astype(jnp.float32)
        parts.append(jnp.broadcast_to(numbers, (len(position), 2)))
    if settings.observe_arena:
        radius = jnp.float32(arena_of(settings, state.task).arena_radius)
        parts.append(jnp.broadcast_to(radius, (len(position), 1)))
    if settings.observe_history:
        spacing = settings.history_spacing
        history = jnp.moveaxis(state.own_history[spacing - 1 :: spacing], 0, 1)
        # the past is seen in today's axes: velocity, body x and z axes are vectors, the
        # command is none
        vectors = [turn_back(history[..., i : i + 3]) for i in (0, 3, 6)]
        history = jnp.concatenate([*vectors, history[..., 9:]], axis=-1)
        parts.append(history.reshape(len(position), -1))
    return jnp.concatenate(parts, axis=-1)


def _privileged_part(settings, state, turn_back):
    """`privileged`, by the drones' true states; `turn_back` as in `_own_part`."""
    n = settings.num_pursuers
    drones = state.drones
    parts = [
        turn_back(drones.position - state.evader_position),
        turn_back(jnp.broadcast_to(state.evader_velocity, (n, 3))),
        turn_back(drones.position),
        jnp.broadcast_to(state.seen.astype(jnp.float32), (n, 1)),
    ]
    if settings.vehicles:
        # which vehicle it is decides what a state is worth
        parts += [
            turn_back(drones.velocity),
            standard_parameters(settings.vehicles, state.vehicles),
        ]
    return jnp.concatenate(parts, axis=-1)


def _quaternion(body_x, body_z):
    """Unit quaternions (N, 4) wxyz, w > 0, of attitudes with these body axes (N, 3)."""
    body_y = jnp.cross(body_z, body_x)
    # the branch of the formula for w away from zero: upright axes have no half turn
    # about the vertical, and what has tipped over has crashed
    trace = body_x[:, 0] + body_y[:, 1] + body_z[:, 2]
    w = 0.5 * jnp.sqrt(jnp.maximum(1.0 + trace, 1e-3))
    x = body_y[:, 2] - body_z[:, 1]
    y = body_z[:, 0] - body_x[:, 2]
    z = body_x[:, 1] - body_y[:, 0]
    return jnp.stack([w, 0.25 * x / w, 0.25 * y / w, 0.25 * z / w], axis=-1)


def _nearest_pillars(settings, position, pillar_position, pillar_active):
    """The k nearest active pillars of each pursuer: (N, k, 5) features, and (N, k) in
    use.
    """
    n = settings.num_pursuers
    k = settings.observed_pillars
    slots = pillar_position.shape[0]
    # a network has inputs for k pillars, a task may have fewer slots
    if slots < k:
        pillar_position = jnp.concatenate([pillar_position, jnp.zeros((k - slots, 2), jnp.float32)])
        pillar_active = jnp.concatenate([pillar_active, jnp.zeros(k - slots, bool)])
    distance = pillar_distance(settings, position, pillar_position)
    distance = jnp.where(pillar_active[None], distance, jnp.inf)
    # rank by counting nearer ones: for a handful of pillars much cheaper on an
    # accelerator than a sort
    earlier = jnp.arange(distance.shape[1])[:, None] < jnp.arange(distance.shape[1])[None]
    nearer = (distance[:, :, None] < distance[:, None, :]) | (
        (distance[:, :, None] == distance[:, None, :]) & earlier[None]
    )
    rank = jnp.sum(nearer, axis=1)
    slot = (rank[:, None, :] == jnp.arange(k)[None, :, None]).astype(jnp.float32)
    axis = jnp.sum(slot[..., None] * pillar_position[None, None], axis=2)
    is_seen = jnp.sum(slot * pillar_active[None, None], axis=2) > 0.5
    features = jnp.concatenate(
        [
            position[:, None, :2] - axis,
            # a pillar's centre is at half of its height
            jnp.broadcast_to(position[:, None, 2:] - settings.arena_height / 2, (n, k, 1)),
            jnp.full((n, k, 1), settings.arena_height, jnp.float32),
            jnp.full((n, k, 1), settings.pillar_radius, jnp.float32),
        ],
        axis=-1,
    )
    return features, is_seen
