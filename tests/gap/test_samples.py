"""Sample flights: a complete, flyable, repeatable case; and the command keeps its hands
off what is there.
"""

import numpy as np
import pytest

from openjax.commands.sample_flights import main
from openjax.errors import UserError
from openjax.flights import samples
from openjax.flights.case import load_case
from openjax.flights.manoeuvres import references
from openjax.flights.samples import fly
from openjax.gap.model.library import CARDS
from openjax.vehicle import load_vehicle
from openjax.vehicle.effects import EFFECTS


def test_every_effect_has_a_strength_within_its_usual_range():
    for name, effect in EFFECTS.items():
        assert effect.card.sample, name
        for parameter, value in effect.card.sample.items():
            low, high = EFFECTS[name].parameters[parameter].prior
            assert low <= value <= high, (name, parameter)


def test_the_nominal_controller_follows_the_reference(sample_columns):
    for name, reference in references(seed=1, duration=8.0).items():
        columns = sample_columns[name]
        error = np.stack([columns[a] for a in "xyz"], 1) - reference.position[:, 0]
        assert np.sqrt(np.mean(error**2)) < 0.08, name
        assert columns["z"].min() > 0.03


def test_an_effect_shows_where_it_should():
    """Rotor drag: the lateral specific force is minus d/m times the body velocity."""
    vehicle = load_vehicle()
    reference = references(seed=1, duration=8.0)["flight_b"]
    columns = fly(vehicle, vehicle, reference, 1, {"rotor_drag": {"d_xy": 0.02}})[0]
    w, z = columns["qw"], columns["qz"]  # nearly level: turn by yaw only
    cos = 1 - 2 * z**2
    sin = 2 * w * z
    forward = cos * columns["vx"] + sin * columns["vy"]
    slope = np.polyfit(forward, columns["ax"], 1)[0]
    assert slope == pytest.approx(-0.02 / 0.0321, rel=0.1)


def test_the_command_makes_a_case_that_passes_every_check(tmp_path):
    for number in (1, 2):
        main([str(tmp_path / f"case{number}"), "--duration", "8"])
    case = load_case(tmp_path / "case1")
    assert [f.name for f in case.flights] == [
        "flight_a.csv.gz",
        "flight_b.csv.gz",
        "flight_c.csv.gz",
    ]
    assert case.quality == () and case.vehicle_file.mass_weighed
    first, second = (sorted((tmp_path / f"case{n}").iterdir()) for n in (1, 2))
    assert [p.read_bytes() for p in first] == [
        p.read_bytes() for p in second
    ]  # same seed, same bytes


@pytest.mark.parametrize("effect", ["none", *EFFECTS])
def test_a_sample_says_weighed_only_where_its_effect_can_still_be_named(
    effect, tmp_path, monkeypatch, sample_columns
):
    """A weighed mass can't be wrong: the diagnosis doesn't try it."""
    monkeypatch.setattr(samples, "fly", lambda *_: [sample_columns["flight_b"]])
    main([str(tmp_path / "case"), "--effect", effect])
    case = load_case(tmp_path / "case")
    assert case.vehicle_file.mass_weighed == (effect != "mass")
    assert effect == "none" or not (case.vehicle_file.mass_weighed and CARDS[effect].weighed)


def test_two_effects_act_at_once(tmp_path, monkeypatch, sample_columns):
    flown = []

    def fly(plant, assumed, reference, seed, effects):
        flown.append(effects)
        return [sample_columns["flight_b"]]

    monkeypatch.setattr(samples, "fly", fly)
    main([str(tmp_path / "case"), "--effect", "rotor_drag", "motor_lag"])
    wanted = {name: EFFECTS[name].card.sample for name in ("rotor_drag", "motor_lag")}
    assert flown == [wanted] * 3
    source = load_case(tmp_path / "case").vehicle_file.log["source"]
    assert source.endswith("effect: rotor_drag, motor_lag")


@pytest.mark.parametrize(
    "arguments",
    [
        ["--effect", "gremlins"],
        ["--effect", "none", "inertia"],
        ["--effect", "inertia", "inertia"],
        ["--duration", "1"],
        ["--colour", "red"],
    ],
)
def test_bad_arguments_are_one_line(tmp_path, arguments):
    with pytest.raises(UserError) as caught:
        main([str(tmp_path / "case"), *arguments])
    assert "\n" not in str(caught.value) and not (tmp_path / "case").exists()


def test_a_folder_in_use_is_left_alone(tmp_path):
    (tmp_path / "mine.txt").write_text("precious")
    with pytest.raises(UserError, match="empty folder"):
        main([str(tmp_path)])
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]
