"""The body of one drone among solid things, its accelerations found by MuJoCo MJX.

Each drone has its own small world: itself as the only moving body, and floor, pillars
and other drones as shapes that are put in place anew in every step. Mapping this world
over drones costs far less than one model that holds them all (its matrices grow with
the square of the number of drones), and only true state is carried between steps.
"""

from __future__ import annotations

import contextlib
import importlib
import io
from concurrent.futures import ThreadPoolExecutor
from functools import cache, lru_cache
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from openjax.vehicle.arena import Arena
from openjax.vehicle.mjcf import read_mjcf
from openjax.vehicle.parameters import NOMINAL, Vehicle, find_mjcf
from openjax.vehicle.rigid_body import euler_step
from openjax.vehicle.shapes import Seconds, Things, Vector
from openjax.vehicle.solids import DRONE_RADIUS, solids_xml
from openjax.vehicle.state import DroneState

if TYPE_CHECKING:
    from mujoco import mjx


@cache
def _mjx():
    """The module `mujoco.mjx`, loaded when it is first needed: the other physics does
    without it.

    It prints two lines when its optional backend is not installed, which is not used
    here.
    """
    with contextlib.redirect_stdout(io.StringIO()):
        return importlib.import_module("mujoco.mjx")


class World(NamedTuple):
    """A one-drone MJX model and its blank data, their arrays on the host."""

    model: mjx.Model
    data: mjx.Data


def world_xml(arena: Arena, n_pillars: int, n_others: int, dt: float, contacts: bool = True) -> str:
    """MJCF of one drone; a step lasts dt seconds. The drone's geom comes after those of
    `solids_xml`.

    One Newton iteration finds the contact forces for the things that are hit, without a
    loop.
    """
    # whoever flies brings its own mass and inertia along; see `mjx_step`
    nominal = read_mjcf(str(find_mjcf(NOMINAL)))
    shapes, pairs = solids_xml(arena, n_pillars, n_others, dt) if contacts else ("", "")
    inertia = " ".join(str(value) for value in nominal["inertia"].tolist())
    return f"""<mujoco>
      <option timestep="{dt}" integrator="Euler" solver="Newton" iterations="1" ls_iterations="1"
              jacobian="sparse">
        <flag warmstart="disable" filterparent="disable" actuation="disable" sensor="disable"
              equality="disable" limit="disable" frictionloss="disable" eulerdamp="disable"
              refsafe="disable" contact="{"enable" if contacts else "disable"}"/>
      </option>
      <default><geom contype="0" conaffinity="0" mass="0"/></default>
      <worldbody>
        <body><freejoint/><inertial pos="0 0 0" mass="{nominal["mass"]}" diaginertia="{inertia}"/>
          <geom name="drone" type="sphere" size="{DRONE_RADIUS}"/></body>
        {shapes}
      </worldbody>
      <contact>{pairs}</contact>
    </mujoco>"""


@lru_cache(maxsize=32)
def make_world(arena: Arena, n_pillars: int, n_others: int, dt: float, contacts: bool) -> World:
    """The compiled world; numpy arrays, so that it can be closed over by compiled code
    of any precision.
    """
    model = mujoco.MjModel.from_xml_string(world_xml(arena, n_pillars, n_others, dt, contacts))
    device = jax.local_devices()[0]  # of several processes each builds its own

    def build():
        mjx_model = _mjx().put_model(model, device, impl="jax")
        mjx_data = _mjx().make_data(mjx_model, device)
        return jax.tree.map(np.asarray, World(mjx_model, mjx_data))

    # A thread of its own knows nothing of the caller's trace or mesh, which may span
    # other processes' devices.
    with ThreadPoolExecutor(max_workers=1) as pool:
        return pool.submit(build).result()


def _as_dtype(tree, dtype):
    def convert(leaf):
        # indices and flags keep their types
        kind = dtype if np.issubdtype(leaf.dtype, np.floating) else leaf.dtype
        # empty arrays are made here: closed over by a shard_map, they crash the
        # compiler of JAX 0.11
        return jnp.asarray(leaf, kind) if leaf.size else jnp.zeros(leaf.shape, kind)

    return jax.tree.map(convert, tree)


def _forward(model, data, contacts: bool):
    """MJX's forward dynamics without what this world has none of: tendons, actuators,
    sensors, cameras.

    The barrier keeps XLA from computing each collision once per entry of the contacts'
    Jacobian.
    """
    mjx = _mjx()
    for stage in (mjx.kinematics, mjx.com_pos, mjx.crb, mjx.factor_m, mjx.collision):
        data = stage(model, data)
    data = jax.lax.optimization_barrier(data)
    data = mjx.fwd_velocity(model, mjx.make_constraint(model, data))
    data = mjx.fwd_acceleration(model, data)
    return mjx.solve(model, data) if contacts else data


def mjx_step(
    world: World,
    vehicle: Vehicle,
    shapes: Things | None,
    drone: DroneState,
    force_world: Vector,
    torque_body: Vector,
    dt: Seconds,
) -> DroneState:
    """`rigid_step` by MJX among `shapes` of `place_solids`, (n, 3) m (None:
    contact-free); dt must be the world's.

    MJX gives the accelerations; velocities and positions are advanced as its Euler
    integrator does it. Gradients are those of free flight: what contacts add is a
    constant to them.
    """
    dtype = drone.position.dtype
    model, data = _as_dtype(world, dtype)
    gravity = jnp.zeros(3, dtype).at[2].set(-vehicle.gravity)
    model = model.replace(
        body_mass=jnp.stack([jnp.zeros_like(vehicle.mass), vehicle.mass]),
        body_inertia=jnp.stack([jnp.zeros_like(vehicle.inertia), vehicle.inertia]),
        # by which MuJoCo scales the contacts
        body_invweight0=model.body_invweight0.at[1, 0].set(1.0 / vehicle.mass),
        opt=model.opt.replace(gravity=gravity),
    )
    if shapes is not None:
        model = model.replace(geom_pos=jnp.concatenate([shapes, jnp.zeros((1, 3), dtype)]))
    data = data.replace(
        qpos=jnp.concatenate([drone.position, drone.quaternion]),
        qvel=jnp.concatenate([drone.velocity, drone.body_rates]),
        qfrc_applied=jnp.concatenate([force_world, torque_body]),
    )
    data = _forward(model, data, shapes is not None)
    qacc = data.qacc_smooth
    if shapes is not None:
        # The solver's line search leaves float32 noise of some 1e-3 m/s^2 even where
        # nothing is touched.
        contact = jnp.where(jnp.any(data.qfrc_constraint != 0), data.qacc - data.qacc_smooth, 0.0)
        qacc = qacc + jax.lax.stop_gradient(contact)
    qacc = qacc.astype(dtype)
    return euler_step(drone, qacc[:3], qacc[3:], dt)
