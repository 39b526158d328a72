"""The nominal vehicle flown along a log: what the firmware did inside each row.

A row of a log holds the mean of the motor commands over 10 ms (or the first of them),
in which the 500 Hz rate loop ran five times: a jump of the command kicks the motors,
and they are back before the next row. The observer runs that loop: the nominal rate
controller on body rates that the logged motors drive and the gyroscope corrects after
every row. It gives the motor command of every tick, which the physics needs, and the
one that the controller would have sent, which shows whether the controller is the
assumed one.
"""

from functools import partial

import jax
import jax.numpy as jnp

from openjax.vehicle import DroneState
from openjax.vehicle.rate_controller import rate_controller
from openjax.vehicle.rotors import rotor_reaction, rotor_speed_step, rotor_thrust, total_wrench

TICKS = 5  # of the rate loop per row
# share of a gyro innovation that corrects the observer, near the optimum for usual
# noise
GYRO_GAIN = 0.3
# share of what single samples of the motors miss that corrects the next ones: their
# noise stays out
FOLLOWED = 0.2


def _ticking(controller, vehicle, h):
    """The tick of `h` s: (rates, previous, integral, speed), command, offset of the
    motors and angular acceleration beyond the nominal -> the same, what the controller
    wanted and what the motors got.
    """
    level = jnp.array([1.0, 0.0, 0.0, 0.0])

    def tick(state, command, offset, push):
        rates, previous, integral, speed = state
        # the rate controller knows neither place nor attitude
        drone = DroneState(
            position=jnp.zeros(3),
            quaternion=level,
            velocity=jnp.zeros(3),
            body_rates=rates,
            rotor_speed=speed,
            rate_integral=integral,
            previous_body_rates=previous,
            effect_memory=(),
        )
        request, integral = rate_controller(controller, drone, command, h)
        command_in_force = jnp.clip(request + offset, 0.0, 1.0)
        speed = rotor_speed_step(vehicle, speed, command_in_force, h)
        thrust = rotor_thrust(vehicle, speed)
        _, torque = total_wrench(vehicle, thrust, rotor_reaction(vehicle, speed))
        gyroscopic = jnp.cross(rates, vehicle.inertia * rates)
        next_rates = rates + h * ((torque - gyroscopic) / vehicle.inertia + push)
        return (next_rates, rates, integral, speed), (request, command_in_force)

    return tick


@partial(jax.jit, static_argnames="at_once")
def observe(controller, vehicle, command, motor, gyro, disturbance, dt, at_once=False):
    """One track: `controller` is the vehicle with its gains; command (T, TICKS, 4),
    motor (T, 4), gyro (T, 3) rad/s, disturbance (T, 3) rad/s^2 of angular acceleration
    beyond the nominal; dt () s per row.

    `at_once`: a row's motor is its first tick's, not the mean.

    Returns the controller's motor command as it would be logged (T, 4), the motor
    commands of the ticks (T, TICKS, 4) that suit the log, and the rates at the end of
    each row as predicted (T, 3).
    """
    tick = _ticking(controller, vehicle, dt / TICKS)

    def ticks(state, command, offset, push):
        return jax.lax.scan(lambda s, c: tick(s, c, offset, push), state, command, unroll=True)

    def row(carry, inputs):
        command, motors, gyro_next, push = inputs
        state, shortfall = carry
        if at_once:
            (rates, previous, *rest), (requests, motor_ticks) = ticks(
                state, command, shortfall, push
            )
            shortfall = shortfall + FOLLOWED * (motors - requests[0] - shortfall)
            requests = requests[0]
        else:
            _, (requests, _) = ticks(state, command, jnp.zeros(4), push)
            requests = requests.mean(0)
            # The second pass follows the motors as logged: the controller's pattern in
            # the row, the log's mean.
            (rates, previous, *rest), (second_requests, motor_ticks) = ticks(
                state, command, motors - requests, push
            )
            requests = second_requests.mean(0)
            # The log's mean, within a motor's limits: what a limit cuts off one tick,
            # the others must have had.
            for _ in range(3):
                motor_ticks = jnp.clip(motor_ticks + (motors - motor_ticks.mean(0)), 0.0, 1.0)
        step = GYRO_GAIN * (gyro_next - rates)
        return ((rates + step, previous + step, *rest), shortfall), (requests, motor_ticks, rates)

    speed = vehicle.max_rotor_speed * jnp.sqrt(jnp.clip(motor[0], 1e-4, 1.0))
    gyro_next = jnp.concatenate([gyro[1:], gyro[-1:]])
    start = (gyro[0], gyro[0], jnp.zeros(3), speed), jnp.zeros(4)
    return jax.lax.scan(row, start, (command, motor, gyro_next, disturbance))[1]


@jax.jit
def respond_to_commands(vehicle, command, dt):
    """Mean motor commands (T, 4) and body rates (T, 3) amid the rows that the body-rate
    commands (T, 4) alone cause: the nominal loop around the nominal vehicle, without
    gyroscope noise and air.
    """
    tick = _ticking(vehicle, vehicle, dt / TICKS)

    def row(carry, command):
        start = carry[0]
        carry, (_, motors) = jax.lax.scan(
            lambda c, _: tick(c, command, 0.0, 0.0), carry, None, length=TICKS
        )
        return carry, (motors.mean(0), 0.5 * (start + carry[0]))

    speed = vehicle.max_rotor_speed * jnp.sqrt(jnp.clip(jnp.full(4, command[0, 0]), 1e-4, 1.0))
    start = (command[0, 1:], command[0, 1:], jnp.zeros(3), speed)
    return jax.lax.scan(row, start, command)[1]
