"""Checks of logs: every planted fault is found and named, a good flight is left alone,
one bad log spares the rest.
"""

import numpy as np
import pytest

from openjax.errors import UserError
from openjax.flights import sampling
from openjax.flights.case import load_case
from openjax.flights.checks import check_flight
from openjax.flights.csv_table import write_csv
from openjax.flights.reading import LogTable, flights_of
from openjax.flights.samples import log_of
from openjax.vehicle import load_vehicle

VEHICLE = load_vehicle()


def check(columns, **log):
    (flight,), _ = flights_of(LogTable("flight.csv", columns, np.full(len(columns["t"]), "0")))
    return check_flight(flight, VEHICLE, log)


def scaled(names, factor):
    return lambda c: c | {n: c[n] * factor for n in names.split()}


def renamed(names, sources):
    return lambda c: c | {n: c[s] for n, s in zip(names.split(), sources.split(), strict=True)}


def without(*names):
    return lambda c: {k: v for k, v in c.items() if k not in names}


def frozen(name):
    def plant(c):
        return c | {name: np.full(len(c["t"]), c[name][0])}

    return plant


RADIANS = 180 / np.pi
REFUSED = {
    "gyroscope in degrees": (scaled("wx wy wz", RADIANS), "units", "deg/s"),
    "commands in degrees": (
        scaled("cmd_wx cmd_wy cmd_wz", RADIANS),
        "units",
        "cmd_wx, cmd_wy, cmd_wz: in deg/s",
    ),
    "accelerometer in g": (scaled("ax ay az", 1 / 9.81), "units", "are in g"),
    "position in mm": (scaled("x y z", 1000), "units", "mm"),
    "velocity in mm/s": (scaled("vx vy vz", 1000), "units", "vx, vy, vz: in mm/s"),
    "time in ms": (scaled("t", 1000), "units", "t is in milliseconds"),
    "motors in counts": (scaled("m1 m2 m3 m4", 65535), "units", "16-bit counts"),
    "thrust command in counts": (scaled("cmd_thrust", 65535), "units", "cmd_thrust"),
    "battery in mV": (scaled("vbat", 1000), "units", "mV"),
    "gyroscope axes swapped": (renamed("wx wy", "wy wx"), "axes", "wx holds y"),
    "gyroscope axis reversed": (scaled("wz", -1), "axes", "wz holds minus z"),
    "accelerometer upside down": (scaled("az", -1), "axes", "accelerometer"),
    "accelerometer axes swapped": (renamed("ay az", "az ay"), "axes", "ay holds z"),
    "position axes swapped": (
        renamed("x y vx vy", "y x vy vx"),
        "axes",
        "position axes: x holds y",
    ),
    "command reversed": (scaled("cmd_wy", -1), "axes", "cmd_wy holds minus y"),
    "quaternion xyzw": (
        renamed("qw qx qy qz", "qx qy qz qw"),
        "quaternion",
        "in the order x, y, z, w",
    ),
    "quaternion world to body": (scaled("qx qy qz", -1), "quaternion", "from world to body"),
    "quaternion not unit": (scaled("qw qx qy qz", 0.5), "quaternion", "aren't unit"),
    "motor order": (renamed("m1 m2 m3 m4", "m2 m3 m4 m1"), "motors", "m1 rear_right"),
    "two motors swapped": (renamed("m1 m2", "m2 m1"), "motors", "motor order"),
    "x at zero": (scaled("x", 0.0), "corrupt", "x: the same value 0 in every row"),
    "z at one": (lambda c: c | {"z": 0 * c["z"] + 1}, "corrupt", "z: the same value 1"),
    "vy at zero": (scaled("vy", 0.0), "corrupt", "vy: the same value"),
    "z negated": (scaled("z", -1.0), "axes", "below the floor at 0: z points up"),
    "dead gyroscope axis": (frozen("wy"), "corrupt", "wy: the same value"),
    "motor column corrupt": (
        lambda c: c | {"m2": c["m2"] - 1.0},
        "corrupt",
        "commands lie in 0..1",
    ),
    "two recordings in one file": (lambda c: c | {"t": c["t"] % 4.0}, "time", "runs backwards"),
    "frozen clock": (
        lambda c: c | {"t": np.round(c["t"] / 0.05) * 0.05},
        "time",
        "repeat the time",
    ),
    "no commands": (without("m1", "m2", "m3", "m4", "cmd_thrust"), "columns", "no commands"),
    "no state": (without("x", "wx"), "columns", "needs position and orientation"),
    "too short": (lambda c: {k: v[:150] for k, v in c.items()}, "short", "at least 2 s"),
    "never took off": (scaled("m1 m2 m3 m4 cmd_thrust", 0.0), "corrupt", "same value"),
}


@pytest.mark.parametrize("fault", REFUSED)
def test_a_planted_fault_is_refused_with_its_name(fault, sample_columns):
    plant, kind, words = REFUSED[fault]
    kept, issues = check(plant(sample_columns["flight_c"]))
    assert kept is None
    refusals = [i for i in issues if i.refused]
    assert [i.kind for i in refusals][:1] == [kind] and words in " ".join(i.issue for i in refusals)


def test_good_flights_pass_without_a_word(sample_columns):
    for name, columns in sample_columns.items():
        kept, issues = check(columns)
        assert issues == [] and len(kept) == len(columns["t"]), name


@pytest.mark.parametrize(
    "drop",
    [
        ("m1", "m2", "m3", "m4"),
        ("cmd_thrust", "cmd_wx", "cmd_wy", "cmd_wz"),
        ("x", "y", "z", "qw", "qx", "qy", "qz", "vx", "vy", "vz"),
        ("wx", "wy", "wz", "ax", "ay", "az"),
        ("vbat",),
    ],
)
def test_flights_with_the_least_that_is_needed_pass(drop, sample_columns):
    kept, issues = check(without(*drop)(sample_columns["flight_b"]))
    assert kept is not None and all("derived from the attitude" in i.issue for i in issues)


def test_body_rates_come_from_the_attitude_where_no_gyroscope_was_logged(sample_columns):
    columns = sample_columns["flight_b"]
    kept, (issue,) = check(without("wx", "wy", "wz", "ax", "ay", "az")(columns))
    assert kept.body_rates_derived and issue.kind == "columns"
    logged = np.stack([columns["wx"], columns["wy"], columns["wz"]], 1)
    wrong = kept.body_rates[10:-10] - logged[10:-10]
    assert np.sqrt(np.mean(wrong**2)) < 0.2 * logged.std()


def test_motors_alone_are_enough_for_a_comparison(sample_columns):
    columns = sample_columns["flight_b"]
    motors = {k: columns[k] for k in ("t", "m1", "m2", "m3", "m4")}
    # two stretches in the air with the ground between: both are kept
    motors = {
        k: np.where(k == "t" or abs(columns["t"] - 4.0) > 0.5, v, 0.0) for k, v in motors.items()
    }
    motors["t"] = columns["t"]
    (flight,), _ = flights_of(LogTable("flight.csv", motors, np.full(len(columns["t"]), "0")))
    assert check_flight(flight, VEHICLE)[0] is None
    kept, _ = check_flight(flight, VEHICLE, comparison=True)
    assert kept.duration > 7.0 and len(kept.stretches()) == 2


@pytest.mark.parametrize("rate", [50, 1000])
def test_other_row_rates_pass(rate, sample_columns):
    columns = sample_columns["flight_c"]
    at = np.arange(0.0, columns["t"][-1], 1 / rate)
    resampled = {k: np.interp(at, columns["t"], v) for k, v in columns.items() if k != "vbat"} | {
        "t": at
    }
    kept, issues = check(resampled)
    assert issues == [] and kept.row_period == pytest.approx(1 / rate)


def test_velocity_is_derived_where_it_is_missing(sample_columns):
    columns = sample_columns["flight_b"]
    kept, issues = check(without("vx", "vy", "vz")(columns))
    assert kept.velocity_derived and [i.kind for i in issues] == ["columns"]
    logged = np.stack([columns["vx"], columns["vy"], columns["vz"]], 1)
    assert (
        np.sqrt(np.mean((kept.velocity - logged) ** 2)) < 0.02
    )  # m/s; the logged one has 0.005 of noise


def test_a_velocity_that_missing_rows_have_spoilt_is_taken_from_the_position(sample_columns):
    columns = {k: v for k, v in sample_columns["flight_b"].items()}
    position = np.stack([columns[n] for n in "xyz"], 1)
    kept = np.random.default_rng(0).random(len(position)) > 0.02
    half = 3
    step = columns["t"][1] - columns["t"][0]
    rows = np.flatnonzero(kept)
    ahead, behind = np.clip(
        [np.arange(len(rows)) + half, np.arange(len(rows)) - half], 0, len(rows) - 1
    )
    # as if all rows were a step apart
    spoilt = (position[rows[ahead]] - position[rows[behind]]) / (2 * half * step)
    true = np.stack([columns[n] for n in ("vx", "vy", "vz")], 1)[rows]
    columns = {k: v[rows] for k, v in columns.items()} | dict(
        zip(("vx", "vy", "vz"), spoilt.T, strict=True)
    )
    flight, issues = check(columns)
    inside = slice(half, -half)
    before, after = (np.sqrt(np.mean((v - true)[inside] ** 2)) for v in (spoilt, flight.velocity))
    assert any("velocity in" in i.issue for i in issues) and after < 0.6 * before


def test_slips_that_can_be_mended_are_mended_and_named(sample_columns):
    columns = {k: np.array(v) for k, v in sample_columns["flight_b"].items()}
    order = np.arange(len(columns["t"]))
    order[[100, 101]] = order[[101, 100]]
    columns = {k: v[order] for k, v in columns.items()}
    columns["x"][300:400] = columns["x"][300]
    columns["y"][300:400] = columns["y"][300]
    columns["z"][300:400] = columns["z"][300]
    keep = np.r_[0:500, 540 : len(order)]
    columns = {k: v[keep] for k, v in columns.items()}
    for part in ("qw", "qx", "qy", "qz"):
        # the same attitude: no fault, but no jump may be left
        columns[part][200:] *= -1
    kept, issues = check(columns)
    text = " | ".join(i.issue for i in issues)
    assert "1 rows out of order in time were sorted" in text
    assert "1 gap in time, the longest 0.41 s after t = 4.99" in text
    assert "x, y, z stand still for 1.0 s from t = 3.0" in text
    assert not any(i.refused for i in issues)
    assert np.isnan(kept.position[310]).all() and np.isfinite(kept.quaternion[310]).all()
    assert (np.diff(kept.time) > 0).all() and (np.abs(np.diff(kept.quaternion, axis=0)) < 0.2).all()
    assert [s.stop - s.start for s in kept.stretches()] == [500, len(kept) - 500]


def test_parts_on_the_ground_are_cut_away(sample_columns):
    columns = sample_columns["flight_b"]
    rest = {k: np.full(200, v[0]) for k, v in columns.items() if k != "vbat"}
    rest |= {m: np.zeros(200) for m in ("m1", "m2", "m3", "m4")} | {"z": np.full(200, 0.05)}
    rng = np.random.default_rng(0)
    rest = {
        k: v + (1e-5 * rng.standard_normal(200) if k[0] in "wavxyzq" else 0)
        for k, v in rest.items()
    }
    rest["t"] = np.arange(200) * 0.01
    joined = {k: np.r_[rest[k], columns[k]] for k in rest}
    joined["t"] = np.r_[rest["t"], 2.0 + columns["t"]]
    kept, issues = check(joined, floor_z=0.05)
    assert [i.kind for i in issues] == ["ground"]
    assert kept.time[0] == pytest.approx(2.0, abs=0.03) and len(kept) > 0.99 * len(columns["t"])


def test_one_bad_log_spares_the_others(case_folder, sample_columns):
    bad = scaled("ax ay az", 1 / 9.81)(sample_columns["flight_a"])
    write_csv(case_folder / "flight_a.csv.gz", log_of([bad], "a"))
    (case_folder / "flight_d.csv.gz").write_bytes((case_folder / "flight_c.csv.gz").read_bytes())
    (case_folder / "flight_e.csv").write_text("t,wx\n0,1\n0.01,two\n")
    case = load_case(case_folder)
    assert [f.name for f in case.flights] == ["flight_b.csv.gz", "flight_c.csv.gz"]
    reasons = {i.flight: i.kind for i in case.quality if i.refused}
    assert reasons == {
        "flight_a.csv.gz": "units",
        "flight_d.csv.gz": "duplicate",
        "flight_e.csv": "reading",
    }


def test_a_copy_with_another_clock_and_layout_is_a_duplicate(case_folder, sample_columns):
    shifted = sample_columns["flight_b"] | {"t": sample_columns["flight_b"]["t"] + 3.0}
    write_csv(case_folder / "flight_x.csv", log_of([shifted], "x"))
    case = load_case(case_folder)
    assert {i.flight: i.issue for i in case.quality} == {
        "flight_x.csv": "the same values as flight_b.csv.gz: a copy, left out"
    }


@pytest.mark.parametrize(
    ("prepare", "reason"),
    [
        (lambda f: [p.unlink() for p in f.glob("*.gz")], "holds no flight log"),
        (
            lambda f: [p.rename(f / "flight.json") for p in f.glob("*.gz")],
            "no game was flown; flight.json says why",
        ),
        (lambda f: (f / "vehicle.toml").unlink(), "an empty one"),
        (
            lambda f: (f / "vehicle.toml").write_text("[vehicle]\nmass = 0.321\n"),
            "motors lift 0.03. kg on the mean, and vehicle.mass is 0.32 kg",
        ),
        (
            lambda f: (f / "vehicle.toml").rename(f / "vehicle.toml.txt"),
            "if vehicle.toml.txt is meant, rename it",
        ),
        (
            lambda f: (f / "vehicle.toml").write_text("[motor]\ncomand = 'pwm'\n"),
            "unknown key 'comand'",
        ),
        (
            lambda f: [p.write_bytes(b"") for p in f.glob("*.gz")],
            r"no flight can be used: .* \(and 2 more\)",
        ),
    ],
)
def test_a_case_that_cannot_be_used_is_one_line(case_folder, prepare, reason):
    prepare(case_folder)
    with pytest.raises(UserError, match=reason) as caught:
        load_case(case_folder)
    assert "\n" not in str(caught.value)


def test_a_folder_of_cases_says_where_they_are(case_folder):
    with pytest.raises(UserError, match=rf"cases inside it: {case_folder.name} \(1 in all\)"):
        load_case(case_folder.parent)


def test_held_poses_of_a_slower_camera_are_moved_to_their_rows(sample_columns):
    columns = sample_columns["flight_a"]
    time = columns["t"] - columns["t"][0]
    # when the pose was taken that a row holds
    taken = np.floor(time * 55.0 + 1e-9) / 55.0
    pose = "x y z qw qx qy qz".split()
    kept = np.random.default_rng(0).random(len(time)) > 0.04
    held = {n: np.interp(taken, time, v) if n in pose else v for n, v in columns.items()}
    flight, _ = check({n: v[kept] for n, v in without("vx", "vy", "vz")(held).items()})
    truth, _ = check(columns)
    expected = truth.interpolated("velocity", flight.time)
    off = flight.interpolated("velocity") - expected
    assert off.std() < 0.05 * expected.std() and flight.pose_age == 0.0


def test_a_last_pose_moves_on_to_its_row():
    time = np.arange(0.0, 10.0, 0.02)
    moved = sampling._on_lines(time + 0.015, time, np.stack([3.0 * time, -time], 1))
    np.testing.assert_allclose(moved[:, 0], 3.0 * (time + 0.015), atol=1e-9)
