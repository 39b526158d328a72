"""What flies in the cases of `onboard_cases`: state estimators as small vehicles carry them, and the loops that fly on what
they say.

`Kalman` is the error-state filter of Mueller, Hamer and D'Andrea (ICRA 2015) with the covariance's turn after an
update of Mueller, Hehn and D'Andrea (J. Guidance, Control, and Dynamics 40, 2017): position, velocity in the body frame
and attitude, predicted by accelerometer and gyroscope. `Complementary` leans on the accelerometer as a plumb line (Mahony,
Hamel and Pflimlin, IEEE TAC 2008) and follows positions by constant gains. World z up, quaternions wxyz body to world.
"""

import numpy as np

GRAVITY = np.array([0.0, 0.0, 9.81])
DEGREES = 180.0 / np.pi


def cross_matrix(a):
    return np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])


def matrix_of(q):
    """Rotations (3, 3, ...), body to world, of unit quaternions (4, ...)."""
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def turned(q, angle):
    """Attitude q turned by a rotation vector (3,) rad in the body frame."""
    size = float(np.sqrt(angle @ angle))
    half = np.sinc(size / (2 * np.pi)) * 0.5 * angle
    w, u, c = q[0], q[1:], np.cos(size / 2)
    out = np.empty(4)
    out[0] = w * c - u @ half
    out[1:] = w * half + c * u + np.cross(u, half)
    return out / np.sqrt(out @ out)


def angle_between(q, p):
    """Rotation vector (3,) rad, body frame of q, that turns q into p; exact to second order."""
    w = q @ p
    vector = q[0] * p[1:] - p[0] * q[1:] - np.cross(q[1:], p[1:])
    return 2.0 * vector * (1.0 if w >= 0 else -1.0)


class Kalman:
    """Position (3,) m, body velocity (3,) m/s, attitude (4,), and the covariance (9, 9) of their errors, the attitude's in
    the body frame: the truth is `turned(attitude, error)`."""

    def __init__(self, position, attitude, accel_noise, gyro_noise):
        self.position, self.attitude, self.v = position.copy(), attitude.copy(), np.zeros(3)
        self.p = np.diag([0.01**2] * 3 + [0.02**2] * 3 + [0.02**2] * 3)
        self.accel, self.gyro = accel_noise**2, gyro_noise**2  # (m/s^2)^2/Hz, (rad/s)^2/Hz

    @property
    def velocity(self):
        return matrix_of(self.attitude) @ self.v

    def predict(self, specific, rates, dt):
        r = matrix_of(self.attitude)
        down = r.T @ GRAVITY
        f = np.eye(9)
        f[:3, 3:6] = dt * r
        f[:3, 6:] = -dt * r @ cross_matrix(self.v)
        f[3:6, 3:6] -= dt * cross_matrix(rates)
        f[3:6, 6:] = -dt * cross_matrix(down)
        f[6:, 6:] -= dt * cross_matrix(rates)
        self.position = self.position + dt * (r @ self.v) + 0.5 * dt * dt * (r @ specific - GRAVITY)
        self.v = self.v + dt * (specific - np.cross(rates, self.v) - down)
        self.attitude = turned(self.attitude, dt * rates)
        self.p = f @ self.p @ f.T
        self.p[range(3, 6), range(3, 6)] += dt * self.accel
        self.p[range(6, 9), range(6, 9)] += dt * self.gyro

    def update(self, missed, h, variance):
        """missed (k,): measured less predicted; h (k, 9); variance (k,)."""
        ph = self.p @ h.T
        gain = ph @ np.linalg.inv(h @ ph + np.diag(variance))
        step = gain @ missed
        keep = np.eye(9) - gain @ h
        self.p = keep @ self.p @ keep.T + (gain * variance) @ gain.T
        self.position, self.v = self.position + step[:3], self.v + step[3:6]
        self.attitude = turned(self.attitude, step[6:])
        turn = np.eye(9)
        turn[6:, 6:] -= 0.5 * cross_matrix(step[6:])  # the errors are now in a body frame that was turned
        self.p = turn @ self.p @ turn.T

    def see(self, what, value, deviation, anchor=None):
        """Update by a position (3,), an attitude (4,), a body velocity's x and y, a height or the distance to an anchor."""
        h = np.zeros((1, 9))
        if what == "position":
            h, missed = np.eye(9)[:3], value - self.position
        elif what == "attitude":
            h, missed = np.eye(9)[6:], angle_between(self.attitude, value)
        elif what == "flow":
            h, missed = np.eye(9)[3:5], value - self.v[:2]
        elif what == "height":
            h, missed = np.eye(9)[2:3], np.atleast_1d(value - self.position[2])
        else:
            away = self.position - anchor
            far = np.linalg.norm(away)
            h[0, :3], missed = away / far, np.atleast_1d(value - far)
        self.update(missed, h, np.full(len(missed), deviation**2))


class Complementary:
    """Attitude by the gyroscope, drawn to where the accelerometer says is up; position and velocity by constant gains."""

    def __init__(self, position, attitude, plumb, follow):
        self.position, self.attitude, self.velocity = position.copy(), attitude.copy(), np.zeros(3)
        self.plumb, self.follow = plumb, follow  # 1/s; rad/s, the bandwidth of the position's observer

    def predict(self, specific, rates, dt):
        r = matrix_of(self.attitude)
        up = specific / max(np.linalg.norm(specific), 1e-6)
        lean = np.cross(up, r[2])  # towards what is felt as up
        acceleration = r @ specific - GRAVITY
        self.position = self.position + dt * self.velocity + 0.5 * dt * dt * acceleration
        self.velocity = self.velocity + dt * acceleration
        self.attitude = turned(self.attitude, dt * (rates + self.plumb * lean))

    def see(self, what, value, deviation, anchor=None, since=0.01):
        if what == "position":
            missed = value - self.position
            self.position = self.position + min(1.4 * self.follow * since, 1.0) * missed
            self.velocity = self.velocity + min(self.follow**2 * since, 0.5 / since) * missed
        elif what == "attitude":  # heading alone
            angle = angle_between(self.attitude, value)
            self.attitude = turned(self.attitude, np.array([0.0, 0.0, min(2.0 * since, 1.0) * angle[2]]))


class Firmware:
    """The body-rate loop of the Crazyflie at its published gains, its slope through a low-pass, and the motors' mixer."""

    KP, KI, KD = np.array([250.0, 250, 120]), np.array([500.0, 500, 16.7]), np.array([2.5, 2.5, 0.0])
    LIMIT = np.array([33.3, 33.3, 166.7])  # deg
    MIX = np.array([[-0.5, -0.5, -1], [-0.5, 0.5, 1], [0.5, 0.5, -1], [0.5, -0.5, 1]])

    def __init__(self, slope_time=0.0):
        self.integral, self.before, self.slope, self.slope_time = np.zeros(3), None, np.zeros(3), slope_time

    def __call__(self, thrust, wanted, gyro, dt):
        """Motor commands (4,) in 0..1."""
        error = DEGREES * (wanted - gyro)
        self.integral = np.clip(self.integral + dt * error, -self.LIMIT, self.LIMIT)
        slope = DEGREES * (gyro - (gyro if self.before is None else self.before)) / dt
        self.before = gyro
        self.slope = self.slope + (slope - self.slope) * dt / (dt + self.slope_time)
        out = np.clip(self.KP * error + self.KI * self.integral - self.KD * self.slope, -32767.0, 32767.0)
        return np.clip(thrust + self.MIX @ out / 65536.0, 0.0, 65535.0 / 65536.0)


def follow(goal, position, velocity, attitude, hover, gains):
    """Collective thrust in 0..1 and body rates (3,) rad/s towards a point of RotorPy's trajectories; `gains`: stiffness
    1/s^2, damping 1/s, of tilt and of heading 1/s."""
    stiff, damp, level, heading = gains
    pull = goal["x_ddot"] + stiff * (goal["x"] - position) + damp * (goal["x_dot"] - velocity)
    pull = np.clip(pull, -5.0, 5.0) + GRAVITY
    r = matrix_of(attitude)
    thrust = hover * (pull @ r[:, 2]) / GRAVITY[2]
    lean = r.T @ np.cross(r[:, 2], pull / np.linalg.norm(pull))
    off = np.arctan2(
        np.sin(goal["yaw"]) * r[0, 0] - np.cos(goal["yaw"]) * r[1, 0],
        np.cos(goal["yaw"]) * r[0, 0] + np.sin(goal["yaw"]) * r[1, 0],
    )
    rates = np.array([level * lean[0], level * lean[1], heading * off + goal["yaw_dot"]])
    return float(np.clip(thrust, 0.05, 0.95)), np.clip(rates, -8.0, 8.0)
