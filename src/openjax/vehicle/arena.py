"""The arena's sizes: one truth for solids, effects, game and pictures."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Arena:
    """A cylinder with vertical pillars in it, all as high as it is and rounded above.
    Lengths in m; the paper's.
    """

    radius: float = 0.9
    """Its wall is no solid thing: flying beyond it is a breach."""
    height: float = 1.2
    """Height of the ceiling and of the pillars."""
    pillar_radius: float = 0.1
