"""The quality of messages between pursuers."""

from dataclasses import dataclass
from typing import Annotated

from openjax.ranges import Interval, check_intervals


@dataclass(frozen=True)
class MessageSettings:
    """Messages between pursuers. In every control step each sends to every other where
    it is, how it flies, and where the evader is if it sees it.
    """

    lost: Annotated[float, Interval("[0, 1]")] = 0.0
    """Share of the messages that are lost, each on its own."""
    late: Annotated[float, Interval("[0, 10]")] = 0.0
    """Delay of the others (s)."""

    def __post_init__(self):
        check_intervals(self, "messages.")

    @property
    def perfect(self) -> bool:
        """True if all pursuers know at once what one knows."""
        return not (self.lost or self.late)
