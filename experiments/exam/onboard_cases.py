"""Cases flown in RotorPy by vehicles that know where they are from an on-board estimator, and log what it says.

    python -m experiments.exam.onboard_cases --seed 1 --each 2 --logs LOGS --answers ANSWERS.json [--jobs 8]

Vehicle, causes and trajectories are those of `rotorpy_cases`; estimators and loops are `onboard`'s, and the vehicle is
flown on the estimate. So the log's pose lags, jumps where a position comes in, leans with the accelerometer's bias, and its
velocity is no derivative of its position. Beside the causes of `rotorpy_cases` there are weak rotors, thrust curves,
sagging batteries, and unknown kinds that are local in time or place. Seeds from 50 on are for reported runs.
"""

import argparse
import multiprocessing
from pathlib import Path

import numpy as np
from scipy.signal import butter, lfilter

from experiments.exam import fleet, measure, onboard, sensors
from experiments.exam import rotorpy_cases as rp
from experiments.exam import vehicle as v
from experiments.exam.generate import write_answers
from experiments.single_thread import use_single_thread

STEP = 0.002  # s
SECONDS, SHORT = 8.0, 4.0  # of a flight; at 500 rows a second
FINISH = 4.0  # s that a flight must last
# where positions come from: (deviation m, rate Hz, how late at most s)
SOURCES = {
    "mocap": ((4e-4, 1.5e-3), (60.0, 100.0), 0.006),
    "lighthouse": ((2e-3, 8e-3), (30.0, 50.0), 0.004),
    "uwb": ((0.03, 0.08), (70.0, 100.0), 0.003),
    "flow": ((0.03, 0.1), (50.0, 100.0), 0.004),  # deviation in m/s; heights are good to 3 mm
}
KINDS = ("kalman_mocap", "kalman_pose", "kalman_lighthouse", "kalman_uwb", "kalman_flow", "mahony_mocap")
SHARES = (0.2, 0.2, 0.2, 0.12, 0.1, 0.18)
RATES = {50: 0.12, 100: 0.53, 250: 0.15, 500: 0.2}
TURBULENCE = {"none": (0.0, 0.05), "light": (0.3, 1.2), "strong": (2.0, 4.0)}  # mN rms


def _imbalance(rng, told, hover):
    e = np.zeros(4)
    e[rng.integers(4)] = -rng.uniform(0.04, 0.15)
    return {"rotors": 1 + e}, None, {"e": e.tolist()}


def _curve(rng, told, hover):
    return {"power": float(rng.choice([rng.uniform(0.7, 0.88), rng.uniform(1.15, 1.35)]))}, None, {}


def _sag(rng, told, hover):
    k = rng.uniform(0.2, 0.45)
    return {"per_volt": k}, None, {"thrust_per_volt": k, "reference_voltage": 3.7}


def _local(kind):
    return lambda rng, told, hover: ({"local": kind}, None, {})


def _both(one, two):
    def draw(rng, told, hover):
        (a, wind, said), (b, other, too) = one(rng, told, hover), two(rng, told, hover)
        return a | b, wind or other, [said, too]

    return draw


CAUSES = {k: x for k, x in rp.KINDS.items() if k not in ("noisy_motors", "translational_lift", "wind_tunnel")}
CAUSES |= {
    "motor_imbalance": (_imbalance, ["motor_imbalance"], "one_weak", ()),
    "thrust_curve": (_curve, ["thrust_curve"], "power", ("circle", "eight")),
    "battery_sag": (_sag, ["battery_sag"], "linear", ()),
    "mass_and_offset": (_both(rp._mass, rp._offset), ["mass", "com_offset"], ("plain", "torque"), ()),
    "drag_and_inertia": (
        _both(rp._drag, rp._inertia),
        ["rotor_drag", "inertia"],
        ("rotor_speed", "diagonal"),
        rp.TURNS,
    ),
}
LOCAL = ("kicks", "jet", "late_fault", "hiccups", "pulses")
CAUSES |= {k: (_local(k), ["unknown"], "outside", rp.LAPS if k == "jet" else ()) for k in LOCAL}
FINE = {"late_fault": ["motor_imbalance"], "hiccups": ["motor_imbalance"], "jet": ["wind"]}
WEIGHTS = {"none": 4, "inertia": 2, "thrust_curve": 2}  # how often more than others


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


def draw_sensors(rng, needed, commanded):
    """Estimator, sensors and log of a case: plain values, with the keys that the scorer reads."""
    kind = str(rng.choice(KINDS, p=SHARES))
    way = kind.split("_")[1]
    deviation, rates, late = SOURCES["mocap" if way == "pose" else way]
    good = float(np.exp(rng.uniform(np.log(0.5), np.log(2.0))))
    turbulence = str(rng.choice(list(TURBULENCE), p=[0.4, 0.4, 0.2]))
    chance = {"p": 1.0, "s": 0.75, "g": 0.93, "a": 0.85, "m": 0.95, "v": 0.8, "c": float(commanded)}
    have = set(needed) | {c for c, p in chance.items() if rng.random() < p}
    have |= set() if have & {"c", "m"} else {"m"}
    filtered = rng.random() < 0.5
    return {
        "kind": kind,
        "rate": int(rng.choice(list(RATES), p=list(RATES.values()))),
        "channels": "".join(sorted(have)),
        "turbulence": turbulence,
        "gust": float(rng.uniform(*TURBULENCE[turbulence])),
        "gust_time": float(rng.uniform(0.08, 0.4)),
        "deviation": float(rng.uniform(*deviation)),
        "source_rate": float(rng.uniform(*rates)),
        "late": float(rng.uniform(0, late)),
        "lost": float(rng.choice([0.0, 0.01, 0.03])),  # chance that a drop-out begins with a measurement
        "believed": float(
            np.exp(rng.uniform(np.log(0.6), np.log(1.8)))
        ),  # deviation in the filter over the true one
        "caution": float(rng.uniform(1.0, 4.0)),  # the same of the IMU's noise
        "plumb": float(np.exp(rng.uniform(np.log(0.05), np.log(0.4)))),
        "follow": float(rng.uniform(4.0, 15.0)),
        "gyro": 0.012 * good,
        "accel": 0.2 * good,
        "gyro_bias": rng.normal(0, 0.003, 3).tolist(),
        "accel_bias": rng.normal(0, 0.08, 3).tolist(),
        "gyro_cut": 80.0 if filtered else 0.0,
        "accel_cut": 30.0 if filtered else 0.0,
        "slope_time": float(rng.choice([0.0, 0.0, 0.003])),
        "gains": [rng.uniform(5, 11), rng.uniform(3.5, 5.5), rng.uniform(7, 12), rng.uniform(2, 5)],
        "thrust_offset": float(rng.uniform(-0.008, 0.008)),
        "constants_off": rng.uniform(-0.01, 0.01, 5).tolist(),
        "motor": "snapshot" if rng.random() < 0.5 else "mean",
        "dropped": float(rng.choice([0.0, 0.0, 0.01, 0.03])),
        "quantum": 1.0,
        "voltage": float(rng.uniform(3.6, 4.05)),
    }


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


def fly(told, changed, wind, path, drawn, rng, seconds=SECONDS):
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


def log_rows(rng, drawn, flown, seconds):
    """Rows of the log, dict column -> (n,): what estimator, sensors and loops hold when a row is written."""
    every = round(1 / (STEP * drawn["rate"]))
    place = np.arange(0, int(seconds / STEP) - every, every)
    keep = rng.random(len(place)) >= drawn["dropped"]
    keep[:3] = True
    place = place[keep]
    motor = flown["motor"][:, :, 0].astype(float)
    motors = (
        motor[place]
        if drawn["motor"] == "snapshot"
        else np.stack([motor[i : i + every].mean(0) for i in place])
    )
    voltage = flown["voltage"][place, 0] + 0.01 * rng.standard_normal(len(place))
    voltage[np.arange(len(place)) % max(drawn["rate"] // 10, 1) != 0] = np.nan
    groups = [
        flown[k][place, :, 0] for k in ("said_position", "said_quaternion", "said_velocity", "gyro", "accel")
    ]
    groups += [flown["command"][place // 5, :, 0], motors, voltage[:, None]]
    values = np.concatenate([g.astype(float) for g in groups], axis=1)
    return {"t": STEP * place} | dict(zip(sensors.COLUMNS[2:], values.T, strict=True))


def air_errors(joined):
    """Mean squares (12,) that the air alone adds to the errors of `measure`."""
    out = np.zeros(12)
    for columns, horizon in ((slice(0, 3), measure.LONG), (slice(3, 6), measure.SHORT)):
        whole = np.cumsum(joined["gusts"][:, columns], axis=0) * STEP
        out[columns] = ((whole[horizon:] - whole[:-horizon]) ** 2).mean(axis=(0, 2))
    return out


def make_case(job):
    """Fly and write one case; returns its answer."""
    seed, number, kind, folder = job
    rng = np.random.default_rng(np.random.SeedSequence([29, seed, number]))
    told = v.draw_told(rng)
    draw, effects, form, exposing = CAUSES[kind]
    if "mass" in effects:
        told = v.Told(**(told.__dict__ | {"weighed": False}))
    changed, wind, said = draw(rng, told, v.MAX_SPEED * np.sqrt(told.hover))
    torque = {"inertia", "yaw_torque", "motor_lag"} & set(effects)
    needed = "pgm" + ("v" if "battery_sag" in effects else "") if effects else ""
    drawn = draw_sensors(rng, needed, bool(torque) or rng.random() < 0.75)
    off = 1 + np.array(drawn["constants_off"])
    untold = {
        "k_eta": told.thrust_constant * (1 + drawn["thrust_offset"]),
        "tau_m": told.motor_time * (1 + 3 * (off[0] - 1)),
    }
    untold["k_m"] = told.torque_ratio * untold["k_eta"] * off[1]
    untold |= dict(zip(("Ixx", "Iyy", "Izz"), np.array(told.inertia) * off[2:], strict=True))
    names = [str(rng.choice(exposing))] if exposing else []
    names += [
        str(n)
        for n in rng.choice(("circle", "eight", "rocking", "yawing", "hover"), 3 - len(names), replace=False)
    ]
    seconds = SHORT if drawn["rate"] >= 500 else SECONDS
    flights, flown = [], []
    for name in names:
        for slower in (1.0, 0.7, 0.5, 0.35):  # some vehicles can't follow the fast ones
            flight = fly(told, untold | changed, wind, rp.trajectory(name, rng, slower), drawn, rng, seconds)
            if flight["crashed"][0] >= min(FINISH, seconds - 0.1) / STEP:
                break
        flown.append(flight)
        flights.append([log_rows(rng, drawn, flight, max(STEP * flight["crashed"][0] - 0.05, 0.5))])
    joined = {k: np.concatenate([f[k] for f in flown], axis=-1) for k in flown[0]}
    place = Path(folder) / f"case_{number:03d}"
    place.mkdir(parents=True, exist_ok=True)
    for letter, flight in zip("abc", flights, strict=True):
        fleet.write_flight(place / f"flight_{letter}.csv.gz", flight, drawn["channels"])
    (place / "vehicle.toml").write_text(v.toml(told, "RotorPy 3, on-board estimate", drawn["rate"]))
    controller = "rates" if "c" in drawn["channels"] else "SE3Control"
    return rp.answer(
        place.name,
        kind,
        told,
        drawn,
        names,
        joined,
        flights,
        effects,
        form,
        said,
        controller,
        FINE.get(kind, []),
        air_errors(joined),
        drawn["constants_off"],
    )


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--each", type=int, default=2, help="cases of each kind")
    parser.add_argument("--kinds", default=",".join(CAUSES))
    parser.add_argument("--cases", help="these cases of the plan alone, comma-separated: case_003,case_017")
    parser.add_argument("--logs", type=Path, required=True)
    parser.add_argument("--answers", type=Path, required=True)
    parser.add_argument("--jobs", type=int, default=1)
    options = parser.parse_args()
    use_single_thread()
    drawn = [k for k in options.kinds.split(",") for _ in range(options.each * WEIGHTS.get(k, 1))]
    order = np.random.default_rng(options.seed).permutation(len(drawn))
    jobs = [(options.seed, n, drawn[i], str(options.logs)) for n, i in enumerate(order, 1)]
    if options.cases:
        jobs = [job for job in jobs if f"case_{job[1]:03d}" in options.cases.split(",")]
    with multiprocessing.get_context("spawn").Pool(options.jobs) as pool:
        answers = sorted(pool.imap_unordered(make_case, jobs), key=lambda a: a["case"])
    print("sha256", write_answers(options.answers, answers, options.seed, "onboard"))


if __name__ == "__main__":
    main()
