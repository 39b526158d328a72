"""One thing that is timed."""

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Case:
    """A function with arguments, and what one call of it does."""

    group: str
    """drones, environment or training."""
    system: str
    """openjax, crazyflow or JaxMARL."""
    variant: str
    worlds: int
    agents: int
    """Drones (openjax, crazyflow) or moving points (JaxMARL) per world."""
    steps: int
    """Steps of every world in one call."""
    make: Callable[[], tuple[Callable, tuple]]
    """Makes the function and its arguments; called just before it is timed."""

    @property
    def name(self) -> str:
        """For messages."""
        return f"{self.group}: {self.system} {self.variant}, {self.worlds:,} worlds of {self.agents}"
