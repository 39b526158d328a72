"""An evader of one's own: it flies away from where the pursuers will be in a moment.

python examples/own_evader.py
openjax view --policy open --opponent examples/own_evader.py:foresee
"""

import jax
import jax.numpy as jnp

import openjax

AHEAD = 0.3  # seconds
TILT = 2.0  # metres per second squared, of a pursuer that leans by 45 degrees or so


def foresee(scene, memory):
    """Velocity (3,) in m/s, and the memory, four numbers. `scene` is what it knows: see
    `openjax.pursuit.evaders.Scene`.
    """
    lean = TILT * scene.thrust_direction.at[:, 2].set(0.0)
    later = scene.pursuers + AHEAD * scene.pursuer_velocity + 0.5 * AHEAD**2 * lean
    away = scene.position - later  # (N, 3) m
    force = jnp.sum(away / jnp.sum(away**2, axis=-1, keepdims=True), axis=0)
    middle = jnp.array(scene.settings.middle)
    force += 4.0 * (middle - scene.position)  # off the walls
    force += 0.5 * jax.random.normal(scene.key, (3,))
    return scene.reach * force / jnp.linalg.norm(force), memory


if __name__ == "__main__":
    for opponent in ("field", foresee):
        record = openjax.evaluate("open", "empty", episodes=16, opponent=opponent)
        name = getattr(opponent, "__name__", opponent)
        print(f"{name:8} caught in {record['capture_rate']:.2f} of the episodes")
