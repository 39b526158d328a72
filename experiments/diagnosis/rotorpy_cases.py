"""Cases flown in somebody else's simulator: RotorPy 3 (Folk, Paulos, Kumar 2023), the
`dev` extra.

    python -m experiments.diagnosis.rotorpy_cases --seed 101 --each 4 --logs LOGS --answers
    ANSWERS.json [--jobs 8]

Rigid body, rotors, hub drag, parasitic drag, flapping moment, translational lift, motor
lag, wind, the controller (SE3Control, motor speeds at 250 Hz from the measured state)
and the trajectories are RotorPy's; the told vehicles, the sensors of the known column
and the measure of severity are the exam's. There are no body-rate commands. RotorPy's
flapping coefficient is taken negative: with its sign convention a positive one pitches
the nose down in forward flight, against what flapping does.
"""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from experiments.diagnosis import cases, fleet, measure, sensors
from experiments.diagnosis import vehicle as v
from experiments.diagnosis.answer_key import HIDDEN, accepted
from experiments.diagnosis.body import Battery
from experiments.diagnosis.firmware import SAMPLE, Filter
from experiments.diagnosis.generate import case_parser, in_processes, write_answers
from experiments.diagnosis.plant import KEPT, POSE
from experiments.flying.single_thread import use_single_thread

PATHS = ("circle", "eight", "rocking", "yawing")
SECONDS = 8.0
TUNNEL_HEIGHT = 0.65  # m
LEAST = 4.0 / SAMPLE + 1  # samples that a flight must last
LAPS = ("circle", "eight")
TURNS = ("eight", "rocking")
TURNING = ("yawing", "rocking")


def hubs(x=0.0, y=0.0):
    """Rotors of RotorPy's vehicle, numbered as the firmware has them, about a centre of
    mass at (x, y) m.
    """
    return {
        f"r{i + 1}": np.array([v.ROTOR_X[i] - x, v.ROTOR_Y[i] - y, 0.0])
        for i in range(4)
    }


def _drag(rng, told, hover):
    d = rng.uniform(0.005, 0.025)
    return (
        {"k_d": d / (4 * hover), "k_z": 0.7 * d / (4 * hover)},
        None,
        {"d_xy": d, "d_z": 0.7 * d},
    )


def _parasitic(rng, told, hover):
    c = rng.uniform(0.006, 0.02)
    return {"c_Dx": c, "c_Dy": c, "c_Dz": c}, None, {"quadratic": c}


def _flapping(rng, told, hover):
    k = rng.uniform(0.6e-4, 3e-4)
    return (
        {"k_flap": -k / (4 * hover)},
        None,
        {"torque_N_m_per_m_s": k, "tilt_rad_per_m_s": 0.0},
    )


def _wind(rng, told, hover, name="steady", times=1):
    speed = rng.uniform(0.4, 1.6)
    angle = rng.uniform(0, 2 * np.pi)
    drag, _, said = _drag(rng, told, hover)
    wind = [speed * np.cos(angle), speed * np.sin(angle), 0.0]
    return (
        drag,
        (name, [times * w for w in wind]),
        {"w_x": wind[0], "w_y": wind[1], "speed": speed, "drag": said["d_xy"]},
    )


def _lag(rng, told, hover):
    tau = told.motor_time * rng.uniform(1.4, 3.5)
    return {"tau_m": tau}, None, {"tau_up": tau, "tau_down": tau}


def _mass(rng, told, hover):
    ratio = 1 + rng.choice([-1, 1]) * rng.uniform(0.03, 0.2)
    return (
        {"mass": told.mass * ratio},
        None,
        {"mass_kg": told.mass * ratio, "ratio": ratio},
    )


def _thrust(rng, told, hover):
    scale = rng.choice([-1, 1]) * rng.uniform(0.03, 0.15)
    k_eta = told.thrust_constant * (1 + scale)
    k_m = told.torque_ratio * told.thrust_constant * (1 + scale)
    return {"k_eta": k_eta, "k_m": k_m}, None, {"scale": scale}


def _inertia(rng, told, hover):
    ratio = rng.uniform(1.15, 1.5, 3)
    moments = dict(
        zip(("Ixx", "Iyy", "Izz"), np.array(told.inertia) * ratio, strict=True)
    )
    return moments, None, {"ratio": ratio.tolist()}


def _yaw(rng, told, hover):
    ratio = rng.uniform(0.3, 0.8)
    return (
        {"k_m": told.torque_ratio * told.thrust_constant * ratio},
        None,
        {"ratio": ratio},
    )


def _offset(rng, told, hover):
    angle = rng.uniform(0, 2 * np.pi)
    size = rng.uniform(0.2, 2.0)
    x = size * np.cos(angle)
    y = size * np.sin(angle)
    return {"rotor_pos": hubs(1e-3 * x, 1e-3 * y)}, None, {"x_mm": x, "y_mm": y}


def _lift(rng, told, hover):
    k = rng.uniform(0.0006, 0.003)
    return {"k_h": k}, None, {"strength": k}


def _noisy(rng, told, hover):
    # process noise, no cause
    return {"motor_noise_std": rng.uniform(0.5, 2.0)}, None, {}


def _drag_and_lag(rng, told, hover):
    (one, _, said_one), (two, _, said_two) = (
        _drag(rng, told, hover),
        _lag(rng, told, hover),
    )
    return one | two, None, [said_one, said_two]


# kind: (draw, effects, form as the scorer knows it, trajectories that expose it)
KINDS = {
    "none": (lambda *_: ({}, None, {}), [], "", ()),
    "noisy_motors": (_noisy, [], "", ()),
    "rotor_drag": (_drag, ["rotor_drag"], "rotor_speed", LAPS),
    "parasitic_drag": (_parasitic, ["rotor_drag"], "parasitic", LAPS),
    "blade_flapping": (_flapping, ["blade_flapping"], "linear", LAPS),
    "wind": (_wind, ["wind"], "steady", ("circle", "yawing", "hover")),
    "swaying_wind": (
        partial(_wind, name="swaying"),
        ["wind"],
        "swaying",
        ("circle", "yawing", "hover"),
    ),
    "motor_lag": (_lag, ["motor_lag"], "slower", TURNS),
    "mass": (_mass, ["mass"], "plain", ()),
    "thrust_scale": (_thrust, ["thrust_scale"], "plain", ()),
    "inertia": (_inertia, ["inertia"], "diagonal", TURNING),
    "yaw_torque": (_yaw, ["yaw_torque"], "scale", ("yawing",)),
    "com_offset": (_offset, ["com_offset"], "torque", ()),
    "translational_lift": (_lift, ["unknown"], "outside", LAPS),
    "wind_tunnel": (
        partial(_wind, name="tunnel", times=2),
        ["unknown"],
        "outside",
        LAPS,
    ),
    "drag_and_lag": (
        _drag_and_lag,
        ["rotor_drag", "motor_lag"],
        ("rotor_speed", "slower"),
        LAPS + TURNS,
    ),
}


def rotorpy_vehicle(told, changed):
    """RotorPy's parameter dict of the told vehicle without aerodynamics, with some
    entries changed.
    """
    out = {
        "mass": told.mass,
        "num_rotors": 4,
        "rotor_pos": hubs(),
        "rotor_directions": v.SPIN,
        "rI": np.zeros(3),
    }
    out |= dict(zip(("Ixx", "Iyy", "Izz"), told.inertia, strict=True))
    out |= dict.fromkeys(
        ("Ixy", "Iyz", "Ixz", "c_Dx", "c_Dy", "c_Dz", "k_d", "k_z", "k_h", "k_flap"),
        0.0,
    )
    thrust = told.thrust_constant
    out |= {
        "k_eta": thrust,
        "k_m": told.torque_ratio * thrust,
        "tau_m": told.motor_time,
    }
    out |= {
        "rotor_speed_min": 0.0,
        "rotor_speed_max": v.MAX_SPEED,
        "motor_noise_std": 0.0,
    }
    if set(changed) - set(out):
        raise ValueError(
            f"not parameters of RotorPy's multirotor: {sorted(set(changed) - set(out))}"
        )
    return out | changed


def _air(kind):
    from rotorpy.wind.default_winds import ConstantWind, NoWind, SinusoidWind
    from rotorpy.wind.spatial_winds import WindTunnel

    if kind is None:
        return NoWind().update
    name, mean = kind
    mean = np.array(mean)
    if name == "tunnel":
        # Its axis goes through the origin, which is on the floor: it is lifted to where
        # the flights are.
        tunnel = WindTunnel(np.linalg.norm(mean), mean / np.linalg.norm(mean), 0.25)
        return lambda t, x: tunnel.update(t, x - [0.0, 0.0, TUNNEL_HEIGHT])
    steady = ConstantWind(*mean)
    sway = SinusoidWind(
        0.25 * mean, np.array([0.4, 0.55, 0.3]), np.array([0.0, 0.7, 0.3])
    )
    return (
        steady.update
        if name == "steady"
        else lambda t, x: steady.update(t, x) + sway.update(t, x)
    )


def trajectory(name, rng, slower=1.0):
    """One of RotorPy's trajectories within the arena."""
    from rotorpy.trajectories.circular_traj import ThreeDCircularTraj
    from rotorpy.trajectories.hover_traj import HoverTraj
    from rotorpy.trajectories.lissajous_traj import TwoDLissajous

    height = rng.uniform(0.5, 0.8)
    speed = rng.uniform(0.8, 1.3) * slower
    if name == "hover":
        return HoverTraj(x0=np.array([0.0, 0.0, height]))
    if name == "eight":
        a = speed
        return TwoDLissajous(
            A=0.55,
            B=0.5,
            a=a,
            b=2 * a,
            height=height,
            yaw_bool=bool(rng.random() < 0.5),
        )
    radius = rng.uniform(0.4, 0.6)
    rate = speed / 0.5 / (2 * np.pi)
    if name == "rocking":  # short swings on every axis
        size = np.array([0.06, 0.07, 0.03])
        rates = slower * rng.uniform(0.7, 1.2, 3)
        return ThreeDCircularTraj(
            np.array([0, 0, height]), size, rates, yaw_bool=bool(rng.random() < 0.5)
        )
    sizes = np.array([radius, radius, rng.uniform(0.05, 0.25)])
    rates = np.array([rate, rate, 0.6 * rate])
    return ThreeDCircularTraj(
        np.array([0, 0, height]), sizes, rates, yaw_bool=name == "yawing"
    )


def fly(told, changed, wind, path, drawn, air):
    """One flight in RotorPy as `plant.fly` would give it: dict of (S, n, 1) arrays
    every 2 ms.
    """
    from rotorpy.controllers.quadrotor_control import SE3Control
    from rotorpy.vehicles.multirotor import Multirotor

    samples = int(SECONDS / SAMPLE)
    goal = path.update(0.0)
    hover = v.MAX_SPEED * np.sqrt(told.hover)
    state = {
        "x": goal["x"].astype(float),
        "v": goal["x_dot"].astype(float),
        "q": np.array([0, 0, 0, 1.0]),
    }
    state |= {"w": np.zeros(3), "wind": np.zeros(3), "rotor_speeds": np.full(4, hover)}
    tight = {"method": "RK23", "rtol": 1e-5, "atol": 1e-7}
    model = Multirotor(
        rotorpy_vehicle(told, changed),
        state,
        "cmd_motor_speeds",
        aero=True,
        integrator_kwargs=tight,
    )
    control = SE3Control(rotorpy_vehicle(told, {}))
    wind_at = _air(wind)
    low = Filter(np.array([drawn["gyro_cut"]]), 3, air["gyro_bias"][:, None])
    cell = {k: np.array([air[k]]) for k in ("open_voltage", "discharge", "resistance")}
    battery = Battery(cell, np.array([told.hover]))
    sizes = POSE | {
        k: size for k, size in KEPT.items() if k not in ("integral", "applied")
    }
    out = {
        name: np.zeros((samples, size, 1), np.float32) for name, size in sizes.items()
    }
    out |= {name: np.zeros((samples, 1), np.float32) for name in ("voltage", "load")}
    m = np.full((4, 1), told.hover)
    crashed = samples
    voltage = battery.step(m, 0.0)
    for s in range(samples):
        t = SAMPLE * s
        state["wind"] = wind_at(t, state["x"])
        gyro = low(
            state["w"][:, None] + air["gyro_bias"][:, None] + air["gyro"][s][:, None]
        )
        if s % 2 == 0:
            k = s // 5
            q = (
                state["q"]
                + 0.5 * np.append(air["seen_attitude"][k][1:] * 2, 0.0) * state["q"][3]
            )
            seen = {
                "x": state["x"] + air["seen_position"][k],
                "v": state["v"] + air["seen_velocity"][k],
            }
            seen |= {"q": q / np.linalg.norm(q), "w": gyro[:, 0]}
            speeds = np.clip(
                control.update(t, seen, path.update(t))["cmd_motor_speeds"],
                0.0,
                v.MAX_SPEED,
            )
            m = (speeds[:, None] / v.MAX_SPEED) ** 2
        rotation = np.roll(state["q"], 1)[:, None]
        accel = model.statedot(state, {"cmd_motor_speeds": speeds}, SAMPLE)["vdot"][
            :, None
        ]
        accel[2] += v.GRAVITY
        names = {
            "position": "x",
            "velocity": "v",
            "rates": "w",
            "rotor": "rotor_speeds",
        }
        now = {name: state[theirs][:, None] for name, theirs in names.items()}
        now |= {
            "quaternion": rotation,
            "specific": v.rotate_back(rotation, accel),
            "gyro": gyro,
        }
        now |= {"motor": m, "voltage": voltage, "load": battery.load}
        for name, value in now.items():
            out[name][s] = value
        if state["x"][2] < 0.02 or np.linalg.norm(state["x"]) > 2.5:
            crashed = s
            break
        state = model.step(state, {"cmd_motor_speeds": speeds}, SAMPLE)
        voltage = battery.step(m, SAMPLE)
    out |= {
        "command": np.zeros((samples // 5, 4, 1), np.float32),
        "crashed": np.array([crashed]),
    }
    return out | {"pose_delay": np.zeros(1), "pose_jitter": np.zeros(1)}


def make_case(job):
    """Fly and write one case; returns its answer."""
    seed, number, kind, folder = job
    rng = np.random.default_rng(np.random.SeedSequence([17, seed, number]))
    draw, effects, _, exposing = KINDS[kind]
    told = v.draw_told(rng)
    if "mass" in effects:  # a vehicle whose mass is the cause wasn't weighed
        told = replace(told, weighed=False)
    changed, wind, said = draw(rng, told, v.MAX_SPEED * np.sqrt(told.hover))
    np.random.seed(seed * 1000 + number)  # noqa: NPY002  RotorPy draws its motor noise from the global state
    needed = "pgm" if effects else "m"
    drawn = sensors.draw(rng, str(rng.choice(sensors.KINDS)), needed, "none")
    drawn["channels"] = drawn["channels"].replace("c", "")
    if "m" not in drawn["channels"]:
        drawn["channels"] += "m"
    drawn["rate"] = min(drawn["rate"], 500)
    nuisance = {"k_eta": told.thrust_constant * (1 + drawn["thrust_offset"])}
    # one trajectory that exposes the cause, where only some do, and others
    names = [str(rng.choice(exposing))] if exposing else []
    names += [str(n) for n in rng.choice(PATHS, 3 - len(names), replace=False)]
    ticks = int(SECONDS * 100)
    flights = []
    flown = []
    for name in names:
        for slower in (1.0, 0.7, 0.5, 0.35):  # some vehicles can't follow fast paths
            air = sensors.draw_air(
                rng, drawn, ticks, drawn["voltage"] + rng.uniform(-0.15, 0.1)
            )
            flight = fly(
                told,
                nuisance | changed,
                wind,
                trajectory(name, rng, slower),
                drawn,
                air,
            )
            if flight["crashed"][0] >= LEAST:
                break
        flown.append(flight)
        length = min(ticks, int(flight["crashed"][0]) // 5 - 5)
        flights.append([sensors.log_rows(rng, drawn, flight, 0, length)])
    joined = {k: np.concatenate([f[k] for f in flown], axis=-1) for k in flown[0]}
    place = Path(folder) / f"case_{number:03d}"
    fleet.write_logs(
        place, flights, drawn["channels"], v.toml(told, "RotorPy 3", drawn)
    )
    return answer(place.name, kind, told, drawn, joined, flights, said)


def floor_of(told, drawn, joined, flights):
    """(seen, floor): mean squares (12,) of the told vehicle without a cause, and root
    mean squares of what air, sensors and the rows of the log leave to a true one.
    """
    many = [told] * 3
    none = np.zeros(3, bool)
    p = v.nominal_parameters(many)
    p["rotor_gain"] *= 1 + drawn["thrust_offset"]

    def errors(flown):
        return (measure.errors(flown, many, p, np.arange(3), none, none) ** 2).mean(
            axis=1
        )

    rows = [f[0] for f in flights]
    samples = len(joined["motor"])
    seen = errors(joined)
    sensed = np.array(
        [measure.sensor_floor(drawn, r, joined, j) for j, r in enumerate(rows)]
    )
    logged = np.stack([measure.motors_of_log(r, samples) for r in rows], axis=-1)
    lasts = np.minimum(joined["crashed"], [round(r["t"][-1] / SAMPLE) for r in rows])
    hidden = [errors(joined | {"motor": m, "crashed": lasts}) for m in logged]
    return seen, np.sqrt(
        (sensed**2).mean(axis=0) + np.maximum(np.min(hidden, axis=0) - seen, 0.0)
    )


def answer(name, kind, told, drawn, joined, flights, said):
    """The answer of one case; `said`: magnitudes of each effect."""
    _, effects, form, _ = KINDS[kind]
    seen, floor = floor_of(told, drawn, joined, flights)
    known = np.isfinite(floor)
    severity = float(np.sqrt(np.where(known, seen / floor**2, 0.0).max()))
    truth = [e if e != "unknown" else kind for e in effects]
    category = {
        0: "none",
        1: "unknown" if effects == ["unknown"] else "single",
        2: "pair",
    }[len(effects)]
    if effects and severity < HIDDEN:
        category = "not_testable"
    forms, each = ([x] if isinstance(x, str | dict) else x for x in (form, said))
    causes = zip(truth, forms, each, strict=False)
    fine = ["wind", "rotor_drag"] if kind == "wind_tunnel" else []
    return {
        "case": name,
        "category": category,
        "effects": truth,
        "expected": ["none"] if category in ("none", "not_testable") else effects,
        "acceptable": {e: accepted(e, told.weighed) for e in effects if e != "unknown"},
        "also_fine": truth if category == "not_testable" else fine,
        "causes": [{"effect": e, "form": f, "magnitudes": m} for e, f, m in causes],
        "severity": cases.label(severity) if effects else None,
        "severity_ratio": round(severity, 3),
        "told": told.__dict__,
        "sensors": drawn,
        "rotorpy": kind,
    }


def main():
    parser = case_parser(__doc__)
    parser.add_argument("--each", type=int, default=4, help="cases of each kind")
    options = parser.parse_args()
    use_single_thread()
    kinds = [kind for kind in KINDS for _ in range(options.each)]
    order = np.random.default_rng(options.seed).permutation(len(kinds))
    jobs = [
        (options.seed, n, kinds[i], str(options.logs)) for n, i in enumerate(order, 1)
    ]
    answers = sorted(
        in_processes(make_case, jobs, options.jobs), key=lambda a: a["case"]
    )
    print("sha256", write_answers(options.answers, answers, options.seed, "rotorpy"))


if __name__ == "__main__":
    main()
