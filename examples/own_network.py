"""A network of one's own: plain layers for actor and critic, trained as any other.

python examples/own_network.py
"""

import flax.linen as nn
import jax.numpy as jnp

import openjax


class Layers(nn.Module):
    size: int

    @nn.compact
    def __call__(self, *parts):
        flat = [part.reshape(*parts[0].shape[:-1], -1) for part in parts]
        hidden = nn.tanh(nn.Dense(64)(jnp.concatenate(flat, axis=-1)))
        return nn.Dense(self.size, kernel_init=nn.initializers.zeros)(hidden)


class Plain:  # what `openjax.policy.Network` asks for
    def init(self, key, seen):
        actor = Layers(4).init(key, seen.self_state, seen.others, seen.pillars)
        return actor, Layers(1).init(key, seen.self_state, seen.privileged)

    def distribution(self, actor, seen):
        mean = Layers(4).apply(actor, seen.self_state, seen.others, seen.pillars)
        return mean + jnp.array([0.25, 0.0, 0.0, 0.0]), jnp.full(4, -1.5)  # about hovering

    def value(self, critic, seen):
        return Layers(1).apply(critic, seen.self_state, seen.privileged)[..., 0]


settings = openjax.preset("quick", first_flights=dict(updates=0))
options = dict(minutes=6, overwrite=True)
policy = openjax.train(settings, "runs/own_network", policy=Plain(), **options)
print(f"captured in {openjax.evaluate(policy, 'empty', episodes=9)['capture_rate']:.0%}")
