"""openjax: multi-quadrotor pursuit-evasion in JAX, trained in one compiled step, with a
diagnosis of the sim-to-real gap.

import jax, openjax
environment = openjax.make()
observation, state = jax.jit(environment.reset)(jax.random.key(0))
policy = openjax.load_policy("open")
observation, state, reward, terminated, truncated, info = jax.jit(environment.step)(
    jax.random.key(1), state, policy(observation)
)
"""

import sys
import types
from typing import TYPE_CHECKING

from openjax.lazy import lazy_names
from openjax.version import __version__ as __version__
from openjax.xla_flags import avoid_wrong_sums

if TYPE_CHECKING:  # so that editors complete and check what is loaded on first use only
    from openjax.commands.calls import evaluate as evaluate
    from openjax.commands.calls import train as train
    from openjax.errors import UserError as UserError
    from openjax.learning.presets import preset as preset
    from openjax.pursuit.environment import Pursuit as Pursuit
    from openjax.pursuit.environment import make as make
    from openjax.pursuit.scenarios import SCENARIOS as SCENARIOS
    from openjax.pursuit.settings import PursuitSettings as PursuitSettings
    from openjax.pursuit.task import Task as Task
    from openjax.store.policies import load_policy as load_policy

avoid_wrong_sums()  # before JAX looks for its devices

# imported on first use: `openjax diagnose --help` needn't wait for MuJoCo
__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "commands.calls": "evaluate train",
        "errors": "UserError",
        "learning": "preset",
        "pursuit": "Pursuit PursuitSettings SCENARIOS Task make",
        "store.policies": "load_policy",
    },
)


class _Package(types.ModuleType):
    """The package, whose functions `train` and `evaluate` stay what they are.

    `python -m openjax.train` needs a module of that name, too. Whoever imports it (an
    editor, a walk through all modules) has the import system bind it as an attribute of
    the package, in place of the function; that is ignored.
    """

    def __setattr__(self, name: str, value: object) -> None:
        if name not in __all__ or not isinstance(value, types.ModuleType):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
