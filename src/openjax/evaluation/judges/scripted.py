"""A policy against the library's scripted evaders, in one program."""

import dataclasses

import jax

from openjax.evaluation.judges.duel import Duel
from openjax.policy import PolicyParameters
from openjax.pursuit import EpisodeStatistics, Task
from openjax.pursuit.evaders import SCRIPTED, draw_evader


def fly_scripted(
    duel: Duel,
    parameters: PolicyParameters,
    tasks: Task,
    place: jax.Array,
    key: jax.Array,
) -> EpisodeStatistics:
    """Statistics (B,): an episode of one evader on each of tasks (B, ...).

    Args:
      duel: the game, whose own evaders don't fly, and the policy.
      parameters: of the policy.
      tasks: (B, ...)
      place: () int32 in `openjax.pursuit.evaders.SCRIPTED`.
      key: draws attitudes, vehicles and the evaders' numbers.
    """
    settings = dataclasses.replace(duel.environment.settings, evaders=SCRIPTED)
    game = dataclasses.replace(duel.environment, settings=settings, evaders=None, dynamics=None)

    def begin(key, task):
        observation, state = game.reset_to(key, task)
        pursuers = task.pursuer_position
        evader = draw_evader(settings, jax.random.fold_in(key, 3), pursuers, kind=place)
        return observation, state.replace(evader=evader)

    def step(state, action):
        # one place for all worlds, so that no other evader is worked out
        state = state.replace(evader=state.evader.replace(kind=place))
        return game.step(key, state, action)

    def one(world, _):
        observation, state = world
        action = duel.policy.act(parameters, observation)
        observation, state, *_ = jax.vmap(step)(state, action)
        return (observation, state), None

    keys = jax.random.split(key, tasks.evader_position.shape[0])
    world = jax.vmap(begin)(keys, tasks)
    return jax.lax.scan(one, world, length=settings.episode_length)[0][1].statistics
