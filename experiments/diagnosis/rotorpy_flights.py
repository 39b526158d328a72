"""Flights in RotorPy: its vehicle, its air, its trajectories and its controller."""

import numpy as np

from experiments.diagnosis import vehicle as v
from experiments.diagnosis.body import Battery
from experiments.diagnosis.firmware import SAMPLE, Filter
from experiments.diagnosis.plant import KEPT, POSE

SECONDS = 8.0
TUNNEL_HEIGHT = 0.65  # m


def hubs(x=0.0, y=0.0):
    """Rotors of RotorPy's vehicle, numbered as the firmware has them, about a centre of mass at (x,
    y) m.
    """
    return {f"r{i + 1}": np.array([v.ROTOR_X[i] - x, v.ROTOR_Y[i] - y, 0.0]) for i in range(4)}


def rotorpy_vehicle(told, changed):
    """RotorPy's parameter dict of the told vehicle without aerodynamics, with some entries changed."""
    out = {
        "mass": told.mass,
        "num_rotors": 4,
        "rotor_pos": hubs(),
        "rotor_directions": v.SPIN,
        "rI": np.zeros(3),
    }
    out |= dict(zip(("Ixx", "Iyy", "Izz"), told.inertia, strict=True))
    out |= dict.fromkeys(
        ("Ixy", "Iyz", "Ixz", "c_Dx", "c_Dy", "c_Dz", "k_d", "k_z", "k_h", "k_flap"), 0.0
    )
    thrust = told.thrust_constant
    out |= {"k_eta": thrust, "k_m": told.torque_ratio * thrust, "tau_m": told.motor_time}
    out |= {"rotor_speed_min": 0.0, "rotor_speed_max": v.MAX_SPEED, "motor_noise_std": 0.0}
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
    sway = SinusoidWind(0.25 * mean, np.array([0.4, 0.55, 0.3]), np.array([0.0, 0.7, 0.3]))
    return (
        steady.update if name == "steady" else lambda t, x: steady.update(t, x) + sway.update(t, x)
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
            A=0.55, B=0.5, a=a, b=2 * a, height=height, yaw_bool=bool(rng.random() < 0.5)
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
    return ThreeDCircularTraj(np.array([0, 0, height]), sizes, rates, yaw_bool=name == "yawing")


def fly(told, changed, wind, path, drawn, air):
    """One flight in RotorPy as `plant.fly` would give it: dict of (S, n, 1) arrays every 2 ms."""
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
    sizes = POSE | {k: size for k, size in KEPT.items() if k not in ("integral", "applied")}
    out = {name: np.zeros((samples, size, 1), np.float32) for name, size in sizes.items()}
    out |= {name: np.zeros((samples, 1), np.float32) for name in ("voltage", "load")}
    m = np.full((4, 1), told.hover)
    crashed = samples
    voltage = battery.step(m, 0.0)
    for s in range(samples):
        t = SAMPLE * s
        state["wind"] = wind_at(t, state["x"])
        gyro = low(state["w"][:, None] + air["gyro_bias"][:, None] + air["gyro"][s][:, None])
        if s % 2 == 0:
            k = s // 5
            q = state["q"] + 0.5 * np.append(air["seen_attitude"][k][1:] * 2, 0.0) * state["q"][3]
            seen = {
                "x": state["x"] + air["seen_position"][k],
                "v": state["v"] + air["seen_velocity"][k],
            }
            seen |= {"q": q / np.linalg.norm(q), "w": gyro[:, 0]}
            speeds = np.clip(
                control.update(t, seen, path.update(t))["cmd_motor_speeds"], 0.0, v.MAX_SPEED
            )
            m = (speeds[:, None] / v.MAX_SPEED) ** 2
        rotation = np.roll(state["q"], 1)[:, None]
        accel = model.statedot(state, {"cmd_motor_speeds": speeds}, SAMPLE)["vdot"][:, None]
        accel[2] += v.GRAVITY
        names = {"position": "x", "velocity": "v", "rates": "w", "rotor": "rotor_speeds"}
        now = {name: state[theirs][:, None] for name, theirs in names.items()}
        now |= {"quaternion": rotation, "specific": v.rotate_back(rotation, accel), "gyro": gyro}
        now |= {"motor": m, "voltage": voltage, "load": battery.load}
        for name, value in now.items():
            out[name][s] = value
        if state["x"][2] < 0.02 or np.linalg.norm(state["x"]) > 2.5:
            crashed = s
            break
        state = model.step(state, {"cmd_motor_speeds": speeds}, SAMPLE)
        voltage = battery.step(m, SAMPLE)
    out |= {"command": np.zeros((samples // 5, 4, 1), np.float32), "crashed": np.array([crashed])}
    return out | {"pose_delay": np.zeros(1), "pose_jitter": np.zeros(1)}
