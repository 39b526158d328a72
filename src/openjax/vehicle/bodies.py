"""How the bodies of N drones move under the wrenches on them, in free flight and among solid
things.
"""

import functools
from dataclasses import dataclass

import jax

from openjax.vehicle.arena import Arena
from openjax.vehicle.mjx_body import make_world, mjx_step
from openjax.vehicle.parameters import Vehicle
from openjax.vehicle.rigid_body import rigid_step
from openjax.vehicle.shapes import Active, Pillars, Team, Vector
from openjax.vehicle.solids import (
    Surroundings,
    contact_acceleration,
    encounters,
    place_solids,
    surroundings,
)
from openjax.vehicle.state import DroneState


@dataclass(frozen=True)
class Bodies:
    """The drones of one world over `dt` seconds; what stops drones of "stops" comes after the step,
    they fly freely here.
    """

    physics: str
    contacts: bool
    arena: Arena
    dt: float

    def __call__(
        self,
        vehicle: Vehicle,
        drones: DroneState,
        force: Team,
        torque: Team,
        pillars: tuple[Pillars, Active],
    ) -> DroneState:
        """The drones (leading axis N) after `dt`; the leaves of `vehicle` are those of all drones
        or, with that axis, of each.

        force (N, 3) N in the world without gravity, torque (N, 3) N m in the body frame, pillars'
        positions (P, 2) m and which of them are in use (P,).
        """
        solid = self.contacts and self.physics != "stops"
        around = surroundings(drones.position, drones.velocity, *pillars) if solid else None
        move = self.rigid
        if self.physics == "mjx":
            sizes = (pillars[0].shape[0], drones.position.shape[0] - 1) if solid else (0, 0)
            move = functools.partial(self._mjx, make_world(self.arena, *sizes, self.dt, solid))
        return jax.vmap(move, (vehicles_axis(vehicle), 0, 0, 0, 0))(
            vehicle, drones, force, torque, around
        )

    def rigid(
        self,
        vehicle: Vehicle,
        drone: DroneState,
        force: Vector,
        torque: Vector,
        around: Surroundings | None,
    ) -> DroneState:
        """One drone by the written-out equations, in free flight if nothing is `around`."""

        def contact(free):
            return contact_acceleration(
                self.arena, drone.position, drone.velocity, free, around, self.dt
            )

        return rigid_step(
            vehicle, drone, force, torque, self.dt, None if around is None else contact
        )

    def _mjx(self, world, vehicle, drone, force, torque, around):
        shapes = None
        if around is not None:
            shapes = place_solids(
                encounters(self.arena, drone.position, drone.velocity, around, self.dt)
            )
        return mjx_step(world, vehicle, shapes, drone, force, torque, self.dt)


def vehicles_axis(vehicle: Vehicle) -> int | None:
    """0 where the leaves of `vehicle` are those of each drone, None where all drones are alike."""
    return 0 if vehicle.mass.ndim else None
