"""Logs as spreadsheets, loops in C and tired people leave them: read as what they hold,
or refused in one line.
"""

import gzip

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from openjax.errors import UserError
from openjax.flights.case import load_case
from openjax.flights.csv_table import read_csv, write_csv
from openjax.flights.grid import tracks_of
from openjax.flights.importers import find_logs, load_mapping, read_log
from openjax.flights.samples import log_of


def quoted(text):
    lines = [",".join(f'"{cell}"' for cell in line.split(",")) for line in text.splitlines()]
    return ("\ufeff" + "\r\n".join(lines)).encode()


def with_units(text):
    head, _, rows = text.partition("\n")
    units = ",".join("s" if name == "t" else "m/s2" for name in head.split(","))
    return f"{head}\n{units}\n{rows}"


def ended(text, ends_in=","):
    head, *rows = text.splitlines()
    return "\n".join([head, *(row + ends_in for row in rows)])


AROUND = {
    "semicolons, decimal commas": lambda t: t.replace(",", ";").replace(".", ","),
    "UTF-32": lambda t: t.encode("utf-32"),
    "tabs in UTF-16": lambda t: t.replace(",", "\t").encode("utf-16"),
    "a byte order mark and quotes": quoted,
    "bars": lambda t: t.replace(",", "|"),
    "comments": lambda t: "# Monday, hall 3\n\n# 100 Hz\n" + t,
    "a header as numpy.savetxt writes it": lambda t: "# " + t,
    "Excel's line": lambda t: "sep=;\r\n" + t.replace(",", ";"),
    "units": with_units,
    "a comma at the end of each row": ended,
    "two carriage returns": lambda t: t.replace("\n", "\r\r\n"),
    "packed": lambda t: gzip.compress(t.encode()),
}


@pytest.mark.parametrize("name", ["flight.csv", "flight.csv.gz", "FLIGHT.CSV"])
@pytest.mark.parametrize("around", AROUND)
def test_what_stands_around_a_table_changes_nothing(tmp_path, text, around, name):
    (tmp_path / "plain.csv").write_text(text)
    plain = read_csv(tmp_path / "plain.csv")
    data = AROUND[around](text)
    folder = tmp_path / "case"
    folder.mkdir()
    (folder / name).write_bytes(data if isinstance(data, bytes) else data.encode())
    assert find_logs(folder) == [folder / name]
    read = read_log(folder / name)
    assert read.columns.keys() == plain.columns.keys()
    for column, values in plain.columns.items():
        np.testing.assert_array_equal(read.columns[column], values, err_msg=column)
    assert [r for r in read.remarks if "line 2 holds words" not in r] == []


@pytest.mark.parametrize("code", ["utf-8", "latin-1"])
def test_units_in_the_header_are_read(tmp_path, sample_columns, code):
    """In other units than the format's, and however they are written and saved."""
    columns = sample_columns["flight_a"]
    units = {"t": "ms", "x": "mm", "wx": "°/s", "az": "m/s²", "qw": "-", "vbat": "mV", "m1": "%"}
    sizes = {"t": 1e3, "x": 1e3, "wx": np.degrees(1.0), "vbat": 1e3, "m1": 100.0}
    named = {
        f"{name} [{units[name]}]" if name in units else name: sizes.get(name, 1.0) * values
        for name, values in columns.items()
    }
    path = tmp_path / "flight.csv"
    rows = np.stack(list(named.values()), 1)
    np.savetxt(path, rows, delimiter=",", header=",".join(named), comments="", encoding=code)
    read = read_log(path)
    for name, values in columns.items():
        np.testing.assert_allclose(read.columns[name], values, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(
    "named",
    ['m1 = "u1 [PWM]"', 'm1 = "u1"', 'm1 = "u1"\nx = "x"\nvx = { from = "vx", unit = "mm/s" }'],
)
def test_units_in_the_header_count_beside_a_columns_toml(tmp_path, sample_columns, named):
    """Of columns that it doesn't list, and of those that it lists without a unit."""
    columns = sample_columns["flight_a"]
    units = {"t": ("ms", 1e3), "x": ("mm", 1e3), "vx": ("mm/s", 1e3), "m1": ("PWM", 1.0)}
    table = {}
    for name, values in columns.items():
        unit, size = units.get(name, ("", 1.0))
        table[f"{'u1' if name == 'm1' else name} [{unit}]" if unit else name] = size * values
    path = tmp_path / "flight.csv"
    np.savetxt(
        path, np.stack(list(table.values()), 1), delimiter=",", header=",".join(table), comments=""
    )
    (tmp_path / "columns.toml").write_text(f"[columns]\n{named}\n")
    read = read_log(path, load_mapping(tmp_path / "columns.toml"))
    for name, values in columns.items():
        np.testing.assert_allclose(read.columns[name], values, rtol=1e-9, atol=1e-12, err_msg=name)


def test_what_an_unknown_unit_holds_is_left_out_and_named(tmp_path, text):
    (tmp_path / "flight.csv").write_text(text.replace("vbat", "vbat [furlong]"))
    read = read_log(tmp_path / "flight.csv")
    assert "vbat" not in read.columns and "vbat [furlong]" in read.remarks[0]


def case_of(folder, text):
    (folder / "vehicle.toml").write_text("")
    (folder / "flight.csv").write_text(text)
    return load_case(folder)


def test_rows_in_any_order_and_written_twice_are_one_flight(tmp_path, text):
    head, *rows = text.splitlines()
    twice = [*rows, *rows[100:200]]
    np.random.default_rng(1).shuffle(twice)
    (flight,) = case_of(tmp_path, "\n".join([head, *twice])).flights
    (plain,) = case_of(tmp_path, text).flights
    np.testing.assert_array_equal(flight.time, plain.time)
    np.testing.assert_array_equal(flight.motor_command, plain.motor_command)


@pytest.mark.parametrize("later", [0.0, 0.003, 3600.0])
def test_two_recordings_in_one_file_are_none(tmp_path, text, later):
    head, *rows = text.splitlines()
    times, values = zip(*(row.split(",", 1) for row in rows), strict=True)
    values = values[200:] + values[:200]
    first = [f"{float(t) + later:.3f},{v}" for t, v in zip(times, values, strict=True)]
    with pytest.raises(UserError, match="several recordings in one file"):
        case_of(tmp_path, "\n".join([head, *first, *rows[50:350]]))


def test_a_hole_in_every_channel_contradicts_nothing(tmp_path, sample_columns):
    """A line drawn over it does: a velocity that wasn't measured leads nowhere."""
    columns = {name: values.copy() for name, values in sample_columns["flight_a"].items()}
    for name, values in columns.items():
        if name != "t":
            values[250:430] = np.nan
    write_csv(tmp_path / "flight.csv", log_of([columns], "flight"))
    (tmp_path / "vehicle.toml").write_text("")
    case = load_case(tmp_path)
    assert len(case.flights) == 1
    (hole,) = [issue.issue for issue in case.quality if issue.kind == "gaps"]
    assert "not sampled for 1.8" in hole


def test_poses_of_a_camera_that_lost_the_body_are_not_sampled(tmp_path, sample_columns):
    columns = {name: values.copy() for name, values in sample_columns["flight_a"].items()}
    lost = np.arange(len(columns["t"])) // 37 % 4 == 2
    for name in ("x", "y", "z", "qw", "qx", "qy", "qz"):
        columns[name][lost] = 0.0
    write_csv(tmp_path / "flight.csv", log_of([columns], "flight"))
    (tmp_path / "vehicle.toml").write_text("")
    (flight,) = load_case(tmp_path).flights
    assert np.isnan(flight.position[:, 0]).sum() >= lost.sum() - 40
    assert np.nanmin(flight.position[:, 2]) > 0.05


def test_a_mark_in_place_of_a_position_is_not_sampled(tmp_path, sample_columns):
    columns = {name: values.copy() for name, values in sample_columns["flight_a"].items()}
    lost = np.arange(len(columns["t"])) // 37 % 4 == 2
    for name in ("x", "y", "z"):
        columns[name][lost] = -999.0
    write_csv(tmp_path / "flight.csv", log_of([columns], "flight"))
    (tmp_path / "vehicle.toml").write_text("")
    case = load_case(tmp_path)
    assert f"{lost.sum()} rows whose x, y, z all are -999" in case.quality[0].issue
    assert np.nanmin(case.flights[0].position) > -2.0


def test_a_vehicle_that_is_in_no_log_is_said_and_a_hidden_file_is_none(tmp_path, text):
    case_of(tmp_path, text)
    (tmp_path / "._flight.csv").write_bytes(b"\0\5\26\7" + bytes(100))
    (tmp_path / "vehicle.toml").write_text("[vehicles.cf01]\nmass = 0.04\n")
    (issue,) = load_case(tmp_path).quality
    assert issue.issue == "[vehicles.cf01]: no log is of such a vehicle; they are of 0"


def test_a_folder_without_a_log_says_what_is_in_it(tmp_path):
    (tmp_path / "vehicle.toml").write_text("")
    (tmp_path / "flight.txt").write_text("t,wx\n")
    with pytest.raises(
        UserError, match=r"PX4 ULog, .* CSV of the log format; it holds flight\.txt"
    ):
        load_case(tmp_path)
    (tmp_path / "flight.csv").write_bytes(b"PK\x03\x04" + bytes(100))
    with pytest.raises(UserError, match="is a zip archive or a spreadsheet"):
        load_case(tmp_path)


def write_case(folder, columns):
    write_csv(folder / "flight.csv", log_of([columns], "flight"))
    (folder / "vehicle.toml").write_text("")


def changed(sample_columns, change):
    """The columns of a sample flight, some of them changed."""
    columns = sample_columns["flight_a"]
    return columns | change(columns)


def test_no_line_is_drawn_over_a_hole_in_the_motors(tmp_path, sample_columns):
    hole = slice(300, 420)

    def without_motors(columns):
        motors = {f"m{i}": columns[f"m{i}"].copy() for i in (1, 2, 3, 4)}
        for values in motors.values():
            values[hole] = np.nan
        return motors

    columns = changed(sample_columns, without_motors)
    write_case(tmp_path, columns)
    first, second = tracks_of(load_case(tmp_path))
    assert first.time[-1] < columns["t"][hole.start] <= columns["t"][hole.stop] <= second.time[0]


def test_an_attitude_of_half_the_angles_is_refused(tmp_path, sample_columns):
    """As where parts of a quaternion are taken for angles."""

    def halved(columns):
        attitude = Rotation.from_quat(
            np.stack([columns[f"q{a}"] for a in "wxyz"], 1), scalar_first=True
        )
        half = Rotation.from_rotvec(0.5 * attitude.as_rotvec()).as_quat(scalar_first=True)
        return dict(zip(("qw", "qx", "qy", "qz"), half.T, strict=True))

    write_case(tmp_path, changed(sample_columns, halved))
    with pytest.raises(UserError, match="wx, wy, wz are 2 times the attitude's rate"):
        load_case(tmp_path)


@pytest.mark.parametrize("share, words", [(0.02, "not sampled there"), (0.2, "left out")])
def test_a_gyroscope_at_its_end_reads_nothing_there(tmp_path, sample_columns, share, words):
    def clipped(columns):
        rates = {name: columns[name] for name in ("wx", "wy", "wz")}
        most = np.quantile(np.abs(np.stack(list(rates.values()))).max(0), 1 - share)
        return {name: np.clip(values, -most, most) for name, values in rates.items()}

    write_case(tmp_path, changed(sample_columns, clipped))
    case = load_case(tmp_path)
    (end,) = [i.issue for i in case.quality if "the sensor's end" in i.issue]
    assert end.startswith("w") and end.endswith(words)
    assert case.flights[0].body_rates_derived == (words == "left out")


@pytest.mark.parametrize("step", [0.02, 0.1, 0.4])
def test_a_coarse_gyroscope_at_the_peaks_of_a_motion_is_not_at_its_end(
    tmp_path, sample_columns, step
):
    def coarse(columns):
        return {n: np.round(columns[n] / step) * step for n in ("wx", "wy", "wz")}

    for name in ("flight_a", "flight_b", "flight_c"):
        write_case(tmp_path, sample_columns[name] | coarse(sample_columns[name]))
        try:
            issues = [issue.issue for issue in load_case(tmp_path).quality]
        except UserError as error:  # too coarse to agree with anything
            issues = [str(error)]
        assert not any("the sensor's end" in issue for issue in issues)


def test_a_table_of_rows_that_repeat_is_the_flight_without_them(tmp_path, sample_columns):
    """As a logger at 1 kHz leaves it of a vehicle that tells something a hundred times
    a second.
    """
    columns = sample_columns["flight_c"]
    repeated = {name: np.repeat(values, 10) for name, values in columns.items()}
    write_case(tmp_path, repeated | {"t": 0.001 * np.arange(len(repeated["t"]))})
    case = load_case(tmp_path)
    (flight,) = case.flights
    write_case(tmp_path, columns)
    (plain,) = load_case(tmp_path).flights
    for channel in ("time", "position", "body_rates", "motor_command"):
        np.testing.assert_allclose(getattr(flight, channel), getattr(plain, channel), atol=1e-6)
    assert "90% of the rows repeat the one before" in case.quality[0].issue


def test_a_long_stand_before_the_flight_is_no_frozen_sensor(tmp_path, sample_columns):
    """Where a simulator or an estimator stands still to the last digit."""
    columns = sample_columns["flight_a"]
    rest = {n: np.full(2000, np.nan if n == "vbat" else 0.0) for n in columns}
    rest |= {"t": 0.01 * np.arange(2000), "qw": np.ones(2000)}
    moved = columns | {"t": columns["t"] + 20.0}
    write_case(tmp_path, {n: np.concatenate([rest[n], moved[n]]) for n in columns})
    case = load_case(tmp_path)
    assert len(case.flights[0]) > 0.9 * len(columns["t"])
    assert "20.0 s with motors at rest are cut away" in [i.issue for i in case.quality]


def test_a_separator_that_columns_toml_has_wrong_is_said(tmp_path, text):
    (tmp_path / "columns.toml").write_text('delimiter = ","\n[columns]\nt = "t"\n')
    with pytest.raises(UserError, match=r"separated by ';', and columns\.toml says ','"):
        case_of(tmp_path, text.replace(",", ";"))
