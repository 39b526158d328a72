"""What a vehicle with given effects does along each track: the physics on logged
states, in lanes of one size.

Channels: body rates (3), velocity (3, world) - both integrated from the first row - and
specific force (3, body).
"""

from dataclasses import dataclass
from functools import cached_property

import jax
import numpy as np
from jaxtyping import Float, Shaped

from openjax.flights.track import Track, smooth
from openjax.gap.model.library import PHYSICS_EFFECTS, THETA, growths
from openjax.gap.model.physics import Path, compiled_physics
from openjax.gap.shapes import Hypotheses, Parameters
from openjax.vehicle.effects.effect import ARENA_CEILING

RATES = slice(0, 3)
VELOCITY = slice(3, 6)
FORCE = slice(6, 9)
# each twice the one before, so that less than half of a track is padding
BUCKETS = (256, 512, 1024, 2048, 4096, 8192, 16384, 32768)
FAR = 1e3  # m, where a ceiling does nothing
LANES = 8  # parameter vectors along tracks that one call of the physics takes
KEPT = 32  # mixtures of tracks that stay on the device, some megabytes each


def bucket(length: int) -> int:
    """The padded length of a track: a few fixed sizes, so that nothing is compiled
    twice.
    """
    return next((b for b in BUCKETS if b >= length), length)


def pad(
    values: Shaped[np.ndarray, " rows *rest"], length: int
) -> Float[np.ndarray, " {length} *rest"]:
    """float32, the last row repeated up to `length`."""
    values = np.asarray(values, np.float32)
    return np.concatenate([values, np.repeat(values[-1:], length - len(values), 0)])


@dataclass(frozen=True, eq=False)
class Physics:
    """Tracks of a case, their nominal vehicles and their paths."""

    tracks: tuple[Track, ...]
    vehicles: tuple
    paths: tuple[Path, ...]

    def predict(self, theta: Hypotheses) -> list[Float[np.ndarray, "hypotheses _ channels"]]:
        """Channels (B, T, 9) of each track for parameter vectors theta (B, P)."""
        theta = np.asarray(theta, np.float32)
        run = compiled_physics(PHYSICS_EFFECTS, THETA)
        parts = [[] for _ in self.tracks]
        lanes = [(number, k) for number in range(len(parts)) for k in range(len(theta))]
        # All of it is under way before any of it is waited for.
        running = []
        for begin in range(0, len(lanes), LANES):
            numbers, vectors = np.array(lanes[begin : begin + LANES]).T
            fill = np.minimum(np.arange(LANES), len(numbers) - 1)
            nominal = self._in_lanes(tuple(numbers[fill].tolist()))
            running.append((numbers, run(theta[vectors[fill]], *nominal)))
        for numbers, rows in running:
            for number, lane in zip(numbers, np.asarray(rows), strict=False):
                parts[number].append(lane[: len(self.tracks[number])])
        return [_integrate(np.stack(p), t.dt) for p, t in zip(parts, self.tracks, strict=True)]

    @cached_property
    def size_factors(self) -> Parameters:
        """(P,) by what usual sizes of parameters are multiplied for a vehicle of this
        size.
        """
        return growths(self.vehicles[0])

    def _in_lanes(self, numbers: tuple[int, ...]) -> tuple:
        """Vehicles and paths of the tracks `numbers`, on the device: a search asks for
        the same few mixtures again and again.
        """
        lanes = self._cache.get(numbers)
        if lanes is None:
            lanes = jax.tree.map(lambda leaf: leaf[list(numbers)], self._nominal)
            lanes = jax.device_put(lanes)
            # fits run side by side: what another one has put in meanwhile is as good
            if len(self._cache) >= KEPT:
                self._cache.clear()
            self._cache[numbers] = lanes
        return lanes

    @cached_property
    def _cache(self) -> dict:
        """{numbers of tracks: what `_in_lanes` gives}."""
        return {}

    @cached_property
    def _nominal(self) -> tuple:
        """Vehicles and paths of all tracks, leaves (tracks, ...)."""
        each = zip(self.vehicles, self.paths, strict=True)
        return jax.tree.map(lambda *leaves: np.stack(leaves), *each)


def make_physics(tracks, vehicles, motor_ticks) -> Physics:
    """Physics of tracks with their nominal vehicles and motor commands (T, TICKS, 4) of
    the rate loop's ticks.
    """
    size = bucket(max(map(len, tracks)))
    neighbours = max(1, *(len(t.neighbours) for t in tracks))
    return Physics(
        tuple(tracks),
        tuple(jax.tree.map(np.float32, v) for v in vehicles),
        tuple(_path(t, m, size, neighbours) for t, m in zip(tracks, motor_ticks, strict=True)),
    )


def _path(track: Track, ticks: np.ndarray, size: int, neighbours: int) -> Path:
    rows = len(track)

    def middle(values):
        return pad(0.5 * (values + np.concatenate([values[1:], values[-1:]])), size)

    unknown = np.zeros((rows, 3))
    quaternion = (
        track.quaternion if track.quaternion is not None else np.tile([1.0, 0, 0, 0], (rows, 1))
    )
    quaternion = middle(quaternion)
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    # Without a pose the vehicle is taken to be in mid-air, far from everything.
    position = track.position if track.position is not None else unknown + np.array([0.0, 0.0, 0.6])
    position, *neighbours_at = (_inside(p, track.ceiling) for p in (position, *track.neighbours))
    velocity = track.velocity if track.velocity is not None else unknown
    # Who didn't fly along is far away.
    others = [middle(p) for p in neighbours_at]
    others += [np.tile(np.float32([50.0, 50.0, -50.0]), (size, 1))] * (neighbours - len(others))
    voltage = np.full(size, np.nan, np.float32) if track.voltage is None else middle(track.voltage)
    return Path(
        middle(position),
        quaternion,
        middle(velocity),
        middle(smooth(track.body_rates, 0.05, track.dt)),
        pad(ticks, size),
        voltage,
        np.stack(others, 1),
        np.float32(_ceiling(position, track.ceiling)),
        np.float32(track.dt),
    )


def _inside(position: np.ndarray, ceiling: float | None) -> np.ndarray:
    """Positions (T, 3) in the room. Neither floor nor a known ceiling can be entered: a
    log that says so has an offset in height.
    """
    highest = np.inf if ceiling is None else ceiling
    return np.concatenate([position[:, :2], np.clip(position[:, 2:], 0.0, highest)], 1)


def _ceiling(position: np.ndarray, ceiling: float | None) -> float:
    """Height (m) of the ceiling whose effect is tried: where none is known, the
    arena's, unless the vehicle flew above it.
    """
    if ceiling is not None:
        return ceiling
    return ARENA_CEILING if (position[:, 2] <= ARENA_CEILING).all() else FAR


def _integrate(rows: np.ndarray, dt: float) -> np.ndarray:
    """Channels (B, T, 9) from accelerations and specific force (B, T, 9) of the rows'
    intervals.
    """
    rows = rows.astype(float)
    integral = np.zeros_like(rows[:, :, :6])
    np.cumsum(rows[:, :-1, :6] * dt, axis=1, out=integral[:, 1:])
    specific = rows[:, :, 6:].copy()
    specific[:, 1:] = 0.5 * (rows[:, 1:, 6:] + rows[:, :-1, 6:])
    return np.concatenate([integral, specific], 2)
