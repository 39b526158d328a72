"""MAPPO on a JaxMARL environment with the structure and settings of JaxMARL's recurrent MPE baseline.

The package ships its environments, not its training scripts (baselines/MAPPO/mappo_rnn_mpe.py of its repository), so
the update is written here after that script and its configuration: networks, sizes, rollout, advantages, clipping and
number of gradient steps are the same. Left out, in its favour, is the logging to a service after each update.
simple_tag's prey has a shorter observation than its predators, which the script's stacking doesn't allow for: it is
padded with zeros. All four agents learn with shared networks, as in the script.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
from flax.linen.initializers import orthogonal


@dataclass(frozen=True)
class MappoSettings:
    """The baseline's configuration (config/mappo_homogenous_rnn_mpe.yaml)."""

    num_envs: int = 128
    num_steps: int = 128
    features: int = 128
    epochs: int = 4
    minibatches: int = 4
    learning_rate: float = 2e-3
    discount: float = 0.99
    gae_lambda: float = 0.95
    clip_epsilon: float = 0.2
    entropy_coefficient: float = 0.01
    value_weight: float = 0.5
    max_grad_norm: float = 0.5


class Transition(NamedTuple):
    """One step of all actors (A = agents x worlds) before it is taken, and what it gave."""

    ended: jax.Array  # (A,) the episode ended with this step
    started: jax.Array  # (A,) the episode starts at this step
    action: jax.Array  # (A,) int
    value: jax.Array  # (A,)
    reward: jax.Array  # (A,)
    log_probability: jax.Array  # (A,)
    observation: jax.Array  # (A, O)
    world: jax.Array  # (A, agents * O) all agents' observations


class Training(NamedTuple):
    """Everything that an update hands to the next."""

    parameters: tuple[Any, Any]
    optimisers: tuple[Any, Any]
    environment: Any
    observations: dict[str, jax.Array]
    started: jax.Array
    memory: tuple[jax.Array, jax.Array]
    key: jax.Array


class _Cell(nn.Module):
    features: int

    @nn.compact
    def __call__(self, memory, inputs):
        x, started = inputs
        memory = jnp.where(started[:, None], 0.0, memory)
        return nn.GRUCell(features=self.features)(memory, x)


class Recurrent(nn.Module):
    """Dense, GRU that forgets at episode starts, dense, output; over inputs (steps, A, inputs)."""

    features: int
    outputs: int
    last_scale: float

    @nn.compact
    def __call__(self, memory, inputs, started):
        x = nn.relu(nn.Dense(self.features, kernel_init=orthogonal(2**0.5))(inputs))
        scan = nn.scan(_Cell, variable_broadcast="params", split_rngs={"params": False})
        memory, x = scan(self.features)(memory, (x, started))
        x = nn.relu(nn.Dense(self.features, kernel_init=orthogonal(2.0))(x))
        return memory, nn.Dense(self.outputs, kernel_init=orthogonal(self.last_scale))(x)


def make_environment(name: str):
    """A JaxMARL environment inside the wrapper that its MPE baselines use."""
    import jaxmarl
    from jaxmarl.wrappers.baselines import MPELogWrapper

    return MPELogWrapper(jaxmarl.make(name))


def make_update(
    environment, settings: MappoSettings
) -> tuple[Callable[[Training], tuple[Training, jax.Array]], Callable[[jax.Array], Training]]:
    """`update(training) -> (training, mean reward)` and `initial(key) -> training`, both to be compiled."""
    agents = list(environment.agents)
    width = max(environment.observation_space(agent).shape[0] for agent in agents)
    actor = Recurrent(settings.features, environment.action_space(agents[0]).n, 0.01)
    critic = Recurrent(settings.features, 1, 1.0)
    optimiser = optax.chain(
        optax.clip_by_global_norm(settings.max_grad_norm), optax.adam(settings.learning_rate, eps=1e-5)
    )
    envs = settings.num_envs
    actors = len(agents) * envs
    step = jax.vmap(environment.step)

    def initial(key):
        reset_key, actor_key, critic_key, key = jax.random.split(key, 4)
        observations, state = jax.vmap(environment.reset)(jax.random.split(reset_key, envs))
        started = jnp.zeros((actors,), bool)
        memory = jnp.zeros((actors, settings.features), jnp.float32)
        first = (jnp.zeros((1, actors, width)), started[None])
        first_world = (jnp.zeros((1, actors, width * len(agents))), started[None])
        parameters = (actor.init(actor_key, memory, *first), critic.init(critic_key, memory, *first_world))
        optimisers = tuple(optimiser.init(p) for p in parameters)
        return Training(parameters, optimisers, state, observations, started, (memory, memory), key)

    def stack(values):
        return jnp.concatenate([values[agent] for agent in agents])

    def observe(observations):
        """(A, O) and (A, agents * O)."""
        padded = [
            jnp.pad(observations[agent], ((0, 0), (0, width - observations[agent].shape[1])))
            for agent in agents
        ]
        world = jnp.concatenate(padded, axis=-1)
        return jnp.concatenate(padded), jnp.tile(world, (len(agents), 1))

    def act(parameters, carry, _):
        state, observations, started, memory, key = carry
        key, action_key, step_key = jax.random.split(key, 3)
        observation, world = observe(observations)
        actor_memory, logits = actor.apply(parameters[0], memory[0], observation[None], started[None])
        critic_memory, value = critic.apply(parameters[1], memory[1], world[None], started[None])
        logits = jax.nn.log_softmax(logits[0])
        action = jax.random.categorical(action_key, logits)
        chosen = {agent: a for agent, a in zip(agents, action.reshape(len(agents), envs), strict=True)}
        keys = jax.random.split(step_key, envs)
        observations, state, reward, done, _ = step(keys, state, chosen)
        transition = Transition(
            ended=jnp.tile(done["__all__"], len(agents)),
            started=started,
            action=action,
            value=value[0, :, 0],
            reward=stack(reward).astype(jnp.float32),
            log_probability=_pick(logits, action),
            observation=observation,
            world=world,
        )
        return (state, observations, stack(done), (actor_memory, critic_memory), key), transition

    def actor_loss(parameters, memory, batch, advantage):
        _, logits = actor.apply(parameters, memory, batch.observation, batch.started)
        logits = jax.nn.log_softmax(logits)
        ratio = jnp.exp(_pick(logits, batch.action) - batch.log_probability)
        advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        clipped = jnp.clip(ratio, 1 - settings.clip_epsilon, 1 + settings.clip_epsilon)
        entropy = -jnp.sum(jnp.exp(logits) * logits, axis=-1).mean()
        return (
            -jnp.minimum(ratio * advantage, clipped * advantage).mean()
            - settings.entropy_coefficient * entropy
        )

    def critic_loss(parameters, memory, batch, target):
        value = critic.apply(parameters, memory, batch.world, batch.started)[1][..., 0]
        clipped = batch.value + jnp.clip(value - batch.value, -settings.clip_epsilon, settings.clip_epsilon)
        worst = jnp.maximum(jnp.square(value - target), jnp.square(clipped - target))
        return settings.value_weight * 0.5 * worst.mean()

    def gradient_step(carry, minibatch):
        parameters, optimisers = carry
        memory, batch, advantage, target = minibatch
        gradients = (
            jax.grad(actor_loss)(parameters[0], memory[0], batch, advantage),
            jax.grad(critic_loss)(parameters[1], memory[1], batch, target),
        )
        steps = [optimiser.update(g, o, p) for g, o, p in zip(gradients, optimisers, parameters, strict=True)]
        parameters = tuple(optax.apply_updates(p, u) for p, (u, _) in zip(parameters, steps, strict=True))
        return (parameters, tuple(o for _, o in steps)), None

    def epoch(whole, carry, key):
        """One pass over all actors' whole trajectories, in shuffled minibatches of actors."""
        order = jax.random.permutation(key, actors).reshape(settings.minibatches, -1)
        memory, *rest = whole
        taken = jax.tree.map(lambda x: x[order], memory)
        split = jax.tree.map(lambda x: jnp.moveaxis(jnp.take(x, order, axis=1), 1, 0), rest)
        return jax.lax.scan(gradient_step, carry, (taken, *split))

    def update(training):
        start = (training.environment, training.observations, training.started, training.memory, training.key)
        rollout_step = functools.partial(act, training.parameters)
        end, batch = jax.lax.scan(rollout_step, start, None, length=settings.num_steps)
        state, observations, started, memory, key = end
        _, last_value = critic.apply(
            training.parameters[1], memory[1], observe(observations)[1][None], started[None]
        )
        advantage = _advantage(settings, batch, last_value[0, :, 0])
        key, shuffle_key = jax.random.split(key)
        whole = (training.memory, batch, advantage, advantage + batch.value)
        (parameters, optimisers), _ = jax.lax.scan(
            functools.partial(epoch, whole),
            (training.parameters, training.optimisers),
            jax.random.split(shuffle_key, settings.epochs),
        )
        training = Training(parameters, optimisers, state, observations, started, memory, key)
        return training, batch.reward.mean()

    return update, initial


def _advantage(settings, batch, last_value):
    """Generalised advantage estimate (steps, A)."""

    def one(carry, t):
        later, next_value = carry
        going_on = 1.0 - t.ended
        error = t.reward + settings.discount * next_value * going_on - t.value
        later = error + settings.discount * settings.gae_lambda * going_on * later
        return (later, t.value), later

    return jax.lax.scan(one, (jnp.zeros_like(last_value), last_value), batch, reverse=True, unroll=16)[1]


def _pick(logits, action):
    return jnp.take_along_axis(logits, action[..., None], axis=-1)[..., 0]
