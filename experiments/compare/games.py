"""Pursuit games and their training: JaxMARL's simple_tag with its MAPPO baseline, and ours."""

import dataclasses
import functools
from collections.abc import Iterator

import jax
import jax.numpy as jnp

from experiments.compare import jaxmarl_mappo
from experiments.compare.case import Case
from openjax.learning import init_carry, make_training_step, preset
from openjax.pursuit import Pursuit, PursuitSettings, hover_action

TASK = "MPE_simple_tag_v3"


def environments(worlds: tuple[int, ...], steps: int) -> Iterator[Case]:
    """Environment steps with random actions."""
    for number in worlds:
        make = functools.partial(make_jaxmarl_environment, number, steps)
        yield Case("environment", "JaxMARL", TASK, number, 4, steps, make)
        for physics in ("rigid", "mjx"):
            make = functools.partial(make_openjax_environment, physics, number, steps)
            yield Case("environment", "openjax", physics, number, 3, steps, make)


def trainings(worlds: int, preset_name: str) -> Iterator[Case]:
    """Whole training steps: the baseline's own number of worlds, then ours for both."""
    baseline = jaxmarl_mappo.MappoSettings()
    for number in dict.fromkeys((min(baseline.num_envs, worlds), worlds)):
        sized = dataclasses.replace(baseline, num_envs=number)
        make = functools.partial(make_jaxmarl_training, sized)
        yield Case("training", "JaxMARL", "MAPPO, recurrent", number, 4, sized.num_steps, make)
    settings = preset(preset_name, num_envs=worlds)
    make = functools.partial(make_openjax_training, settings)
    agents, length = settings.environment.num_pursuers, settings.rollout_length
    yield Case("training", "openjax", f"{settings.environment.physics}", worlds, agents, length, make)


def make_jaxmarl_environment(worlds: int, steps: int):
    """simple_tag as its baselines step it: a fresh key per world and step, and its automatic reset."""
    environment = jaxmarl_mappo.make_environment(TASK)
    key = jax.random.key(0)
    state = jax.jit(jax.vmap(environment.reset))(jax.random.split(key, worlds))[1]
    actions = {
        agent: jax.random.randint(jax.random.fold_in(key, i), (worlds,), 0, environment.action_space(agent).n)
        for i, agent in enumerate(environment.agents)
    }

    def run(key, state, actions):
        def one(state, key):
            keys = jax.random.split(key, worlds)
            observation, state, reward, *_ = jax.vmap(environment.step)(keys, state, actions)
            return state, _used(observation) + _used(reward)

        return jax.lax.scan(one, state, jax.random.split(key, steps))

    return run, (key, state, actions)


def make_openjax_environment(physics: str, worlds: int, steps: int):
    """Our game with three pursuers under random commands about hovering; episodes don't end within the call."""
    environment = Pursuit(PursuitSettings(physics=physics))
    key = jax.random.key(1)
    state = jax.jit(jax.vmap(environment.reset))(jax.random.split(key, worlds))[1]
    action = 0.1 * jax.random.normal(key, (worlds, environment.settings.num_pursuers, 4))
    action = jnp.tanh(action + hover_action(environment.vehicle))

    def run(state, action):
        def one(state, _):
            observation, state, reward, *_ = jax.vmap(environment.step, (None, 0, 0))(key, state, action)
            return state, _used(observation) + _used(reward)

        return jax.lax.scan(one, state, None, length=steps)

    return run, (state, action)


def make_jaxmarl_training(settings: jaxmarl_mappo.MappoSettings):
    """One update of the baseline: rollout and all its epochs."""
    environment = jaxmarl_mappo.make_environment(TASK)
    update, initial = jaxmarl_mappo.make_update(environment, settings)
    return update, (jax.jit(initial)(jax.random.key(0)),)


def make_openjax_training(settings):
    """One training step of ours: rollout, predictor, all epochs, task archive."""
    return make_training_step(settings), (init_carry(settings, jax.random.key(0)),)


def _used(tree):
    """A sum over everything, else the compiler would leave out what nobody reads."""
    return sum(jnp.sum(leaf) for leaf in jax.tree.leaves(tree))
