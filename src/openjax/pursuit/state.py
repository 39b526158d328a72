"""The state of one world."""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool

from openjax.pursuit.evaders.evader_state import EvaderState
from openjax.pursuit.shortest_paths import ShortestPaths
from openjax.pursuit.statistics import EpisodeStatistics
from openjax.pursuit.task import Task
from openjax.pursuit.teams import still_there
from openjax.vehicle import DroneState


@struct.dataclass
class PursuitState:
    """State of one world with N pursuers."""

    task: Task
    drones: DroneState  # leading axis N
    vehicles: dict[str, dict[str, jax.Array]]
    """effect -> parameter -> (N,), drawn at the start; empty: nominal vehicles"""
    evader_position: jax.Array  # (3,) m, world
    evader_velocity: jax.Array  # (3,) m/s, world
    evader: EvaderState | None
    """which evader it is, and its memory; None where all are the paper's, which has
    none
    """
    # (3,) where the evader was last seen; the arena's middle before that
    last_seen: jax.Array
    # (N,) bool, between which pursuers and the evader no pillar stands
    in_sight: jax.Array
    frames: jax.Array  # (n * spacing, F) history, oldest first
    own_history: jax.Array | None
    """(H * spacing, N, OWN_FRAME) as seen, oldest first; None where it isn't
    observed
    """
    previous_action: jax.Array  # (N, 4) squashed command of the last step
    step: jax.Array  # () int32, control steps since the start
    statistics: EpisodeStatistics
    gone_after: jax.Array | None = None
    """(N,) int32, the last step in which each pursuer is there; None: nobody falls
    out
    """
    in_view: jax.Array | None = None
    """(N,) bool, which of those in sight have it in range and cone; None: these have no
    limits
    """

    paths: ShortestPaths | None = None
    """round the task's pillars; None where no term of the settings' reward asks for
    them
    """

    strategies: jax.Array | None = None
    """(D,) from 0 to 1, the draws of the strategies that the team flies one after
    another in this episode; None: it has only one
    """

    @property
    def active(self) -> Bool[Array, "*worlds drones"] | None:
        """(N,) bool, the slots of pursuers in use; None: all are."""
        return still_there(self.task.active, self.gone_after, self.step)

    @property
    def sees(self) -> Bool[Array, "*worlds drones"]:
        """(N,) bool, which pursuers see the evader."""
        return jnp.asarray(self.in_sight if self.in_view is None else self.in_view)

    @property
    def seen(self) -> Bool[Array, "*worlds"]:
        """() bool, some pursuer sees the evader."""
        return jnp.any(self.sees, axis=-1)
