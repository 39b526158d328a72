"""Receding-horizon planning: a plan is made, its beginning is flown, and so on to the episode's
end.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, Protocol

import jax

from openjax.evaluation.judges.duel import Duel, World
from openjax.policy import PolicyParameters
from openjax.pursuit import EpisodeStatistics, PursuitState


class Replanned(Protocol):
    """Settings of who plans."""

    replan: int
    """Control steps after which it plans anew."""


class RecedingHorizon(ABC):
    """An evader that plans, or both sides; a subclass says what a plan is."""

    settings: Replanned
    duel: Duel

    @abstractmethod
    def begin(self, start: World) -> Any:
        """Worlds (B, ...) at the start of an episode as its field `world`, and plans
        that are none.
        """

    @abstractmethod
    def replan(self, parameters: PolicyParameters, carry: Any, key: jax.Array) -> Any:
        """The same after it has planned once and flown until the next time."""

    def fly(self, parameters: PolicyParameters, start: World, key: jax.Array) -> EpisodeStatistics:
        """Statistics (B,) of one episode from each of B starts."""
        end, _ = self.fly_and_keep(parameters, start, key, lambda state: None)
        return end.statistics

    def fly_and_keep(
        self,
        parameters: PolicyParameters,
        start: World,
        key: jax.Array,
        keep: Callable[[PursuitState], Any],
    ) -> tuple[PursuitState, Any]:
        """The states (B, ...) at the end of one episode from each of B starts, and what
        `keep` says of those after each time it plans (T, ...).
        """

        def one(carry, key):
            carry = self.replan(parameters, carry, key)
            return carry, keep(carry.world[1])

        episode = self.duel.environment.settings.episode_length
        keys = jax.random.split(key, episode // self.settings.replan)
        end, records = jax.lax.scan(one, self.begin(start), keys)
        return end.world[1], records
