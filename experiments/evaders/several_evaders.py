"""Several evaders at once: each flees from all pursuers, and each pursuer goes for one
of them.

A world has a state for each evader; the drones are the same in all of them. A pursuer
acts by what it observes in the state of its target, where all others of the team seem
to go for that one, too. Nobody goes for one that is caught.
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int32

from openjax.policy import Policy, PolicyParameters
from openjax.pursuit import EpisodeStatistics, Pursuit, PursuitSettings, Task, uniform_task

Choice = Callable[
    [Float[Array, "drones 3"], Float[Array, "evaders 3"], Bool[Array, " evaders"]],
    Int32[Array, " drones"],
]
"""Positions of pursuers (N, 3) and evaders (M, 3) in m, who of these is free (M,) ->
the target of each pursuer (N,). Where nobody is free, any will do.
"""


def nearest(position, evaders, free):
    """Each goes for the free evader nearest to it."""
    return jnp.argmin(_distances(position, evaders, free), axis=1)


def one_by_one(position, evaders, free):
    """All go for the free evader that is nearest to any of them."""
    first = jnp.argmin(jnp.min(_distances(position, evaders, free), axis=0))
    return jnp.full(position.shape[0], first)


def shared_out(position, evaders, free):
    """As many go for each free evader, up to one, the nearest pairs first."""
    number = position.shape[0]
    # of five pursuers and two evaders, three may go for the one
    share = jnp.ceil(number / jnp.maximum(jnp.sum(free), 1))

    def pair(carry, _):
        target, distance, free = carry
        flat = jnp.argmin(jnp.where(free > 0, distance, jnp.inf))
        pursuer, evader = jnp.divmod(flat, evaders.shape[0])
        target = target.at[pursuer].set(evader)
        distance = distance.at[pursuer].set(jnp.inf)
        return (target, distance, free.at[evader].add(-1.0)), None

    start = (
        jnp.zeros(number, jnp.int32),
        _distances(position, evaders, free),
        jnp.where(free, share, 0.0),
    )
    return jax.lax.scan(pair, start, length=number)[0][0]


def _distances(position, evaders, free):
    """(N, M) m, infinite to those that aren't free."""
    distance = jnp.linalg.norm(position[:, None] - evaders[None], axis=-1)
    return jnp.where(free, distance, jnp.inf)


CHOICES = {"nearest": nearest, "one_by_one": one_by_one, "shared_out": shared_out}
"""Choices by name."""


def several_tasks(settings: PursuitSettings, key: jax.Array, number: int) -> Task:
    """(M, ...) a task for each of M evaders: a uniform one, with the other evaders
    where those of other uniform tasks start. Pillars that one of them would start in
    are left away.
    """
    first, *others = jax.random.split(key, number)
    task = uniform_task(settings, first)
    starts = [task.evader_position]
    starts += [uniform_task(settings, other).evader_position for other in others]
    starts = jnp.stack(starts)
    offset = jnp.linalg.norm(task.pillar_position[:, None] - starts[None, :, :2], axis=-1)
    clear = jnp.all(offset >= settings.pillar_radius + settings.pillar_clearance, axis=1)
    task = task.replace(pillar_active=task.pillar_active & clear)
    return jax.vmap(lambda start: task.replace(evader_position=start))(starts)


@struct.dataclass
class Caught:
    """An episode after several evaders."""

    caught: jax.Array  # (M,) bool
    # (M,) int32, of each capture; the episode's length where there was none
    steps: jax.Array
    pursuers: EpisodeStatistics
    """As in an episode after the first one alone: breaches and crashes are those of the
    whole.
    """


@dataclass(frozen=True, eq=False)
class SeveralEvaders:
    """The game of each evader of a world, the pursuers' policy, and who goes for
    whom.
    """

    environment: Pursuit
    policy: Policy
    choice: Choice

    def fly(self, parameters: PolicyParameters, tasks: Task, key: jax.Array) -> Caught:
        """One episode of a world's M tasks (M, ...), which differ in their evaders
        alone; to be mapped over worlds and compiled by the caller. `key` draws what a
        reset draws, and evaders, each on its own.
        """
        game = self.environment
        number = tasks.evader_position.shape[0]
        if tasks.evader is None:
            kinds = jax.random.randint(
                jax.random.fold_in(key, 1), (number,), 0, len(game.evader_rows)
            )
            tasks = tasks.replace(evader=kinds)
        # one key, as all have the same drones
        world = jax.vmap(game.reset_to, in_axes=(None, 0))(key, tasks)
        length = game.settings.episode_length
        which = jnp.arange(game.settings.num_pursuers)

        follow = jax.vmap(game.follow, in_axes=(0, None, None))

        def one(world, _):
            observation, state = world
            free = ~state.statistics.captured
            first = jax.tree.map(lambda leaf: leaf[0], state)
            target = self.choice(first.drones.position, state.evader_position, free)
            action = self.policy.act(parameters, observation)[target, which]
            action = jnp.clip(action, -1.0, 1.0)
            observation, state, *_ = follow(state, action, game.move(first, action))
            return (observation, state), None

        statistics = jax.lax.scan(one, world, length=length)[0][1].statistics
        return Caught(
            caught=statistics.captured,
            steps=statistics.capture_step,
            pursuers=jax.tree.map(lambda leaf: leaf[0], statistics),
        )
