"""A policy against the library's scripted evaders, in one program."""

import dataclasses

import jax

from openjax.evaluation.judges.duel import Duel
from openjax.policy import PolicyParameters
from openjax.pursuit import EpisodeStatistics, Pursuit, Task
from openjax.pursuit.evaders import SCRIPTED, draw_evader


def with_scripted(environment: Pursuit) -> Pursuit:
    """The same game with all scripted evaders, each at its place in
    `openjax.pursuit.evaders.SCRIPTED`; not to be called while something is traced.
    """
    settings = dataclasses.replace(environment.settings, evaders=SCRIPTED)
    return dataclasses.replace(environment, settings=settings, evaders=None, dynamics=None)


def fly_scripted(
    duel: Duel, parameters: PolicyParameters, tasks: Task, place: jax.Array, key: jax.Array
) -> EpisodeStatistics:
    """Statistics (B,): an episode of one evader on each of tasks (B, ...).

    Args:
      duel: the game, one of `with_scripted`, and the policy.
      parameters: of the policy.
      tasks: (B, ...)
      place: () int32 in `openjax.pursuit.evaders.SCRIPTED`.
      key: draws attitudes, vehicles and the evaders' numbers.
    """
    game = duel.environment

    def begin(key, task):
        observation, state = game.reset_to(key, task)
        pursuers = task.pursuer_position
        evader = draw_evader(game.settings, jax.random.fold_in(key, 3), pursuers, kind=place)
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
    return jax.lax.scan(one, world, length=game.settings.episode_length)[0][1].statistics
