"""What the two baselines share: windows cut from logs, and the nominal vehicle replayed with every parameter
of a fit at once.

The replay covers 0.2 s from the logged state, driven by the logged body-rate commands, in steps of 2 ms.
Rotor speeds and integrators at the start are set from the logged motor commands.
"""

import csv
import gzip

import numpy as np

from experiments.withheld import body as b
from experiments.withheld.replay import MIX, turn_between

TICKS, EVERY = 20, 20  # window and spacing, ticks of 10 ms
RATE_TICKS, VELOCITY_TICKS = (2, 5, 10), (10, 20)

# parameter: (nominal, lower, upper, usual change) - the usual change is half the usual range of GAP.md
PARAMETERS = {
    "thrust_scale": (0.0, -0.4, 0.4, 0.1),
    "battery_sag": (0.0, -3.0, 3.0, 1.0),
    "thrust_saturation": (1.0, 0.5, 1.0, 0.15),
    "thrust_curve": (0.0, -1.0, 1.0, 0.3),
    "rotor_drag:xy": (0.0, -0.1, 0.1, 0.015),
    "rotor_drag:z": (0.0, -0.1, 0.1, 0.015),
    "blade_flapping": (0.0, -1e-3, 1e-3, 1e-4),
    "wind:x": (0.0, -0.06, 0.06, 0.01),
    "wind:y": (0.0, -0.06, 0.06, 0.01),
    "ground_effect": (0.0, -3.0, 3.0, 0.6),
    "ceiling_effect": (0.0, -3.0, 3.0, 0.6),
    "downwash": (0.0, -0.4, 0.4, 0.08),
    "motor_lag:up": (0.0, -0.02, 0.2, 0.03),
    "motor_lag:down": (0.0, -0.02, 0.2, 0.03),
    "command_latency": (0.0, 0.0, 0.08, 0.02),
    "motor_imbalance:a": (0.0, -0.3, 0.3, 0.04),
    "motor_imbalance:b": (0.0, -0.3, 0.3, 0.04),
    "motor_imbalance:c": (0.0, -0.3, 0.3, 0.04),
    "com_offset:x": (0.0, -0.01, 0.01, 0.002),
    "com_offset:y": (0.0, -0.01, 0.01, 0.002),
    "inertia:xx": (1.0, 0.4, 2.5, 0.3),
    "inertia:yy": (1.0, 0.4, 2.5, 0.3),
    "inertia:zz": (1.0, 0.4, 2.5, 0.3),
    "yaw_torque": (1.0, 0.05, 3.0, 0.4),
    "rate_gains:p": (1.0, 0.3, 3.0, 0.4),
    "rate_gains:i": (1.0, 0.0, 3.0, 0.5),
    "rate_gains:d": (1.0, 0.0, 3.0, 0.5),
    "state_latency": (0.0, 0.0, 0.08, 0.02),
}
NAMES = tuple(PARAMETERS)
UNMIX = np.array([[-1, -1, 1, 1], [-1, 1, 1, -1], [-0.5, 0.5, -0.5, 0.5]]) * 0.5 * 65536.0


def read_flight(path):
    """{vehicle: {column: (K,) array}} of one log."""
    with gzip.open(path, "rt") as file:
        rows = csv.reader(file)
        header = next(rows)
        table = [[float(v) if v else np.nan for v in row] for row in rows]
    table = np.array(table)
    out = {}
    for vehicle in np.unique(table[:, 1]):
        own = table[table[:, 1] == vehicle]
        out[vehicle] = {name: own[:, i] for i, name in enumerate(header)}
    return out


def _columns(log, *names):
    return np.stack([log[n] for n in names])


def windows_of(folder):
    """Windows of all flights of a case, stacked: arrays (..., W) and `flight` (W,), the number of the log
    they come from.
    """
    parts = []
    for number, path in enumerate(sorted(folder.glob("flight_*.csv.gz"))):
        vehicles = read_flight(path)
        for name, log in vehicles.items():
            others = [v for key, v in vehicles.items() if key != name]
            parts.append(_cut(log, others[0] if others else None, number))
    return {key: np.concatenate([p[key] for p in parts], axis=-1) for key in parts[0]}


def _cut(log, other, number):
    ticks = len(log["t"])
    position, q, v = (
        _columns(log, "x", "y", "z"),
        _columns(log, "qw", "qx", "qy", "qz"),
        _columns(log, "vx", "vy", "vz"),
    )
    w, command = _columns(log, "wx", "wy", "wz"), _columns(log, "cmd_thrust", "cmd_wx", "cmd_wy", "cmd_wz")
    m = _columns(log, "m1", "m2", "m3", "m4")
    q = q * np.sign((q[:, :1] * q).sum(axis=0))
    voltage = np.interp(log["t"], log["t"][~np.isnan(log["vbat"])], log["vbat"][~np.isnan(log["vbat"])])
    # gyro bias from pose against gyro over the whole flight, per axis
    turned = np.stack(
        [turn_between(q[:, i : i + 1], q[:, i + 10 : i + 11])[:, 0] for i in range(0, ticks - 11, 10)], axis=1
    )
    seen = np.stack(
        [
            0.01 * (w[:, i : i + 10].sum(axis=1) + 0.5 * (w[:, i + 10] - w[:, i]))
            for i in range(0, ticks - 11, 10)
        ],
        axis=1,
    )
    # the rate loop works on the raw gyroscope, the body turns without its bias
    bias = np.median(seen - turned, axis=1, keepdims=True) / 0.1
    w = w - bias
    starts = np.arange(50, ticks - TICKS - 2, EVERY)
    above = (
        np.full((3, len(starts)), 1e3)
        if other is None
        else _columns(other, "x", "y", "z")[:, starts] - position[:, starts]
    )
    lag = 1 - np.exp(-0.01 / b.MOTOR_TIME)
    rotor, speeds = b.MAX_SPEED * np.sqrt(m[:, 0]), np.zeros_like(m)
    for k in range(ticks):
        speeds[:, k] = rotor
        rotor = rotor + lag * (b.MAX_SPEED * np.sqrt(m[:, k]) - rotor)
    # integrators: the logged rate error summed up, from a start that makes the logged motor commands right on
    # average
    smooth = np.apply_along_axis(
        np.convolve, 1, np.pad(w, ((0, 0), (1, 1)), mode="edge"), [0.25, 0.5, 0.25], mode="valid"
    )
    error = np.rad2deg(command[1:] - smooth - bias)
    output, slope = UNMIX @ m, np.rad2deg(np.gradient(smooth, 0.01, axis=1))
    summed = 0.01 * (np.cumsum(error, axis=1) - error)
    offset = (output - b.RATE_KP[:, None] * error + b.RATE_KD[:, None] * slope) / b.RATE_KI[:, None] - summed
    inside = ((m > 0.01) & (m < 0.99)).all(axis=0)
    integral = summed + np.median(offset[:, inside], axis=1, keepdims=True)
    mean_m = np.stack([m[:, starts + k] for k in range(10)]).mean(axis=0)
    return {
        "position": position[:, starts],
        "quaternion": q[:, starts],
        "velocity": v[:, starts],
        "rates": smooth[:, starts],
        "rotor": speeds[:, starts],
        "integral": np.clip(integral, -33.3, 33.3)[:, starts],
        "voltage": voltage[starts],
        "above": above,
        "flight": np.full(len(starts), number),
        "gyro_bias": np.repeat(bias, len(starts), axis=1),
        "commands": np.stack([command[:, starts + k] for k in range(-8, TICKS)]),
        "seen_velocity": np.stack([v[:, starts + k] for k in VELOCITY_TICKS]),
        "seen_rates": np.stack([w[:, starts + k] for k in RATE_TICKS]),
        "seen_motor": MIX @ mean_m,
        "seen_collective": mean_m.mean(axis=0),
        "turn": turn_between(q[:, starts], q[:, starts + 10])
        - 0.01 * sum(0.5 * (w[:, starts + k] + w[:, starts + k + 1]) for k in range(10)),
        "rate_change": w[:, starts + 10] - w[:, starts],
    }


def replay(windows, theta):
    """Residuals (rows, W, P) in units of about their noise for parameter sets theta (len(NAMES), P)."""
    count, sets = windows["position"].shape[-1], theta.shape[1]

    def wide(x):
        return np.repeat(x, sets, axis=-1)

    p = {name: np.tile(theta[i], count) for i, name in enumerate(NAMES)}
    q, v, w, rotor, integral = (
        wide(windows[k]) for k in ("quaternion", "velocity", "rates", "rotor", "integral")
    )
    position, above, voltage, commands = (
        wide(windows["position"]),
        wide(windows["above"]),
        wide(windows["voltage"]),
        windows["commands"],
    )
    gain = np.stack(
        [
            p["motor_imbalance:a"] + p["motor_imbalance:c"],
            -p["motor_imbalance:a"] + p["motor_imbalance:b"],
            p["motor_imbalance:c"] * -1 - p["motor_imbalance:b"],
            p["motor_imbalance:b"] * 0,
        ]
    )
    gain = (1 + gain) * (1 + p["thrust_scale"])
    inertia = b.INERTIA[:, None] * np.stack([p["inertia:xx"], p["inertia:yy"], p["inertia:zz"]])
    arm_x, arm_y = b.ROTOR_X[:, None] - p["com_offset:x"], b.ROTOR_Y[:, None] - p["com_offset:y"]
    kp, ki, kd = (
        b.RATE_KP[:, None] * p["rate_gains:p"],
        b.RATE_KI[:, None] * p["rate_gains:i"],
        b.RATE_KD[:, None] * p["rate_gains:d"],
    )
    sag = np.power(voltage / 3.7, p["battery_sag"])
    up, down = (
        1 - np.exp(-0.002 / np.maximum(b.MOTOR_TIME + p["motor_lag:" + k], 1e-3)) for k in ("up", "down")
    )
    delay = p["command_latency"] / 0.01
    whole, part = np.floor(delay).astype(int), delay - np.floor(delay)
    columns = np.repeat(np.arange(count), sets)
    wake = (
        np.where(
            above[2] > 0.02,
            np.exp(
                -np.maximum(above[2], 0) / 0.5
                - 0.5 * (above[0] ** 2 + above[1] ** 2) / (0.05 + 0.1 * np.maximum(above[2], 0)) ** 2
            ),
            0.0,
        )
        * p["downwash"]
    )
    bias = wide(windows["gyro_bias"])
    previous, rates, velocities, motor, collective = w, [], [], 0.0, 0.0
    for k in range(TICKS):
        # the command of a fraction of a tick ago, linearly between two
        index = np.clip(8 + k - whole, 1, None)
        command = (1 - part) * commands[index, :, columns].T + part * commands[index - 1, :, columns].T
        for _ in range(5):
            error = np.rad2deg(command[1:] - w - bias)
            integral = np.clip(
                integral + 0.002 * error, -b.INTEGRAL_LIMIT[:, None], b.INTEGRAL_LIMIT[:, None]
            )
            m = b.mix(command[0], kp * error + ki * integral - kd * np.rad2deg(w - previous) / 0.002)
            previous = w
            if k < 10:
                motor, collective = motor + MIX @ m / 50, collective + m.mean(axis=0) / 50
            u = m + p["thrust_curve"] * (m - 0.625) * (m - 0.4)
            u = np.clip(np.minimum(u * sag, p["thrust_saturation"]), 1e-6, None)
            target = b.MAX_SPEED * np.sqrt(u)
            rotor = rotor + np.where(target > rotor, up, down) * (target - rotor)
            squared = b.THRUST_CONSTANT * rotor * rotor * gain
            near_floor = (b.PROPELLER / (np.maximum(position[2], 0.0) + 0.02)) ** 2
            near_top = (b.PROPELLER / (np.maximum(b.CEILING - position[2], 0.0) + 0.02)) ** 2
            thrust = squared * (1 + p["ground_effect"] * near_floor + p["ceiling_effect"] * near_top)
            vb = b.rotate_back(q, v)
            moment = np.stack(
                [
                    (arm_y * thrust).sum(0) + p["blade_flapping"] * vb[1],
                    -(arm_x * thrust).sum(0) - p["blade_flapping"] * vb[0],
                    b.TORQUE_RATIO * p["yaw_torque"] * (b.SPIN[:, None] * squared).sum(0),
                ]
            )
            force = np.stack(
                [
                    -p["rotor_drag:xy"] * vb[0],
                    -p["rotor_drag:xy"] * vb[1],
                    thrust.sum(0) - p["rotor_drag:z"] * vb[2],
                ]
            )
            accel = b.rotate(q, force)
            accel = np.stack([accel[0] + p["wind:x"], accel[1] + p["wind:y"], accel[2] - wake]) / b.MASS
            accel[2] -= b.GRAVITY
            w = w + 0.002 * (moment - b.cross(w, inertia * w)) / inertia
            position, v = position + 0.002 * v, v + 0.002 * accel
            q = b.turn(q, w, 0.002)
        if k + 1 in RATE_TICKS:
            rates.append(w)
        if k + 1 in VELOCITY_TICKS:
            velocities.append(v)
    rows = [
        (wide(seen) - out) / 0.015 for seen, out in zip(windows["seen_velocity"], velocities, strict=True)
    ]
    rows += [(wide(seen) - out) / 0.05 for seen, out in zip(windows["seen_rates"], rates, strict=True)]
    rows.append((wide(windows["seen_motor"]) - motor) / 0.002)
    rows.append((wide(windows["seen_collective"]) - collective)[None] / 0.002)
    rows.append((wide(windows["turn"]) + p["state_latency"] * wide(windows["rate_change"])) / 0.003)
    return np.clip(np.concatenate(rows), -1e3, 1e3).reshape(-1, count, sets)
