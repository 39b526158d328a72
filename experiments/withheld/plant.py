"""The withheld plant: quadrotors flown at 1 kHz by a firmware-like rate loop (500 Hz) and an off-board
controller (100 Hz).

`fly` integrates a whole batch of bodies at once (NumPy, body index last) and returns what was true at every
10 ms plus what the sensors and the radio said. Nothing of `openjax` is used. Euler angles appear nowhere;
integration is semi-implicit with a trapezoidal position.
"""

from dataclasses import dataclass

import numpy as np

from experiments.withheld import body as b
from experiments.withheld import plant_effects as effects

DT = 0.001
RING = 128  # ms of history kept for delayed poses


@dataclass
class Batch:
    """Everything that decides a batch of B bodies over K control ticks of 10 ms."""

    parameters: dict  # arrays of `body.nominal_parameters`
    reference: dict  # position, velocity, acceleration (K, 3, B), yaw, yaw_rate (K, B), pulses (K, 4, B)
    partner: np.ndarray  # (B,) index of the vehicle that may fly above; itself if alone
    arrival: np.ndarray  # (K, B) ms at which the command of tick k reaches the vehicle; >= 10**8: lost
    noise: dict  # see `sensors.draw_noise`


def _received(arrival, steps):
    """(steps, B) index of the newest command that has arrived by each ms; -1 before the first."""
    ticks, count = arrival.shape
    table = np.full((steps, count), -1, dtype=np.int32)
    columns = np.arange(count)
    for k in range(ticks):
        ms = arrival[k].astype(np.int64)
        inside = ms < steps
        table[ms[inside], columns[inside]] = np.maximum(table[ms[inside], columns[inside]], k)
    return np.maximum.accumulate(table, axis=0)


def off_board_control(reference, k, position, q, velocity, integral, p_mass):
    """Off-board controller: [thrust 0..1, body rates rad/s] (4, B) from the measured pose and velocity."""
    error = reference["position"][k] - position
    integral += 0.01 * np.clip(error, -0.2, 0.2)
    np.clip(integral, -0.5, 0.5, out=integral)
    gain = np.array([[6.0], [6.0], [12.0]])
    damping = np.array([[3.8], [3.8], [5.5]])
    want = reference["acceleration"][k] + gain * error + damping * (reference["velocity"][k] - velocity)
    want = want + np.array([[1.5], [1.5], [5.0]]) * integral
    want[2] = np.clip(want[2], -6.0, 8.0) + b.GRAVITY
    # at most 38 degrees of tilt
    side = np.sqrt(want[0] ** 2 + want[1] ** 2)
    shrink = np.minimum(1.0, 0.78 * want[2] / np.maximum(side, 1e-9))
    want[:2] *= shrink
    w, x, y, z = q
    up = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    thrust = p_mass * (want * up).sum(axis=0) / (4 * b.MAX_THRUST)
    lean = b.rotate_back(q, b.cross(up, want / np.sqrt((want * want).sum(axis=0))))
    heading = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    turn = reference["yaw"][k] - heading
    turn = (turn + np.pi) % (2 * np.pi) - np.pi
    rates = np.stack([8.0 * lean[0], 8.0 * lean[1], 3.0 * turn + reference["yaw_rate"][k]])
    command = np.concatenate([thrust[None], rates]) + reference["pulses"][k]
    command[0] = np.clip(command[0], 0.08, 0.9)
    command[1:] = np.clip(command[1:], -np.pi, np.pi)
    return command


def fly(batch):
    """Fly the batch; dict of arrays over ticks: true state, received commands, motors, and what the sensors
    saw.

    Shapes: position, velocity, rates, specific (K, 3, B); quaternion (K, 4, B); command, motor (K, 4, B)
    (motor: mean over the 10 ms that begin at the tick); rotor (K, 4, B) rad/s; integral (K, 3, B) deg;
    voltage (K, B); measured_* as logged, before IMU noise; crashed (B,) tick of the first breach (floor, tilt
    above 85 degrees or 2.5 m away), K if none.
    """
    p, reference, noise, partner = batch.parameters, batch.reference, batch.noise, batch.partner
    ticks, _, count = reference["position"].shape
    active = effects.Active(p, b.nominal_parameters(count))
    received = _received(batch.arrival, 10 * ticks)

    position = reference["position"][0].copy()
    velocity, rates = np.zeros((3, count)), np.zeros((3, count))
    half = 0.5 * reference["yaw"][0]
    q = np.stack([np.cos(half), np.zeros(count), np.zeros(count), np.sin(half)])
    hover = b.MASS * b.GRAVITY / (4 * b.MAX_THRUST)
    rotor = np.full((4, count), b.MAX_SPEED * np.sqrt(hover))
    drive = rotor.copy()  # state of a second lag, if any
    m = np.full((4, count), hover)
    output_integral, previous, filtered = np.zeros((3, count)), rates.copy(), np.zeros((3, count))
    goal_integral = np.zeros((3, count))
    start = np.concatenate([np.full((1, count), hover), np.zeros((3, count))])
    command = np.zeros((ticks, 4, count))
    load = np.full(count, hover)
    used = np.zeros(count)
    voltage = noise["open_voltage"] - noise["resistance"] * hover

    inertia_inverse = np.moveaxis(np.linalg.inv(np.moveaxis(p["inertia"], 2, 0)), 0, 2)
    diagonal = not np.any(p["inertia"][~np.eye(3, dtype=bool)])
    principal = p["inertia"][np.arange(3), np.arange(3)]
    arm_x, arm_y = b.ROTOR_X[:, None] - p["com"][0], b.ROTOR_Y[:, None] - p["com"][1]
    up_lag, down_lag = 1 - np.exp(-DT / p["tau_up"]), 1 - np.exp(-DT / p["tau_down"])
    second = np.where(p["tau_second"] > 0, 1 - np.exp(-DT / np.maximum(p["tau_second"], 1e-4)), 1.0)
    d_keep = np.where(p["d_filter"] > 0, np.exp(-0.002 / np.maximum(p["d_filter"], 1e-6)), 0.0)
    spin = b.SPIN[:, None]
    ring = {
        "p": np.repeat(position[None], RING, 0),
        "q": np.repeat(q[None], RING, 0),
        "v": np.repeat(velocity[None], RING, 0),
    }
    columns = np.arange(count)
    names3 = (
        "position",
        "velocity",
        "rates",
        "specific",
        "integral",
        "measured_position",
        "measured_velocity",
        "measured_rates",
        "measured_specific",
        "disturbance",
    )
    out = {n: np.zeros((ticks, 3, count), np.float32) for n in names3}
    out |= {
        n: np.zeros((ticks, 4, count), np.float32)
        for n in ("quaternion", "rotor", "motor", "measured_quaternion", "applied")
    }
    out["voltage"] = np.zeros((ticks, count), np.float32)
    crashed = np.full(count, ticks)
    specific, accel = np.zeros((3, count)), np.zeros((3, count))
    specific[2] = b.GRAVITY

    def delayed(name, step, delay):
        whole = np.floor(delay).astype(int)
        part = delay - whole
        newer = ring[name][(step - whole) % RING, :, columns].T
        older = ring[name][(step - whole - 1) % RING, :, columns].T
        return newer + part * (older - newer)

    for n in range(10 * ticks):
        k, sub = divmod(n, 10)
        if sub == 0:
            ring["p"][n % RING], ring["q"][n % RING], ring["v"][n % RING] = position, q, velocity
            delay = np.clip(
                noise["mocap_delay"]
                + noise["mocap_jitter"][k]
                + p["pose_delay"]
                + p["pose_jitter"] * noise["pose_jitter"][k],
                0.0,
                RING - 3.0,
            )
            seen_p = delayed("p", n, delay) + noise["position"][k]
            seen_v = delayed("v", n, delay) + noise["velocity"][k]
            seen_q = b.multiply(delayed("q", n, delay), noise["attitude"][k])
            seen_q /= np.sqrt((seen_q * seen_q).sum(axis=0))
            command[k] = off_board_control(reference, k, seen_p, seen_q, seen_v, goal_integral, b.MASS)
            for name, value in (
                ("position", position),
                ("velocity", velocity),
                ("rates", rates),
                ("specific", specific),
                ("integral", output_integral),
                ("measured_position", seen_p),
                ("measured_velocity", seen_v),
                ("quaternion", q),
                ("rotor", rotor),
                ("measured_quaternion", seen_q),
                ("voltage", voltage),
            ):
                out[name][k] = value
            bad = (
                (position[2] < 0.015)
                | (1 - 2 * (q[1] ** 2 + q[2] ** 2) < 0.087)
                | ((position**2).sum(axis=0) > 2.5**2)
            )
            bad |= ~np.isfinite(position[0])
            crashed = np.where(bad & (crashed == ticks), k, crashed)
            dead = crashed < ticks
            if dead.any():  # parked, so that one wreck does not spoil the arithmetic of the batch
                position[:, dead], velocity[:, dead], rates[:, dead] = (
                    reference["position"][k][:, dead],
                    0.0,
                    0.0,
                )
                q[:, dead] = np.array([1.0, 0, 0, 0])[:, None]
            gust_force, gust_torque = noise["gust_force"][k], noise["gust_torque"][k]
        else:
            ring["p"][n % RING], ring["q"][n % RING], ring["v"][n % RING] = position, q, velocity
        if sub % 2 == 0:
            index = received[n]
            now = np.where(index >= 0, command[np.maximum(index, 0), :, columns].T, start)
            gyro = rates + noise["gyro_bias"] + noise["gyro_loop"][5 * k + sub // 2]
            error = np.rad2deg(now[1:] - gyro)
            output_integral = np.clip(
                output_integral + 0.002 * error, -b.INTEGRAL_LIMIT[:, None], b.INTEGRAL_LIMIT[:, None]
            )
            slope = -np.rad2deg(gyro - previous) / 0.002
            filtered = d_keep * filtered + (1 - d_keep) * slope
            previous = gyro
            m = b.mix(now[0], p["kp"] * error + p["ki"] * output_integral + p["kd"] * filtered)
            out["motor"][k] += 0.2 * m
            if sub == 0:
                out["applied"][k] = now
        # battery: open-circuit voltage falls with the charge used, the terminals sag with the current
        current = (m * np.sqrt(m)).sum(axis=0) * 0.25
        used += DT * current
        load += (DT / 0.04) * (current - load)
        voltage = noise["open_voltage"] - noise["discharge"] * used - noise["resistance"] * load
        u = effects.motor_demand(p, active, m, voltage, load)
        target = b.MAX_SPEED * np.sqrt(u)
        drive += second * (target - drive)
        rotor = rotor + np.where(drive > rotor, up_lag, down_lag) * (drive - rotor)
        squared = b.THRUST_CONSTANT * rotor * rotor * p["rotor_gain"]
        thrust = squared * effects.surface_gain(p, active, position, q)
        moment = np.stack(
            [
                (arm_y * thrust).sum(0),
                -(arm_x * thrust).sum(0),
                p["torque_ratio"] * p["torque_gain"] * (spin * squared).sum(0),
            ]
        )
        force = np.stack([np.zeros(count), np.zeros(count), thrust.sum(0)])
        air_force, air_torque = effects.air_forces(
            p, active, q, velocity, rates, rotor, thrust, position, noise["slow"][k]
        )
        force, moment = force + air_force, moment + air_torque + gust_torque
        outside = gust_force
        if active("wake"):
            pull, gradient = effects.wake_force(p, position, partner)
            outside = outside + np.stack([np.zeros(count), np.zeros(count), pull])
            moment = moment + b.rotate_back(q, np.stack([gradient[1], -gradient[0], np.zeros(count)])) * (
                b.ARM**2
            )
        force = force + b.rotate_back(q, outside)
        specific = force / p["mass"]
        accel = b.rotate(q, specific)
        accel[2] -= b.GRAVITY
        if diagonal:
            spun = b.cross(rates, principal * rates)
            rates = rates + DT * (moment - spun) / principal
        else:
            momentum = np.einsum("ijb,jb->ib", p["inertia"], rates)
            rates = rates + DT * np.einsum("ijb,jb->ib", inertia_inverse, moment - b.cross(rates, momentum))
        position = position + DT * velocity + 0.5 * DT * DT * accel
        velocity = velocity + DT * accel
        q = b.turn(q, rates, DT)
        if active("imu_lever"):
            # accelerometer away from the centre of mass: centripetal part
            lever = -p["com"] * p["imu_lever"]
            specific = specific + b.cross(rates, b.cross(rates, lever))
    out["command"], out["crashed"] = command.astype(np.float32), crashed
    return out
