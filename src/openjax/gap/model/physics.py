"""Forces and torques along a flight: the simulator's own functions on logged states,
driven by the logged motors.

Nothing is rolled out: at every row the vehicle is where the log says, only the rotor
speeds are simulated, from the motor commands through the motors' lag. So an error stays
where it arises, and one call is a few milliseconds.
"""

from functools import lru_cache, partial

import flax.struct
import jax
import jax.numpy as jnp

from openjax.vehicle import DroneState
from openjax.vehicle.effects import make_context, resolve
from openjax.vehicle.effects.composition import (
    added_wrench,
    change_body,
    change_motor_command,
    change_thrust,
)
from openjax.vehicle.rigid_body import rotate
from openjax.vehicle.rotors import commanded_rotor_speed, rotor_reaction, rotor_thrust, total_wrench


@flax.struct.dataclass
class Path:
    """A track as the physics sees it: T rows, each the state amid its interval.
    float32, padded.
    """

    position: jax.Array  # (T, 3) m
    quaternion: jax.Array  # (T, 4)
    velocity: jax.Array  # (T, 3) m/s
    body_rates: jax.Array  # (T, 3) rad/s
    motor: jax.Array  # (T, TICKS, 4) 0..1 in the row's ticks
    voltage: jax.Array  # (T,) V, NaN where unknown
    others: jax.Array  # (T, M, 3) m
    ceiling: jax.Array  # () m
    dt: jax.Array  # () s


@lru_cache(maxsize=16)
def compiled_physics(names: tuple[str, ...], parameters: tuple[tuple[str, str], ...]):
    """The batched physics with the effects `names`: theta (B, P), and of each its
    vehicle and path (leaves (B, ...)) -> (B, T, 9).

    `parameters` says which (effect, parameter) each entry of theta is; parameters not
    named stay without effect. Beyond them stand the propellers' inertia, each a share
    of the body's about z, and a shift of the motors in time (s, later is positive).
    """
    return jax.jit(jax.vmap(partial(_channels, resolve(names), parameters)))


def _rotors(vehicle, targets_in_ticks, commands, dt, late):
    """Rotor speeds (T, 4) whose square is the row's mean, and their change (T, 4),
    1/s^2, under the motors' lag, `late` s later. `targets_in_ticks` (T, TICKS, 4): the
    speeds that `commands` of the same shape ask for.
    """
    step = dt / targets_in_ticks.shape[1]
    # As `rotor_speed_step`, with what doesn't change outside the loop.
    faster = -jnp.expm1(-step / vehicle.motor_time_constant)
    slower = -jnp.expm1(-step / (vehicle.motor_time_constant * vehicle.motor_slowdown_ratio))

    def row(speed, targets):
        total = 0.0
        start_speed = speed
        for tick in range(len(targets)):
            target = targets[tick]
            next_speed = speed + (target - speed) * jnp.where(target < speed, slower, faster)
            # Mean of the square over a tick, in which the speed is nearly straight.
            total = total + (speed * speed + speed * next_speed + next_speed * next_speed) / 3.0
            speed = next_speed
        return speed, (total / len(targets), (speed - start_speed) / dt)

    start = jnp.sqrt(jnp.clip(commands[0, 0], 1e-6, None)) * vehicle.max_rotor_speed
    _, rotors = jax.lax.scan(row, start, targets_in_ticks)
    square, sped_up = (v - late * jnp.gradient(v, dt, axis=0) for v in rotors)
    speed = jnp.sqrt(jnp.maximum(square, 0.0))
    return speed, sped_up


def _values(effects, parameters, theta) -> dict[str, dict[str, jax.Array]]:
    """{effect: {parameter: ()}}: those of theta (P,), and of the others what does
    nothing.
    """
    values = {}
    for effect in effects:
        absent = effect.none()
        values[effect.name] = {k: jnp.asarray(v, theta.dtype) for k, v in absent.items()}
    for number, (effect, parameter) in enumerate(parameters):
        values[effect] = {**values[effect], parameter: theta[number]}
    return values


def _state(position, quaternion, velocity, rates, speed) -> DroneState:
    """A drone as physics sees it: none looks at the memory of its controller."""
    return DroneState(
        position=position,
        quaternion=quaternion,
        velocity=velocity,
        body_rates=rates,
        rotor_speed=speed,
        rate_integral=rates,
        previous_body_rates=rates,
        effect_memory=(),
    )


def _channels(effects, parameters, theta, vehicle, path: Path):
    """(T, 9) of one track with parameters theta (P,)."""
    values = _values(effects, parameters, theta)
    changed_vehicle = change_body(effects, values, vehicle)
    step = path.dt / path.motor.shape[1]

    def context(position, quaternion, velocity, rates, voltage, others, speed):
        state = _state(position, quaternion, velocity, rates, speed)
        room = {"others_position": others, "ceiling_height": path.ceiling}
        return make_context(changed_vehicle, state, battery_voltage=voltage, dt=step, **room)

    along = (
        path.position,
        path.quaternion,
        path.velocity,
        path.body_rates,
        path.voltage,
        path.others,
    )
    at_rest = jax.vmap(context)(*along, jnp.zeros_like(path.motor[:, 0]))

    def motor_requests(commands, around):
        return jax.vmap(lambda m: change_motor_command(effects, values, m, around))(commands)

    motors = jax.vmap(motor_requests)(path.motor, at_rest)

    speed, sped_up = _rotors(
        changed_vehicle, commanded_rotor_speed(changed_vehicle, motors), motors, path.dt, theta[-1]
    )
    spun_up = theta[-2] * (sped_up @ changed_vehicle.rotor_spin)

    def wrench(position, quaternion, velocity, rates, voltage, others, speed, spun_up):
        around = context(position, quaternion, velocity, rates, voltage, others, speed)
        thrust = rotor_thrust(changed_vehicle, speed)
        reaction = rotor_reaction(changed_vehicle, speed)
        thrust, reaction = change_thrust(effects, values, thrust, reaction, around)
        around = around.replace(thrust=thrust)
        force, torque = total_wrench(changed_vehicle, thrust, reaction)
        more_force, more_torque = added_wrench(effects, values, around)
        force = force + more_force
        torque = torque + more_torque
        angular = (
            torque - jnp.cross(rates, changed_vehicle.inertia * rates)
        ) / changed_vehicle.inertia
        angular = angular.at[2].add(spun_up)  # what speeds a rotor up turns the body
        specific = force / changed_vehicle.mass
        gravity = jnp.array([0.0, 0.0, 1.0], force.dtype) * changed_vehicle.gravity
        return jnp.concatenate([angular, rotate(quaternion, specific) - gravity, specific])

    return jax.vmap(wrench)(*along, speed, spun_up)
