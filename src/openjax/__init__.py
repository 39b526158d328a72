"""openjax: multi-quadrotor pursuit-evasion in JAX, trained in one compiled step, with a diagnosis of the sim-to-real gap.

import jax, openjax
environment = openjax.make(physics="rigid")
observation, state = jax.jit(environment.reset)(jax.random.key(0))
policy = openjax.load_policy("open")
observation, state, reward, terminated, truncated, info = jax.jit(environment.step)(
    jax.random.key(1), state, policy(observation)
)
"""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # so that editors complete and check what is loaded on first use only
    from openjax.commands.calls import evaluate, train
    from openjax.errors import UserError
    from openjax.learning.presets import preset
    from openjax.pursuit.environment import Pursuit, make
    from openjax.pursuit.scenarios import SCENARIOS
    from openjax.pursuit.settings import PursuitSettings
    from openjax.pursuit.task import Task
    from openjax.store.policies import load_policy

__version__ = "0.1.0"

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

__all__ = [
    "SCENARIOS",
    "Pursuit",
    "PursuitSettings",
    "Task",
    "UserError",
    "evaluate",
    "load_policy",
    "make",
    "preset",
    "train",
]


def __getattr__(name: str):
    # imported on first use: `openjax diagnose --help` needn't wait for MuJoCo
    if name in _PUBLIC:
        return getattr(importlib.import_module(_PUBLIC[name]), name)
    raise AttributeError(f"module 'openjax' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
