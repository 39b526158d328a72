"""Settings of a best response, without JAX, so that a command's help comes at once."""

from dataclasses import dataclass
from typing import Annotated

from openjax.errors import UserError
from openjax.learning.settings import EvaderLearningSettings
from openjax.ranges import Interval


@dataclass(frozen=True)
class BestResponseSettings(EvaderLearningSettings):
    """How an evader learns against fixed pursuers."""

    learning_rate_end: Annotated[float, Interval("[0, 1]")] = 0.0
    own_axes: bool = True
    total_steps: Annotated[int, Interval("[1, 1e15]")] = 200_000_000
    """Environment steps of each seed."""
    seeds: Annotated[int, Interval("[1, 64]")] = 3
    """That learn side by side."""
    num_envs: Annotated[int, Interval("[1, 16777216]")] = 4096
    """Worlds of each seed."""
    rollout_length: Annotated[int, Interval("[1, 100000]")] = 40
    """Control steps per iteration; worlds whose evader was caught start anew after it."""
    layouts: Annotated[float, Interval("[0, 1]")] = 0.5
    """Share of the episodes on the six layouts, which the pursuers never learned on; the others are
    uniform tasks.
    """

    def __post_init__(self):
        super().__post_init__()
        if self.num_envs % self.minibatches:
            raise UserError(
                f"num_envs {self.num_envs} must be a multiple of minibatches {self.minibatches}"
            )

    @property
    def total_updates(self) -> int:
        """Training steps of the run."""
        return max(1, -(-self.total_steps // (self.num_envs * self.rollout_length)))
