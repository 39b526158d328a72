"""Sample flights: openjax's own vehicle flown through manoeuvres, logged as a
laboratory would log them.

Physics at 1 kHz, rate loop at 500 Hz on a noisy gyroscope, off-board commands every 10
ms from a position controller that knows the nominal vehicle only. Rows every 10 ms:
sensors at t, commands issued at t, motors averaged over the 10 ms that begin at t.
Noise and biases are of the size of a Crazyflie's IMU and a motion-capture system.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Shaped

from openjax.flights.manoeuvres import PERIOD, Reference
from openjax.flights.reading import LogTable
from openjax.vehicle import (
    DroneState,
    Vehicle,
    hover_state,
    max_rotor_thrust,
    rigid_step,
    rotate,
    rotate_inverse,
    rotor_speed_step,
)
from openjax.vehicle.effects import composition, make_context
from openjax.vehicle.rate_controller import rate_controller
from openjax.vehicle.solids import others

RATE_LOOPS = 5  # per row: 500 Hz
SUBSTEPS = 2  # per rate loop: 1 kHz


@dataclass(frozen=True)
class SensorModel:
    """Noise (standard deviation per sample) and constant biases (standard deviation
    over flights).
    """

    gyro_noise: float = 0.02  # rad/s
    gyro_bias: float = 0.01  # rad/s
    accelerometer_noise: float = 0.15  # m/s^2
    accelerometer_bias: float = 0.15  # m/s^2
    position_noise: float = 1e-4  # m
    attitude_noise: float = 1e-3  # rad
    velocity_noise: float = 5e-3  # m/s
    voltage_noise: float = 0.005  # V


@dataclass(frozen=True)
class Turbulence:
    """Forces and torques of uneven air, root mean squares per axis, each forgotten
    within a time. The usual ones are those of a quiet hall.
    """

    force: float = 7e-4  # N
    force_time: float = 0.35  # s
    torque: float = 1e-5  # N m
    torque_time: float = 0.08  # s

    def draw(self, rng: np.random.Generator, rows: int, count: int) -> np.ndarray:
        """(T, N, 6) force in the world's axes and torque in the body's."""
        sizes = np.repeat([self.force, self.torque], 3)
        times = np.repeat([self.force_time, self.torque_time], 3)
        decay = np.exp(-PERIOD / times)
        white = rng.standard_normal((rows, count, 6))
        out = np.empty_like(white)
        out[0] = white[0]
        for row in range(1, rows):
            out[row] = decay * out[row - 1] + np.sqrt(1.0 - decay**2) * white[row]
        return sizes * out


def fly(
    plant: Vehicle,
    model: Vehicle,
    reference: Reference,
    seed: int = 0,
    effects: Mapping[str, Mapping[str, float]] | None = None,
    sensors: SensorModel | None = None,
    air: Turbulence | None = None,
) -> list[dict[str, Shaped[np.ndarray, " rows"]]]:
    """Fly `plant` with `effects` ({name: {parameter: value}}) along `reference`, under
    a controller that assumes the vehicle `model`, in still air or turbulent `air`.
    Returns the columns of the log for each vehicle, {name: (T,)}.
    """
    sensors = SensorModel() if sensors is None else sensors
    names = tuple(sorted(effects or {}))
    parameters = composition.complete_parameters(composition.resolve(names), effects, jnp.float32)
    velocity = np.gradient(reference.position, PERIOD, axis=0)
    acceleration = np.gradient(velocity, PERIOD, axis=0)
    targets = (reference.position, velocity, acceleration, reference.yaw, reference.extra_command)
    targets = tuple(jnp.asarray(w, jnp.float32) for w in targets)
    start = jnp.float32(reference.open_circuit_voltage)
    length, count = reference.position.shape[:2]
    # generators of their own: the same flight in other air, or with other sensors
    gusts = None
    if air is not None:
        gusts_drawn = air.draw(np.random.default_rng([seed, 2]), length, count)
        gusts = jnp.asarray(gusts_drawn, jnp.float32)
    key = jax.random.key(seed)
    record = _fly(plant, model, targets, start, parameters, key, gusts, names, sensors)
    rows = jax.device_get(record)
    rng = np.random.default_rng([seed, 1])
    return [_columns([r[:, n] for r in rows], rng, sensors) for n in range(count)]


def log_of(columns: list[dict[str, Shaped[np.ndarray, "..."]]], name: str) -> LogTable:
    """The vehicles' columns as one log in the long format, sorted by time; vehicles are
    "0", "1", ...
    """
    time = np.concatenate([c["t"] for c in columns])
    # stable: rows of one moment stay in the vehicles' order
    order = np.argsort(time, kind="stable")
    table = {n: np.concatenate([c[n] for c in columns])[order] for n in columns[0]}
    vehicle = np.concatenate([np.full(len(c["t"]), str(i)) for i, c in enumerate(columns)])[order]
    return LogTable(name, table, vehicle)


@partial(jax.jit, static_argnames=("names", "sensors"))
def _fly(
    plant: Vehicle,
    model: Vehicle,
    target,
    voltage,
    parameters,
    key,
    gusts,
    names,
    sensors: SensorModel,
):
    effects = composition.resolve(names)
    count = target[0].shape[1]
    vehicle = composition.change_body(effects, parameters, plant)
    key, bias_key, memory_key = jax.random.split(key, 3)
    gyro_bias = sensors.gyro_bias * jax.random.normal(bias_key, (count, 3))
    drones = hover_state(plant, target[0][0], velocity=target[1][0])
    memory = jax.vmap(lambda d, k: composition.initial_memory(effects, plant, d, PERIOD, k))(
        drones, jax.random.split(memory_key, count)
    )
    drones = drones.replace(effect_memory=memory)

    def contexts(drones, load, air_time, dt):
        """Of every drone. The cell gives less with charge (0.02 V/s is a short, hard
        flight) and with load.
        """
        under_load = voltage - 0.004 * air_time - 0.5 * load

        def build(d, neighbours, v):
            return make_context(
                vehicle, d, others_position=neighbours, battery_voltage=v, air_time=air_time, dt=dt
            )

        return jax.vmap(build)(drones, drones.position[others(count)], under_load), under_load

    def row(carry, inputs):
        drones, integral, force, load, key = carry
        wanted_row, air_time, gust = inputs
        key, noise_key = jax.random.split(key)
        measured_state = jax.vmap(partial(composition.seen_state, effects, parameters))(drones)
        command_sent, integral = jax.vmap(_position_controller, (None, 0, 0, 0))(
            model, measured_state, integral, wanted_row
        )
        context, under_load = contexts(drones, load, air_time, PERIOD)
        change = partial(composition.change_command, effects, parameters)
        command, memory = jax.vmap(change)(drones.effect_memory, command_sent, context)
        drones = drones.replace(effect_memory=memory)

        def rate_loop(inner, noise):
            drones, _ = inner
            gyro = drones.body_rates + gyro_bias + sensors.gyro_noise * noise

            def control(d, g, c):
                return rate_controller(vehicle, d.replace(body_rates=g), c, PERIOD / RATE_LOOPS)

            motor, rate_integral = jax.vmap(control)(drones, gyro, command)
            drones = drones.replace(rate_integral=rate_integral, previous_body_rates=gyro)
            for _ in range(SUBSTEPS):
                context, _ = contexts(drones, load, air_time, PERIOD / RATE_LOOPS / SUBSTEPS)
                drones, force = jax.vmap(partial(_physics, vehicle, effects, parameters))(
                    drones, motor, context, gust
                )
            return (drones, force), motor

        noise = jax.random.normal(noise_key, (RATE_LOOPS, count, 3))
        (state_after, force_after), motors = jax.lax.scan(rate_loop, (drones, force), noise)
        motors = motors.mean(0)
        memory = jax.vmap(lambda d: composition.record(effects, d.effect_memory, d, PERIOD))(
            state_after
        )
        state_after = state_after.replace(effect_memory=memory)
        # What motion capture and estimator deliver is what the controller sees; the IMU
        # knows the moment itself.
        pose = (measured_state.position, measured_state.quaternion, measured_state.velocity)
        log = (
            *pose,
            drones.body_rates + gyro_bias,
            force / vehicle.mass,
            command_sent,
            motors,
            under_load,
        )
        return (state_after, integral, force_after, motors.mean(-1), key), log

    # before the first step accelerometers feel what a hover takes
    hover = jnp.zeros((count, 3)).at[:, 2].set(vehicle.mass * vehicle.gravity)
    load = jnp.full(count, 0.6)
    air_time = jnp.arange(target[0].shape[0], dtype=jnp.float32) * PERIOD
    start = (drones, jnp.zeros((count, 3)), hover, load, key)
    return jax.lax.scan(row, start, (target, air_time, gusts))[1]


def _physics(vehicle, effects, parameters, drone: DroneState, motor_command, context, gust):
    """One physics step of one drone; its state, and the force without gravity in the body frame
    (3,) N. `gust` (6,): force in the world's axes and torque of turbulent air, or None.
    """
    motor_command = composition.change_motor_command(effects, parameters, motor_command, context)
    speed = rotor_speed_step(vehicle, drone.rotor_speed, motor_command, context.dt)
    force, torque = composition.wrench(effects, parameters, vehicle, speed, context)
    if gust is not None:
        force = force + rotate_inverse(drone.quaternion, gust[:3])
        torque = torque + gust[3:]
    drone = rigid_step(vehicle, drone, rotate(drone.quaternion, force), torque, context.dt)
    return drone.replace(rotor_speed=speed), force


def _position_controller(model: Vehicle, state: DroneState, integral, target):
    """Command (4,) of a position controller and its integral (3,) m s: PID to a wanted
    acceleration, thrust along body z, attitude error to body rates. Gains are for a
    vehicle of this size.
    """
    position, velocity, acceleration, yaw, extra = target
    error = position - state.position
    integral = jnp.clip(integral + error * PERIOD, -0.5, 0.5)
    pull = acceleration + 9.0 * error + 5.0 * (velocity - state.velocity) + 5.0 * integral
    pull = jnp.clip(pull, -6.0, 6.0) + jnp.array([0.0, 0.0, 1.0]) * model.gravity
    up = rotate(state.quaternion, jnp.array([0.0, 0.0, 1.0]))
    thrust = model.mass * jnp.dot(pull, up) / (4 * max_rotor_thrust(model))
    tilt = rotate_inverse(state.quaternion, jnp.cross(up, pull / jnp.linalg.norm(pull)))
    forward = rotate(state.quaternion, jnp.array([1.0, 0.0, 0.0]))
    across = jnp.sin(yaw) * forward[0] - jnp.cos(yaw) * forward[1]
    along = jnp.cos(yaw) * forward[0] + jnp.sin(yaw) * forward[1]
    rates = jnp.stack([9.0 * tilt[0], 9.0 * tilt[1], 3.0 * jnp.arctan2(across, along)])
    command = jnp.concatenate([thrust[None], rates]) + extra
    limit = jnp.array([0.95, 2 * jnp.pi, 2 * jnp.pi, 2 * jnp.pi])
    return jnp.clip(command, limit * jnp.array([0.05, -1, -1, -1]), limit), integral


def _columns(rows, rng: np.random.Generator, sensors: SensorModel) -> dict[str, np.ndarray]:
    """The log's columns of one vehicle: true rows through the sensors."""
    position, quaternion, velocity, gyro, specific_force, command, motors, voltage = (
        np.asarray(r, float) for r in rows
    )
    count = len(position)

    def noisy(values, size):
        return values + size * rng.standard_normal(values.shape)

    specific_force = specific_force + sensors.accelerometer_bias * rng.standard_normal(3)

    def shaken(attitudes):
        return _turn(attitudes, noisy(np.zeros((count, 3)), sensors.attitude_noise))

    groups = {
        ("x", "y", "z"): noisy(position, sensors.position_noise),
        ("qw", "qx", "qy", "qz"): shaken(quaternion),
        ("vx", "vy", "vz"): noisy(velocity, sensors.velocity_noise),
        ("wx", "wy", "wz"): noisy(gyro, sensors.gyro_noise),
        ("ax", "ay", "az"): noisy(specific_force, sensors.accelerometer_noise),
        ("cmd_thrust", "cmd_wx", "cmd_wy", "cmd_wz"): command,
        ("m1", "m2", "m3", "m4"): motors,
    }
    columns = {"t": np.arange(count) * PERIOD}
    for names, values in groups.items():
        columns |= dict(zip(names, values.T, strict=True))
    # a battery is logged at 10 Hz
    every_tenth = np.arange(count) % 10 == 0
    return columns | {"vbat": np.where(every_tenth, noisy(voltage, sensors.voltage_noise), np.nan)}


def _turn(quaternion: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Attitudes (T, 4) turned by small body-frame rotations (T, 3) rad."""
    w = quaternion[:, :1]
    u = quaternion[:, 1:]
    half = rotation / 2
    scalar = w - (u * half).sum(1, keepdims=True)
    product = np.concatenate([scalar, u + w * half + np.cross(u, half)], 1)
    return product / np.linalg.norm(product, axis=1, keepdims=True)
