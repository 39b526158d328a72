"""The vehicle of the exam's plants: published constants, parameters per simulated body, and vector
helpers.

Nothing is imported from `openjax`, so that a mistake in one is not repeated in the other. Arrays
carry the body index last, (3, B) or (4, B). Frames: world z up, body x forward, y left, z up,
quaternions wxyz body to world.
"""

from dataclasses import dataclass

import numpy as np

GRAVITY = 9.81
MASS = 0.0321  # kg
INERTIA = np.array([1.4e-5, 1.4e-5, 2.17e-5])  # kg m^2
ARM = 0.043 / np.sqrt(2.0)  # m, x-configuration
# front right, rear right, rear left, front left
ROTOR_X = np.array([1.0, -1.0, -1.0, 1.0]) * ARM
ROTOR_Y = np.array([-1.0, -1.0, 1.0, 1.0]) * ARM
SPIN = np.array([-1.0, 1.0, -1.0, 1.0])  # a clockwise rotor pushes the body along +z
THRUST_CONSTANT = 2.350347e-8  # N s^2
TORQUE_RATIO = 7.24e-10 / 2.350347e-8  # m, k_m / k_f
MAX_SPEED = 2315.0  # rad/s
MOTOR_TIME = 0.025  # s
PROPELLER = 0.023  # m, radius
CEILING = 1.2  # m
RATE_KP = np.array([250.0, 250.0, 120.0])  # counts per deg/s
RATE_KI = np.array([500.0, 500.0, 16.7])  # counts per deg
RATE_KD = np.array([2.5, 2.5, 0.0])  # counts per deg/s^2, on the measurement
INTEGRAL_LIMIT = np.array([33.3, 33.3, 166.7])  # deg
OUTPUT_LIMIT = 32767.0


@dataclass(frozen=True)
class Told:
    """What the simulator is told about a vehicle: mass kg, thrust constant N s^2, k_m/k_f m, motor
    time s, inertia kg m^2.
    """

    mass: float = MASS
    thrust_constant: float = THRUST_CONSTANT
    torque_ratio: float = TORQUE_RATIO
    motor_time: float = MOTOR_TIME
    inertia: tuple = tuple(INERTIA.tolist())
    weighed: bool = False

    @property
    def hover(self):
        """Motor command at hover, 0..1."""
        return self.mass * GRAVITY / (4 * self.thrust_constant * MAX_SPEED**2)


def draw_told(rng):
    """A vehicle of 27 to 45 g. A heavy one carries stronger motors; constants are off the published
    ones by some per cent.
    """
    mass = float(rng.uniform(0.027, 0.045))
    standard = mass < 0.037 and rng.random() < 0.6
    thrust = (
        THRUST_CONSTANT
        if standard
        else mass * GRAVITY / (4 * rng.uniform(0.5, 0.66) * MAX_SPEED**2)
    )
    size = 1.0 if standard and rng.random() < 0.5 else mass / MASS * rng.uniform(0.93, 1.1)
    ratio = TORQUE_RATIO if rng.random() < 0.6 else rng.uniform(0.006, 0.02)
    time = MOTOR_TIME if standard and rng.random() < 0.5 else rng.uniform(0.02, 0.04)
    moments = INERTIA * size if size == 1.0 else INERTIA * size * rng.uniform(0.97, 1.03, 3)
    return Told(
        mass=round(mass, 5),
        thrust_constant=float(f"{thrust:.5g}") if not standard else THRUST_CONSTANT,
        torque_ratio=float(f"{ratio:.4g}") if ratio != TORQUE_RATIO else TORQUE_RATIO,
        motor_time=round(float(time), 4),
        inertia=tuple(float(f"{v:.4g}") for v in moments),
        weighed=bool(rng.random() < 0.4),
    )


def toml(told, source, sensors, command="thrust"):
    """Text of the case's `vehicle.toml`: the vehicle as told, and what a laboratory knows of its
    logger.
    """
    lines = ["[vehicle]", 'name = "crazyflie-2.1"', f"mass = {told.mass:.5f}"]
    lines += [
        f"mass_weighed = {'true' if told.weighed else 'false'}",
        "",
        "[motor]",
        f'command = "{command}"',
    ]
    lines += ['order = ["front_right", "rear_right", "rear_left", "front_left"]']
    lines += ['spin = ["ccw", "cw", "ccw", "cw"]']
    if (told.torque_ratio, told.thrust_constant) != (TORQUE_RATIO, THRUST_CONSTANT):
        lines.append(f"torque_per_thrust = {told.torque_ratio:.4g}")
    lines += ["", "[log]", f'source = "{source}"', f"motion_capture_rate = {sensors['pose_rate']}"]
    lines.append(f'motor_rows = "{"mean" if sensors["motor"] == "mean" else "sample"}"')
    for name, value, nominal, unit in (
        ("thrust_constant", told.thrust_constant, THRUST_CONSTANT, "N s^2"),
        ("motor_time_constant", told.motor_time, MOTOR_TIME, "s"),
        ("inertia", told.inertia, tuple(INERTIA.tolist()), "kg m^2"),
    ):
        if value == nominal:
            continue
        values = value if isinstance(value, tuple) else (value,)
        interval = ", ".join(f"[{0.98 * v:.5g}, {1.02 * v:.5g}]" for v in values)
        said = ", ".join(f"{v:.5g}" for v in values)
        lines += ["", f"[calibrated.{name}]", f"value = [{said}]"]
        lines += [f"interval90 = [{interval}]", f'unit = "{unit}"']
    return "\n".join(lines) + "\n"


SURFACE = {
    "image": 0.0,
    "exp": 0.0,
    "scale": 0.05,
    "inverse": 0.0,
    "offset": 0.01,
}  # of thrust near it
# name -> neutral value of a parameter that is one number per body
NEUTRAL = {
    "torque_gain": 1.0,  # of the reaction torque beside the thrust
    "imu_lever": 0.0,  # 1: the accelerometer sits where the centre of mass should be
    "curve_quadratic": 0.0,
    "curve_root": 0.4,
    "curve_power": 1.0,
    "curve_dip": 0.0,
    "sag_reference": 3.7,  # V
    "sag_power": 0.0,
    "sag_quadratic": 0.0,
    "sag_load": 0.0,
    "limit": 9.0,
    "limit_voltage": 0.0,
    "limit_knee": 0.0,
    "tau_second": 0.0,
    "drag_xy": 0.0,
    "drag_z": 0.0,
    "drag_quadratic": 0.0,
    "drag_rotor": 0.0,
    "drag_height": 0.0,
    "flap_torque": 0.0,
    "flap_tilt": 0.0,
    "flap_advance": 0.0,
    "wind_drag": 0.0,
    "wind_quadratic": 0.0,
    "wind_shear": 0.0,
    "wind_gust": 0.0,
    **{
        f"{side}_{name}": value for side in ("ground", "ceiling") for name, value in SURFACE.items()
    },
    "wake": 0.0,  # N
    "wake_height": 0.3,
    "wake_width": 0.04,
    "wake_spread": 0.1,
    "wake_jet": 0.0,
    "gyro_gain": 1.0,
    "propeller_inertia": 0.0,  # kg m^2
    "link_delay": 0.0,  # ms, of a model that knows a delay of the commands
    "pose_delay": 0.0,  # ms
    "pose_jitter": 0.0,
    "d_filter": 0.0,  # s, of an effect; the firmware's own is `derivative_cut`
    "gyro_cut": 0.0,  # Hz, low-pass of the firmware on the gyroscope; 0: none
    "derivative_cut": 0.0,  # Hz
}


def nominal_parameters(told):
    """Parameters of the bodies described by a list of `Told`, as told. Effects overwrite entries."""
    count = len(told)

    def rows(values):
        return np.repeat(np.asarray(values, float)[:, None], count, axis=1)

    inertia = np.zeros((3, 3, count))
    inertia[np.arange(3), np.arange(3)] = np.array([t.inertia for t in told]).T
    tau = np.array([t.motor_time for t in told])
    return {name: np.full(count, value) for name, value in NEUTRAL.items()} | {
        "mass": np.array([t.mass for t in told]),
        "thrust_constant": np.array([t.thrust_constant for t in told]),
        "torque_ratio": np.array([t.torque_ratio for t in told]),
        "hover": np.array([t.hover for t in told]),
        "inertia": inertia,
        "tau_up": tau.copy(),
        "tau_down": tau.copy(),
        "rotor_gain": np.ones((4, count)),
        # offset, slope, curvature of the thrust in the command
        "curve_map": rows([0.0, 1.0, 0.0]),
        "com": np.zeros((3, count)),
        "wind": np.zeros((3, count)),
        "kp": rows(RATE_KP),
        "ki": rows(RATE_KI),
        "kd": rows(RATE_KD),
    }


def rotate(q, v):
    """Body vector (3, B) to world by quaternions (4, B)."""
    w, x, y, z = q
    vx, vy, vz = v
    tx = 2 * (y * vz - z * vy)
    ty = 2 * (z * vx - x * vz)
    tz = 2 * (x * vy - y * vx)
    return np.stack(
        [
            vx + w * tx + y * tz - z * ty,
            vy + w * ty + z * tx - x * tz,
            vz + w * tz + x * ty - y * tx,
        ]
    )


def rotate_back(q, v):
    """World vector (3, B) to body."""
    return rotate(np.stack([q[0], -q[1], -q[2], -q[3]]), v)


def cross(a, b):
    """Cross product of (3, B) vectors."""
    return np.stack(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


def multiply(a, b):
    """Quaternion product, both (4, B)."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ]
    )


def turn(q, w, dt):
    """Quaternion after turning with body rates w (3, B) for dt, second order and renormalised."""
    h = w * (0.5 * dt)
    out = q + multiply(q, np.concatenate([-0.5 * (h * h).sum(axis=0)[None], h]))
    return out / np.sqrt((out * out).sum(axis=0))


def mix(thrust, output):
    """Firmware mixer: collective thrust (B,) 0..1 and outputs (3, B) in counts to motor commands
    (4, B) in 0..1.
    """
    roll, pitch, yaw = np.minimum(np.maximum(output, -OUTPUT_LIMIT), OUTPUT_LIMIT) / 65536.0
    r = roll / 2
    p = pitch / 2
    m = np.stack(
        [thrust - r - p - yaw, thrust - r + p + yaw, thrust + r + p - yaw, thrust + r - p + yaw]
    )
    return np.minimum(np.maximum(m, 0.0), 1.0)
