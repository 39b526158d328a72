"""The names of a virtual Crazyflie's firmware: log variables and parameters, with their types and
values.
"""

import zlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from openjax.flying.controller import roll_pitch_yaw
from openjax.flying.crtp import FULL_SCALE, compress_quaternion


@dataclass(frozen=True)
class Sensors:
    """The firmware's knowledge of its vehicle; SI units, frames as everywhere in openjax."""

    position: np.ndarray  # (3,) m
    velocity: np.ndarray  # (3,) m/s
    quaternion: np.ndarray  # (4,) wxyz
    body_rates: np.ndarray  # (3,) rad/s
    specific_force: np.ndarray  # (3,) m/s^2, body
    motor_command: np.ndarray  # (4,) 0..1
    voltage: float = 4.1  # V


def _angles(quaternion):
    """Roll, pitch, yaw in degrees; pitch with the firmware's inverted sign."""
    return np.degrees(roll_pitch_yaw(quaternion)) * (1.0, -1.0, 1.0)


def _log_variables() -> dict[str, tuple[str, Callable]]:
    """Name -> C type and value of (firmware, sensors): the variables that a flight
    needs, named as on board.
    """
    table: dict[str, tuple[str, Callable]] = {}
    for i, axis in enumerate("xyz"):
        table[f"stateEstimate.{axis}"] = ("float", lambda f, s, i=i: s.position[i])
        table[f"stateEstimate.v{axis}"] = ("float", lambda f, s, i=i: s.velocity[i])
        table[f"stateEstimateZ.{axis}"] = ("int16_t", lambda f, s, i=i: 1000 * s.position[i])
        table[f"stateEstimateZ.v{axis}"] = ("int16_t", lambda f, s, i=i: 1000 * s.velocity[i])
        table[f"acc.{axis}"] = ("float", lambda f, s, i=i: s.specific_force[i] / 9.81)
        table[f"gyro.{axis}"] = ("float", lambda f, s, i=i: np.degrees(s.body_rates[i]))
        table[f"locSrv.{axis}"] = ("float", lambda f, s, i=i: f.external_pose[i])
    for i, name in enumerate(("roll", "pitch", "yaw")):
        table[f"stateEstimate.{name}"] = ("float", lambda f, s, i=i: _angles(s.quaternion)[i])
    for i, name in enumerate(("qw", "qx", "qy", "qz")):
        table[f"stateEstimate.{name}"] = ("float", lambda f, s, i=i: s.quaternion[i])
        table[f"locSrv.{name}"] = ("float", lambda f, s, i=i: f.external_pose[3 + i])
        table[f"motor.m{i + 1}"] = ("uint16_t", lambda f, s, i=i: FULL_SCALE * s.motor_command[i])
    table["stateEstimateZ.quat"] = ("uint32_t", lambda f, s: compress_quaternion(s.quaternion))
    table["pm.vbat"] = ("float", lambda f, s: s.voltage)
    table["pm.vbatMV"] = ("uint16_t", lambda f, s: 1000 * s.voltage)
    table["supervisor.info"] = ("uint16_t", lambda f, s: f.supervisor_info)
    return dict(sorted(table.items()))


LOG_VARIABLES = _log_variables()
LOG_NAMES = tuple(LOG_VARIABLES)
PARAMETERS = {
    "commander.enHighLevel": ("uint8_t", 0),
    "firmware.modified": ("uint8_t", 1),
    "firmware.revision0": ("uint16_t", 0),
    "flightmode.stabModePitch": ("uint8_t", 1),
    "flightmode.stabModeRoll": ("uint8_t", 1),
    "flightmode.stabModeYaw": ("uint8_t", 0),
    "kalman.resetEstimation": ("uint8_t", 0),
    "locSrv.extPosStdDev": ("float", 0.01),
    "locSrv.extQuatStdDev": ("float", 4.5e-3),
    "stabilizer.controller": ("uint8_t", 1),
    "stabilizer.estimator": ("uint8_t", 2),
}
"""Name -> C type and first value. Written values are kept and change nothing."""
PARAMETER_NAMES = tuple(PARAMETERS)
READ_ONLY_GROUP = "firmware"


def _crc(table) -> int:
    return zlib.crc32(repr([(name, table[name][0]) for name in table]).encode())


LOG_CRC = _crc(LOG_VARIABLES)
PARAMETER_CRC = _crc(PARAMETERS)
