"""Settings of the networks."""

import itertools
from dataclasses import dataclass
from types import MappingProxyType
from typing import Annotated, Literal

from openjax.errors import UserError
from openjax.ranges import Interval, check_intervals


@dataclass(frozen=True)
class NetworkSettings:
    """Actor and critic: an attention encoder each (the paper's figure 3)."""

    features: Annotated[int, Interval("[1, 8192]")] = 128
    """Width of the entity embeddings and of all layers."""
    heads: Annotated[int, Interval("[1, 256]")] = 4
    """Attention heads."""
    compute_type: Literal["float32", "bfloat16"] = "float32"
    """Arithmetic of the networks; parameters stay in float32."""
    initial_log_std: Annotated[float, Interval("[-10, 2]")] = -0.5
    """Start of the Gaussian policy's state-independent log standard deviation."""
    squash: Literal["mean", "sample"] = "mean"
    """The value that the tanh bounds. "mean": exploration is added after it and cut at the
    bounds, so that the mean policy does what the exploring one does on average;
    "sample": exploration passes through the tanh, which shifts that average.
    """
    output: Literal["commands", "velocity", "field"] = "commands"
    """The actor's output. "commands": thrust and body rates; "velocity": a
    velocity, which a controller flies; "field": parameters of a potential field, whose
    force that controller flies (DACOOP).
    """
    critic_encoder: Literal["attention", "layers"] = "attention"
    """The critic's first layers, unless it shares the actor's encoder. "attention":
    an encoder like the actor's; "layers": two layers, twice as wide as `features`, on
    all that it sees: a third of the work on a CPU.
    """
    shared_encoder: bool = False
    """The critic is a layer on the actor's encoder, which halves the cost of an update;
    what it sees beside the actor joins behind the encoder. False: an encoder each.
    """

    FORMER = MappingProxyType({"critic_input": "state"})
    """Settings that earlier versions had, and their only value now."""

    def __post_init__(self):
        check_intervals(self, "network.")
        if self.features % self.heads:
            raise UserError(
                f"network: features {self.features} must be a multiple of heads {self.heads}"
            )
        if self.shared_encoder and self.critic_encoder != "attention":
            raise UserError(
                f"network: critic_encoder {self.critic_encoder} has no effect with a shared encoder"
            )


@dataclass(frozen=True)
class PredictorSettings:
    """Evader predictor: an LSTM over the last frames."""

    enabled: bool = True
    """Predict the evader and let the policy observe the prediction."""
    units: Annotated[int, Interval("[1, 8192]")] = 64
    """Width of the LSTM."""
    horizons: Annotated[tuple[int, ...], Interval("[1, 10000]")] = (1, 5, 10, 20, 40)
    """Control steps ahead at which positions are predicted; the first is 1. The paper's
    are 1 to 5.
    """
    LEARNING_RATE = 1e-3
    """Adam step size at the start; falls linearly to zero over `total_steps`. The paper's
    stays at 1e-4.
    """
    windows: Annotated[int, Interval("[1, 1000]")] = 8
    """Windows of each environment's rollout that one iteration trains on; even."""

    WINDOWS_PER_STEP = 2
    """Windows of one gradient step: an iteration's steps are over disjoint ones."""
    FORMER = MappingProxyType({"relative": True, "loss": "scaled", "decay": True, "steps": 4})
    """Settings that earlier versions had, and their only value now."""

    def __post_init__(self):
        check_intervals(self, "predictor.")
        rising = all(
            horizon < later_horizon for horizon, later_horizon in itertools.pairwise(self.horizons)
        )
        if not self.horizons or self.horizons[0] != 1 or not rising:
            raise UserError(
                f"predictor.horizons {list(self.horizons)[:20]} must start with 1 and rise"
            )
        if self.windows % self.WINDOWS_PER_STEP:
            raise UserError(f"predictor: windows {self.windows} must be even")

    @property
    def steps(self) -> int:
        """Gradient steps per iteration."""
        return self.windows // self.WINDOWS_PER_STEP
