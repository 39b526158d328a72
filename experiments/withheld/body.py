"""The vehicle of the withheld plant: constants, parameters per simulated body, and vector helpers.

Written from the published facts of the vehicle only; nothing is imported from `openjax`, so that a mistake in
one is not repeated in the other. Arrays carry the body index last, (3, B) or (4, B). Frames: world z up, body
x forward, y left, z up, quaternions wxyz body to world.
"""

import numpy as np

MASS = 0.0321  # kg
INERTIA = np.array([1.4e-5, 1.4e-5, 2.17e-5])  # kg m^2
ARM = 0.043 / np.sqrt(2.0)  # m, x-configuration
ROTOR_X = np.array([1.0, -1.0, -1.0, 1.0]) * ARM  # front right, rear right, rear left, front left
ROTOR_Y = np.array([-1.0, -1.0, 1.0, 1.0]) * ARM
SPIN = np.array([-1.0, 1.0, -1.0, 1.0])  # a clockwise rotor pushes the body along +z
THRUST_CONSTANT = 2.350347e-8  # N s^2
TORQUE_RATIO = 7.24e-10 / 2.350347e-8  # m, k_m / k_f
MAX_SPEED = 2315.0  # rad/s
MAX_THRUST = THRUST_CONSTANT * MAX_SPEED**2  # N per rotor, 0.12596
MOTOR_TIME = 0.025  # s
GRAVITY = 9.81
PROPELLER = 0.023  # m, radius
CEILING = 1.2  # m
RATE_KP = np.array([250.0, 250.0, 120.0])  # counts per deg/s
RATE_KI = np.array([500.0, 500.0, 16.7])  # counts per deg
RATE_KD = np.array([2.5, 2.5, 0.0])  # counts per deg/s^2, on the measurement
INTEGRAL_LIMIT = np.array([33.3, 33.3, 166.7])  # deg
OUTPUT_LIMIT = 32767.0


def nominal_parameters(count):
    """Neutral value of every parameter of the plant, for `count` bodies. Effects overwrite entries."""

    def scalar(value):
        return np.full(count, float(value))

    def rows(values):
        return np.repeat(np.asarray(values, float)[:, None], count, axis=1)

    inertia = np.zeros((3, 3, count))
    inertia[np.arange(3), np.arange(3)] = INERTIA[:, None]
    return {
        "mass": scalar(MASS),
        "inertia": inertia,
        "rotor_gain": np.ones((4, count)),
        "torque_ratio": scalar(TORQUE_RATIO),
        "torque_gain": scalar(1.0),
        "com": np.zeros((3, count)),
        "imu_lever": scalar(0.0),
        # thrust map u -> u + curve_2 (u - u_h)(u - u_0) + ..., power, dead zone
        "curve_a": scalar(0),
        "curve_b": scalar(1),
        "curve_c": scalar(0),
        "curve_power": scalar(1),
        "curve_dip": scalar(0),
        # battery: gain (V / V0)^n, quadratic and recovery forms
        "sag_reference": scalar(3.7),
        "sag_power": scalar(0),
        "sag_quadratic": scalar(0),
        "sag_load": scalar(0),
        "limit": scalar(9.0),
        "limit_voltage": scalar(0),
        "limit_knee": scalar(0),
        "tau_up": scalar(MOTOR_TIME),
        "tau_down": scalar(MOTOR_TIME),
        "tau_second": scalar(0),
        "drag_xy": scalar(0),
        "drag_z": scalar(0),
        "drag_quadratic": scalar(0),
        "drag_rotor": scalar(0),
        "drag_height": scalar(0),
        "flap_torque": scalar(0),
        "flap_tilt": scalar(0),
        "flap_advance": scalar(0),
        "wind": np.zeros((3, count)),
        "wind_drag": scalar(0),
        "wind_quadratic": scalar(0),
        "wind_shear": scalar(0),
        "wind_gust": scalar(0),
        "ground_image": scalar(0),
        "ground_exp": scalar(0),
        "ground_scale": scalar(0.05),
        "ground_inverse": scalar(0),
        "ground_offset": scalar(0.01),
        "ceiling_image": scalar(0),
        "ceiling_exp": scalar(0),
        "ceiling_scale": scalar(0.05),
        "ceiling_inverse": scalar(0),
        "ceiling_offset": scalar(0.01),
        "wake": scalar(0),
        "wake_height": scalar(0.3),
        "wake_width": scalar(0.04),
        "wake_spread": scalar(0.1),
        "wake_jet": scalar(0),
        "kp": rows(RATE_KP),
        "ki": rows(RATE_KI),
        "kd": rows(RATE_KD),
        "d_filter": scalar(0),
        "pose_delay": scalar(0),
        "pose_jitter": scalar(0),
    }


def rotate(q, v):
    """Body vector (3, B) to world by quaternions (4, B)."""
    w, x, y, z = q
    vx, vy, vz = v
    tx, ty, tz = 2 * (y * vz - z * vy), 2 * (z * vx - x * vz), 2 * (x * vy - y * vx)
    return np.stack(
        [vx + w * tx + y * tz - z * ty, vy + w * ty + z * tx - x * tz, vz + w * tz + x * ty - y * tx]
    )


def rotate_back(q, v):
    """World vector (3, B) to body."""
    return rotate(np.stack([q[0], -q[1], -q[2], -q[3]]), v)


def cross(a, b):
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


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
    h = 0.5 * dt
    dx, dy, dz = w * h
    out = q + multiply(q, np.stack([-0.5 * (dx * dx + dy * dy + dz * dz), dx, dy, dz]))
    return out / np.sqrt((out * out).sum(axis=0))


def mix(thrust, output):
    """Firmware mixer: collective thrust (B,) 0..1 and outputs (3, B) in counts to motor commands (4, B) in
    0..1.
    """
    roll, pitch, yaw = np.clip(output, -OUTPUT_LIMIT, OUTPUT_LIMIT) / 65536.0
    r, p = roll / 2, pitch / 2
    return np.clip(
        np.stack([thrust - r - p - yaw, thrust - r + p + yaw, thrust + r + p - yaw, thrust + r - p + yaw]),
        0.0,
        1.0,
    )
