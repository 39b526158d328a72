"""A game of one's own: other numbers, many worlds at once, a controller written in JAX.

python examples/own_game.py
"""

import jax
import jax.numpy as jnp

import openjax
from openjax.pursuit import hover_action

WORLDS = 64
STEPS = 500  # of 10 ms
game = openjax.make(num_pursuers=3, evader_speed=0.6, max_pillars=3, min_pillars=3)


def controller(state):
    """(N, 4) actions that lean towards the evader, by rates in proportion to where it is."""
    drones = state.drones
    tilt = drones.quaternion[:, 1:3]  # sine of half the roll and pitch
    towards = state.evader_position - drones.position
    lean = jnp.array([-1.0, 1.0])  # roll moves towards -y, pitch towards +x
    wanted = lean * (0.2 * towards[:, [1, 0]] - 0.1 * drones.velocity[:, [1, 0]])
    rates = jnp.clip(4.0 * (wanted - tilt), -1.0, 1.0)
    thrust = hover_action(game.vehicle)[0] + 0.5 * towards[:, 2] - 0.4 * drones.velocity[:, 2]
    return jnp.column_stack([thrust, rates, jnp.zeros(len(thrust))])


def episode(key):
    """One world from its start; whether some pursuer captured the evader in some step."""

    def step(state, _):
        _, state, _, _, _, info = game.step(key, state, controller(state))
        return state, jnp.any(info.captured)

    return jnp.any(jax.lax.scan(step, game.reset(key)[1], None, length=STEPS)[1])


captured = jax.jit(jax.vmap(episode))(jax.random.split(jax.random.key(0), WORLDS))
print(f"captured in {int(captured.sum())} of {WORLDS} worlds within 5 s")
