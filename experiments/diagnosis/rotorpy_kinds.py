"""What is wrong with the vehicles of RotorPy's cases, drawn kind by kind."""

from functools import partial

import numpy as np

from experiments.diagnosis.rotorpy_flights import hubs

LAPS = ("circle", "eight")
TURNS = ("eight", "rocking")
TURNING = ("yawing", "rocking")


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
    return ({"k_flap": -k / (4 * hover)}, None, {"torque_N_m_per_m_s": k, "tilt_rad_per_m_s": 0.0})


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
    return ({"mass": told.mass * ratio}, None, {"mass_kg": told.mass * ratio, "ratio": ratio})


def _thrust(rng, told, hover):
    scale = rng.choice([-1, 1]) * rng.uniform(0.03, 0.15)
    k_eta = told.thrust_constant * (1 + scale)
    k_m = told.torque_ratio * told.thrust_constant * (1 + scale)
    return {"k_eta": k_eta, "k_m": k_m}, None, {"scale": scale}


def _inertia(rng, told, hover):
    ratio = rng.uniform(1.15, 1.5, 3)
    moments = dict(zip(("Ixx", "Iyy", "Izz"), np.array(told.inertia) * ratio, strict=True))
    return moments, None, {"ratio": ratio.tolist()}


def _yaw(rng, told, hover):
    ratio = rng.uniform(0.3, 0.8)
    return ({"k_m": told.torque_ratio * told.thrust_constant * ratio}, None, {"ratio": ratio})


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
    (one, _, said_one), (two, _, said_two) = (_drag(rng, told, hover), _lag(rng, told, hover))
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
    "wind_tunnel": (partial(_wind, name="tunnel", times=2), ["unknown"], "outside", LAPS),
    "drag_and_lag": (
        _drag_and_lag,
        ["rotor_drag", "motor_lag"],
        ("rotor_speed", "slower"),
        LAPS + TURNS,
    ),
}
