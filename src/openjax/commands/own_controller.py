"""A user's own function in a policy's place, so that it is flown and counted like any other."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from openjax.baselines.heuristic import WithoutNetwork
from openjax.pursuit import Observation


@dataclasses.dataclass(frozen=True)
class OwnController(WithoutNetwork):
    """A pure function from an `Observation` to actions (N, 4). It is mapped over worlds, so it sees the observation of one."""

    function: Callable[[Observation], jax.Array]

    def mean(self, actor: Any, observation: Observation) -> jax.Array:
        """Actions (..., N, 4) in -1..1."""
        function = self.function
        for _ in range(observation.position.ndim - 2):
            function = jax.vmap(function)
        return jnp.clip(function(observation), -1.0, 1.0)
