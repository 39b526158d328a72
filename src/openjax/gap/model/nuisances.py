"""Nuisances of the replay: small errors that every vehicle and every log has, as
columns of the channels in units of their standard deviations.
"""

import pathlib
import tomllib

import numpy as np
from jaxtyping import Float

from openjax.flights.track import GRAVITY, Track, smooth, specific_force_of, to_world
from openjax.gap.decision import DECISION
from openjax.gap.model.physics import Path
from openjax.gap.model.prediction import FORCE, RATES, VELOCITY
from openjax.gap.shapes import Rows

SIZE = {
    name: float(entry["size"])
    for name, entry in tomllib.loads(
        pathlib.Path(__file__).with_suffix(".toml").read_text(encoding="utf-8")
    ).items()
}
UNKNOWN_GAIN = DECISION.gyroscope_gain / DECISION.nuisance_bound
"""Of a gyroscope that no attitude was logged beside: nothing else tells its gain from
another inertia about all axes.
"""
# s: what motors do more slowly is no answer to a gust, but what the vehicle needs
TRIM = 0.5
FEEDBACK_ROWS, QUICK_ROWS = (0, 2), (0, 1, 2)  # rows of delay
# Nuisances that belong to a block of flight, not to the vehicle: noise of the gyroscope
# weakens feedback where little else moves.
OF_A_BLOCK = ("feedback",)


def columns_of(track: Track, path: Path, nominal, feedback, at_once: bool) -> dict[str, Rows]:
    """{name: column (T, 9)} of one track, of what doesn't depend on what acts; the
    arguments as in `make_replay`.
    """
    columns = _late_torques("feedback", track, feedback.acceleration, FEEDBACK_ROWS)
    # slow parts are the same some rows later
    columns |= _late_torques("trim", track, feedback.trim, (0,))
    if at_once:
        columns |= _late_torques("motors within a row", track, feedback.quick, QUICK_ROWS)
    return columns | _sensor_nuisances(track, path, nominal)


def _sensor_nuisances(track: Track, path: Path, nominal: np.ndarray) -> dict[str, np.ndarray]:
    """Mounting, biases and clocks of the sensors, and what a rigid body with small
    errors does: columns (T, 9).
    """
    rows = len(track)
    attitude = np.asarray(path.quaternion, float)[:rows]
    body = specific_force_of(attitude, nominal[:, VELOCITY], track.dt)
    columns: dict[str, np.ndarray] = {}

    def column(name: str, channel, values, size: float) -> None:
        out = np.zeros((rows, 9))
        out[:, channel] = values
        columns[name] = columns.get(name, 0.0) + out * size

    # what a change of the body-frame acceleration does to the velocity
    def velocity_change(acceleration):
        return np.cumsum(to_world(attitude, acceleration), 0) * track.dt

    rates = smooth(track.body_rates, 0.03, track.dt)
    force = nominal[:, FORCE]
    for name, axis in zip("xy", np.eye(3), strict=False):
        column(
            f"frame tilt {name}",
            VELOCITY,
            velocity_change(np.cross(axis, body)),
            SIZE["frame_tilt"],
        )
    # another in each flight, as a chip's temperature is
    for number, name in enumerate("xyz"):
        column(
            f"accelerometer bias {name} of {track.flight}",
            6 + number,
            1.0,
            SIZE["accelerometer_bias"],
        )
    for name, axis in zip("xyz", np.eye(3), strict=True):
        column(f"IMU tilt {name}", RATES, -np.cross(axis, rates - rates[0]), SIZE["imu_tilt"])
        column(f"IMU tilt {name}", FORCE, -np.cross(axis, force), SIZE["imu_tilt"])
    for axis, name in enumerate("xyz"):
        # Euler's equations: about an axis acts the product of the other two rates
        turning = np.cumsum(rates[:, axis - 2] * rates[:, axis - 1]) * track.dt
        column(f"gyroscopic torque {name}", axis, turning, SIZE["gyroscopic"])
    for name, axes in (("roll and pitch damping", (0, 1)), ("yaw damping", (2,))):
        column(name, axes, -np.cumsum(rates, 0)[:, axes] * track.dt, SIZE["damping"])
    for axis, name in enumerate("xy"):
        column(
            f"level of the world {name}",
            3 + axis,
            GRAVITY * track.dt * np.arange(rows),
            SIZE["world_level"],
        )
    column(
        "accelerometer's low-pass",
        FORCE,
        -np.gradient(force, track.dt, axis=0),
        SIZE["accelerometer_lag"],
    )
    spinning = np.gradient(nominal[:, RATES], track.dt, axis=0)
    column("gyroscope's low-pass", RATES, -(spinning - spinning[0]), SIZE["gyroscope_lag"])
    if not track.logs_attitude:
        column("gyroscope's gain", RATES, nominal[:, RATES], UNKNOWN_GAIN)
    if track.velocity is not None:
        late = -velocity_change(np.cross(np.asarray(path.body_rates, float)[:rows], body))
        late += smooth(np.gradient(track.velocity, track.dt, axis=0), 0.05, track.dt)
        column("clock of the pose", VELOCITY, late, SIZE["pose_clock"])
    return columns


def _late_torques(
    name: str, track: Track, acceleration: np.ndarray, delays
) -> dict[str, np.ndarray]:
    """Columns (T, 9) of angular accelerations by roll and pitch, yaw, at some delays: a
    filter of any shape.
    """
    columns = {}
    for rows in delays:
        late = np.concatenate([np.zeros((rows, 3)), acceleration[: len(acceleration) - rows]])
        for axes, mask in (("roll and pitch", [1.0, 1.0, 0.0]), ("yaw", [0.0, 0.0, 1.0])):
            columns[f"{name}, {axes}, {rows} rows late"] = (
                torque_channels(late * mask, track.dt) * SIZE["feedback"]
            )
    return columns


def torque_channels(
    acceleration: Float[np.ndarray, "rows 3"], dt: float
) -> Float[np.ndarray, "rows 9"]:
    """Channels (T, 9) of an angular acceleration (T, 3)."""
    column = np.zeros((len(acceleration), 9))
    # what a row's interval does shows at its end, the next row
    column[1:, RATES] = np.cumsum(acceleration[:-1], 0) * dt
    return column
