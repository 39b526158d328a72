"""A learner, and the samples that it learns from."""

from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import PRNGKeyArray

from openjax.errors import UserError, part_name
from openjax.learning.collectives import mean_over_devices
from openjax.learning.rollout import Rollout
from openjax.policy import PolicyParameters
from openjax.pursuit import Observation, PursuitState
from openjax.pursuit.shapes import Scalar


@struct.dataclass
class Experience:
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
    """A learner updates some of the policy's parameters, or something beside them, from each
    rollout.

    Its state is any tree of arrays, the same on all devices; checkpoints hold it, and a
    resumed run goes on with it. Learners come one after the other, in the order of
    their dictionary.

    One that has a method `act(state, worlds, noise) -> desired velocities (E, 3),
    samples` also flies the evaders; see `openjax.learning.learners.evasion`.
    """

    def start(self, parameters: PolicyParameters, key: PRNGKeyArray) -> Any:
        """Its state before the first update of a policy with fresh `parameters`."""

    def learn(
        self, state: Any, parameters: PolicyParameters, experience: Experience, key: PRNGKeyArray
    ) -> tuple[Any, PolicyParameters, dict[str, Scalar]]:
        """After a rollout: its state, the policy's parameters, and () metrics by name.

        `key` is the same on all devices.
        """


def check_learners(learners: Any) -> None:
    """Raises UserError for learners that somebody hands in and that are none."""
    if not isinstance(learners, Mapping):
        raise UserError(
            f"learners: {part_name(learners)} has no names; a dictionary of learners by "
            "name would be right"
        )
    for name, learner in learners.items():
        if isinstance(learner, type) or not isinstance(learner, Learner):
            raise UserError(
                f"learner {name}: {part_name(learner)} is no object with start and learn; "
                "see openjax.learning.Learner"
            )


def check_learning(name: str, result: Any, state: Any) -> None:
    """Raises UserError where `learn` gives something else than a learner's state like
    the one before, parameters and () metrics.
    """
    right = "state, parameters, metrics would be right"
    if not isinstance(result, tuple) or len(result) != 3:
        raise UserError(f"learner {name}: learn gives {part_name(result)}; {right}")

    next_state, _, metrics = result
    # a compiled step hands its state to the next one, so it keeps shapes and types
    old_leaves = _described_leaves(state)
    new_leaves = _described_leaves(next_state)
    for place in sorted(old_leaves.keys() | new_leaves.keys()):
        old = old_leaves.get(place, "absent")
        new = new_leaves.get(place, "absent")
        if new != old:
            raise UserError(
                f"learner {name}: state{place} is {new} after learn; as before, {old}, "
                "would be right"
            )
    for metric, value in metrics.items():
        if jnp.shape(value) != ():
            raise UserError(
                f"learner {name}: metric {metric} has shape {jnp.shape(value)}; one "
                "number would be right"
            )


def _described_leaves(tree):
    """{path: type and shape} of a tree's leaves."""
    return {
        jax.tree_util.keystr(path): (
            f"{getattr(leaf, 'dtype', type(leaf).__name__)}{list(jnp.shape(leaf))}"
        )
        for path, leaf in jax.tree.leaves_with_path(tree)
    }
