"""Drones under body-rate control: crazyflow's step and ours, from the same kind of state, for the same step size."""

import functools
from collections.abc import Iterator

import jax
import jax.numpy as jnp

from experiments.compare.case import Case
from openjax.pursuit import PursuitSettings, hover_action, uniform_task
from openjax.pursuit.environment import action_to_command
from openjax.vehicle import hover_state, load_vehicle, make_drones_step

# crazyflow's default frequency, that of the Crazyflie's own rate loop. All compared run one controller step and one
# step of semi-implicit Euler in each of it.
FREQUENCY = 500
BODY_RATE = 0.1  # rad/s, commanded about all axes while hovering
GRAVITY = 9.81
# Drone steps per call of MJX: what takes about half a second on an H200.
MJX_DRONE_STEPS = 30_000_000

VARIANTS = ("rigid free", "rigid", "mjx free", "mjx")
"""Ours; in those that aren't free, floor, pillars and other drones are solid."""


def cases(worlds: tuple[int, ...], drones: tuple[int, ...], steps: int) -> Iterator[Case]:
    """Every size with crazyflow's body-rate control, `rigid` without and with contacts, and `mjx`."""
    for num_drones in drones:
        for num_worlds in worlds:
            yield _crazyflow("body_rate", num_worlds, num_drones, steps)
            yield _openjax("rigid free", num_worlds, num_drones, steps)
            yield _openjax("rigid", num_worlds, num_drones, steps)
            yield _openjax("mjx", num_worlds, num_drones, steps)


def beside(worlds: int, drones: tuple[int, ...], steps: int) -> Iterator[Case]:
    """crazyflow's default (attitude) control, and MJX with nothing solid, as crazyflow's drones are."""
    for num_drones in drones:
        yield _crazyflow("attitude", worlds, num_drones, steps)
        yield _openjax("mjx free", worlds, num_drones, steps)


def _crazyflow(control, worlds, drones, steps):
    make = functools.partial(make_crazyflow, control, worlds, drones, steps)
    return Case("drones", "crazyflow", control, worlds, drones, steps, make)


def _openjax(variant, worlds, drones, steps):
    if variant.startswith("mjx"):
        steps = max(5, min(steps, MJX_DRONE_STEPS // (worlds * drones)))
    make = functools.partial(make_openjax, variant, worlds, drones, steps)
    return Case("drones", "openjax", variant, worlds, drones, steps, make)


def make_crazyflow(control: str, worlds: int, drones: int, steps: int):
    """crazyflow's own compiled step of `steps` steps, hovering drones with a constant command."""
    from crazyflow import Control, Dynamics, Sim
    from crazyflow.sim.integration import Integrator

    sim = Sim(
        n_worlds=worlds,
        n_drones=drones,
        dynamics=Dynamics.first_principles,
        control=Control(control),
        integrator=Integrator.symplectic_euler,
        freq=FREQUENCY,
        attitude_freq=FREQUENCY,
        body_rate_freq=FREQUENCY,
        force_torque_freq=FREQUENCY,
        device=jax.default_backend(),
        fused_mjx_model=True,
    )
    sim.mjx_data = (
        None  # for drawing and contact queries, unused by the step; gigabytes with a million worlds
    )
    rates = [BODY_RATE] * 3 if control == "body_rate" else [0.0] * 3
    hover = float(sim.data.params.mass[0]) * GRAVITY
    command = jnp.broadcast_to(jnp.array([*rates, hover], jnp.float32), (worlds, drones, 4))
    (sim.body_rate_control if control == "body_rate" else sim.attitude_control)(command)
    states = sim.data.states
    quadratic = sim.data.params.rpm2thrust[0]
    speed = _speed_for_thrust(quadratic, hover / 4)
    data = sim.data.replace(
        states=states.replace(
            pos=states.pos.at[..., 2].set(0.5), rotor_vel=jnp.full_like(states.rotor_vel, speed)
        )
    )
    return lambda data: sim._step(data, n_steps=steps), (data,)


def _speed_for_thrust(curve, thrust):
    """Rotor speed (rpm) at which c + b w + a w² is `thrust` (N), curve = (c, b, a)."""
    c, b, a = (float(value) for value in curve)
    return (-b + (b * b - 4 * a * (c - thrust)) ** 0.5) / (2 * a)


def make_openjax(variant: str, worlds: int, drones: int, steps: int):
    """`steps` steps of our drones, hovering among the pillars of drawn tasks with a constant command."""
    vehicle = load_vehicle()
    physics, _, free = variant.partition(" ")
    drones_step = make_drones_step(physics=physics, dt=1 / FREQUENCY, contacts=not free)
    settings = PursuitSettings(num_pursuers=drones)
    keys = jax.random.split(jax.random.key(0), worlds)
    tasks = jax.jit(jax.vmap(lambda key: uniform_task(settings, key)))(keys)
    state = jax.jit(jax.vmap(lambda task: hover_state(vehicle, task.pursuer_position)))(tasks)
    command = action_to_command(jnp.broadcast_to(hover_action(vehicle), (worlds, drones, 4)))
    command = command.at[..., 1:].add(BODY_RATE)

    def run(state, command, position, active):
        def one(state, _):
            step = jax.vmap(lambda d, c, p, a: drones_step(vehicle, d, c, p, a, {}))
            return step(state, command, position, active), None

        return jax.lax.scan(one, state, None, length=steps)[0]

    return run, (state, command, tasks.pillar_position, tasks.pillar_active)
