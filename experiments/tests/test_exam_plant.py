"""The exam's plant against the simulator, and its cases against one another."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.diagnosis import answer_key, cases, effects, fleet, sensors, vehicle
from openjax.vehicle import (
    load_vehicle,
    rigid_step,
    rotor_reaction,
    rotor_speed_step,
    rotor_thrust,
    total_wrench,
)
from openjax.vehicle.rate_controller import rate_controller
from openjax.vehicle.rigid_body import rotate
from openjax.vehicle.state import DroneState

pytestmark = pytest.mark.slow

TICKS = 500
FLIGHTS = {1: ("agile", "yaw", "fast"), 2: ("climb", "step", "agile"), 3: ("laps",)}


def fly(*numbers, causes=(), **changes):
    """Vehicles told exactly, with hard manoeuvres in light turbulence; `changes` of their sensors."""
    drawn = sensors.draw(np.random.default_rng(3), "white", "psgacmv", "light")
    drawn |= {
        "constants_off": [0.0] * 5,
        "thrust_offset": 0.0,
        "gyro_cut": 0.0,
        "derivative_cut": 0.0,
    }
    drawn |= changes
    specs = [
        {
            "name": f"case_{n}",
            "number": n,
            "missions": [(m,) for m in FLIGHTS[n]],
            "ticks": [cases.TICKS] * len(FLIGHTS[n]),
            "sensors": drawn,
            "told": vehicle.Told(),
            "controller": "geometric",
        }
        for n in numbers
    ]
    bodies = {s["name"]: fleet.bodies(5, "known", s) for s in specs}
    return fleet.Fleet(5, "known", [(s, list(causes)) for s in specs], bodies)


@pytest.fixture(scope="module")
def nominal():
    """Two nominal cases."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cases, "TICKS", TICKS)
        yield fly(1, 2)


def _replay(vehicle, start, motors, commands, from_commands):
    """Velocity and rates after each tick of 10 ms, replayed with the simulator's own functions at 2
    ms.
    """
    dt = 0.002

    def tick(carry, inputs):
        def step(state, inputs):
            m_logged, command = inputs
            m, integral = rate_controller(vehicle, state, command, dt)
            m = m if from_commands else m_logged
            rotor = rotor_speed_step(vehicle, state.rotor_speed, m, dt)
            thrust = rotor_thrust(vehicle, rotor)
            reaction = rotor_reaction(vehicle, rotor)
            force, torque = total_wrench(vehicle, thrust, reaction)
            new = rigid_step(vehicle, state, rotate(state.quaternion, force), torque, dt)
            rotors = {"rotor_speed": rotor, "rate_integral": integral}
            return new.replace(**rotors, previous_body_rates=state.body_rates), None

        carry, _ = jax.lax.scan(step, carry, inputs)
        return carry, (carry.velocity, carry.body_rates)

    return jax.lax.scan(tick, start, (motors, commands))[1]


@pytest.mark.parametrize("from_commands", [False, True])
def test_nominal_plant_agrees_with_the_rigid_simulator(nominal, from_commands):
    # a wrong sign, unit, motor order, spin, gain or lag in either would show at many
    # times the gusts
    flown = nominal.flown
    bodies = nominal.columns[0]
    starts = np.arange(100, TICKS - 25, 20)
    length = 20

    def gather(name, tick=0):
        values = flown[name][5 * (starts + tick)].astype(float)
        return np.moveaxis(values[:, :, bodies], 2, 1).reshape(-1, values.shape[1])

    start = DroneState(
        position=gather("position"),
        quaternion=gather("quaternion"),
        velocity=gather("velocity"),
        body_rates=gather("rates"),
        rotor_speed=gather("rotor"),
        rate_integral=gather("integral"),
        previous_body_rates=gather("rates"),
        effect_memory=(),
    )
    start = jax.tree.map(jnp.asarray, start)

    def windows(name):
        cut = [
            np.moveaxis(flown[name][5 * k : 5 * (k + length)][:, :, bodies], 2, 0) for k in starts
        ]
        return np.stack(cut).reshape(-1, length, 5, 4)

    replayed = jax.jit(jax.vmap(lambda s, m, c: _replay(load_vehicle(), s, m, c, from_commands)))
    velocity, rates = replayed(start, windows("motor"), windows("applied"))

    def error(name, values, ticks):
        truth = gather(name, ticks)
        moved = truth - np.asarray(
            getattr(start, "velocity" if name == "velocity" else "body_rates")
        )
        return np.sqrt(np.mean((values[:, ticks - 1] - truth) ** 2, 0)), np.sqrt(
            np.mean(moved**2, 0)
        )

    dv, moved_v = error("velocity", velocity, 20)
    dw, moved_w = error("rates", rates, 5)
    assert np.all(dv < 0.012) and np.all(dv < 0.1 * moved_v)
    assert np.all(dw < 0.05) and np.all(dw < 0.25 * moved_w)


def test_a_case_does_not_depend_on_its_companions(nominal):
    # otherwise the number of processes would change the flights, and a seed would mean nothing
    alone = fly(2)
    among_others = nominal.flown["velocity"][:, :, nominal.columns[1]]
    np.testing.assert_array_equal(alone.flown["velocity"], among_others)


def test_a_factor_stands_in_for_a_battery_only_while_its_voltage_stays(monkeypatch):
    """Else the key would want a name that no reader of one steady flight could know, or let any
    scale pass for a battery.
    """
    monkeypatch.setattr(cases, "TICKS", 400)
    sag = effects.draw(np.random.default_rng(1), "battery_sag", "linear") | {"size": 1.2}
    for discharge, stands_in in ((0.0, True), (0.2, False)):
        flown = fly(3, causes=[sag], discharge=discharge, resistance=0.0)
        squares = {"truth": flown.replayed(0, flown.parameters)}
        floor = np.sqrt(squares["truth"]) + 0.02
        assert answer_key.scale_stands_in(flown, 0, "battery_sag", squares, floor) == stands_in
