"""What a learner is, and what it learns from."""

from typing import Any, Protocol, runtime_checkable

import jax
from flax import struct
from jaxtyping import PRNGKeyArray

from openjax.learning.collectives import mean_over_devices
from openjax.learning.rollout import Rollout
from openjax.policy import PolicyParameters
from openjax.pursuit import Observation, PursuitState
from openjax.pursuit.shapes import Scalar


@struct.dataclass
class Flown:
    """A rollout of T steps in E worlds, and what lies before and after it."""

    rollout: Rollout  # (T, E, ...)
    frames: jax.Array  # (E, H, F), the predictor's history before its second step
    observation: Observation  # (E, ...) after it, before any reset
    state: PursuitState  # (E, ...) the same
    predicted: jax.Array | None  # (E, K, 3) m, predicted after it
    progress: jax.Array | float = 0.0
    """() share of the run that is done"""
    axis: str | None = struct.field(pytree_node=False, default=None)
    """Name of the devices' axis; None on one device."""

    def mean(self, tree: Any) -> Any:
        """The mean of every leaf over all devices, each of which has a share of the
        worlds: a gradient has to go through this, so that all devices learn the same.
        """
        return mean_over_devices(tree, self.axis)


@runtime_checkable
class Learner(Protocol):
    """What learns from each rollout: of the policy's parameters some, or something
    beside them.

    Its state is any tree of arrays, the same on all devices; checkpoints hold it, and a
    resumed run goes on with it. Learners come one after the other, in the order of
    their dictionary.

    One that has a method `act(state, worlds, noise) -> desired velocities (E, 3),
    samples` also flies the evaders; see `openjax.learning.learners.evasion`.
    """

    def start(self, parameters: PolicyParameters, key: PRNGKeyArray) -> Any:
        """Its state before the first update of a policy with fresh `parameters`."""

    def learn(
        self, state: Any, parameters: PolicyParameters, flown: Flown, key: PRNGKeyArray
    ) -> tuple[Any, PolicyParameters, dict[str, Scalar]]:
        """After a rollout: its state, the policy's parameters, and () metrics by name.

        `key` is the same on all devices.
        """
