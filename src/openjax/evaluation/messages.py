"""A team whose messages are lost or late: each pursuer flies the policy by what it
believes.

A pursuer knows where it is itself, what it sees, and of the others what it was told
last, and when. It takes the teammates to have flown on as they told, as a tenth of a
second is a hand's breadth. The evader it takes to be where it saw it, or where the
newest report has it; without a report in this step the evader counts as hidden. So each
has its own view of the world, in which the policy acts for it alone. With perfect
messages all views are the same, and those of a game in which what one sees is seen by
all.
"""

import functools
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from flax import struct

from openjax.evaluation.message_settings import MessageSettings
from openjax.pursuit import Observation, Pursuit, PursuitState
from openjax.pursuit.hiding import thought_place
from openjax.pursuit.observation import frame, frame_pursuers

COAST = 0.3
"""Seconds for which a teammate that isn't heard of is taken to fly on as it told: about
twice the time in which a vehicle turns its velocity round.
"""


@struct.dataclass
class Sent:
    """The messages that the N pursuers of a world send in a step."""

    position: jax.Array  # (N, 3) m, their own
    velocity: jax.Array  # (N, 3) m/s, their own
    sees: jax.Array  # (N,) bool, whether the evader is in it
    evader: jax.Array  # (3,) m
    evader_velocity: jax.Array  # (3,) m/s
    step: jax.Array  # () int32


@struct.dataclass
class Beliefs:
    """The beliefs of each of the N pursuers about its world."""

    # (N, N, 3) m, where each pursuer (second axis) was when it told
    position: jax.Array
    velocity: jax.Array  # (N, N, 3) m/s, at that time
    told_step: jax.Array  # (N, N) int32, the step of that time
    evader: jax.Array  # (N, 3) m, by the newest report
    evader_velocity: jax.Array  # (N, 3) m/s
    report_step: jax.Array  # (N,) int32, the step of that report; -1: none yet
    seen: jax.Array  # (N,) bool, whether there was one in this step
    last_seen: jax.Array  # (N, 3) m
    frames: jax.Array  # (N, H, F)
    on_the_way: Sent
    """(D, ...) what is sent in the last D steps, oldest first"""


@dataclass(frozen=True)
class Hearsay:
    """The messages of one world's pursuers, as pure functions to be mapped."""

    settings: MessageSettings
    environment: Pursuit

    @property
    def delay(self) -> int:
        """Control steps by which messages are late."""
        return round(self.settings.late / self.environment.settings.time_step)

    def start(self, state: PursuitState) -> Beliefs:
        """At an episode's start all know where all start, and who sees the evader tells
        it.
        """
        number = state.drones.position.shape[0]

        def each(leaf):
            return jnp.broadcast_to(leaf, (number, *leaf.shape))

        # as if all had said the same since long before
        on_the_way = jax.tree.map(
            lambda leaf: jnp.broadcast_to(leaf, (self.delay, *leaf.shape)), _reports(state)
        )
        return Beliefs(
            position=each(state.drones.position),
            velocity=each(state.drones.velocity),
            told_step=jnp.broadcast_to(state.step, (number, number)),
            evader=each(state.evader_position),
            evader_velocity=each(state.evader_velocity),
            report_step=jnp.where(each(state.seen), state.step, -1),
            seen=each(state.seen),
            last_seen=each(state.last_seen),
            frames=each(state.frames),
            on_the_way=on_the_way,
        )

    def update(self, beliefs: Beliefs, state: PursuitState, key: jax.Array) -> Beliefs:
        """Beliefs after a step that ended with `state`; `key` draws which messages are
        lost.
        """
        number = state.drones.position.shape[0]
        reports = _reports(state)
        # what is on the way as a queue: a new report joins it, the oldest one arrives
        line = jax.tree.map(
            lambda old, new: jnp.concatenate([old, new[None]]), beliefs.on_the_way, reports
        )
        arriving = jax.tree.map(lambda leaf: leaf[0], line)
        # (N, N): row by row what each pursuer hears of each
        is_itself = jnp.eye(number, dtype=bool)
        # each pair draws for itself: a report that one misses may reach another
        arrives = jax.random.uniform(key, (number, number)) >= self.settings.lost
        arrives &= ~is_itself
        # a report counts that is newer than what one knows, and one's own eyes before
        # any report
        has_report = jnp.any(arrives & arriving.sees, axis=-1)
        has_report &= arriving.step > beliefs.report_step
        sees = state.sees

        def newest(by_itself, by_report, by_belief):
            by_message = jnp.where(has_report[:, None], by_report, by_belief)
            return jnp.where(sees[:, None], by_itself, by_message)

        evader = newest(reports.evader, arriving.evader, beliefs.evader)
        velocity = newest(
            reports.evader_velocity, arriving.evader_velocity, beliefs.evader_velocity
        )
        report_step = jnp.where(has_report, arriving.step, beliefs.report_step)
        has_sight = sees | has_report
        beliefs = _with_teammates(beliefs, reports, arriving, arrives)
        thought = jax.vmap(functools.partial(self._thought, state))(
            beliefs.replace(on_the_way=None)
        )
        beliefs = beliefs.replace(
            evader=evader,
            evader_velocity=velocity,
            report_step=jnp.where(sees, state.step, report_step),
            seen=has_sight,
            last_seen=jnp.where(has_sight[:, None], evader, thought),
            on_the_way=jax.tree.map(lambda leaf: leaf[1:], line),
        )
        return beliefs.replace(frames=self._frames(beliefs, state))

    def _place(self, belief, step):
        """(N, 3) m, where one pursuer takes all to be at a step ()."""
        age = (step - belief.told_step) * self.environment.settings.time_step
        # who hasn't been heard for long has turned by now, so it isn't led on for ever
        return belief.position + belief.velocity * jnp.minimum(age, COAST)[..., None]

    def _thought(self, state, belief):
        """(3,) m, where one pursuer takes an evader to be that it knows nothing of."""
        drones = state.drones.replace(position=self._place(belief, state.step))
        game = self.environment.settings
        return thought_place(game, state.task, drones, state.active, belief.last_seen)

    def _frames(self, beliefs, state):
        settings = self.environment.settings

        def newest(belief):
            place = self._place(belief, state.step)
            own_frame = frame_pursuers(settings, place, belief.last_seen, state.active)
            return frame(
                settings, state.step, own_frame, belief.evader, belief.evader_velocity, belief.seen
            )

        # what is on the way has another leading axis than the pursuers'
        frames = jax.vmap(newest)(beliefs.replace(on_the_way=None))
        return jnp.concatenate([beliefs.frames[:, 1:], frames[:, None]], axis=1)

    def observations(self, beliefs: Beliefs, state: PursuitState) -> Observation:
        """The observations of each pursuer in its own view: (N, ...) of one pursuer each."""

        def view(i, belief):
            place = self._place(belief, state.step)
            world = state.replace(
                drones=state.drones.replace(position=place),
                evader_position=belief.evader,
                evader_velocity=belief.evader_velocity,
                in_sight=jnp.broadcast_to(belief.seen, state.in_sight.shape),
                in_view=None,
                last_seen=belief.last_seen,
                frames=belief.frames,
            )
            return _of_one(self.environment.observe(world), i)

        number = beliefs.seen.shape[0]
        return jax.vmap(view)(jnp.arange(number), beliefs.replace(on_the_way=None))


def _with_teammates(beliefs, reports, arriving, arrives):
    """Beliefs after messages (N, N) of who `arrives`, and what each knows of itself."""
    is_itself = jnp.eye(len(arrives), dtype=bool)

    def merge(by_itself, by_message, by_belief):
        axes = (..., *[None] * (by_belief.ndim - 2))
        told_by_all = jnp.where(arrives[axes], by_message, by_belief)
        return jnp.where(is_itself[axes], by_itself, told_by_all)

    return beliefs.replace(
        position=merge(reports.position, arriving.position, beliefs.position),
        velocity=merge(reports.velocity, arriving.velocity, beliefs.velocity),
        told_step=merge(reports.step, arriving.step, beliefs.told_step),
    )


def _reports(state):
    return Sent(
        position=state.drones.position,
        velocity=state.drones.velocity,
        sees=state.sees,
        evader=state.evader_position,
        evader_velocity=state.evader_velocity,
        step=state.step,
    )


WHOLE = ("last_seen", "frames", "strategy")
"""Fields of an observation that a team has in common; a team that draws has agreed on its
draws before the game.
"""


def _of_one(observation, i):
    """The observation of pursuer i alone, which keeps the pursuers' axis."""
    each = observation.replace(**dict.fromkeys(WHOLE))
    of_one = jax.tree.map(lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, i, 1), each)
    return of_one.replace(**{name: getattr(observation, name) for name in WHOLE})
