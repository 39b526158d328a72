"""Noise of the withheld plant, drawn per flight and vehicle, and the log columns made from it.

In every case, "none" included: white and coloured sensor noise, IMU bias and a tilt up to 1 degree between
IMU and tracked frame, a mocap delay and jitter of a few ms, a thrust offset up to 1 %, light gusts (first-
order Dryden-like forces and torques) and a discharging battery.
"""

import numpy as np
from scipy.signal import lfilter

GUST_FORCE = 0.9e-3  # N rms per axis
MOCAP_JITTER = 0.4  # ms, standard deviation of the extra delay before its absolute value is taken
GUST_TORQUE = 1.2e-5  # N m rms per axis (roll, pitch); yaw half


def _coloured(rng, ticks, axes, time, rms, step=0.01):
    """First-order noise (ticks, axes) of correlation time `time` (s) and the given rms."""
    keep = np.exp(-step / time)
    white = rng.standard_normal((ticks, axes)) * np.sqrt(1 - keep**2)
    white[0] /= np.sqrt(1 - keep**2)
    return rms * lfilter([1.0], [1.0, -keep], white, axis=0)


def draw_case(rng):
    """What all flights of a case share: sensor mounting, thrust and clock offset, size of the gusts."""
    tilt = rng.standard_normal(3)
    tilt *= np.deg2rad(rng.uniform(0, 1.0)) / np.linalg.norm(tilt)
    return {
        "tilt": tilt,
        "accel_bias": rng.uniform(-0.35, 0.35, 3),
        "gyro_bias": rng.uniform(-0.02, 0.02, 3),
        "thrust_offset": rng.uniform(-0.008, 0.008),
        "gust": rng.uniform(0.6, 1.4),
        "mocap_delay": rng.uniform(0.0, 2.5),
        "voltage": rng.uniform(3.55, 4.0),
        "resistance": rng.uniform(0.12, 0.3),
        "discharge": rng.uniform(0.01, 0.03),
    }


def draw_flight(rng, case, ticks, open_voltage):
    """Noise of one body in one flight, keyed as `plant.fly` and `log_rows` want it (no body axis yet)."""
    angle = 0.0018 * rng.standard_normal((ticks, 3)) + _coloured(rng, ticks, 3, 1.5, 0.0008)
    attitude = np.concatenate([np.ones((ticks, 1)), 0.5 * angle], axis=1)
    gust = case["gust"]
    force = _coloured(rng, ticks, 3, 0.35, GUST_FORCE * gust) + _coloured(
        rng, ticks, 3, 0.05, 0.4 * GUST_FORCE * gust
    )
    torque = _coloured(rng, ticks, 3, 0.08, GUST_TORQUE * gust) * np.array([1.0, 1.0, 0.5])
    loop = _coloured(rng, 5 * ticks, 3, 0.002, 0.006, step=0.002)
    drift = _coloured(rng, ticks, 3, 4.0, 0.002)
    return {
        "position": 2.0e-4 * rng.standard_normal((ticks, 3)) + _coloured(rng, ticks, 3, 1.0, 1.5e-4),
        "velocity": 3.0e-3 * rng.standard_normal((ticks, 3)) + _coloured(rng, ticks, 3, 0.3, 1.0e-3),
        "attitude": attitude,
        "gust_force": force,
        "gust_torque": torque,
        "slow": _coloured(rng, ticks, 1, 1.2, 1.0)[:, 0],
        "gyro_loop": loop,
        "gyro_bias": case["gyro_bias"] + 0.003 * rng.standard_normal(3),
        "gyro": 0.015 * rng.standard_normal((ticks, 3)) + drift + _coloured(rng, ticks, 3, 0.02, 0.006),
        "accel": 0.16 * rng.standard_normal((ticks, 3))
        + _coloured(rng, ticks, 3, 0.02, 0.08)
        + _coloured(rng, ticks, 3, 3.0, 0.02),
        "accel_bias": case["accel_bias"] + 0.02 * rng.standard_normal(3),
        "tilt": case["tilt"],
        "mocap_delay": case["mocap_delay"],
        "mocap_jitter": np.abs(MOCAP_JITTER * rng.standard_normal(ticks)),
        "pose_jitter": rng.uniform(-1, 1, ticks),
        "open_voltage": open_voltage,
        "resistance": case["resistance"],
        "discharge": case["discharge"],
        "voltage": 0.012 * rng.standard_normal(ticks),
    }


def stack(noises):
    """List of `draw_flight` dicts to one dict with the body index last."""
    return {key: np.stack([np.asarray(n[key]) for n in noises], axis=-1) for key in noises[0]}


COLUMNS = (
    "t,vehicle,x,y,z,qw,qx,qy,qz,vx,vy,vz,wx,wy,wz,ax,ay,az,cmd_thrust,cmd_wx,cmd_wy,cmd_wz,m1,m2,m3,m4,vbat"
).split(",")


def log_rows(flown, noise, index, ticks):
    """Logged values (ticks, 25) of body `index`, columns after t and vehicle; vbat is NaN where it was not
    sampled.
    """

    def take(name):
        return flown[name][:ticks, :, index].astype(float)

    tilt = noise["tilt"][:, index]
    gyro = take("rates") + noise["gyro_bias"][:, index]
    accel = take("specific")
    # small-angle turn from the tracked frame into the IMU's
    gyro_seen = gyro - np.cross(np.broadcast_to(tilt, gyro.shape), gyro) + noise["gyro"][:ticks, :, index]
    accel_seen = (
        accel
        - np.cross(np.broadcast_to(tilt, accel.shape), accel)
        + noise["accel_bias"][:, index]
        + noise["accel"][:ticks, :, index]
    )
    voltage = flown["voltage"][:ticks, index] + noise["voltage"][:ticks, index]
    voltage[np.arange(ticks) % 10 != 0] = np.nan
    quaternion = take("measured_quaternion")
    return np.concatenate(
        [
            take("measured_position"),
            quaternion,
            take("measured_velocity"),
            gyro_seen,
            accel_seen,
            take("command"),
            take("motor"),
            voltage[:, None],
        ],
        axis=1,
    )


DECIMALS = (4,) * 3 + (5,) * 4 + (4,) * 3 + (4,) * 3 + (3,) * 3 + (4,) + (3,) * 3 + (4,) * 4 + (3,)
