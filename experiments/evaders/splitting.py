"""Evaders by splitting: many copies of an episode, in which those that are caught
become copies of those that aren't.

Each copy's evader flies straight on, turns a little, or turns anywhere, at random;
after every piece the caught take over the whole world of a free one. What is left at
the end is an escape that a determined evader could have flown, since a policy's mean
answers the same each time. There is no network, no gradient, no horizon and no model of
what is good but to be free: it shares neither code nor ideas with the learners and the
planner. It is kept for the last word on weights that are done.

Splitting of rare events: Kahn and Harris, 1951; Aldous and Vazirani, "Go with the
winners", 1994.
"""

from dataclasses import dataclass
from typing import Annotated

import jax
import jax.numpy as jnp

from openjax.policy import Policy, PolicyParameters
from openjax.pursuit import EpisodeStatistics, Pursuit, PursuitState, Task
from openjax.ranges import Interval, check_intervals

TOGETHER = 32
"""Tasks that are flown side by side."""


@dataclass(frozen=True)
class SplittingSettings:
    """How many copies an evader by splitting has, and how they turn."""

    copies: Annotated[int, Interval("[2, 1000000]")] = 1024
    """Of each episode."""
    piece_steps: Annotated[int, Interval("[1, 1000]")] = 10
    """Control steps between two turns: .1 s, in which an evader moves 13 cm."""
    straight_on: Annotated[float, Interval("[0, 1]")] = 0.7
    """Odds of flying on as before."""
    small_turn: Annotated[float, Interval("[0, 1]")] = 0.25
    """Odds of a turn by some `turn`; else it's anywhere."""
    turn: Annotated[float, Interval("[0, 10]")] = 0.2
    """Of a small turn, radians."""

    def __post_init__(self):
        check_intervals(self)


@dataclass(frozen=True, eq=False)
class Splitting:
    """Splitting against the mean of a policy in its game."""

    settings: SplittingSettings
    environment: Pursuit
    policy: Policy

    def fly(self, parameters: PolicyParameters, tasks: Task, key: jax.Array) -> EpisodeStatistics:
        """Statistics (B,) of the copy that was free the longest, for each of tasks (B,
        ...).
        """
        keys = jax.random.split(key, tasks.evader_position.shape[0])
        # one task at a time would leave an accelerator idle, all at once need too much
        # memory
        return jax.lax.map(
            lambda inputs: self._fly_one(parameters, *inputs), (tasks, keys), batch_size=TOGETHER
        )

    def _fly_one(self, parameters, task, key):
        """Statistics () of the best copy of one task."""
        copies = self.settings.copies
        start_key, heading_key, pieces_key = jax.random.split(key, 3)
        world = self.environment.reset_to(start_key, task)
        worlds = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (copies, *leaf.shape)), world)
        heading = _directions(heading_key, copies)

        def piece(carry, key):
            worlds, heading = carry
            turn_key, split_key = jax.random.split(key)
            heading = self._turn(turn_key, heading)
            worlds = self._fly_piece(parameters, worlds, heading)
            source = sources(split_key, worlds[1])
            return jax.tree.map(lambda leaf: leaf[source], (worlds, heading)), None

        length = self.environment.settings.episode_length // self.settings.piece_steps
        keys = jax.random.split(pieces_key, length)
        (_, state), _ = jax.lax.scan(piece, (worlds, heading), keys)[0]
        statistics = state.statistics
        # the game's length where it isn't caught; of those caught together the last
        longest = statistics.capture_step + ~statistics.captured
        return jax.tree.map(lambda leaf: leaf[jnp.argmax(longest)], statistics)

    def _turn(self, key, heading):
        """(C, 3) unit vectors after a turn of each of (C, 3)."""
        settings = self.settings
        odds_key, small_key, far_key = jax.random.split(key, 3)
        odds = jax.random.uniform(odds_key, (len(heading), 1))
        small = heading + settings.turn * jax.random.normal(small_key, heading.shape)
        small = small / jnp.linalg.norm(small, axis=-1, keepdims=True)
        other = jnp.where(
            odds < settings.straight_on + settings.small_turn,
            small,
            _directions(far_key, len(heading)),
        )
        return jnp.where(odds < settings.straight_on, heading, other)

    def _fly_piece(self, parameters, worlds, heading):
        """Worlds (C, ...) after a piece in which each evader flies along its heading
        (C, 3).
        """
        step = jax.vmap(self.environment.step, in_axes=(None, 0, 0, 0))
        # a game of the library draws nothing after its reset
        nothing = jax.random.key(0)

        def one(worlds, _):
            observation, state = worlds
            action = self.policy.act(parameters, observation)
            observation, state, *_ = step(nothing, state, action, heading)
            return (observation, state), None

        return jax.lax.scan(one, worlds, length=self.settings.piece_steps)[0]


def _directions(key, number):
    """(number, 3) unit vectors, uniform over the sphere."""
    vector = jax.random.normal(key, (number, 3))
    return vector / jnp.linalg.norm(vector, axis=-1, keepdims=True)


def sources(key: jax.Array, state: PursuitState) -> jax.Array:
    """(C,) which of the copies (C, ...) each goes on as: a free one as itself, a caught
    one as the better of two free ones; all as they are where none is free.
    """
    free = ~state.statistics.captured
    copies = free.size
    offset = state.drones.position - state.evader_position[:, None]
    room = jnp.min(jnp.linalg.norm(offset, axis=-1), axis=-1)
    # minus infinity for those that are caught: they are never drawn
    odds = jnp.log(free.astype(jnp.float32))
    pairs = jax.random.categorical(key, odds, shape=(copies, 2))
    better = jnp.where(room[pairs[:, 0]] >= room[pairs[:, 1]], pairs[:, 0], pairs[:, 1])
    itself = jnp.arange(copies)
    return jnp.where(free | ~jnp.any(free), itself, better)
