"""The environment: reset and step as pure functions of arrays."""

import dataclasses
import functools
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import chex
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from openjax.errors import UserError
from openjax.pursuit.arguments import check_action, check_key
from openjax.pursuit.axes import rotation_axes
from openjax.pursuit.collisions import breaches, crashed
from openjax.pursuit.evaders import (
    Evader,
    EvaderKind,
    draw_row,
    evader_rows,
    evader_velocity,
    handed_in,
)
from openjax.pursuit.hiding import thought_place
from openjax.pursuit.info import StepInfo
from openjax.pursuit.observation import Observation, frame, frame_pursuers, observe, own_frame
from openjax.pursuit.reward import (
    Term,
    Transition,
    captures,
    check_terms,
    default_reward,
    over_speed,
    total_reward,
)
from openjax.pursuit.sensing import line_of_sight, within_view
from openjax.pursuit.settings import PursuitSettings
from openjax.pursuit.shapes import Actions, Active, Commands, Each, Flag, Pillars, Scalar, Vector
from openjax.pursuit.shortest_paths import shortest_paths
from openjax.pursuit.spaces import Box
from openjax.pursuit.state import PursuitState
from openjax.pursuit.statistics import count, empty_statistics
from openjax.pursuit.task import Task, arena_of, start_attitude, uniform_task
from openjax.pursuit.teams import draw_fall_out, draw_strategies, held, still_there
from openjax.ranges import changed
from openjax.vehicle import (
    DroneState,
    Vehicle,
    hover_share,
    hover_state,
    load_vehicle,
    make_drones_step,
)
from openjax.vehicle.family import draw_vehicles, family_effects
from openjax.vehicle.vectors import length

THRUST_LIMIT = 0.9
"""The commanded thrust is cut here, as a fraction of the maximum (the paper's simulator
does so).
"""


def hover_action(vehicle: Vehicle) -> Float[Array, "4"]:
    """(4,) action [thrust, roll, pitch, yaw rate] in -1..1 that hovers."""
    return jnp.zeros(4, jnp.float32).at[0].set(2.0 * hover_share(vehicle) - 1.0)


def action_to_command(action: Float[Array, "*drones 4"]) -> Float[Array, "*drones 4"]:
    """(..., 4) action in -1..1 to command: collective thrust 0..0.9 of the maximum,
    body rates up to pi rad/s.
    """
    action = jnp.clip(action, -1.0, 1.0)
    thrust = jnp.minimum(0.5 * (action[..., :1] + 1.0), THRUST_LIMIT)
    return jnp.concatenate([thrust, jnp.pi * action[..., 1:]], axis=-1)


@runtime_checkable
class Dynamics(Protocol):
    """The motion of the pursuers: `openjax.vehicle.DronesStep`, or a world outside."""

    def reset(self, vehicle: Vehicle, drones: DroneState, key: PRNGKeyArray) -> DroneState:
        """The drones (leading axis N) at the start of an episode."""

    def __call__(
        self,
        vehicle: Vehicle,
        drones: DroneState,
        command: Commands,
        pillar_position: Pillars,
        pillar_active: Active,
        effect_parameters: dict,
    ) -> DroneState:
        """The drones a control step later; see `openjax.vehicle.DronesStep`."""

    def seen(self, drones: DroneState, effect_parameters: dict) -> DroneState:
        """The drones as their sensors tell."""


@runtime_checkable
class Observer(Protocol):
    """The observation of the pursuers; `openjax.pursuit.observe` is the game's own."""

    def __call__(
        self, settings: PursuitSettings, state: PursuitState, seen_drones: DroneState
    ) -> Observation:
        """The observation of all N pursuers; `seen_drones` is what sensors tell of
        them. The shapes of `self_state`, `others`, `pillars` and `privileged` are free
        but for N.
        """


@dataclass(frozen=True, eq=False)
class Pursuit:
    """Pursuit-evasion by N quadrotors, as pure functions: map them with `jax.vmap`,
    compile them with `jax.jit`.
    """

    settings: PursuitSettings | None = None
    """The game; None: the paper's."""
    vehicle: Vehicle | None = None
    """The pursuers' vehicle; None: the nominal one of the settings' airframe."""
    effects: tuple[str, ...] = ()
    """Names of physical effects to fly with (`openjax.vehicle.effects`)."""
    effect_parameters: dict | None = None
    """Their parameters, {effect: {parameter: value}}."""
    vehicle_bounds: jax.Array | None = None
    """(R, 4) bounds of `settings.vehicles` that go before those written there."""
    evader_share: jax.Array | None = None
    """() from 0 to 1, how far a curriculum over `settings.evaders` has come; None is 1.
    See `openjax.pursuit.evaders`.
    """
    dynamics: Dynamics | None = None
    """The dynamics of the pursuers; None: the physics that the settings name, with the
    effects.
    """
    evaders: tuple[Evader, ...] | None = None
    """The evaders, one of them in each episode: names, rows, or functions of one's
    own (`openjax.pursuit.evaders.EvaderKind`); they go before those that the settings
    name. None: these.
    """
    reward: tuple[Term, ...] | None = None
    """The reward's terms; None: `openjax.pursuit.default_reward(settings.reward)`."""
    observer: Observer | None = None
    """The pursuers' observation; None: `openjax.pursuit.observe`."""

    def __post_init__(self):
        settings = self.settings or PursuitSettings()
        evaders = self.evaders
        if evaders is not None:
            names, rows = handed_in(evaders)
            settings = dataclasses.replace(settings, evaders=names)
            evaders = evaders if rows else None  # names alone are the settings'
        complete = {
            "evaders": evaders,
            "settings": settings,
            "vehicle": load_vehicle(settings.airframe) if self.vehicle is None else self.vehicle,
            "effects": tuple(self.effects),
            "reward": None if self.reward is None else check_terms(self.reward),
            "effect_parameters": self.effect_parameters or {},
            "dynamics": self.dynamics
            or make_drones_step(
                physics=settings.physics,
                dt=settings.time_step,
                substeps=settings.substeps,
                effects=(*family_effects(settings.vehicles), *self.effects),
                contacts=settings.contacts,
                arena=settings.arena,
            ),
        }
        for name, value in complete.items():
            # the one moment at which a frozen object is filled
            object.__setattr__(self, name, value)
        _ = self.evader_rows  # raises where settings name one that isn't here

    @property
    def _handed_in(self) -> tuple[EvaderKind, ...]:
        return () if self.evaders is None else handed_in(self.evaders)[1]

    @property
    def evader_rows(self) -> tuple[EvaderKind, ...]:
        """The row of each of `settings.evaders`."""
        return evader_rows(self.settings.evaders, self._handed_in)

    @property
    def terms(self) -> tuple[Term, ...]:
        """The reward's terms."""
        return default_reward(self.settings.reward) if self.reward is None else self.reward

    @property
    def action_space(self) -> Box:
        """Actions (N, 4) of all pursuers: collective thrust, roll, pitch and yaw rate,
        in -1..1.
        """
        return Box(-1.0, 1.0, (self.settings.num_pursuers, 4))

    @property
    def observation_space(self) -> Observation:
        """An `Observation` whose leaves are the boxes of its arrays."""
        kinds = jax.eval_shape(lambda key: self.reset(key)[0], jax.random.key(0))
        return jax.tree.map(lambda kind: Box(-jnp.inf, jnp.inf, kind.shape, kind.dtype), kinds)

    def reset(self, key: PRNGKeyArray) -> tuple[Observation, PursuitState]:
        """Start an episode of a uniformly drawn task.

        Args:
          key: () typed key; map over (B,) of them for B worlds.

        Returns:
          observation, state, both of one world.

        Raises:
          UserError: `key` is no single key.
        """
        check_key("reset", key)
        task_key, reset_key = jax.random.split(key)
        return self.reset_to(reset_key, uniform_task(self.settings, task_key))

    def reset_to(self, key: PRNGKeyArray, task: Task) -> tuple[Observation, PursuitState]:
        """Start an episode of `task`.

        Args:
          key: () typed key; draws start attitudes and vehicles and drives random
          effects.
          task: with the settings' number of pursuers and pillar slots.

        Returns:
          observation, state, both of one world.
        """
        check_key("reset_to", key)
        settings = arena_of(self.settings, task)
        task = task.with_starts(task.pursuer_position)
        chex.assert_shape(task.pursuer_position, (settings.num_pursuers, 3))
        chex.assert_shape(task.evader_position, (3,))
        chex.assert_shape(task.pillar_position, (*task.pillar_active.shape, 2))
        # each draw has a key of its own, so that one that is added changes no other
        attitude_key, effect_key = jax.random.split(key)
        vehicle_key, evader_key, fall_out_key, strategy_key = (
            jax.random.fold_in(key, i) for i in (2, 3, 4, 5)
        )
        quaternion = start_attitude(settings, attitude_key)
        hovering = functools.partial(hover_state, self.vehicle)
        drones = jax.vmap(hovering)(task.pursuer_position, quaternion)
        drones = self.dynamics.reset(self.vehicle, drones, effect_key)
        action = jnp.broadcast_to(hover_action(self.vehicle), (settings.num_pursuers, 4))
        in_sight, in_view, seen = self._sights(task, task.active, drones, task.evader_position)
        rest = jnp.zeros(3, jnp.float32)
        step = jnp.zeros((), jnp.int32)
        # an evader that nobody has seen yet is taken to be amid the arena, which is
        # nearest to wherever it may be
        last_seen = jnp.where(seen, task.evader_position, jnp.array(settings.middle, jnp.float32))
        places = frame_pursuers(settings, task.pursuer_position, last_seen, task.active)
        first = frame(settings, step, places, task.evader_position, rest, seen)
        state = PursuitState(
            task=task,
            drones=drones,
            vehicles=self._draw_vehicles(vehicle_key),
            evader_position=task.evader_position,
            evader_velocity=rest,
            evader=self._draw_evader(evader_key, task),
            last_seen=last_seen,
            in_sight=in_sight,
            # the history before the start is the start, as if all had waited there
            frames=_repeat(first, settings.history_length * settings.history_spacing),
            own_history=self._first_own_history(drones, action),
            previous_action=action,
            step=step,
            statistics=empty_statistics(settings.episode_length),
            gone_after=draw_fall_out(settings, fall_out_key, task.active),
            in_view=in_view,
            paths=shortest_paths(settings, task) if settings.reward.needs_paths else None,
            strategies=draw_strategies(settings, strategy_key),
        )
        return self.observe(state), state

    def _draw_vehicles(self, key):
        """The pursuers' vehicles of an episode."""
        settings = self.settings
        return draw_vehicles(
            settings.vehicles,
            key,
            settings.num_pursuers,
            settings.rare_vehicles,
            self.vehicle_bounds,
        )

    def _draw_evader(self, key, task):
        """The evader of an episode; the one that the task names, where it names one."""
        rows = self.evader_rows
        return draw_row(rows, key, task.pursuer_position, self.evader_share, task.evader)

    def _first_own_history(self, drones, action):
        """The pursuers' memory of themselves at the start; None if it isn't observed."""
        settings = self.settings
        if not settings.observe_history:
            return None
        first = own_frame(drones.quaternion, drones.velocity, action)
        return _repeat(first, settings.observe_history * settings.history_spacing)

    def with_bounds(self, vehicle_bounds: Float[Array, "ranges 4"]) -> "Pursuit":
        """The same game with vehicles drawn within these bounds (R, 4)."""
        return dataclasses.replace(self, vehicle_bounds=vehicle_bounds)

    def with_evader_share(self, share: Scalar) -> "Pursuit":
        """The same game at this share () of its curriculum over evaders."""
        return dataclasses.replace(self, evader_share=share)

    def observe(self, state: PursuitState) -> Observation:
        """The observation of a state; effects on the sensors act on what a pursuer
        knows of all pursuers.
        """
        return self._observe(state, self._see(state.drones, state.vehicles))

    def _observe(self, state, seen_drones):
        return (self.observer or observe)(self.settings, state, seen_drones)

    def _parameters(self, vehicles):
        """Parameters of all effects: those drawn for the episode, and this
        environment's own, which go first.
        """
        return {**vehicles, **self.effect_parameters}

    def _active_after(self, state):
        """(N,) which slots are in use after a step that begins with `state`; None: all
        are.
        """
        if state.gone_after is None:
            return state.active
        return still_there(state.task.active, state.gone_after, state.step + 1)

    def _in_sight(self, task, active, position, evader):
        """(N,) which of the pursuers at (N, 3) see the evader at (3,)."""
        sees = line_of_sight(
            self.settings, position, evader, task.pillar_position, task.pillar_active
        )
        return sees if active is None else sees & active

    def _sights(self, task, active, drones, evader):
        """(N,) to whom of the drones nothing hides the evader at (3,), (N,) who also
        looks its way (None: looking isn't part of the game), and () whether somebody
        sees it.
        """
        in_sight = self._in_sight(task, active, drones.position, evader)
        in_view = self._in_view(in_sight, drones, evader)
        return in_sight, in_view, jnp.any(in_sight if in_view is None else in_view)

    def _in_view(self, in_sight, drones, evader):
        """(N,) which of those in sight have the evader at (3,) in view; None: all of
        them.
        """
        if not self.settings.limited_sight:
            return None
        ahead = rotation_axes(drones.quaternion)[0]
        return in_sight & within_view(self.settings, drones.position, ahead, evader)

    def _see(self, drones, vehicles):
        return self.dynamics.seen(drones, self._parameters(vehicles))

    def step(
        self,
        key: PRNGKeyArray | None,
        state: PursuitState,
        action: Actions,
        wish: Vector | None = None,
    ) -> tuple[Observation, PursuitState, Each, Flag, Flag, StepInfo]:
        """One control step.

        Args:
          key: for an interface like other environments'; the game itself draws nothing
          after its reset, and None will do.
          state: of this step's start.
          action: (N, 4) in -1..1: collective thrust, roll, pitch and yaw rate; see
          `action_to_command`.
          wish: (3,) where an evader from outside flies, as a share of its speed (at
          most length one); None or NaN: its own rule.

        Returns:
          observation, state, reward (N,), terminated (), truncated (), info.

        Raises:
          UserError: `action` has another shape.
        """
        del key
        check_action(action, self.settings.num_pursuers)
        action = jnp.clip(jnp.asarray(action, jnp.float32), -1.0, 1.0)
        return self.follow(state, action, self.move(state, action), wish)

    def move(self, state: PursuitState, action: Actions) -> DroneState:
        """The pursuers (leading axis N) a control step after `state`, in which they fly
        `action` (N, 4) in -1..1: the part of `step` that is physics.
        """
        settings = self.settings
        task = state.task
        check_action(action, settings.num_pursuers, "move(state, action)")
        drones = self.dynamics(
            self.vehicle,
            state.drones,
            action_to_command(action),
            task.pillar_position,
            task.pillar_active,
            self._parameters(state.vehicles),
        )
        if settings.speed_limit == "clamp":
            # as the paper's simulator does; the small number keeps the root's gradient
            # finite
            speed = length(drones.velocity, keepdims=True)
            drones = drones.replace(
                velocity=drones.velocity * jnp.minimum(1.0, settings.max_speed / speed)
            )
        return held(self._active_after(state), drones)

    def follow(
        self, state: PursuitState, action: Actions, drones: DroneState, wish: Vector | None = None
    ) -> tuple[Observation, PursuitState, Each, Flag, Flag, StepInfo]:
        """The game's part of a step that began at `state` with `action` and ended with
        the pursuers as `drones`.

        `step` is `move` and this; where the pursuers are flown by something else, real
        vehicles say, this alone. Returns what `step` does.
        """
        settings = arena_of(self.settings, state.task)
        old = state
        # the evader answers to the pursuers as they were at the step's start, while
        # they moved
        velocity, evader_state = evader_velocity(settings, self.evader_rows, old, wish)
        evader = old.evader_position + settings.time_step * velocity
        step = old.step + 1
        active = self._active_after(old)
        in_sight, in_view, seen = self._sights(old.task, active, drones, evader)
        seen_drones = self._see(drones, old.vehicles)
        thought = thought_place(settings, old.task, seen_drones, active, old.last_seen)
        last_seen = jnp.where(seen, evader, thought)
        places = frame_pursuers(settings, seen_drones.position, last_seen, active)
        newest = frame(settings, step, places, evader, velocity, seen)
        own_history = old.own_history
        if settings.observe_history:
            newest_own = own_frame(seen_drones.quaternion, seen_drones.velocity, action)
            own_history = _with_newest(own_history, newest_own)
        state = old.replace(
            drones=drones,
            evader_position=evader,
            evader_velocity=velocity,
            evader=evader_state,
            last_seen=last_seen,
            in_sight=in_sight,
            in_view=in_view,
            frames=_with_newest(old.frames, newest),
            own_history=own_history,
            previous_action=action,
            step=step,
        )
        info, rewards = self._outcome(old, state, active)
        state = state.replace(statistics=count(old.statistics, step, info, rewards, active))
        terminated, truncated = self._end(step)
        return (self._observe(state, seen_drones), state, rewards, terminated, truncated, info)

    def _outcome(self, start, state, active):
        """The outcome of a step from `start` to `state` for the slots that are `active`, and its
        rewards.
        """
        info = self._events(state).of_team(active)
        settings = arena_of(self.settings, state.task)
        transition = Transition(settings, start, state, info)
        rewards, penalty = total_reward(self.terms, transition)
        return info.replace(penalty=penalty), rewards

    def _events(self, state):
        """The events of the step that ended with `state`, without the penalties."""
        task = state.task
        settings = arena_of(self.settings, task)
        drones = state.drones
        position = drones.position
        pillars = task.pillar_position
        pillar_active = task.pillar_active
        body_z_up = rotation_axes(drones.quaternion)[1][:, 2]
        return StepInfo(
            captured=captures(
                settings, position, state.evader_position, state.in_sight, task.capture_radius
            ),
            seen=state.seen,
            breaches=breaches(settings, position, pillars, pillar_active),
            over_speed=over_speed(settings, drones.velocity),
            crashed=crashed(settings, position, body_z_up, pillars, pillar_active),
            # known after the reward, whose terms are given the rest of this
            penalty=jnp.zeros(settings.num_pursuers, jnp.float32),
        )

    def _end(self, step):
        """() whether the episode ends for good with this step, and whether it is cut.

        An observed horizon is part of the task, so its end is terminal; an unobserved
        one only cuts the episode.
        """
        over = step >= self.settings.episode_length
        no_time_limit = jnp.zeros((), bool)
        return (over, no_time_limit) if self.settings.observe_time else (no_time_limit, over)


def _repeat(first, number):
    """A history (number, ...) of the same moment."""
    return jnp.broadcast_to(first, (number, *first.shape))


def _with_newest(history, newest):
    """A history, oldest first, that has moved on by one."""
    return jnp.concatenate([history[1:], newest[None]])


def make(
    settings: PursuitSettings | None = None, evader: Evader | None = None, **changes
) -> Pursuit:
    """An environment.

    Args:
      settings: the game; None is the paper's.
      evader: a name in `openjax.pursuit.evaders.EVADERS`, short for `evaders=(name,)`;
      a row, or a function of one's own.
      changes: fields of `PursuitSettings`, as `reward=dict(crash=20.0)`.

    Raises:
      UserError: no such setting, a value that it can't have, an evader that nobody
        knows, or the learned one, which is more than a name.
    """
    if evader == "learned":
        raise UserError(
            "evader learned: a name isn't enough; a file of openjax exploit is the opponent= of "
            "openjax.evaluate, the --opponent of commands"
        )
    game = changed(settings or PursuitSettings(), **changes)
    return Pursuit(game, evaders=None if evader is None else (evader,))
