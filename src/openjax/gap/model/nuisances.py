"""Nuisances of the replay: small errors that every vehicle and every log has, as columns of the channels in units of
their standard deviations."""

import pathlib
import tomllib

import numpy as np

from openjax.flights.track import GRAVITY, Track, rotation, smooth
from openjax.gap.model.library import PLACE, STEP
from openjax.gap.model.physics import Path
from openjax.gap.model.prediction import FORCE, RATES, VELOCITY
from openjax.vehicle.effects.airspeed import PROPELLER_RADIUS
from openjax.vehicle.effects.effect import ARENA_CEILING

SIZE = {
    name: float(entry["size"])
    for name, entry in tomllib.loads(
        pathlib.Path(__file__).with_suffix(".toml").read_text(encoding="utf-8")
    ).items()
}
TRIM = 0.5  # s: what motors do more slowly is no answer to a gust, but what the vehicle needs
FEEDBACK_ROWS, QUICK_ROWS = (0, 2), (0, 1, 2)  # rows of delay
WAKE_WIDTHS = (0.05, 0.1)  # m
NEAR_OFFSET = 0.02  # m
# Nuisances that belong to a track, not to the vehicle.
OF_A_TRACK = ("clock of the motors", "accelerometer bias", "clock of the pose")


def columns_of(
    track: Track,
    path: Path,
    nominal,
    moved,
    numbers,
    feedback,
    one_clock: bool,
    at_once: bool,
    wander: float,
) -> dict[str, np.ndarray]:
    """{name: column (T, 9)} of one track. `moved` (numbers + 1, T, 9): channels with one of the vehicle's `numbers` a step
    off, the motors' clock last; the other arguments as in `make_replay`."""
    places = [PLACE[key[:2]] for key in numbers]
    columns = {
        " ".join(key[:2]): (m - nominal) * key[2] / STEP[k]
        for key, m, k in zip(numbers, moved, places, strict=False)
    }
    shift = (
        max(SIZE["motor_clock"], wander + (track.dt / 4 if at_once or wander else 0.0))
        if one_clock
        else SIZE["streams_apart"]
    )
    later = (moved[-1] - nominal) / STEP[-1]
    columns["clock of the motors"] = later * shift
    columns["delay of the motors"] = later * SIZE["motor_delay"]
    columns |= _late_torques("feedback", track, feedback.acceleration, FEEDBACK_ROWS)
    columns |= _late_torques("trim", track, feedback.trim, (0,))
    if at_once:
        columns |= _late_torques("motors within a row", track, feedback.quick, QUICK_ROWS)
    columns |= _sensor_nuisances(track, path, nominal, max(SIZE["pose_clock"], wander))
    return columns | _wake_torques(track) | _near_torques(track)


def _sensor_nuisances(
    track: Track, path: Path, nominal: np.ndarray, pose_shift: float
) -> dict[str, np.ndarray]:
    """Mounting, biases and clocks of the sensors, and what a rigid body with small errors does: columns (T, 9)."""
    rows = len(track)
    turn = rotation(np.asarray(path.quaternion, float)[:rows])
    specific = np.gradient(nominal[:, VELOCITY], track.dt, axis=0) + np.array([0.0, 0.0, GRAVITY])
    body = np.einsum("tji,tj->ti", turn, specific)
    columns: dict[str, np.ndarray] = {}

    def column(name: str, channel, values, size: float) -> None:
        out = np.zeros((rows, 9))
        out[:, channel] = values
        columns[name] = columns.get(name, 0.0) + out * size

    def moved(acceleration):  # what a change of the body-frame acceleration does to the velocity
        return np.cumsum(np.einsum("tij,tj->ti", turn, acceleration), 0) * track.dt

    rates = smooth(track.body_rates, 0.03, track.dt)
    force = nominal[:, FORCE]
    for name, axis in zip("xy", np.eye(3), strict=False):
        column(f"frame tilt {name}", VELOCITY, moved(np.cross(axis, body)), SIZE["frame_tilt"])
    for number, name in enumerate("xyz"):
        column(f"accelerometer bias {name}", 6 + number, 1.0, SIZE["accelerometer_bias"])
    for name, axis in zip("xyz", np.eye(3), strict=True):
        column(f"IMU tilt {name}", RATES, -np.cross(axis, rates - rates[0]), SIZE["imu_tilt"])
        column(f"IMU tilt {name}", FORCE, -np.cross(axis, force), SIZE["imu_tilt"])
    for axis, name in enumerate("xyz"):
        turning = np.cumsum(rates[:, axis - 2] * rates[:, axis - 1]) * track.dt
        column(f"gyroscopic torque {name}", axis, turning, SIZE["gyroscopic"])
    for name, axes in (("roll and pitch damping", (0, 1)), ("yaw damping", (2,))):
        column(name, axes, -np.cumsum(rates, 0)[:, axes] * track.dt, SIZE["damping"])
    for axis, name in enumerate("xy"):
        column(f"level of the world {name}", 3 + axis, 9.81 * track.dt * np.arange(rows), SIZE["world_level"])
    column(
        "accelerometer's low-pass", FORCE, -np.gradient(force, track.dt, axis=0), SIZE["accelerometer_lag"]
    )
    spinning = np.gradient(nominal[:, RATES], track.dt, axis=0)
    column("gyroscope's low-pass", RATES, -(spinning - spinning[0]), SIZE["gyroscope_lag"])
    if track.velocity is not None:
        late = -moved(np.cross(np.asarray(path.body_rates, float)[:rows], body))
        late += smooth(np.gradient(track.velocity, track.dt, axis=0), 0.05, track.dt)
        column("clock of the pose", VELOCITY, late, pose_shift)
    return columns


def _late_torques(name: str, track: Track, acceleration: np.ndarray, delays) -> dict[str, np.ndarray]:
    """Columns (T, 9) of angular accelerations by roll and pitch, yaw, at some delays: a filter of any shape."""
    columns = {}
    for rows in delays:
        late = np.concatenate([np.zeros((rows, 3)), acceleration[: len(acceleration) - rows]])
        for axes, mask in (("roll and pitch", [1.0, 1.0, 0.0]), ("yaw", [0.0, 0.0, 1.0])):
            columns[f"{name}, {axes}, {rows} rows late"] = (
                torque_channels(late * mask, track.dt) * SIZE["feedback"]
            )
    return columns


def torque_channels(acceleration: np.ndarray, dt: float) -> np.ndarray:
    """Channels (T, 9) of an angular acceleration (T, 3)."""
    column = np.zeros((len(acceleration), 9))
    column[1:, RATES] = np.cumsum(acceleration[:-1], 0) * dt
    return column


def _near_torques(track: Track) -> dict[str, np.ndarray]:
    """How floor and ceiling right a tilted vehicle or turn it over, which depends on more than its height: columns (T, 9)."""
    if track.position is None or track.quaternion is None:
        return {}
    height, up = track.position[:, 2], rotation(track.quaternion)[:, 2]
    tilt = np.stack([-up[:, 1], up[:, 0], np.zeros(len(track))], 1)
    out = {}
    for name, distance in (("floor", height), ("ceiling", ARENA_CEILING - height)):
        near = (PROPELLER_RADIUS / (np.maximum(distance, 0.0) + NEAR_OFFSET)) ** 3
        out[f"torque near the {name}"] = torque_channels(tilt * near[:, None], track.dt) * SIZE["near_torque"]
    return out


def _wake_torques(track: Track) -> dict[str, np.ndarray]:
    """How the wakes of vehicles above turn this one, by wake width: columns (T, 9)."""
    if track.position is None or not len(track.neighbours) or track.quaternion is None:
        return {}
    gap = track.neighbours - track.position
    height = np.maximum(gap[..., 2:], 0.0)
    square = (gap[..., :2] ** 2).sum(-1, keepdims=True)
    out = {}
    for width in WAKE_WIDTHS:
        strength = (gap[..., 2:] > 0.02) * np.exp(-height / 0.5 - square / (2.0 * width**2)) / width
        # The side nearer to the wake is pushed down: (gap) x (-e_z).
        world = np.stack([-gap[..., 1], gap[..., 0], np.zeros_like(gap[..., 0])], -1) * strength
        turned = np.einsum("tji,tj->ti", rotation(track.quaternion), world.sum(0))
        out[f"wake, {width:g} m"] = torque_channels(turned, track.dt) * SIZE["wake_torque"]
    return out
