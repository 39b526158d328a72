"""Rows of a log: what sensors, motion capture and radio make of a flight's truth."""

import numpy as np
from scipy.signal import butter, lfilter, lfilter_zi

from experiments.diagnosis import unknowns, vehicle
from experiments.diagnosis.firmware import SAMPLE
from experiments.diagnosis.sensors import COLUMNS, DECIMALS, GROUPS, coloured, vibration


def at(signal, times):
    """(S, n) or (S,) truth every 2 ms, at `times` (s), linearly."""
    place = np.clip(np.asarray(times) / SAMPLE, 0, len(signal) - 1.001)
    whole = place.astype(int)
    rest = place - whole
    rest = rest[:, None] if signal.ndim == 2 else rest
    return signal[whole] + rest * (signal[whole + 1] - signal[whole])


def _through(cut, signal):
    """A (S, n) signal through the second-order low-pass of `cut` Hz, started in rest."""
    if not cut:
        return signal
    low = butter(2, cut, fs=1 / SAMPLE)
    return lfilter(*low, signal, axis=0, zi=lfilter_zi(*low)[:, None] * signal[:1])[0]


def _pose(rng, sensors, flown, j, times, delay):
    """Position, orientation, velocity (n, 10) of the motion capture at its own `times`."""
    size = sensors["size"]
    n = len(times)
    step = float(np.median(np.diff(times)))
    when = times - delay
    position = at(flown["position"][:, :, j].astype(float), when)
    white = sensors["position"] * rng.standard_normal((n, 3))
    position += white + coloured(rng, n, 3, 1.0, 1.5e-4 * size, step)
    angle = sensors["angle"] * rng.standard_normal((n, 3)) + coloured(
        rng, n, 3, 1.5, 8e-4 * size, step
    )
    velocity = at(flown["velocity"][:, :, j].astype(float), when)
    # smoothed: hardly any white noise, slow errors instead
    if sensors["kind"] == "estimator":
        slow = sensors["colour"]
        time = sensors["colour_time"]
        wander = coloured(rng, n, 3, time, slow * 6e-4 * size, step)
        position += wander - sensors["position"] * 0.8 * rng.standard_normal((n, 3))
        angle = coloured(rng, n, 3, time, slow * 2.5e-3 * size, step)
        velocity += coloured(rng, n, 3, time, slow * 5e-3 * size, step)
    elif sensors["velocity"] == "derived":
        velocity = smooth_derivative(position, step)
    else:
        velocity += 3e-3 * size * rng.standard_normal((n, 3)) + coloured(
            rng, n, 3, 0.3, 1e-3 * size, step
        )
    if sensors["kind"] == "coloured":
        velocity += coloured(
            rng, n, 3, sensors["colour_time"], 3e-3 * size * sensors["colour"], step
        )
    q = at(flown["quaternion"][:, :, j].astype(float), when)
    q = vehicle.multiply(q.T, np.concatenate([np.ones((1, n)), 0.5 * angle.T]))
    return np.concatenate([position, (q / np.sqrt((q * q).sum(axis=0))).T, velocity], axis=1)


def smooth_derivative(position, step):
    """Least-squares slope over seven samples."""
    half = np.arange(-3, 4)
    padded = np.concatenate(
        [np.repeat(position[:1], 3, 0), position, np.repeat(position[-1:], 3, 0)]
    )
    out = sum(h * padded[3 + h : 3 + h + len(position)] for h in half) / (28.0 * step)
    out[:3], out[-3:] = out[3], out[-4]
    return out


def _inputs(flown, j, times, hover):
    """What `unknowns.misread` depends on, from the truth at `times`."""
    names = ("position", "quaternion", "velocity", "rates", "motor")
    rows = [at(flown[name][:, :, j].astype(float), times).T for name in names]
    return unknowns.inputs_of(*rows, at(flown["voltage"][:, j].astype(float), times), hover)


def log_rows(rng, sensors, flown, j, ticks, unknown=(), hover=0.5):
    """Rows of body j: dict column -> (n,) with NaN where a channel was not sampled; `t` first. All
    groups are made, the caller leaves out what was not logged. `unknown`: causes that sit in
    sensors.
    """
    seconds = 0.01 * ticks
    rate = sensors["rate"]
    t = np.arange(int(seconds * rate)) / rate
    if sensors["dropped"]:
        keep = rng.random(len(t)) >= sensors["dropped"]
        keep[:3] = True
        t = t[keep]
    n = len(t)
    wander = None
    if sensors["wander"]:
        wander = coloured(rng, len(flown["rates"]), 2, 2.0, 1e-3 * sensors["wander"], SAMPLE)

    def stream(signal, times, clock):
        """A 500 Hz signal as its stream delivers it at `times`, by the IMU's clock (0) or the
        motors' (1).
        """
        own = np.arange(0, seconds, 1 / sensors["stream_rate"]) if sensors["stream_rate"] else times
        values = at(signal, own + (0.0 if wander is None else at(wander[:, clock], own)))
        if own is times:
            return values
        return np.stack(
            [np.interp(times, own, values[:, i]) for i in range(values.shape[1])], axis=1
        )

    out = {"t": t}
    # pose: at its own rate, empty cells between, held (stale) or interpolated
    own = np.arange(0, seconds, 1 / sensors["pose_rate"]) if sensors["pose_rate"] < rate else t
    delay = 1e-3 * sensors["pose_delay"] + flown["pose_delay"][j]
    if flown["pose_jitter"][j]:
        delay = delay + flown["pose_jitter"][j] * rng.uniform(-1, 1, len(own))
    pose = _pose(rng, sensors, flown, j, own, delay)
    if len(own) != n and sensors["kind"] == "stale":
        pose = pose[np.searchsorted(own, t + 1e-9) - 1]
    elif len(own) != n:
        row = np.searchsorted(t, own - 0.5 / rate)
        ok = row < n
        empty = np.full((n, 10), np.nan)
        empty[row[ok]] = pose[ok]
        pose = empty
    wrong = unknowns.misread(unknown, _inputs(flown, j, t, hover), t) if unknown else {}
    pose[:, :3] += wrong.get("unknown_position", 0.0)
    if "unknown_attitude" in wrong:
        pose[:, 3:7] = unknowns.turned(pose[:, 3:7], wrong["unknown_attitude"])

    # IMU: the firmware's gyroscope, and the accelerometer with its own noise, vibration and filter
    tilt = np.array(sensors["tilt"])
    gyro = flown["gyro"][:, :, j].astype(float)
    accel = flown["specific"][:, :, j].astype(float)
    samples = len(accel)
    accel = (
        accel
        - np.cross(np.broadcast_to(tilt, accel.shape), accel)
        + np.array(sensors["accel_bias"])
    )
    noise = sensors["accel"] * rng.standard_normal((samples, 3))
    noise += coloured(rng, samples, 3, 3.0, 0.02, SAMPLE)
    if sensors["colour"]:
        noise += coloured(rng, samples, 3, 0.02, 0.4 * sensors["accel"] * sensors["colour"], SAMPLE)
    if sensors["vibration"]:
        noise += vibration(rng, sensors, samples, sensors["vibration"])
    accel = _through(sensors["accel_cut"], accel + noise)
    gyro = gyro - np.cross(np.broadcast_to(tilt, gyro.shape), gyro)

    motor = flown["motor"][:, :, j].astype(float)
    if sensors["motor"] == "mean" and rate <= 500:
        # the mean over the row, whose end may lie within a sample
        total = np.concatenate([np.zeros((1, 4)), np.cumsum(motor, axis=0)])
        width = min(500 / rate, samples)
        last = np.minimum(np.arange(samples) + width, samples)
        total_then = np.stack(
            [np.interp(last, np.arange(samples + 1), total[:, i]) for i in range(4)], 1
        )
        motor = (total_then - total[:samples]) / (last - np.arange(samples))[:, None]
    place = np.minimum((t / SAMPLE + 1e-6).astype(int), samples - 1)
    motors = stream(motor, t, 1) if sensors["stream_rate"] else motor[place]
    tick = np.minimum((t / 0.01 + 1e-6).astype(int), len(flown["command"]) - 1)
    command = flown["command"][tick, :, j].astype(float)
    voltage = flown["voltage"][place, j] + 0.012 * rng.standard_normal(n)
    seldom = np.floor(t * 10 + 1e-6)
    voltage[np.concatenate([[False], seldom[1:] == seldom[:-1]])] = np.nan
    gyro = stream(gyro, t, 0) + wrong.get("unknown_gyroscope", 0.0)
    accel = stream(accel, t, 0) + wrong.get("unknown_accelerometer", 0.0)
    values = np.concatenate([pose, gyro, accel, command, motors, voltage[:, None]], axis=1)
    for i, column in enumerate(COLUMNS[2:]):
        step = 10.0 ** -DECIMALS[column]
        if sensors["quantum"] > 1 and column not in GROUPS["c"]:
            step *= sensors["quantum"]
        out[column] = step * np.rint(values[:, i] / step)
    return out
