"""A learner of one's own in MAPPO's place: REINFORCE, the oldest policy gradient (Williams, 1992).

python examples/own_learner.py
"""

import jax
import jax.numpy as jnp
import optax

import openjax
from openjax.learning import build
from openjax.policy import gaussian_log_prob

settings = openjax.preset("quick")
policy = build(settings).policy
adam = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(3e-4))


class Reinforce:  # what `openjax.learning.Learner` asks for; its state is the optimiser's
    def start(self, parameters, key):
        return adam.init(parameters.actor)

    def learn(self, state, parameters, flown, key):
        rollout = flown.rollout  # leaves (T, E, ...)
        rest = jnp.cumsum(rollout.reward[::-1], axis=0)[::-1]
        worth = (rest - jnp.mean(rest, axis=1, keepdims=True)) / (jnp.std(rest) + 1e-6)

        def loss(actor):
            mean, log_std = policy.distribution(actor, rollout.observation, rollout.predicted)
            return -jnp.mean(worth * gaussian_log_prob(rollout.action, mean, log_std))

        value, gradient = flown.mean(jax.value_and_grad(loss)(parameters.actor))
        change, state = adam.update(gradient, state)
        actor = optax.apply_updates(parameters.actor, change)
        return state, parameters.replace(actor=actor), {"reinforce_loss": value}


learners = {"policy": Reinforce()}
openjax.train(settings, "runs/own_learner", learners=learners, minutes=6, overwrite=True)
