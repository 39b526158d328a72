"""Garbage is called garbage: logs whose channels contradict each other are refused with
the numbers. That good flights pass is tested with the other checks.
"""

import itertools

import numpy as np
import pytest
from scipy.signal import butter, sosfilt
from scipy.spatial.transform import Rotation

from openjax.errors import UserError
from openjax.flights.case import load_case
from openjax.flights.checks import check_flight
from openjax.flights.csv_table import write_csv
from openjax.flights.pairs import Signals, pairs_of
from openjax.flights.reading import CHANNEL_COLUMNS, LogTable, flights_of
from openjax.flights.samples import log_of
from openjax.vehicle import load_vehicle

VEHICLE = load_vehicle()


def refusals(columns):
    (flight,), _ = flights_of(LogTable("flight.csv", columns, np.full(len(columns["t"]), "0")))
    kept, issues = check_flight(flight, VEHICLE)
    return kept, [i for i in issues if i.refused]


NO_PART = ("battery_voltage", "rotor_speed")  # of the sample flights' channels


@pytest.mark.parametrize("channel", [c for c in CHANNEL_COLUMNS if c not in NO_PART])
@pytest.mark.parametrize("how", ["shuffled", "of another time", "noise"])
def test_a_channel_that_contradicts_the_others_is_garbage(channel, how, sample_columns):
    columns = sample_columns["flight_b"]
    rng = np.random.default_rng(1)
    rows = len(columns["t"])
    order = rng.permutation(rows) if how == "shuffled" else np.roll(np.arange(rows), rows // 3)
    changed = dict(columns)
    for name in CHANNEL_COLUMNS[channel]:
        changed[name] = columns[name][order]
        if how == "noise":
            changed[name] = columns[name].mean() + columns[name].std() * rng.standard_normal(rows)
    if channel in ("motor_command", "command_thrust"):
        changed |= {n: np.clip(changed[n], 0.0, 1.0) for n in CHANNEL_COLUMNS[channel]}
    kept, found = refusals(changed)
    assert kept is None
    # with the numbers
    assert all(any(c.isdigit() for c in issue.issue) for issue in found)


def test_noise_in_every_column_is_garbage(sample_columns):
    columns = sample_columns["flight_b"]
    rng = np.random.default_rng(2)
    noise = {
        n: v if n == "t" else np.nanmean(v) + np.nanstd(v) * rng.standard_normal(len(v))
        for n, v in columns.items()
    }
    for names, low, high in ((CHANNEL_COLUMNS["motor_command"], 0, 1), (("cmd_thrust",), 0, 1)):
        noise |= {n: np.clip(noise[n], low, high) for n in names}
    length = np.sqrt(sum(noise[f"q{p}"] ** 2 for p in "wxyz"))
    noise |= {f"q{p}": noise[f"q{p}"] / length for p in "wxyz"}
    kept, found = refusals(noise)
    assert kept is None and {i.kind for i in found} == {"garbage"}


def test_a_column_copied_over_another_is_garbage(sample_columns):
    columns = sample_columns["flight_b"]
    kept, found = refusals(columns | {"ay": columns["ax"]})
    assert kept is None and "hold the same values" in found[0].issue


def test_clocks_apart_filters_and_noise_are_no_contradiction(sample_columns):
    """What honest sensors do: 100 ms between the streams, smoothing, and noise as
    strong as in bad logs.
    """
    columns = sample_columns["flight_c"]
    rng = np.random.default_rng(3)
    late = dict(columns)
    for channel, noise in (("body_rates", 0.3), ("specific_force", 1.0)):
        for name in CHANNEL_COLUMNS[channel]:
            smooth = np.convolve(columns[name], np.full(5, 0.2), "same")
            late[name] = np.roll(smooth, 10) + noise * rng.standard_normal(len(smooth))
    for name in CHANNEL_COLUMNS["position"]:
        late[name] = columns[name] + 0.003 * rng.standard_normal(len(columns[name]))
    kept, found = refusals(late)
    assert found == [] and kept is not None


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda w: w, ""),
        (lambda w: w[:, ::-1], "contradictory: w1, w2, w3, w4 against m1"),
        (lambda w: np.roll(w, 300, 0), "contradictory: w1, w2"),
        (lambda w: 30 / np.pi * w, "in rpm"),
        (lambda w: 1e-3 * w, "not the rotors' speeds"),
        (lambda w: w * [1, -1, 1, -1], "speeds have no sign"),
    ],
)
def test_rotors_turn_as_their_motors_say(change, words, sample_columns):
    columns = sample_columns["flight_c"]
    speeds = 2500.0 * np.sqrt(np.stack([columns[f"m{i}"] for i in "1234"], 1))
    names = CHANNEL_COLUMNS["rotor_speed"]
    kept, found = refusals(columns | dict(zip(names, change(speeds).T, strict=True)))
    assert (kept is None) == bool(words) and (not words or words in found[0].issue)


def in_wind(columns, force):
    """A flight whose motors answer a force (m/s^2) of a steady wind along x: what it does
    along the body's z axis as that leans they leave out, and the path stays as it was.
    """
    rotations = Rotation.from_quat(np.stack([columns[f"q{a}"] for a in "xyzw"], 1)).as_matrix()
    names = (*CHANNEL_COLUMNS["motor_command"], "cmd_thrust")
    share = 1.0 - force * rotations[:, 0, 2] / 9.81
    return columns | {name: np.clip(columns[name] * share, 0.0, 1.0) for name in names}


def test_motors_that_answer_a_wind_contradict_no_force(sample_columns):
    columns = sample_columns["flight_b"]
    kept, found = refusals(in_wind(columns, 3.5))
    assert found == [] and kept is not None
    # motors of another flight are no wind
    names = (*CHANNEL_COLUMNS["motor_command"], "cmd_thrust")
    of_another_flight = {n: sample_columns["flight_a"][n] for n in names}
    kept, found = refusals(in_wind(columns | of_another_flight, 3.5))
    assert kept is None and found[0].kind == "garbage"


def test_an_estimates_wandering_position_is_no_contradiction_while_hovering():
    rng = np.random.default_rng(5)
    t = np.arange(0.0, 8.0, 0.01)
    low = butter(2, 1.5, fs=100.0, output="sos")
    slow = {
        n: sosfilt(low, rng.standard_normal((len(t) + 500, 3)), axis=0)[500:]
        for n in ("place", "lean")
    }
    slow = {n: v / v.std(0) for n, v in slow.items()}
    # m: what ultra-wideband ranges leave
    place = [0.0, 0.0, 0.6] + 0.003 * slow["place"]
    lean = 0.01 * slow["lean"]
    rates = np.gradient(lean, t, axis=0) + 0.01 * rng.standard_normal((len(t), 3))
    force = [0.0, 0.0, 9.81] + 0.05 * rng.standard_normal((len(t), 3))
    quaternion = np.concatenate([np.ones((len(t), 1)), 0.5 * lean], 1)
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    motors = 0.6 + 0.02 * rng.standard_normal((len(t), 4))
    columns = {"t": t}
    for channel, values in {
        "position": place,
        "quaternion": quaternion,
        "body_rates": rates,
        "specific_force": force,
        "motor_command": motors,
    }.items():
        columns |= dict(zip(CHANNEL_COLUMNS[channel], values.T, strict=True))
    kept, found = refusals(columns)
    assert kept is not None, found


@pytest.mark.parametrize(("hover", "contradicts"), [(0.5, [False]), (0.85, []), (None, [True])])
def test_motors_at_their_limit_need_not_add_up_to_the_thrust(hover, contradicts):
    """A light and a heavy vehicle, whose mixer is cut at full thrust; and motors that
    follow another thrust.
    """
    rng = np.random.default_rng(6)
    steps = 3000
    slow = sosfilt(butter(2, 2.0, fs=100.0, output="sos"), rng.standard_normal((steps, 3)), axis=0)
    thrust, roll, other = slow.T / slow.std(0)[:, None] * [[0.01], [0.05], [0.01]]
    center = hover or 0.5
    asked = (
        center
        + (thrust if hover else other)[:, None]
        + (roll + 0.15)[:, None] * [1.0, -1.0, 1.0, -1.0]
    )
    nothing = dict.fromkeys(
        ("position", "quaternion", "velocity", "body_rates", "force", "commands")
    )
    logged = Signals(motor=np.clip(asked, 0.0, 1.0), thrust=(center + thrust)[:, None], **nothing)
    assert [bool(pair.bad.any()) for pair in pairs_of(logged)] == contradicts


def test_what_most_flights_contradict_the_calm_ones_must_show_to_be_right(
    case_folder, sample_columns
):
    """Swapped gyroscope columns in every log: where the vehicle hardly turns they don't
    show, and aren't trusted.
    """
    swapped = {n: c | {"wx": c["wy"], "wy": c["wx"]} for n, c in sample_columns.items()}
    calm = {n: v[:300] for n, v in swapped["flight_a"].items()}
    rng = np.random.default_rng(4)
    for names in (("qx", "qy", "qz"), ("wx", "wy", "wz")):
        calm |= {n: 0.002 * rng.standard_normal(300) for n in names}
    calm["qw"] = np.sqrt(1.0 - calm["qx"] ** 2 - calm["qy"] ** 2 - calm["qz"] ** 2)
    still = {
        n: 0.001 * rng.standard_normal(300)
        for n in ("x", "y", "vx", "vy", "vz", "cmd_wx", "cmd_wy", "cmd_wz")
    }
    calm |= still | {"z": 0.5 + 0.001 * rng.standard_normal(300)}
    calm |= {m: 0.5 + 0.01 * rng.standard_normal(300) for m in ("m1", "m2", "m3", "m4")}
    calm |= {
        a: (9.81 if a == "az" else 0.0) + 0.1 * rng.standard_normal(300) for a in ("ax", "ay", "az")
    }
    calm["cmd_thrust"] = (calm["m1"] + calm["m2"] + calm["m3"] + calm["m4"]) / 4
    assert refusals(calm)[1] == []
    for name in ("flight_b", "flight_c"):
        write_csv(case_folder / f"{name}.csv.gz", log_of([swapped[name]], name))
    write_csv(case_folder / "flight_a.csv.gz", log_of([calm], "flight_a"))
    with pytest.raises(UserError, match="no flight can be used"):
        load_case(case_folder)


def scaled(names, factor):
    return lambda c: c | {n: factor * c[n] for n in names.split()}


def swapped(a, b):
    return lambda c: c | {a: c[b], b: c[a]}


PATHS = {
    "z negated": (scaled("z", -1.0), "z "),
    "x at zero": (scaled("x", 0.0), "x: the same value 0"),
    "y negated": (scaled("y", -1.0), "y "),
    "y twice as large": (scaled("y", 2.0), "y moves by 2.0"),
    "z half as large": (scaled("z", 0.5), "z moves by 0.5"),
    "all twice as large": (scaled("x y z", 2.0), "x moves by 2.0"),
    "vx at zero": (scaled("vx", 0.0), "x"),
    "velocity twice as large": (scaled("vx vy vz", 2.0), "moves by 0.5"),
    "z and vz negated": (scaled("z vz", -1.0), "z"),
}


@pytest.mark.parametrize("imu", [True, False])
@pytest.mark.parametrize("fault", PATHS)
def test_a_position_moves_as_its_velocity_says_however_slowly(fault, imu, sample_columns):
    """A figure of some decimetres in ten seconds is below the band of the other
    comparisons.
    """
    damage, words = PATHS[fault]
    columns = damage(sample_columns["flight_b"])
    if not imu:
        columns = {n: v for n, v in columns.items() if n[0] not in "aw"}
    kept, found = refusals(columns)
    assert kept is None and words in found[0].issue


def test_a_velocity_that_drifts_is_no_contradiction(sample_columns):
    """As estimators' do by some centimetres a second."""
    for columns in sample_columns.values():
        drift = {n: columns[n] + 0.03 for n in ("vx", "vy", "vz")}
        assert refusals(columns | drift)[0] is not None


PARTS = ("qw", "qx", "qy", "qz")


@pytest.mark.parametrize("pair", list(itertools.combinations(PARTS, 2)), ids="-".join)
@pytest.mark.parametrize("name", ["flight_b", "flight_c"])
def test_parts_of_a_quaternion_that_are_swapped_are_named(pair, name, sample_columns):
    """In a single flight, where no other tells what is right."""
    columns = swapped(*pair)(sample_columns[name])
    order = [dict(zip(pair, pair[::-1], strict=True)).get(part, part)[1] for part in PARTS]
    kept, found = refusals(columns)
    assert kept is None
    # a level vehicle's yaw: other axes of the world do the same
    if pair != ("qw", "qz"):
        assert f"in the order {', '.join(order)}" in found[0].issue


@pytest.mark.parametrize("name", ["flight_a", "flight_c"])
def test_what_hovers_upside_down_is_refused_without_an_imu_too(name, sample_columns):
    columns = swapped("qw", "qx")(sample_columns[name])
    kept, found = refusals({n: v for n, v in columns.items() if n[0] not in "aw"})
    assert kept is None and found[0].kind == "quaternion"


@pytest.mark.parametrize("angle", ["roll", "pitch"])
def test_an_angle_with_the_other_sign_is_named(angle, sample_columns):
    columns = sample_columns["flight_a"]
    quaternion = np.stack([columns[n] for n in PARTS], 1)
    angles = Rotation.from_quat(quaternion, scalar_first=True).as_euler("ZYX")
    angles[:, {"pitch": 1, "roll": 2}[angle]] *= -1.0
    other = Rotation.from_euler("ZYX", angles).as_quat(scalar_first=True)
    kept, found = refusals(columns | dict(zip(PARTS, other.T, strict=True)))
    assert kept is None and f"{angle} has the other sign: scale = -1" in found[0].issue


def test_a_quick_turn_to_and_fro_the_wrong_way_round_is_no_late_one():
    """Twice a second half a period is what clocks may be apart by, nearly."""
    t = np.arange(0.0, 8.0, 0.01)
    phase = 2.0 * np.pi * 2.0 * t
    path = 0.012 * np.stack([np.cos(phase), np.sin(1.1 * phase), 0.0 * t], 1)
    velocity = np.gradient(path, t, axis=0)
    up = np.gradient(velocity, t, axis=0) + np.array([0.0, 0.0, 9.81])
    attitude = Rotation.concatenate([Rotation.align_vectors([u], [[0.0, 0.0, 1.0]])[0] for u in up])
    rates = (attitude[:-1].inv() * attitude[1:]).as_rotvec() / 0.01
    rates = np.concatenate([rates, rates[-1:]])
    columns = {"t": t, "cmd_thrust": 0.62 + 0.01 * np.cos(3.0 * t)}
    for names, values in (
        ("x y z", path + np.array([0.0, 0.0, 0.7])),
        ("vx vy vz", velocity),
        ("wx wy wz", rates),
        ("cmd_wx cmd_wy cmd_wz", rates),
    ):
        columns |= dict(zip(names.split(), values.T, strict=True))
    quaternion = attitude.as_quat(scalar_first=True)
    right, inverse = (
        dict(zip(("qw", "qx", "qy", "qz"), (signs * quaternion).T, strict=True))
        for signs in (np.ones(4), np.array([1.0, -1.0, -1.0, -1.0]))
    )
    assert not refusals(columns | right)[1]
    (found,) = refusals(columns | inverse)[1]
    assert found.kind == "quaternion" and "from world to body" in found.issue
