"""Files as laboratories have them, each made small from a sample flight and read
without a `columns.toml`: what arrives is what was flown.
"""

import struct
import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from openjax.errors import UserError
from openjax.flights.case import load_case
from openjax.flights.importers import find_logs, load_mapping, read_log
from openjax.flights.importers.columns import CHANNEL_COLUMNS
from openjax.flights.reading import LogError, flights_of

DEGREES = 180 / np.pi
G = 9.80665


@pytest.fixture
def columns(sample_columns):
    return {name: values[:400] for name, values in sample_columns["flight_c"].items()}


def write_table(path, table, form="{:.9g}", separator=","):
    """A CSV of {name: values}; text stays as it is."""
    rows = zip(*table.values(), strict=True)
    cells = [[v if isinstance(v, str) else form.format(v) for v in row] for row in rows]
    lines = [separator.join(table), *(separator.join(row) for row in cells)]
    path.write_text("\n".join(lines) + "\n")


def assert_read(table, columns, names, tolerance=1e-4, rows=slice(None)):
    for name in names:
        np.testing.assert_allclose(
            table.columns[name][rows], columns[name][rows], atol=tolerance, err_msg=name
        )


def mixer_inputs(columns):
    """What the firmware's legacy power distribution makes these motors of."""
    m = 65535 * np.stack([columns[f"m{i}"] for i in "1234"])
    return {
        "controller.cmd_thrust": m.mean(0),
        "controller.cmd_roll": (m[2] + m[3] - m[0] - m[1]) / 2,
        "controller.cmd_pitch": (m[0] + m[3] - m[1] - m[2]) / 2,
        "controller.cmd_yaw": (m[0] + m[2] - m[1] - m[3]) / 4,
    }


def client_blocks(c):
    """Log blocks as the client has them: the firmware's units, and its sense of
    pitch.
    """
    roll, pitch, yaw = euler(c)
    return {
        "stabilizer": {
            "stateEstimate.x": c["x"],
            "stateEstimate.y": c["y"],
            "stateEstimate.z": c["z"],
            "stabilizer.roll": roll * DEGREES,
            "stabilizer.pitch": -pitch * DEGREES,
            "stabilizer.yaw": yaw * DEGREES,
        },
        "imu": {f"gyro.{a}": c[f"w{a}"] * DEGREES for a in "xyz"}
        | {f"acc.{a}": c[f"a{a}"] / G for a in "xyz"},
        "motors": {f"motor.m{i}": np.rint(c[f"m{i}"] * 65535) for i in (1, 2, 3, 4)},
    }


def euler(c):
    """Roll, pitch and yaw (rad) of a sample's quaternion, turned in the order z, y,
    x.
    """
    qw, qx, qy, qz = (c[f"q{a}"] for a in "wxyz")
    roll = np.arctan2(2 * (qw * qx + qy * qz), 1 - 2 * (qx**2 + qy**2))
    pitch = np.arcsin(2 * (qw * qy - qz * qx))
    yaw = np.arctan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy**2 + qz**2))
    return roll, pitch, yaw


MOTION = ("t", "x", "z", "qw", "qx", "qy", "qz", "wx", "wy", "wz", "ax", "az", "m1", "m2", "m4")


@pytest.mark.parametrize("name", ["Timestamp", "timestamp", "tick"])
def test_the_clients_csv_is_read_by_its_firmware_names(tmp_path, columns, name):
    ticks = 81234 + np.rint(columns["t"] * 1000)
    blocks = client_blocks(columns)
    table = {name: ticks} | blocks["stabilizer"] | blocks["imu"] | blocks["motors"]
    table["sys.flightmode"] = ["0"] + ["HOVER"] * 399  # a text beside the numbers
    write_table(tmp_path / "flight.csv", table)
    assert find_logs(tmp_path) == [tmp_path / "flight.csv"]
    read = read_log(tmp_path / "flight.csv")
    assert_read(read, columns, MOTION)
    assert read.remarks == ()


def test_the_clients_log_blocks_of_one_flight_are_one_log(tmp_path, columns):
    """One file for each block, as the client writes them, at rates of their own."""
    flight = tmp_path / "20261127T10-11-12"
    flight.mkdir()
    every = {"stabilizer": 2, "imu": 1, "motors": 1}
    for block, values in client_blocks(columns).items():
        rows = slice(None, None, every[block])
        table = {"Timestamp": 500 + np.rint(columns["t"] * 1000)} | values
        write_table(flight / f"{block}.csv", {n: v[rows] for n, v in table.items()})
    battery = {"Timestamp": np.array([600, 1600, 2600]), "pm.vbat": np.array([4.0, 3.9, 3.8])}
    write_table(flight / "battery.csv", battery)
    assert find_logs(tmp_path) == [flight]
    read = read_log(flight)
    assert_read(read, columns, ("t", "wx", "wy", "az", "m1", "m3"))
    assert_read(read, columns, ("x", "qw", "qy"), 2e-3, slice(0, -1, 2))
    assert np.isfinite(read.columns["vbat"]).sum() == 3


def test_mixer_and_controller_stand_for_motors_and_gyroscope(tmp_path, columns):
    """What CrazyPAD's logs hold: the mixer's inputs, the controller's gyroscope (rad/s,
    legacy pitch) and vertical force, ticks with fractions of a ms.
    """
    table = {"timestamp": columns["t"] * 1000 + 0.003} | mixer_inputs(columns)
    table |= {
        "controller.r_roll": columns["wx"],
        "controller.r_pitch": -columns["wy"],
        "controller.r_yaw": columns["wz"],
        "controller.accelz": columns["az"] / G,
        "stateEstimate.x": columns["x"],
        "stateEstimate.y": columns["y"],
        "stateEstimate.z": columns["z"],
    }
    write_table(tmp_path / "log.csv", table)
    (tmp_path / "vehicle.toml").write_text("")
    read = read_log(tmp_path / "log.csv")
    assert_read(read, columns, ("wx", "wy", "wz", "az", "x", "m1", "m2", "m3", "m4"))
    assert any("mixer" in remark for remark in read.remarks)
    (flight,) = load_case(tmp_path).flights
    assert flight.specific_force is None and flight.quaternion is None


def test_gyroscope_and_motors_alone_are_a_flight(tmp_path, columns):
    names = ("t", *CHANNEL_COLUMNS["body_rates"], *CHANNEL_COLUMNS["motor_command"])
    write_table(tmp_path / "log.csv", {n: columns[n] for n in names})
    (tmp_path / "vehicle.toml").write_text("")
    case = load_case(tmp_path)
    assert [flight.name for flight in case.flights] == ["log.csv"]
    assert any("only torques" in issue.issue for issue in case.quality)


def client_table(columns, begin=81234):
    """All blocks in one table, as scripts with cflib write them."""
    table = {"timestamp": begin + np.rint(columns["t"] * 1000)}
    for values in client_blocks(columns).values():
        table |= values
    return table


def test_the_firmwares_ticks_go_before_the_computers_clock(tmp_path, columns):
    """Which says when a packet was received."""
    received = 1.76e9 + columns["t"] + np.random.default_rng(0).uniform(0.0, 0.02, 400)
    write_table(tmp_path / "log.csv", {"time": received} | client_table(columns), "{:.15g}")
    assert_read(read_log(tmp_path / "log.csv"), columns, MOTION)


def test_recordings_of_the_same_ticks_in_one_file_are_none(tmp_path, columns):
    first, second = (client_table(columns), client_table({n: -v for n, v in columns.items()}))
    second["timestamp"] = first["timestamp"]
    write_table(tmp_path / "log.csv", {n: np.r_[v, second[n]] for n, v in first.items()})
    with pytest.raises(LogError, match="several recordings in one file"):
        read_log(tmp_path / "log.csv")


def test_log_blocks_beside_others_and_of_another_time(tmp_path, columns):
    """An empty block and a note change nothing; blocks that share no time are told."""
    flight = tmp_path / "flight"
    flight.mkdir()
    for late in (0, 100_000):
        for block, values in client_blocks(columns).items():
            begin = 500 + late * (block == "motors")
            ticks = {"Timestamp": begin + np.rint(columns["t"] * 1000)}
            write_table(flight / f"{block}.csv", ticks | values)
        if late:
            with pytest.raises(LogError, match=r"m1, m2, m3, m4 were logged from 100\.50 to"):
                read_log(flight)
        else:
            (flight / "battery.csv").write_text("Timestamp,pm.vbat\n")
            (flight / "note.txt").write_text("hall 3")
            assert find_logs(tmp_path) == [flight]
            read = read_log(flight)
            assert_read(read, columns, MOTION)
            assert read.remarks == ("battery.csv: no rows: left out",)


TOPICS = {
    "pose": ("x", "y", "z", "qw", "qx", "qy", "qz"),
    "imu": ("wx", "wy", "wz", "ax", "ay", "az"),
    "motor": ("m1", "m2", "m3", "m4"),
}


def topic_table(columns, name="{topic}.{column}", stamp="{topic}.time"):
    """Topics that were put side by side by the number of their rows: their times in a
    row are up to 80 ms apart.
    """
    table = {}
    for late, (topic, names) in enumerate(TOPICS.items()):
        rows = slice(4 * late, len(columns["t"]) - 8 + 4 * late)
        stamps = 1_700_000_000_000_000_000 + np.rint(columns["t"][rows] * 1e9).astype(np.int64)
        table[stamp.format(topic=topic)] = [str(s) for s in stamps]
        table |= {name.format(topic=topic, column=c): columns[c][rows] for c in names}
    return table


@pytest.mark.parametrize("name", ["{topic}.{column}", "/cf1/{topic}/{column}"])
def test_each_topic_of_a_csv_has_its_own_time(tmp_path, columns, name):
    stamp = name.replace("{column}", "time")
    write_table(tmp_path / "flight.csv", topic_table(columns, name, stamp))
    read = read_log(tmp_path / "flight.csv")
    for column in ("x", "qy", "wx", "az", "m1"):
        shifted = {column: columns[column][_first(read, columns) :]}
        assert_read(read, shifted, (column,), 1e-4, slice(10, 300))


def _first(read, columns):
    """The row of the sample with which the merged table begins, by its gyroscope."""
    wx = read.columns["wx"]
    row = int(np.flatnonzero(np.isfinite(wx))[0])
    return int(np.argmin(np.abs(columns["wx"] - wx[row]))) - row


def test_columns_toml_names_a_time_for_each_group(tmp_path, columns):
    """Stamps with names that say nothing, one of them in another unit."""
    table = topic_table(columns, "{column}_raw", "{topic}_t")
    table = {n.replace("motor_t", "stamp 3").replace("_t", " clock"): v for n, v in table.items()}
    table["stamp 3"] = [f"{int(v) * 1e-6:.6f}" for v in table["stamp 3"]]
    write_table(tmp_path / "flight.csv", table)
    groups = {"pose clock": "pose", "imu clock": "imu", "stamp 3": "motor"}
    units = dict.fromkeys(groups, "ns") | {"stamp 3": "ms"}
    clocks = ", ".join(
        f'{{ from = "{stamp}", unit = "{units[stamp]}", of = {list(TOPICS[topic])} }}'
        for stamp, topic in groups.items()
    )
    text = f"[columns]\nt = [{clocks}]\n"
    text += "".join(f'{c} = "{c}_raw"\n' for names in TOPICS.values() for c in names)
    (tmp_path / "columns.toml").write_text(text)
    read = read_log(tmp_path / "flight.csv", load_mapping(tmp_path / "columns.toml"))
    first = _first(read, columns)
    for column in ("x", "wx", "m1"):
        shifted = {column: columns[column][first:]}
        assert_read(read, shifted, (column,), 1e-3, slice(10, 300))
    (tmp_path / "columns.toml").write_text(text.replace("pose clock", "pose time"))
    with pytest.raises(LogError, match="no column 'pose time' for t"):
        read_log(tmp_path / "flight.csv", load_mapping(tmp_path / "columns.toml"))


def test_a_topics_name_may_end_in_an_underscore(tmp_path, columns):
    write_table(tmp_path / "flight.csv", topic_table(columns, "{topic}_{column}", "{topic}_t"))
    write_table(tmp_path / "plain.csv", topic_table(columns))
    read, plain = (read_log(tmp_path / name) for name in ("flight.csv", "plain.csv"))
    assert_read(read, plain.columns, ("t", "x", "qy", "wx", "m1"))


def test_motors_that_were_sent_with_a_pose_are_there_with_it(tmp_path, columns):
    """However the stamps of the two are rounded."""
    table = topic_table(columns)
    table["pose.time"] = [f"{int(v) * 1e-9:.9f}" for v in table["pose.time"]]
    write_table(tmp_path / "flight.csv", table)
    write_table(tmp_path / "plain.csv", topic_table(columns))
    mixed, plain = (read_log(tmp_path / name) for name in ("flight.csv", "plain.csv"))
    for name in ("m1", "m3"):
        assert_read(mixed, {name: plain.columns[name]}, (name,), rows=slice(20, 360))


@pytest.mark.parametrize("stamp", ["0", "1.7000000e18"])
def test_a_clock_that_stands_is_told(tmp_path, columns, stamp):
    """As where a spreadsheet kept seven digits of it."""
    table = topic_table(columns)
    table["motor.time"] = [stamp] * len(table["motor.time"])
    write_table(tmp_path / "flight.csv", table)
    with pytest.raises(LogError, match=r"motor\.time hardly moves \(1 different of 392 stamps\)"):
        read_log(tmp_path / "flight.csv")


def test_a_second_vehicle_in_a_table_of_topics_is_told(tmp_path, columns):
    names = ("/cf{}/{{topic}}/{{column}}", "/cf{}/{{topic}}/time")
    both = [topic_table(columns, *(n.format(i) for n in names)) for i in (1, 2)]
    write_table(tmp_path / "flight.csv", both[0] | both[1])
    (remark,) = read_log(tmp_path / "flight.csv").remarks
    assert "/cf2/pose/x to /cf2/motor/m4" in remark


def test_one_named_time_does_not_take_the_others_away(tmp_path, columns):
    write_table(tmp_path / "flight.csv", topic_table(columns))
    text = '[columns]\nt = { from = "pose.time", unit = "ns" }\n'
    text += "".join(f'{c} = "{t}.{c}"\n' for t, names in TOPICS.items() for c in names)
    (tmp_path / "columns.toml").write_text(text)
    mapped = read_log(tmp_path / "flight.csv", load_mapping(tmp_path / "columns.toml"))
    plain = read_log(tmp_path / "flight.csv")
    assert "each topic's columns are at its own times" in mapped.remarks[0]
    assert_read(mapped, plain.columns, ("t", "x", "wx", "m1"))


# --- PX4


LETTERS = {
    **{"float": "f", "double": "d", "bool": "?", "uint64_t": "Q", "uint32_t": "I"},
    **{"int32_t": "i", "uint16_t": "H", "uint8_t": "B"},
}


def ulog(topics, parameters):
    """A ULog as PX4 writes it: {topic: (times in s, {field: (type, values)})}, {name:
    number}; whole numbers are int32_t. Padding at the end of a message is in its
    format, not in the data.
    """

    def message(kind, data):
        return struct.pack("<HB", len(data), ord(kind)) + data

    def keyed(kind, key, data):
        return message(kind, bytes([len(key)]) + key.encode() + data)

    out = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 1_000_000)
    out += message("B", bytes(40))
    out += keyed("I", "char[3] sys_name", b"PX4") + keyed("I", "char[5] ver_hw", b"FMUV6")
    for topic, (_, fields) in topics.items():
        text = "".join(f"{kind} {name};" for name, (kind, _) in fields.items())
        out += message("F", f"{topic}:uint64_t timestamp;{text}uint8_t[6] _padding0;".encode())
    for name, value in parameters.items():
        kind, form = ("int32_t", "<i") if isinstance(value, int) else ("float", "<f")
        out += keyed("P", f"{kind} {name}", struct.pack(form, value))
    records = [(0.0, message("L", struct.pack("<BQ", 54, 1_400_000) + b"[logger] Start file log"))]
    for number, (topic, (times, fields)) in enumerate(topics.items()):
        out += message("A", struct.pack("<BH", 0, number) + topic.encode())
        for row, time in enumerate(times):
            data = struct.pack("<HQ", number, 1_500_000 + round(time * 1e6))
            for kind, values in fields.values():
                cells = np.atleast_1d(values[row]).tolist()
                letter = LETTERS[kind.partition("[")[0]]
                whole = letter not in "fd"
                data += struct.pack(
                    f"<{len(cells)}{letter}", *(map(int, cells) if whole else cells)
                )
            records.append((time, message("D", data)))
    return out + b"".join(data for _, data in sorted(records, key=lambda r: r[0]))


def frame(forward, left, up):
    """A vector of ours in PX4's body."""
    return np.stack([forward, -left, -up], 1)


def px4_topics(c, order=("m1", "m3", "m4", "m2")):
    """A sample flight in PX4's frames; `order`: our column of PX4's motors 1 to 4."""
    t = c["t"]
    half = np.sqrt(0.5)
    qw, qx, qy, qz = (c[f"q{a}"] for a in "wxyz")
    turned = np.stack([half * (qw + qz), half * (qx + qy), half * (qx - qy), half * (qw - qz)], 1)
    turned[::3] *= -1.0  # the same attitude
    slow = slice(None, None, 2)
    motors = np.full((len(t), 12), np.nan)
    motors[:, :4] = np.stack([c[m] for m in order], 1)
    rates = frame(c["wx"], c["wy"], c["wz"])
    force = frame(c["ax"], c["ay"], c["az"])
    sampled = 1_500_000 + np.rint(1e6 * t)
    zero = np.zeros(len(t))
    local = {
        **{"timestamp_sample": ("uint64_t", sampled[slow]), "ref_timestamp": ("uint64_t", zero)},
        **{"ref_lat": ("double", zero + 47.4), "ref_lon": ("double", zero + 8.5)},
        **{"x": ("float", c["y"][slow]), "y": ("float", c["x"][slow])},
        **{"z": ("float", -c["z"][slow]), "delta_z": ("float", zero)},
        **{"vx": ("float", c["vy"][slow]), "vy": ("float", c["vx"][slow])},
        **{"vz": ("float", -c["vz"][slow]), "z_deriv": ("float", zero), "heading": ("float", zero)},
        **{"xy_valid": ("bool", zero + 1), "z_valid": ("bool", zero + 1)},
    }
    combined = {
        **{"gyro_rad": ("float[3]", rates), "gyro_integral_dt": ("uint32_t", zero + 4000)},
        **{"accelerometer_timestamp_relative": ("int32_t", zero)},
        **{"accelerometer_m_s2": ("float[3]", force)},
        **{"accelerometer_integral_dt": ("uint32_t", zero + 4000)},
        **{"accelerometer_clipping": ("uint8_t", zero), "gyro_clipping": ("uint8_t", zero)},
    }
    attitude = {
        **{"timestamp_sample": ("uint64_t", sampled[slow]), "q": ("float[4]", turned[slow])},
        **{"delta_q_reset": ("float[4]", turned[slow]), "quat_reset_counter": ("uint8_t", zero)},
    }
    control = {"timestamp_sample": ("uint64_t", sampled), "control": ("float[12]", motors)}
    rare = t[::50]
    battery = {"voltage_v": ("float", np.full(len(rare), 15.2)), "id": ("uint8_t", zero)}
    return {
        "vehicle_attitude": (t[slow], attitude),
        "vehicle_local_position": (t[slow], local),
        "sensor_combined": (t, combined),
        "actuator_motors": (t, control | {"reversible_flags": ("uint16_t", zero)}),
        "battery_status": (rare, battery),
    }


PX4_NAMES = ("wx", "wy", "wz", "ax", "ay", "az", "m1", "m2", "m3", "m4")


def test_a_px4_log_arrives_in_our_frames_and_order(tmp_path, columns):
    pytest.importorskip("pyulog")
    (tmp_path / "flight.ulg").write_bytes(ulog(px4_topics(columns), {"THR_MDL_FAC": 0.3}))
    assert find_logs(tmp_path) == [tmp_path / "flight.ulg"]
    read = read_log(tmp_path / "flight.ulg")
    assert_read(read, columns, PX4_NAMES)
    (flight,), _ = flights_of(read)
    rows = slice(0, -2, 2)
    (own,), _ = flights_of(type(read)("own", columns, np.full(len(columns["t"]), "0")))
    np.testing.assert_allclose(flight.position[rows], own.position[rows], atol=1e-5)
    np.testing.assert_allclose(flight.velocity[rows], own.velocity[rows], atol=1e-5)
    agreement = np.abs((flight.quaternion * own.quaternion).sum(1))
    np.testing.assert_allclose(agreement[rows], 1.0, atol=1e-6)
    assert np.nanmedian(read.columns["vbat"]) == pytest.approx(15.2)
    (tmp_path / "vehicle.toml").write_text("")
    case = load_case(tmp_path)  # all checks of agreement pass
    assert [f.name for f in case.flights] == ["flight.ulg"], case.quality


def test_a_px4_airframe_is_taken_from_its_parameters(tmp_path, columns):
    """Motors in another order, logged as pulses of outputs that aren't in order
    either.
    """
    pytest.importorskip("pyulog")
    places = {"m2": (-1, 1, -1), "m1": (1, 1, 1), "m4": (1, -1, -1), "m3": (-1, -1, 1)}
    topics = px4_topics(columns)
    del topics["actuator_motors"]
    # outputs 3, 4, 1, 2 are motors 1, 2, 3, 4
    wired = ("m4", "m3", "m2", "m1")
    curve = 0.4
    thrust = np.stack([columns[m] for m in wired], 1)
    signal = (-(1 - curve) + np.sqrt((1 - curve) ** 2 + 4 * curve * thrust)) / (2 * curve)
    pulses = np.full((len(thrust), 16), 900.0)
    pulses[:, :4] = 1100 + 800 * signal
    number = np.full(len(thrust), 16)
    outputs = {"noutputs": ("uint32_t", number), "output": ("float[16]", pulses)}
    topics["actuator_outputs"] = (columns["t"], outputs)
    parameters = {"THR_MDL_FAC": curve, "CA_ROTOR_COUNT": 4, "PWM_MIN": 1100, "PWM_MAX": 1900}
    for i, (x, y, spin) in enumerate(places.values()):
        parameters |= {f"CA_ROTOR{i}_PX": 0.1 * x, f"CA_ROTOR{i}_PY": 0.1 * y}
        parameters |= {f"CA_ROTOR{i}_KM": 0.05 * spin}
    parameters |= {f"PWM_MAIN_FUNC{o}": 101 + m for m, o in enumerate((3, 4, 1, 2))}
    (tmp_path / "flight.ulg").write_bytes(ulog(topics, parameters))
    read = read_log(tmp_path / "flight.ulg")
    assert_read(read, columns, PX4_NAMES, 2e-4)
    assert any('"ccw", "cw", "ccw", "cw"' in remark for remark in read.remarks)
    parameters["CA_ROTOR_COUNT"] = 6
    (tmp_path / "flight.ulg").write_bytes(ulog(topics, parameters))
    with pytest.raises(LogError, match="6 rotors"):
        read_log(tmp_path / "flight.ulg")


def _without_fields(topics):
    return topics | {
        "actuator_motors": (
            topics["actuator_motors"][0],
            {"control": ("float[3]", np.zeros((400, 3)))},
        )
    }


def _outputs(topics, values):
    rest = {name: topic for name, topic in topics.items() if name != "actuator_motors"}
    return rest | {
        "actuator_outputs": (topics["sensor_combined"][0], {"output": ("float[16]", values)})
    }


@pytest.mark.parametrize(
    "change, parameters, words",
    [
        (_without_fields, {}, r"no actuator_motors:control\[3\] in the log"),
        (
            lambda t: _outputs(t, np.linspace(60.0, 1990.0, 6400).reshape(400, 16)),
            {},
            r"actuator_outputs reach from 60 to .*DShot",
        ),
        (
            lambda t: _outputs(t, np.full((400, 16), 1500.0)),
            {f"PWM_AUX_FUNC{i}": 100 + i for i in (1, 2, 3, 4)},
            "motor 1 is on PWM_AUX_FUNC1",
        ),
        (
            lambda t: (
                t
                | {
                    "vehicle_attitude": (
                        t["vehicle_attitude"][0],
                        {"roll": ("float", np.zeros(400))},
                    )
                }
            ),
            {"CA_ROTOR_COUNT": 8},
            "8 rotors",
        ),
    ],
)
def test_motors_that_a_px4_log_does_not_have_are_told(tmp_path, columns, change, parameters, words):
    pytest.importorskip("pyulog")
    (tmp_path / "flight.ulg").write_bytes(ulog(change(px4_topics(columns)), parameters))
    with pytest.raises(LogError, match=words):
        read_log(tmp_path / "flight.ulg")


@pytest.mark.parametrize("told", [{}, {"PWM_MAIN_MIN": 960}, {"PWM_MIN": 940, "PWM_MAX": 1980}])
def test_an_output_whose_range_is_minus_one_has_that_of_all(tmp_path, columns, told):
    """As the parameters of PX4 1.10 to 1.12 say it."""
    pytest.importorskip("pyulog")
    least = told.get("PWM_MAIN_MIN", told.get("PWM_MIN", 1000))
    most = told.get("PWM_MAX", 2000)
    of_each = {f"PWM_MAIN_{end}{i}": -1 for end in ("MIN", "MAX") for i in range(1, 9)}
    topics = px4_topics(columns)
    share = np.zeros((400, 16))
    share[:, :4] = topics["actuator_motors"][1]["control"][1][:, :4]
    data = ulog(_outputs(topics, least + (most - least) * share), told | of_each)
    (tmp_path / "flight.ulg").write_bytes(data)
    read = read_log(tmp_path / "flight.ulg")
    assert_read(read, columns, ("m1", "m2", "m3", "m4"), 2e-3, slice(2, None))


def test_a_px4_log_with_any_byte_flipped_is_read_or_refused(tmp_path, columns):
    """Of its header and formats, up to the data."""
    pytest.importorskip("pyulog")
    short = {name: values[:40] for name, values in columns.items()}
    data = ulog(px4_topics(short), {})
    head = data.index(b"[logger]")
    for at in np.random.default_rng(0).choice(np.arange(8, head), 150, replace=False):
        changed = bytearray(data)
        changed[at] ^= 0x04
        (tmp_path / "flight.ulg").write_bytes(changed)
        try:
            read_log(tmp_path / "flight.ulg")
        except LogError as error:
            assert "\n" not in str(error)


@pytest.mark.parametrize("data", [b"ULog\x01\x12\x35", b"ULog\x01\x12\x35\x01" + bytes(8)])
def test_a_px4_log_without_a_flight_says_so(tmp_path, data):
    pytest.importorskip("pyulog")
    (tmp_path / "flight.ulg").write_bytes(data)
    with pytest.raises(LogError, match="PX4 log"):
        read_log(tmp_path / "flight.ulg")


# --- Betaflight

PID = [
    f"axis{part}[{i}]"
    for part, axes in (("P", 3), ("I", 3), ("D", 2), ("F", 3))
    for i in range(axes)
]
ROUGH = {"w": 0.0088, "a": 0.0025, "m": 0.0003, "c": 0.0088}
"""By the first letter of a column what whole numbers leave of it."""


def blackbox(c, unit="", fine=1.0):
    """A decoded blackbox, fields, order and whole numbers as `blackbox_decode` has them
    of a flight with Betaflight 4; or with its --unit-rotation and --unit-acceleration.
    """
    force = G if unit else G / 2048
    whole = np.rint if not unit else np.asarray
    rate = (DEGREES * fine, "") if not unit else (1.0, " (rad/s)")
    zero = np.zeros(len(c["t"]))
    table = {"loopIteration": np.arange(len(zero)), "time (us)": np.rint(55_158_008 + c["t"] * 1e6)}
    table |= dict.fromkeys((*PID, *(f"rcCommand[{i}]" for i in range(4))), zero)
    table |= {
        f"setpoint[{i}]": np.rint(c[f"cmd_w{a}"] * DEGREES * fine) for i, a in enumerate("xyz")
    }
    table["setpoint[3]"] = np.rint(c["cmd_thrust"] * 1000)
    table |= {"vbatLatest (V)": zero + 16.12, "amperageLatest (A)": zero + 15.2, "rssi": zero + 785}
    table |= {f"gyroADC[{i}]{rate[1]}": whole(c[f"w{a}"] * rate[0]) for i, a in enumerate("xyz")}
    table |= {f"accSmooth[{i}]{unit}": whole(c[f"a{a}"] / force) for i, a in enumerate("xyz")}
    table |= {f"debug[{i}]": zero for i in range(4)}
    for number, column in enumerate(("m2", "m1", "m3", "m4")):
        table[f"motor[{number}]"] = np.rint(48 + 1999 * c[column])
    table["energyCumulative (mAh)"] = zero
    table["flightModeFlags (flags)"] = ["0", *["ANGLE_MODE|HORIZON_MODE"] * (len(zero) - 1)]
    table["stateFlags (flags)"] = ["0"] * len(zero)
    table["failsafePhase (flags)"] = ["IDLE"] * len(zero)
    return table | {"rxSignalReceived": zero, "rxFlightChannelsValid": zero}


FROM_BLACKBOX = (*PX4_NAMES, "cmd_thrust", "cmd_wx", "cmd_wy", "cmd_wz")


def assert_blackbox(read, columns, names=FROM_BLACKBOX):
    for name in names:
        assert_read(read, columns, (name,), ROUGH[name[0]])
    assert_read(read, columns, ("t",), 1e-6)


@pytest.mark.parametrize("unit", ["", " (g)"])
def test_a_decoded_blackbox_is_read(tmp_path, columns, unit):
    path = tmp_path / "LOG00001.01.csv"
    write_table(path, blackbox(columns, unit), separator=", ")
    (tmp_path / "LOG00001.01.gps.csv").write_text("time (us), GPS_numSat\n0, 9\n")
    assert find_logs(tmp_path) == [path]
    read = read_log(path)
    assert_blackbox(read, columns)
    assert np.nanmedian(read.columns["vbat"]) == pytest.approx(16.12)
    (tmp_path / "vehicle.toml").write_text("")
    case = load_case(tmp_path)
    assert [f.name for f in case.flights] == [path.name], case.quality


EXPLORER = """"Product","Blackbox flight data recorder by Nicholas Sherlock"
"Data version",2
"firmwareType",3
"firmware",4.5
"firmwarePatch",1
"firmwareVersion","4.5.1"
"Firmware revision","Betaflight 4.5.1 (77d01ba3b) STM32H743"
"Log start datetime","0000-01-01T00:00:00.000+00:00"
"Craft name",""
"minthrottle",1070
"maxthrottle",2000
"gyroScale",1.7453292519943295e-8
"motorOutput","48,2047"
"acc_1G",4096
"vbatref",1660
"rollPID","45,80,40"
"dterm_lpf_dyn_hz","75,150"
"debug_mode",6
"blackbox_high_resolution",{fine:d}
"unknownHeaders",""
"""


def write_explorer(path, c, fine):
    """The Explorer's export: a line for each header, then raw fields under names in
    quotes, with what the Explorer computes itself, and NaN where there is nothing.
    """
    table = blackbox(c, fine=10.0 if fine else 1.0)
    table = {name.partition(" (")[0]: values for name, values in table.items()}
    table |= {name: np.zeros(len(c["t"])) for name in ("flightModeFlags", "stateFlags")}
    table["failsafePhase"] = table["stateFlags"]
    table["vbatLatest"] = table["vbatLatest"] * 100
    table |= {f"accSmooth[{i}]": np.rint(c[f"a{a}"] / G * 4096) for i, a in enumerate("xyz")}
    del table["energyCumulative"]
    nothing = np.full(len(c["t"]), np.nan)
    table |= {f"{name}[{i}]": nothing for name in ("heading", "axisSum") for i in range(3)}
    quoted = {f'"{name}"': values for name, values in table.items()}
    write_table(path, quoted, form="{:.10g}")
    text = EXPLORER.format(fine=fine) + path.read_text().replace("nan", "NaN").rstrip("\n")
    path.write_text(text)


@pytest.mark.parametrize("fine", [False, True])
def test_the_blackbox_explorers_export_is_read(tmp_path, columns, fine):
    """Its headers say what 1 g and the battery's unit are, and whether rates are
    tenths.
    """
    path = tmp_path / "btfl_001.bbl.csv"
    write_explorer(path, columns, fine)
    read = read_log(path)
    assert_blackbox(read, columns)
    assert np.nanmedian(read.columns["vbat"]) == pytest.approx(16.12)
    rates = 0.1 * ROUGH["w"] if fine else ROUGH["w"]
    assert_read(read, columns, ("wx", "wy", "wz", "cmd_wx"), rates)
    (tmp_path / "vehicle.toml").write_text("")
    case = load_case(tmp_path)
    assert [f.name for f in case.flights] == [path.name], case.quality


def test_headers_that_were_decoded_into_a_file_of_their_own_count(tmp_path, columns):
    path = tmp_path / "btfl_001.01.csv"
    write_table(path, blackbox(columns, fine=10.0), separator=", ")
    headers = 'fieldname, fieldvalue\nacc_1G, "2048"\nblackbox_high_resolution, "1"\n'
    (tmp_path / "btfl_001.01.headers.csv").write_text(headers)
    assert find_logs(tmp_path) == [path]
    assert_read(read_log(path), columns, ("wx", "wy", "wz"), 0.1 * ROUGH["w"])


def test_a_blackbox_of_pulses_is_told_from_one_of_dshot(tmp_path, columns):
    table = blackbox(columns)
    for number, column in enumerate(("m2", "m1", "m3", "m4")):
        table[f"motor[{number}]"] = 1000 + 1000 * columns[column]
    write_table(tmp_path / "log.csv", table, separator=", ")
    read = read_log(tmp_path / "log.csv")
    assert_blackbox(read, columns, ("m1", "m2", "m3", "m4"))
    assert any("pulses" in remark for remark in read.remarks)


def test_a_blackbox_without_the_usual_fields(tmp_path, columns):
    """The gyroscope before its filters stands for the filtered one; six rotors are
    refused.
    """
    path = tmp_path / "log.csv"
    table = {n.replace("gyroADC", "gyroUnfilt"): v for n, v in blackbox(columns).items()}
    write_table(path, table, separator=", ")
    read = read_log(path)
    assert_blackbox(read, columns)
    assert any("gyroUnfilt" in remark for remark in read.remarks)
    write_table(path, {n: v for n, v in table.items() if "gyro" not in n}, separator=", ")
    with pytest.raises(LogError, match=r"no gyroscope was logged \(gyroADC"):
        read_log(path)
    write_table(path, table | {"motor[4]": table["motor[0]"]}, separator=", ")
    with pytest.raises(LogError, match="more than four motors"):
        read_log(path)


def binary_blackbox(fields, headers=""):
    """A blackbox as a flight controller writes it, of whole frames alone: {field: whole
    numbers}, zigzag and seven bits a byte.
    """
    zeros = ",".join("0" for _ in fields)
    lines = [
        "H Product:Blackbox flight data recorder by Nicholas Sherlock",
        "H Data version:2",
        "H I interval:1",
        "H P interval:1/1",
        f"H Field I name:{','.join(fields)}",
        f"H Field I signed:{','.join('1' for _ in fields)}",
        f"H Field I predictor:{zeros}",
        f"H Field I encoding:{zeros}",
        f"H Field P predictor:{zeros}",
        f"H Field P encoding:{zeros}",
        *headers.splitlines(),
    ]
    data = bytearray("".join(f"{line}\n" for line in lines).encode())
    for row in zip(*fields.values(), strict=True):
        data += b"I"
        for number in map(int, row):
            rest = number << 1 if number >= 0 else (-number << 1) - 1
            while rest > 127:
                data.append(rest & 127 | 128)
                rest >>= 7
            data.append(rest)
    return bytes(data) + b"E\xffEnd of log\0"


def indiflight(c):
    """A sample flight in the counts of Indiflight: pose in north, east, down and forward,
    right, down, rotor speeds in rad/s.
    """
    w, x, y, z = (c[f"q{a}"] for a in "wxyz")
    half = np.sqrt(0.5)
    frd = (half * (w + z), half * (x + y), half * (x - y), half * (w - z))
    numbers = {"loopIteration": np.arange(len(w)), "time": 2_000_000 + 1e6 * c["t"]}
    numbers |= {f"gyroADC[{i}]": 10 * DEGREES * c[f"w{a}"] for i, a in enumerate("xyz")}
    numbers |= {f"accSmooth[{i}]": 2048 / G * c[f"a{a}"] for i, a in enumerate("xyz")}
    numbers |= {f"quat[{i}]": 8127 * q for i, q in enumerate(frd)}
    numbers |= {f"motor[{i}]": 48 + 1999 * c[m] for i, m in enumerate(("m2", "m1", "m3", "m4"))}
    numbers |= {f"omega[{i}]": speed_of(c, m) for i, m in enumerate(("m2", "m1", "m3", "m4"))}
    for name, scale in (("extPos", 1000), ("extVel", 100)):
        ours = ("y", "x", "z") if name == "extPos" else ("vy", "vx", "vz")
        signs = zip(ours, (1, 1, -1), strict=True)
        numbers |= {f"{name}[{i}]": scale * sign * c[n] for i, (n, sign) in enumerate(signs)}
    return {name: np.rint(values) for name, values in numbers.items()}


def speed_of(c, motor):
    """Of a rotor whose thrust is in proportion to its command, rad/s."""
    return 2500.0 * np.sqrt(np.clip(c[motor], 0.0, None))


@pytest.mark.parametrize("name", ["LOG00001.BFL", "log.bbl", "blackbox"])
def test_a_binary_blackbox_is_read_with_pose_and_rotor_speeds(tmp_path, columns, name):
    pytest.importorskip("orangebox")
    headers = "H acc_1G:2048\nH blackbox_high_resolution:1\nH Firmware revision:Indiflight 5.0.0"
    (tmp_path / name).write_bytes(binary_blackbox(indiflight(columns), headers))
    (tmp_path / "vehicle.toml").write_text("")
    assert find_logs(tmp_path) == [tmp_path / name]
    read = read_log(tmp_path / name)
    assert_read(read, columns, ("t", "x", "y", "z", "qw", "qx", "qy", "qz", "wx", "wy", "wz"), 2e-3)
    assert_read(read, columns, ("vx", "vz", "az", "m1", "m2", "m3", "m4"), 1e-2)
    assert_read(
        read, {"w1": speed_of(columns, "m1"), "w3": speed_of(columns, "m3")}, ("w1", "w3"), 1
    )
    (flight,) = load_case(tmp_path).flights
    assert flight.rotor_speed is not None and flight.has_pose


def test_electrical_revolutions_are_rotor_speeds(tmp_path, columns):
    pytest.importorskip("orangebox")
    fields = indiflight(columns)
    for i in range(4):  # hundreds in a minute, of a motor of 12 poles
        fields[f"eRPM[{i}]"] = np.rint(fields.pop(f"omega[{i}]") * 30 / np.pi * 6 / 100)
    (tmp_path / "log.bbl").write_bytes(binary_blackbox(fields, "H motor_poles:12"))
    read = read_log(tmp_path / "log.bbl")
    assert_read(read, {"w1": speed_of(columns, "m1")}, ("w1",), 2.0)


@pytest.mark.parametrize(
    "module, name, data",
    [
        ("orangebox", "log.bbl", b"H Product:Blackbox flight data recorder\n"),
        ("pymavlink.DFReader", "log.bin", b"\xa3\x95\x80"),
    ],
)
def test_a_log_whose_library_is_missing_names_it(tmp_path, monkeypatch, module, name, data):
    monkeypatch.setitem(sys.modules, module, None)
    (tmp_path / name).write_bytes(data)
    with pytest.raises(UserError, match=f"pip install '?{module.partition('.')[0]}"):
        read_log(tmp_path / name)


@pytest.mark.parametrize("name, library", [("log.bbl", "orangebox"), ("log.bin", "pymavlink")])
def test_a_binary_log_without_a_flight_says_so(tmp_path, name, library):
    pytest.importorskip(library)
    start = b"H Product:Blackbox\n" if name == "log.bbl" else b"\xa3\x95\x80"
    for rest in (b"", b"H Data version:2\n", bytes(100), b"\xff" * 300):
        (tmp_path / name).write_bytes(start + rest)
        with pytest.raises(LogError):
            read_log(tmp_path / name)


# --- ArduPilot


def dataflash(messages):
    """A DataFlash log: [(name, types, fields, rows)], each message declared first."""
    data = bytearray()

    def declare(kind, length, name, types, fields):
        nonlocal data
        texts = (name.encode().ljust(4, b"\0"), types.encode().ljust(16, b"\0"))
        data += b"\xa3\x95\x80" + struct.pack("<BB", kind, length)
        data += texts[0] + texts[1] + ",".join(fields).encode().ljust(64, b"\0")

    declare(0x80, 89, "FMT", "BBnNZ", ("Type", "Length", "Name", "Format", "Columns"))
    records = []
    for kind, (name, types, fields, rows) in enumerate(messages, start=1):
        layout = "<" + types.replace("N", "16s")
        declare(kind, 3 + struct.calcsize(layout), name, types, fields)
        head = b"\xa3\x95" + bytes([kind])
        records += [(row[0], head + struct.pack(layout, *row)) for row in rows]
    return bytes(data) + b"".join(r for _, r in sorted(records, key=lambda r: r[0]))


def ardupilot(c, parameters):
    """A sample flight in ArduPilot's frames and messages, every row of each."""
    roll, pitch, yaw = (DEGREES * angle for angle in euler(c))
    time = np.rint(1e6 * (3.0 + c["t"])).astype(int)
    expo = parameters.get("MOT_THST_EXPO", 0.65)
    share = {
        m: (np.sqrt((1 - expo) ** 2 + 4 * expo * c[m]) - (1 - expo)) / (2 * expo)
        for m in ("m1", "m2", "m3", "m4")
    }  # of the range, which gives that thrust
    pulses = [np.rint(1000 + 1000 * share[m]).astype(int) for m in ("m1", "m3", "m4", "m2")]
    zero = np.zeros(len(time), int)
    imu = (time, zero, c["wx"], -c["wy"], -c["wz"], c["ax"], -c["ay"], -c["az"])
    estimate = (time, zero, c["y"], c["x"], -c["z"], c["vy"], c["vx"], -c["vz"])
    rates = (
        time,
        DEGREES * c["cmd_wx"],
        -DEGREES * c["cmd_wy"],
        -DEGREES * c["cmd_wz"],
        c["cmd_thrust"],
    )
    messages = [
        (
            "PARM",
            "QNf",
            ("TimeUS", "Name", "Value"),
            [(0, name.encode(), value) for name, value in parameters.items()],
        ),
        ("IMU", "QBffffff", ("TimeUS", "I", "GyrX", "GyrY", "GyrZ", "AccX", "AccY", "AccZ"), imu),
        ("ATT", "Qfff", ("TimeUS", "Roll", "Pitch", "Yaw"), (time, roll, -pitch, 90.0 - yaw)),
        ("XKF1", "QBffffff", ("TimeUS", "C", "PN", "PE", "PD", "VN", "VE", "VD"), estimate),
        ("RCOU", "QHHHH", ("TimeUS", "C1", "C2", "C3", "C4"), (time, *pulses)),
        ("RATE", "Qffff", ("TimeUS", "RDes", "PDes", "YDes", "AOut"), rates),
        ("BAT", "QBf", ("TimeUS", "I", "Volt"), (time, zero, np.full(len(time), 15.2))),
    ]
    for output, motor in enumerate(("m1", "m3", "m4", "m2")):
        rpm = np.rint(30 / np.pi * speed_of(c, motor))
        messages.append(("ESC", "QBf", ("TimeUS", "Instance", "RPM"), (time, zero + output, rpm)))
    esc = [m for m in messages if m[0] == "ESC"]
    messages = [m for m in messages if m[0] != "ESC"]
    rows = [row for *_, of_motor in esc for row in zip(*of_motor, strict=True)]
    plain = [(n, t, f, v if n == "PARM" else list(zip(*v, strict=True))) for n, t, f, v in messages]
    return dataflash([*plain, (*esc[0][:3], rows)])


@pytest.mark.parametrize("expo", [0.65, 0.3])
def test_an_ardupilot_log_arrives_in_our_frames_and_order(tmp_path, columns, expo):
    pytest.importorskip("pymavlink")
    data = ardupilot(columns, {"MOT_THST_EXPO": expo, "FRAME_CLASS": 1, "FRAME_TYPE": 1})
    (tmp_path / "00000012.BIN").write_bytes(data)
    (tmp_path / "vehicle.toml").write_text("")
    assert find_logs(tmp_path) == [tmp_path / "00000012.BIN"]
    read = read_log(tmp_path / "00000012.BIN")
    names = (
        "t",
        "x",
        "y",
        "z",
        "vx",
        "vy",
        "vz",
        "wx",
        "wy",
        "wz",
        "ax",
        "az",
        "cmd_wy",
        "cmd_thrust",
    )
    assert_read(read, columns, names, 1e-3)
    assert_read(read, columns, ("qw", "qx", "qy", "qz", "m1", "m2", "m3", "m4"), 2e-3)
    assert_read(read, {"w2": speed_of(columns, "m2")}, ("w2",), 1.0)
    (flight,) = load_case(tmp_path).flights
    assert flight.rotor_speed is not None


def test_an_ardupilot_frame_that_is_no_quad_x_is_told(tmp_path, columns):
    pytest.importorskip("pymavlink")
    (tmp_path / "log.bin").write_bytes(ardupilot(columns, {"FRAME_CLASS": 2}))
    with pytest.raises(LogError, match=r"FRAME_CLASS is 2 .* a quad X"):
        read_log(tmp_path / "log.bin")


# --- Crazyswarm2

SWARM_YAML = """
robots:
  cf1: { enabled: true, type: cf21 }
  cf2:
    enabled: true
    type: cf21
    firmware_logging:
      custom_topics:
        rates: { frequency: 100, vars: ["gyro.z", "gyro.y", "gyro.x"] }
robot_types:
  cf21:
    firmware_logging:
      custom_topics:
        rates: { frequency: 100, vars: ["gyro.x", "gyro.y", "gyro.z"] }
all:
  firmware_logging:
    enabled: true
    default_topics: { pose: { frequency: 50 } }
    custom_topics:
      mixer: { frequency: 100, vars: [%s] }
      rates: { frequency: 10, vars: ["acc.x"] }
"""


def write_swarm_bag(path, c):
    """Two vehicles with custom topics; every message waits for the radio for some ms
    more.
    """
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    from openjax.flights.importers.crazyswarm import DEFINITIONS, LOG_TYPE

    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(DEFINITIONS[LOG_TYPE], LOG_TYPE))
    types = store.types
    log, header, stamp = (
        types[n] for n in (LOG_TYPE, "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    )
    waits = np.random.default_rng(1).integers(0, 8, len(c["t"])) * 1_000_000
    waits[7] = 0
    values = {
        "mixer": np.stack(list(mixer_inputs(c).values()), 1),
        "rates": np.stack([c["wx"], c["wy"], c["wz"]], 1) * DEGREES,
    }
    with Writer(path, version=8, storage_plugin=StoragePlugin.SQLITE3) as writer:
        for vehicle in ("cf1", "cf2"):
            for topic, rows in values.items():
                rows = rows[:, ::-1] if (vehicle, topic) == ("cf2", "rates") else rows
                name = f"/{vehicle}/{topic}"
                connection = writer.add_connection(name, LOG_TYPE, typestore=store)
                for k, row in enumerate(rows):
                    tick = 40_000 + round(float(c["t"][k]) * 1000)
                    at = 1_700_000_000_000_000_000 + tick * 1_000_000 + int(waits[k])
                    time = stamp(at // 10**9, at % 10**9)
                    message = log(header(time, ""), tick, row.astype(np.float32))
                    writer.write(connection, at, store.serialize_cdr(message, LOG_TYPE))


def test_crazyswarms_topics_are_named_by_its_yaml(tmp_path, columns):
    pytest.importorskip("rosbags")
    write_swarm_bag(tmp_path / "bag", columns)
    with pytest.raises(LogError, match=r"/cf1/mixer holds values without names: put the crazyfl"):
        read_log(tmp_path / "bag")
    names = ", ".join(f'"{name}"' for name in mixer_inputs(columns))
    (tmp_path / "crazyflies.yaml").write_text(SWARM_YAML % names)
    read = read_log(tmp_path / "bag")
    assert set(read.vehicle.tolist()) == {"cf1", "cf2"}
    for vehicle in ("cf1", "cf2"):
        rows = read.vehicle == vehicle
        own = type(read)("bag", {n: v[rows] for n, v in read.columns.items()}, read.vehicle[rows])
        assert_read(own, columns, ("t", "wx", "wy", "wz", "m1", "m2", "m3", "m4"), 2e-4)
    (tmp_path / "crazyflies.yaml").write_text(SWARM_YAML % '"gyro.x"')
    with pytest.raises(LogError, match=r"/cf1/mixer hold 4 values, but crazyflies\.yaml names 1"):
        read_log(tmp_path / "bag")


def swarm_store():
    """Message types of a bag of Crazyswarm2."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    from openjax.flights.importers.crazyswarm import DEFINITIONS

    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    return store


def add_pose_topics(writer, store, c, without):
    """The default topics `pose` and `odom` of a vehicle at 50 Hz, as Crazyswarm2's
    server with cflib sends them, `odom` with the firmware's sign of pitch; and `/poses`
    of motion capture at 100 Hz, of two vehicles and a wand.
    """
    m = {name.rpartition("/")[2]: kind for name, kind in store.types.items()}
    capture = "motion_capture_tracking_interfaces/msg/NamedPoseArray"
    kinds = {"/cf1/pose": "geometry_msgs/msg/PoseStamped", "/cf1/odom": "nav_msgs/msg/Odometry"}
    kinds["/poses"] = capture
    kinds = {name: kind for name, kind in kinds.items() if name not in without}
    topics = {n: writer.add_connection(n, k, typestore=store) for n, k in kinds.items()}
    roll, pitch, yaw = euler(c)
    wrong = Rotation.from_euler("ZYX", np.stack([yaw, -pitch, roll], 1)).as_quat()
    zero = m["Vector3"](0.0, 0.0, 0.0)
    twist = m["TwistWithCovariance"](m["Twist"](zero, zero), np.zeros(36))
    for k, time in enumerate(c["t"]):
        at = 1_700_000_040_000_000_000 + round(float(time) * 1e9)
        header = m["Header"](m["Time"](at // 10**9, at % 10**9), "world")
        place = m["Point"](c["x"][k], c["y"][k], c["z"][k])
        pose = m["Pose"](place, m["Quaternion"](*(c[f"q{a}"][k] for a in "xyzw")))
        lying = m["Pose"](m["Point"](0.0, 0.0, 0.0), m["Quaternion"](*[np.nan] * 4))
        bodies = [m["NamedPose"]("cf1", pose), m["NamedPose"]("wand", lying)]
        messages = {"/poses": m["NamedPoseArray"](header, bodies)}
        if k % 2 == 0:
            messages["/cf1/pose"] = m["PoseStamped"](header, pose)
            odom = m["Pose"](place, m["Quaternion"](*wrong[k]))
            both = m["PoseWithCovariance"](odom, np.zeros(36))
            messages["/cf1/odom"] = m["Odometry"](header, "cf1", both, twist)
        for name in messages.keys() & topics.keys():
            writer.write(topics[name], at, store.serialize_cdr(messages[name], kinds[name]))


@pytest.mark.parametrize("without, tolerance", [((), 2e-3), (("/poses",), 2e-2)])
def test_crazyswarms_poses_are_the_fastest_with_the_right_sign(
    tmp_path, columns, without, tolerance
):
    pytest.importorskip("rosbags")
    from rosbags.rosbag2 import Reader, StoragePlugin, Writer

    write_swarm_bag(tmp_path / "logs", columns)
    store = swarm_store()
    with (
        Reader(tmp_path / "logs") as logs,
        Writer(tmp_path / "bag", version=8, storage_plugin=StoragePlugin.SQLITE3) as writer,
    ):
        add_pose_topics(writer, store, columns, without)
        copies = {
            c.topic: writer.add_connection(c.topic, c.msgtype, typestore=store)
            for c in logs.connections
        }
        for connection, at, data in logs.messages():
            writer.write(copies[connection.topic], at, data)
    names = ", ".join(f'"{name}"' for name in mixer_inputs(columns))
    (tmp_path / "crazyflies.yaml").write_text(SWARM_YAML % names)
    read = read_log(tmp_path / "bag")
    assert without or any("nothing but poses was logged of wand" in r for r in read.remarks)
    rows = np.flatnonzero(read.vehicle == "cf1")[10:380]
    for name in ("x", "z", "qw", "qx", "qy", "qz"):
        values = read.columns[name][rows]
        np.testing.assert_allclose(values, columns[name][10:380], atol=tolerance, err_msg=name)


def test_columns_of_the_formats_own_names_have_their_time_too(tmp_path, columns):
    """Where `columns.toml` names nothing but the times."""
    table = topic_table(columns, "{column}", "{topic}_t")
    table = {n.replace("_t", " clock") if n.endswith("_t") else n: v for n, v in table.items()}
    write_table(tmp_path / "flight.csv", table)
    groups = {"pose clock": "pose", "imu clock": "imu", "motor clock": "motor"}
    clocks = ", ".join(
        f'{{ from = "{stamp}", unit = "ns", of = {list(TOPICS[topic])} }}'
        for stamp, topic in groups.items()
    )
    (tmp_path / "columns.toml").write_text(f"[columns]\nt = [{clocks}]\n")
    read = read_log(tmp_path / "flight.csv", load_mapping(tmp_path / "columns.toml"))
    first = _first(read, columns)
    for column in ("x", "wx", "m1"):
        assert_read(read, {column: columns[column][first:]}, (column,), 1e-3, slice(10, 300))
    (tmp_path / "columns.toml").write_text('[columns]\nt = [{ from = "imu clock" }]\n')
    write_table(tmp_path / "flight.csv", {"imu clock": table["imu clock"]})
    with pytest.raises(LogError, match="none of its other columns"):
        read_log(tmp_path / "flight.csv", load_mapping(tmp_path / "columns.toml"))
