"""Each effect shows its own signature, does nothing at "no effect" and works beside all
others.
"""

import dataclasses

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from openjax.errors import UserError
from openjax.vehicle import (
    hover_state,
    load_vehicle,
    make_drones_step,
    max_rotor_thrust,
    rotor_reaction,
    rotor_speed_step,
    rotor_thrust,
    total_wrench,
)
from openjax.vehicle.effects import (
    EFFECTS,
    Effect,
    Parameter,
    composition,
    make_context,
    register_effect,
)
from openjax.vehicle.rate_controller import rate_controller
from tests.vehicle.typical import typical

pytestmark = pytest.mark.slow

NO_PILLARS = jnp.zeros((0, 2)), jnp.zeros(0, bool)
NONE = {name: effect.none() for name, effect in EFFECTS.items()}
VOCABULARY = """mass thrust_scale battery_sag thrust_saturation thrust_curve rotor_drag blade_flapping wind
ground_effect ceiling_effect downwash motor_lag command_latency packet_loss motor_imbalance com_offset inertia
yaw_torque rate_gains state_latency""".split()


@pytest.fixture(scope="module")
def vehicle():
    return load_vehicle()


def state_at(
    vehicle, position=(0, 0, 0.6), quaternion=None, velocity=(0, 0, 0), body_rates=(0, 0, 0)
):
    drone = hover_state(
        vehicle, jnp.asarray(position, jnp.float32), quaternion, jnp.asarray(velocity, jnp.float32)
    )
    return drone.replace(body_rates=jnp.asarray(body_rates, jnp.float32))


def yawed(angle):
    return jnp.array([np.cos(angle / 2), 0, 0, np.sin(angle / 2)])


def given(name, **values):
    """Parameters of an effect, `values` where they are given and no effect elsewhere,
    as arrays.
    """
    assert set(values) <= set(EFFECTS[name].parameters)
    return {key: jnp.float32(value) for key, value in {**NONE[name], **values}.items()}


def wrench(vehicle, name, values, others=None, **state):
    context = make_context(vehicle, state_at(vehicle, **state), others_position=others)
    return jax.tree.map(np.asarray, EFFECTS[name].wrench(given(name, **values), context))


def rotors(vehicle, name, values, **state):
    """(force, torque) of the rotors at hover with an effect on their thrusts."""
    context = make_context(vehicle, state_at(vehicle, **state))
    reaction = rotor_reaction(vehicle, context.rotor_speed)
    changed = EFFECTS[name].thrust(given(name, **values), context.thrust, reaction, context)
    return jax.tree.map(np.asarray, total_wrench(vehicle, *changed))


def test_the_library_is_complete_and_documented():
    assert sorted(EFFECTS) == sorted(VOCABULARY)
    for name, effect in EFFECTS.items():
        assert effect.name == name and effect.description and effect.parameters
        assert typical(effect) != effect.none()
        for parameter in effect.parameters.values():
            low, high = parameter.prior
            assert low < high and parameter.unit and parameter.source
            assert low - (high - low) * 3 <= parameter.none <= high + (high - low) * 3


def test_a_product_of_inertia_turns_the_body_as_its_whole_matrix_does(vehicle):
    """Newton and Euler's equations with the matrix, moments changed as well."""
    values = {"xx": 1.2, "yy": 0.9, "xy": 0.07}
    other = EFFECTS["inertia"].body(given("inertia", **values), vehicle)
    context = make_context(other, state_at(vehicle, body_rates=(3.0, -2.0, 1.0)))
    thrust = jnp.array([0.06, 0.08, 0.1, 0.09], jnp.float32)
    _, more = EFFECTS["inertia"].wrench(given("inertia", **values), context.replace(thrust=thrust))
    _, torque = total_wrench(vehicle, thrust, jnp.zeros(4))
    moments, rates, torque = (
        np.asarray(v, float) for v in (other.inertia, context.body_rates, torque)
    )
    matrix = np.diag(moments)
    nominal = np.asarray(vehicle.inertia, float)
    matrix[0, 1] = matrix[1, 0] = 0.07 * np.sqrt(nominal[0] * nominal[1])
    right = np.linalg.solve(matrix, torque - np.cross(rates, matrix @ rates))
    as_flown = (torque + more - np.cross(rates, moments * rates)) / moments
    np.testing.assert_allclose(as_flown, right, rtol=1e-5)


def test_body_effects_change_what_they_name(vehicle):
    def changed(name, **values):
        other = EFFECTS[name].body(given(name, **values), vehicle)
        fields = vars(vehicle)
        return {key: np.asarray(vars(other)[key] / fields[key]) for key in fields
                if not np.allclose(vars(other)[key], fields[key], rtol=1e-5, atol=0)}  # fmt: skip

    assert changed("mass", extra=0.00321) == {"mass": pytest.approx(1.1, rel=1e-5)}
    scaled = changed("thrust_scale", scale=-0.1)
    assert scaled == {"thrust_constant": pytest.approx(0.9), "torque_constant": pytest.approx(0.9)}
    assert changed("yaw_torque", ratio=0.2) == {"torque_constant": pytest.approx(0.2)}
    np.testing.assert_allclose(
        changed("inertia", xx=1.2, zz=0.8)["inertia"], [1.2, 1, 0.8], rtol=1e-5
    )
    gains = changed("rate_gains", p=0.5, d=2.0)
    assert set(gains) == {"rate_kp", "rate_kd"} and np.allclose(gains["rate_kp"], 0.5)


def test_motor_lag_has_the_time_constants_that_were_asked_for(vehicle):
    slow = EFFECTS["motor_lag"].body(given("motor_lag", extra_up=0.035, extra_down=0.055), vehicle)
    low, high = float(vehicle.max_rotor_speed) * np.sqrt([0.2, 0.8])
    for start, command, end, time_constant in ((low, 0.8, high, 0.06), (high, 0.2, low, 0.08)):
        speed = jnp.full(4, start)
        times = 0.0
        while abs(speed[0] - end) > np.exp(-1) * abs(start - end):
            speed = rotor_speed_step(slow, speed, jnp.full(4, command), 1e-3)
            times = times + 1e-3
        assert times == pytest.approx(time_constant, abs=2e-3)


def test_com_offset_and_imbalance_trim_differently(vehicle):
    """Both turn the body about roll and pitch in proportion to thrust, only imbalance
    about yaw.
    """
    moved = EFFECTS["com_offset"].body(given("com_offset", x=0.002, y=-0.001), vehicle)
    speed = state_at(vehicle).rotor_speed
    force, torque = total_wrench(moved, rotor_thrust(moved, speed), rotor_reaction(moved, speed))
    np.testing.assert_allclose(
        torque, [0.001 * force[2], 0.002 * force[2], 0], rtol=1e-3, atol=1e-8
    )
    _, torque = rotors(vehicle, "motor_imbalance", {"m1": 0.1})
    # front right, counter-clockwise
    assert torque[0] < 0 and torque[1] < 0 and torque[2] < 0


def test_battery_sag_follows_the_voltage_or_the_time(vehicle):
    command = jnp.full(4, 0.6)

    def sagged(**context):
        context = make_context(vehicle, state_at(vehicle), **context)
        return float(
            EFFECTS["battery_sag"].motor(given("battery_sag", exponent=2.0), command, context)[0]
        )

    assert sagged(battery_voltage=3.9) == pytest.approx(0.6)
    assert sagged(battery_voltage=3.5) == pytest.approx(0.6 * (3.5 / 3.9) ** 2)
    assert sagged(air_time=0.0) > sagged(air_time=100.0) > sagged(air_time=300.0)


def test_saturation_is_one_sided_and_the_curve_is_not(vehicle):
    context = make_context(vehicle, state_at(vehicle))
    command = jnp.array([0.2, 0.5, 0.8, 0.95])
    cut = EFFECTS["thrust_saturation"].motor(
        given("thrust_saturation", limit=0.7), command, context
    )
    np.testing.assert_allclose(cut, [0.2, 0.5, 0.7, 0.7], rtol=1e-6)
    low = context.replace(battery_voltage=jnp.float32(3.5))
    sagging = given("thrust_saturation", limit=0.7, voltage_slope=0.5)
    np.testing.assert_allclose(
        EFFECTS["thrust_saturation"].motor(sagging, command, low)[3], 0.56, rtol=1e-5
    )
    bent = EFFECTS["thrust_curve"].motor(
        given("thrust_curve", offset=0.01, curvature=0.1), command, context
    )
    np.testing.assert_allclose(bent, 0.01 + command + 0.1 * command**2, rtol=1e-6)
    # Absent, it leaves what a curve, or a battery fuller than its reference, gives
    # beyond the nominal largest thrust.
    absent = EFFECTS["thrust_saturation"].motor(given("thrust_saturation"), 1.2 * command, low)
    np.testing.assert_allclose(absent, 1.2 * command, rtol=1e-6)


def test_rotor_drag_opposes_motion_and_damps_rates(vehicle):
    values = {"d_xy": 0.02, "d_z": 0.01}
    force, torque = wrench(vehicle, "rotor_drag", values)
    assert not force.any() and not torque.any()
    force, _ = wrench(vehicle, "rotor_drag", values, velocity=(1, -2, 0.5))
    np.testing.assert_allclose(force, [-0.02, 0.04, -0.005], rtol=1e-5)
    force, _ = wrench(
        vehicle, "rotor_drag", values, velocity=(1, 0, 0), quaternion=yawed(np.pi / 2)
    )
    np.testing.assert_allclose(force, [0, 0.02, 0], atol=1e-7)  # it flies to its right
    _, torque = wrench(vehicle, "rotor_drag", values, body_rates=(2, -3, 4))
    assert np.all(torque * [2, -3, 4] < 0)


def test_blade_flapping_tilts_back_and_pitches_up(vehicle):
    force, torque = wrench(
        vehicle, "blade_flapping", {"tilt": 0.02, "stiffness": 1e-4}, velocity=(1.5, 0, 0)
    )
    weight = float(vehicle.mass * vehicle.gravity)
    np.testing.assert_allclose(force, [-0.02 * 1.5 * weight, 0, 0], rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(torque, [0, -1.5e-4, 0], rtol=1e-4, atol=1e-9)
    _, torque = wrench(vehicle, "blade_flapping", {"stiffness": 1e-4}, velocity=(0, 1, 0))
    assert torque[0] > 0


def test_wind_persists_at_rest_and_turns_with_yaw(vehicle):
    values = {"x": 2.0, "drag": 0.01}
    np.testing.assert_allclose(wrench(vehicle, "wind", values)[0], [0.02, 0, 0], rtol=1e-5)
    np.testing.assert_allclose(
        wrench(vehicle, "wind", values, quaternion=yawed(np.pi / 2))[0], [0, -0.02, 0], atol=1e-7
    )
    np.testing.assert_allclose(
        wrench(vehicle, "wind", values, velocity=(2, 0, 0))[0], [0, 0, 0], atol=1e-8
    )
    # In still air it is rotor drag: along the axes by its share, and against the body's
    # rates.
    still = {"x": 0.0, "y": 0.0, "z": 0.0, "drag": 0.02, "along": 0.4}
    moving = dict(velocity=(0.5, -1.0, 2.0), body_rates=(1.0, 2.0, 3.0))
    drag = wrench(vehicle, "rotor_drag", {"d_xy": 0.02, "d_z": 0.008}, **moving)
    np.testing.assert_allclose(
        np.concatenate(wrench(vehicle, "wind", still, **moving)), np.concatenate(drag), rtol=1e-5
    )


@pytest.mark.parametrize(
    ("name", "plane", "side"), [("ground_effect", 0.0, 1), ("ceiling_effect", 1.2, -1)]
)
def test_a_near_plane_adds_thrust_and_a_gradient_tilts(vehicle, name, plane, side):
    values = {"strength": 0.6, "offset": 0.01}
    weight = float(vehicle.mass * vehicle.gravity)
    gains = [
        rotors(vehicle, name, values, position=(0, 0, plane + side * d))[0][2] / weight
        for d in (0.05, 0.1, 0.6)
    ]
    np.testing.assert_allclose(
        gains, 1 + 0.6 * (0.023 / np.array([0.06, 0.11, 0.61])) ** 2, rtol=1e-5
    )
    rolled = jnp.array([np.cos(0.1), np.sin(0.1), 0, 0])  # the left side is up
    _, torque = rotors(
        vehicle, name, values, position=(0, 0, plane + side * 0.05), quaternion=rolled
    )
    assert (
        torque[0] * side < 0
        # the side nearer to the plane gains more: the floor rights, the ceiling turns
        # over
    )


def test_downwash_pushes_only_what_is_below(vehicle):
    def push(other, **values):
        return wrench(
            vehicle, "downwash", {"force": 0.1, **values}, jnp.array([other]), position=(0, 0, 0.5)
        )

    right_under, torque = push([0.0, 0, 0.8], width=0.2, spread=0.0)
    rotor_radius_share = np.exp(-(0.043**2) / (2 * 0.2**2))
    assert right_under[2] == pytest.approx(-0.1 * np.exp(-0.3 / 0.5) * rotor_radius_share, rel=1e-4)
    np.testing.assert_allclose(torque, 0, atol=1e-8)
    assert not push([0.0, 0, 0.3])[0].any()
    assert abs(push([0.5, 0, 0.8])[0][2]) < 1e-6
    assert abs(push([0.0, 0, 1.5])[0][2]) < abs(right_under[2])
    assert push([0.06, 0, 0.8])[1][1] > 0  # a wake over the front pushes the nose down


def test_latency_delays_by_fractions_of_a_step(vehicle):
    effect = EFFECTS["command_latency"]
    drone = state_at(vehicle)
    context = make_context(vehicle, drone, dt=0.01)

    def received(delay):
        memory = effect.initial_memory(vehicle, drone, 0.01, None)
        got = []
        for k in range(8):
            command = jnp.array([0.1 * k, 0, 0, 0])
            arrived, memory = effect.command({"delay": delay}, memory, command, context)
            got.append(arrived[0])
        return jnp.stack(got)

    np.testing.assert_allclose(received(0.0), 0.1 * np.arange(8), atol=1e-6)
    np.testing.assert_allclose(received(0.025)[4:], 0.1 * (np.arange(4, 8) - 2.5), atol=1e-5)
    slope = jax.jacfwd(received)(
        jnp.float32(0.0)
    )  # a fit that starts from no delay must see where to go
    np.testing.assert_allclose(slope[1:], -0.1 / 0.01, rtol=1e-4)


def test_packet_loss_holds_the_last_command(vehicle):
    effect = EFFECTS["packet_loss"]
    drone = state_at(vehicle)
    context = make_context(vehicle, drone)
    commands = jnp.zeros((2000, 4)).at[:, 0].set(jnp.arange(2000.0))

    def receive(context, probability):
        memory = effect.initial_memory(vehicle, drone, 0.01, jax.random.key(3))

        def advance(memory, command):
            arrived, memory = effect.command({"probability": probability}, memory, command, context)
            return memory, arrived[0]

        return np.asarray(jax.lax.scan(advance, memory, commands)[1])

    got = receive(context, 0.3)
    lost = np.diff(got) == 0
    assert lost.mean() == pytest.approx(0.3, abs=0.04)
    arrived = np.flatnonzero(~lost) + 1
    assert (got[arrived] == arrived).all()
    replayed = receive(context.replace(packet_lost=jnp.float32(1.0)), 0.0)
    assert (replayed == replayed[0]).all()


def commands(steps):
    """(steps, 2, 4) commands that change in each step and reach full thrust."""
    draw = np.random.default_rng(2)
    thrust = draw.uniform(0.3, 1.0, (20, 2, 1))
    rates = draw.uniform(-3, 3, (20, 2, 3))
    return jnp.asarray(np.concatenate([thrust, rates], axis=-1), jnp.float32)[:steps]


def flight(vehicle, effects, steps=20):
    """A jitted flight of two drones, one above the other: parameters -> (states, seen
    at the end).
    """
    step = make_drones_step("rigid", effects=effects)
    start = hover_state(
        vehicle, jnp.array([[0.0, 0, 0.2], [0.01, 0, 0.5]]), velocity=jnp.array([0.5, -0.3, 0.1])
    )
    start = step.reset(vehicle, start, jax.random.key(0))

    @jax.jit
    def fly(parameters):
        def advance(drones, command):
            drones = step(vehicle, drones, command, *NO_PILLARS, parameters)
            return drones, drones.replace(effect_memory=())

        end, states = jax.lax.scan(advance, start, commands(steps))
        return states, step.seen(end, parameters)

    return fly


@pytest.fixture(scope="module")
def fly(vehicle):
    """A flight with all effects, each of which can be switched on by its parameters;
    compiled once.
    """
    everything = flight(vehicle, tuple(EFFECTS))
    return lambda **on: everything(jax.tree.map(jnp.float32, {**NONE, **on}))


@pytest.fixture(scope="module")
def nominal(vehicle):
    """The same flight of a step that has no effects."""
    return flight(vehicle, ())({})[0]


def test_no_effect_means_none(nominal, fly):
    leaves = jax.tree.leaves(fly()[0]), jax.tree.leaves(nominal)
    chex.assert_trees_all_close(*leaves, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("name", sorted(VOCABULARY))
def test_each_effect_alone_changes_the_flight(fly, name):
    """And only what it may change: latencies of what is seen leave the flight itself
    alone.
    """
    (nominal, nominal_seen), (changed, seen) = (fly(), fly(**{name: typical(EFFECTS[name])}))
    moved = max(
        float(np.abs(changed.position - nominal.position).max()),
        float(np.abs(changed.body_rates - nominal.body_rates).max()),
    )
    if name == "state_latency":
        assert moved == 0
        delay = typical(EFFECTS[name])["delay"]
        expected = nominal.position[-1] - delay * nominal.velocity[-1]
        np.testing.assert_allclose(seen.position, expected, atol=2e-3)
        assert np.abs(seen.position - nominal_seen.position).max() > 5e-3
        np.testing.assert_allclose(seen.body_rates, nominal.body_rates[-1])
    else:
        assert moved > 1e-4


def test_all_effects_together_have_finite_gradients(vehicle):
    """Jitted and differentiated, at typical values and at "no effect"."""
    step = make_drones_step("rigid", effects=tuple(EFFECTS))
    start = hover_state(
        vehicle, jnp.array([[0.0, 0, 0.1], [0.01, 0, 0.4]]), velocity=jnp.array([0.5, -0.3, 0.1])
    )
    start = step.reset(vehicle, start, jax.random.key(0))

    @jax.jit
    @jax.value_and_grad
    def loss(parameters):
        def advance(drones, command):
            return step(vehicle, drones, command, *NO_PILLARS, parameters), None

        drones, _ = jax.lax.scan(advance, start, commands(8))
        seen = step.seen(drones, parameters)
        return jnp.sum(seen.position) + jnp.sum(drones.body_rates**2) + jnp.sum(drones.velocity**2)

    for parameters in (NONE, {name: typical(effect) for name, effect in EFFECTS.items()}):
        value, slope = loss(jax.tree.map(jnp.float32, parameters))
        assert np.isfinite(value)
        assert np.isfinite(jax.tree.leaves(slope)).all()
    acting = {name for name in EFFECTS if any(float(entry) != 0 for entry in slope[name].values())}
    # whether a packet arrives has no slope
    assert acting >= set(EFFECTS) - {"packet_loss"}


def test_an_effect_of_ones_own(vehicle, nominal):
    """Anything that fills the hooks flies; here a constant push."""
    push = Effect(
        name="push",
        description="a constant force",
        parameters={"x": Parameter("N", 0.0, (0.0, 1.0), "made up")},
        wrench=lambda parameters, context: (jnp.stack([parameters["x"], 0, 0]), jnp.zeros(3)),
    )
    states, _ = flight(vehicle, (push, "mass"), steps=3)({"push": {"x": jnp.float32(0.0321)}})
    np.testing.assert_allclose(
        states.velocity[2, :, 0] - nominal.velocity[2, :, 0], 0.03, atol=1e-3
    )


def test_hooks_map_over_logged_states(vehicle):
    """What the diagnosis does: the drag along a logged flight, differentiated in the
    parameter.
    """
    states = jax.vmap(lambda v: state_at(vehicle, velocity=v))(
        jnp.linspace(-1, 1, 9)[:, None] * jnp.ones(3)
    )

    def drag(d_xy):
        contexts = jax.vmap(lambda state: make_context(vehicle, state))(states)
        parameters = {"d_xy": d_xy, "d_z": 0.0}
        return jax.vmap(lambda context: EFFECTS["rotor_drag"].wrench(parameters, context)[0])(
            contexts
        )

    slope = jax.jacfwd(drag)(jnp.float32(0.01))
    np.testing.assert_allclose(slope[:, 0], -np.linspace(-1, 1, 9), atol=1e-6)


def test_random_effects_need_a_key_and_differ_between_drones(vehicle):
    step = make_drones_step("rigid", effects=("packet_loss",))
    start = hover_state(vehicle, jnp.zeros((2, 3)))
    with pytest.raises(UserError, match="needs a key"):
        step.reset(vehicle, start)
    keys = step.reset(vehicle, start, jax.random.key(1)).effect_memory["packet_loss"]["key"]
    assert (keys[0] != keys[1]).any()


@pytest.mark.parametrize("wrong", [{"wind": {"speed": 1.0}}, {"mass": {"extra": 0.0}}])
def test_parameters_of_nothing_are_refused(vehicle, wrong):
    step = make_drones_step("rigid", effects=("wind",))
    with pytest.raises(UserError, match="reset"):
        step(vehicle, hover_state(vehicle, jnp.zeros((1, 3))), jnp.zeros((1, 4)), *NO_PILLARS)
    start = step.reset(vehicle, hover_state(vehicle, jnp.zeros((1, 3))))
    with pytest.raises(UserError):
        step(vehicle, start, jnp.zeros((1, 4)), *NO_PILLARS, wrong)


def test_rate_gains_act_in_the_controller(vehicle):
    soft = EFFECTS["rate_gains"].body(given("rate_gains", p=0.5, i=0.5, d=0.5), vehicle)
    command = jnp.array([0.5, 0.5, 0, 0])
    nominal, halved = (
        rate_controller(v, state_at(vehicle), command, 0.01)[0] - 0.5 for v in (vehicle, soft)
    )
    np.testing.assert_allclose(halved, 0.5 * nominal, rtol=1e-4)
    assert float(4 * max_rotor_thrust(soft)) == pytest.approx(float(4 * max_rotor_thrust(vehicle)))


def test_an_effect_of_ones_own_has_a_name_of_its_own():
    other = dataclasses.replace(EFFECTS["wind"], description="another one")
    with pytest.raises(UserError, match="'wind': there is one of that name already"):
        register_effect(other)
    register_effect(EFFECTS["wind"])  # the same one again is nothing new
    assert EFFECTS["wind"].description != "another one"


def test_usual_ranges_grow_with_the_vehicle_and_stay_for_a_crazyflie():
    from openjax.vehicle.effects.effect import growth

    small = load_vehicle()
    heavy = small.replace(mass=40.0 * small.mass, rotor_position=6.0 * small.rotor_position)
    loaded = small.replace(mass=1.5 * small.mass)
    grown = {"kg": 40.0, "N": 40.0, "N s/m": 40.0, "m": 6.0, "N m s/m": 240.0, "s": 1.0, "1": 1.0}
    for unit, factor in grown.items():
        assert growth(unit, heavy) == pytest.approx(factor), unit
        assert growth(unit, loaded) == 1.0, unit
    known = {p.unit for e in EFFECTS.values() for p in e.parameters.values()}
    # a unit with a kilogram, newton or metre in it that nobody thought of
    assert {u for u in known if "N" in u or "kg" in u or u == "m"} <= set(grown)
    drag = EFFECTS["rotor_drag"].parameters["d_xy"]
    assert drag.usual(small) == drag.prior
    assert drag.usual(heavy) == pytest.approx((40 * drag.prior[0], 40 * drag.prior[1]))


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ({"name": "two words"}, "letters, digits and _ would be right"),
        ({}, "changes nothing: one of body, command"),
        ({"command": lambda p, m, u, c: (u, m)}, "initial_memory says what"),
    ],
)
def test_what_is_no_effect_is_a_line(parts, words):
    with pytest.raises(UserError, match=words):
        Effect(**{"name": "mine", "description": "", "parameters": {}, **parts})


def test_a_hook_that_gives_another_shape_is_a_line_with_its_effect():
    def of_three(parameters, motor_command, context):
        return motor_command[:3]

    effect = Effect(name="mine", description="", parameters={}, motor=of_three)
    with pytest.raises(UserError, match=r"'mine': motor gives arrays of shapes"):
        composition.change_motor_command([effect], {"mine": {}}, jnp.ones(4), None)
