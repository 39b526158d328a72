"""The body-rate PID and the mixer of the Crazyflie firmware (CTBR: collective thrust
and body rates).
"""

import jax.numpy as jnp

from openjax.vehicle.parameters import Vehicle
from openjax.vehicle.shapes import Command, Hubs, Rotors, Seconds, Vector
from openjax.vehicle.state import DroneState

COUNTS = 65536.0  # motor commands are 16-bit in the firmware
_LARGEST_COUNT = 65535.0  # of them
_AXIS_LIMIT = 32767.0  # outputs of the rate controllers are int16
_DEGREES = 57.29577951308232  # in a radian: the firmware counts in degrees


def mixer(vehicle: Vehicle) -> Hubs:
    """(4, 3) share of each motor in roll, pitch and yaw outputs: the sign of the torque
    it exerts, roll and pitch halved as in the firmware's x configuration.
    """
    # thrust to the left (y > 0) rolls to the right, thrust in front (x > 0) pitches the
    # nose up, which is negative about y
    x = vehicle.rotor_position[:, 0]
    y = vehicle.rotor_position[:, 1]
    return jnp.stack([0.5 * jnp.sign(y), -0.5 * jnp.sign(x), vehicle.rotor_spin], axis=-1)


def rate_controller(
    vehicle: Vehicle, state: DroneState, command: Command, dt: Seconds
) -> tuple[Rotors, Vector]:
    """Motor commands (4,) in 0..1 and the new integrals (3,) deg, for one drone.

    command (4,): collective thrust in 0..1 as a share of four times the largest rotor
    thrust, body rates in rad/s. The derivative acts on the measurement, so a step of
    the command does not kick.
    """
    error = (command[1:] - state.body_rates) * _DEGREES
    limit = vehicle.rate_integral_limit
    # limited as on board, so that a vehicle that is held fast doesn't wind it up
    integral = jnp.clip(state.rate_integral + error * dt, -limit, limit)
    slope = (state.body_rates - state.previous_body_rates) * (_DEGREES / dt)
    output = vehicle.rate_kp * error + vehicle.rate_ki * integral - vehicle.rate_kd * slope
    output = jnp.clip(output, -_AXIS_LIMIT, _AXIS_LIMIT)
    counts = COUNTS * command[0] + jnp.sum(mixer(vehicle) * output, axis=-1)
    # each motor is cut by itself, as on board: at full thrust a turn costs thrust
    return jnp.clip(counts, 0.0, _LARGEST_COUNT) / COUNTS, integral
