"""The vehicles inside virtual Crazyflies: openjax's own, with any of its effects,
advanced between packets.
"""

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from openjax.errors import UserError
from openjax.flying.controller import airframe_of
from openjax.flying.real_time import compile_in_line
from openjax.flying.set_point import ANGLES, OFF
from openjax.vehicle import Vehicle, hover_state, make_drones_step, rotate, rotate_inverse
from openjax.vehicle.effects import composition
from openjax.vehicle.rate_controller import rate_controller
from openjax.virtual_crazyflie.firmware import STEP
from openjax.virtual_crazyflie.tables import Sensors

ANGLE_GAIN = 6.0
"""Body rate asked for per angle error (1/s): proportional part of the firmware's
attitude controller.
"""
CRASH_SPEED = 1.5
"""Touching the floor faster than this (m/s) is a crash."""
CRASH_TILT = 0.5
"""So is touching it with the body's z axis lower than this (cosine of the tilt)."""
_NO_THRUST = -10.0
"""As a thrust set-point: whatever the rate controller adds, all motors stay off."""
FULL_VOLTAGE = 4.15
"""Of a full battery without load (V)."""
SAG = 0.35
"""By how much full thrust takes it down (V)."""
SPENT = 0.9
"""By how much it falls from full to empty (V): empty is about 3.25 V."""


class SensorReadings(NamedTuple):
    """Arrays (N, ...) of what the firmware senses."""

    position: np.ndarray
    velocity: np.ndarray
    quaternion: np.ndarray
    body_rates: np.ndarray
    specific_force: np.ndarray
    motor_command: np.ndarray
    on_floor: np.ndarray
    crashed: np.ndarray


class VirtualVehicles:
    """N vehicles in one air. Each step takes 2 ms.

    Args:
      vehicle: their parameters.
      position: (N, 2) m, where they stand on the floor, level; or (N, 3), where they
      hover.
      effects: {effect: {parameter: value}}; those that delay or lose commands belong to
      the link instead.
      battery: charge at the start, 0..1.
      endurance: s of hover that empty a full battery.

    Raises:
      UserError: an unknown effect, or one that acts on commands.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        position,
        effects: Mapping[str, Mapping[str, float]] | None = None,
        battery: float = 1.0,
        endurance: float = 420.0,
    ):
        self._vehicle = vehicle
        self._parameters = dict(effects or {})
        names = tuple(sorted(self._parameters))
        # without contacts: of solid things there is only the floor, see `_stand`
        self._step = make_drones_step("rigid", dt=STEP, effects=names, contacts=False)
        for effect in self._step.effects:
            if effect.command is not None:
                raise UserError(
                    f"effect {effect.name} acts on commands: set it for the link, by "
                    "--latency_ms or --loss"
                )
        position = np.atleast_2d(np.asarray(position, np.float32))
        self.number, dimensions = position.shape
        flying = dimensions == 3
        drones = hover_state(vehicle, np.pad(position, ((0, 0), (0, 3 - dimensions))))
        # who stands on the floor has its rotors at rest
        drones = drones.replace(rotor_speed=drones.rotor_speed * flying)
        drones = self._step.reset(vehicle, drones, jax.random.key(0))
        gravity = jnp.zeros((self.number, 3)).at[:, 2].set(vehicle.gravity)
        begin = (drones, gravity, jnp.zeros(self.number, bool))
        flat, self._unflatten = ravel_pytree(begin)
        nothing = np.zeros((self.number, 5), np.float32)
        self._advance = compile_in_line(jax.jit(self._program).lower(flat, nothing, np.int32(1)))
        self._charge = float(battery)
        self._endurance = float(endurance)
        self._begin = np.asarray(flat)
        self._hover = airframe_of(vehicle).hover_thrust
        self.reset()

    def reset(self) -> None:
        """As at the beginning."""
        self._state = self._begin
        self.battery = np.full(self.number, self._charge)
        self.report = self.advance(np.zeros((self.number, 5), np.float32), 0)

    def advance(self, set_points: np.ndarray, steps: int) -> SensorReadings:
        """The sensors' readings after `steps` steps under constant set-points (N, 5) float32, see
        `SetPoint`; after none, the motors' commands under new ones.
        """
        self._state, report = self._advance(self._state, set_points, np.int32(steps))
        self.report = SensorReadings._make(np.asarray(leaf, np.float64) for leaf in report)
        share = self.report.motor_command.mean(1) / self._hover
        self.battery = np.maximum(self.battery - steps * STEP * share / self._endurance, 0.0)
        # once for all packets of a moment
        load = SAG * self.report.motor_command.mean(1)
        self._voltage = FULL_VOLTAGE - SPENT * (1.0 - self.battery) - load
        return self.report

    def _program(self, flat, set_points, steps):
        """The flat state after `steps` steps, and what is sensed then."""
        vehicle = self._vehicle
        effects = self._step.effects
        no_pillar = jnp.zeros((1, 2))
        inactive = jnp.zeros(1, bool)
        complete = composition.complete_parameters(effects, self._parameters, jnp.float32)
        plant = composition.change_body(effects, complete, vehicle)

        def step(_, carry):
            drones, _, _, has_crashed = carry
            command = commands(drones.quaternion, set_points)
            new = self._step(vehicle, drones, command, no_pillar, inactive, self._parameters)
            # from what the step did, so that the accelerometer feels every effect
            acceleration = (new.velocity - drones.velocity) / STEP
            new, on_floor, hit = _stand(new)
            gravity = vehicle.gravity * jnp.array([0.0, 0.0, 1.0])
            acceleration = jnp.where(on_floor[:, None], 0.0, acceleration)
            force = jax.vmap(rotate_inverse)(new.quaternion, acceleration + gravity)
            return new, force, on_floor, has_crashed | hit

        carry = (*self._unflatten(flat), jnp.zeros(self.number, bool))
        *state, has_crashed = jax.lax.fori_loop(0, steps, step, carry)
        drones, force, on_floor = state
        # the loop has read the sensors of this moment, and its motors turn by that until
        # the next one
        command = commands(drones.quaternion, set_points)
        motor, _ = jax.vmap(lambda d, c: rate_controller(plant, d, c, STEP))(drones, command)
        report = SensorReadings(
            position=drones.position,
            velocity=drones.velocity,
            quaternion=drones.quaternion,
            body_rates=drones.body_rates,
            specific_force=force,
            motor_command=motor,
            on_floor=on_floor,
            crashed=has_crashed,
        )
        return ravel_pytree(tuple(state))[0], report

    def voltage(self) -> np.ndarray:
        """(N,) V, of the batteries under their loads."""
        return self._voltage

    def sensors(self, i: int) -> Sensors:
        """The sensors' readings of vehicle i."""
        report = self.report
        return Sensors(
            position=report.position[i],
            velocity=report.velocity[i],
            quaternion=report.quaternion[i],
            body_rates=report.body_rates[i],
            specific_force=report.specific_force[i],
            motor_command=report.motor_command[i],
            voltage=self.voltage()[i],
        )


def commands(quaternion, set_points):
    """(N, 4) thrust and body rates (rad/s) for the rate controller from set-points (N,
    5) at attitudes (N, 4).

    Angles are tracked by the proportional attitude loop of the firmware, whose yaw is a
    rate.
    """
    mode, roll, pitch, yaw_rate, thrust = set_points.T
    w, x, y, z = quaternion.T
    roll_error = roll - jnp.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch_error = pitch - jnp.arcsin(jnp.clip(2 * (w * y - z * x), -1.0, 1.0))
    angles = mode == ANGLES
    return jnp.stack(
        [
            jnp.where(mode == OFF, _NO_THRUST, thrust),
            jnp.where(angles, ANGLE_GAIN * roll_error, roll),
            jnp.where(angles, ANGLE_GAIN * pitch_error, pitch),
            yaw_rate,
        ],
        axis=-1,
    )


def _stand(drones):
    """The floor: a vehicle on it stands still and level, and leaves it as soon as it is
    lifted.
    """
    # one that rises already isn't held, however low it is
    below = (drones.position[:, 2] <= 0.0) & (drones.velocity[:, 2] <= 0.0)
    up = jax.vmap(lambda q: rotate(q, jnp.array([0.0, 0.0, 1.0])))(drones.quaternion)[:, 2]
    hit = below & ((drones.velocity[:, 2] < -CRASH_SPEED) | (up < CRASH_TILT))
    w = drones.quaternion[:, 0]
    z = drones.quaternion[:, 3]
    size = jnp.sqrt(w * w + z * z + 1e-12)
    level = jnp.stack([w / size, 0 * w, 0 * w, z / size], axis=-1)

    def keep(standing, free):
        return jnp.where(below[:, None], standing, free)

    rest = jnp.zeros_like(drones.velocity)
    drones = drones.replace(
        position=drones.position.at[:, 2].set(jnp.where(below, 0.0, drones.position[:, 2])),
        velocity=keep(rest, drones.velocity),
        quaternion=keep(level, drones.quaternion),
        body_rates=keep(rest, drones.body_rates),
        rate_integral=keep(rest, drones.rate_integral),
        previous_body_rates=keep(rest, drones.previous_body_rates),
    )
    return drones, below, hit
