"""Vehicles of one flight in files of their own, and what their motors' columns are."""

import numpy as np
import pytest

from openjax.errors import UserError
from openjax.flights.case import load_case
from openjax.flights.csv_table import write_csv
from openjax.flights.samples import log_of
from tests.flights.test_foreign_formats import client_table, write_table

LATER = 0.5  # s by which the second vehicle's log begins later


@pytest.fixture
def two(sample_columns):
    """Columns of two vehicles that fly one above the other; the second's log begins later."""
    lower = sample_columns["flight_c"]
    noise = 1e-3 * np.random.default_rng(0).standard_normal(len(lower["t"]))
    upper = lower | {"z": lower["z"] + 0.4, "wx": lower["wx"] + noise}
    rows = lower["t"] >= LATER
    return lower, {name: values[rows] for name, values in upper.items()}


def case_of(folder, names, tables, stamp=0.0, toml=""):
    (folder / "vehicle.toml").write_text(toml)
    for name, columns in zip(names, tables, strict=True):
        stamped = columns | {"t": columns["t"] + stamp}
        write_csv(folder / name, log_of([stamped], name))
    return load_case(folder)


@pytest.mark.parametrize(
    "names", [("a_cf0.csv", "a_cf1.csv"), ("Drone-3 a.csv.gz", "Drone-4 a.csv")]
)
def test_files_whose_names_differ_by_an_id_are_one_flight(tmp_path, two, names):
    case = case_of(tmp_path, names, two, toml="[vehicles.cf1]\nmass = 0.035\n")
    first, second = case.flights
    assert case.others(first) == (second,) and case.others(second) == (first,)
    assert second.time[0] - first.time[0] == pytest.approx(LATER, abs=0.02)
    if "cf1" in names[1]:
        assert float(case.vehicle_of(second).mass) == pytest.approx(0.035)
    (issue,) = [i for i in case.quality if i.kind == "vehicles"]
    assert "one flight of" in issue.issue and names[0] in issue.flight


def test_stamps_of_one_computer_say_who_flew_together(tmp_path, two):
    """Whatever flights are called, and wherever each log's own time is put."""
    (tmp_path / "columns.toml").write_text('[columns]\nt = "t"\n')
    lower, upper = two
    names = ("cf0_log03.csv", "cf1_log07.csv", "cf1_log08.csv")
    tables = (lower, upper, upper | {"t": upper["t"] + 100.0, "x": upper["x"] + 0.1})
    case = case_of(tmp_path, names, tables, stamp=1.7e9)
    first, second, alone = case.flights
    assert case.others(first) == (second,) and case.others(alone) == ()
    assert second.time[0] - first.time[0] == pytest.approx(LATER, abs=0.02)


@pytest.mark.parametrize(
    "names", [("a.csv", "b.csv"), ("cf0_1.csv", "cf1_2.csv"), ("cf0_1.csv", "cf0_2.csv")]
)
def test_other_files_are_flights_of_their_own(tmp_path, two, names):
    case = case_of(tmp_path, names, two)
    assert [case.others(f) for f in case.flights] == [(), ()] and case.quality == ()


def test_clocks_of_each_vehicle_are_told_not_joined(tmp_path, two):
    (tmp_path / "vehicle.toml").write_text("")
    for name, columns, begin in zip(("a_cf0", "a_cf1"), two, (81234, 9000), strict=True):
        write_table(tmp_path / f"{name}.csv", client_table(columns, begin))
    case = load_case(tmp_path)
    assert [case.others(f) for f in case.flights] == [(), ()]
    (issue,) = [i for i in case.quality if i.kind == "vehicles"]
    assert "a_cf0.csv, a_cf1.csv" == issue.flight and "one file with a column" in issue.issue


@pytest.mark.parametrize(
    "toml, command", [("", "pwm"), ('[motor]\ncommand = "thrust"\n', "thrust")]
)
def test_motors_of_the_firmwares_logs_are_duty_cycles(tmp_path, two, toml, command):
    write_table(tmp_path / "log.csv", client_table(two[0]))
    (tmp_path / "vehicle.toml").write_text(toml)
    case = load_case(tmp_path)
    assert case.vehicle_file.motor.command == command
    assert [i.kind for i in case.quality if i.kind == "motors"] == ["motors"] * (command == "pwm")
    # shares of the thrust beside them: what isn't said can't be both
    if not toml:
        case = case_of(tmp_path, ("other.csv",), two[:1])
        assert case.vehicle_file.motor.command == "thrust"
        assert [(i.flight, i.kind) for i in case.left_out()] == [("log.csv", "motors")]


def test_a_log_of_the_format_holds_shares_of_the_thrust(tmp_path, two):
    assert case_of(tmp_path, ("a.csv",), two[:1]).vehicle_file.motor.command == "thrust"
    with pytest.raises(UserError, match=r"motor\.command"):
        case_of(tmp_path, ("a.csv",), two[:1], toml='[motor]\ncommand = "percent"\n')
