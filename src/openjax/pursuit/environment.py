"""The environment: reset and step as pure functions of arrays."""

import copy
import dataclasses

import jax
import jax.numpy as jnp
from flax import struct

from openjax.pursuit.collisions import Breaches, breaches, crashed
from openjax.pursuit.evader import evader_velocity
from openjax.pursuit.observation import Observation, frame, observe, own_frame, rotation_axes
from openjax.pursuit.reward import captures, over_speed, reward
from openjax.pursuit.sensing import line_of_sight
from openjax.pursuit.settings import PursuitSettings
from openjax.pursuit.spaces import Box
from openjax.pursuit.statistics import EpisodeStatistics, count, empty_statistics
from openjax.pursuit.task import Task, start_attitude, uniform_task
from openjax.vehicle import DroneState, Vehicle, hover_state, load_vehicle, make_drones_step
from openjax.vehicle.family import draw_vehicles, family_effects, standard_parameters

THRUST_LIMIT = 0.9
"""The commanded thrust is cut here, as a fraction of the maximum (SPEC section 2)."""


@struct.dataclass
class PursuitState:
    """State of one world with N pursuers."""

    task: Task
    drones: DroneState  # leading axis N
    vehicles: dict[
        str, dict[str, jax.Array]
    ]  # effect -> parameter -> (N,), drawn at the start; empty: nominal vehicles
    evader_position: jax.Array  # (3,) m, world
    evader_velocity: jax.Array  # (3,) m/s, world
    last_seen: jax.Array  # (3,) where the evader was last seen; the arena's middle before that
    in_sight: jax.Array  # (N,) bool, which pursuers see the evader
    frames: jax.Array  # (n * spacing, F) history, oldest first
    own_history: (
        jax.Array | None
    )  # (H * spacing, N, OWN_FRAME) as seen, oldest first; None where it isn't observed
    previous_action: jax.Array  # (N, 4) squashed command of the last step
    step: jax.Array  # () int32, control steps since the start
    statistics: EpisodeStatistics

    @property
    def seen(self) -> jax.Array:
        """() bool, some pursuer sees the evader."""
        return jnp.any(self.in_sight, axis=-1)


@struct.dataclass
class StepInfo:
    """What happened in one step, beside the reward."""

    captured: jax.Array  # (N,) bool
    seen: jax.Array  # () bool, some pursuer sees the evader
    breaches: Breaches
    over_speed: jax.Array  # (N,) bool
    crashed: jax.Array  # (N,) bool
    penalty: jax.Array  # (N,) the reward's penalties, at most 0


def hover_action(vehicle: Vehicle) -> jax.Array:
    """(4,) action [thrust, roll, pitch, yaw rate] in -1..1 that hovers."""
    hover = vehicle.mass * vehicle.gravity / (4 * vehicle.thrust_constant * vehicle.max_rotor_speed**2)
    return jnp.concatenate([(2.0 * hover - 1.0)[None], jnp.zeros(3, jnp.float32)]).astype(jnp.float32)


def action_to_command(action: jax.Array) -> jax.Array:
    """(..., 4) action in -1..1 to command: collective thrust 0..0.9 of the maximum, body rates up to pi rad/s."""
    action = jnp.clip(action, -1.0, 1.0)
    thrust = jnp.minimum(0.5 * (action[..., :1] + 1.0), THRUST_LIMIT)
    return jnp.concatenate([thrust, jnp.pi * action[..., 1:]], axis=-1)


class Pursuit:
    """Pursuit-evasion by N quadrotors, as pure functions: map them with `jax.vmap`, compile them with `jax.jit`.

    Args:
        settings: the game; see `PursuitSettings`.
        vehicle: the pursuers' vehicle; None is the nominal Crazyflie.
        effects: names of physical effects to fly with (`openjax.vehicle.effects`).
        effect_parameters: their parameters, {effect: {parameter: value}}.
        vehicle_bounds: (R, 4) bounds of `settings.vehicles` that go before those written there.
    """

    def __init__(
        self,
        settings: PursuitSettings | None = None,
        vehicle: Vehicle | None = None,
        effects: tuple[str, ...] = (),
        effect_parameters: dict | None = None,
        vehicle_bounds: jax.Array | None = None,
    ):
        self.settings = settings or PursuitSettings()
        self.vehicle = vehicle if vehicle is not None else load_vehicle()
        self.effects = tuple(effects)
        self.effect_parameters = effect_parameters or {}
        self.vehicle_bounds = vehicle_bounds
        drawn = family_effects(self.settings.vehicles)
        self._drones_step = make_drones_step(
            physics=self.settings.physics,
            dt=self.settings.time_step,
            substeps=self.settings.substeps,
            effects=(*drawn, *self.effects),
            contacts=self.settings.contacts,
            arena=self.settings.arena,
        )

    @property
    def action_space(self) -> Box:
        """Actions (N, 4) of all pursuers: collective thrust, roll, pitch and yaw rate, in -1..1."""
        return Box(-1.0, 1.0, (self.settings.num_pursuers, 4))

    @property
    def observation_space(self) -> Observation:
        """An `Observation` whose leaves are the boxes of its arrays."""
        kinds = jax.eval_shape(lambda key: self.reset(key)[0], jax.random.key(0))
        return jax.tree.map(lambda kind: Box(-jnp.inf, jnp.inf, kind.shape, kind.dtype), kinds)

    def reset(self, key: jax.Array) -> tuple[Observation, PursuitState]:
        """Start an episode of a uniformly drawn task."""
        task_key, reset_key = jax.random.split(key)
        return self.reset_to(reset_key, uniform_task(self.settings, task_key))

    def reset_to(self, key: jax.Array, task: Task) -> tuple[Observation, PursuitState]:
        """Start an episode of `task`; `key` draws the start attitudes and drives random effects."""
        settings = self.settings
        attitude_key, effect_key = jax.random.split(key)
        quaternion = start_attitude(settings, attitude_key)
        drones = jax.vmap(lambda p, q: hover_state(self.vehicle, p, q))(task.pursuer_position, quaternion)
        drones = self._drones_step.reset(self.vehicle, drones, effect_key)
        vehicles = draw_vehicles(
            settings.vehicles,
            jax.random.fold_in(key, 2),
            settings.num_pursuers,
            settings.rare_vehicles,
            self.vehicle_bounds,
        )
        action = jnp.broadcast_to(hover_action(self.vehicle), (settings.num_pursuers, 4))
        own_history = None
        if settings.observe_history:
            own_history = own_frame(drones.quaternion, drones.velocity, action)
            steps = settings.observe_history * settings.observe_history_spacing
            own_history = jnp.broadcast_to(own_history, (steps, *own_history.shape))
        in_sight = line_of_sight(
            settings, task.pursuer_position, task.evader_position, task.pillar_position, task.pillar_active
        )
        seen = jnp.any(in_sight)
        still = jnp.zeros(3, jnp.float32)
        step = jnp.zeros((), jnp.int32)
        middle = jnp.array(settings.middle, jnp.float32)
        first = frame(settings, step, task.pursuer_position, task.evader_position, still, seen)
        frames = jnp.broadcast_to(
            first, (settings.history_length * settings.history_spacing, settings.frame_size)
        )
        state = PursuitState(
            task=task,
            drones=drones,
            vehicles=vehicles,
            evader_position=task.evader_position,
            evader_velocity=still,
            last_seen=jnp.where(seen, task.evader_position, middle),
            in_sight=in_sight,
            frames=frames,
            own_history=own_history,
            previous_action=action,
            step=step,
            statistics=empty_statistics(settings.episode_length),
        )
        return self.observe(state), state

    def with_bounds(self, vehicle_bounds: jax.Array) -> "Pursuit":
        """The same game with vehicles drawn within these bounds (R, 4)."""
        other = copy.copy(self)
        other.vehicle_bounds = vehicle_bounds
        return other

    def observe(self, state: PursuitState) -> Observation:
        """The observation of a state; effects on the sensors act on what a pursuer knows of all pursuers."""
        return self._observe(state, self._seen(state.drones, state.vehicles))

    def _parameters(self, vehicles):
        """Parameters of all effects: those drawn for the episode, and this environment's own, which go first."""
        return {**vehicles, **self.effect_parameters}

    def _seen(self, drones, vehicles):
        return self._drones_step.seen(drones, self._parameters(vehicles))

    def _observe(self, state, seen):
        settings = self.settings
        return observe(
            settings,
            state.step,
            state.drones,
            seen,
            state.own_history[settings.observe_history_spacing - 1 :: settings.observe_history_spacing]
            if settings.observe_history
            else None,
            standard_parameters(settings.vehicles, state.vehicles) if settings.vehicles else None,
            state.evader_position,
            state.evader_velocity,
            state.seen,
            state.last_seen,
            state.frames[self.settings.history_spacing - 1 :: self.settings.history_spacing],
            state.task.pillar_position,
            state.task.pillar_active,
        )

    def step(
        self, key: jax.Array, state: PursuitState, action: jax.Array
    ) -> tuple[Observation, PursuitState, jax.Array, jax.Array, jax.Array, StepInfo]:
        """One control step.

        Args:
            key: for an interface like other environments'; the game itself draws nothing after its reset.
            state: of this step's start.
            action: (N, 4) in -1..1: collective thrust, roll, pitch and yaw rate; see `action_to_command`.

        Returns:
            observation, state, reward (N,), terminated (), truncated (), info.
        """
        del key
        settings, task = self.settings, state.task
        action = jnp.clip(action.astype(jnp.float32), -1.0, 1.0)
        drones = self._drones_step(
            self.vehicle,
            state.drones,
            action_to_command(action),
            task.pillar_position,
            task.pillar_active,
            self._parameters(state.vehicles),
        )
        if settings.speed_limit == "clamp":
            speed = jnp.sqrt(jnp.sum(drones.velocity**2, axis=-1, keepdims=True) + 1e-12)
            drones = drones.replace(velocity=drones.velocity * jnp.minimum(1.0, settings.max_speed / speed))
        return self.follow(state, action, drones)

    def follow(
        self, state: PursuitState, action: jax.Array, drones: DroneState
    ) -> tuple[Observation, PursuitState, jax.Array, jax.Array, jax.Array, StepInfo]:
        """The game's part of a step that began at `state` with `action` and ended with the pursuers as `drones`.

        `step` is physics and this; where the pursuers are flown by something else, real vehicles say, this alone.
        Returns what `step` does.
        """
        settings, task = self.settings, state.task
        pillars = (task.pillar_position, task.pillar_active)
        velocity = evader_velocity(
            settings, state.evader_position, state.drones.position, state.in_sight, *pillars
        )
        evader = state.evader_position + settings.time_step * velocity

        step = state.step + 1
        position = drones.position
        in_sight = line_of_sight(settings, position, evader, *pillars)
        seen = jnp.any(in_sight)
        captured = captures(settings, position, evader, in_sight)
        breach = breaches(settings, position, *pillars)
        too_fast = over_speed(settings, drones.velocity)
        body_z_up = rotation_axes(drones.quaternion)[1][:, 2]
        crash = crashed(settings, position, body_z_up, *pillars)
        distance = jnp.sqrt(jnp.sum((position - evader) ** 2, axis=-1) + 1e-12)
        counted, counted_crash = self._counted(breach, crash, drones, body_z_up, pillars)
        first_crash = crash & ~state.statistics.crashed
        rewards, penalty = reward(
            settings,
            captured,
            distance,
            counted,
            too_fast,
            counted_crash,
            first_crash,
            action,
            state.previous_action,
        )

        seen_drones = self._seen(drones, state.vehicles)
        newest = frame(settings, step, seen_drones.position, evader, velocity, seen)
        own_history = state.own_history
        if settings.observe_history:
            now = own_frame(seen_drones.quaternion, seen_drones.velocity, action)
            own_history = jnp.concatenate([own_history[1:], now[None]])
        state = PursuitState(
            task=task,
            drones=drones,
            vehicles=state.vehicles,
            evader_position=evader,
            evader_velocity=velocity,
            last_seen=jnp.where(seen, evader, state.last_seen),
            in_sight=in_sight,
            frames=jnp.concatenate([state.frames[1:], newest[None]]),
            own_history=own_history,
            previous_action=action,
            step=step,
            statistics=count(state.statistics, step, captured, breach, too_fast, crash, rewards),
        )
        over = step >= settings.episode_length
        never = jnp.zeros((), bool)
        # an observed horizon is part of the task, so its end is terminal; an unobserved one only cuts the episode
        terminated, truncated = (over, never) if settings.observe_time else (never, over)
        info = StepInfo(
            captured=captured, seen=seen, breaches=breach, over_speed=too_fast, crashed=crash, penalty=penalty
        )
        return self._observe(state, seen_drones), state, rewards, terminated, truncated, info

    def _counted(self, breach, crash, drones, body_z_up, pillars):
        """The breaches (N,) and crashes (N,) that the reward counts: those of the metrics, early by margin and lookahead."""
        settings, weights = self.settings, self.settings.reward
        if weights.margin != 0.0:
            breach = breaches(settings, drones.position, *pillars, weights.margin)
            crash = crashed(settings, drones.position, body_z_up, *pillars, weights.margin)
        if weights.lookahead != 0.0:
            ahead = drones.position + weights.lookahead * drones.velocity
            breach = jax.tree.map(jnp.maximum, breach, breaches(settings, ahead, *pillars))
            crash = crash | crashed(settings, ahead, body_z_up, *pillars)
        return breach, crash


def make(settings: PursuitSettings | None = None, **changes) -> Pursuit:
    """An environment. `changes` are fields of `PursuitSettings`: `make(num_pursuers=4, speed_limit="none")`."""
    return Pursuit(dataclasses.replace(settings or PursuitSettings(), **changes))
