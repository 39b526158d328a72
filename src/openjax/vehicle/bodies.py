"""How the bodies of N drones move under the wrenches on them: `rigid` and `mjx`, in free flight and among solid things.

Each takes (vehicle, drones, force, torque, pillars) to the drones a substep later: force (N, 3) N in the world without
gravity, torque (N, 3) N m in the body frame, pillars position (P, 2) m and active (P,) bool. The leaves of `vehicle` are
those of all drones or, with a leading axis N, of each.
"""

import functools
from collections.abc import Callable

import jax

from openjax.vehicle.arena import Arena
from openjax.vehicle.mjx_body import make_world, mjx_step
from openjax.vehicle.parameters import Vehicle
from openjax.vehicle.rigid_body import rigid_step
from openjax.vehicle.shapes import Seconds, Vector
from openjax.vehicle.solids import Surroundings, contact_acceleration, encounters, place_solids, surroundings
from openjax.vehicle.state import DroneState

Body = Callable[[Vehicle, DroneState, jax.Array, jax.Array, tuple[jax.Array, jax.Array]], DroneState]


def make_body(physics: str, contacts: bool, arena: Arena, dt: float) -> Body:
    """The body of a `physics` for substeps of dt seconds; "stops" flies freely, what stops it comes after the step."""
    chosen = {
        ("rigid", True): _rigid_among_solids,
        ("rigid", False): _rigid,
        ("stops", True): _rigid,
        ("stops", False): _rigid,
        ("mjx", True): _mjx_among_solids,
        ("mjx", False): _mjx,
    }[physics, contacts]
    return functools.partial(chosen, arena, dt)


def rigid_drone(
    arena: Arena,
    dt: Seconds,
    vehicle: Vehicle,
    drone: DroneState,
    force: Vector,
    torque: Vector,
    around: Surroundings | None,
) -> DroneState:
    """One drone by the written-out equations after dt seconds, in free flight if nothing is `around`."""

    def contact(free):
        return contact_acceleration(arena, drone.position, drone.velocity, free, around, dt)

    moved = rigid_step(vehicle, *_of(drone), force, torque, dt, None if around is None else contact)
    return _with(drone, moved)


def vehicles_axis(vehicle: Vehicle) -> int | None:
    """0 where the leaves of `vehicle` are those of each drone, None where all drones are alike."""
    return 0 if vehicle.mass.ndim else None


def _rigid(arena, dt, vehicle, drones, force, torque, pillars):
    move = functools.partial(rigid_drone, arena, dt)
    return jax.vmap(move, (vehicles_axis(vehicle), 0, 0, 0, None))(vehicle, drones, force, torque, None)


def _rigid_among_solids(arena, dt, vehicle, drones, force, torque, pillars):
    around = surroundings(drones.position, drones.velocity, *pillars)
    move = functools.partial(rigid_drone, arena, dt)
    return jax.vmap(move, (vehicles_axis(vehicle), 0, 0, 0, 0))(vehicle, drones, force, torque, around)


def _mjx(arena, dt, vehicle, drones, force, torque, pillars):
    return _by_mjx(make_world(arena, 0, 0, dt, False), dt, vehicle, drones, force, torque, None)


def _mjx_among_solids(arena, dt, vehicle, drones, force, torque, pillars):
    around = surroundings(drones.position, drones.velocity, *pillars)
    met = jax.vmap(functools.partial(encounters, arena, dt=dt))(drones.position, drones.velocity, around)
    world = make_world(arena, pillars[0].shape[0], drones.position.shape[0] - 1, dt, True)
    return _by_mjx(world, dt, vehicle, drones, force, torque, jax.vmap(place_solids)(met))


def _by_mjx(world, dt, vehicle, drones, force, torque, shapes):
    axes = (vehicles_axis(vehicle), None if shapes is None else 0, *[0] * 6)
    move = jax.vmap(functools.partial(mjx_step, world, dt=dt), axes)
    return _with(drones, move(vehicle, shapes, *_of(drones), force, torque))


def _of(drone):
    return drone.position, drone.quaternion, drone.velocity, drone.body_rates


def _with(drone, body):
    """`drone` with the position, quaternion, velocity and body rates of `body`."""
    position, quaternion, velocity, body_rates = body
    return drone.replace(position=position, quaternion=quaternion, velocity=velocity, body_rates=body_rates)
