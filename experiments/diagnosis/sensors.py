"""The family of sensors and logs: what a case's vehicle carries, and the air that it flies in.

`draw` makes a case's set-up; eight kinds of sensors, two of which (`STRANGERS`) are drawn for
reported runs only. Every case, "none" included, has biases, a tilt up to 1 degree between IMU and
tracked frame, a thrust offset up to 0.8 % and constants off by up to 1 % beside what is told.
"""

import numpy as np
from scipy.signal import lfilter

from experiments.diagnosis.firmware import SAMPLE

KINDS = ("white", "coloured", "filtered", "vibrating", "quantised", "radio")
STRANGERS = ("estimator", "stale")
RATES = {50: 0.15, 100: 0.5, 200: 0.1, 250: 0.08, 500: 0.12, 1000: 0.05}
# letter of a channel group -> its columns
GROUPS = {
    "p": ["x", "y", "z", "qw", "qx", "qy", "qz"],
    "s": ["vx", "vy", "vz"],
    "g": ["wx", "wy", "wz"],
    "a": ["ax", "ay", "az"],
    "c": ["cmd_thrust", "cmd_wx", "cmd_wy", "cmd_wz"],
    "m": ["m1", "m2", "m3", "m4"],
    "v": ["vbat"],
}
COLUMNS = ["t", "vehicle", *(column for group in GROUPS.values() for column in group)]
DIGITS = (4,) * 3 + (5,) * 4 + (4,) * 3 + (4,) * 3 + (3,) * 3 + (4,) + (3,) * 3 + (4,) * 4 + (3,)
LOGGED = {"p": 0.88, "g": 0.9, "a": 0.85, "s": 0.6, "c": 0.75, "m": 0.92, "v": 0.8}
"""How often a log has a group."""
DECIMALS = dict(zip(COLUMNS[2:], DIGITS, strict=True))
# mN rms per axis
TURBULENCE = {"none": (0.0, 0.05), "light": (0.3, 1.2), "strong": (2.0, 4.0)}


def coloured(rng, count, axes, time, rms, step):
    """First-order noise (count, axes) of correlation time `time` (s) and the given rms, sampled
    every `step` (s).
    """
    keep = np.exp(-step / time)
    white = rng.standard_normal((count, axes)) * np.sqrt(1 - keep**2)
    white[0] /= np.sqrt(1 - keep**2)
    return rms * lfilter([1.0], [1.0, -keep], white, axis=0)


def narrow(rng, count, axes, frequency, quality, rms, step):
    """Narrow-band noise (count, axes) around `frequency` (Hz): white noise through a resonance of
    the given quality.
    """
    pole = np.exp(-np.pi * frequency / quality * step)
    a = [1.0, -2 * pole * np.cos(2 * np.pi * frequency * step), pole * pole]
    signal = lfilter([1.0], a, rng.standard_normal((count + 500, axes)), axis=0)[500:]
    return rms * signal / np.sqrt((signal**2).mean())


def _channels(rng, needed):
    """Letters of the logged groups: what an effect needs is there, the rest is drawn; always a
    legal log.
    """
    have = set(needed) | {letter for letter, chance in LOGGED.items() if rng.random() < chance}
    if "p" not in have:
        have -= {"s"}
        have |= {"a", "g"}
    if "g" not in have:
        have |= {"p"}
    if not have & {"c", "m"}:
        have.add("m")
    return have


def draw(rng, kind, needed="", turbulence=None):
    """Sensors and air of a case: a dict of plain numbers, see the keys below. `needed`: letters of
    `GROUPS`.
    """
    # good and bad instruments
    size = float(np.exp(rng.uniform(np.log(0.5), np.log(2.0))))
    tilt = rng.standard_normal(3)
    tilt *= np.deg2rad(rng.uniform(0, 1.0)) / np.linalg.norm(tilt)
    filtered = kind == "filtered" or rng.random() < 0.5
    turbulence = turbulence or str(rng.choice(list(TURBULENCE), p=[0.35, 0.45, 0.2]))
    rate = (
        int(rng.choice(list(RATES), p=list(RATES.values())))
        if kind not in ("radio", "stale")
        else 100
    )
    out = {
        "kind": kind,
        "rate": rate,
        "channels": "".join(sorted(_channels(rng, needed))),
        "size": size,
        "tilt": tilt.tolist(),
        "accel_bias": rng.uniform(-0.35, 0.35, 3).tolist(),
        "gyro_bias": rng.uniform(-0.02, 0.02, 3).tolist(),
        "thrust_offset": float(rng.uniform(-0.008, 0.008)),
        "constants_off": rng.uniform(
            -0.01, 0.01, 5
        ).tolist(),  # motor time, yaw torque, three moments
        "turbulence": turbulence,
        "gust": float(rng.uniform(*TURBULENCE[turbulence])),
        "pose_delay": float(rng.uniform(0.0, 2.5)),  # ms
        "pose_rate": int(rng.choice([60, 100, 120, 240])) if rate > 100 else min(rate, 100),
        "position": 2.0e-4 * size,  # m, white
        "angle": 1.8e-3 * size,  # rad, white
        "accel": 0.16 * size,
        "gyro": 0.008 * size,
        "colour": 0.0,  # rms of the coloured part, in units of the white one
        "colour_time": float(np.exp(rng.uniform(np.log(0.02), np.log(0.3)))),
        "accel_cut": 30.0 if filtered else 0.0,
        "gyro_cut": 80.0 if filtered else 0.0,
        "derivative_cut": float(rng.choice([0.0, 0.0, 30.0, 60.0])),
        "vibration": 0.0,  # m/s^2 rms; the gyroscope gets 0.04 rad/s of it per m/s^2
        "vibration_frequency": float(rng.uniform(12.0, 90.0)),
        "vibration_quality": float(rng.uniform(5.0, 25.0)),
        "quantum": 1.0,  # 1: as many digits as the log has
        "velocity": str(rng.choice(["smooth", "derived"])),
        "motor": "mean" if rng.random() < 0.7 else "snapshot",
        "wander": 0.0,  # ms rms of the clocks of IMU and motors against the pose
        # Hz of the streams that were interpolated onto the rows; 0: sampled at the rows
        "stream_rate": 0.0,
        "dropped": float(rng.choice([0.0, 0.0, 0.01, 0.04])),
        "voltage": float(rng.uniform(3.6, 4.05)),
        "resistance": float(rng.uniform(0.12, 0.3)),
        "discharge": float(rng.uniform(0.01, 0.03)),
    }
    if kind == "coloured":
        out |= {"colour": float(rng.uniform(1.0, 3.0)), "velocity": "smooth"}
    elif kind == "vibrating":
        out |= {"vibration": float(rng.uniform(0.3, 2.0))}
    elif kind == "quantised":
        out |= {"quantum": float(rng.choice([4.0, 10.0, 20.0]))}
    elif kind == "radio":
        out |= {"wander": float(rng.uniform(2.0, 10.0)), "stream_rate": float(rng.uniform(70, 90))}
    elif kind == "estimator":
        out |= {
            "colour": float(rng.uniform(1.5, 4.0)),
            "colour_time": float(rng.uniform(0.15, 0.5)),
        }
        out |= {"velocity": "smooth"}
    elif kind == "stale":
        out |= {"pose_rate": int(rng.choice([45, 60, 72]))}
    return out


def draw_air(rng, sensors, ticks, voltage, strong=1.0):
    """Air, gyroscope and pose of one body in one flight as `plant.fly` wants them (no body axis
    yet).
    """
    samples = 5 * ticks
    size = sensors["size"]
    gust = 1e-3 * sensors["gust"] * strong
    force = coloured(rng, ticks, 3, 0.35, gust, 0.01) + coloured(
        rng, ticks, 3, 0.05, 0.4 * gust, 0.01
    )
    torque = coloured(rng, ticks, 3, 0.08, 0.013 * gust, 0.01) * np.array([1.0, 1.0, 0.5])
    gyro = sensors["gyro"] * rng.standard_normal((samples, 3))
    if sensors["colour"]:
        gyro += coloured(rng, samples, 3, 0.02, 0.4 * sensors["gyro"] * sensors["colour"], SAMPLE)
    if sensors["vibration"]:
        gyro += vibration(rng, sensors, samples, 0.04 * sensors["vibration"])
    angle = 1.5e-3 * size * rng.standard_normal((ticks, 3))
    return {
        "gust_force": force.astype(np.float32),
        "gust_torque": torque.astype(np.float32),
        "slow": coloured(rng, ticks, 1, 1.2, 1.0, 0.01)[:, 0],
        "gyro": gyro.astype(np.float32),
        "gyro_bias": np.array(sensors["gyro_bias"]) + 0.003 * rng.standard_normal(3),
        "seen_position": 2e-4 * size * rng.standard_normal((ticks, 3)),
        "seen_velocity": 4e-3 * size * rng.standard_normal((ticks, 3)),
        "seen_attitude": np.concatenate([np.ones((ticks, 1)), 0.5 * angle], axis=1),
        "pose_delay": np.float64(sensors["pose_delay"]),
        "pose_jitter": rng.uniform(-1, 1, ticks),
        "open_voltage": np.float64(voltage),
        "resistance": np.float64(sensors["resistance"]),
        "discharge": np.float64(sensors["discharge"]),
    }


def holds_poses(sensors):
    """Whether rows repeat the last pose, which makes them late by half the hold on average,
    whatever flies.
    """
    return sensors["kind"] == "stale" and "p" in sensors["channels"]


def pose_lag(delay_ms, sensors):
    """By how much poses in the log are late, ms: the cause together with the motion capture's own;
    None if they are held.
    """
    return None if holds_poses(sensors) else delay_ms + sensors["pose_delay"]


def stack(flights):
    """List of `draw_air` dicts to one with the body index last."""
    return {key: np.stack([np.asarray(f[key]) for f in flights], axis=-1) for key in flights[0]}


def vibration(rng, sensors, samples, rms):
    frequency = sensors["vibration_frequency"]
    quality = sensors["vibration_quality"]
    return narrow(rng, samples, 3, frequency, quality, rms, SAMPLE) * np.array([1.0, 1.0, 0.6])


def apply_nuisances(p, columns, sensors):
    """What is off in every case: thrust, motor time, yaw torque, moments of inertia, and the
    firmware's filters.
    """
    lag, yaw, *moments = sensors["constants_off"]
    p["rotor_gain"][:, columns] *= 1 + sensors["thrust_offset"]
    p["tau_up"][columns] *= 1 + 3 * lag
    p["tau_down"][columns] *= 1 + 3 * lag
    p["torque_ratio"][columns] *= 1 + yaw
    for i, off in enumerate(moments):
        p["inertia"][i, i, columns] *= 1 + off
    p["gyro_cut"][columns], p["derivative_cut"][columns] = (
        sensors["gyro_cut"],
        sensors["derivative_cut"],
    )
