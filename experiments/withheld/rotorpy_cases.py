"""Withheld cases flown in somebody else's simulator: RotorPy 3 (Folk, Paulos, Kumar 2023), the `dev` extra.

    python -m experiments.withheld.rotorpy_cases --seed 201 --each 5 --logs OUT/logs --answers
    OUT/answers.json [--jobs N]

Rigid body, rotors, drag at the hubs (proportional to rotor speed), parasitic drag, flapping moment,
translational lift, motor lag and wind are RotorPy's; the rate loop of the firmware, the off-board controller,
missions and sensor noise are those of the withheld plant. The vehicle carries the nominal numbers with one
thing changed. RotorPy's flapping coefficient is taken negative: with its sign convention a positive one
pitches the nose down in forward flight, against what flapping does.
"""

import argparse
import math
import multiprocessing
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from experiments.withheld import body as b
from experiments.withheld import cases, generate, missions, plant, replay, sensors

TICKS = 850
HOVER_SPEED = b.MAX_SPEED * math.sqrt(b.MASS * b.GRAVITY / (4 * b.MAX_THRUST))
FAST, TURN = ("fast", "agile", "spiral"), ("agile", "step", "yaw")


def _none(rng):
    return {}, None, {}


def _drag(rng):
    d = rng.uniform(0.005, 0.025)
    return (
        {"k_d": d / (4 * HOVER_SPEED), "k_z": 0.7 * d / (4 * HOVER_SPEED)},
        None,
        {"d_xy": d, "d_z": 0.7 * d},
    )


def _parasitic(rng):
    c = rng.uniform(0.006, 0.02)
    return {"c_Dx": c, "c_Dy": c, "c_Dz": c}, None, {"quadratic": c}


def _flapping(rng):
    k = rng.uniform(0.6e-4, 3e-4)
    return {"k_flap": -k / (4 * HOVER_SPEED)}, None, {"torque_N_m_per_m_s": k}


def _steady_wind(rng):
    speed, angle, d = rng.uniform(0.4, 1.6), rng.uniform(0, 2 * np.pi), rng.uniform(0.008, 0.015)
    wind = [speed * np.cos(angle), speed * np.sin(angle), 0.0]
    said = {"w_x": wind[0], "w_y": wind[1], "speed": speed, "drag": d}
    return {"k_d": d / (4 * HOVER_SPEED), "k_z": d / (4 * HOVER_SPEED)}, ("constant", wind), said


def _swaying_wind(rng):
    drag, (_, wind), said = _steady_wind(rng)
    return drag, ("swaying", wind), said | {"sway": 0.25 * said["speed"]}


def _lag(rng):
    tau = float(np.exp(rng.uniform(np.log(0.035), np.log(0.09))))
    return {"tau_m": tau}, None, {"tau_up": tau, "tau_down": tau}


def _mass(rng):
    ratio = 1 + rng.choice([-1, 1]) * rng.uniform(0.03, 0.2)
    return {"mass": b.MASS * ratio}, None, {"mass_kg": b.MASS * ratio, "ratio": ratio}


def _inertia(rng):
    ratio = rng.uniform(1.15, 1.5, 3)
    return dict(zip(("Ixx", "Iyy", "Izz"), b.INERTIA * ratio, strict=True)), None, {"ratio": ratio.tolist()}


def _yaw(rng):
    ratio = rng.uniform(0.2, 0.8)
    return {"k_m": b.TORQUE_RATIO * b.THRUST_CONSTANT * ratio}, None, {"ratio": ratio}


def _lift(rng):
    k = rng.uniform(0.0006, 0.003)
    return {"k_h": k}, None, {"k_h": k}


def _noisy_motors(rng):
    # RotorPy's own sensor-like noise on the rotor speeds: process noise, no cause
    return {"motor_noise_std": rng.uniform(0.5, 2.0)}, None, {}


def _drag_and_lag(rng):
    one, _, said_one = _drag(rng)
    two, _, said_two = _lag(rng)
    return one | two, None, [said_one, said_two]


# kind: (draw, effects, form as the scorer knows it, exposing missions)
KINDS = {
    "none": (_none, [], "", ()),
    "noisy_motors": (_noisy_motors, [], "", ()),
    "rotor_drag": (_drag, ["rotor_drag"], "rotor_speed", FAST),
    "parasitic_drag": (_parasitic, ["rotor_drag"], "parasitic", FAST),
    "blade_flapping": (_flapping, ["blade_flapping"], "linear", FAST),
    "wind": (_steady_wind, ["wind"], "steady", ("yaw", "fast", "hover")),
    "wind_swaying": (_swaying_wind, ["wind"], "swaying", ("yaw", "fast", "hover")),
    "motor_lag": (_lag, ["motor_lag"], "slower", TURN),
    "mass": (_mass, ["mass"], "plain", ()),
    "inertia": (_inertia, ["inertia"], "diagonal", TURN),
    "yaw_torque": (_yaw, ["yaw_torque"], "scale", ("yaw",)),
    "translational_lift": (_lift, ["unknown"], "outside", FAST),
    "drag_and_lag": (_drag_and_lag, ["rotor_drag", "motor_lag"], "rotor_speed", FAST),
}


def vehicle_parameters(changed):
    """RotorPy's parameter dict of the nominal vehicle (SPEC numbers, no aerodynamics) with some entries
    changed.
    """
    hubs = {f"r{i + 1}": np.array([b.ROTOR_X[i], b.ROTOR_Y[i], 0.0]) for i in range(4)}
    out = {
        "mass": b.MASS,
        "Ixx": b.INERTIA[0],
        "Iyy": b.INERTIA[1],
        "Izz": b.INERTIA[2],
        "Ixy": 0.0,
        "Iyz": 0.0,
        "Ixz": 0.0,
        "num_rotors": 4,
        "rotor_pos": hubs,
        "rotor_directions": b.SPIN,
        "rI": np.zeros(3),
        "c_Dx": 0.0,
        "c_Dy": 0.0,
        "c_Dz": 0.0,
        "k_eta": b.THRUST_CONSTANT,
        "k_m": b.TORQUE_RATIO * b.THRUST_CONSTANT,
        "k_d": 0.0,
        "k_z": 0.0,
        "k_h": 0.0,
        "k_flap": 0.0,
        "tau_m": b.MOTOR_TIME,
        "rotor_speed_min": 0.0,
        "rotor_speed_max": b.MAX_SPEED,
        "motor_noise_std": 0.0,
    }
    unknown = set(changed) - set(out)
    if unknown:
        raise ValueError(f"not parameters of RotorPy's multirotor: {sorted(unknown)}")
    return out | changed


def _wind(kind):
    from rotorpy.wind.default_winds import ConstantWind, NoWind, SinusoidWind

    if kind is None:
        return NoWind()
    name, mean = kind
    steady = ConstantWind(*mean)
    if name == "constant":
        return steady
    # RotorPy's gusts (Dryden) need PyTorch; its sinusoid on top of its steady wind does not
    sway = SinusoidWind(0.25 * np.array(mean), np.array([0.4, 0.55, 0.3]), np.array([0.0, 0.7, 0.3]))
    return SimpleNamespace(update=lambda t, position: steady.update(t, position) + sway.update(t, position))


def fly(changed, wind, reference, noise, ticks=TICKS):
    """One flight in RotorPy: the same dict of (K, n, 1) arrays that `plant.fly` gives."""
    from rotorpy.vehicles.multirotor import Multirotor

    dt = 0.002
    start = reference["position"][0, :, 0]
    half = 0.5 * reference["yaw"][0, 0]
    state = {
        "x": start.copy(),
        "v": np.zeros(3),
        "q": np.array([0, 0, np.sin(half), np.cos(half)]),
        "w": np.zeros(3),
        "wind": np.zeros(3),
        "rotor_speeds": np.full(4, HOVER_SPEED),
    }
    model = Multirotor(
        vehicle_parameters(changed),
        state,
        control_abstraction="cmd_motor_speeds",
        aero=True,
        integrator_kwargs={"method": "RK23", "rtol": 1e-5, "atol": 1e-7},
    )
    air = _wind(wind)
    names = {
        "position": 3,
        "velocity": 3,
        "rates": 3,
        "specific": 3,
        "integral": 3,
        "measured_position": 3,
        "measured_velocity": 3,
        "quaternion": 4,
        "rotor": 4,
        "motor": 4,
        "measured_quaternion": 4,
        "command": 4,
    }
    out = {n: np.zeros((ticks, size, 1), np.float32) for n, size in names.items()} | {
        "voltage": np.zeros((ticks, 1), np.float32)
    }
    integral, goal = np.zeros((3, 1)), np.zeros((3, 1))
    previous, used, voltage = np.zeros((3, 1)), 0.0, float(noise["open_voltage"][0])
    crashed = ticks
    delay = 0.001 * float(noise["mocap_delay"][0])
    for k in range(ticks):
        q = np.roll(state["q"], 1)[:, None]
        p, v, w = state["x"][:, None], state["v"][:, None], state["w"][:, None]
        state["wind"] = air.update(0.01 * k, state["x"])
        accel = model.statedot(state, {"cmd_motor_speeds": state["rotor_speeds"]}, dt)["vdot"][:, None]
        seen_p = p - delay * v + noise["position"][k]
        seen_v = v - delay * accel + noise["velocity"][k]
        seen_q = b.turn(q, -w, delay)
        seen_q = b.multiply(seen_q, noise["attitude"][k])
        seen_q = seen_q / np.sqrt((seen_q * seen_q).sum(axis=0))
        command = plant.off_board_control(reference, k, seen_p, seen_q, seen_v, goal, b.MASS)
        for name, value in (
            ("position", p),
            ("velocity", v),
            ("rates", w),
            ("integral", integral),
            ("measured_position", seen_p),
            ("measured_velocity", seen_v),
            ("quaternion", q),
            ("rotor", state["rotor_speeds"][:, None]),
            ("measured_quaternion", seen_q),
            ("command", command),
            ("specific", b.rotate_back(q, accel + np.array([[0.0], [0.0], [b.GRAVITY]]))),
        ):
            out[name][k] = value
        out["voltage"][k] = voltage
        if p[2, 0] < 0.015 or 1 - 2 * (q[1, 0] ** 2 + q[2, 0] ** 2) < 0.087:
            crashed = k
            break
        for i in range(5):
            gyro = state["w"][:, None] + noise["gyro_bias"] + noise["gyro_loop"][5 * k + i]
            error = np.rad2deg(command[1:] - gyro)
            integral = np.clip(integral + dt * error, -b.INTEGRAL_LIMIT[:, None], b.INTEGRAL_LIMIT[:, None])
            slope = -np.rad2deg(gyro - previous) / dt
            previous = gyro
            m = b.mix(
                command[0],
                b.RATE_KP[:, None] * error + b.RATE_KI[:, None] * integral + b.RATE_KD[:, None] * slope,
            )
            out["motor"][k] += 0.2 * m
            state["wind"] = air.update(0.01 * k + dt * i, state["x"])
            state = model.step(state, {"cmd_motor_speeds": b.MAX_SPEED * np.sqrt(m[:, 0])}, dt)
        load = float((m * np.sqrt(m)).mean())
        used += 0.01 * load
        voltage = float(
            noise["open_voltage"][0] - noise["discharge"][0] * used - noise["resistance"][0] * load
        )
    out["crashed"] = np.array([crashed])
    out["pose"] = out["measured_quaternion"]
    return out


def make_case(job):
    """Fly and write one case; returns its answer."""
    seed, number, kind, folder = job
    rng = cases.case_rng(seed, number, 7)
    draw, effects, form, needed = KINDS[kind]
    changed, wind, said = draw(rng)
    np.random.seed(seed * 1000 + number)  # noqa: NPY002  RotorPy draws its motor noise from the global state
    shared = sensors.draw_case(rng)
    changed = {"k_eta": b.THRUST_CONSTANT * (1 + shared["thrust_offset"])} | changed
    names = [m[0] for m in cases.draw_missions(rng, [needed], False)]
    flown, noises = [], []
    for name in names:
        reference = {key: value[..., None] for key, value in missions.single(name, rng, TICKS).items()}
        noise = sensors.stack(
            [sensors.draw_flight(rng, shared, TICKS, shared["voltage"] + rng.uniform(-0.25, 0.15))]
        )
        flown.append(fly(changed, wind, reference, noise))
        noises.append(noise)
    joined = {key: np.concatenate([f[key] for f in flown], axis=-1) for key in flown[0]}
    noise = {key: np.concatenate([n[key] for n in noises], axis=-1) for key in noises[0]}
    flights = SimpleNamespace(
        of_flight=[[[0], [1], [2]]], ticks=[[TICKS] * 3], noise=noise, partner=np.arange(3)
    )
    spec = {"mass_weighed": False, "name": f"case_{number:04d}"}
    lengths = generate.write_case(Path(folder) / spec["name"], spec, flights, joined, 0)
    level = cases.floor()
    # the sensors' part (pose noise, the rate loop's gyro bias and noise) is there without any cause
    base = np.where([c.startswith("velocity") for c in replay.CHANNELS], 0.0, level)
    rms = np.sqrt((replay.errors(joined, min(lengths)) ** 2).mean(axis=(1, 2)))
    ratio = np.sqrt(np.maximum(rms**2 - base**2, 0.0)) / level
    said = said if isinstance(said, list) else [said]
    causes = [
        {"effect": e if e != "unknown" else kind, "form": form, "magnitudes": s}
        for e, s in zip(effects, said, strict=False)
    ]
    if len(causes) == 2:
        causes[1]["form"] = "slower"
    kinds = {0: "none", 1: "unknown" if effects == ["unknown"] else "single", 2: "pair"}
    return {
        "case": spec["name"],
        "kind": kinds[len(effects)],
        "rotorpy": kind,
        "effects": effects,
        "without": [],
        "mass_weighed": False,
        "causes": causes,
        "severity_ratio": round(float(ratio.max()), 3),
        "hidden": None,
        "severity": cases.label(float(ratio.max())) if effects else None,
        "ratio_per_channel": {c: round(float(r), 3) for c, r in zip(replay.CHANNELS, ratio, strict=True)},
        "exposure": cases.exposure(joined, flights, 0),
        "flights": [[n] for n in names],
        "ticks": lengths,
        "gap": {"before": None, "floor": None, "closed_by_truth": 0.0},
        "crashed": bool(joined["crashed"].min() < TICKS),
    }


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=201)
    parser.add_argument("--each", type=int, default=5, help="cases of each kind")
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--logs", type=Path, required=True)
    parser.add_argument("--answers", type=Path, required=True)
    parser.add_argument("--jobs", type=int, default=1)
    options = parser.parse_args()
    if options.answers.resolve().is_relative_to(options.logs.resolve()):
        parser.error("--answers must not lie inside --logs")
    drawn = [kind for kind in options.kinds.split(",") for _ in range(options.each)]
    order = cases.case_rng(options.seed, 0, 99).permutation(len(drawn))
    jobs = [(options.seed, n, drawn[i], str(options.logs)) for n, i in enumerate(order, 1)]
    with multiprocessing.get_context("spawn").Pool(options.jobs) as pool:
        answers = []
        for answer in pool.imap_unordered(make_case, jobs):
            answers.append(answer)
            print(f"{len(answers)}/{len(jobs)} cases", flush=True)
    answers.sort(key=lambda a: a["case"])
    print("sha256", generate.write_answers(options.answers, answers, options.seed, options.each))


if __name__ == "__main__":
    main()
