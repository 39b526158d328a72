"""The motion of the bodies of N drones under the wrenches on them, in free flight and among solid
things.
"""

import functools
from dataclasses import dataclass

import jax

from openjax.vehicle.arena import Arena
from openjax.vehicle.contacts import contact_acceleration
from openjax.vehicle.mjx_body import make_world, mjx_step
from openjax.vehicle.parameters import Vehicle
from openjax.vehicle.rigid_body import rigid_step
from openjax.vehicle.shapes import Active, Pillars, Team, Vector
from openjax.vehicle.solids import Obstacles, encounters, place_solids, surroundings
from openjax.vehicle.state import DroneState


@dataclass(frozen=True)
class Bodies:
    """The drones of one world over `dt` seconds; what stops drones of "stops" comes
    after the step, they fly freely here.
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
        around: Obstacles | None,
    ) -> DroneState:
        """The drones (leading axis N) after `dt`; the leaves of `vehicle` are those of
        all drones or, with that axis, of each.

        force (N, 3) N in the world without gravity, torque (N, 3) N m in the body
        frame; `around` each drone is what `self.around` says.
        """
        move = self.rigid
        if self.physics == "mjx":
            # a world without contacts holds no shapes, and is the same for any number
            # of them
            solid = around is not None
            pillars = around.pillar_position.shape[1] if solid else 0
            others = around.other_position.shape[1] if solid else 0
            world = make_world(self.arena, pillars, others, self.dt, solid)
            move = functools.partial(self._mjx, world)
        step = jax.vmap(move, (vehicles_axis(vehicle), 0, 0, 0, 0))
        return step(vehicle, drones, force, torque, around)

    def around(
        self, drones: DroneState, pillar_position: Pillars, pillar_active: Active
    ) -> Obstacles | None:
        """The things that each drone (leading axis N) may touch in this step; None if nothing is
        solid.

        pillar_position (P, 2) m, pillar_active (P,): which of them are in use.
        """
        if not self.contacts or self.physics == "stops":
            return None
        return surroundings(drones.position, drones.velocity, pillar_position, pillar_active)

    def rigid(
        self,
        vehicle: Vehicle,
        drone: DroneState,
        force: Vector,
        torque: Vector,
        around: Obstacles | None,
    ) -> DroneState:
        """One drone by the written-out equations, in free flight if nothing is
        `around`.
        """

        def contact(free):
            return contact_acceleration(
                self.arena, drone.position, drone.velocity, free, around, self.dt
            )

        if around is None:
            return rigid_step(vehicle, drone, force, torque, self.dt)
        return rigid_step(vehicle, drone, force, torque, self.dt, contact)

    def _mjx(self, world, vehicle, drone, force, torque, around):
        shapes = None
        if around is not None:
            gaps = encounters(self.arena, drone.position, drone.velocity, around, self.dt)
            shapes = place_solids(gaps)
        return mjx_step(world, vehicle, shapes, drone, force, torque, self.dt)


def vehicles_axis(vehicle: Vehicle) -> int | None:
    """0 where the leaves of `vehicle` are those of each drone, None where all drones
    are alike.
    """
    return 0 if vehicle.mass.ndim else None
