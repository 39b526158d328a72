"""The exam of the diagnosis: sensors against what they say, causes and cases."""

import numpy as np
import pytest

from experiments.diagnosis import (
    cases,
    effects,
    garbage,
    generate,
    measure,
    plant,
    sensors,
    unknowns,
    vehicle,
)
from experiments.diagnosis.rows import log_rows

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def hovering():
    """Two vehicles of different mass for 3 s, one holding a point, one on laps, in still air and
    without noise.
    """
    many = [
        vehicle.Told(mass=0.03),
        vehicle.Told(mass=0.042, thrust_constant=3e-8, motor_time=0.03),
    ]
    rng = np.random.default_rng(1)
    laps = cases.missions.single("laps", rng, 300)
    still = {k: np.zeros_like(x) for k, x in laps.items()}
    still["position"][:, 2] = 0.6
    set_up = sensors.draw(rng, "white", "pgacmv", "none")
    set_up |= {"size": 1e-9, "gyro": 0.0, "gyro_bias": [0.0] * 3, "pose_delay": 0.0, "gust": 0.0}
    air = sensors.stack([sensors.draw_air(rng, set_up, 300, 3.9) for _ in many])
    air["gyro_bias"] *= 0
    reference = {k: np.stack([still[k], laps[k]], axis=-1) for k in laps}
    arrival = np.repeat(10 * np.arange(300)[:, None], 2, axis=1)
    p = vehicle.nominal_parameters(many)
    batch = plant.Batch(many, p, reference, ["geometric", "cascade"], np.arange(2), arrival, air)
    return many, p, plant.fly(batch)


def test_hover_needs_the_weight_and_motion_agrees_with_the_sensors(hovering):
    many, _, flown = hovering
    np.testing.assert_allclose(
        flown["motor"][-250:, :, 0].mean(axis=(0, 1)), many[0].hover, rtol=1e-3
    )
    assert (flown["crashed"] == 1500).all()
    speed = flown["velocity"][:, :, 1].astype(float)
    q = flown["quaternion"][:, :, 1].astype(float)
    assert np.abs(speed[:, :2]).max() > 0.3
    accel = np.gradient(speed, 0.002, axis=0)[500:-5]
    accel[:, 2] += 9.81
    force = flown["specific"][500:-5, :, 1]
    np.testing.assert_allclose(vehicle.rotate_back(q[500:-5].T, accel.T).T, force, atol=0.08)
    turn = 2 * vehicle.multiply((q[:-1] * [1, -1, -1, -1]).T, q[1:].T)[1:].T / 0.002
    np.testing.assert_allclose(turn[500:-5], flown["rates"][501:-5, :, 1], atol=0.05)


def test_the_measure_sees_nothing_in_a_true_model_and_a_wrong_thrust_by_its_size(hovering):
    many, p, flown = hovering
    none = np.zeros(2, bool)
    assert measure.errors(flown, many, p, np.arange(2), none, none).max() < 2e-3
    wrong = {k: x.copy() for k, x in p.items()}
    wrong["rotor_gain"] = wrong["rotor_gain"] * 0.9
    seen = measure.errors(flown, many, wrong, np.arange(2), none, none)
    np.testing.assert_allclose(seen[2, 0], 0.1 * 9.81 * 0.25, rtol=0.01)
    late = flown | {"pose_delay": np.full(2, 0.01)}
    turned = measure.errors(late, many, p, np.arange(2), none, none)[9:, 1]
    # a delayed pose is off by delay times rate; the horizon doubles the variance
    rms = np.sqrt(2) * 0.01 * flown["rates"][500:1374, :, 1].std(axis=0)
    np.testing.assert_allclose(turned, rms, rtol=0.3, atol=1e-4)


def log_of(flown, kind, unknown=(), **changes):
    rng = np.random.default_rng(5)
    plain = {"rate": 100, "pose_rate": 100, "dropped": 0.0}
    set_up = sensors.draw(rng, kind, "psgacmv", "none") | plain | changes
    return log_rows(rng, set_up, flown, 1, 300, unknown)


def test_drawn_sensors_have_the_noise_that_they_say(hovering):
    _, _, flown = hovering
    plain = {
        "accel_cut": 0.0,
        "tilt": [0, 0, 0],
        "accel_bias": [0, 0, 0],
        "pose_delay": 2.0,
        "quantum": 1.0,
    }
    rows = log_of(flown, "white", **plain, size=1.0, accel=0.2, position=2e-4, velocity="smooth")
    at = np.arange(300) * 5
    noise = rows["ax"] - flown["specific"][at, 0, 1]
    assert noise.std() == pytest.approx(0.2, rel=0.15)
    late = rows["x"] - (flown["position"][at, 0, 1] - 0.002 * flown["velocity"][at, 0, 1])
    assert late[10:].std() == pytest.approx(2.5e-4, rel=0.4)
    filtered = log_of(flown, "filtered", **plain | {"accel_cut": 30.0}, size=1.0, accel=0.2)
    assert (filtered["ax"] - flown["specific"][at, 0, 1])[20:].std() < 0.13
    coarse = log_of(flown, "quantised", **plain | {"quantum": 20.0})
    steps_seen = np.round(coarse["qx"] / 2e-4)
    np.testing.assert_allclose(coarse["qx"], steps_seen * 2e-4, atol=1e-9)
    quiet = {"size": 1e-3, "accel": 1e-3, "vibration": 1.0, "vibration_frequency": 20.0}
    shaking = log_of(flown, "vibrating", **plain, **quiet)
    spectrum = np.abs(np.fft.rfft(shaking["ay"] - flown["specific"][at, 1, 1])) ** 2
    peak = np.fft.rfftfreq(300, 0.01)[spectrum[1:].argmax() + 1]
    assert 16 < peak < 24
    slow = log_of(flown, "stale", pose_rate=50)
    assert (np.diff(slow["x"])[0::2] == 0).mean() > 0.95
    gaps = log_of(flown, "white", pose_rate=50)
    assert np.isnan(gaps["x"]).mean() == pytest.approx(0.5, abs=0.02)
    radio = log_of(flown, "radio", stream_rate=75.0, wander=0.0)
    exact = flown["motor"][at, 0, 1]
    assert 0 < np.abs(radio["m1"] - exact).max() < 0.3


def test_the_stranger_column_shares_no_kind_with_the_known_one():
    known, strange = (cases.draw_cases(3, column, 250) for column in ("known", "stranger"))
    for read in (
        lambda c: c["sensors"]["kind"],
        lambda c: c["controller"],
        lambda c: c["causes"][0]["form"] if c["category"] == "unknown" else None,
        lambda c: c["garbage"],
    ):
        one, two = ({read(c) for c in column} - {None} for column in (known, strange))
        assert one and two and not one & two
    assert {c["causes"][0]["effect"] for c in known if c["category"] == "single"} == set(
        effects.EFFECTS
    )
    assert cases.draw_cases(3, "known", 250) == known
    for c in known:
        for cause in c["causes"]:
            needs = (
                effects.EFFECTS[cause["effect"]].needs if cause["effect"] in effects.EFFECTS else ""
            )
            assert set(needs) <= set(c["sensors"]["channels"])


def test_generated_kinds_differ_and_no_line_in_their_inputs_explains_them():
    """Else a named effect, which is such a line, would be half right, and a detector for one kind
    would find all.
    """
    rng = np.random.default_rng(0)
    causes = [{"shape": rng.uniform(size=8), "form": "smooth"} for _ in range(40)]
    function = unknowns.Generated(causes)
    values = []
    for _ in range(600):
        inputs = np.repeat(rng.standard_normal((len(unknowns.SCALE) - 1, 1)), 40, axis=1)
        values.append(np.r_[inputs[:, 0], function(inputs, 50.0 + 10 * rng.uniform())])
    values = np.array(values)
    x = np.c_[np.ones(600), values[:, :-40]]
    f = values[:, -40:]
    line = x @ np.linalg.lstsq(x, f, rcond=None)[0]
    explained = 1 - (f - line).var(0) / f.var(0)
    assert np.median(explained) < 0.15 and np.abs(np.corrcoef(f.T) - np.eye(40)).max() < 0.6
    assert 0.5 < np.median(f.std(0)) < 1.5


def test_every_unknown_site_acts(hovering):
    _, _, flown = hovering
    cause = {"shape": np.full(8, 0.2), "form": "smooth"}
    for name, site in unknowns.SITES.items():
        own = cause | {"effect": name, "size": site.sizes[1]}
        if site.logs:
            one, two = (log_of(flown, "white", unknown=unknown) for unknown in ([], [own]))
            wrong = {c for c in one if not np.allclose(one[c], two[c], equal_nan=True)}
            assert wrong and wrong <= set(sensors.GROUPS[site.logs]), name
            continue
        strange = unknowns.Unknowns({name: [(np.array([0]), own)]}, 1)
        u = np.full((4, 1), 0.6)
        moved = 0.0
        for s in range(0, 1400, 7):
            names = ("position", "quaternion", "velocity", "rates")
            state = [flown[k][s, :, 1:].astype(float) for k in names]
            time = 5 + 0.006 * s
            strange.look(*state, u, np.array([3.7]))
            force, torque = strange.wrench(state[1], time)
            sizes = (force / 1e-2, torque / 1e-4, (strange.motors(u, time) - u) / 0.05)
            moved = max(moved, *(np.abs(size).max() for size in sizes))
        assert moved > 0.3, name


def test_garbage_spoils_what_it_says_and_nothing_else(hovering):
    _, _, flown = hovering
    for kind in garbage.KINDS | garbage.STRANGERS:
        flights = [log_of(flown, "white") for _ in range(3)]
        flights[1] = {k: x + 0.01 if k != "t" else x for k, x in flights[1].items()}
        before = [{k: x.copy() for k, x in f.items()} for f in flights]
        wrong = garbage.spoil(kind, flights, np.random.default_rng(2))
        both = list(zip(flights, before, strict=True))
        changed = {k for f, o in both for k in f if not np.array_equal(f[k], o[k], equal_nan=True)}
        assert changed and changed <= set(wrong), kind


def test_written_cases_can_be_read_and_say_what_they_hold(tmp_path, monkeypatch):
    from openjax.flights.case import load_case

    monkeypatch.setattr(cases, "TICKS", 300)
    single = (cases.draw_case(5, "known", 1, "single", i) for i in range(20))
    thrust = next(s for s in single if s["causes"][0]["effect"] == "thrust_scale")
    hidden = (cases.draw_case(5, "known", 3, "not_testable", i) for i in range(8))
    drag = next(s for s in hidden if s["causes"][0]["effect"] == "rotor_drag")
    drawn = [thrust, cases.draw_case(5, "known", 2, "pair", 0), drag]
    for spec in drawn:
        spec |= {"ticks": [300] * 3, "missions": [("laps",)] * 3}
    monkeypatch.setattr(cases, "draw_cases", lambda *_: drawn)
    answers = generate.generate(5, "known", 2, tmp_path / "logs")
    digest = generate.write_answers(tmp_path / "answers.json", answers, 5, "known")
    assert (tmp_path / "answers.sha256").read_text().strip() == digest
    for answer in answers:
        case = load_case(tmp_path / "logs" / answer["case"])
        assert case.flights
        assert answer["gap"]["before"] >= 0.99
        if answer["category"] == "pair":
            assert sum(answer["shares"].values()) == pytest.approx(1.0, abs=0.35)
        elif answer["effects"] == [
            "rotor_drag"
        ]:  # on laps it shows: the key may not call it hidden
            assert answer["category"] == "single" and answer["expected"] == ["rotor_drag"]
        mass = answer["told"]["mass"]
        assert (
            f"mass = {mass:.5f}"
            in (tmp_path / "logs" / answer["case"] / "vehicle.toml").read_text()
        )


def test_rows_that_see_little_of_the_motors_hide_torque(hovering):
    """A key whose floor forgets this asks for torques that no reader of a slow log can see."""
    many, p, flown = hovering
    none = np.zeros(2, bool)
    left = {}
    m = flown["motor"].copy()
    m[::2] += 0.02  # the loop's own noise: fast, and without effect on the motion
    m[1::2] -= 0.02
    for rate in (500, 50):
        rows = log_of(flown | {"motor": m}, "white", rate=rate, motor="snapshot")
        held, straight = measure.motors_of_log(rows, len(m))
        logged = np.stack([held, held], axis=-1)
        seen = measure.errors(flown | {"motor": logged}, many, p, np.arange(2), none, none)
        left[rate] = seen[3:6, 1].max()
        assert straight.shape == held.shape
    np.testing.assert_allclose(left[500], 0.0, atol=0.1)
    assert left[50] > 5 * left[500]
