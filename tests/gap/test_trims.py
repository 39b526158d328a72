"""What trims say of two sets of flights: on flown vehicles with a known change, and on
trims made by hand for what only many flights show (days, sizes, classes).
"""

import functools
import json
import shutil

import numpy as np
import pytest

from openjax.commands.diagnose import main
from openjax.errors import UserError
from openjax.flights.case import load_case, read_folder
from openjax.flights.csv_table import write_csv
from openjax.flights.manoeuvres import references
from openjax.flights.reading import LogTable
from openjax.flights.samples import fly, log_of
from openjax.gap.trims import change_between, compare, read
from openjax.gap.trims.days import spread_of_charge
from openjax.gap.trims.figures import PLACES, FlightFigures, mixer_of
from openjax.vehicle import load_vehicle
from openjax.vehicle.effects import EFFECTS

VEHICLE = load_vehicle()
CHANGES = {
    "same": {},
    "rotor": {"motor_imbalance": {"m1": 0.0, "m2": 0.0, "m3": -0.15, "m4": 0.0}},
    "heavier": {"mass": {"extra": 0.004}},
    "weight": {"mass": {"extra": 0.003}, "com_offset": {"x": 0.0, "y": 0.004}},
    **{e: {e: EFFECTS[e].card.sample} for e in ("motor_lag", "rate_gains")},
}


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Two folders of flights of the sample vehicle, and one per change."""
    root = tmp_path_factory.mktemp("flights")
    flown = [
        ("monday", {}, 1),
        ("tuesday", {}, 2),
        *((n, effects, 7) for n, effects in CHANGES.items()),
    ]
    for name, effects, seed in flown:
        (root / name).mkdir()
        for number, (flight, reference) in enumerate(references(seed=seed, duration=8.0).items()):
            columns = fly(VEHICLE, VEHICLE, reference, 10 * seed + number, effects)
            write_csv(root / name / f"{flight}.csv.gz", log_of(columns, flight))
    return root


@functools.cache
def figures_in(folder):
    return read(read_folder(folder))


@functools.cache
def compared(folders, name):
    case, new, _ = figures_in(folders / name)
    old = [f for day in ("monday", "tuesday") for f in figures_in(folders / day)[1]]
    return change_between(name, new, old, case)


def test_the_same_vehicle_has_not_changed(folders):
    change = compared(folders, "same")
    assert not change.changed and change.effects == () and change.days == 2
    assert "No change" in change.in_words()[0]


def test_a_weak_rotor_is_found_with_its_size(folders):
    change = compared(folders, "rotor")
    assert change.changed and change.rotors == (3,) and change.effects[0] == "motor_imbalance"
    assert change.size.low < 0.15 < change.size.high and abs(change.size.value - 0.15) < 0.03


def test_a_heavier_vehicle_blames_no_rotor(folders):
    change = compared(folders, "heavier")
    assert change.changed and change.rotors == (1, 2, 3, 4) and "mass" in change.effects
    share = 4 * 0.004 / float(VEHICLE.mass)  # of one rotor's load
    assert change.size.low < share < change.size.high


def test_a_weight_at_a_side_names_the_side_and_what_it_cannot_be_told_from(folders):
    change = compared(folders, "weight")
    assert change.changed and change.side == "left" and change.rotors == (3, 4)
    assert {"motor_imbalance", "mass"} <= set(change.effects)


@pytest.mark.parametrize("effect", ["motor_lag", "rate_gains"])
def test_what_moves_no_trim_is_named_alone(folders, effect):
    """Gains by this alone: in hover and gentle turns no diagnosis judges them."""
    change = compared(folders, effect)
    assert change.changed and change.effects == (effect,) and not change.trims_changed
    assert change.prediction()["rotors"] == []


def with_columns(folder, into, kept):
    """The flights of a folder with motors and, if they are to be `kept`, position (x),
    gyroscope and accelerometer (w).
    """
    into.mkdir()
    for flight in load_case(folder, comparison=True).flights:
        columns = {"t": flight.time} | {f"m{i + 1}": flight.motor_command[:, i] for i in range(4)}
        if "x" in kept:
            columns |= dict(zip("xyz", flight.position.T, strict=True))
        if "w" in kept:
            columns |= {f"w{a}": v for a, v in zip("xyz", flight.body_rates.T, strict=True)}
            columns |= {f"a{a}": v for a, v in zip("xyz", flight.specific_force.T, strict=True)}
        log = LogTable(flight.log, columns, np.full(len(flight), "0"))
        write_csv(into / flight.log, log)


@pytest.mark.parametrize("kept", ["m", "mx", "mw"])
def test_poor_logs_tell_as_much_about_trims(folders, tmp_path, kept):
    """Motors alone, position without attitude, sensors without a pose: no gyroscope or
    orientation is needed.
    """
    for name in ("monday", "rotor"):
        with_columns(folders / name, tmp_path / name, kept)
    change = compare(read_folder(tmp_path / "rotor"), [read_folder(tmp_path / "monday")])
    assert change.changed and change.rotors == (3,)


# Trims by hand: what a rotor's factor does to them, with days that differ as real ones
# do.


@pytest.fixture(scope="module")
def case(folders):
    return load_case(folders / "monday", comparison=True)


def test_a_folder_of_several_vehicles_is_refused(case, tmp_path):
    for number, flight in enumerate(case.flights):
        columns = {"t": flight.time} | {f"m{i + 1}": flight.motor_command[:, i] for i in range(4)}
        vehicle = np.full(len(flight), str(number % 2))
        write_csv(tmp_path / flight.log, LogTable(flight.log, columns, vehicle))
    with pytest.raises(UserError, match="several vehicles"):
        compare(read_folder(tmp_path), [read_folder(tmp_path)])


def trims(day, factors=(1, 1, 1, 1), offset=(0, 0, 0, 0), seed=0, flights=3):
    rng = np.random.default_rng(seed)
    mixer = mixer_of(VEHICLE)
    level = np.linalg.solve(mixer, np.r_[1.0, np.asarray(offset, float)[1:]])
    out = []
    for k in range(flights):
        mixed = mixer @ (level * factors)
        value = np.r_[
            0.6 * mixed[0] * (1 + offset[0]), mixed[1:] / mixed[0]
        ] + 0.001 * rng.standard_normal(4)
        names = ("hover", "roll", "pitch", "yaw")
        out.append(
            FlightFigures(
                f"{day}{k}",
                day,
                {n: (float(v), 0.001) for n, v in zip(names, value, strict=True)},
                None,
            )
        )
    return out


def test_the_spread_of_days_is_learnt_and_hides_what_is_smaller(case):
    wild = [
        f
        for k, roll in enumerate((-0.05, 0.0, 0.05))
        for f in trims(f"d{k}", offset=(0, roll, 0, 0), seed=k)
    ]
    calm = [f for k in range(8) for f in trims(f"d{k}", seed=k)]
    new = trims("new", factors=(1, 1, 1.095, 1), seed=9)
    in_wild = change_between("new", new, wild, case)
    in_calm = change_between("new", new, calm, case)
    assert in_wild.spread["roll"] > 2 * in_calm.spread["roll"]
    assert in_calm.changed and in_calm.rotors == (3,)
    assert not in_wild.changed and in_wild.least > in_calm.least


def test_sizes_grow_with_the_change_and_intervals_hold_it(case):
    old = [f for k in range(3) for f in trims(f"d{k}", offset=(0, 0.01 * k, 0, 0), seed=k)]
    sizes = []
    for rise in (0.05, 0.1, 0.2, 0.3):
        change = change_between("new", trims("new", factors=(1, 1 + rise, 1, 1), seed=5), old, case)
        sizes.append(change.size.value)
        assert change.size.low < rise / (1 + rise) < change.size.high
    assert sizes == sorted(sizes) and change.rotors == (2,)


def test_two_rotors_of_a_side_are_a_class_with_a_weight_there(case):
    old = [f for k in range(3) for f in trims(f"d{k}", seed=k)]
    change = change_between("new", trims("new", factors=(1.15, 1.15, 1, 1), seed=5), old, case)
    assert change.changed and change.rotors == (1, 2) and change.side == "right"
    assert {"motor_imbalance", "com_offset"} <= set(change.effects)
    chances = change.prediction()["probabilities"]
    assert sum(chances.values()) == pytest.approx(1.0, abs=1e-3)


def test_rotors_are_counted_as_logged(case, folders, tmp_path):
    """A vehicle file that names the motors in another order moves the answer with
    it.
    """
    order = '["rear_left", "front_left", "front_right", "rear_right"]'
    for name in ("monday", "rotor"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "vehicle.toml").write_text(f"[motor]\norder = {order}\n")
        for flight in load_case(folders / name, comparison=True).flights:
            columns = {"t": flight.time} | {
                f"m{i + 1}": flight.motor_command[:, (i + 2) % 4] for i in range(4)
            }
            write_csv(
                tmp_path / name / flight.log,
                LogTable(flight.log, columns, np.full(len(flight), "0")),
            )
    change = compare(read_folder(tmp_path / "rotor"), [read_folder(tmp_path / "monday")])
    assert change.rotors == (1,) and change.side == "rear left"


def test_flights_are_no_reference_of_their_own(folders, tmp_path):
    """They would be found unchanged, whatever changed."""
    monday = str(folders / "monday")
    with pytest.raises(UserError, match="is the case itself"):
        main([monday, "--reference", monday, "--out", str(tmp_path / "out")])


def test_motors_alone_get_the_same_report_and_are_told_why_it_is_no_diagnosis(
    folders, tmp_path, capsys
):
    for name in ("monday", "rotor"):
        with_columns(folders / name, tmp_path / name, "m")
    # one of three flights could be diagnosed: it isn't asked alone
    (tmp_path / "rotor" / "vehicle.toml").touch()
    shutil.copy(next((folders / "rotor").glob("*.csv.gz")), tmp_path / "rotor")
    (tmp_path / "empty").mkdir()
    out = tmp_path / "out"
    answers = tmp_path / "answers.json"
    status = main([
        str(tmp_path / "rotor"), str(tmp_path / "empty"), "--reference", str(tmp_path / "monday"),
        "--out", str(out), "--predictions", str(answers),
    ])  # fmt: skip
    assert status == 0
    written = json.loads((out / "rotor" / "report.json").read_text())
    assert written["changed"] and written["rotors"] == [3]
    assert json.loads(answers.read_text())["rotor"]["rotors"] == [3]
    page = (out / "rotor" / "report.html").read_text()
    assert "<svg" in page and "src=" not in page and "1 of 3 flights holds more" in page
    assert "holds no flight log" in capsys.readouterr().err and not (out / "empty").exists()


def test_a_misspelt_effect_is_no_reason_to_compare_trims_alone(folders, tmp_path):
    with pytest.raises(UserError, match="did you mean rotor_drag"):
        main([
            str(folders / "rotor"), "--reference", str(folders / "monday"),
            "--out", str(tmp_path / "out"), "--without", "rotordrag",
        ])  # fmt: skip


def test_a_battery_that_nobody_logged_hides_a_tenth_of_hover():
    def spread(voltage, duty):
        return spread_of_charge([FlightFigures("a", "monday", {}, voltage, duty)])

    silent = spread(None, True)
    assert silent[PLACES["hover"]] == pytest.approx(0.1, abs=0.02)
    assert silent[PLACES["roll"]] == 0.0
    assert not spread(3.7, True).any() and not spread(None, False).any()
