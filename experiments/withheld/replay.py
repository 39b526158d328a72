"""How much an effect shows: the nominal vehicle replayed over short windows from the true state, against what
really happened.

Severity = the largest, over the predicted channels, of the rms error that the effect causes divided by that
channel's noise floor. Channels and horizons: velocity (body axes, m/s) after 0.25 s; body rates (rad/s) after
0.05 s; motor commands (roll, pitch, yaw) over the first 0.05 s, all replayed from the body-rate commands as
they were issued; and turn of the pose over 0.1 s against the gyroscope (rad). The floor is the rms error of
the same replay on nominal flights, started from the *logged* states: it holds sensor noise, gusts and all
nuisances.
"""

import numpy as np

from experiments.withheld import body as b

LONG, SHORT = 25, 5  # ticks of 10 ms
CHANNELS = (
    "velocity_x",
    "velocity_y",
    "velocity_z",
    "rate_x",
    "rate_y",
    "rate_z",
    "motor_roll",
    "motor_pitch",
    "motor_yaw",
    "pose_x",
    "pose_y",
    "pose_z",
)
MIX = np.array([[-1, -1, 1, 1], [-1, 1, 1, -1], [-1, 1, -1, 1]]) / 4.0


def _windows(values, starts, offset=0):
    """(K, n, B) at ticks starts + offset, flattened to (n, W)."""
    return np.moveaxis(values[starts + offset], 0, 1).reshape(values.shape[1], -1).astype(float)


def replay(position, q, velocity, rates, rotor, integral, commands, parameters=None):
    """Nominal vehicle over windows W: states (n, W), commands (ticks, 4, W), 1 ms steps. Returns velocity and
    quaternion after
    every tick, rates after every tick, mean motor command of every tick."""
    q, velocity, rates, rotor, integral = (
        q.copy(),
        velocity.copy(),
        rates.copy(),
        rotor.copy(),
        integral.copy(),
    )
    lag = 1 - np.exp(-0.001 / b.MOTOR_TIME)
    x, y, spin = b.ROTOR_X[:, None], b.ROTOR_Y[:, None], b.SPIN[:, None]
    previous = None
    out_v, out_w, out_m = [], [], []
    inertia = b.INERTIA[:, None]
    for command in commands:
        mean = 0.0
        for step in range(10):
            if step % 2 == 0:
                error = np.rad2deg(command[1:] - rates)
                integral = np.clip(
                    integral + 0.002 * error, -b.INTEGRAL_LIMIT[:, None], b.INTEGRAL_LIMIT[:, None]
                )
                slope = 0.0 if previous is None else -np.rad2deg(rates - previous) / 0.002
                previous = rates
                m = b.mix(
                    command[0],
                    b.RATE_KP[:, None] * error + b.RATE_KI[:, None] * integral + b.RATE_KD[:, None] * slope,
                )
                mean = mean + 0.2 * m
            rotor = rotor + lag * (b.MAX_SPEED * np.sqrt(m) - rotor)
            f = b.THRUST_CONSTANT * rotor * rotor
            moment = np.stack([(y * f).sum(0), -(x * f).sum(0), b.TORQUE_RATIO * (spin * f).sum(0)])
            force = np.zeros_like(velocity)
            force[2] = f.sum(0)
            accel = b.rotate(q, force / b.MASS)
            accel[2] -= b.GRAVITY
            rates = rates + 0.001 * (moment - b.cross(rates, inertia * rates)) / inertia
            velocity = velocity + 0.001 * accel
            q = b.turn(q, rates, 0.001)
        out_v.append(velocity)
        out_w.append(rates)
        out_m.append(mean)
    return out_v, out_w, out_m, q


def turn_between(q0, q1):
    """Body-frame rotation vector (3, W) from q0 to q1."""
    d = b.multiply(np.stack([q0[0], -q0[1], -q0[2], -q0[3]]), q1)
    return 2 * d[1:] * np.sign(d[0])


def errors(flown, ticks, logged=None):
    """Replay errors (12, n_windows, B) of all bodies, over the flight's common part (`ticks`, after a first
    second).

    With `logged` (dict of measured position, quaternion, velocity, rates as (K, n, B)) the windows start
    from, and are compared with, the log.
    """
    starts = np.arange(100, ticks - LONG - 1, 20)
    count = flown["position"].shape[2]
    src = flown if logged is None else logged
    q0, v0, w0 = (_windows(src[n], starts) for n in ("quaternion", "velocity", "rates"))
    commands = [_windows(flown["command"], starts, k) for k in range(LONG)]
    out_v, out_w, out_m, _ = replay(
        _windows(flown["position"], starts),
        q0,
        v0,
        w0,
        _windows(flown["rotor"], starts),
        _windows(flown["integral"], starts),
        commands,
    )
    dv = b.rotate_back(q0, _windows(src["velocity"], starts, LONG) - out_v[LONG - 1])
    dw = _windows(src["rates"], starts, SHORT) - out_w[SHORT - 1]
    motor = sum(_windows(flown["motor"], starts, k) for k in range(SHORT)) / SHORT
    dm = MIX @ (motor - sum(out_m[:SHORT]) / SHORT)
    pose0, pose1 = _windows(src["pose"], starts), _windows(src["pose"], starts, 10)
    gyro = sum(
        (_windows(src["rates"], starts, k) + _windows(src["rates"], starts, k + 1)) * 0.005 for k in range(10)
    )
    dp = turn_between(pose0, pose1) - gyro
    return np.concatenate([dv, dw, dm, dp]).reshape(len(CHANNELS), len(starts), count)
