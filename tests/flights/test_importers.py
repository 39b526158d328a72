"""Importers: what a laboratory's files hold arrives with the right sign, unit, clock
and vehicle.
"""

import re
import struct
from pathlib import Path
from zlib import crc32

import numpy as np
import pytest

from openjax.errors import UserError
from openjax.flights.case import load_case
from openjax.flights.csv_table import write_csv
from openjax.flights.importers import find_logs, importer, load_mapping, read_log
from openjax.flights.importers.firmware import VARIABLES
from openjax.flights.importers.importer import Importer, check_table
from openjax.flights.reading import LogError, LogTable, flights_of
from openjax.flights.samples import log_of

DEGREES = 180 / np.pi


def micro_sd(events, version=2, cut=0):
    """A micro-SD log as the firmware writes it; events: [(name, period us, {variable:
    (letter, values)})].
    """
    data = struct.pack("<BHH", 0xBC, version, len(events))
    for number, (name, _, variables) in enumerate(events):
        data += (
            struct.pack("<H", number) + name.encode() + b"\0" + struct.pack("<H", len(variables))
        )
        for variable, (letter, _) in variables.items():
            data += f"{variable}({letter})".encode() + b"\0"
    stamped = []
    for number, (_, period, variables) in enumerate(events):
        layout = "<" + "".join(letter for letter, _ in variables.values())
        for row, values in enumerate(zip(*(v for _, v in variables.values()), strict=True)):
            stamp = 5_000_000 + row * period if version == 2 else 5_000 + row * period // 1000
            head = struct.pack("<HQ" if version == 2 else "<HI", number, stamp)
            stamped.append((stamp, head + struct.pack(layout, *values)))
    data += b"".join(record for _, record in sorted(stamped, key=lambda s: s[0]))
    return (data + struct.pack("<I", crc32(data)))[: -cut or None]


def firmware_variables(c):
    """A sample flight as the firmware logs it: degrees, g, counts, and its legacy sense
    of pitch.
    """
    floats = {f"stateEstimate.{a}": c[a] for a in "xyz"}
    floats |= {f"stateEstimate.q{a}": c[f"q{a}"] for a in "wxyz"}
    floats |= {f"gyro.{a}": c[f"w{a}"] * DEGREES for a in "xyz"} | {
        f"acc.{a}": c[f"a{a}"] / 9.80665 for a in "xyz"
    }
    floats |= {
        "controller.cmd_thrust": c["cmd_thrust"] * 65535,
        "controller.rollRate": c["cmd_wx"] * DEGREES,
    }
    floats |= {
        "controller.pitchRate": -c["cmd_wy"] * DEGREES,
        "controller.yawRate": c["cmd_wz"] * DEGREES,
    }
    variables = {name: ("f", values) for name, values in floats.items()}
    return variables | {
        f"motor.m{i}": ("H", np.round(c[f"m{i}"] * 65535).astype(int)) for i in (1, 2, 3, 4)
    }


@pytest.fixture
def columns(sample_columns):
    return sample_columns["flight_c"]


def assert_same(table, columns, tolerance=3e-5, skip=("vbat", "vx", "vy", "vz")):
    for name, values in columns.items():
        if name not in skip:
            np.testing.assert_allclose(table.columns[name], values, atol=tolerance, err_msg=name)


def test_a_mapping_of_one_column_leaves_the_others_as_they_are(tmp_path, columns):
    table = log_of([columns], "flight.csv")
    write_csv(tmp_path / "flight.csv", table)
    text = (tmp_path / "flight.csv").read_text().replace("cmd_thrust", "throttle", 1)
    (tmp_path / "flight.csv").write_text(text)
    (tmp_path / "columns.toml").write_text('[columns]\ncmd_thrust = "throttle"\n')
    read = read_log(tmp_path / "flight.csv", load_mapping(tmp_path / "columns.toml"))
    assert set(read.columns) == set(table.columns)


@pytest.mark.parametrize(
    "change, words",
    [
        ({"t": "time"}, "no column t; the log has time, "),
        ({"m3": "motor_3"}, "m1, m2, m4 without m3: log m3"),
        ({"qz": "q_z"}, "qw, qx, qy without qz: log qz"),
    ],
)
def test_a_missing_column_is_named(tmp_path, columns, change, words):
    write_csv(tmp_path / "flight.csv", log_of([columns], "flight.csv"))
    head, _, body = (tmp_path / "flight.csv").read_text().partition("\n")
    names = [change.get(name, name) for name in head.split(",")]
    (tmp_path / "flight.csv").write_text(",".join(names) + "\n" + body)
    with pytest.raises(UserError, match="an empty one there means the nominal"):
        load_case(tmp_path)
    (tmp_path / "vehicle.toml").write_text("")
    with pytest.raises(UserError, match=words):
        load_case(tmp_path)


def config_of(text):
    """A card's config.txt as usddeck.c of the firmware reads it: white space and comments
    are no part of a line, a line that is a comment is none. Version, buffer, file name,
    log on boot; then after "on:fixedFrequency" frequency, mode, and up to 20 variables.
    """
    lines = ["".join(line.partition("#")[0].split()) for line in text.splitlines()]
    lines = [
        line for line, raw in zip(lines, text.splitlines(), strict=True) if raw.strip()[:1] != "#"
    ]
    version, buffer, name, boot, event, frequency, mode, *variables = lines
    assert (version, event) == ("1", "on:fixedFrequency") and 1 <= len(name) <= 10
    return int(buffer), boot == "1", int(frequency), int(mode), variables


def test_the_pages_config_is_what_the_firmware_reads():
    page = (Path(__file__).parents[2] / "docs" / "what_to_log.md").read_text(encoding="utf-8")
    (block,) = [text for text in page.split("```")[1::2] if "on:fixedFrequency" in text]
    buffer, on_boot, frequency, mode, variables = config_of(block.strip())
    # the vendor's own measure: ten variables at 1 kHz go with 512 bytes
    assert len(variables) * frequency <= 10_000 * buffer / 512
    assert on_boot and mode == 1 and len(variables) <= 20 and set(variables) <= VARIABLES
    others = re.findall(r"`(controller\.\w+)`", page)
    swapped = [v for v in variables if not v.startswith("stateEstimate.q")] + others
    assert len(others) == 4 and len(swapped) <= 20 and set(swapped) <= VARIABLES


@pytest.mark.parametrize("tick", [1.0, 1e-3])
def test_micro_sd_log_with_a_line_of_text_above_its_rows(tmp_path, columns, tick):
    """As firmware of 2019 wrote it, in us or ms; the clock of us runs over meanwhile."""
    variables = firmware_variables(columns) | {"pm.vbatMV": ("h", np.full(len(columns["t"]), 3900))}
    names = ",".join(f"{name}({letter})" for name, (letter, _) in variables.items())
    layout = "<I" + "".join(letter for letter, _ in variables.values())
    stamps = (
        (2**32 - 2_000_000 + 1e6 * columns["t"]).astype(int) if tick == 1.0 else 1e3 * columns["t"]
    )
    rows = zip(np.asarray(stamps, int) % 2**32, *(v for _, v in variables.values()), strict=True)
    data = b"".join(struct.pack(layout, *row) for row in rows)
    path = tmp_path / "log00"
    path.write_bytes(f"#tick(I),{names}\n".encode() + data)
    assert find_logs(tmp_path) == [path]
    assert_same(read_log(path), columns)
    path.write_bytes(path.read_bytes()[:-5])
    table = read_log(path)
    assert len(table.vehicle) == len(columns["t"]) - 1 and "cut off" in table.remarks[0]


@pytest.mark.parametrize("version", [1, 2])
def test_micro_sd_log_of_one_clock(tmp_path, columns, version):
    path = tmp_path / "log00"
    path.write_bytes(micro_sd([("fixedFrequency", 10_000, firmware_variables(columns))], version))
    assert find_logs(tmp_path) == [path]
    table = read_log(path)
    assert_same(table, columns)
    assert table.remarks == ()


def test_micro_sd_streams_are_put_on_the_imu_clock(tmp_path, columns):
    variables = firmware_variables(columns)
    slow = {
        n: (letter, v[::2]) for n, (letter, v) in variables.items() if n.startswith("stateEstimate")
    }
    fast = {n: v for n, v in variables.items() if n not in slow}
    battery = {"pm.vbat": ("f", np.linspace(4.0, 3.8, 8))}
    events = [("pose", 20_000, slow), ("imu", 10_000, fast), ("power", 1_000_000, battery)]
    path = tmp_path / "log01"
    path.write_bytes(micro_sd(events))
    table = read_log(path)
    assert_same(table, {n: columns[n] for n in ("t", "wx", "az", "m1", "cmd_wy")})
    assert np.isfinite(table.columns["vbat"]).sum() == 8
    # Every second pose was logged; the rows between are interpolated.
    np.testing.assert_allclose(table.columns["x"][:-1], columns["x"][:-1], atol=1e-3)


def test_the_controllers_variables_stand_for_motors_and_gyroscope(tmp_path, columns):
    """What a log of the controller holds: mixer inputs, gyroscope in the firmware's
    sense, vertical force.
    """
    m = 65535 * np.stack([columns[f"m{i}"] for i in "1234"])
    inputs = {
        "thrust": m.mean(0),
        "roll": (m[2] + m[3] - m[0] - m[1]) / 2,
        "pitch": (m[0] + m[3] - m[1] - m[2]) / 2,
        "yaw": (m[0] + m[2] - m[1] - m[3]) / 4,
    }
    variables = {f"controller.cmd_{n}": ("f", v) for n, v in inputs.items()}
    variables |= {f"stateEstimate.{a}": ("f", columns[a]) for a in "xyz"}
    variables |= {
        "controller.r_roll": ("f", columns["wx"]),
        "controller.r_pitch": ("f", -columns["wy"]),
    }
    variables |= {
        "controller.r_yaw": ("f", columns["wz"]),
        "controller.accelz": ("f", columns["az"] / 9.80665),
    }
    (tmp_path / "log04").write_bytes(micro_sd([("fixedFrequency", 10_000, variables)]))
    table = read_log(tmp_path / "log04")
    assert "mixer" in table.remarks[0]
    assert_same(
        table, {n: columns[n] for n in ("m1", "m2", "m3", "m4", "wx", "wy", "wz", "az", "x")}
    )
    (flight,), _ = flights_of(table)
    assert flight.specific_force is None


def test_a_micro_sd_log_cut_off_is_read_as_far_as_it_goes(tmp_path, columns):
    path = tmp_path / "log02"
    path.write_bytes(micro_sd([("fixedFrequency", 10_000, firmware_variables(columns))], cut=1000))
    table = read_log(path)
    assert "checksum" in table.remarks[0]
    rows = len(table.columns["t"])
    assert 700 < rows < 800
    assert_same(table, {n: v[:rows] for n, v in columns.items()})


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"\xbc\x02\x00\xff\x00" + b"x" * 20, "corrupt header"),
        (micro_sd([("e", 10_000, {"a.b": ("f", [])})]), "without a record"),
        (micro_sd([("e", 10_000, {"a.b": ("f", [1.0, 2.0, 3.0])})]), "neither position"),
    ],
)
def test_unusable_micro_sd_logs_say_why(tmp_path, data, reason):
    (tmp_path / "log03").write_bytes(data)
    with pytest.raises(LogError, match=reason):
        read_log(tmp_path / "log03")


def test_a_mapped_csv_in_other_names_units_and_angles(tmp_path, columns):
    qw, qx, qy, qz = (columns[f"q{a}"] for a in "wxyz")
    other = {
        "stamp": columns["t"] * 1e3 + 1.7e12,
        "px": columns["x"] * 1e3,
        "py": columns["y"] * 1e3,
        "pz": columns["z"] * 1e3,
        "roll": np.arctan2(2 * (qw * qx + qy * qz), 1 - 2 * (qx**2 + qy**2)) * DEGREES,
        "pitch": np.arcsin(2 * (qw * qy - qz * qx)) * DEGREES,
        "yaw": np.arctan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy**2 + qz**2)) * DEGREES,
    } | {f"u{i}": columns[f"m{i}"] * 255 for i in (1, 2, 3, 4)}
    lines = [";".join([*other, "comment"])]
    lines += [
        ";".join([*(f"{v:.7f}" for v in row), "text"]) for row in zip(*other.values(), strict=True)
    ]
    (tmp_path / "other.csv").write_text("\n".join(lines))
    (tmp_path / "columns.toml").write_text(
        'delimiter = ";"\n[columns]\nt = { from = "stamp", unit = "ms" }\n'
        + "".join(f'{a} = {{ from = "p{a}", unit = "mm" }}\n' for a in "xyz")
        + "".join(f'{a} = {{ from = "{a}", unit = "deg" }}\n' for a in ("roll", "pitch", "yaw"))
        + "".join(f'm{i} = {{ from = "u{i}", unit = "8bit" }}\n' for i in (1, 2, 3, 4))
    )
    (tmp_path / "vehicle.toml").write_text('[motor]\ncommand = "pwm"\n')
    table = read_log(tmp_path / "other.csv", load_mapping(tmp_path / "columns.toml"))
    names = ("x", "y", "z", "qw", "qx", "qy", "qz", "m1", "m4")
    assert_same(table, {n: columns[n] for n in names})
    np.testing.assert_allclose(table.columns["t"], columns["t"], atol=1e-3)
    case = load_case(tmp_path)  # the mapping is found and used
    assert [f.name for f in case.flights] == ["other.csv"]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("x = 1", "unknown key 'x'"),
        ("[columns]\nxx = 'a'", "unknown column 'xx'"),
        ("[columns]\nx = { from = 'a', unit = 'feet' }", "unknown unit 'feet'"),
        ("[columns]\nx = { form = 'a' }", "x must be"),
        ("[columns]\nx = { from = 'a', scale = true }", "must be numbers"),
        ("[columns]\nm1 = 'a'\nm2 = 'a'", "m1 and m2 are both from 'a'"),
        ("[columns", "not readable as TOML"),
    ],
)
def test_a_mapping_with_a_slip_says_where(tmp_path, text, reason):
    (tmp_path / "columns.toml").write_text(text)
    with pytest.raises(UserError, match=reason):
        load_mapping(tmp_path / "columns.toml")


def write_bag(path, columns, storage):
    """A ROS 2 bag of two vehicles with standard messages: pose at 50 Hz, IMU and motors
    at 100 Hz.
    """
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    kinds = {
        name.rpartition("/")[2]: store.types[name]
        for name in (
            "sensor_msgs/msg/Imu",
            "geometry_msgs/msg/PoseStamped",
            "geometry_msgs/msg/Pose",
            "geometry_msgs/msg/Point",
            "geometry_msgs/msg/Quaternion",
            "geometry_msgs/msg/Vector3",
            "std_msgs/msg/Header",
            "std_msgs/msg/Float32MultiArray",
            "std_msgs/msg/MultiArrayLayout",
            "builtin_interfaces/msg/Time",
        )
    }
    with Writer(path, version=9, storage_plugin=getattr(StoragePlugin, storage)) as writer:
        for number, vehicle in enumerate(("cf1", "cf2")):
            topics = {
                name: writer.add_connection(f"/{vehicle}/{name}", kind, typestore=store)
                for name, kind in (
                    ("imu", "sensor_msgs/msg/Imu"),
                    ("pose", "geometry_msgs/msg/PoseStamped"),
                    ("motors", "std_msgs/msg/Float32MultiArray"),
                )
            }
            for k in range(len(columns["t"])):
                at = 1_700_000_000_000_000_000 + round(columns["t"][k] * 1e9)
                header = kinds["Header"](kinds["Time"](at // 10**9, at % 10**9), vehicle)
                rates = kinds["Vector3"](*(columns[f"w{a}"][k] for a in "xyz"))
                force = kinds["Vector3"](*(columns[f"a{a}"][k] for a in "xyz"))
                none = kinds["Quaternion"](0.0, 0.0, 0.0, 1.0)
                zero = np.zeros(9)
                messages = {"imu": kinds["Imu"](header, none, zero, rates, zero, force, zero)}
                motors = np.array([columns[f"m{i}"][k] for i in (1, 2, 3, 4)], np.float32)
                messages["motors"] = kinds["Float32MultiArray"](
                    kinds["MultiArrayLayout"]([], 0), motors
                )
                if k % 2 == 0:
                    point = kinds["Point"](
                        columns["x"][k] + number, columns["y"][k], columns["z"][k]
                    )
                    attitude = kinds["Quaternion"](*(columns[f"q{a}"][k] for a in "xyzw"))
                    messages["pose"] = kinds["PoseStamped"](header, kinds["Pose"](point, attitude))
                for name, message in messages.items():
                    # Received 3 ms after it was stamped; the motors have no stamp of
                    # their own.
                    delay = 0 if name == "motors" else 3_000_000
                    connection = topics[name]
                    writer.write(
                        connection, at + delay, store.serialize_cdr(message, connection.msgtype)
                    )


@pytest.mark.parametrize("storage", ["SQLITE3", "MCAP"])
def test_ros2_bag_of_two_vehicles(tmp_path, columns, storage):
    pytest.importorskip("rosbags")
    columns = {n: v[:300] for n, v in columns.items()}
    write_bag(tmp_path / "bag", columns, storage)
    assert find_logs(tmp_path) == [tmp_path / "bag"]
    table = read_log(tmp_path / "bag")
    assert set(table.vehicle.tolist()) == {"cf1", "cf2"}
    for number, vehicle in enumerate(("cf1", "cf2")):
        rows = table.vehicle == vehicle
        own = type(table)(
            "bag", {n: v[rows] for n, v in table.columns.items()}, table.vehicle[rows]
        )
        assert_same(own, {n: columns[n] for n in ("t", "wx", "wz", "ay", "m1", "m4")}, 1e-5)
        np.testing.assert_allclose(own.columns["x"][:-1:2], columns["x"][::2] + number, atol=1e-6)
    mapping = tmp_path / "columns.toml"
    mapping.write_text(
        '[columns]\nwx = "/cf2/imu:angular_velocity.x"\nm1 = "/cf2/motors:data[0]"\n'
    )
    mapped = read_log(tmp_path / "bag", load_mapping(mapping))
    assert_same(mapped, {n: columns[n] for n in ("wx", "m1")}, 1e-5)
    mapping.write_text('[columns]\nwx = "/cf2/imu:angular_velocity.q"\n')
    with pytest.raises(LogError, match=r"no number 'angular_velocity\.q'"):
        read_log(tmp_path / "bag", load_mapping(mapping))


def test_a_damaged_bag_is_refused_and_the_csv_beside_it_is_used(tmp_path, columns):
    pytest.importorskip("rosbags")
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "metadata.yaml").write_text("nonsense: [")
    (tmp_path / "vehicle.toml").write_text("")
    write_csv(tmp_path / "flight.csv", log_of([columns], "flight"))
    case = load_case(tmp_path)
    assert [f.name for f in case.flights] == ["flight.csv"]
    assert [(i.flight, i.refused) for i in case.quality] == [("bag", True)]


@pytest.mark.parametrize("storage", ["SQLITE3", "MCAP"])
def test_a_bag_without_its_metadata_is_read_by_its_files(tmp_path, columns, storage):
    """As where recording was killed, or one file of a bag was handed on."""
    pytest.importorskip("rosbags")
    columns = {n: v[:300] for n, v in columns.items()}
    write_bag(tmp_path / "bag", columns, storage)
    whole = read_log(tmp_path / "bag")
    (tmp_path / "bag" / "metadata.yaml").unlink()
    (file,) = (tmp_path / "bag").iterdir()
    for path in (tmp_path / "bag", file):
        assert find_logs(path.parent) == [path]
        table = read_log(path)
        assert_same(table, whole.columns, 1e-9, skip=())
        np.testing.assert_array_equal(table.vehicle, whole.vehicle)


def test_a_bag_of_ros_1_is_read(tmp_path, columns):
    pytest.importorskip("rosbags")
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    kind = {name.rpartition("/")[2]: message for name, message in store.types.items()}
    stamp = store.types["builtin_interfaces/msg/Time"]
    with Writer(tmp_path / "flight.bag") as writer:
        imu = writer.add_connection("/cf1/imu", "sensor_msgs/msg/Imu", typestore=store)
        still = kind["Quaternion"](0.0, 0.0, 0.0, 1.0)
        for k, time in enumerate(columns["t"][:300]):
            at = 1_700_000_000_000_000_000 + round(float(time) * 1e9)
            header = kind["Header"](k, stamp(at // 10**9, at % 10**9), "cf1")
            rates = kind["Vector3"](*(columns[f"w{a}"][k] for a in "xyz"))
            force = kind["Vector3"](*(columns[f"a{a}"][k] for a in "xyz"))
            message = kind["Imu"](
                header, still, np.zeros(9), rates, np.zeros(9), force, np.zeros(9)
            )
            writer.write(imu, at, store.serialize_ros1(message, imu.msgtype))
    assert find_logs(tmp_path) == [tmp_path / "flight.bag"]
    table = read_log(tmp_path / "flight.bag")
    assert_same(table, {n: columns[n][:300] for n in ("t", "wx", "wz", "ax", "az")})


def test_what_foxglove_is_given_is_no_log(tmp_path, columns):
    """`openjax view --mcap` may write into the folder of the flights."""
    pytest.importorskip("mcap")
    from openjax.show.foxglove import write_mcap

    write_mcap(tmp_path / "flight.mcap", [])
    assert find_logs(tmp_path) == []


def test_a_px4_log_with_flipped_bits_is_read_quietly(tmp_path, capsys):
    pytest.importorskip("pyulog")
    (tmp_path / "log.ulg").write_bytes(b"ULog\x01\x12\x35\x01" + bytes(8) + b"\xff" * 300)
    with pytest.raises(LogError):
        read_log(tmp_path / "log.ulg")
    assert capsys.readouterr() == ("", "")


def test_a_damage_that_an_importer_does_not_foresee_is_a_line(tmp_path, monkeypatch):
    def read(path, mapping):
        return {}["timestamp"]

    monkeypatch.setattr(importer, "_IMPORTERS", [Importer("ours", lambda path: True, read)])
    with pytest.raises(LogError, match=r"can.t be read as ours .KeyError: .timestamp..: damaged"):
        read_log(tmp_path / "flight")


@pytest.mark.parametrize(
    ("read", "words"),
    [
        (lambda columns, ids: columns, "importer of ours gives dict"),
        (lambda columns, ids: LogTable("a", columns, ids[:3]), "column t as ndarray"),
        (
            lambda columns, ids: LogTable("a", {**columns, "wx": [0.0]}, ids),
            r"column wx as list of shape \(1,\); an array of shape \(5,\)",
        ),
    ],
)
def test_what_an_importer_of_ones_own_may_not_give_is_a_line(read, words):
    columns = {"t": np.arange(5.0), "wx": np.zeros(5)}
    ids = np.full(5, "0")
    check_table("ours", LogTable("a", columns, ids))
    with pytest.raises(LogError, match=words):
        check_table("ours", read(columns, ids))
