"""openjax: multi-quadrotor pursuit-evasion in JAX, trained in one compiled step, with a diagnosis of the sim-to-real gap.

import jax, openjax
environment = openjax.make(num_pursuers=3)
observation, state = environment.reset(jax.random.key(0))
policy = openjax.load_policy("open")
observation, state, reward, terminated, truncated, info = environment.step(
    jax.random.key(1), state, policy(observation)
)
"""

import importlib

_PUBLIC = {
    "Pursuit": "openjax.pursuit",
    "PursuitSettings": "openjax.pursuit",
    "SCENARIOS": "openjax.pursuit",
    "Task": "openjax.pursuit",
    "UserError": "openjax.errors",
    "evaluate": "openjax.commands.calls",
    "load_policy": "openjax.store.policies",
    "make": "openjax.pursuit",
    "preset": "openjax.learning",
    "train": "openjax.commands.calls",
}

__all__ = sorted(_PUBLIC)


def __getattr__(name: str):
    # imported on first use: `python -m openjax.diagnose --help` needn't wait for MuJoCo
    if name in _PUBLIC:
        return getattr(importlib.import_module(_PUBLIC[name]), name)
    raise AttributeError(f"module 'openjax' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
