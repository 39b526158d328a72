"""One drone among solid things, stepped by MuJoCo MJX with the Euler integrator.

Each drone has its own small world: itself as the only moving body, and floor, pillars and other drones as
shapes that are put in place anew in every step. Mapping this world over drones costs far less than one model
that holds them all (its matrices grow with the square of the number of drones), and only true state is
carried between steps.

A shape is placed where it will stand, seen from the drone, at the end of the step if nothing intervened. So a
contact stops a drone at the surface in the step in which it would have passed it, at any speed that it can
reach, where a test of present positions would let it sink in by a step's way first.
"""

from __future__ import annotations

import contextlib
import io
from functools import lru_cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from openjax.vehicle.parameters import Vehicle, assets_directory, read_mjcf
from openjax.vehicle.rigid_body import euler_step

# MJX prints two lines when its optional backend is not installed; it is not used here.
with contextlib.redirect_stdout(io.StringIO()):
    from mujoco import mjx

DRONE_RADIUS = 0.05  # m, the solid sphere of a drone
PILLAR_RADIUS = 0.1  # m
PILLAR_HEIGHT = 1.2  # m, of the cylindrical part, which stands on the floor
_PARKED = -100.0  # m, height of what is not there

# Contacts in MuJoCo's direct form: acceleration along the normal >= -stiffness * gap - damping * speed, `gap`
# being the one at the end of the step. In units of 1/dt^2 and 1/dt. Fixed things: together they cancel the
# approach in one step and close 0.4 of the gap, below the half at which a resting drone would chatter. Other
# drones: each of the pair takes half of the approach, which is an inelastic impact of equal masses that keeps
# their momentum.
_FIXED = (0.4, 0.6)
_DRONE = (0.5, 0.0)
_IMPEDANCE = "0.99 0.99 0.001"


class World(NamedTuple):
    """A one-drone MJX model and its blank data, their arrays on the host."""

    model: mjx.Model
    data: mjx.Data


def world_xml(n_pillars: int, n_others: int, dt: float, contacts: bool = True) -> str:
    """MJCF of one drone (the geoms in order: floor, pillars, other drones, drone); a step lasts dt
    seconds."""
    nominal = read_mjcf(str(assets_directory() / "crazyflie.xml"))
    shapes = ['<geom name="floor" type="plane" size="0 0 1"/>']
    pairs = [("floor", _FIXED)]
    for k in range(n_pillars):
        shapes.append(f'<geom name="pillar_{k}" type="capsule" size="{PILLAR_RADIUS} {PILLAR_HEIGHT / 2}"/>')
        pairs.append((f"pillar_{k}", _FIXED))
    for k in range(n_others):
        shapes.append(f'<geom name="other_{k}" type="sphere" size="{DRONE_RADIUS}"/>')
        pairs.append((f"other_{k}", _DRONE))
    if not contacts:
        shapes, pairs = [], []
    contact = "".join(
        f'<pair geom1="drone" geom2="{name}" condim="1" solimp="{_IMPEDANCE}" '
        f'solref="{-stiffness / dt**2} {-damping / dt}"/>'
        for name, (stiffness, damping) in pairs
    )
    inertia = " ".join(str(value) for value in nominal["inertia"].tolist())
    return f"""<mujoco>
      <option timestep="{dt}" integrator="Euler" solver="CG" iterations="1" ls_iterations="4"
              jacobian="sparse">
        <flag warmstart="disable" filterparent="disable" actuation="disable" sensor="disable"
              equality="disable" limit="disable" frictionloss="disable" eulerdamp="disable" refsafe="disable"
              contact="{"enable" if contacts else "disable"}"/>
      </option>
      <default><geom contype="0" conaffinity="0" mass="0"/></default>
      <worldbody>
        <body><freejoint/><inertial pos="0 0 0" mass="{nominal["mass"]}" diaginertia="{inertia}"/>
          <geom name="drone" type="sphere" size="{DRONE_RADIUS}"/></body>
        {"".join(shapes)}
      </worldbody>
      <contact>{contact}</contact>
    </mujoco>"""


@lru_cache(maxsize=32)
def make_world(n_pillars: int, n_others: int, dt: float, contacts: bool) -> World:
    """The compiled world; numpy arrays, so that it can be closed over by compiled code of any precision."""
    model = mujoco.MjModel.from_xml_string(world_xml(n_pillars, n_others, dt, contacts))
    with jax.ensure_compile_time_eval():
        mjx_model = mjx.put_model(model)
        mjx_data = mjx.make_data(mjx_model)
        return World(*jax.tree.map(np.asarray, (mjx_model, mjx_data)))


def _as_dtype(tree, dtype):
    def convert(leaf):
        return jnp.asarray(leaf, dtype if np.issubdtype(leaf.dtype, np.floating) else None)

    return jax.tree.map(convert, tree)


def others(n: int) -> np.ndarray:
    """(n, n - 1) indices of the other drones, for each of n."""
    return np.array([[j for j in range(n) if j != i] for i in range(n)], int).reshape(n, n - 1)


def end_of_step_shapes(drones, pillar_position, pillar_active, dt) -> jax.Array:
    """Where each drone's shapes stand at the end of the step, seen from the drone: (N, 1 + P + N - 1 + 1, 3)
    m.

    Geoms in the order of `world_xml`; the drone's own geom sits at its body's origin.
    """
    n = drones.position.shape[0]
    dtype = drones.position.dtype
    ahead = drones.velocity * dt
    active = pillar_active.astype(bool)[:, None]
    height = jnp.where(active, PILLAR_HEIGHT / 2, _PARKED).astype(dtype)
    pillars = jnp.concatenate([pillar_position.astype(dtype), height], axis=1)
    floor = jnp.zeros((n, 1, 3), dtype)
    pillars = jnp.broadcast_to(pillars, (n, *pillars.shape))
    neighbours = (drones.position + ahead)[others(n)]
    shapes = jnp.concatenate([floor, pillars, neighbours], axis=1) - ahead[:, None]
    return jnp.concatenate([shapes, jnp.zeros((n, 1, 3), dtype)], axis=1)


def mjx_step(
    world: World,
    vehicle: Vehicle,
    shapes,
    position,
    quaternion,
    velocity,
    body_rates,
    force_world,
    torque_body,
    dt,
):
    """`rigid_step` by MJX among `shapes` (n_geoms, 3) (None: contact-free); dt must be the world's.

    Reverse-mode gradients are promised without contacts only.
    """
    dtype = position.dtype
    model, data = _as_dtype(world, dtype)
    gravity = jnp.zeros(3, dtype).at[2].set(-vehicle.gravity)
    model = model.replace(
        body_mass=jnp.stack([jnp.zeros_like(vehicle.mass), vehicle.mass]),
        body_inertia=jnp.stack([jnp.zeros_like(vehicle.inertia), vehicle.inertia]),
        opt=model.opt.replace(gravity=gravity),
    )
    if shapes is not None:
        model = model.replace(geom_pos=shapes)
    data = data.replace(
        qpos=jnp.concatenate([position, quaternion]),
        qvel=jnp.concatenate([velocity, body_rates]),
        qfrc_applied=jnp.concatenate([force_world, torque_body]),
    )
    data = mjx.forward(model, data)
    qacc = data.qacc
    if shapes is not None:
        # The solver's line search leaves float32 noise of some 1e-3 m/s^2 even where nothing is touched.
        qacc = jnp.where(jnp.any(data.qfrc_constraint != 0), qacc, data.qacc_smooth)
    qacc = qacc.astype(dtype)
    return euler_step(position, quaternion, velocity, body_rates, qacc[:3], qacc[3:], dt)
