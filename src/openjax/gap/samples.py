"""Sample flights: openjax's own vehicle flown through manoeuvres, logged as a laboratory would log them.

Physics at 1 kHz, rate loop at 500 Hz on a noisy gyroscope, off-board commands every 10 ms from a position controller
that knows the nominal vehicle only. Rows every 10 ms: sensors at t, commands issued at t, motors averaged over the
10 ms that begin at t. Sensor noise and biases are those of a Crazyflie's IMU and a motion-capture system, rounded.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from openjax.gap.reading import LogTable
from openjax.vehicle import (
    DroneState,
    Vehicle,
    hover_state,
    max_rotor_thrust,
    rate_controller,
    rigid_step,
    rotate,
    rotate_inverse,
    rotor_speed_step,
    rotor_thrust,
    rotor_wrench,
)

PERIOD = 0.01  # s, rows and off-board commands
RATE_LOOPS = 5  # per row: 500 Hz
SUBSTEPS = 2  # per rate loop: 1 kHz


@dataclass(frozen=True)
class SensorModel:
    """Noise (standard deviation per sample) and constant biases (standard deviation over flights)."""

    gyro_noise: float = 0.02  # rad/s
    gyro_bias: float = 0.01  # rad/s
    accelerometer_noise: float = 0.15  # m/s^2
    accelerometer_bias: float = 0.15  # m/s^2
    position_noise: float = 1e-4  # m
    attitude_noise: float = 1e-3  # rad
    velocity_noise: float = 5e-3  # m/s
    voltage_noise: float = 0.005  # V


@dataclass(frozen=True)
class Reference:
    """What to fly: (T, ...) at the row period. `extra_command` is added to the controller's command."""

    position: np.ndarray  # (T, 3) m
    yaw: np.ndarray  # (T,) rad
    extra_command: np.ndarray  # (T, 4) thrust in 0..1, body rates in rad/s


def references(seed: int = 0, duration: float = 10.0) -> dict[str, Reference]:
    """Three flights that expose a vehicle: waypoints down to 6 cm above the floor, a fast Lissajous figure with turning
    yaw, and doublets on every axis around hover."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, duration, PERIOD)
    zero = np.zeros((len(t), 4))

    corners = rng.uniform([-0.6, -0.6, 0.3], [0.6, 0.6, 1.0], (8, 3))
    corners[[2, 5], 2] = rng.uniform(0.06, 0.12, 2)
    waypoints = Reference(_minimum_jerk(corners, t, 1.4), 0.6 * np.sin(0.9 * t), zero)

    phase = rng.uniform(0, 2 * np.pi, 3)
    speed = np.array([0.4, 0.33, 0.25]) * 2 * np.pi * rng.uniform(0.9, 1.1, 3)
    amplitude = np.array([0.55, 0.55, 0.2])
    start = np.clip(t / 2.0, 0, 1)[:, None] ** 2
    figure = start * amplitude * np.sin(speed * t[:, None] + phase) + [0.0, 0.0, 0.65]
    lissajous = Reference(figure, 0.8 * np.sin(0.7 * t), zero)

    doublets = zero.copy()
    size = np.array([0.12, 4.0, 4.0, 3.0])
    for k, begin in enumerate(np.arange(0.8, duration - 0.6, 0.45)):
        axis, sign = k % 4, 1 if (k // 4) % 2 == 0 else -1
        at = (t >= begin) & (t < begin + 0.16)
        doublets[at, axis] += sign * size[axis] * np.where(t[at] < begin + 0.08, 1.0, -1.0)
    hover = np.tile([0.0, 0.0, 0.7], (len(t), 1))
    return {"flight_a": waypoints, "flight_b": lissajous, "flight_c": Reference(hover, 0.0 * t, doublets)}


def fly(plant: Vehicle, assumed: Vehicle, reference: Reference, seed: int = 0, sensors: SensorModel | None = None):
    """Fly `plant` along `reference` with a controller that assumes `assumed`; the columns of the log, {name: (T,)}."""
    sensors = SensorModel() if sensors is None else sensors
    key = jax.random.key(seed)
    velocity = np.gradient(reference.position, PERIOD, axis=0)
    wanted = (
        jnp.asarray(reference.position, jnp.float32),
        jnp.asarray(velocity, jnp.float32),
        jnp.asarray(np.gradient(velocity, PERIOD, axis=0), jnp.float32),
        jnp.asarray(reference.yaw, jnp.float32),
        jnp.asarray(reference.extra_command, jnp.float32),
    )
    rows = jax.device_get(_fly(plant, assumed, wanted, key, sensors))
    return _log(rows, np.random.default_rng([seed, 1]), sensors)


@partial(jax.jit, static_argnames="sensors")
def _fly(plant: Vehicle, assumed: Vehicle, wanted, key, sensors: SensorModel):
    key, bias_key = jax.random.split(key)
    gyro_bias = sensors.gyro_bias * jax.random.normal(bias_key, (3,))
    state = hover_state(plant, wanted[0][0], velocity=wanted[1][0])
    carry = (state, jnp.zeros(3), jnp.zeros(3), key)

    def row(carry, wanted_row):
        state, integral, force, key = carry
        key, noise_key = jax.random.split(key)
        command, integral = _position_controller(assumed, state, integral, wanted_row)

        def rate_loop(inner, noise):
            state, _ = inner
            gyro = state.body_rates + gyro_bias + sensors.gyro_noise * noise
            motor, rate_integral = rate_controller(
                plant, state.replace(body_rates=gyro), command, PERIOD / RATE_LOOPS
            )
            state = state.replace(rate_integral=rate_integral, previous_body_rates=gyro)
            for _ in range(SUBSTEPS):
                state, force = _physics(plant, state, motor, PERIOD / RATE_LOOPS / SUBSTEPS)
            return (state, force), motor

        noise = jax.random.normal(noise_key, (RATE_LOOPS, 3))
        (after, force_after), motors = jax.lax.scan(rate_loop, (state, force), noise)
        gyro = state.body_rates + gyro_bias
        log = (state.position, state.quaternion, state.velocity, gyro, force / plant.mass, command, motors.mean(0))
        return (after, integral, force_after, key), log

    # The first row's specific force is that of hover.
    carry = (state, carry[1], jnp.array([0.0, 0.0, 1.0]) * plant.mass * plant.gravity, carry[3])
    return jax.lax.scan(row, carry, wanted)[1]


def _physics(vehicle: Vehicle, state: DroneState, motor_command, dt) -> tuple[DroneState, jax.Array]:
    """One physics step; the state, and the force without gravity in the body frame (3,) N."""
    rotor_speed = rotor_speed_step(vehicle, state.rotor_speed, motor_command, dt)
    force, torque = rotor_wrench(vehicle, rotor_thrust(vehicle, rotor_speed), rotor_speed)
    position, quaternion, velocity, body_rates = rigid_step(
        vehicle,
        state.position,
        state.quaternion,
        state.velocity,
        state.body_rates,
        rotate(state.quaternion, force),
        torque,
        dt,
    )
    state = state.replace(
        position=position,
        quaternion=quaternion,
        velocity=velocity,
        body_rates=body_rates,
        rotor_speed=rotor_speed,
    )
    return state, force


def _position_controller(assumed: Vehicle, state: DroneState, integral, wanted):
    """Command (4,) of a position controller: PID to a wanted acceleration, thrust along body z, attitude error to
    body rates. Gains are for a vehicle of this size."""
    position, velocity, acceleration, yaw, extra = wanted
    error = position - state.position
    integral = jnp.clip(integral + error * PERIOD, -0.5, 0.5)
    pull = acceleration + 9.0 * error + 5.0 * (velocity - state.velocity) + 3.0 * integral
    pull = jnp.clip(pull, -6.0, 6.0) + jnp.array([0.0, 0.0, 1.0]) * assumed.gravity
    up = rotate(state.quaternion, jnp.array([0.0, 0.0, 1.0]))
    thrust = assumed.mass * jnp.dot(pull, up) / (4 * max_rotor_thrust(assumed))
    tilt = rotate_inverse(state.quaternion, jnp.cross(up, pull / jnp.linalg.norm(pull)))
    forward = rotate(state.quaternion, jnp.array([1.0, 0.0, 0.0]))
    turn = jnp.arctan2(jnp.sin(yaw) * forward[0] - jnp.cos(yaw) * forward[1],
                       jnp.cos(yaw) * forward[0] + jnp.sin(yaw) * forward[1])  # fmt: skip
    rates = jnp.stack([9.0 * tilt[0], 9.0 * tilt[1], 3.0 * turn])
    command = jnp.concatenate([thrust[None], rates]) + extra
    low = jnp.array([0.05, -jnp.pi * 2, -jnp.pi * 2, -jnp.pi * 2])
    return jnp.clip(command, low, jnp.array([0.95, jnp.pi * 2, jnp.pi * 2, jnp.pi * 2])), integral


def _log(rows, rng: np.random.Generator, sensors: SensorModel) -> dict[str, np.ndarray]:
    """The log's columns: true rows through the sensors."""
    position, quaternion, velocity, gyro, specific_force, command, motors = (np.asarray(r, float) for r in rows)
    count = len(position)
    tilt = sensors.attitude_noise * rng.standard_normal((count, 3))
    measured = {
        "xyz": position + sensors.position_noise * rng.standard_normal((count, 3)),
        "q": _turned(quaternion, tilt),
        "v": velocity + sensors.velocity_noise * rng.standard_normal((count, 3)),
        "w": gyro + sensors.gyro_noise * rng.standard_normal((count, 3)),
        "a": specific_force
        + sensors.accelerometer_bias * rng.standard_normal(3)
        + sensors.accelerometer_noise * rng.standard_normal((count, 3)),
    }
    # A 250 mAh cell from nearly full: falls with charge and load; sampled at 10 Hz.
    load = motors.mean(1)
    voltage = 4.0 - 0.004 * np.arange(count) * PERIOD - 0.35 * load + sensors.voltage_noise * rng.standard_normal(count)
    voltage[np.arange(count) % 10 != 0] = np.nan
    columns = {"t": np.arange(count) * PERIOD}
    columns |= dict(zip(("x", "y", "z"), measured["xyz"].T, strict=True))
    columns |= dict(zip(("qw", "qx", "qy", "qz"), measured["q"].T, strict=True))
    columns |= dict(zip(("vx", "vy", "vz"), measured["v"].T, strict=True))
    columns |= dict(zip(("wx", "wy", "wz"), measured["w"].T, strict=True))
    columns |= dict(zip(("ax", "ay", "az"), measured["a"].T, strict=True))
    columns |= dict(zip(("cmd_thrust", "cmd_wx", "cmd_wy", "cmd_wz"), command.T, strict=True))
    columns |= dict(zip(("m1", "m2", "m3", "m4"), motors.T, strict=True))
    return columns | {"vbat": voltage}


def _turned(quaternion: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Attitudes (T, 4) turned by small body-frame rotations (T, 3) rad."""
    w, u, half = quaternion[:, :1], quaternion[:, 1:], rotation / 2
    turned = np.concatenate([w - (u * half).sum(1, keepdims=True), u + w * half + np.cross(u, half)], 1)
    return turned / np.linalg.norm(turned, axis=1, keepdims=True)


def _minimum_jerk(points: np.ndarray, t: np.ndarray, leg: float) -> np.ndarray:
    """Positions (T, 3) along legs of `leg` seconds between points, at rest at each (10 s^3 - 15 s^4 + 6 s^5)."""
    k = np.minimum((t / leg).astype(int), len(points) - 2)
    s = np.clip(t / leg - k, 0.0, 1.0)[:, None]
    return points[k] + (points[k + 1] - points[k]) * s**3 * (10 - 15 * s + 6 * s**2)


def table_of(columns: dict[str, np.ndarray], name: str, vehicle: str = "0") -> LogTable:
    """One vehicle's columns as a log table."""
    return LogTable(name, columns, np.full(len(columns["t"]), vehicle))
