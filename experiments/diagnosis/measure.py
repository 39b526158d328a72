"""How much an effect shows, by the plant's own measure.

The vehicle is replayed along the true motion in short windows, driven by the motor commands that it
got: the change of velocity over 0.25 s (force, body axes) and of the body rates over 0.05 s
(torque), with the true position, attitude, velocity and rates at every step and the model's own
rotors. The firmware is run along the true gyroscope and the commands as issued: motor commands
(roll, pitch, yaw), without what is slower than half a second. The turn of the pose over 0.1 s is
set against the body rates. Errors are divided by the case's noise floor: what is left with the true
model when the logged motor commands drive it (turbulence, and rows that see little of the motors)
together with what the case's sensors add over the same horizons. A channel that the logs do not
hold has no finite floor. Severity is the largest ratio of a channel; energies are mean squares in
floors.
"""

import numpy as np
from scipy.ndimage import uniform_filter1d

from experiments.diagnosis import vehicle as v
from experiments.diagnosis.body import Body
from experiments.diagnosis.firmware import SAMPLE, Firmware
from experiments.diagnosis.plant import PER_TICK
from experiments.diagnosis.rows import at, smooth_derivative
from experiments.diagnosis.sensors import GROUPS

LONG, SHORT, TURN = 125, 25, 50  # samples of 2 ms
EVERY = 100
FIRST = 500
CHANNELS = [f"{c}_{a}" for c in ("force", "torque", "motor", "pose") for a in ("x", "y", "z")]
MIX = np.array([[-1, -1, 1, 1], [-1, 1, 1, -1], [-1, 1, -1, 1]]) / 4.0
THRUST_ALLOWANCE = 0.008  # of the thrust, free in every hypothesis


def errors(flown, told, parameters, partner, other_firmware, links):
    """Root-mean-square errors (12, B) of the model `parameters`.

    `other_firmware` (B,): the model's commands, gains or filters differ from those that flew;
    `links` (B,): it knows which commands arrived.
    """
    samples, _, count = flown["position"].shape
    neutral = v.nominal_parameters(told)
    starts = np.arange(FIRST, samples - LONG - 1, EVERY)
    valid = starts[:, None] + LONG < flown["crashed"][None] - 25

    def gather(name, offset=0):
        values = flown[name][starts + offset].astype(float)
        return np.moveaxis(values, 0, -2).reshape(*values.shape[1:-1], -1)

    def spread(p):
        return {
            k: np.tile(x, len(starts)) if x.ndim == 1 else _tile(x, len(starts))
            for k, x in p.items()
        }

    wide = spread(parameters)
    wide_neutral = spread(neutral)
    columns = (np.arange(len(starts))[:, None] * count + partner[None]).reshape(-1)
    alone = np.tile(np.where(partner == np.arange(count), -10.0, 0.0), len(starts)) * np.array(
        [[0], [0], [1.0]]
    )
    body = Body(
        wide,
        wide_neutral,
        *(gather(n) for n in ("position", "velocity", "quaternion", "rates", "rotor")),
    )
    q0 = body.q
    zero = np.zeros_like(body.rates)
    moved = np.zeros_like(zero)
    turned = np.zeros_like(zero)
    for s in range(LONG):
        m = gather("motor", s)
        voltage = gather("voltage", s)
        load = gather("load", s)
        other = gather("position", s)
        body.position, body.velocity, body.q, body.rates = (
            other,
            gather("velocity", s),
            gather("quaternion", s),
            gather("rates", s),
        )
        velocity = body.velocity
        rates = body.rates
        for _ in range(2):
            body.step(m, voltage, load, zero, zero, 0.0, [other[:, columns] + alone])
        moved += body.velocity - velocity
        if s < SHORT:
            turned += body.rates - rates
    velocity_error = v.rotate_back(q0, gather("velocity", LONG) - gather("velocity") - moved)
    rate_error = gather("rates", SHORT) - gather("rates") - turned

    def rms(error):
        squares = np.where(valid, error.reshape(3, len(starts), count) ** 2, 0.0).sum(axis=1)
        return np.sqrt(squares / np.maximum(valid.sum(axis=0), 1))

    turned = np.cumsum(flown["rates"], axis=0, dtype=float) * SAMPLE
    late = (flown["pose_delay"] - 1e-3 * parameters["pose_delay"]) / SAMPLE
    whole = np.floor(late).astype(int)
    turn = np.zeros((3, len(starts), count))
    for j in np.flatnonzero(np.abs(late) > 1e-9):
        own = turned[:, :, j]
        moved = own[starts - whole[j]] - (late[j] - whole[j]) * (
            own[starts - whole[j]] - own[starts - whole[j] - 1]
        )
        turn[:, :, j] = (moved - own[starts]).T
    # the difference of two such moments, TURN apart: the root of two covers it
    turn -= turn.mean(axis=1, keepdims=True)
    return np.concatenate(
        [
            rms(velocity_error),
            rms(rate_error),
            _motor_errors(flown, parameters, other_firmware, links),
            np.sqrt(2) * rms(turn),
        ]
    )


def _tile(x, times):
    return np.tile(x, (1,) * (x.ndim - 1) + (times,))


def _motor_errors(flown, parameters, other_firmware, links):
    samples, _, count = flown["motor"].shape
    out = np.zeros((3, count))
    own = np.flatnonzero(other_firmware)
    if not len(own):
        return out
    p = {
        k: parameters[k][..., own]
        for k in ("kp", "ki", "kd", "gyro_cut", "derivative_cut", "d_filter")
    }
    gyro, applied, motor = (flown[k][..., own].astype(float) for k in ("gyro", "applied", "motor"))
    issued = flown["command"][..., own].astype(float)
    late = parameters["link_delay"][own] / 2.0
    each = np.arange(len(own))
    firmware = Firmware(p, gyro[0], flown["integral"][0][:, own].astype(float))
    error = np.zeros((samples, 3, len(own)))
    for s in range(samples):
        tick = np.maximum((s - late) // PER_TICK, 0).astype(int)
        now = np.where(links[own], applied[s], issued[tick, :, each].T)
        error[s] = MIX @ (motor[s] - firmware(now, gyro[s]))
    error -= uniform_filter1d(error, 250, axis=0)
    inside = (np.arange(samples) >= FIRST)[:, None] & (
        np.arange(samples)[:, None] < flown["crashed"][own] - 25
    )
    squares = np.where(inside[:, None], error**2, 0.0).sum(axis=0)
    out[:, own] = np.sqrt(squares / np.maximum(inside.sum(axis=0), 1))
    return out


def motors_of_log(rows, samples):
    """Motor commands every 2 ms as a reader of the log can have them, (2, S, 4): held over a row,
    straight between rows.
    """
    times = SAMPLE * np.arange(samples)
    logged = np.stack([rows[c] for c in GROUPS["m"]], axis=1)
    held = logged[np.maximum(np.searchsorted(rows["t"], times + 1e-6) - 1, 0)]
    return np.stack([held, np.stack([np.interp(times, rows["t"], c) for c in logged.T], axis=1)])


def sensor_floor(sensors, rows, flown, j):
    """(12,) what the case's sensors add to the errors of body j, over the same horizons; inf where
    nothing was logged.
    """
    have = sensors["channels"]
    t = rows["t"]

    def table(letter):
        values = np.stack([rows[c] for c in GROUPS[letter]], axis=1)
        ok = np.isfinite(values[:, 0]) & (t > 1.0)
        return t[ok], values[ok]

    def truth(name, times):
        return at(flown[name][:, :, j].astype(float), times)

    def change(times, e, horizon):
        h = max(1, round(horizon / np.median(np.diff(times))))
        return np.sqrt(((e[h:] - e[:-h]) ** 2).mean(axis=0))

    out = np.full(12, np.inf)
    delay = flown["pose_delay"][j]
    angle = None
    if "p" in have:
        times, pose = table("p")
        q = pose[:, 3:]
        true_q = truth("quaternion", times - delay)
        flip = np.array([[1.0], [-1], [-1], [-1]])
        angle = 2 * v.multiply(flip * true_q.T, q.T)[1:].T
        drift = smooth_derivative(
            pose[:, :3] - truth("position", times - delay), float(np.median(np.diff(times)))
        )
        out[:3] = change(times, drift, 0.25)
        if "s" in have:
            times_v, velocity = table("s")
            out[:3] = np.minimum(
                out[:3], change(times_v, velocity - truth("velocity", times_v - delay), 0.25)
            )
        out[3:6] = change(times, smooth_derivative(angle, float(np.median(np.diff(times)))), 0.05)
    if "a" in have:
        times, accel = table("a")
        e = accel - truth("specific", times)
        e = np.cumsum(e - e.mean(axis=0), axis=0) * np.median(np.diff(times))
        out[:3] = np.minimum(out[:3], change(times, e, 0.25))
    out[2] = np.hypot(out[2], THRUST_ALLOWANCE * v.GRAVITY * 0.25)
    noise = 0.0
    if "g" in have:
        times, gyro = table("g")
        e = gyro - truth("rates", times)
        e -= e.mean(axis=0)
        out[3:6] = np.minimum(out[3:6], change(times, e, 0.05))
        noise = e.std(axis=0)
        if angle is not None:
            turned = np.cumsum(e, axis=0) * np.median(np.diff(times))
            out[9:] = np.hypot(np.sqrt(2) * angle.std(axis=0), change(times, turned, 0.1))
        if "c" in have and "m" in have:
            slope = np.diff(flown["gyro"][:, :, j].astype(float), axis=0).std(axis=0) / SAMPLE
            counts = v.RATE_KP * np.rad2deg(noise) + 0.3 * v.RATE_KD * np.rad2deg(slope)
            # commands that came between the rows are not in the log
            issued = flown["command"][:, 1:, j].astype(float)
            inside = 0.01 * np.arange(len(flown["command"]))
            last = np.searchsorted(t, inside + 1e-6) - 1
            known = np.stack([rows[c] for c in GROUPS["c"][1:]], axis=1)[np.maximum(last, 0)]
            missed = (issued - known)[(inside > 1.0) & (inside < t[-1])]
            counts = np.hypot(counts, v.RATE_KP * np.rad2deg(np.sqrt((missed**2).mean(axis=0))))
            out[6:9] = np.hypot(
                counts / 65536.0 / np.array([2, 2, 1]), 1e-4 * sensors["quantum"] / 3.5
            )
    return out
