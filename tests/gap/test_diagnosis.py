"""The diagnosis on flights whose cause is known: the right name, honest parameters, and
honest refusals.
"""

import dataclasses
import gzip
import json
import shutil
import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from openjax.command_line import one_line
from openjax.commands import diagnose
from openjax.errors import UserError
from openjax.flights.case import load_case
from openjax.flights.csv_table import write_csv
from openjax.flights.kinematics import read_kinematics
from openjax.flights.manoeuvres import references
from openjax.flights.regimes import REGIMES
from openjax.flights.samples import fly, log_of
from openjax.gap import evidence
from openjax.gap.decision import DECISION
from openjax.gap.diagnosis import diagnose_case, not_testable
from openjax.gap.evidence import gather
from openjax.gap.model.library import library
from openjax.gap.report import VERDICTS
from openjax.gap.where import CHANNELS
from openjax.vehicle import load_vehicle
from openjax.vehicle.effects import EFFECTS, load_effects

pytestmark = pytest.mark.slow

VEHICLE = '[vehicle]\nmass = 0.0321\nmass_weighed = {weighed}\n\n[motor]\ncommand = "thrust"\n'
NOTHING = {
    "mass": {"extra": 0.0},
    "rotor_drag": {"d_xy": 0.0, "d_z": 0.0},
}  # one compiled flight for all cases
DRAG = {"d_xy": 0.015, "d_z": 0.006}


def _case(
    folder,
    effects,
    weighed=False,
    flights=("flight_a", "flight_b", "flight_c"),
    seed=3,
    logged=lambda c: c,
):
    """Fly and log a case; `flights` may repeat a reference, `logged` changes the
    columns {name: (T,)}.
    """
    vehicle = load_vehicle()
    found = references(seed=seed, duration=8.0)
    folder.mkdir(parents=True)
    (folder / "vehicle.toml").write_text(VEHICLE.format(weighed=str(weighed).lower()))
    for number, name in enumerate(flights):
        columns = fly(vehicle, vehicle, found[name], 10 * seed + number, NOTHING | effects)
        columns = [logged(c) for c in columns]
        write_csv(folder / f"flight_{number}.csv.gz", log_of(columns, f"flight_{number}"))
    return folder


def _held(columns):
    """The pose comes every 20 ms, and each other row repeats the last one."""
    pose = ("x", "y", "z", "qw", "qx", "qy", "qz", "vx", "vy", "vz")
    rows = np.arange(len(columns["t"])) // 2 * 2
    return {n: v[rows] if n in pose else v for n, v in columns.items()}


def _late(columns):
    """The pose is 4 ms older than its row says."""
    pose = ("x", "y", "z", "qw", "qx", "qy", "qz", "vx", "vy", "vz")
    t = columns["t"]
    return {n: np.interp(t - 0.004, t, v) if n in pose else v for n, v in columns.items()}


MOTORS = ("m1", "m2", "m3", "m4")


def _motors_late(rows):
    """Motor commands stand so many rows after they acted."""

    def logged(columns):
        place = np.maximum(np.arange(len(columns["t"])) - rows, 0)
        return {n: v[place] if n in MOTORS else v for n, v in columns.items()}

    return logged


def _without(*names):
    return lambda columns: {n: v for n, v in columns.items() if n not in names}


def _leaning(columns):
    """No position, in a world that leans by two degrees about x."""
    lean = Rotation.from_rotvec([np.radians(2.0), 0.0, 0.0])
    pose = np.stack([columns[n] for n in ("qw", "qx", "qy", "qz")], 1)
    turned = (lean * Rotation.from_quat(pose, scalar_first=True)).as_quat(scalar_first=True)
    velocity = lean.apply(np.stack([columns[n] for n in ("vx", "vy", "vz")], 1))
    both = np.concatenate([turned, velocity], 1).T
    names = ("qw", "qx", "qy", "qz", "vx", "vy", "vz")
    return _without("x", "y", "z")(columns) | dict(zip(names, both, strict=True))


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    root = tmp_path_factory.mktemp("cases")
    return {
        "none": _case(root / "none", {}),
        "drag": _case(root / "drag", {"rotor_drag": DRAG}),
        "late": _case(
            root / "late", {"rotor_drag": {n: 3.0 * v for n, v in DRAG.items()}}, logged=_late
        ),
        "mass": _case(root / "mass", {"mass": {"extra": 0.003}}),
        "weighed": _case(root / "weighed", {"thrust_scale": {"scale": -0.08}}, weighed=True),
        "held": _case(root / "held", {}, logged=_held),
    }


@pytest.fixture(scope="module")
def reports(folders):
    return {name: diagnose_case(load_case(folder)) for name, folder in folders.items()}


def test_a_pose_some_milliseconds_late_is_a_nuisance(reports):
    """Clocks of motion capture and vehicle may be apart by as much, whatever else
    acts.
    """
    assert reports["late"].effects == ("rotor_drag",)
    assert sum(reports["late"].probabilities.values()) == pytest.approx(1.0)


def test_a_known_cause_is_named_with_its_size(reports):
    report = reports["drag"]
    assert report.verdict == "effect" and report.effects == ("rotor_drag",)
    # no name is surer than stable choices are right
    assert report.probabilities["rotor_drag"] > 0.9 * DECISION.reliability
    estimate = report.parameters["rotor_drag"]["d_xy"]
    assert estimate.value == pytest.approx(DRAG["d_xy"], rel=0.1)
    # 90 % intervals may miss; three half-widths may not.
    half = 0.5 * (estimate.interval90[1] - estimate.interval90[0])
    assert abs(estimate.value - DRAG["d_xy"]) < 3 * half < 0.01
    assert report.gap.reduction > 0.3 and report.gap.interval90[0] > 0
    share = report.shares.effects["rotor_drag"]
    assert share.value > 0.9 and share.interval90[0] > 0.8 and report.shares.unexplained.value < 0.1
    # At the hubs drag turns the vehicle as well.
    assert any(p.channel.startswith("force") and p.after < p.before for p in report.where[:4])


@pytest.mark.parametrize(
    "logged",
    [_motors_late(14), _without("qw", "qx", "qy", "qz"), _leaning],
    ids=["motors on another clock", "no attitude", "no position"],
)
def test_drag_is_named_from_the_logs_that_there_are(logged, tmp_path):
    """And no torque from motors that share no clock with the gyroscope."""
    folder = _case(tmp_path / "case", {"rotor_drag": DRAG}, weighed=True, logged=logged)
    report = diagnose_case(load_case(folder))
    assert report.effects == ("rotor_drag",) and report.shares.effects["rotor_drag"].value > 0.6
    assert report.parameters["rotor_drag"]["d_xy"].value == pytest.approx(DRAG["d_xy"], rel=0.1)
    if any("share a clock" in text for text in report.sensors):
        hidden = {"inertia", "motor_lag", "yaw_torque", "com_offset", "rate_gains"}
        assert hidden | {"command_latency"} <= set(report.not_testable)


def test_rotors_that_differ_are_told_by_torques_alone(folders, monkeypatch):
    """Where these aren't judged, the little force that they make would have rotors
    differ by what slow turns do to the thrust.
    """

    def apart(*arguments):
        return dataclasses.replace(read_kinematics(*arguments), one_clock=False)

    monkeypatch.setattr(evidence, "read_kinematics", apart)
    motion = gather(load_case(folders["none"]), library(())).motion
    assert motion.exposure["motor_imbalance"] == 0.0 < motion.exposure["rotor_drag"]


def test_a_gyroscope_that_reads_little_is_no_heavy_body(tmp_path):
    """Beside no attitude, nothing tells the gain of one from the inertia of the
    other.
    """

    def logged(columns):
        rates = {n: 0.92 * columns[n] for n in ("wx", "wy", "wz")}
        columns = columns | rates
        return {n: v for n, v in columns.items() if n[0] not in "xyzqv"}

    report = diagnose_case(load_case(_case(tmp_path / "gain", {}, logged=logged)))
    assert report.effects == ()
    low, high = report.identification.quantities["inertia_roll"].interval90
    assert low < 1.0 < high


def test_motors_that_were_averaged_before_their_row_are_found_and_name_nothing(tmp_path):
    report = diagnose_case(load_case(_case(tmp_path / "mean", {}, logged=_motors_late(1))))
    assert report.effects == () and "one row earlier" in report.sensors[0]


def test_motors_quicker_than_told_are_named_with_their_size(tmp_path):
    """The replay of the motion has bounds for a lag; what the torques told isn't held to them."""
    quick = {"motor_lag": {"extra_up": -0.015, "extra_down": -0.015}}
    report = diagnose_case(load_case(_case(tmp_path / "quick", quick)))
    assert report.effects == ("motor_lag",)
    for number in report.parameters["motor_lag"].values():
        assert number.value == pytest.approx(-0.015, abs=0.002)


def test_nothing_is_named_where_nothing_is_wrong(reports):
    report = reports["none"]
    assert report.effects == () and report.verdict == "none"
    assert report.probabilities["none"] > 0.5
    assert abs(report.gap.reduction) < 0.05


def test_a_pose_that_rows_repeat_is_no_late_pose(reports):
    assert reports["held"].effects == ()
    assert any("repeat the last sample" in q["issue"] for q in reports["held"].quality)


def test_a_strong_cause_outside_the_library_is_unknown_not_its_neighbour(tmp_path):
    strong = _case(
        tmp_path / "strong", {"rotor_drag": {name: 2.0 * size for name, size in DRAG.items()}}
    )
    report = diagnose_case(load_case(strong), without=("rotor_drag", "wind", "blade_flapping"))
    assert report.verdict == "unknown" and report.effects[0] == "unknown"


def test_a_mass_is_told_from_thrust_by_how_the_vehicle_turns(reports):
    """Weaker rotors turn it more weakly, too, and a heavier vehicle turns as before:
    400 nats.
    """
    assert reports["mass"].effects == ("mass",)
    assert "thrust_scale" not in reports["mass"].equivalent.get("mass", [])
    weighed = reports["weighed"]
    assert weighed.effects == ("thrust_scale",)
    assert "mass" not in weighed.equivalent.get("thrust_scale", [])
    assert weighed.parameters["thrust_scale"]["scale"].value == pytest.approx(-0.08, abs=0.015)
    assert weighed.probabilities["mass"] == 0.0


def test_what_was_not_flown_is_not_testable(reports, tmp_path):
    doublets = _case(tmp_path / "doublets", {}, flights=("flight_c", "flight_c"))
    missing = not_testable(gather(load_case(doublets), library()))
    assert {"ground_effect", "ceiling_effect", "downwash"} <= set(missing)
    assert (
        "downwash" in reports["drag"].not_testable
        and "motor_lag" not in reports["drag"].not_testable
    )


def test_the_report_has_the_agreed_form(reports):
    for report in reports.values():
        data = json.loads(json.dumps(report.to_dict()))
        assert data["verdict"] in {"effect", *VERDICTS}
        assert set(data["probabilities"]) == {*EFFECTS, "none", "unknown"}
        assert sum(data["probabilities"].values()) == pytest.approx(1.0, abs=1e-4)
        assert set(data["effects"]) <= {*EFFECTS, "unknown"}
        for effect, values in data["parameters"].items():
            for name, estimate in values.items():
                assert estimate["unit"] == EFFECTS[effect].parameters[name].unit
                assert estimate["interval90"][0] <= estimate["value"] <= estimate["interval90"][1]
        assert all(p["channel"] in CHANNELS and p["regime"] in REGIMES for p in data["where"])
        assert {"metric", "before", "after", "floor", "reduction", "interval90"} <= set(data["gap"])
        assert set(data["not_testable"]) <= set(EFFECTS)
        first = data["effects"][0] if data["effects"] else "none"
        assert data["probabilities"][first] == max(data["probabilities"].values())
        assert (
            set(data["shares"]["effects"])
            == set(data["effects"]) - {"unknown"}
            == set(data["parameters"])
        )
        prediction = report.prediction()
        assert set(prediction) == {"effects", "probabilities", "where", "reduction", "not_testable"}
        assert sum(prediction["probabilities"].values()) == pytest.approx(1.0, abs=1e-3)


def main(arguments):
    """The command as `python -m openjax.diagnose` runs it: its exit status."""
    try:
        return diagnose.main(arguments)
    except UserError as error:
        print(f"error: {one_line(error)}", file=sys.stderr)
        return 2


def test_the_command_writes_everything_or_nothing(folders, reports, tmp_path, capsys, monkeypatch):
    # what it says of the drag is known; that a command diagnoses is asked where the
    # README's commands are run
    monkeypatch.setattr("openjax.gap.folders.diagnose_case", lambda case, *_: reports[case.name])
    out = tmp_path / "out"
    assert (
        main([str(folders["drag"]), "--out", str(out), "--predictions", str(tmp_path / "p.json")])
        == 0
    )
    names, parameters = load_effects(out / "drag" / "effects.toml")
    assert names == ("rotor_drag",) and parameters["rotor_drag"]["d_xy"] == pytest.approx(
        DRAG["d_xy"], rel=0.1
    )
    assert "<svg" in (out / "drag" / "report.html").read_text()
    assert json.loads((tmp_path / "p.json").read_text())["drag"]["effects"] == ["rotor_drag"]
    assert sorted(p.name for p in out.iterdir()) == ["drag"]
    capsys.readouterr()
    assert main([str(folders["drag"]), "--out", str(out)]) == 2
    assert "already exists" in capsys.readouterr().err


def test_a_fault_in_one_case_does_not_cost_the_others(
    folders, reports, tmp_path, capsys, monkeypatch
):
    def diagnosed(case, *_):
        # KeyError: what no check has foreseen
        return {"drag": reports["drag"]}[case.name]

    monkeypatch.setattr("openjax.gap.folders.diagnose_case", diagnosed)
    out = tmp_path / "out"
    assert main([str(folders["none"]), str(folders["drag"]), "--out", str(out), "--no-html"]) == 0
    said = capsys.readouterr()
    assert said.err.startswith("error: none: KeyError") and said.err.count("\n") == 1
    assert sorted(p.name for p in out.iterdir()) == ["drag"] and "report.html" not in said.out


def test_a_log_without_an_attitude_is_diagnosed_and_one_left_out_is_named(
    folders, tmp_path, capsys
):
    folder = tmp_path / "case"
    shutil.copytree(folders["drag"], folder)
    for path in folder.glob("*.csv.gz"):
        rows = [
            line.split(",") for line in gzip.decompress(path.read_bytes()).decode().splitlines()
        ]
        keep = [k for k, name in enumerate(rows[0]) if name not in ("qw", "qx", "qy", "qz")]
        text = "\n".join(",".join(row[k] for k in keep) for row in rows) + "\n"
        path.write_bytes(gzip.compress(text.encode()))
    (folder / "torn.csv").write_text("t,wx\n1,2\n")
    assert main([str(folder), "--out", str(tmp_path / "out")]) == 0
    assert "Left out: torn.csv" in capsys.readouterr().out
    assert "Left out: torn.csv" in (tmp_path / "out" / "case" / "report.html").read_text()


@pytest.mark.parametrize("kind", ["missing", "empty", "no_commands", "unknown_effect"])
def test_bad_input_is_one_line_and_leaves_nothing(folders, tmp_path, capsys, kind):
    folder = tmp_path / "case"
    more = []
    if kind != "missing":
        folder.mkdir()
        (folder / "vehicle.toml").write_text(VEHICLE.format(weighed="false"))
    if kind == "no_commands":
        (folder / "a.csv").write_text(
            "t,wx,wy,wz\n" + "".join(f"{k / 100},0.1,{k % 7},0\n" for k in range(500))
        )
    if kind == "unknown_effect":
        folder = folders["none"]
        more = ["--without", "gremlins"]
    assert main([str(folder), "--out", str(tmp_path / "out"), *more]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1
    assert not (tmp_path / "out").exists() or not list((tmp_path / "out").iterdir())
