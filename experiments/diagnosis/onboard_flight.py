"""One flight on an on-board estimate: RotorPy's vehicle in gusts, what an unknown kind adds, sensors, estimator and loops."""

import numpy as np
from scipy.signal import butter, lfilter

from experiments.diagnosis import onboard
from experiments.diagnosis import rotorpy_cases as rp
from experiments.diagnosis import vehicle as v

STEP = 0.002  # s


class LowPass:
    """Second-order Butterworth of (3,) samples every STEP; 0 Hz lets everything through."""

    def __init__(self, cut, start):
        self.b, self.a = (
            butter(2, cut, fs=1 / STEP) if cut else (np.array([1.0, 0, 0]), np.array([1.0, 0, 0]))
        )
        self.one = start * (1 - self.b[0])
        self.two = start * (self.b[2] - self.a[2])

    def __call__(self, x):
        y = self.b[0] * x + self.one
        self.one = self.b[1] * x - self.a[1] * y + self.two
        self.two = self.b[2] * x - self.a[2] * y
        return y


def coloured(rng, count, rms, time):
    """(count, 3) first-order noise of a correlation time, in samples of STEP."""
    keep = np.exp(-STEP / time)
    return lfilter(
        [np.sqrt(1 - keep**2)], [1.0, -keep], rms * rng.standard_normal((count + 1000, 3)), axis=0
    )[1000:]


def local_loads(rng, kind, samples):
    """What an unknown kind does: a function of sample, position and hover force that gives world force (3,) N, body torque (3,)
    N m and the factors (4,) of the motors' thrust."""
    force, torque, weak = np.zeros((samples, 3)), np.zeros((samples, 3)), np.ones((samples, 4))
    where, width, blow = None, 0.0, np.zeros(3)
    starts = np.cumsum(rng.uniform(0.4, 1.6, 40)) / STEP
    if kind == "kicks":
        for s in starts.astype(int):
            n = int(rng.uniform(0.02, 0.06) / STEP)
            force[s : s + n, :2] = 0.001 * rng.uniform(25, 90) * _direction(rng)[:2]
            torque[s : s + n] = 1e-4 * rng.uniform(1, 4) * _direction(rng)
    elif kind == "late_fault":
        weak[int(rng.uniform(0.25, 0.6) * samples) :, rng.integers(4)] = rng.uniform(0.78, 0.92)
    elif kind == "hiccups":
        for s in starts.astype(int):
            weak[s : s + int(rng.uniform(0.03, 0.09) / STEP), rng.integers(4)] = rng.uniform(0.4, 0.75)
    elif kind == "pulses":
        period, duty, axis = rng.uniform(0.35, 1.2), rng.uniform(0.15, 0.45), rng.integers(3)
        on = (np.arange(samples) * STEP / period + rng.random()) % 1.0 < duty
        if rng.random() < 0.5:
            torque[on, axis] = rng.choice([-1, 1]) * (1e-4 if axis < 2 else 4e-5) * rng.uniform(0.6, 2.0)
        else:
            force[on, axis] = rng.choice([-1, 1]) * 0.001 * rng.uniform(12, 40)
    elif kind == "jet":
        angle = rng.uniform(0, 2 * np.pi)
        where = np.array([0.5 * np.cos(angle), 0.5 * np.sin(angle), 0.65])
        width, blow = rng.uniform(0.12, 0.22), 0.001 * rng.uniform(40, 110) * _direction(rng)

    def at(s, position):
        here = 0.0 if where is None else np.exp(-((position - where) ** 2).sum() / (2 * width**2))
        return force[s] + here * blow, torque[s], weak[s]

    return at


def _direction(rng):
    d = rng.standard_normal(3)
    return d / np.linalg.norm(d)


def _positions(rng, drawn, samples):
    """Which samples a measurement reaches the filter at, without those lost (drop-outs last up to 0.25 s)."""
    times = np.arange(0.01, samples * STEP, 1 / drawn["source_rate"])
    there = np.ones(len(times), bool)
    for k in np.flatnonzero(rng.random(len(times)) < drawn["lost"]):
        there[k : k + max(1, int(rng.exponential(0.08) * drawn["source_rate"]))] = False
    return set((times[there] / STEP).astype(int).tolist())


def _measure(rng, drawn, estimate, kept, s, since):
    """Give the estimator what its sources measure at sample s, `late` seconds old. `kept`: true motion up to s."""
    way, sigma = drawn["kind"].split("_")[1], drawn["deviation"]
    past = max(0, s - round(drawn["late"] / STEP))
    position, q, velocity = (
        kept[k][past, :, 0].astype(float) for k in ("position", "quaternion", "velocity")
    )
    believed = drawn["believed"] * sigma
    if way == "uwb":
        anchor = np.array([(-1.5, 1.5)[s % 2], (-1.5, 1.5)[s // 2 % 2], (0.1, 2.2)[s // 4 % 2]])
        estimate.see(
            "range", np.linalg.norm(position - anchor) + sigma * rng.standard_normal(), believed, anchor
        )
    elif way == "flow":
        seen = (onboard.matrix_of(q).T @ velocity)[:2] + sigma * rng.standard_normal(2)
        estimate.see("flow", seen, believed)
        estimate.see("height", position[2] + 0.003 * rng.standard_normal(), 0.003 * drawn["believed"])
    else:
        seen = position + sigma * rng.standard_normal(3)
        more = {"since": since} if drawn["kind"].startswith("mahony") else {}
        estimate.see("position", seen, believed, **more)
        if way == "pose" or drawn["kind"].startswith("mahony"):
            angle = 0.008 * rng.standard_normal(3)
            estimate.see("attitude", onboard.turned(q, angle), 0.008 * drawn["believed"], **more)


def fly(told, changed, wind, path, drawn, rng, seconds):
    """One flight as `rotorpy_cases.fly` gives it, with the estimate beside: dict of (S, n, 1) arrays every 2 ms."""
    from rotorpy.controllers.quadrotor_control import SE3Control
    from rotorpy.vehicles.multirotor import Multirotor

    samples, goal = int(seconds / STEP), path.update(0.0)
    hover, changed = told.hover, dict(changed)
    rotors, power, per_volt, kind = (
        changed.pop(k, d)
        for k, d in (("rotors", np.ones(4)), ("power", 1.0), ("per_volt", 0.0), ("local", ""))
    )
    full = rp.rotorpy_vehicle(told, changed)
    state = {"x": goal["x"].astype(float), "v": goal["x_dot"].astype(float), "q": np.array([0, 0, 0, 1.0])}
    state |= {"w": np.zeros(3), "wind": np.zeros(3), "rotor_speeds": np.full(4, v.MAX_SPEED * np.sqrt(hover))}
    model = Multirotor(full, state, "cmd_motor_speeds", aero=True)
    wind_at, loads = rp._air(wind), local_loads(rng, kind, samples)
    mass, turning = full["mass"], 1 / np.array([full["Ixx"], full["Iyy"], full["Izz"]])
    push = coloured(rng, samples, 1e-3 * drawn["gust"], drawn["gust_time"])
    twist = coloured(rng, samples, 1e-3 * drawn["gust"] * 4e-3, 0.5 * drawn["gust_time"]) * [1, 1, 0.3]
    gyro_noise = drawn["gyro"] * rng.standard_normal((samples, 3)) + drawn["gyro_bias"]
    accel_noise = drawn["accel"] * rng.standard_normal((samples, 3)) + drawn["accel_bias"]
    low_gyro = LowPass(drawn["gyro_cut"], np.array(drawn["gyro_bias"]))
    low_accel = LowPass(drawn["accel_cut"], onboard.GRAVITY + drawn["accel_bias"])
    q0, root = np.array([1.0, 0, 0, 0]), np.sqrt(STEP)
    if drawn["kind"].startswith("kalman"):
        noise = drawn["caution"] * drawn["accel"] * root, drawn["caution"] * drawn["gyro"] * root
        estimate = onboard.Kalman(state["x"], q0, *noise)
        estimate.v = state["v"].copy()
    else:
        estimate = onboard.Complementary(state["x"], q0, drawn["plumb"], drawn["follow"])
        estimate.velocity = state["v"].copy()
    commanded = "c" in drawn["channels"]
    firmware, control = onboard.Firmware(drawn["slope_time"]), SE3Control(rp.rotorpy_vehicle(told, {}))
    seen_at, last = _positions(rng, drawn, samples), 0
    sizes = {"position": 3, "velocity": 3, "quaternion": 4, "rates": 3, "specific": 3, "gyro": 3, "accel": 3}
    sizes |= {
        "rotor": 4,
        "motor": 4,
        "said_position": 3,
        "said_velocity": 3,
        "said_quaternion": 4,
        "deviations": 9,
    }
    out = {name: np.zeros((samples, size, 1), np.float32) for name, size in sizes.items()}
    out |= {name: np.zeros((samples, 1), np.float32) for name in ("voltage", "load")}
    out["gusts"] = np.concatenate([push / mass, twist * turning], 1)[..., None]  # of the velocities, per s
    out["command"] = np.zeros((samples // 5, 4, 1), np.float32)
    packed, m, wanted, crashed = model._pack_state(state), np.full(4, hover), (hover, np.zeros(3)), samples
    for s in range(samples):
        t, position, rates = STEP * s, packed[:3], packed[10:13]
        q, load = np.roll(packed[6:10], 1), float(m.mean())
        voltage = drawn["voltage"] - 0.02 * t - 0.35 * (load - hover)
        packed[13:16] = wind_at(t, position)
        force, torque, weak = loads(s, position)
        force, torque = (force + push[s]) / mass, (torque + twist[s]) * turning

        def slope(x, speeds, force=force, torque=torque):
            d = model._s_dot_fn(0.0, x, speeds)
            d[3:6] += force
            d[10:13] += torque
            return d

        def speeds_of(m, weak=weak, voltage=voltage):
            thrust = m if power == 1.0 else hover * (np.maximum(m, 1e-6) / hover) ** power
            thrust = thrust * rotors * weak * (1 + per_volt * (voltage - 3.7))
            return v.MAX_SPEED * np.sqrt(np.clip(thrust, 0.0, 1.2))

        one = slope(packed, speeds_of(m))
        specific = onboard.matrix_of(q).T @ (one[3:6] + onboard.GRAVITY)
        gyro, accel = low_gyro(rates + gyro_noise[s]), low_accel(specific + accel_noise[s])
        if s in seen_at:
            _measure(rng, drawn, estimate, out, max(s - 1, 0), STEP * (s - last))
            last = s
        if commanded:
            if s % 5 == 0:
                wanted = onboard.follow(
                    path.update(t),
                    estimate.position,
                    estimate.velocity,
                    estimate.attitude,
                    hover,
                    drawn["gains"],
                )
                out["command"][s // 5, :, 0] = [wanted[0], *wanted[1]]
            m = firmware(*wanted, gyro, STEP)
        elif s % 2 == 0:
            seen = {"x": estimate.position, "v": estimate.velocity, "w": gyro}
            seen["q"] = np.roll(estimate.attitude, -1)
            m = (
                np.clip(control.update(t, seen, path.update(t))["cmd_motor_speeds"], 0, v.MAX_SPEED)
                / v.MAX_SPEED
            ) ** 2
        for name, value in (
            ("position", position),
            ("velocity", packed[3:6]),
            ("quaternion", q),
            ("rates", rates),
            ("specific", specific),
            ("gyro", gyro),
            ("accel", accel),
            ("rotor", packed[16:]),
            ("motor", m),
            ("said_position", estimate.position),
            ("said_velocity", estimate.velocity),
            ("said_quaternion", estimate.attitude),
            ("deviations", np.sqrt(np.diag(estimate.p)) if hasattr(estimate, "p") else 0.0),
        ):
            out[name][s, :, 0] = value
        out["voltage"][s], out["load"][s] = voltage, load
        if (
            position[2] < 0.05
            or position[2] > 1.15
            or np.abs(position).max() > 2.0
            or abs(q[1]) + abs(q[2]) > 0.75
        ):
            crashed = s
            break
        estimate.predict(accel, gyro, STEP)
        # By the midpoint; what the motors get now acts over the step.
        speeds = speeds_of(m)
        one[16:] = (speeds - packed[16:]) / full["tau_m"]
        packed = packed + STEP * slope(packed + 0.5 * STEP * one, speeds)
        packed[6:10] /= np.linalg.norm(packed[6:10])
    out |= {"crashed": np.array([crashed]), "pose_delay": np.zeros(1), "pose_jitter": np.zeros(1)}
    return out
